"""One pass over scores: places, and those by sequences of several lengths."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from helpers import streamed
from torch import Tensor

from dejavu_torch.evaluation.contenders import lengths_beside
from dejavu_torch.recognition.calibration import Platt, confidence_of
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.select import Acceptance, best_candidates, best_match
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match, SequenceModel

SCORES = torch.rand(30, 40, generator=torch.Generator().manual_seed(3))


def matched(matching: Matching, scores: Tensor = SCORES, size: int = 30) -> Match:
    matcher = Localizer(None, matching)
    return Match.joined(map(matcher.match, scores.split(size)))


def same(one: Match, other: Match) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("size", [1, 7, 30])
@pytest.mark.parametrize(
    ("sequence", "speeds"), [(SequenceMatcher(5, [1, 0.5]), [1, 0.5]), (PlaceFilter(within=2), [1.0])]
)
def test_a_sequence_and_what_stands_beside_it(
    sequence: SequenceModel, speeds: list[float], size: int
) -> None:
    """A matcher's at its own speeds, a filter's at speed 1, out of the scores of single queries."""
    found = matched(Matching(sequence, (1, 5, 11)), size=size)
    with torch.no_grad():
        (own,) = streamed(sequence, [SCORES])
    assert found.index.tolist() == own.argmin(1).tolist()
    assert torch.allclose(found.score, own.min(1).values)
    assert list(found.sequences) == [1, 5, 11]
    for length, match in found.sequences.items():
        assert same(match, best_match(SequenceMatcher(length, speeds)(SCORES)))


@pytest.mark.parametrize("sequence", [SequenceMatcher(5), PlaceFilter()])
def test_scores_pass_by_once_and_are_not_held(
    sequence: SequenceModel, largest_tensor: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch is asked for when those before it are matched, and none is asked for twice."""
    asked: list[int] = []

    def batches() -> Iterator[Tensor]:
        for number in range(40):
            asked.append(number)
            yield torch.rand(2, 50)

    with largest_tensor() as seen:
        for number, _ in enumerate(map(Localizer(None, Matching(sequence, (1, 5, 11))).match, batches())):
            assert asked == list(range(number + 1))
    assert len(asked) == 40
    assert seen.numel <= (11 - 1 + 2) * (50 + 2 * 10)  # a trajectory's places to each side


def test_single_queries_alone_where_there_is_no_sequence() -> None:
    found = matched(Matching(rule=Acceptance(0.01)), size=7)
    assert same(found, best_match(SCORES, 0.01))
    assert found.sequences == {}
    several = matched(Matching(k=3, radius=4))
    assert same(several, best_candidates(SCORES, 3, 4))
    assert (several.index.sort(1).values.diff(dim=1) > 4).all()


def test_of_several_candidates_the_first_has_the_probability_and_is_accepted_by_it() -> None:
    platt = Platt(1.0, 0.0)
    probability = platt.probability(confidence_of(SCORES))
    middle = float(probability.median())
    score = best_candidates(SCORES, 2, 4).score
    for rule in (Acceptance(precision=middle), Acceptance(0.02), Acceptance()):
        match = matched(Matching(k=2, radius=4, rule=rule, platt=platt), size=7)
        assert match.probability is not None
        assert torch.equal(match.probability[:, 0], probability)
        assert match.probability[:, 1].isnan().all()
        if rule.precision is not None:
            assert torch.equal(match.accepted[:, 0], probability >= middle)
            assert not match.accepted[:, 1].any()
        else:  # of scores, which all candidates have
            assert torch.equal(match.accepted, score < (rule.threshold or math.inf))
        first = matched(Matching(rule=rule, platt=platt))
        assert same(first, match.map(lambda column: column[:, 0]))
    alone = matched(Matching(rule=Acceptance(precision=0.5)))
    assert alone.probability is None


def test_places_are_renumbered_everywhere() -> None:
    match = Match(torch.tensor([3, -1]), torch.tensor([0.0, math.inf]), torch.tensor([True, False]))
    several = Match(torch.tensor([[1, 2], [3, -1]]), torch.zeros(2, 2), torch.ones(2, 2) > 0)
    probability = torch.rand(2, 2)
    found = several._replace(probability=probability, sequences={5: match})
    moved = found.renumbered(lambda place: torch.where(place >= 0, 10 * place, -1))
    assert moved.index.tolist() == [[10, 20], [30, -1]]
    assert moved.sequences[5].index.tolist() == [30, -1]
    assert moved.probability is probability
    both = Match.joined([moved, moved])
    assert both.index.tolist() == [[10, 20], [30, -1]] * 2
    assert both.sequences[5].index.tolist() == [30, -1] * 2


def test_lengths_that_there_is_room_for() -> None:
    assert lengths_beside(None, 100, 100) == ()
    assert lengths_beside(PlaceFilter(), 100, 100) == (1, 5, 11, 21)
    assert lengths_beside(SequenceMatcher(11), 21, 100) == (1, 5, 11, 21)
    assert lengths_beside(SequenceMatcher(11), 100, 20) == (1, 5, 11)
    assert lengths_beside(SequenceMatcher(30), 29, 100) == (1, 5, 11, 21)
    beside = lengths_beside(SequenceMatcher(30), 30, 30)
    assert all(one < other for one, other in pairwise(beside))
    assert 30 in beside
