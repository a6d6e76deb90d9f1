"""The coder as Python and compiled: one code, and which of them codes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.maps import codec
from dejavu_torch.maps.codec import Stream, coded_bytes, decode, encode
from dejavu_torch.types import InputError


@contextmanager
def coded_by(kernel: Callable[..., int]) -> Iterator[None]:
    with mock.patch.object(codec, "_kernel", return_value=kernel):
        yield


@given(st.integers(1, 700), st.integers(1, 12), st.integers(0, 400), st.integers(0, 2**32 - 1))
def test_compiled_and_plain_are_one(rows: int, columns: int, spread: int, seed: int) -> None:
    """Streams, and how an altered stream is refused."""
    fast = codec._compiled()
    assert fast is not None
    random = np.random.default_rng(seed)
    own = (random.integers(-spread, spread + 1, (rows, columns)) * random.random((rows, 1)) ** 4).astype(int)
    levels, told = torch.from_numpy(own).int(), []
    for kernel in (codec._code, fast):
        with coded_by(kernel):
            stream = encode(levels)
            altered = stream.bytes.numpy().copy()
            altered[seed // 8 % len(altered)] ^= 1 << seed % 8
            told.append([stream.bytes.tolist(), coded_bytes(levels), stream.checksum])
            for packed in (altered, altered[: len(altered) // 2]):
                try:
                    found = decode(Stream(torch.from_numpy(packed.copy()), stream.checksum), rows, columns)
                except InputError as error:
                    told[-1].append(str(error))
                else:
                    told[-1].append(found.tolist())
    assert told[0] == told[1]


def test_it_is_compiled_once_it_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "_coded", 0)
    assert codec._kernel(codec.WORTH_COMPILING - 1) is codec._code
    assert codec._kernel(1) is codec._compiled() is not codec._code


def test_without_numba_it_is_coded_in_python(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "numba.extending", None)
    codec._compiled.cache_clear()
    monkeypatch.setattr(codec, "_coded", codec.WORTH_COMPILING)
    with caplog.at_level("INFO", "dejavu_torch"):
        assert codec._kernel(1) is codec._kernel(1) is codec._code
    codec._compiled.cache_clear()
    assert ["not by numba" in line for line in caplog.messages] == [True]
