"""What a spectral map takes in memory and in a file, which sizes it refuses, and routes that are long."""

from __future__ import annotations

import errno
import os
import tempfile

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from test_spectral import held, levels_of, route

from dejavu_torch import DejaVu, memory
from dejavu_torch.maps import quantisation, spectral, spectral_map
from dejavu_torch.maps.codec import encode
from dejavu_torch.maps.spectral import SpectralMapper, encode_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap, sparse_products


def coded(levels):
    return Chunk(len(levels), 1.0, encode(levels.int()))


@given(
    rows=st.integers(1, 40),
    width=st.sampled_from([1, 5, 255, 256, 300]),
    largest=st.sampled_from([1, 127, 128, 32767, 32768, 2**24]),
    share=st.floats(0, 1),
    seed=st.integers(0, 99),
)
def test_a_map_holds_the_levels_in_small_types(rows, width, largest, share, seed):
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
        largest = int(levels.abs().max())  # int8 holds -128 too, which either way is right
        size = 4 if largest >= 2**15 else 2 if largest > 127 else 1
        assert learned.level.element_size() == size or largest in (2**7, 2**15)
    assert torch.equal(loaded.streams, parts[1].streams)


@pytest.mark.parametrize("csr", [True, False])
def test_sparse_products_are_those_of_the_whole_rows(csr, monkeypatch):
    monkeypatch.setattr(spectral_map, "_has_csr", lambda: csr)
    rows = torch.randint(-9, 9, (40, 300)) * (torch.rand(40, 300) < 0.05)
    rows[3] = 0
    counts, feature = (rows != 0).sum(1).to(torch.int16), rows.nonzero()[:, 1].to(torch.int16)
    for queries in (torch.randn(1, 300), torch.randn(70, 300), torch.randn(5, 300).double()):
        found = sparse_products(queries, counts, feature, rows[rows != 0].to(torch.int8))
        assert torch.allclose(found, queries @ rows.T.to(queries), atol=1e-4)
        alone = [
            sparse_products(one, counts, feature, rows[rows != 0].to(torch.int8)) for one in queries.split(1)
        ]
        torch.testing.assert_close(torch.cat(alone), found, rtol=1e-5, atol=1e-4)


def test_a_long_chunk_is_decoded_by_parts(monkeypatch):
    learned = SpectralMapper(None, 0.5, 32)(torch.randn(64, 256))
    whole = held(learned)
    monkeypatch.setattr(spectral_map, "LONG", 32 * 100)
    assert torch.allclose(held(learned), whole, atol=1e-6)


def test_more_places_than_the_index_type_holds_are_refused(monkeypatch):
    one = encode_chunk(torch.randn(4, 3), torch.zeros(3).bfloat16(), 0.1)
    monkeypatch.setattr(spectral_map, "LARGEST", 11)
    with refused("12 places", "at most 11"):
        SpectralMap(torch.zeros(1, 3).bfloat16()).extend([one] * 3)


@pytest.mark.parametrize("budget", [1.0, 4.0])
def test_a_map_takes_few_bytes_for_each_place(budget):
    walk = torch.randn(4096, 64, generator=torch.Generator().manual_seed(0)).cumsum(0)
    learned = SpectralMapper(budget, chunk=1024)(torch.nn.functional.normalize(walk, dim=1))
    taken = sum(buffer.nbytes for buffer in learned.buffers())
    assert taken / learned.places <= {1.0: 12, 4.0: 36}[budget]  # and 4 of a position


