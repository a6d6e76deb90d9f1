"""Arrays as traverses: values, batches, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import all_of, refused

from dejavu_torch import compare
from dejavu_torch.data.arrays import ArrayTraverse, read_array

RANDOM = np.random.default_rng(0)
GREY = RANDOM.integers(0, 256, (7, 4, 5), np.uint8)
COLOUR = RANDOM.integers(0, 256, (7, 4, 5, 3), np.uint8)
FRAMES = RANDOM.random((7, 1, 4, 5), np.float32)
FEATURES = RANDOM.random((7, 6))


@pytest.mark.parametrize("kind", ["array", "tensor", "file"])
@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (GREY, torch.tensor(GREY)[:, None] / 255),
        (COLOUR, torch.tensor(COLOUR).permute(0, 3, 1, 2) / 255),
        (COLOUR[..., :1], torch.tensor(COLOUR)[:, None, :, :, 0] / 255),
        (FRAMES, torch.tensor(FRAMES)),
        (FEATURES.astype(np.float16), torch.tensor(FEATURES.astype(np.float16)).float()),
        (GREY[::-1], torch.tensor(GREY[::-1].copy())[:, None] / 255),
        (np.asfortranarray(FEATURES), torch.tensor(FEATURES)),
    ],
    ids=["grey", "colour", "one-channel", "float", "half", "reversed", "fortran"],
)
def test_values(values, expected, kind, tmp_path):
    if kind == "file":
        np.save(tmp_path / "a.npy", values)
        traverse = read_array(tmp_path / "a.npy")
        next(traverse.batches(3)).zero_()  # a batch is a copy
    else:
        traverse = ArrayTraverse(torch.tensor(values.copy()) if kind == "tensor" else values)
    found = all_of(traverse)
    assert found.dtype == expected.dtype
    assert torch.equal(found, expected)
    assert len(traverse) == 7


@pytest.mark.parametrize(("names", "ordered"), [("5 6 7 8 9 10 11", True), ("é 1 2 0 1 2 0", False)])
def test_a_file_beside_features_names_their_images(tmp_path, names, ordered):
    np.save(tmp_path / "a.npy", FEATURES)
    (tmp_path / "a.txt").write_bytes(("\ufeff" + "\r\n".join(names.split()) + "\n\n").encode())
    traverse = read_array(tmp_path / "a.npy")
    assert (traverse.names, traverse.ordered) == (names.split(), ordered)
    assert torch.equal(all_of(traverse), torch.tensor(FEATURES))


@pytest.mark.parametrize("count", [0, 6, 8])
def test_another_number_of_names_is_refused(tmp_path, count):
    np.save(tmp_path / "a.npy", FEATURES)
    (tmp_path / "a.txt").write_text("a.jpg\n" * count)
    with refused("a.txt", f"has {count} names", "expected 7 names", "a.npy"):
        read_array(tmp_path / "a.npy")


def test_rows_and_columns_that_are_swapped_are_noticed_by_names_and_by_numbers(tmp_path):
    np.save(tmp_path / "a.npy", FEATURES.T)
    (tmp_path / "a.txt").write_text("a.jpg\n" * len(FEATURES))
    with refused("as many as the array has columns", "its transpose"):
        read_array(tmp_path / "a.npy")
    with refused("6 features", "rows and columns are swapped", "transposes"):
        compare(torch.rand(9, 6), torch.rand(9, 7))


def test_names_that_are_no_text_are_refused_and_frames_have_none(tmp_path):
    np.save(tmp_path / "a.npy", FEATURES)
    np.save(tmp_path / "b.npy", GREY)
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_bytes(b"\xff\xfe\n" * 7)
    with refused("a.txt", "UTF-8"):
        read_array(tmp_path / "a.npy")
    assert read_array(tmp_path / "b.npy").names == ()


@pytest.mark.parametrize(
    "values",
    [
        np.zeros((3, 4), np.uint8),
        np.zeros((3, 4), np.complex64),
        np.zeros((3, 4), np.longdouble),
        np.zeros(()),
        np.zeros((3, 4, 5)),
        np.zeros((3, 4, 5, 2), np.uint8),
        np.zeros((3, 4, 5, 3)),
        np.zeros((0, 4)),
        np.zeros((3, 0)),
        np.array(["a", "b"]),
    ],
    ids=lambda values: f"{values.shape}{values.dtype}",
)
def test_another_shape_or_type_is_refused(values, tmp_path):
    with refused("the array", str(values.shape), "expected frames (N,H,W)"):
        ArrayTraverse(values)
    path = tmp_path / "a.npy"
    np.save(path, values)
    with refused(str(path), "expected frames (N,H,W)"):
        read_array(path)


def test_a_file_that_is_no_whole_array_is_refused(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, FEATURES)
    whole = path.read_bytes()
    cut = [whole[:length] for length in range(0, len(whole), 7)]
    for content in (*cut, b"not an array\n" * 9, b"\x80\x04\x95 a pickle"):
        path.write_bytes(content)
        with refused(str(path), "not a complete .npy array", "expected frames (N,H,W)"):
            read_array(path)


def test_pickled_objects_are_refused_and_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    path = tmp_path / "a.npy"
    np.save(path, np.array([Trap()], dtype=object), allow_pickle=True)
    with refused(str(path), "not a complete .npy array"):
        read_array(path)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("bad", [-0.01, 1.01, np.nan, np.inf])
def test_float_frames_of_a_file_lie_from_0_to_1(tmp_path, bad):
    frames = FRAMES.copy()
    frames[5, 0, 1, 1] = bad
    np.save(tmp_path / "a.npy", frames)
    traverse = read_array(tmp_path / "a.npy")
    assert len(next(traverse.batches(5))) == 5
    with refused("a.npy", "frame 5", "expected 0 to 1"):
        all_of(traverse, 3)
