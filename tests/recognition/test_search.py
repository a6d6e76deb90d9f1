"""A search finds what the scores of all places say."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import DejaVu, PlaceFilter, SequenceMatcher, SpectralMapper
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.recognition import scorer
from dejavu_torch.recognition import search as searching
from dejavu_torch.recognition.calibration import Calibration, Platt, confidence_of
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.search import Scan, merge_topk, topk
from dejavu_torch.recognition.select import best_candidates


def walk(places, numbers=6, seed=0, smooth=0.9):
    """Descriptors that change slowly, the more slowly the nearer `smooth` is to 1."""
    draw = torch.randn(places, numbers, generator=torch.Generator().manual_seed(seed))
    rows = [draw[0]]
    for row in draw[1:]:
        rows.append(smooth * rows[-1] + (1 - smooth**2) ** 0.5 * row)
    return torch.stack(rows)


class Scored(PlaceMap):
    """Query i scores row i of a table; blocks of `size` places."""

    kind = "scored"
    settings = summary = lambda self: {}  # type: ignore[assignment]

    def __init__(self, table: Tensor, size: int) -> None:
        super().__init__(table.shape[1], 1)
        self.rows, self.size, self.batches = table, size, list[int]()

    @property
    def block_places(self):
        return self.size

    def scores(self, queries):
        return self.rows[queries[:, 0].long()]

    def score_blocks(self, queries):
        self.batches.append(len(queries))
        scores = self.scores(queries)
        for first in range(0, self.places, self.size):
            yield first, scores[:, first : first + self.size]


def rows_of(route):
    return torch.arange(float(len(route.rows)))[:, None]


def table(rows, places, values, seed):
    """Of few different values, so that there are ties, and some places that nothing covers."""
    draw = torch.Generator().manual_seed(seed)
    scores = torch.randint(values, (rows, places), generator=draw).float()
    scores[torch.rand(rows, places, generator=draw) < 0.2] = math.inf
    return scores


def assert_equal(found, expected):
    assert torch.equal(found[0], expected[0])
    finite = expected[0].isfinite()
    assert torch.equal(found[1][finite], expected[1][finite])


@given(
    rows=st.integers(1, 4),
    places=st.integers(1, 60),
    values=st.integers(1, 9),
    block=st.integers(1, 30),
    n=st.integers(1, 70),
    seed=st.integers(0, 999),
)
def test_the_best_of_blocks_are_those_of_all_scores(rows, places, values, block, n, seed):
    scores, n = table(rows, places, values, seed), min(n, places)
    score, index = scores.sort(dim=1, stable=True)
    expected = score[:, :n], index[:, :n]
    assert_equal(topk(scores, n), expected)
    route = Scored(scores, block)
    assert_equal(Scan(route)(rows_of(route), [(n, 0)]), expected)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    first, second = order[: (n + 1) // 2], order[(n + 1) // 2 :]
    parts = [(expected[0][:, part], expected[1][:, part]) for part in (first, second)]
    found = merge_topk(parts[0], parts[1])
    assert torch.equal(found[0], expected[0][:, : len(first)])


@given(
    places=st.integers(1, 60),
    k=st.integers(1, 6),
    radius=st.integers(0, 9),
    values=st.integers(1, 9),
    seed=st.integers(0, 999),
)
def test_candidates_are_those_of_all_scores(places, k, radius, values, seed):
    scores, k = table(3, places, values, seed), min(k, places)
    route = Scored(scores, 7)
    found = Localizer(
        route, Matching(k=k, radius=radius), lambda queries, wanted: Scan(route)(queries, [(places, 0)])
    )
    match, expected = found(rows_of(route)), best_candidates(scores, k, radius)
    assert all(map(torch.equal, match, expected))


@pytest.mark.parametrize("settings", [{"chunk": 50}, {"chunk": 50, "metric": "l2"}], ids=str)
def test_a_calibrated_map_finds_the_same_without_all_scores(settings, monkeypatch):
    monkeypatch.setattr(scorer, "SHORT", 0)
    route = walk(600)
    model = DejaVu(whitening="none", mapper=SpectralMapper(6.0, **settings)).learn(route)
    platt = Platt(4.0, 1.0)
    model.calibration = Calibration(platt, None)
    queries = route[::7] + 0.2 * torch.randn(86, 6)
    scores = model.map.scores(queries)
    match = model.localize(queries, search="scan")
    expected = platt.probability(confidence_of(scores))
    assert match.probability is not None
    torch.testing.assert_close(match.probability, expected, rtol=1e-5, atol=1e-5)
    assert (match.index == scores.argmin(1)).float().mean() > 0.98
    several = model.candidates(queries, 4, apart=6, search="scan")
    torch.testing.assert_close(several.score, best_candidates(scores, 4, 6).score, rtol=1e-5, atol=1e-5)


def test_many_of_the_best_are_taken_from_all_scores(monkeypatch):
    """Few of them block by block on longer maps, for as many queries at a time as memory allows."""
    route = Scored(torch.rand(21, 2000), 1000)
    assert torch.equal(Localizer(route)(rows_of(route)).index, route.rows.argmin(1))
    assert route.batches == []
    monkeypatch.setattr(scorer, "SHORT", 1999)
    for k, radius, batches in ((3, 5, [21]), (6, 100, [])):
        found = Localizer(route, Matching(k=k, radius=radius))(rows_of(route))
        assert torch.equal(found.index, best_candidates(route.rows, k, radius).index)
        assert route.batches == batches
        route.batches.clear()
    monkeypatch.setattr(scorer.Scorer, "at_once", 8 * scorer.PER_BEST * (2 * (2 * 5 + 1) + 1))
    assert Localizer(route, Matching(k=3, radius=5))(rows_of(route)).index.shape == (21, 3)
    assert route.batches == [8, 8, 5]
    monkeypatch.setattr(searching, "SCORES_AT_ONCE", 4 * 1000)
    Scan(route)(rows_of(route), [(2, 0)])
    assert route.batches[3:] == [4, 4, 4, 4, 4, 1]


@pytest.mark.parametrize("metric", ["cosine", "l2"])
def test_convention_10_scores_are_float32_whatever_the_autocast(metric):
    route = SpectralMapper(None, 0.5, 32, metric=metric)(walk(300))
    for queries in (walk(300)[:1], walk(300)[::5]):
        with torch.autocast("cpu", torch.bfloat16):
            found = Scan(route)(queries, [(3, 0)])
        assert_equal(found, Scan(route)(queries, [(3, 0)]))


def test_what_cannot_be_searched_so_is_refused():
    wave = walk(128)
    model = DejaVu(whitening="none").learn(wave)
    with refused("search 'all'", "expected auto, coarse, exact or scan"):
        model.localize(wave, search="all")  # type: ignore[arg-type]
    for method, sequence in (("bound", None), ("ivf", SequenceMatcher(3)), ("ivf", PlaceFilter())):
        with refused(f"search '{method}'", "expected auto, coarse, exact or scan"):
            model.localize(wave, sequence=sequence, search=method)  # type: ignore[arg-type]
