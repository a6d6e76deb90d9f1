"""Global descriptors as hloc writes them: names, order, numbers, and files that are none."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import all_of, refused

from dejavu_torch.data.h5 import DescriptorFile
from dejavu_torch.data.source import open_source

h5py = pytest.importorskip("h5py")

NAMES = ["db/left/9.jpg", "db/left/10.jpg", "db/left/11.jpg", "query.jpg"]
ROWS = np.random.default_rng(0).normal(size=(4, 6)).astype(np.float16)


def written(path, rows, key="global_descriptor"):
    """As hloc does it: a group for each image, its size beside what was extracted."""
    with h5py.File(path, "w", libver="latest") as file:
        for name, row in rows.items():
            group = file.create_group(name)
            group.create_dataset(key, data=row)
            group.create_dataset("image_size", data=np.array([640, 480]))
    return path


@pytest.mark.parametrize("kind", ["float16", "float32", ">f4"])
@pytest.mark.parametrize("suffix", ["h5", "HDF5"])
def test_rows_are_in_natural_order_with_the_names_of_their_images(tmp_path, kind, suffix):
    shuffled = {NAMES[i]: ROWS[i].astype(kind) for i in (2, 3, 0, 1)}
    source = open_source(f"{written(tmp_path / f'a.{suffix}', shuffled)}?order=natural")
    assert isinstance(source, DescriptorFile)
    assert (len(source), source.frame_shape, source.places, source.ordered) == (4, (6,), None, False)
    assert source.names == NAMES
    assert all_of(source, 3).dtype == torch.float32
    assert torch.equal(all_of(source, 3), torch.from_numpy(ROWS.astype(np.float32)))
    assert torch.equal(source[1::2], torch.from_numpy(ROWS[1::2].astype(np.float32)))
    assert torch.equal(all_of(pickle.loads(pickle.dumps(source))), all_of(source))  # as a cluster sends it


def test_the_lexicographic_order_is_another_traverse(tmp_path):
    path = written(tmp_path / "a.h5", dict(zip(NAMES, ROWS, strict=True)))
    natural, lexicographic = (open_source(f"{path}?order={order}") for order in ("natural", "lexicographic"))
    assert lexicographic.names == sorted(NAMES)
    assert torch.equal(all_of(lexicographic), all_of(natural)[[1, 2, 0, 3]])
    part = open_source(f"{path}?order=lexicographic&start=1&step=2")
    assert part.names == [sorted(NAMES)[1], sorted(NAMES)[3]]
    with refused("a.h5", "order is 'size'", "natural or lexicographic"):
        open_source(f"{path}?order=size")


BAD = ROWS[0].copy()
BAD[2] = np.nan


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ({}, ("contains no global_descriptor", "expected a group for each image")),
        ({"a.jpg": ROWS[0], "b/c.jpg": ROWS[1, :5]}, ("b/c.jpg has 5 dimensions", "expected 6", "a.jpg")),
        ({"a.jpg": ROWS[0], "b.jpg": BAD}, ("global_descriptor of b.jpg", "NaN")),
        ({"a.jpg": np.full(3, np.inf)}, ("global_descriptor of a.jpg", "infinite")),
        ({"a.jpg": ROWS}, ("global_descriptor of a.jpg is (4, 6) float16", "(D,)")),
        ({"a.jpg": 0.5}, ("global_descriptor of a.jpg is () float64",)),
        ({"a.jpg": np.arange(4)}, ("is (4,) int64", "of floats")),
        ({"a.jpg": ROWS[0, :0]}, ("a.jpg has 0 dimensions",)),
        ({"a.jpg": "text"}, ("global_descriptor of a.jpg is ()",)),
    ],
)
def test_other_contents_are_refused(tmp_path, rows, words):
    path = written(tmp_path / "a.h5", rows)
    with refused(str(path), *words):
        all_of(open_source(path))


def in_another_file(group):
    (Path(group.file.filename).parent / "secret").write_bytes(bytes(64))
    external = [("secret", 0, h5py.h5f.UNLIMITED)]
    group.create_dataset("global_descriptor", (8,), np.float32, external=external)


def seen_in_another_file(group):
    layout = h5py.VirtualLayout((8,), np.float32)
    layout[:] = h5py.VirtualSource("other.h5", "x", (8,))
    group.create_virtual_dataset("global_descriptor", layout)


def a_group(group):
    group.create_group("global_descriptor")


def test_one_table_for_all_images_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["global_descriptor"] = ROWS
    with refused("a.h5 has one global_descriptor for all images", "expected a group for each image"):
        open_source(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["a.jpg/global_descriptor"] = ROWS[0]
    assert len(open_source(tmp_path / "a.h5")) == 1  # what else a file has is ignored


@pytest.mark.parametrize("make", [in_another_file, seen_in_another_file, a_group])
def test_numbers_that_the_file_does_not_hold_are_refused(tmp_path, make):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file.create_group("a.jpg"))
    with refused("a.h5", "global_descriptor of a.jpg is", "expected a group for each image"):
        all_of(open_source(tmp_path / "a.h5"))


def test_without_h5py_a_line_says_what_to_install(tmp_path, monkeypatch):
    path = written(tmp_path / "a.h5", {"a.jpg": ROWS[0]})
    monkeypatch.setitem(sys.modules, "h5py", None)
    with refused("a.h5", "h5py", "cannot be imported", "pip install 'dejavu_torch[h5]'"):
        open_source(path)
