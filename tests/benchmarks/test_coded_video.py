"""Frames as a video codec gives them back."""

from __future__ import annotations

import av
import pytest
import torch
from helpers import all_of, refused

from benchmarks.coded_video import CodedVideo
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_fewer_bytes_give_back_less(codec: str) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"no {codec}")
    traverse = open_source("sim:aerial?frames=40")
    fine, coarse = (CodedVideo(traverse, codec, crf) for crf in (10, 45))
    assert fine.bytes > 2 * coarse.bytes > 0
    frames = all_of(traverse)
    found = [all_of(coded) for coded in (fine, coarse)]
    assert found[0].shape == frames.shape
    errors = [float((one - frames).square().mean()) for one in found]
    assert errors[0] < errors[1]
    still = float((frames[torch.randperm(40)] - frames).square().mean())
    assert errors[0] < still / 4  # and in their order


def test_grey_frames_of_odd_sizes() -> None:
    if "libx264" not in av.codecs_available:
        pytest.skip("no libx264")
    traverse = ArrayTraverse(torch.rand(3, 1, 33, 17).round())
    assert all_of(CodedVideo(traverse, "libx264", 20)).shape == (3, 3, 33, 17)


def test_ready_features_are_no_frames() -> None:
    with refused("ready features", "expected frames"):
        CodedVideo(ArrayTraverse(torch.rand(5, 8)), "libx264", 20)


def test_every_kth_frame() -> None:
    if "libx264" not in av.codecs_available:
        pytest.skip("no libx264")
    traverse = open_source("sim:aerial?frames=10")
    every, third = (CodedVideo(traverse, "libx264", 10, step) for step in (1, 3))
    assert (every.length, third.length) == (10, 4)
    assert third.bytes < every.bytes
    errors = (all_of(third)[-1] - all_of(traverse)).square().mean((1, 2, 3))
    assert int(errors.argmin()) == 9
