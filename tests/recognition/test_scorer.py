"""Scores of queries by their numbers, in blocks, and wrapped."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import DejaVu, Layout, PlaceFilter, PlaceSmoother, SpectralMapper
from dejavu_torch.maps.distance import phase_distances
from dejavu_torch.recognition.calibration import Platt
from dejavu_torch.recognition.localizer import Localizer, Matching, answer
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.scorer import (
    BestHeading,
    Cached,
    Earlier,
    OfMap,
    OfRows,
    OfStored,
    Reordered,
    Wrapped,
)

TWO = Querying(headings=2).wrappers


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def place_map():
    return SpectralMapper(step=0.1, chunk=32)(noise(90, 6, seed=1))


def test_rows_are_blocks_and_scores_of_the_map(place_map):
    queries = noise(12, 6)
    scorer, some = OfMap(place_map, queries), torch.tensor([3, 0, 11])
    rows = scorer.rows(some)
    torch.testing.assert_close(rows, place_map.scores(queries[some]))
    blocks = [*scorer.blocks(some)]
    assert len(blocks) > 1
    torch.testing.assert_close(torch.cat([scores for _, scores in blocks], 1), rows)
    assert scorer.width == place_map.block_places
    assert (len(scorer), scorer.layout) == (12, place_map.layout)
    assert torch.cat(scorer.parts()).tolist() == [*range(12)]
    mirrored = scorer.null(some, seed=1)
    assert mirrored.shape == rows.shape
    assert not torch.allclose(mirrored, scorer.null(some, seed=2))


@given(k=st.integers(1, 5), rows=st.integers(1, 6), columns=st.integers(1, 6), seed=st.integers(0, 9))
def test_stored_frames_answer_for_their_neighbours_in_each_direction(k, rows, columns, seed):
    layout, frames, queries = Layout(rows, columns), noise(rows * columns, 4, seed=seed), noise(5, 4)
    scorer, every = OfStored(frames, queries, k, layout=layout), torch.arange(5)
    stored, nearest = layout.strided(k)
    expected = phase_distances(queries, frames, "l1")[:, stored[nearest]]
    torch.testing.assert_close(scorer.rows(every), expected)
    found = answer(scorer).index
    assert torch.isin(found, stored).all()
    assert torch.equal(found, stored[phase_distances(queries, frames[stored], "l1").argmin(1)])


@given(copies=st.integers(1, 4), seed=st.integers(0, 20))
def test_wrappers_commute_where_they_have_nothing_to_do_with_each_other(copies, seed):
    every, order = torch.arange(6), torch.randperm(9, generator=torch.Generator().manual_seed(seed))
    scores = noise(6 * copies, 9, seed=seed)
    inner = OfRows(
        scores.__getitem__, noise(6 * copies, 3), Layout(9), lambda numbers, seed: scores[numbers] + seed
    )
    one, other = BestHeading(Reordered(inner, order), copies), Reordered(BestHeading(inner, copies), order)
    assert len(one) == len(other) == 6
    assert torch.equal(one.rows(every), other.rows(every))
    best = scores.view(6, copies, 9).amin(1)
    assert torch.equal(one.rows(every)[:, torch.arange(9)], best[:, order.argsort()])
    assert one.null is other.null is None  # a shuffled map has no order to ask for
    assert torch.equal(BestHeading(inner, copies).null(every, seed=2), best + 2)
    places = one.rows(every).topk(2, 1, largest=False).indices
    turn = BestHeading(inner, copies).told(every, order.argsort()[places])["heading"]
    at = scores.view(6, copies, 9).gather(2, order.argsort()[places][:, None].expand(-1, copies, -1))
    assert torch.equal(turn, at.argmin(1) * (360 / copies))
    assert torch.equal(one.told(every, places)["heading"], turn)
    assert torch.equal(other.told(every, places)["heading"], turn)
    assert Reordered(inner, order).told(every, places) == {}
    assert torch.equal(one.descriptors, inner.descriptors[::copies])


def test_frames_that_are_stored_keep_their_numbers_in_another_order():
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    frames = noise(30, 4)
    scorer = Reordered(OfStored(frames[order], noise(50, 4, seed=1), 4), order)
    assert sorted(scorer.stored.tolist()) == sorted(order[::4].tolist())
    assert torch.isin(answer(scorer).index, order[::4]).all()


@pytest.mark.parametrize(
    "matching",
    [Matching(), Matching(PlaceFilter(lag=3)), Matching(k=3, wrappers=TWO), Matching(wrappers=TWO)],
)
def test_a_wrapper_that_changes_nothing_changes_no_answer(place_map, matching):
    model = DejaVu(None, "none")
    model.map = place_map
    queries = noise(90, 6, seed=1) + 0.3 * noise(90, 6, seed=2)
    queries[10:14] = 0  # blank
    plain = model.localize_descriptors(queries, matching)
    wrapped = model.localize_descriptors(queries, matching, Wrapped)
    torch.testing.assert_close(
        plain.score, wrapped.score, atol=1e-4, rtol=0
    )  # almost alike are in either order
    assert (plain.index == wrapped.index).double().mean() > 0.95
    assert torch.equal(plain.accepted, wrapped.accepted)
    assert (plain.heading is None) == (wrapped.heading is None)
    if plain.heading is not None:
        assert (plain.heading == wrapped.heading).double().mean() > 0.9


def test_only_earlier_places_answer_and_blank_queries_find_none():
    scores, descriptors = noise(9, 9), noise(9, 3)
    descriptors[7] = 0
    scorer = Earlier(OfRows(scores.__getitem__, descriptors, Layout(9)), 3)
    rows = scorer.rows(torch.arange(9))
    for query, row in enumerate(rows):
        assert row.isfinite().nonzero()[:, 0].tolist() == ([] if query == 7 else [*range(max(0, query - 3))])
    assert scorer.null is None


def test_a_wrapper_changes_what_a_model_finds():
    route = noise(80, 8, seed=3)
    model, queries = DejaVu(whitening="none").learn(route), route + 0.1 * noise(80, 8, seed=4)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    shuffled = DejaVu(whitening="none").learn(route[order])
    found = shuffled.localize_descriptors(queries, None, lambda scorer: Reordered(scorer, order))
    assert float((found.index == torch.arange(80)).double().mean()) > 0.9
    several = model.localize_descriptors(queries, Matching(k=3, radius=5), lambda scorer: scorer)
    assert torch.equal(several.index, model.localize_descriptors(queries, Matching(k=3, radius=5)).index)


def test_no_queries_have_no_headings(place_map):
    for sequence in (None, PlaceFilter(), PlaceSmoother()):
        match = answer(OfMap(place_map, noise(0, 6)), Matching(sequence, wrappers=TWO))
        assert len(match) == 0


def test_a_filter_asks_once_how_faithful_its_map_is(place_map, monkeypatch):
    asked, plain = [], type(place_map).fidelity
    monkeypatch.setattr(
        type(place_map), "fidelity", property(lambda self: asked.append(1) or plain.fget(self))
    )
    localizer = Localizer(place_map, Matching(PlaceFilter(), platt=Platt(1.0, 0.0)))
    for query in noise(12, 6, seed=1).split(1):
        localizer(query)
    assert len(asked) == 1
    assert len(localizer.running.counts[1]) > 0


@pytest.mark.parametrize("every", [True, False])
def test_scores_that_are_cached_are_computed_once(every):
    scores, asked = noise(9, 5), list[int]()
    rows = lambda numbers: asked.extend(numbers.tolist()) or scores[numbers]  # noqa: E731
    scorer = Cached(OfRows(rows, noise(9, 3), Layout(5)), every)
    for first in (0, 3, 6, 6, 3, 0):  # there and back
        assert torch.equal(scorer.rows(torch.arange(first, first + 3)), scores[first : first + 3])
    assert asked == [*range(9)] if every else asked == [*range(9), 3, 4, 5, 0, 1, 2]
