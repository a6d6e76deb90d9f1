"""Searches find what the scores of all places say."""

from __future__ import annotations

import builtins
import math
import pickle
import weakref
from typing import Any

import pytest
import torch
from dejavu_torch.maps.coefficients import coefficients_of
from dejavu_torch.maps.merged import MergedMap
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import DejaVu, PlaceFilter, SequenceMatcher
from dejavu_torch.maps import spectral
from dejavu_torch.maps.codec import to_int8
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral import SpectralMap, SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.recognition import matching, search
from dejavu_torch.recognition.calibration import Calibration, Platt, evidence_of
from dejavu_torch.recognition.candidates import best_candidates
from dejavu_torch.recognition.matching import Matching
from dejavu_torch.recognition.search import Best, Bound, Searcher, enough, lowest, merged, scan

METRICS = ("cosine", "l2")


def walk(places: int, numbers: int = 6, seed: int = 0, smooth: float = 0.9) -> Tensor:
    """Descriptors that change slowly, the more slowly the nearer `smooth` is to 1."""
    draw = torch.randn(places, numbers, generator=torch.Generator().manual_seed(seed))
    rows = [draw[0]]
    for row in draw[1:]:
        rows.append(smooth * rows[-1] + (1 - smooth**2) ** 0.5 * row)
    return torch.stack(rows)


def with_silence(metric: str, transform: str) -> SpectralMap:
    """Of mean 0; the chunk [20, 30) holds nothing, [40, 50) next to nothing."""
    draw = torch.Generator().manual_seed(0)
    levels = torch.randint(-3, 4, (60, 3), generator=draw) * (torch.rand(60, 1, generator=draw) < 0.3)
    levels[20:30], levels[40], levels[41:50] = 0, 1, 0
    lengths, steps = torch.full((6,), 10), torch.rand(6, generator=draw) + 0.2
    steps[4] = 1e-7
    own = coefficients_of(*to_int8(levels))
    return SpectralMap(own, lengths, steps, torch.zeros(3).bfloat16(), metric, transform, 10)  # type: ignore[arg-type]


def learned(places: int = 300, chunk: Any = 32, step: float = 0.5, **more: Any) -> SpectralMap:
    metric = more.pop("metric", "cosine")
    transform = more.pop("transform", "dft")
    mapper = SpectralMapper(None, step, chunk, transform, metric)
    return mapper(walk(places, **more))


def by_sorting(scores: Tensor, n: int) -> Best:
    score, index = scores.sort(dim=1, stable=True)
    return Best(score[:, :n], index[:, :n])


def assert_equal(found: Best, expected: Best) -> None:
    assert torch.equal(found.score, expected.score)
    finite = expected.score.isfinite()
    assert torch.equal(found.index[finite], expected.index[finite])


@given(
    rows=st.integers(1, 4),
    places=st.integers(1, 60),
    values=st.integers(1, 9),
    blocks=st.integers(1, 5),
    n=st.integers(1, 70),
    seed=st.integers(0, 999),
)
def test_the_best_of_blocks_are_those_of_all_scores(
    rows: int, places: int, values: int, blocks: int, n: int, seed: int
) -> None:
    """Of few different values, so that there are ties, and some places that nothing covers."""
    draw = torch.Generator().manual_seed(seed)
    scores = torch.randint(values, (rows, places), generator=draw).float()
    scores[torch.rand(rows, places, generator=draw) < 0.2] = math.inf
    expected = by_sorting(scores, min(n, places))
    assert_equal(lowest(scores, min(n, places)), expected)

    class Scored(PlaceMap):
        kind = "scored"
        settings = summary = disagreement = lambda self: {}  # type: ignore[assignment]
        block_places = 7

        def scores(self, queries: Tensor) -> Tensor:
            return scores[queries[:, 0].long()]

        def score_blocks(self, queries: Tensor, start: int = 0, stop: int | None = None) -> Any:
            done = 0
            for part in self.scores(queries).tensor_split(blocks, 1):
                if part.shape[1]:
                    yield done, part
                done += part.shape[1]

    found = scan(Scored(places, 1), torch.arange(rows)[:, None].float(), min(n, places))
    assert_equal(found, expected)
    shuffled = merged(*(Best(part[0], part[1]) for part in halves(expected, draw)))
    assert torch.equal(shuffled.score, expected.score[:, : shuffled.score.shape[1]])


def halves(best: Best, draw: torch.Generator) -> tuple[Best, Best]:
    """A list of the best as two, each in a random order, the first the longer one."""
    order = torch.randperm(best.score.shape[1], generator=draw)
    cut = (len(order) + 1) // 2
    first, second = order[:cut], order[cut:]
    return Best(best.score[:, first], best.index[:, first]), Best(
        best.score[:, second], best.index[:, second]
    )


