"""The coder as Python and compiled: one code, and which of them codes."""

from __future__ import annotations

import sys
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.maps import codec
from dejavu_torch.maps.codec import Stream, decode, encode
from dejavu_torch.types import InputError


@given(st.integers(1, 700), st.integers(1, 12), st.integers(0, 400), st.integers(0, 2**32 - 1))
def test_compiled_and_plain_are_one(rows: int, columns: int, spread: int, seed: int) -> None:
    """Streams, and how an altered stream is refused."""
    random = np.random.default_rng(seed)
    own = (random.integers(-spread, spread + 1, (rows, columns)) * random.random((rows, 1)) ** 4).astype(int)
    levels, told = torch.from_numpy(own).int(), []
    for kernel in (codec._code, codec._compiled()):
        with mock.patch.object(codec, "_kernel", return_value=kernel):
            stream = encode(levels)
            altered = stream.bytes.numpy().copy()
            altered[seed // 8 % len(altered)] ^= 1 << seed % 8
            told.append([stream.bytes.tolist(), stream.checksum])
            for packed in (altered, altered[: len(altered) // 2]):
                try:
                    found = decode(Stream(torch.from_numpy(packed.copy()), stream.checksum), rows, columns)
                    told[-1].append(found.tolist())
                except InputError as error:
                    told[-1].append(str(error))
    assert told[0] == told[1]


def test_it_is_compiled_once_it_pays_if_it_can_be(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(codec, "_coded", 0)
    assert codec._kernel(codec.WORTH_COMPILING - 1) is codec._code
    assert codec._kernel(1) is codec._compiled() is not codec._code
    monkeypatch.setitem(sys.modules, "numba.extending", None)
    codec._compiled.cache_clear()
    with caplog.at_level("INFO", "dejavu_torch"):
        assert codec._kernel(1) is codec._kernel(1) is codec._code
    codec._compiled.cache_clear()
    assert ["not by numba" in line for line in caplog.messages] == [True]
