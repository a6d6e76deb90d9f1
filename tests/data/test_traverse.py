"""A traverse is a sequence, whatever it reads; parts, several as one, other sizes, and users' own frames."""

from __future__ import annotations

import pickle
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from command_line import frames, write_images
from footage import REFERENCE, camera, footage
from helpers import all_of, refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch.utils.data import DataLoader, TensorDataset
from videos import clip, numbers, pictures

from dejavu_torch import DejaVu, types
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import as_traverse, open_source
from dejavu_torch.data.traverse import (
    Chain,
    Cropped,
    Fitted,
    Part,
    Whole,
    at_size,
    chained,
    frame_range,
    kept,
    runs,
)
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.resize import is_stretched, reduced_size, resize_frames
from dejavu_torch.types import Traverse

VALUES = torch.arange(40.0)[:, None]
PARTS = st.tuples(st.integers(0, 39), st.integers(0, 40), st.integers(1, 45)).filter(
    lambda part: part[1] == 0 or part[0] < part[1]
)


# cropped, masked and damaged frames


def test_crop_and_mask(tmp_path):
    write_images(tmp_path / "a", frames(3, size=12))
    Image.fromarray(np.repeat([[0, 255]], 12, 1).astype(np.uint8).repeat(6, 0).reshape(6, 24)).save(
        tmp_path / "half.png"
    )
    plain = open_source(tmp_path / "a")[:]
    cropped = open_source(f"{tmp_path}/a?crop=1,2,3,4&start=1")
    assert torch.equal(cropped[:], plain[1:, :, 1:10, 3:8])
    assert at_size(cropped, (3, 4)).frame_shape == (1, 3, 4)
    masked = open_source(f"{tmp_path}/a?mask={tmp_path}/half.png&crop=0,0,1,0")[:]
    assert torch.equal(masked[..., :5], torch.zeros_like(masked[..., :5]))
    assert torch.equal(masked[..., 5:], plain[..., 6:])
    assert torch.equal(Cropped(open_source(tmp_path / "a"), [0, 0, 0, 0])[:], plain)
    for option, words in (
        ("crop=1,2,3", ("'1,2,3'", "TOP,BOTTOM,LEFT,RIGHT")),
        ("crop=-1,2,3,4", ("'-1,2,3,4'",)),
        ("crop=6,6,0,0", ("crop=6,6,0,0 of 1 x 12 x 12", "some pixels are left")),
        (f"mask={tmp_path}/no.png", ("no.png is not there",)),
    ):
        with refused(*words):
            open_source(f"{tmp_path}/a?{option}")


def test_damaged_frames_are_black_and_counted(tmp_path):
    write_images(tmp_path / "a", frames(6, size=12))
    plain = open_source(tmp_path / "a")
    names = [*plain.names]
    before = plain[:]
    for i in (0, 4):
        (tmp_path / "a" / names[i]).write_bytes(b"no image")
    whole = Whole(open_source(tmp_path / "a"))
    assert whole.frame_shape == (1, 12, 12)
    half = at_size(whole, (6, 6))
    assert half[:].flatten(1).any(1).tolist() == [False, True, True, True, False, True]
    assert sorted(whole.damaged) == [0, 4]
    assert names[4] in whole.damaged[4]
    before[[0, 4]] = 0
    assert torch.equal(whole[:], before)
    for name in names:
        (tmp_path / "a" / name).write_bytes(b"no image")
    with refused("none of the 6 frames"):
        Whole(open_source(tmp_path / "a"))[:]


# the sequence protocol


def descriptor_file(folder):
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / "a.h5", "w") as file:
        for i, row in enumerate(np.random.default_rng(0).random((12, 4), np.float32)):
            file[f"{i:02}.jpg/global_descriptor"] = row
    return open_source(folder / "a.h5")


