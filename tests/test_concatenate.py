from __future__ import annotations

import errno
import tempfile
import weakref
from unittest import mock

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import memory
from dejavu_torch.memory import concatenate


@given(
    rows=st.integers(1, 40), batch=st.integers(1, 9), block=st.integers(0, 300), in_memory=st.integers(0, 500)
)
def test_whatever_the_memory_the_rows_are_the_same(rows, batch, block, in_memory):
    features = torch.randn(rows, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "BLOCK_BYTES", block)
        assert torch.equal(concatenate(features.split(batch)), features)
        assert torch.equal(concatenate(features.split(batch), in_memory), features)


def test_memory_holds_no_more_than_its_share(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    made = []

    def batches():
        for i in range(100):
            batch = torch.full((4, 256), float(i))
            made.append(weakref.ref(batch))
            yield batch
            assert sum(ref() is not None for ref in made) <= 3  # two that fit in memory, and the next

    spilled = concatenate(batches(), in_memory=2 * 4 * 256 * 4)
    assert list(tmp_path.iterdir()) == []  # the file has no name: nothing is left, whatever happens
    assert torch.equal(spilled[::4, 0], torch.arange(100.0))


def test_no_room_for_the_file_is_told(monkeypatch):
    full, nowhere = (
        OSError(errno.ENOSPC, "No space left"),
        FileNotFoundError(errno.ENOENT, "No usable folder"),
    )
    file = mock.Mock()
    file.write.side_effect = full
    for made, error in ((mock.Mock(return_value=file), full), (mock.Mock(side_effect=nowhere), nowhere)):
        monkeypatch.setattr(tempfile, "TemporaryFile", made)
        with refused("do not fit into a temporary file", error.strerror, "TMPDIR"):
            concatenate(torch.rand(4, 4).split(1), in_memory=0)


def test_mixed_and_missing_batches_are_refused():
    with refused("features 2.. are 4 of torch.float32", "expected 3 of torch.float32"):
        concatenate([torch.rand(2, 3), torch.rand(2, 4)])
    with refused("features 2.. are 3 of torch.float64", "expected 3 of torch.float32"):
        concatenate([torch.rand(2, 3), torch.rand(2, 3).double()])
    with refused("no features"):
        concatenate([])
