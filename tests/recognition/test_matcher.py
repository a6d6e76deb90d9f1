"""One pass over scores: places, and those by sequences of several lengths."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import streamed

from dejavu_torch.evaluation.contenders import models_beside
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.recognition.calibration import Platt, confidence_of
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.select import Acceptance, best_candidates, best_match
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match

SCORES = torch.rand(30, 40, generator=torch.Generator().manual_seed(3))


def matched(matching, scores=SCORES, size=30):
    matcher = Localizer(None, matching)
    return Match.joined(map(matcher.match, scores.split(size)))


def lengths(speeds):
    return {length: SequenceMatcher(length, speeds) for length in (1, 5, 11)}


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("size", [1, 7, 30])
@pytest.mark.parametrize(
    ("sequence", "speeds"), [(SequenceMatcher(5, [1, 0.5]), [1, 0.5]), (PlaceFilter(within=2), [1.0])]
)
def test_a_sequence_and_what_stands_beside_it(sequence, speeds, size):
    """All out of the scores of single queries."""
    found = matched(Matching(sequence, lengths(speeds)), size=size)
    with torch.no_grad():
        (own,) = streamed(sequence, [SCORES])
    assert found.index.tolist() == own.argmin(1).tolist()
    assert torch.allclose(found.score, own.min(1).values)
    assert list(found.sequences) == [1, 5, 11]
    for length, model in lengths(speeds).items():
        assert same(found.sequences[length], best_match(model(SCORES)))


@pytest.mark.parametrize("sequence", [SequenceMatcher(5), PlaceFilter()])
def test_scores_pass_by_once_and_are_not_held(sequence, largest_tensor, monkeypatch):
    """A batch is asked for when those before it are matched, and none is asked for twice."""
    asked = []

    def batches():
        for number in range(40):
            asked.append(number)
            yield torch.rand(2, 50)

    with largest_tensor() as seen:
        matching = Matching(sequence, lengths([1.0]))
        for number, _ in enumerate(map(Localizer(None, matching).match, batches())):
            assert asked == list(range(number + 1))
    assert len(asked) == 40
    # a trajectory's places to each side, or all states by move
    states = 5 * PlaceFilter().start(50).belief.numel() if isinstance(sequence, PlaceFilter) else 0
    assert seen.numel <= max(states, (11 - 1 + 2) * (50 + 2 * 10))


def test_single_queries_alone_where_there_is_no_sequence():
    found = matched(Matching(acceptance=Acceptance(0.01)), size=7)
    assert same(found, best_match(SCORES, 0.01))
    assert found.sequences == {}
    several = matched(Matching(k=3, radius=4))
    assert same(several, best_candidates(SCORES, 3, 4))
    assert (several.index.sort(1).values.diff(dim=1) > 4).all()


def test_of_several_candidates_the_first_has_the_probability_and_is_accepted_by_it():
    platt = Platt(1.0, 0.0)
    probability = platt.probability(confidence_of(SCORES))
    middle = float(probability.median())
    score = best_candidates(SCORES, 2, 4).score
    for acceptance in (Acceptance(precision=middle), Acceptance(0.02), Acceptance()):
        match = matched(Matching(k=2, radius=4, acceptance=acceptance, platt=platt), size=7)
        assert match.probability is not None
        assert torch.equal(match.probability[:, 0], probability)
        assert match.probability[:, 1].isnan().all()
        if acceptance.precision is not None:
            assert torch.equal(match.accepted[:, 0], probability >= middle)
            assert not match.accepted[:, 1].any()
        else:  # of scores, which all candidates have
            assert torch.equal(match.accepted, score < (acceptance.threshold or math.inf))
        first = matched(Matching(acceptance=acceptance, platt=platt))
        assert same(first, match.map(lambda column: column[:, 0]))
    alone = matched(Matching(acceptance=Acceptance(precision=0.5)))
    assert alone.probability is None


def test_places_are_renumbered_everywhere():
    match = Match(torch.tensor([3, -1]), torch.tensor([0.0, math.inf]), torch.tensor([True, False]))
    several = Match(torch.tensor([[1, 2], [3, -1]]), torch.zeros(2, 2), torch.ones(2, 2) > 0)
    probability = torch.rand(2, 2)
    found = Match(*several, probability, sequences={5: match})
    moved = found.renumbered(lambda place: torch.where(place >= 0, 10 * place, -1))
    assert moved.index.tolist() == [[10, 20], [30, -1]]
    assert moved.sequences[5].index.tolist() == [30, -1]
    assert moved.probability is probability
    both = Match.joined([moved, moved])
    assert both.index.tolist() == [[10, 20], [30, -1]] * 2
    assert both.sequences[5].index.tolist() == [30, -1] * 2


@pytest.mark.parametrize(
    ("sequence", "ordered", "queries", "places", "keys"),
    [
        (None, False, 100, 100, []),
        (None, True, 100, 100, ["filter"]),
        (None, True, 100, 2, []),  # a filter moves by up to 2 places
        (None, True, 1, 100, []),
        (PlaceFilter(), False, 100, 100, [1, 5, 11, 21, "filter"]),
        (SequenceMatcher(11), False, 21, 100, [1, 5, 11, 21]),
        (SequenceMatcher(11), True, 100, 20, [1, 5, 11, "filter"]),
        (SequenceMatcher(30), False, 29, 100, [1, 5, 11, 21]),
        (SequenceMatcher(30), False, 30, 30, [1, 5, 11, 21, 30]),
    ],
)
def test_ways_to_match_that_there_is_room_for(sequence, ordered, queries, places, keys):
    found = models_beside(sequence, ordered, queries, places, within=3)
    assert [*found] == keys
    if isinstance(sequence, PlaceFilter):
        assert found["filter"] is sequence
    elif "filter" in keys:
        assert getattr(found["filter"], "within", None) == 3


def test_sequences_and_a_filter_beside_single_queries_change_nothing_of_them():
    route = SpectralMapper(12.0)(torch.randn(60, 8).cumsum(0))
    queries = route.decode(0)[10:40] + 0.3 * torch.randn(30, 8)
    also = {5: SequenceMatcher(5), "filter": PlaceFilter()}
    platt = Platt(3.0, -1.0)
    batches = queries.split(7)  # the same for both: another size of a product rounds otherwise
    alone = Match.joined(map(Localizer(route, Matching(platt=platt)), batches))
    # the state goes on from batch to batch
    parts = Match.joined(map(Localizer(route, Matching(platt=platt, also=also)), batches))
    assert all(torch.equal(one, other) for one, other in zip(parts, alone, strict=True))
    assert parts.probability is not None
    assert alone.probability is not None
    assert torch.equal(parts.probability, alone.probability)
    scores = torch.cat([route.scores(part) for part in batches])
    for key, model in also.items():
        expected = best_match(model(scores))
        assert torch.equal(parts.sequences[key].index, expected.index)
        torch.testing.assert_close(parts.sequences[key].score, expected.score)