MADE = {
    "h5": lambda images, folder: descriptor_file(folder),
    "chain": lambda images, folder: Chain([images, frame_range(images, 3, 9, 2)]),
    "part": lambda images, folder: Part(images, torch.tensor([4, 1, 1, 11, 0, 7])),
    "part of a part": lambda images, folder: Part(frame_range(images, 2, step=2), range(1, 5)),
    "fitted": lambda images, folder: Fitted(images, (1, 8, 8)),
    "resampled": lambda images, folder: ResampledTraverse(ArrayTraverse(footage(REFERENCE)), camera()),
    "list": lambda images, folder: as_traverse([*images]),
}
SOURCES = ("images", "frames.npy", "features.npy", "clip.mkv", "clip.mp4", "strip", "aerial", "outdoor")


@pytest.mark.parametrize("kind", [*SOURCES, *MADE])
def test_any_traverse_is_a_sequence(kind, sources, tmp_path):
    made, images = MADE.get(kind), open_source(sources["images"])
    traverse = made(images, tmp_path) if made else open_source(sources[kind])
    count, whole = len(traverse), all_of(traverse, 5)
    numbers = np.arange(count)

    def same(found, expected):  # simulated frames are drawn together
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)

    assert (len(whole), whole.shape[1:]) == (count, traverse.frame_shape)
    same(traverse[:], whole)
    same(torch.stack([*traverse]), whole)
    for i in (count - 1, 0, 3, -1, -count, torch.tensor(2), np.int64(1)):
        same(traverse[i], whole[int(i)])
    mask = torch.arange(count) % 3 == 1
    several = [slice(1, 5, 3), slice(-3, None), slice(None, None, -1), range(1, 4), [3, 2, 2, -1]]
    for index in (*several, torch.tensor([3, 0, 3]), mask, mask.numpy()):
        same(traverse[index], whole[numbers[np.asarray(index) if index is mask else index].copy()])
    for none in (slice(3, 3), slice(count, count + 5), [], torch.zeros(count, dtype=torch.bool)):
        assert traverse[none].shape == (0, *traverse.frame_shape)
    for beyond in (count, -count - 1, [0, count]):
        missing = beyond[-1] if isinstance(beyond, list) else beyond
        with pytest.raises(IndexError) as caught:
            traverse[beyond]
        assert str(caught.value) == f"there is no frame {missing} of {traverse.name}, which has {count}"
    with pytest.raises(IndexError, match=r"a mask \(2,\) for the"):
        traverse[[True, False]]
    with pytest.raises(TypeError, match="float"):
        traverse[1.0]  # type: ignore[index]
    assert len(traverse.names) in (0, count)
    assert all(known is None or len(known) == count for known in (traverse.times, traverse.places))
    same(all_of(pickle.loads(pickle.dumps(traverse))), whole)


@pytest.mark.parametrize("how", ["fork", "spawn"])
def test_a_loader_with_workers_gives_the_same_frames(how, sources):
    for kind in ("clip.mp4", "images"):
        traverse = open_source(sources[kind])
        whole = traverse[:]
        assert torch.equal(traverse[3:5], whole[3:5])  # a video stays open
        loader = DataLoader(traverse, batch_size=5, num_workers=2, multiprocessing_context=how)
        assert torch.equal(torch.cat([*loader]), whole)


def test_a_traverse_of_ones_own_is_a_length_and_a_reader():
    class Ramp(Traverse):
        def __init__(self, count: int) -> None:
            self.count = count

        def __len__(self):
            return self.count

        def read(self, frames):
            return torch.tensor([*frames]).float()[:, None]

    assert torch.equal(Ramp(40)[3:9], VALUES[3:9])
    assert torch.equal(all_of(Ramp(40), 7), VALUES)
    assert (Ramp(3).names, Ramp(3).times, Ramp(3).places, Ramp(3).frame_shape) == ((), None, None, (1,))
    assert [repr(Ramp(40)), repr(Ramp(0))] == [
        "traverse: 40 frames (1,)",
        "traverse: no frames that can be read",
    ]
    with refused("traverse holds no frames", "at least one"):
        DejaVu().learn(Ramp(0))
    with refused("0 frames", "at least 1"):
        next(Ramp(3).batches(0))


