"""Parts of traverses, several as one route, and what every traverse offers by itself."""

from __future__ import annotations

import math
import pickle
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import frames, write_images
from helpers import Stream, all_of, refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import types
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.traverse import Chain, FrameRange, Selection, chained, runs
from dejavu_torch.data.source import open_source
from dejavu_torch.types import Traverse

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


def parts(cuts: list[int], streams: bool) -> list[Traverse]:
    bounds = [0, *sorted(cuts), len(VALUES)]
    pieces = [VALUES[a:b] for a, b in pairwise(bounds) if b > a]
    return [Stream(piece) if streams else ArrayTraverse(piece) for piece in pieces]


@given(
    st.lists(st.integers(0, 40), max_size=4),
    st.booleans(),
    st.integers(1, 50),
    st.integers(0, 40),
    st.integers(0, 45),
)
def test_a_chain_reads_as_one_traverse(
    cuts: list[int], streams: bool, size: int, start: int, stop: int
) -> None:
    chain = Chain(parts(cuts, streams))
    assert torch.equal(all_of(chain, size), VALUES)
    assert chain.length == (None if streams else 40)
    assert chain.count() == 40
    between = [VALUES[:0], *chain.between(start, stop)]
    assert torch.equal(torch.cat(between), VALUES[start:stop])
    selected = [VALUES[:0], *chain.select(range(start, stop, 3), size)]
    assert torch.equal(torch.cat(selected), VALUES[start:stop:3])


@given(st.sets(st.integers(0, 39)), st.booleans(), st.integers(1, 50))
def test_a_selection_has_the_frames_with_these_numbers(numbers: set[int], streams: bool, size: int) -> None:
    frame = torch.tensor(sorted(numbers), dtype=torch.int64)
    traverse = Stream(VALUES) if streams else ArrayTraverse(VALUES)
    some = Selection(traverse, frame)
    assert some.length == len(frame)
    assert torch.equal(torch.cat([VALUES[:0], *some.batches(size)]), VALUES[frame])
    assert [i for run in runs(frame) for i in run] == sorted(numbers)


@pytest.mark.parametrize("streams", [False, True])
def test_large_frames_are_read_few_at_a_time(streams: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    chain = Chain(parts([20], streams))
    some = Selection(chain, torch.arange(5, 30))
    assert ArrayTraverse(torch.rand(9, 1, 4, 5)).batch_size(64) == 64
    for numbers, most in ((3, 3), (0, 1)):
        monkeypatch.setattr(types, "BATCH_NUMBERS", numbers)
        for traverse in (chain, some):
            assert max(map(len, traverse.between(0, 25))) == traverse.batch_size(64) == most
    assert torch.equal(torch.cat(list(some.select(range(25), 2))), VALUES[5:30])
    monkeypatch.setattr(types, "FRAME_NUMBERS", 19)
    with refused("frames of 1 x 4 x 5 numbers", "expected at most 19"):
        ArrayTraverse(torch.rand(9, 1, 4, 5)).batch_size(64)


def test_frames_keep_their_names_behind_that_of_their_traverse(tmp_path: Path) -> None:
    folders = [write_images(tmp_path / name, frames(count, size=16)) for name, count in (("a", 3), ("b", 2))]
    chain = chained([open_source(folder) for folder in folders])
    assert [chain.frame_name(i) for i in range(5)] == ["a/0.png", "a/1.png", "a/2.png", "b/0.png", "b/1.png"]
    assert math.isnan(chain.frame_time(4))
    assert chain.seeks
    assert not Chain([Stream(VALUES), open_source(folders[0])][:1]).seeks
    alone = open_source(folders[0])
    assert chained([alone]) is alone


def test_frames_of_other_sizes_are_refused() -> None:
    pair = [ArrayTraverse(torch.zeros(3, 4), "left"), ArrayTraverse(torch.zeros(3, 5), "right")]
    with refused("right", "5", "4", "left"):
        Chain(pair)
    with refused("no traverses"):
        Chain([])


@pytest.mark.parametrize("source", ["aerial", "outdoor", "underground"])
def test_a_simulated_route_goes_elsewhere_without_its_drawings(source: str) -> None:
    route = open_source(f"sim:{source}?frames=8&seed=3")
    first = next(route.batches(2))
    packed = pickle.dumps(route)
    assert len(packed) < 1000
    assert torch.equal(next(pickle.loads(packed).batches(2)), first)


def test_an_array_goes_elsewhere_as_its_file(tmp_path: Path) -> None:
    np.save(tmp_path / "route.npy", np.random.default_rng(0).random((5000, 8), np.float32))
    route = open_source(tmp_path / "route.npy")
    packed = pickle.dumps(route)
    assert len(packed) < 1000
    assert torch.equal(all_of(pickle.loads(packed)), all_of(route))
    # a part of what is mapped goes as its values
    mapped = np.load(tmp_path / "route.npy", mmap_mode="r")
    part, other = ArrayTraverse(mapped[100:140]), ArrayTraverse(mapped[200:240])
    assert torch.equal(all_of(pickle.loads(pickle.dumps(part))), all_of(route)[100:140])
    assert part.state(0, 40) != other.state(0, 40)


def test_identities_tell_sources_apart(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "a", frames(3, size=16))
    np.save(tmp_path / "b.npy", np.zeros((4, 8), np.float32))
    sources = [folder, f"{folder}?width=8", f"{folder}?start=1", tmp_path / "b.npy"]
    sources += ["sim:aerial?frames=9", "sim:aerial?frames=9&seed=1"]
    opened = [open_source(source) for source in sources]
    identities = [one.identity() for one in (*opened, Chain([opened[0], opened[0]]))]
    assert len({*identities}) == 7
    assert identities[:6] == [open_source(source).identity() for source in sources]


def test_states_change_with_the_frames_that_they_are_of(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "a", frames(3, size=16))
    np.save(tmp_path / "b.npy", np.zeros((4, 8), np.float32))
    images, array = open_source(folder), open_source(tmp_path / "b.npy")
    chain, part = Chain([images, images]), open_source(f"{folder}?start=1")
    watched = [(images, 0, 3), (array, 0, 3), (chain, 0, 3), (chain, 3, 4)]
    others = [(images, 1, 3), (part, 0, 2), (chain, 1, 3), (chain, 4, 6)]
    before, kept = ([one.state(start, stop) for one, start, stop in list] for list in (watched, others))
    np.save(tmp_path / "b.npy", np.zeros((5, 8), np.float32))
    (folder / "0.png").write_bytes((folder / "1.png").read_bytes() + b"\0")
    assert all(one.state(a, b) != old for (one, a, b), old in zip(watched, before, strict=True))
    assert [one.state(a, b) for one, a, b in others] == kept
    (folder / "0.png").unlink()
    with refused("0.png"):
        images.state(0, 1)
    arrays = [ArrayTraverse(values) for values in (VALUES, VALUES + 1, VALUES.to(torch.bfloat16))]
    assert len({one.state(0, 3) for one in arrays}) == 3
    assert ArrayTraverse(VALUES.clone()).state(0, 40) == arrays[0].state(0, 40)
