"""Levels as a stream, by Python and compiled, and a stream that was damaged."""

from __future__ import annotations

import math
import sys
import zlib
from functools import partial
from time import sleep
from unittest import mock

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import example, given
from hypothesis import strategies as st

from dejavu_torch.maps import codec, compiling
from dejavu_torch.maps.codec import Stream, coded_bytes, decode, encode
from dejavu_torch.types import InputError


def levels(rows=200, columns=7, spread=3.0):
    random = torch.randn(rows, columns, generator=torch.Generator().manual_seed(0))
    return (random * spread * torch.linspace(2, 0.1, rows)[:, None]).round().to(torch.int32)


@given(
    st.integers(1, 40), st.integers(1, 20), st.sampled_from([0.1, 3.0, 60.0, 500.0, 2e9]), st.integers(0, 99)
)
@example(1, 1, 500.0, 0)  # 770 alone, with no negative level beside it
@example(1, 1, 500.0, 2)  # 196
def test_a_stream_gives_the_levels_back(rows, columns, spread, seed):
    random = torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    own = (random * spread).round().clamp(1 - 2**31, 2**31 - 1).to(torch.int32)
    stream = encode(own)
    again = decode(stream, rows, columns)
    assert torch.equal(again.int(), own)
    assert again.dtype == (torch.int8 if int(own.max()) < 128 and int(own.min()) >= -128 else torch.int32)
    assert 0 <= coded_bytes(own) - len(stream.bytes) <= 1


def test_how_many_rows_are_coded_at_a_time_changes_nothing(monkeypatch):
    own = levels()
    whole = encode(own), coded_bytes(own)
    for block in (1, 7 * 16, 7 * 200):
        monkeypatch.setattr(codec, "CODED_LEVELS", block)
        assert torch.equal(encode(own).bytes, whole[0].bytes)
        assert coded_bytes(own) == whole[1]
        assert torch.equal(decode(whole[0], 200, 7), own.to(torch.int8))


def test_the_rows_that_are_0_at_the_end_cost_next_to_nothing():
    own = levels(500, 32)
    longer = torch.cat([own, own.new_zeros(100000, 32)])
    stream = encode(longer)
    assert len(stream.bytes) <= len(encode(own).bytes) + 3
    assert torch.equal(decode(stream, len(longer), 32), longer.to(torch.int8))


def test_levels_of_a_known_law_take_little_more_than_their_entropy():
    """Geometric magnitudes that fall along rows and columns, and signs of which nothing is known."""
    random = torch.Generator().manual_seed(0)
    rows, columns = torch.arange(3000)[:, None], torch.arange(64)
    ratio = (3 / (1 + rows / 40) * 0.98**columns / 2).clamp(max=0.9)  # P(m > n | m >= n)
    size = (torch.rand(3000, 64, generator=random).log() / ratio.log()).floor()
    own = (size * torch.randn(3000, 64, generator=random).sign()).to(torch.int8)
    mean = ratio / (1 - ratio)
    bits = -(1 - ratio).log2() - mean * ratio.log2() + ratio  # magnitude, and sign where it is not 0
    ideal = float(bits.sum()) / 8
    assert 0.97 * ideal < len(encode(own).bytes) < 1.05 * ideal


def made(rows, columns, largest):
    """Levels that fall along the rows, by whole numbers alone."""
    count = torch.arange(rows * columns)
    noise = (count * count * 7919 + count * 104729) % 100003 % 1009
    size = noise**4 * largest // 1009**4 // (1 + 8 * (count // columns) // rows)
    return torch.where(noise % 2 > 0, size, -size).clamp(-128, 127).to(torch.int8).view(rows, columns)


# as map files of format 11 hold them: bytes and CRC-32
STREAMS = {
    (1, 1, 3): (1, 2466682349),
    (3, 500, 4): (129, 458651044),
    (40, 1, 30): (14, 840899869),
    (200, 9, 5000): (1281, 1953290175),
    (300, 40, 2): (158, 2340225975),
    (520, 17, 60): (3760, 2942481618),
    (700, 3, 9): (302, 736628344),
}