# parts, and several as one


@given(PARTS, st.integers(1, 50))
def test_a_part_is_a_slice_however_the_frames_are_read(part, size):
    start, stop, step = part
    expected = VALUES[start : stop or None : step]
    for traverse in (ArrayTraverse(VALUES), frame_range(ArrayTraverse(VALUES))):
        some = frame_range(traverse, start, stop, step)
        batches = list(some.batches(size))
        assert torch.equal(torch.cat(batches), expected)
        assert {len(batch) for batch in batches[:-1]} <= {size}
        assert len(some) == len(expected)
        assert torch.equal(some[1:4], expected[1:4])


def parts(cuts):
    bounds = [0, *sorted(cuts), len(VALUES)]
    return [ArrayTraverse(VALUES[a:b]) for a, b in pairwise(bounds) if b > a]


@given(st.lists(st.integers(0, 40), max_size=4), st.integers(1, 50), st.integers(0, 40), st.integers(0, 45))
def test_a_chain_reads_as_one_traverse(cuts, size, start, stop):
    chain = Chain(parts(cuts))
    assert torch.equal(all_of(chain, size), VALUES)
    assert len(chain) == 40
    assert torch.equal(chain[start:stop:3], VALUES[start:stop:3])
    mixed = [(7 * i + start) % 40 for i in range(stop)]
    assert torch.equal(chain[mixed], VALUES[mixed])


@given(st.sets(st.integers(0, 39)), st.integers(1, 50))
def test_a_part_has_the_frames_with_these_numbers(numbers, size):
    frame = torch.tensor(sorted(numbers), dtype=torch.int64)
    some = Part(ArrayTraverse(VALUES), frame)
    assert len(some) == len(frame)
    assert torch.equal(torch.cat([VALUES[:0], *some.batches(size)]), VALUES[frame])
    assert [i for run in runs(frame) for i in run] == sorted(numbers)


def test_large_frames_are_read_few_at_a_time(monkeypatch):
    chain, large = Chain(parts([20])), ArrayTraverse(torch.rand(9, 1, 4, 5))
    some = Part(chain, torch.arange(5, 30))
    assert large.at_once(64) == 64
    for values, most in ((3, 3), (0, 1)):
        monkeypatch.setattr(types, "BATCH_NUMBERS", values)
        for traverse in (chain, some):
            assert max(map(len, traverse.batches(64))) == traverse.at_once(64) == most
    assert torch.equal(all_of(some, 2), VALUES[5:30])
    monkeypatch.setattr(types, "FRAME_NUMBERS", 19)
    with refused("frames of 1 x 4 x 5 numbers", "expected at most 19"):
        large.at_once(64)


def test_frames_keep_their_names_and_times_behind_the_name_of_their_traverse(tmp_path):
    folders = [write_images(tmp_path / name, frames(count, size=16)) for name, count in (("a", 3), ("b", 2))]
    alone, other = map(open_source, folders)
    chain = chained([alone, other])
    assert chain.names == ["a/0.png", "a/1.png", "a/2.png", "b/0.png", "b/1.png"]
    assert (chain.times, Part(chain, torch.tensor([4, 0])).names) == (None, ["b/1.png", "a/0.png"])
    other.times = torch.tensor([0.5, 0.75], dtype=torch.float64)
    times = chained([alone, other]).times
    assert times is not None
    assert [*times.isnan().tolist(), *times[3:].tolist()] == [True, True, True, False, False, 0.5, 0.75]
    assert chained([alone]) is alone
    assert Chain([ArrayTraverse(VALUES)] * 2).names == ()


def test_frames_of_other_sizes_are_refused():
    pair = [ArrayTraverse(torch.zeros(3, 4), "left"), ArrayTraverse(torch.zeros(3, 5), "right")]
    with refused("right", "5", "4", "left"):
        Chain(pair)
    with refused("no traverses"):
        Chain([])