def test_a_mean_that_is_next_to_nothing_takes_no_bytes():
    centred = route(200, 12)
    centred = centred - centred.mean(0)
    size = float(centred.square().mean().sqrt())
    maps = [SpectralMapper(step=0.1 * size)(centred + shift * size) for shift in (0, 0.1, 0.4)]
    shapes = [tuple(one.packed()["means"].shape) for one in maps]
    assert shapes == [(0, 12), (0, 12), (1, 12)]
    for one, shift in zip(maps, (0, 0.1, 0.4), strict=True):
        missed = (centred + shift * size - held(one)).square().mean().sqrt()
        assert missed < 0.06 * size  # a mean that is left out is a line
        again = SpectralMap()
        again.load_packed(one.packed(), one.get_extra_state())
        assert torch.equal(again.scores(centred[:9]), one.scores(centred[:9]))
    wide = [SpectralMapper(hold=0.85)(centred + shift * size) for shift in (0, 0.2)]
    missed = [
        (centred + shift * size - held(one)).square().sum() for one, shift in zip(wide, (0, 0.2), strict=True)
    ]
    shares = [1 - float(error / centred.square().sum()) for error in missed]
    assert shares == pytest.approx([0.85, 0.85], abs=0.003)  # of the variance, which has no mean
    both = [SpectralMap.merged(pair, ("a", "b")) for pair in (maps[:2], maps[1:])]
    assert [len(one.packed()["means"]) for one in both] == [0, 2]
    again = SpectralMap()
    again.load_packed(both[0].packed(), both[0].get_extra_state())
    assert torch.equal(again.part("b").decode(0), maps[1].decode(0))


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_a_sample_pays_its_share_of_a_mean(shift):
    features = route(400, 12) - route(400, 12).mean(0) + shift
    mapper = SpectralMapper(6.0)
    whole, part = (mapper.fit(features, [(400, 1)], share).step for share in (1.0, 0.1))
    assert (part < whole) == bool(shift)
    assert part == whole or shift


def test_a_map_that_was_loaded_is_saved_without_coding_anew(tmp_path, monkeypatch):
    features = torch.randn(300, 5) * torch.tensor([900.0, 1, 1, 1, 1])
    model = DejaVu(mapper=SpectralMapper(None, step=0.5, chunk=90), whitening="none").learn(features)
    model.save(tmp_path / "a.safetensors")
    monkeypatch.delattr(spectral, "encode")
    DejaVu.load(tmp_path / "a.safetensors").save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


# routes so long that their lines are made and gone through in blocks

IN_BLOCKS = [
    {},
    {"chunk": 700, "resolution": 4.0},
    {"transform": "dct", "resolution": 4.0},
]


@pytest.fixture
def in_blocks(monkeypatch):
    """Every route is a long one; its lines are in a file."""
    monkeypatch.setattr(quantisation, "NUMBERS_AT_ONCE", 1000)
    monkeypatch.setattr(quantisation, "empty", lambda *size: memory.empty(*size, in_memory=0))


@pytest.mark.parametrize("settings", IN_BLOCKS)
def test_in_blocks_a_map_of_a_step_holds_the_same(settings, request):
    descriptors = route(2000, 24)
    whole = SpectralMapper(None, step=0.1, **settings)(descriptors)
    request.getfixturevalue("in_blocks")
    parts = SpectralMapper(None, step=0.1, **settings)(descriptors)
    assert torch.equal(parts.means, whole.means)
    differ = (levels_of(parts) != levels_of(whole)).sum()  # sums of floats in another order
    assert differ <= 1e-3 * (levels_of(whole) != 0).sum()
    assert torch.allclose(held(parts), held(whole), atol=0.02)


@pytest.mark.usefixtures("in_blocks")
@pytest.mark.parametrize(("budget", "settings"), [*zip((0.7, 4.0, 4.0), IN_BLOCKS, strict=True)])
def test_in_blocks_the_route_is_within_the_budget(settings, budget):
    descriptors = route(2000, 24)
    learned = SpectralMapper(budget, **settings)(descriptors)
    assert 0.98 * budget <= learned.summary().route_bytes / 2000 <= budget
    error = (held(learned) - descriptors).square().mean()
    assert error < (0.7 if budget < 1 else 0.1) * descriptors.var()


@pytest.mark.usefixtures("in_blocks")
def test_descriptors_may_be_halves_in_a_file(tmp_path):
    descriptors = route(900, 24).half()
    descriptors.numpy().tofile(tmp_path / "d")
    mapped = torch.from_numpy(np.memmap(tmp_path / "d", np.float16, "c", shape=(900, 24)))
    learned, own = SpectralMapper(3.0)(mapped), SpectralMapper(3.0)(descriptors.float())
    assert torch.equal(levels_of(learned), levels_of(own))
    assert torch.equal(learned.steps, own.steps)


def test_there_may_be_no_room_for_the_file(monkeypatch, tmp_path):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, refused("1000 x 3", "No space left", "TMPDIR"):
        patch.setattr(os, "posix_fallocate", full)
        memory.empty(1000, 3, torch.device("cpu"), in_memory=0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with refused("temporary file", "TMPDIR"):
        memory.empty(1000, 3, torch.device("cpu"), in_memory=0)
