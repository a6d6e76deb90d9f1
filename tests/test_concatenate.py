from __future__ import annotations

import errno
import tempfile
import weakref
from pathlib import Path
from unittest import mock

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from processes import python

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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_spilled_rows_keep_their_type_and_can_be_changed_without_harm(dtype):
    features = torch.randn(9, 3, dtype=dtype)
    spilled = concatenate(features.split(2), in_memory=0)
    assert spilled.dtype == dtype
    assert torch.equal(spilled, features)
    spilled[0] = 7
    assert torch.equal(spilled[1:], features[1:])
    assert spilled[0].eq(7).all()


def test_what_fits_is_not_held_twice():
    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc")
    code = (
        "import torch; from benchmarks.measure import peak_memory\n"
        "from dejavu_torch.memory import concatenate\n"
        "print(peak_memory(lambda: concatenate(torch.ones(64, 2048) for _ in range(700))))"
    )
    held = 700 * 64 * 2048 * 4  # 367 MB, over five blocks
    assert held < int(python(code).stdout) < 1.5 * held


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


def test_batches_that_do_not_lie_in_a_row_spill_as_they_read():
    features = torch.randn(5, 12).T
    assert torch.equal(concatenate(features.split(5), in_memory=0), features)


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


def test_what_the_traverse_complains_about_passes():
    def batches():
        yield torch.rand(2, 2)
        raise OSError("the camera is gone")

    with pytest.raises(OSError, match="the camera is gone"):
        concatenate(batches())


def test_mixed_and_missing_batches_are_refused():
    with refused("features 2.. are 4 of torch.float32", "expected 3 of torch.float32"):
        concatenate([torch.rand(2, 3), torch.rand(2, 4)])
    with refused("features 2.. are 3 of torch.float64", "expected 3 of torch.float32"):
        concatenate([torch.rand(2, 3), torch.rand(2, 3).double()])
    with refused("no features"):
        concatenate([])
