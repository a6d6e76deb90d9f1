"""Batches as one tensor, in memory or in a file."""

from __future__ import annotations

import errno
import os
import tempfile
import weakref
from unittest import mock

import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.memory import concatenate


@given(rows=st.integers(1, 40), batch=st.integers(1, 9), in_memory=st.integers(0, 500), half=st.booleans())
def test_whatever_the_memory_the_rows_are_the_same(rows, batch, in_memory, half):
    features = torch.randn(rows, 3).half().float()
    found = concatenate(features.split(batch), rows, in_memory, half)
    assert torch.equal(found.float(), features)
    assert found.dtype == (torch.float16 if half and features.nbytes > in_memory else torch.float32)
    found[0] = 1.0


def test_memory_holds_no_more_than_its_share(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    made = []

    def batches():
        for i in range(100):
            batch = torch.full((4, 256), float(i))
            made.append(weakref.ref(batch))
            yield batch
            assert sum(ref() is not None for ref in made) <= 2

    spilled = concatenate(batches(), 400, in_memory=2 * 4 * 256 * 4)
    assert list(tmp_path.iterdir()) == []  # the file has no name: nothing is left, whatever happens
    assert torch.equal(spilled[::4, 0], torch.arange(100.0))


def test_no_room_for_the_file_is_told(monkeypatch):
    full = OSError(errno.ENOSPC, "No space left")
    nowhere = FileNotFoundError(errno.ENOENT, "No usable folder")
    for owner, name, error in ((os, "posix_fallocate", full), (tempfile, "TemporaryFile", nowhere)):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, mock.Mock(side_effect=error), raising=False)
            with refused("4 x 4 numbers do not fit into a temporary file", error.strerror, "TMPDIR"):
                concatenate(torch.rand(4, 4).split(1), 4, in_memory=0)


def test_mixed_and_missing_batches_are_refused():
    with refused("features 2.. are 4 of torch.float32", "expected 3 of torch.float32"):
        concatenate([torch.rand(2, 3), torch.rand(2, 4)], 4)
    with refused("features 2.. are 3 of torch.float64", "expected 3 of torch.float32"):
        concatenate([torch.rand(2, 3), torch.rand(2, 3).double()], 4)
    with refused("features are 0", "at least one batch"):
        concatenate([], 0)
    with refused("features are 2", "expected 4"):
        concatenate([torch.rand(2, 3)], 4)
    with refused("5 features", "expected 4"):
        concatenate([torch.rand(2, 3), torch.rand(3, 3)], 4)
    assert concatenate([torch.rand(0, 3)], 0).shape == (0, 3)
