"""What a spectral map takes in memory and in a file, and which sizes it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from test_spectral import levels_of
from torch import Tensor

from dejavu_torch import DejaVu
from dejavu_torch.maps import spectral, spectral_map
from dejavu_torch.maps.codec import encode
from dejavu_torch.maps.spectral import SpectralMapper, code_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap, sparse_products


def coded(levels: Tensor) -> Chunk:
    return Chunk(len(levels), 1.0, encode(levels.int()))


@given(
    rows=st.integers(1, 40),
    width=st.sampled_from([1, 5, 255, 256, 300]),
    largest=st.sampled_from([1, 127, 128, 32767, 32768, 2**24]),
    share=st.floats(0, 1),
    seed=st.integers(0, 99),
)
def test_a_map_holds_the_levels_in_small_types(
    rows: int, width: int, largest: int, share: float, seed: int
) -> None:
    draw = torch.Generator().manual_seed(seed)
    levels = torch.randint(-largest, largest + 1, (rows, width), generator=draw)
    levels *= torch.rand(rows, width, generator=draw) < share
    mean = torch.zeros(1, width, dtype=torch.bfloat16)
    parts = SpectralMap(mean, step=1.0), SpectralMap(mean, step=1.0)
    parts[0].extend([coded(levels)], [levels])
    parts[1].extend(map(coded, levels.split(max(1, rows // 2))))
    loaded = parts[1].of_chunks(parts[1].coded())
    for learned in (*parts, loaded):
        assert torch.equal(levels_of(learned), levels)
        assert (learned.feature.element_size() == 1) == (width <= 256)  # they go to width - 1
        size = 4 if int(levels.abs().max()) >= 2**15 else 2 if int(levels.abs().max()) > 127 else 1
        assert learned.level.element_size() == size
    assert torch.equal(loaded.streams, parts[1].streams)


@pytest.mark.parametrize("csr", [True, False])
def test_sparse_products_are_those_of_the_whole_rows(csr: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spectral_map, "_has_csr", lambda: csr)
    rows = torch.randint(-9, 9, (40, 300)) * (torch.rand(40, 300) < 0.05)
    rows[3] = 0
    counts, feature = (rows != 0).sum(1).to(torch.int16), rows.nonzero()[:, 1].to(torch.int16)
    for queries in (torch.randn(1, 300), torch.randn(70, 300), torch.randn(5, 300).double()):
        found = sparse_products(queries, counts, feature, rows[rows != 0].to(torch.int8))
        assert torch.allclose(found, queries @ rows.T.to(queries), atol=1e-4)


def test_a_long_chunk_is_decoded_by_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    route = SpectralMapper(None, 0.5, 32)(torch.randn(64, 256))
    whole = [route.decode(g) for g in range(2)]
    monkeypatch.setattr(spectral_map, "LONG", 32 * 100)
    assert all(torch.allclose(route.decode(g), whole[g], atol=1e-6) for g in range(2))


def test_more_places_than_the_index_type_holds_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    one = code_chunk(torch.randn(4, 3), torch.zeros(3).bfloat16(), 0.1)
    monkeypatch.setattr(spectral_map, "LARGEST", 11)
    with refused("12 places", "at most 11"):
        SpectralMap(torch.zeros(1, 3).bfloat16()).extend([one] * 3)


@pytest.mark.parametrize("budget", [1.0, 4.0])
def test_a_map_takes_few_bytes_for_each_place(budget: float) -> None:
    walk = torch.randn(4096, 64, generator=torch.Generator().manual_seed(0)).cumsum(0)
    learned = SpectralMapper(budget, chunk=1024)(torch.nn.functional.normalize(walk, dim=1))
    taken = sum(buffer.nbytes for buffer in learned.buffers())
    assert taken / learned.places <= {1.0: 12, 4.0: 36}[budget]  # and 4 of a position


def test_a_map_that_was_loaded_is_saved_without_coding_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    features = torch.randn(300, 5) * torch.tensor([900.0, 1, 1, 1, 1])
    model = DejaVu(mapper=SpectralMapper(None, step=0.5, chunk=90), whitening="none").learn(features)
    model.save(tmp_path / "a.safetensors")
    monkeypatch.delattr(spectral, "encode")
    DejaVu.load(tmp_path / "a.safetensors").save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
