"""The coefficients of a spectral map: what they are of, what they take, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import DejaVu
from dejavu_torch.maps import spectral
from dejavu_torch.maps.codec import to_int8
from dejavu_torch.maps.coefficients import (
    Coefficients,
    check_sizes,
    coded_levels,
    coefficients_of,
    disagreement,
    joined,
    levels_of,
)
from dejavu_torch.maps.spectral import CodedChunk, SpectralMap, SpectralMapper, code_chunk
from dejavu_torch.types import InputError


@given(
    rows=st.integers(1, 40),
    width=st.sampled_from([1, 5, 255, 256, 300]),
    largest=st.sampled_from([1, 127, 128, 32767, 32768, 2**24]),
    share=st.floats(0, 1),
    seed=st.integers(0, 99),
)
def test_they_are_the_levels(rows: int, width: int, largest: int, share: float, seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    levels = torch.randint(-largest, largest + 1, (rows, width), generator=draw)
    levels *= torch.rand(rows, width, generator=draw) < share
    small, escapes = to_int8(levels)
    found = coefficients_of(small, escapes)
    assert torch.equal(levels_of(found, width).long(), levels)
    assert all(map(torch.equal, coded_levels(found, width), (small, escapes)))
    assert (found.feature.element_size() == 1) == (width <= 256)  # they go to width - 1
    assert disagreement(found, width) == ""
    size = 1 if not len(escapes) else 2 if int(levels.abs().max()) < 2**15 else 4
    assert found.level.element_size() == size
    half = rows // 2
    if half:
        parts = levels[:half], levels[half:]
        again = joined([coefficients_of(*to_int8(part)) for part in parts])
        assert torch.equal(levels_of(again, width).long(), levels)


def test_a_byte_for_each_of_256_numbers_also_of_a_long_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    route = SpectralMapper(None, 0.5, 32)(torch.randn(64, 256))
    whole = [route.rebuilt(g) for g in range(2)]
    monkeypatch.setattr(spectral, "LONG", 32 * 100)
    assert all(torch.equal(route.rebuilt(g), whole[g]) for g in range(2))


def test_escapes_that_there_is_no_room_for_are_refused() -> None:
    small = torch.tensor([[1, -128, 0]], dtype=torch.int8)
    with refused("0 escapes", "expected 1"):
        coefficients_of(small, torch.zeros(0, dtype=torch.int32))
    with refused("1 escapes", "a byte does not hold"):
        coefficients_of(small, torch.tensor([5], dtype=torch.int32))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"counts": torch.tensor([1, 3], dtype=torch.uint8)}, "expected 4"),
        ({"counts": torch.tensor([-1, 4], dtype=torch.int16)}, "as the lines count"),
        ({"feature": torch.tensor([0, 2, 1], dtype=torch.uint8)}, "ascending"),
        ({"feature": torch.tensor([0, 1, 7], dtype=torch.uint8)}, "from 0 to 2"),
        ({"level": torch.ones(2, dtype=torch.int8)}, "2 levels"),
        ({"level": torch.ones(3)}, "float32"),
    ],
)
def test_coefficients_that_do_not_fit_are_refused(change: dict[str, Tensor], words: str) -> None:
    fitting = Coefficients(
        torch.tensor([1, 2], dtype=torch.uint8),
        torch.tensor([0, 1, 2], dtype=torch.uint8),
        torch.ones(3, dtype=torch.int8),
    )
    assert disagreement(fitting, 3) == ""
    assert words in disagreement(fitting._replace(**change), 3)
    with refused(words):
        SpectralMap(fitting._replace(**change), torch.tensor([2]), torch.ones(1), torch.zeros(3).bfloat16())


def test_more_places_than_the_index_type_holds_are_refused() -> None:
    check_sizes(2**31 - 1, 2**31 - 1)
    for sizes in ((2**31, 0), (5, 2**31)):
        with refused(str(2**31), str(2**31 - 1)):
            check_sizes(*sizes)
    one = code_chunk(torch.randn(4, 3), torch.zeros(3).bfloat16(), 0.1)
    many: list[CodedChunk] = [one._replace(places=2**30)] * 3
    with refused(str(3 * 2**30), str(2**31 - 1)):
        SpectralMap.of_chunks(many, torch.zeros(3).bfloat16(), chunk=2**30)


@pytest.mark.parametrize("budget", [1.0, 4.0])
def test_a_map_takes_few_bytes_for_each_place(budget: float) -> None:
    walk = torch.randn(4096, 64, generator=torch.Generator().manual_seed(0)).cumsum(0)
    learned = SpectralMapper(budget, chunk=1024)(torch.nn.functional.normalize(walk, dim=1))
    taken = sum(buffer.nbytes for buffer in learned.buffers())
    taken += sum(part.stream.bytes.nbytes for part in learned.coded())
    assert taken / learned.places <= {1.0: 12, 4.0: 36}[budget]  # and 4 of a position


def test_a_map_that_was_loaded_is_saved_without_coding_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    features = torch.randn(300, 5, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [900.0, 1, 1, 1, 1]
    )
    model = DejaVu(mapper=SpectralMapper(None, step=0.5, chunk=90), whitening="none").learn(features)
    model.save(tmp_path / "a.safetensors")

    def coded(levels: Tensor) -> Any:
        raise InputError("coded")

    with monkeypatch.context() as patch:
        patch.setattr(spectral, "encode", coded)
        again = DejaVu.load(tmp_path / "a.safetensors")
        again.save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    assert isinstance(again.map, SpectralMap)
    again.map.extend(features[:50])  # only these are coded
    assert [part.places for part in again.map.coded()] == [90, 90, 90, 30, 50]