# other sizes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The same 6 smooth frames of 64 x 96 pixels as images, as a video and as an array."""
    folder, frames = tmp_path_factory.mktemp("frames"), pictures(6, 64, 96)
    frames[:, :, 48:] = 100 + np.arange(48, dtype=np.uint8)[:, None]
    (folder / "images").mkdir()
    for i, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / "images" / f"{i}.png")
    clip(folder / "clip.mkv", frames)
    np.save(folder / "frames.npy", frames)
    return folder


@pytest.mark.parametrize(
    "source", ["images", "clip.mkv", "frames.npy", "images?start=1&stop=6&step=2", "clip.mkv?stop=4"]
)
def test_frames_are_resized_and_all_else_stays(source, folder):
    own = open_source(f"{folder}/{source}")
    own.places = torch.arange(len(own)).double()
    first = own[0]  # what is open or known by now is of the other size
    small = at_size(own, (32, 48))
    assert small.frame_shape == (3, 32, 48)
    assert (len(small), small.sized, small.ordered) == (len(own), True, own.ordered)
    assert [*small.names] == [*own.names]
    assert small.places is not None
    assert torch.equal(small.places, own.places)
    assert (own.frame_shape, own.sized) == ((3, 64, 96), False)
    frames = all_of(small, batch=4)
    assert numbers(frames) == numbers(own[:])
    torch.testing.assert_close(frames, resize_frames(own[:], (32, 48)), atol=0.15, rtol=0)  # at the edge
    torch.testing.assert_close(small[1:3], frames[1:3])
    assert torch.equal(own[0], first)


def test_a_large_jpeg_is_decoded_small(tmp_path):
    across = torch.linspace(0, 255, 800).byte().expand(3, 600, 800)
    Image.fromarray(across.permute(1, 2, 0).numpy()).save(tmp_path / "photo.jpg", quality=95)
    small, whole = (open_source(f"{tmp_path}{size}")[:] for size in ("?width=80", ""))
    assert small.shape == (1, 3, 60, 80)
    torch.testing.assert_close(small, resize_frames(whole, (60, 80)), atol=0.02, rtol=0)


def test_a_portrait_among_landscapes_is_refused(tmp_path):
    for i, size in enumerate(((400, 300), (404, 300), (300, 400))):
        Image.new("L", size, 90).save(tmp_path / f"{i}.png")
    with refused("2.png", "300 x 400", "aspect ratio", "0.png"):
        all_of(at_size(open_source(tmp_path), (120, 160)))
    assert open_source(f"{tmp_path}?width=160&height=120")[:].shape == (3, 1, 120, 160)  # as asked for


def test_sizes():
    assert reduced_size((4000, 1), 160) == (160, 1)
    assert reduced_size((96, 96), 160) == (96, 96)
    assert reduced_size((3000, 4000), None) == (3000, 4000)
    assert reduced_size((480, 640), 160, least=(224, 224)) == (224, 299)
    assert not is_stretched((480, 640), (90, 120))
    assert is_stretched((480, 640), (120, 120))


# a user's own frames


class Labelled:
    """A dataset without end in sight, as many have: items by number, and a length."""

    def __init__(self, items: list[Any]) -> None:
        self.items = items

    def __len__(self):
        return len(self.items)

    def __getitem__(self, i):
        return self.items[i], i % 3


def pil(frames):
    return [Image.fromarray(frame) for frame in (frames.permute(0, 2, 3, 1) * 255).round().byte().numpy()]


