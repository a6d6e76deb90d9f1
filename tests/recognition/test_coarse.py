"""A coarse search finds nearly always what a scan finds, an exact one always."""

from __future__ import annotations

import copy
import math
from functools import cache
from typing import Any

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from test_search import walk

from dejavu_torch import DejaVu, SpectralMapper
from dejavu_torch.growth import append
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.recognition import coarse
from dejavu_torch.recognition.calibration import Calibration, Platt
from dejavu_torch.recognition.coarse import CoarseSearch, Plan, coarse_search, plan
from dejavu_torch.recognition.search import Wanted
from dejavu_torch.recognition.select import best_candidates

EXACT = Plan(1, 1, 4, 1.0, 0)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps of a few hundred places are searched as long ones are."""
    monkeypatch.setattr(coarse, "MIN_PLACES", 500)


def smooth_model(places: int = 3000, seed: int = 0, **settings: Any) -> DejaVu:
    return copy.deepcopy(_learned(places, seed, **settings))


@cache
def _learned(places: int, seed: int, **settings: Any) -> DejaVu:
    mapper = SpectralMapper(None, 0.1, 256, **settings)
    return DejaVu(whitening="none", mapper=mapper).learn(walk(places, 24, seed, 0.99))


def queries_of(places: int = 3000, noise: float = 0.3) -> torch.Tensor:
    route = walk(places, 24, 0, 0.99)[::13]
    return route + noise * torch.randn(route.shape, generator=torch.Generator().manual_seed(9))


@given(
    places=st.integers(3, 150),
    chunk=st.integers(2, 60),
    transform=st.sampled_from(["dft", "dct"]),
    smooth=st.sampled_from([0.0, 0.9, 0.99]),
    k=st.integers(1, 4),
    radius=st.integers(0, 6),
    step=st.sampled_from([0.2, 3.0]),
    seed=st.integers(0, 99),
)
def test_exact_finds_what_a_scan_finds(
    places: int, chunk: int, transform: Transform, smooth: float, k: int, radius: int, step: float, seed: int
) -> None:
    """Of any map: with places without length, with chunks that are alike, of rough descriptors."""
    route = walk(places, 8, seed, smooth)
    route[places // 2 : places // 2 + chunk] = 0
    route[-(places // 3) :] = route[: places // 3]
    learned = SpectralMapper(None, step, chunk, transform=transform)(route)
    queries = torch.cat([route[::5] + 0.2 * walk(len(route[::5]), 8, seed + 1), torch.zeros(1, 8)])
    scores = learned.scores(queries)
    wanted: Wanted = [(min(k, places), radius), (min(2, places), 5)]
    search = CoarseSearch(learned, EXACT)
    if seed % 2:  # whatever was found first
        some = torch.rand(len(queries), places, generator=torch.Generator().manual_seed(seed)) < 0.3
        anywhere = torch.where(some, torch.arange(places), -1)
        search._windows = lambda *_: anywhere  # type: ignore[method-assign]
    found = search(queries, wanted)
    for one in wanted:
        match, expected = best_candidates(found[0], *one, found[1]), best_candidates(scores, *one)
        torch.testing.assert_close(match.score, expected.score, rtol=0, atol=1e-5)
        there = match.index >= 0
        assert torch.equal(there, expected.index >= 0)
        row = torch.arange(len(queries))[:, None].expand(match.index.shape)[there]
        torch.testing.assert_close(scores[row, match.index[there]], match.score[there], rtol=0, atol=1e-5)


def test_of_identical_chunks_exact_finds_the_first() -> None:
    period = walk(64, 8, 0, 0.9)
    learned = SpectralMapper(None, 0.2, 64)(period.repeat(5, 1))
    score, place = CoarseSearch(learned, EXACT)(period, [(1, 0)])
    assert (best_candidates(score, 1, 0, place).index[:, 0] < 64).all()


@pytest.mark.usefixtures("searched")
@pytest.mark.parametrize("settings", [{}, {"transform": "dct"}], ids=str)
def test_coarse_finds_nearly_what_a_scan_finds(settings: dict[str, Any]) -> None:
    model, queries = smooth_model(**settings), queries_of()
    chosen = plan(model.map)
    assert chosen is not None
    assert 1 < chosen.fine < chosen.coarse
    scan, found = model.localize(queries, search="scan"), model.localize(queries)
    assert (found.index == scan.index).float().mean() >= 0.99
    same = found.index == scan.index
    torch.testing.assert_close(found.score[same], scan.score[same], rtol=0, atol=1e-5)
    several = model.candidates(queries, 4, apart=5)
    assert (several.index == model.candidates(queries, 4, apart=5, search="scan").index).float().mean() > 0.97


@pytest.mark.usefixtures("searched")
def test_coarse_probabilities_are_those_of_a_scan() -> None:
    model, queries = smooth_model(), queries_of()
    model.calibration = Calibration(Platt(4.0, 1.0), None)
    expected = model.localize(queries, search="scan").probability
    for search in ("coarse", "exact"):
        found = model.localize(queries, search=search).probability  # type: ignore[arg-type]
        assert found is not None
        assert expected is not None
        assert float((found - expected).abs().quantile(0.99)) < 0.01


@pytest.mark.usefixtures("searched")
def test_a_query_that_is_like_no_place_is_scanned() -> None:
    learned = SpectralMapper(None, 0.1, 256)(walk(1000, 24, 0, 0.99).abs() + 1)
    search = coarse_search(learned)
    assert search is not None
    queries = torch.stack([torch.zeros(24), -torch.ones(24)])
    score, place = search(queries, [(1, 0)])
    expected = best_candidates(learned.scores(queries), 1, 0)
    assert torch.equal(best_candidates(score, 1, 0, place).index, expected.index)


def test_products_are_the_same_without_those_of_integers(monkeypatch: pytest.MonkeyPatch) -> None:
    learned, queries = smooth_model(700).map, queries_of(700)
    assert isinstance(learned, SpectralMap)
    found = []
    for there in (True, False):
        if not (there and coarse.has_int8_products()):
            monkeypatch.setattr(coarse, "has_int8_products", lambda: False)
        found.append(CoarseSearch(learned, Plan(8, 4, 8, 1.0, 0))(queries, [(1, 0)]))
    assert all(map(torch.equal, *found))


@pytest.mark.usefixtures("searched")
@pytest.mark.parametrize(("least", "a_place", "chosen"), [(10**8, 0, True), (1, 100, True), (1, 1, False)])
def test_the_memory_by_default_grows_with_the_places(
    least: int, a_place: int, chosen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned = smooth_model().map
    expected = plan(learned, 10**9)
    monkeypatch.setattr(coarse, "MEMORY", least)
    monkeypatch.setattr(coarse, "MEMORY_PER_PLACE", a_place)
    if chosen:
        assert plan(learned) == expected
    else:
        assert plan(learned) != expected  # further apart, or none


@pytest.mark.usefixtures("searched")
def test_samples_follow_from_the_energy_of_the_lines_and_the_memory() -> None:
    learned = smooth_model().map
    chosen = plan(learned)
    assert chosen is not None
    assert chosen.held >= coarse.COARSE
    less = plan(learned, chosen.bytes - 1)
    assert less is not None
    assert less.bytes < chosen.bytes
    assert (less.coarse, less.fine) > (chosen.coarse, chosen.fine)
    assert less.refined >= chosen.refined
    search = CoarseSearch(learned, chosen)  # type: ignore[arg-type]
    kept = [one for part in (search.coarse, search.fine) for one in (part.rows, part.norm, part.place)]
    padding = 2 * coarse.GROUP * coarse.GROUPS_PER_BLOCK * (24 + coarse.OVERHEAD)
    assert sum(one.nbytes for one in kept) <= 1.1 * chosen.bytes + padding
    with refused("memory is 100 bytes", "for a chunk"):
        plan(learned, 100)


@pytest.mark.usefixtures("searched")
def test_what_is_scanned() -> None:
    rough = SpectralMapper(None, 0.1, 256)(walk(1000, 24, 0, 0.0))
    one_chunk = SpectralMapper(None, 0.1, 1000)(walk(1000, 24, 0, 0.99))
    distances = SpectralMapper(None, 0.1, 256, metric="l2")(walk(1000, 24, 0, 0.99))
    assert [plan(route) for route in (rough, one_chunk, distances, SpectralMap())] == [None] * 4
    assert plan(rough, exact=True) is not None


@pytest.mark.usefixtures("searched")
def test_a_map_that_grew_is_sampled_anew() -> None:
    model = smooth_model(1000)
    more = walk(1000, 24, 5, 0.99)
    model.localize(more[:3])
    append(model, more)
    assert model.localize(more[500:501]).index.tolist() == [1500]


def test_the_cosine_of_samples_is_near_that_of_places() -> None:
    """Samples are descriptors of their places, low-passed."""
    for transform in ("dft", "dct"):
        learned = smooth_model(700, transform=transform).map
        assert isinstance(learned, SpectralMap)
        for chunk, (start, _) in enumerate(learned.chunks):
            rows, at = learned.samples(chunk, 60), learned.sampled(chunk, 60)
            own = learned.decode(chunk)[at]
            assert float(torch.cosine_similarity(rows, own).quantile(0.1)) > 0.97, (transform, start)
            own = learned.decode(chunk)
            same, at = learned.samples(chunk, len(own)), learned.sampled(chunk, len(own))
            torch.testing.assert_close(same, own[at], rtol=0, atol=1e-4)


def test_angles_are_not_understated() -> None:
    assert math.isclose(float(coarse.angle(torch.tensor(1.0))), math.acos(1 - coarse.ROUNDING), rel_tol=0.1)


@pytest.mark.usefixtures("searched")
def test_many_candidates_are_those_of_a_scan_and_no_query_has_none() -> None:
    learned, queries = smooth_model().map, queries_of()[:5]
    search, wanted = coarse_search(learned), [(40, 5)]
    assert search is not None
    score, place = search(queries, wanted)
    assert score.shape[1] <= learned.places
    found = best_candidates(score, *wanted[0], place)
    assert (found.index == best_candidates(learned.scores(queries), *wanted[0]).index).float().mean() > 0.9
    assert [tuple(one.shape) for one in search(queries[:0], wanted)] == [(0, 40)] * 2
