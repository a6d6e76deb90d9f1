"""A coarse search finds nearly always what a scan finds."""

from __future__ import annotations

import copy
import math
from functools import cache
from typing import get_args

import pytest
import torch
from helpers import refused
from test_search import walk

from dejavu_torch import DejaVu, SpectralMapper
from dejavu_torch.growth import append
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition import coarse, samples
from dejavu_torch.recognition.calibration import Calibration, Platt
from dejavu_torch.recognition.coarse import CoarseSearch, SamplingPlan, plan, searcher
from dejavu_torch.recognition.samples import RowSearch
from dejavu_torch.recognition.search import NmsSpec, Scan, Search
from dejavu_torch.recognition.select import best_candidates


@pytest.fixture
def searched(monkeypatch):
    """Maps of a few hundred places are searched as those of millions are."""
    monkeypatch.setattr(coarse, "MIN_PLACES", 500)
    monkeypatch.setattr(coarse, "DECODED", 0)


@pytest.fixture
def held(monkeypatch):
    """Maps of a few hundred places are searched as those of 10^6, whose descriptors fit into memory."""
    monkeypatch.setattr(coarse, "MIN_PLACES", 500)
    for most in ("COMPARED", "COMPARED_IN_FLOAT"):
        monkeypatch.setattr(coarse, most, 0)


def smooth_model(places=3000, seed=0, **settings):
    return copy.deepcopy(_learned(places, seed, **settings))


@cache
def _learned(places, seed, **settings):
    mapper = SpectralMapper(None, 0.1, 256, **settings)
    return DejaVu(whitening="none", mapper=mapper).learn(walk(places, 24, seed, 0.99))


def queries_of(places=3000, noise=0.3):
    route = walk(places, 24, 0, 0.99)[::13]
    return route + noise * torch.randn(route.shape, generator=torch.Generator().manual_seed(9))


@pytest.mark.parametrize(("longer", "atol"), [("searched", 1e-5), ("held", 5e-5)])
@pytest.mark.parametrize("settings", [{}, {"transform": "dct"}], ids=str)
def test_coarse_finds_nearly_what_a_scan_finds(longer, atol, settings, request):
    request.getfixturevalue(longer)
    model, queries = smooth_model(**settings), queries_of()
    chosen = plan(model.map)
    assert chosen is not None
    assert 1 <= chosen.fine < chosen.coarse
    assert (chosen.fine == 1) == (longer == "held")
    scan, found = model.localize(queries, search="scan"), model.localize(queries)
    same = found.index == scan.index
    assert same.float().mean() >= 0.99
    torch.testing.assert_close(found.score[same], scan.score[same], rtol=0, atol=atol)
    several = model.candidates(queries, 4, apart=5)
    assert (several.index == model.candidates(queries, 4, apart=5, search="scan").index).float().mean() > 0.97


@pytest.mark.parametrize("settings", [{}, {"transform": "dct"}], ids=str)
@pytest.mark.parametrize("stage", [False, True])
@pytest.mark.parametrize("int8", [False, True])
def test_a_short_map_is_compared_with_whole(settings, stage, int8, monkeypatch):
    if not int8:
        monkeypatch.setattr(samples, "has_int8_products", lambda *_: False)
    model, queries = smooth_model(**settings), queries_of()
    if stage:
        mixed = torch.randn(24, 24, generator=torch.Generator().manual_seed(1))
        model.map = model.map.refined(torch.eye(24) + 0.2 * mixed)
    assert isinstance(searcher(model.map), RowSearch)
    scan, found = model.localize(queries, search="scan"), model.localize(queries)
    torch.testing.assert_close(found.score, scan.score, rtol=0, atol=5e-5)
    assert (found.index == scan.index).float().mean() >= 0.99
    for k, apart in ((4, 5), (2, 700), (40, 1)):
        expected = model.candidates(queries, k, apart=apart, search="scan")
        several = model.candidates(queries, k, apart=apart)
        assert (several.index == expected.index).float().mean() > 0.97
        near = (several.score - expected.score).abs() < 5e-5  # all but those that another choice suppressed
        assert near.float().mean() > 0.99


