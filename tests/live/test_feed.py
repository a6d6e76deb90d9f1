"""Frames read ahead, dropped, in real time, and sources that stop."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
from helpers import refused

from dejavu_torch.data.camera import Frame
from dejavu_torch.live.feed import FrameReader, in_real_time

PIXELS = np.zeros((2, 2, 3), np.uint8)


def shots(count, rate=25.0):
    return (Frame(i, i / rate, PIXELS) for i in range(count))


def test_of_a_live_source_the_newest_frame_is_taken_and_the_others_are_counted():
    steps = [threading.Event() for _ in range(2)]

    def bursts():
        yield from shots(5)
        steps[0].set()
        assert steps[1].wait(5)
        yield from (Frame(i, 0.0, PIXELS) for i in range(5, 9))

    with FrameReader(bursts(), newest=True) as feed:
        assert steps[0].wait(5)
        frames = iter(feed)
        first = next(frames).number
        assert first >= 3  # the last but one, if its successor is on its way
        steps[1].set()
        seen = [first, *(shot.number for shot in frames)]
    assert seen[-1] == 8
    assert feed.dropped == 9 - len(seen)


def test_the_thread_ends_with_the_feed():
    with FrameReader(shots(10**9)) as feed:
        next(iter(feed))
    assert not feed._thread.is_alive()


def test_real_time():
    began = time.monotonic()
    assert len(list(in_real_time(shots(6, rate=50), "clip"))) == 6
    assert time.monotonic() - began >= 0.1
    with refused("no times"):
        list(in_real_time([Frame(0, math.nan, PIXELS)], "folder"))
    began = time.monotonic()
    assert len(list(in_real_time((Frame(i, math.nan, PIXELS) for i in range(6)), "folder", rate=50))) == 6
    assert time.monotonic() - began >= 0.1
