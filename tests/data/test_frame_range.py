"""What every traverse offers by itself: parts, the shape of a frame, batches that fit into memory."""

from __future__ import annotations

import pytest
import torch
from helpers import Stream, all_of, refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import types
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.frame_range import FrameRange

VALUES = torch.arange(40.0)[:, None]
PARTS = st.tuples(st.integers(0, 39), st.integers(0, 40), st.integers(1, 45)).filter(
    lambda part: part[1] == 0 or part[0] < part[1]
)


@given(PARTS, st.integers(1, 50))
def test_a_part_is_a_slice_however_the_frames_are_read(part: tuple[int, int, int], size: int) -> None:
    start, stop, step = part
    expected = VALUES[start : stop or None : step]
    for traverse in (Stream(VALUES), ArrayTraverse(VALUES), FrameRange(Stream(VALUES))):
        some = FrameRange(traverse, start, stop, step)
        frames = range(start, stop or len(VALUES), step)
        for batches in (list(some.batches(size)), list(traverse.select(frames, size))):
            assert torch.equal(torch.cat(batches), expected)
            assert {len(batch) for batch in batches[:-1]} <= {size}
        assert some.length in (None, len(expected))
        inner = torch.cat([VALUES[:0], *some.between(1, 4)])
        assert torch.equal(inner, expected[1:4])


def test_parts_of_parts_name_both() -> None:
    part = FrameRange(FrameRange(ArrayTraverse(VALUES, "walk"), start=10), stop=8, step=2)
    assert part.name == "walk[10:][0:8:2]"
    assert all_of(part).flatten().tolist() == [10, 12, 14, 16]


@pytest.mark.parametrize(("start", "stop"), [(40, 0), (90, 0), (0, 41), (50, 60)])
def test_a_stream_that_ends_too_soon_is_refused(start: int, stop: int) -> None:
    with refused("traverse[", "frames; expected"):
        all_of(FrameRange(Stream(VALUES), start, stop))


def test_the_shape_of_a_frame() -> None:
    assert ArrayTraverse(torch.rand(3, 2)).frame_shape == (2,)
    assert ArrayTraverse(torch.rand(3, 1, 4, 5)).frame_shape == (1, 4, 5)
    assert FrameRange(Stream(VALUES), start=3).frame_shape == (1,)
    with refused("holds no frames"):
        _ = Stream(VALUES[:0]).frame_shape


def test_large_frames_are_read_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = ArrayTraverse(torch.rand(9, 1, 4, 5))
    assert frames.batch_size(64) == 64
    monkeypatch.setattr(types, "BATCH_NUMBERS", 3 * 20 + 1)
    assert frames.batch_size(64) == 3
    monkeypatch.setattr(types, "BATCH_NUMBERS", 20)
    assert frames.batch_size(64) == 1
    monkeypatch.setattr(types, "FRAME_NUMBERS", 19)
    with refused("frames of 1 x 4 x 5 numbers", "expected at most 19"):
        frames.batch_size(64)