def test_a_query_of_which_eight_bits_leave_no_best_place_is_scanned():
    """Of a standing camera: more places than are looked at are worse than the best by less than 8 bits tell,
    but by more than rounding."""
    draw = torch.Generator().manual_seed(0)
    still = walk(400, 24, 0, 0.9).repeat_interleave(torch.where(torch.arange(400) == 200, 600, 1), 0)
    learned = SpectralMapper(None, 0.01)(still + 0.03 * torch.randn(still.shape, generator=draw))
    search, shown, wanted = searcher(learned), torch.arange(250, 800, 60), [(1, 0)]
    rows = torch.cat([learned.decode(chunk) for chunk in range(len(learned.chunks))])[shown]
    best = learned.scores(rows).topk(2, largest=False).values
    assert float((best[:, 1] - best[:, 0]).min()) > 2e-4
    assert isinstance(search, RowSearch)
    score, place = search(torch.cat([rows, torch.zeros(1, 24)]), wanted)
    found = best_candidates(score, 1, 0, place)
    assert found.index[:, 0].tolist() == [*shown.tolist(), 0]  # all are as far from a query of zeros
    expected = torch.tensor([0.0] * len(shown) + [1])
    torch.testing.assert_close(found.score[:, 0], expected, rtol=0, atol=1e-4)
    assert not search(torch.full((1, 24), math.nan), wanted)[0].isfinite().any()