@given(
    places=st.integers(1, 80),
    k=st.integers(1, 6),
    apart=st.integers(0, 9),
    values=st.integers(2, 30),
    seed=st.integers(0, 999),
)
def test_candidates_are_those_of_all_scores(places: int, k: int, apart: int, values: int, seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    scores = torch.randint(values, (3, places), generator=draw).float()
    scores[torch.rand(3, places, generator=draw) < 0.1] = math.inf
    k = min(k, places)
    found = lowest(scores, min(places, enough(k, apart))).candidates(k, apart)
    expected = best_candidates(scores, k, apart)
    assert torch.equal(found.index, expected.index)
    assert torch.equal(found.score, expected.score)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_no_score_is_below_its_bound(metric: str, transform: str) -> None:
    for seed, (chunk, step) in enumerate([(32, 2.0), (33, 0.7), (2, 0.1), (64, 0.3), (7, 0.5)]):
        route = learned(200, chunk, step, metric=metric, transform=transform, seed=seed)
        queries = torch.cat([walk(200, seed=seed)[::9], torch.randn(20, 6), torch.zeros(1, 6)])
        assert_bounded(route, queries)


def assert_bounded(route: SpectralMap, queries: Tensor) -> None:
    scores, lower = route.scores(queries), Bound(route)(queries)
    assert lower.isfinite().all()
    for g, (start, stop) in enumerate(route.chunks):
        assert (lower[:, g] <= scores[:, start:stop].amin(1) + 1e-6).all()


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_silent_places_are_bounded_and_found(metric: str, transform: str) -> None:
    route = with_silence(metric, transform)
    assert route.silent >= 20
    queries = torch.cat([torch.randn(40, 3), 0.1 * torch.randn(40, 3), torch.zeros(1, 3)])
    assert_bounded(route, queries)
    for n in (1, 25):
        found = Searcher(route, "bound")(queries, n)
        torch.testing.assert_close(found.score, scan(route, queries, n).score, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("metric", METRICS)
def test_bounds_find_what_a_scan_finds_in_ten_thousand_cases(metric: str) -> None:
    """With both metrics: 10 maps each, of smooth routes and of noise, 250 queries, the 1 and 12 best."""
    spared = []
    for seed in range(10):
        smooth = (0.0, 0.9, 0.99, 0.999)[seed % 4]
        chunk, step = (16, 25, 64, 40)[seed // 4 % 4], (2.0, 0.7, 0.3)[seed % 3]
        route = learned(300, chunk, step, metric=metric, seed=seed, smooth=smooth)
        queries = torch.cat([walk(300, seed=seed, smooth=smooth)[::2], torch.randn(100, 6)])
        queries[:150] += 0.1 * torch.randn(150, 6)
        searcher = Searcher(route, "bound")
        for n in (1, 12):
            found, expected = searcher(queries, n), scan(route, queries, n)
            torch.testing.assert_close(found.score, expected.score, rtol=1e-5, atol=1e-5)
            assert torch.equal(found.index, expected.index)
        spared.append(searcher.told.pruned)
        assert searcher.told.queries == 500
    assert max(spared) > 0.3  # type: ignore[type-var,operator]
    assert all(0 <= one < 1 for one in spared)  # type: ignore[operator]


def test_of_equal_places_bounds_find_the_lowest() -> None:
    """Chunks that are all alike."""
    once = walk(32, smooth=0.5)
    route = SpectralMapper(None, step=1e-3, chunk=32)(torch.cat([once] * 8))
    found = Searcher(route, "bound")(once, 3)
    assert torch.equal(found.index, scan(route, once, 3).index)
    assert torch.equal(found.index[:, 0], torch.arange(32))


def test_auto_takes_bounds_where_they_spare_most_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "WORTH_BOUNDS", 1)
    monkeypatch.setattr(search, "SPARED", 0.6)
    slow = walk(3200, smooth=0.9999)
    smooth, noise = (SpectralMapper(None, 0.3, 32)(one) for one in (slow, walk(3200, smooth=0.0)))
    for route, queries, method in ((smooth, slow[::100], "bound"), (noise, torch.randn(40, 6), "scan")):
        searcher = Searcher(route)
        found = searcher(queries, 1)
        assert searcher.told.method == method
        assert f"search: {method}" in str(searcher.told)
        assert torch.allclose(found.score, route.scores(queries).amin(1, keepdim=True), atol=1e-5)
    assert "chunks a query spared" in str(Searcher(smooth, "bound").told._replace(pruned=0.75))
    assert "75%" in str(Searcher(smooth, "bound").told._replace(pruned=0.75))


@pytest.mark.parametrize("metric", METRICS)
def test_lists_score_as_the_map_does(metric: str) -> None:
    pytest.importorskip("faiss")
    route = learned(2000, 100, metric=metric)
    queries = walk(2000)[::40]
    every = Searcher(route, "ivf", lists=20, probes=20)(queries, 7)
    expected = scan(route, queries, 7)
    torch.testing.assert_close(every.score, expected.score, rtol=1e-5, atol=1e-5)
    few = Searcher(route, "ivf", lists=20, probes=2, sample=5)
    found = few(queries, 7)
    assert found.score.shape == (50, 7)
    assert few.told.sampled == 4  # one of 16
    some = torch.arange(4) * 50 // 4
    right = (found.index[some, 0] == expected.index[some, 0]).float().mean()
    assert few.told.recall == pytest.approx(float(right))
    assert f"{few.told.recall:.1%} of 4 queries" in str(few.told)
    few(queries, 1)
    few(queries, 1)
    assert few.told.sampled == 5
    with refused("0 probes"):
        Searcher(route, "ivf", probes=0)(queries, 1)


@pytest.mark.parametrize("settings", [{"chunk": 50}, {}, {"chunk": 50, "metric": "l2"}], ids=str)
@pytest.mark.parametrize("blocks", [False, True])
def test_a_calibrated_map_finds_the_same_without_all_scores(
    settings: dict[str, Any], blocks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if blocks:
        monkeypatch.setattr(spectral, "BLOCK", 400)
    route = walk(600)
    model = DejaVu(whitening="none", mapper=SpectralMapper(6.0, **settings)).learn(route)
    platt = Platt(4.0, 1.0)
    model.calibration = Calibration(platt, None)
    queries = route[::7] + 0.2 * torch.randn(86, 6)
    scores = model.map.scores(queries)
    match = model.localize_descriptors(queries)
    expected = platt.probability(evidence_of(scores))
    assert match.probability is not None
    torch.testing.assert_close(match.probability, expected, rtol=1e-5, atol=1e-5)
    assert (match.index == scores.argmin(1)).float().mean() > 0.98
    several = model.candidates(queries, 4, apart=6)
    torch.testing.assert_close(several.score, best_candidates(scores, 4, 6).score, rtol=1e-5, atol=1e-5)


def test_no_block_of_scores_is_as_long_as_the_route(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spectral, "BLOCK", 2**10)
    route = walk(4000, 4)
    model = DejaVu(whitening="none", mapper=SpectralMapper(None, 0.5, 50)).learn(route)
    seen: list[int] = []
    make = SpectralMap.score_blocks

    def watched(*args: Any) -> Any:
        for start, scores in make(*args):
            seen.append(scores.shape[1])
            yield start, scores

    monkeypatch.setattr(SpectralMap, "score_blocks", watched)
    assert model.localize(route[:300]).index.shape == (300,)
    assert max(seen) <= 300
    assert sum(seen) % 4000 == 0  # for each batch of queries


def test_what_a_long_chunk_holds_beside_its_scores_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    route, make, seen = learned(400, "route"), spectral.from_slots, []
    monkeypatch.setattr(spectral, "BLOCK", 2**10)
    monkeypatch.setattr(search, "SCORES_AT_ONCE", 8 * 400)
    monkeypatch.setattr(spectral, "LONG", 2**11)
    monkeypatch.setattr(spectral, "from_slots", lambda *args: seen.append(args[0].shape) or make(*args))
    queries = walk(400)[::50]
    assert torch.equal(Searcher(route)(queries, 1).index[:, 0], torch.arange(0, 400, 50))
    assert [shape[0] for shape in seen] == [2] * 4


@pytest.mark.parametrize("method", ["auto", "bound"])
def test_many_of_the_best_are_taken_from_all_scores(
    method: search.Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless it is asked for otherwise; few of them for as many queries at a time as memory allows."""
    route, queries = learned(2000, 50), walk(2000)[::99]
    scores, searcher = route.scores(queries), Searcher(route, method)
    batches: list[int] = []
    make = Searcher.__call__
    monkeypatch.setattr(Searcher, "__call__", lambda self, q, n: batches.append(len(q)) or make(self, q, n))
    for ranks, apart in ((3, 5), (6, 100)):
        found = Matching(ranks=ranks, apart=apart).search_for(queries, searcher).candidates
        expected = best_candidates(scores, ranks, apart)
        torch.testing.assert_close(found.score, expected.score, rtol=1e-5, atol=1e-5)
    assert batches == [len(queries)] * (1 if method == "auto" else 2)
    batches.clear()
    monkeypatch.setattr(matching, "SCORES_AT_ONCE", 8 * matching.LISTED * enough(3, 5))
    found = Matching(ranks=3, apart=5).search_for(queries, searcher).candidates
    assert batches == [8, 8, 5]
    assert found.index.shape == (21, 3)


def test_a_merged_map_is_searched_block_by_block() -> None:
    parts = [SpectralMapper(None, 0.5, 50)(walk(places, seed=places)) for places in (200, 130)]
    route, queries = MergedMap(parts, ["out", "back"]), walk(130, seed=130)
    assert_equal(scan(route, queries, 9), by_sorting(route.scores(queries), 9))
    assert [start for start, _ in route.score_blocks(queries, 190, 210)] == [190, 200]
    assert route.block_places == max(part.block_places for part in parts)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_queries_of_half_precision_are_searched_for_as_floats(dtype: torch.dtype) -> None:
    route = learned()
    few, many = walk(300)[:1].to(dtype), walk(300)[::5].to(dtype)  # which are scored in different ways
    assert route.rebuilds(len(many)) > route.rebuilds(len(few))
    for queries in (few, many):
        for method in ("scan", "bound"):
            expected = Searcher(route, method)(queries.float(), 3)  # type: ignore[arg-type]
            assert_equal(Searcher(route, method)(queries, 3), expected)  # type: ignore[arg-type]


@pytest.mark.parametrize("metric", METRICS)
def test_convention_10_scores_are_float32_whatever_the_autocast(metric: str) -> None:
    route = learned(metric=metric)
    for queries in (walk(300)[:1], walk(300)[::5]):
        for searcher in (Searcher(route, "scan"), Searcher(route, "bound")):
            with torch.autocast("cpu", torch.bfloat16):
                found = searcher(queries, 3)
            assert_equal(found, searcher(queries, 3))


def test_what_auto_takes_does_not_hang_on_what_was_asked_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "WORTH_BOUNDS", 1)
    monkeypatch.setattr(search, "SPARED", 0)
    route = walk(200)
    model = DejaVu(whitening="none", mapper=SpectralMapper(6.0, chunk=50)).learn(route)
    model.localize(route[:3], search="scan")
    model.localize(route[:3])
    assert model.searcher().told.method == "bound"  # as it spares enough
    monkeypatch.setattr(search, "SPARED", 2)
    assert model.searcher("bound") is not model.searcher()
    searcher = model.searcher()
    assert searcher(route[:0], 2).index.shape == (0, 2)
    assert searcher.told.method == "auto"  # still open
    model.localize(route[:3])
    assert model.searcher() is searcher
    assert searcher.told.method == "scan"


def test_nothing_of_a_search_outlives_the_map_or_is_written() -> None:
    route = walk(200)
    model = DejaVu(whitening="none", mapper=SpectralMapper(6.0, chunk=50)).learn(route)
    size, old = len(pickle.dumps(model)), weakref.ref(model.map)
    model.localize(route[:3], search="bound")
    assert len(pickle.dumps(model)) == size
    model.learn(route)
    assert old() is None


def test_a_search_is_kept_until_the_map_changes() -> None:
    route = walk(200)
    model = DejaVu(whitening="none", mapper=SpectralMapper(6.0, chunk=50)).learn(route)
    model.localize(route[:3], search="bound")
    searcher = model.searcher("bound")
    model.localize(route[:4], search="bound")
    assert model.searcher("bound") is searcher
    assert searcher.told.queries == 7
    model.map.extend(walk(50, seed=5))
    assert model.searcher("bound") is not searcher
    assert torch.equal(model.localize(walk(50, seed=5), search="bound").index, torch.arange(200, 250))
    scanned = model.searcher("scan")
    model.learn(walk(200, seed=9))
    assert model.searcher("scan") is not scanned


def test_what_cannot_be_searched_so_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    wave = walk(128)
    whole = DejaVu(whitening="none").learn(wave)
    templates = DejaVu(mapper=TemplateMapper(ImposedPeriods((8, 9)))).learn(wave)
    chunked = DejaVu(whitening="none", mapper=SpectralMapper(6.0, chunk=32)).learn(wave)
    with refused("'all'", "auto, scan, bound, ivf"):
        whole.localize(wave, search="all")  # type: ignore[arg-type]
    with refused("'bound'", "one chunk", "auto or scan"):
        whole.localize(wave, search="bound")
    for method in ("bound", "ivf"):
        with refused(method, "'templates'", "auto or scan"):
            templates.candidates(wave, 2, search=method)  # type: ignore[arg-type]
        for sequence in (SequenceMatcher(3), PlaceFilter()):
            with refused(method, "all scores"):
                chunked.localize(wave, sequence=sequence, search=method)  # type: ignore[arg-type]
    loading = builtins.__import__

    def without(name: str, *args: Any) -> Any:
        if name == "faiss":
            raise ImportError("No module named 'faiss'")
        return loading(name, *args)

    monkeypatch.setattr(builtins, "__import__", without)
    with refused("needs faiss", "dejavu_torch[bench]"):
        chunked.localize(wave, search="ivf")