def test_a_stream_stays_what_it_was():
    for shape in STREAMS:
        stream = encode(made(*shape))
        assert (len(stream.bytes), zlib.crc32(stream.bytes.numpy().tobytes())) == STREAMS[shape]


def test_damage_is_told():
    own = levels()
    stream = encode(own)
    altered = stream.bytes.clone()
    altered[len(altered) // 2] ^= 8
    for packed, checksum in ((altered, stream.checksum), (stream.bytes, stream.checksum + 1)):
        with refused("truncated or altered", "1400"):
            decode(Stream(packed, checksum), 200, 7)
    for rows in (199, 201):
        with refused("truncated or altered", str(rows * 7)):
            decode(stream, rows, 7)
    with refused("altered"):  # after its last bit that counts a stream goes on in zeros
        decode(encode(torch.zeros(10, 4, dtype=torch.int8)), 11, 4)


def test_a_stream_of_too_many_or_too_few_bytes_is_told():
    """Even where the levels are those of the checksum."""
    own = levels()
    stream = encode(own)
    for part in (stream.bytes[:-5], stream.bytes[:-1], torch.cat([stream.bytes, torch.zeros(1).byte()])):
        with refused("truncated or altered", "1400 levels", f"{len(part)} bytes"):
            decode(Stream(part, stream.checksum), 200, 7)


@given(st.binary(max_size=60), st.integers(1, 20), st.integers(1, 9))
def test_a_stream_of_anything_is_refused(packed, rows, columns):
    stream = Stream(torch.tensor(list(packed), dtype=torch.uint8), zlib.crc32(b"other levels"))
    with refused("truncated or altered", f"{rows * columns} levels"):
        decode(stream, rows, columns)


def test_a_claim_of_nothing_or_beyond_the_memory_is_refused(monkeypatch):
    stream = encode(levels())
    for rows, columns in ((0, 5), (5, -1), (10**10, 10**4)):
        with refused(f"claims {rows} x {columns}", "1 or more", "memory"):
            decode(stream, rows, columns)
    monkeypatch.setattr(codec, "free_memory", lambda: math.inf)
    assert decode(stream, 200, 7).shape == (200, 7)


def test_a_claim_of_endless_zeros_is_refused_before_they_are_decoded(monkeypatch):
    monkeypatch.setattr(codec, "LEVELS_AT_LEAST", 2**12)
    zeros = Stream(torch.zeros(3, dtype=torch.uint8), 0)
    with refused("nearly all 0"):
        decode(zeros, 10**5, 128)
    sparse = torch.zeros(10**4, 16, dtype=torch.int8)
    assert torch.equal(decode(encode(sparse), 10**4, 16), sparse)
    sparse[-1, -1] = 1
    with refused("nearly all 0", "more bytes"):  # nothing is written that is not read
        encode(sparse)


@given(st.integers(1, 700), st.integers(1, 12), st.integers(0, 400), st.integers(0, 2**32 - 1))
def test_compiled_and_plain_are_one(rows, columns, spread, seed):
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


def test_it_is_compiled_once_it_pays_if_it_can_be(monkeypatch, caplog):
    monkeypatch.setattr(codec, "_coded", 0)
    assert codec._kernel(codec.WORTH_COMPILING - 1) is codec._code
    assert codec._kernel(1) is codec._compiled() is not codec._code
    monkeypatch.setitem(sys.modules, "numba.extending", None)
    codec._compiled.cache_clear()
    with caplog.at_level("INFO", "dejavu_torch"):
        assert codec._kernel(1) is codec._kernel(1) is codec._code
    codec._compiled.cache_clear()
    assert ["not by numba" in line for line in caplog.messages] == [True]


@pytest.mark.parametrize("seconds", [0.0, 0.2])
def test_a_long_compilation_is_told(monkeypatch, caplog, seconds):
    """A load from the cache is short, and silent."""
    monkeypatch.setattr(compiling, "SILENCE", 0.1)
    monkeypatch.setattr("numba.njit", lambda *_, **__: lambda one: sleep(seconds) or partial(one))
    assert compiling.compiled(lambda: 1, "int64()", "") is not None
    assert ["20 s" in line for line in caplog.messages] == [True] * (seconds > 0)