@pytest.mark.parametrize("places", [5, 129, 137, 1033])
def test_padding_takes_no_place_of_a_candidate(places):
    """Where nearly all places are opposed to the query, whose products are below those of the padding."""
    draw = torch.Generator().manual_seed(0)
    rows = 0.2 * torch.randn(places, 24, generator=draw) - torch.eye(24)[0]
    rows[places // 2] *= -1
    learned, query = SpectralMapper(None, 0.01)(rows), torch.eye(24)[:1]
    search = searcher(learned)
    assert isinstance(search, RowSearch)
    for spec in ((2, 1), (min(20, places // 2), 0)):
        score, place = search(query, [spec])
        expected = best_candidates(learned.scores(query), *spec)
        torch.testing.assert_close(
            best_candidates(score, *spec, place).score, expected.score, rtol=0, atol=5e-5
        )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_a_query_of_another_type_may_be_in_doubt(dtype):
    model = smooth_model(700)
    queries = torch.cat([torch.zeros(1, 24), queries_of(700)[:3]]).to(dtype)
    found = model.localize(queries, search="scan").index
    assert torch.equal(model.localize(queries).index, found)
    tiny = 1e-14 * queries_of(700)[:3]
    assert torch.equal(model.localize(tiny).index, model.localize(tiny, search="scan").index)


def test_places_that_no_frame_shows_leave_a_map_to_a_scan():
    model = smooth_model(700)
    model.map.count_visits((torch.arange(700) != 300).long())
    assert type(searcher(model.map)) is Scan


@pytest.mark.usefixtures("searched")
def test_coarse_probabilities_are_those_of_a_scan():
    model, queries = smooth_model(), queries_of()
    model.calibration = Calibration(Platt(4.0, 1.0), None)
    expected = model.localize(queries, search="scan").probability
    found = model.localize(queries).probability
    assert found is not None
    assert expected is not None
    assert float((found - expected).abs().quantile(0.99)) < 0.01


@pytest.mark.usefixtures("searched")
def test_a_query_that_is_like_no_place_is_scanned():
    learned = SpectralMapper(None, 0.1, 256)(walk(1000, 24, 0, 0.99).abs() + 1)
    search = searcher(learned)
    assert isinstance(search, CoarseSearch)
    queries = torch.stack([torch.zeros(24), -torch.ones(24)])
    score, place = search(queries, [(1, 0)])
    expected = best_candidates(learned.scores(queries), 1, 0)
    assert torch.equal(best_candidates(score, 1, 0, place).index, expected.index)


@pytest.mark.parametrize("int8", [False, True])
def test_products_of_whole_numbers_are_exact(int8, monkeypatch):
    """Also those of the largest, of which two together need more than 16 bits."""
    if not int8:
        monkeypatch.setattr(samples, "has_int8_products", lambda *_: False)
    signs = torch.randint(2, (1024, 24), generator=torch.Generator().manual_seed(0)) * 2 - 1
    signs[0], signs[1] = 1, -1
    rows = (samples.LEVELS * signs).to(torch.int8)
    for count in (1, 40):
        queries = rows[:count]
        found = torch.cat([*samples.products_of(rows, queries)])
        assert torch.equal(found.long(), rows.long() @ queries.T.long())


def test_products_that_saturate_are_not_used(monkeypatch):
    """As those of kernels without VNNI, which torch may take on a processor with it."""

    def exact(rows, others):
        return rows.int() @ others.int()

    def saturating(rows, others):
        lifted, others = rows.int() + 128, others.int()
        pairs = (lifted[:, :, None] * others).unflatten(1, (-1, 2)).sum(2).clamp(-(2**15), 2**15 - 1)
        return (pairs.sum(1) - 128 * others.sum(0)).int()

    monkeypatch.setattr(torch.cpu, "_is_vnni_supported", lambda: True)
    for products, there in ((exact, torch.backends.mkldnn.is_available()), (saturating, False)):
        monkeypatch.setattr(torch, "_int_mm", products)
        assert samples.has_int8_products.__wrapped__() == there


def test_products_are_the_same_without_those_of_integers(monkeypatch):
    learned, queries = smooth_model(700).map, queries_of(700)
    assert isinstance(learned, SpectralMap)
    found = []
    for there in (True, False):
        if not (there and samples.has_int8_products()):
            monkeypatch.setattr(samples, "has_int8_products", lambda *_: False)
        found.append(CoarseSearch(learned, SamplingPlan(8, 4, 8, 1.0, 0))(queries, [(1, 0)]))
    assert all(map(torch.equal, *found))


@pytest.mark.usefixtures("searched")
@pytest.mark.parametrize(("least", "a_place", "chosen"), [(10**8, 0, True), (1, 100, True), (1, 1, False)])
def test_the_memory_by_default_grows_with_the_places(least, a_place, chosen, monkeypatch):
    learned = smooth_model().map
    expected = plan(learned, 10**9)
    monkeypatch.setattr(coarse, "MEMORY", least)
    monkeypatch.setattr(coarse, "MEMORY_PER_PLACE", a_place)
    if chosen:
        assert plan(learned) == expected
    else:
        assert plan(learned) != expected  # further apart, or none


@pytest.mark.usefixtures("searched")
def test_samples_follow_from_the_energy_of_the_lines_and_the_memory():
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
    kept = [one for part in (search.coarse, search.fine) for one in (part.rows, part.place)]
    padding = 2 * samples.GROUP * samples.GROUPS_PER_BLOCK * (24 + coarse.OVERHEAD)
    assert sum(one.nbytes for one in kept) <= 1.1 * chosen.bytes + padding
    with refused("memory is 100 bytes", "for a chunk"):
        plan(learned, 100)


@pytest.mark.usefixtures("searched")
def test_what_is_scanned():
    rough = SpectralMapper(None, 0.1, 256)(walk(1000, 24, 0, 0.0))
    one_chunk = SpectralMapper(None, 0.1, 1000)(walk(1000, 24, 0, 0.99))
    distances = SpectralMapper(None, 0.1, 256, metric="l2")(walk(1000, 24, 0, 0.99))
    assert [plan(route) for route in (rough, one_chunk, distances, SpectralMap())] == [None] * 4
    smooth = smooth_model(1000).map
    ways = {method: type(searcher(smooth, method)) for method in get_args(Search)}
    assert ways == {"auto": CoarseSearch, "coarse": CoarseSearch, "exact": Scan, "scan": Scan}
    assert type(searcher(rough)) is Scan


def appended(model, more):
    append(model, more)


def learned_anew(model, more):
    model.learn(torch.cat([walk(1000, 24, 0, 0.99), more]))


def loaded(model, more):
    model.load_state_dict(append(copy.deepcopy(model), more).state_dict())


def map_loaded(model, more):
    model.map.load_state_dict(append(copy.deepcopy(model), more).map.state_dict())


def map_set(model, more):
    model.map = append(copy.deepcopy(model), more).map


@pytest.mark.usefixtures("searched")
@pytest.mark.parametrize("change", [appended, learned_anew, loaded, map_loaded, map_set])
def test_samples_are_made_once_for_a_map_and_anew_for_another(change):
    model, more = smooth_model(1000), walk(1000, 24, 5, 0.99)
    model.localize(more[:3])
    first = model.searcher
    assert isinstance(first, CoarseSearch)
    model.candidates(more[:3], 2)
    model.to("cpu").localize(more[:3], search="scan")
    assert model.searcher is first
    change(model, more)
    assert model.localize(more[500:501]).index.tolist() == [1500]
    assert isinstance(model.searcher, CoarseSearch)
    assert model.searcher is not first


def test_a_searcher_of_the_user_finds_the_places_until_the_map_is_another():
    model, asked = smooth_model(700), list[list[NmsSpec]]()

    def own(queries, wanted):
        asked.append(wanted)
        return torch.tensor([[0.0, 1.0]]).expand(len(queries), 2), torch.tensor([[7, 99]]).expand(
            len(queries), 2
        )

    model.searcher = own
    queries = queries_of(700, noise=0.0)[:5]
    assert model.localize(queries).index.tolist() == [7] * 5
    assert asked == [[(1, 5), (2, 5)]]  # the second best is for the confidence
    for search in ("scan", "exact"):
        assert model.localize(queries, search=search).index.tolist() == [0, 13, 26, 39, 52]  # type: ignore[arg-type]
    model.load_state_dict(model.state_dict())
    assert model.localize(queries).index.tolist() == [0, 13, 26, 39, 52]
    assert len(asked) == 1


def test_the_cosine_of_samples_is_near_that_of_places():
    """Samples are descriptors of their places, low-passed."""
    for transform in ("dft", "dct"):
        learned = smooth_model(700, transform=transform).map
        assert isinstance(learned, SpectralMap)
        for chunk, (start, _) in enumerate(learned.chunks):
            spacing = -(-len(learned.decode(chunk)) // 60)
            rows, at = learned.samples(chunk, spacing), learned.sampled(chunk, spacing)
            own = learned.decode(chunk)[at]
            assert float(torch.cosine_similarity(rows, own).quantile(0.1)) > 0.97, (transform, start)
            own = learned.decode(chunk)
            same, at = learned.samples(chunk, 1), learned.sampled(chunk, 1)
            torch.testing.assert_close(same, own[at], rtol=0, atol=1e-4)


@pytest.mark.usefixtures("searched")
def test_many_candidates_are_those_of_a_scan_and_no_query_has_none():
    learned, queries = smooth_model().map, queries_of()[:5]
    search, wanted = searcher(learned), [(40, 5)]
    assert isinstance(search, CoarseSearch)
    score, place = search(queries, wanted)
    assert score.shape[1] <= learned.places
    found = best_candidates(score, *wanted[0], place)
    assert (found.index == best_candidates(learned.scores(queries), *wanted[0]).index).float().mean() > 0.9
    assert [tuple(one.shape) for one in search(queries[:0], wanted)] == [(0, 40)] * 2
