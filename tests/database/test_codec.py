"""Levels as a stream, and a stream that was damaged."""

from __future__ import annotations

import lzma
import math
import zlib

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.database import codec
from dejavu_torch.database.codec import Stream, decode, encode, entropy_bytes, from_int8, to_int8


def levels(rows: int = 200, columns: int = 7, spread: float = 3.0) -> Tensor:
    random = torch.randn(rows, columns, generator=torch.Generator().manual_seed(0))
    return (random * spread * torch.linspace(2, 0.1, rows)[:, None]).round()


@given(st.integers(1, 40), st.integers(1, 20), st.floats(0.1, 500))
def test_a_stream_gives_the_levels_back(rows: int, columns: int, spread: float) -> None:
    own = levels(rows, columns, spread)
    small, escapes = to_int8(own)
    assert len(escapes) == int((own.abs() > 127).sum())
    again = from_int8(decode(encode(small), rows, columns), escapes)
    assert torch.equal(again, own.to(torch.int32))


@pytest.mark.parametrize("value", [0, 1, -1, 127, -128])
def test_levels_that_are_all_alike(value: int) -> None:
    own = torch.full((30, 11), value, dtype=torch.int8)
    assert torch.equal(decode(encode(own), 30, 11), own)


def test_what_lies_further_apart_than_lzma_looks_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """The packed bytes name no more than the window with which they are unpacked."""
    own, _ = to_int8(levels(1000, 16))
    own = torch.cat([own, torch.ones(5000, 16, dtype=torch.int8), own])
    monkeypatch.setattr(codec, "WINDOW", 4096)
    monkeypatch.setattr(codec, "FILTERS", [{**codec.FILTERS[0], "dict_size": 4096}])
    assert torch.equal(decode(encode(own), 7000, 16), own)


def test_what_is_mostly_zero_takes_little_more_than_its_entropy() -> None:
    own = levels(4000, 32, 1.0)
    size = len(encode(to_int8(own)[0]).bytes)
    assert entropy_bytes(own) * 0.8 < size < entropy_bytes(own) * 1.2 < own.numel() / 3


def test_entropy_of_known_counts() -> None:
    assert entropy_bytes(torch.zeros(50, 3)) == 0
    four = torch.arange(4.0).repeat(4).view(16, 1)
    assert entropy_bytes(four) == 16 * 2 / 8
    quiet = torch.cat([four, torch.zeros(16, 1), four])  # octaves [0, 16), [16, 32), [32, 64)
    assert entropy_bytes(quiet) == 2 * 16 * 2 / 8


def test_damage_is_told() -> None:
    own, _ = to_int8(levels())
    stream = encode(own)
    altered = stream.bytes.clone()
    altered[len(altered) // 2] ^= 8
    damaged = (
        Stream(stream.bytes[:-5], stream.checksum),
        Stream(altered, stream.checksum),
        Stream(stream.bytes, stream.checksum + 1),
        Stream(torch.zeros(0, dtype=torch.uint8), stream.checksum),
    )
    for one in damaged:
        with refused("truncated or altered", "1400"):
            decode(one, 200, 7)
    for rows in (199, 201):
        with refused("truncated or altered", str(rows * 7)):
            decode(stream, rows, 7)


@pytest.mark.parametrize("plain", [b"", b"\0" * 199, b"\0" * 200, b"\0" * 401, b"\xff" * 400])
def test_a_stream_of_too_many_or_too_few_bytes_is_told(plain: bytes) -> None:
    """A whole stream by LZMA, and a checksum that fits no levels of its shape."""
    packed = lzma.compress(plain, format=lzma.FORMAT_RAW, filters=codec.FILTERS)
    stream = Stream(torch.frombuffer(bytearray(packed), dtype=torch.uint8), zlib.crc32(bytes(200 * 9)))
    with refused("truncated or altered", "1800 levels"):
        decode(stream, 200, 9)


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (5, 0), (-1, 5)])
def test_a_claim_of_nothing_is_refused(rows: int, columns: int) -> None:
    with refused(f"claims {rows} x {columns}", "at least one"):
        decode(encode(to_int8(levels())[0]), rows, columns)


def test_a_claim_beyond_the_memory_is_refused_before_anything_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stream = encode(to_int8(levels())[0])
    with refused("claims 10000000000 x 10000", "memory"):
        decode(stream, 10**10, 10**4)
    monkeypatch.setattr(codec, "memory", lambda: math.inf)
    assert decode(stream, 200, 7).shape == (200, 7)