TOLD = {"pair": "of each pair the first part is taken", "pil": "PIL images are converted to floats in [0, 1]"}


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (list, []),
        (lambda frames: [*frames.numpy()], []),
        (lambda frames: Labelled([*frames]), ["pair"]),
        (TensorDataset, ["pair"]),
        (pil, ["pil"]),
        (lambda frames: Labelled(pil(frames)), ["pair", "pil"]),
        (lambda frames: [np.asarray(image) for image in pil(frames)], []),
    ],
    ids=["tensors", "arrays", "pairs", "tensor dataset", "images", "pairs of images", "bytes"],
)
def test_any_frames_learn_and_localize(make, told, caplog):
    values = (open_source("sim:aerial?frames=40")[:] * 255).round() / 255
    source = make(values)
    assert torch.equal(as_traverse(source)[:], values)
    expected = [f"the dataset: {', '.join(TOLD[one] for one in told)}"] if told else []
    assert caplog.messages == expected
    assert DejaVu().learn(source).localize(source).index.tolist() == list(range(40))


def test_images_of_other_modes_are_frames():
    grey, palette = Image.new("L", (5, 4), 51), Image.new("P", (5, 4))
    assert torch.equal(as_traverse([grey])[:], torch.full((1, 1, 4, 5), 0.2))
    assert as_traverse([palette, Image.new("RGBA", (5, 4))])[:].shape == (2, 3, 4, 5)
    assert as_traverse([np.zeros((4, 5), np.uint8)]).frame_shape == (1, 4, 5)
    assert as_traverse([torch.rand(7, dtype=torch.float64)] * 2)[:].dtype == torch.float64  # features


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ({"a": torch.rand(3, 4, 5)}, ["got a dict", "expected a Traverse, a tensor or array"]),
        (None, ["got a NoneType", "expected a Traverse"]),
        (iter([torch.rand(3, 4, 5)]), ["got a list_iterator", "expected a Traverse"]),
        ([], ["the dataset is empty"]),
        ([1, 2], ["item 0 of the dataset is int", "expected a frame (C,H,W), features (D,) or an image"]),
        ([torch.zeros(4, 5, dtype=torch.int64)], ["item 0", "(4, 5) torch.int64"]),
        ([torch.rand(3, 4, 5), torch.rand(3, 4, 6)], ["item 1", "(3, 4, 6)", "expected (3, 4, 5) as item 0"]),
        ([torch.rand(3, 4, 5), torch.rand(3)], ["item 1", "(3,)", "expected (3, 4, 5) as item 0"]),
    ],
)
def test_what_holds_no_frames_of_one_shape_is_refused(source, words):
    with refused(*words):
        as_traverse(source)[:]


# frames that are kept


class Counted(ArrayTraverse):
    """Notes which frames were read."""

    def __init__(self, values):
        super().__init__(values)
        self.seen = []

    def read(self, frames):
        self.seen += frames
        return super().read(frames)


@pytest.mark.parametrize("whole", [True, False])
def test_kept_frames_are_read_once_and_stay_the_same(whole):
    frames = torch.rand(20, 3, 8, 8)
    counted = Counted((frames * 255).byte() if whole else frames)
    expected, held = counted[:], kept(counted)
    counted.seen.clear()
    for some in ([3, 4, 5], range(2, 9), [7, 19, 4, 7], range(20), [0]):
        assert torch.equal(held[some], expected[some])
    assert sorted(counted.seen) == [*range(20)]


def test_frames_beyond_the_room_are_read_again(monkeypatch):
    monkeypatch.setattr("dejavu_torch.data.traverse.KEPT_BYTES", 4 * 3 * 8 * 8 * 5)
    counted = Counted((torch.rand(20, 3, 8, 8) * 255).byte())
    expected, held = counted[:], kept(counted)
    counted.seen.clear()
    for _ in range(2):
        assert torch.equal(held[:], expected)
    assert counted.seen == [*range(20), *range(5, 20)]


def test_features_and_long_traverses_are_not_kept(monkeypatch):
    features, frames = ArrayTraverse(torch.rand(9, 4)), ArrayTraverse(torch.rand(9, 1, 4, 4))
    assert kept(features) is features
    monkeypatch.setattr("dejavu_torch.data.traverse.KEPT_FRAMES", 8)
    assert kept(frames) is frames
