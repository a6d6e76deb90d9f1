"""One pass over scores: places, and those by sequences of several lengths."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.recognition.candidates import Candidates
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.matching import Found, Matching, lengths_beside
from dejavu_torch.recognition.select import Acceptance, best_match
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match, SequenceModel

SCORES = torch.rand(30, 40, generator=torch.Generator().manual_seed(3))
SCORE = st.one_of(st.integers(0, 3).map(float), st.just(math.inf))
TABLE = st.integers(1, 7).flatmap(
    lambda n: st.lists(st.lists(SCORE, min_size=n, max_size=n), min_size=1, max_size=14)
)
SPEEDS = st.lists(st.sampled_from([1.0, 0.0, 0.5, 2.0, -1.0, 9.0]), min_size=1, max_size=3)
LENGTHS = st.lists(st.integers(1, 12), min_size=1, max_size=4, unique=True).map(sorted)


@given(TABLE, LENGTHS, SPEEDS, st.integers(1, 4))
def test_each_of_several_lengths_scores_as_by_itself(
    rows: list[list[float]], lengths: list[int], speeds: list[float], size: int
) -> None:
    """To the bit, so that ties stay ties."""
    scores = torch.tensor(rows)
    found = zip(*SequenceMatcher(1, speeds).stream_sums(scores.split(size), lengths), strict=True)
    for length, parts in zip(lengths, found, strict=True):
        assert torch.equal(torch.cat(parts), SequenceMatcher(length, speeds)(scores))


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
    found = Matching(sequence, (1, 5, 11)).found(SCORES.split(size))
    with torch.no_grad():
        (own,) = sequence.stream([SCORES])
    assert found.match().index.tolist() == own.argmin(1).tolist()
    assert torch.allclose(found.match().score, own.min(1).values)
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
        for number, _ in enumerate(Matching(sequence, (1, 5, 11)).stream(batches())):
            assert asked == list(range(number + 1))
    assert len(asked) == 40
    assert seen.numel <= (11 - 1 + 2) * 51


def test_single_queries_alone_where_there_is_no_sequence() -> None:
    found = Matching().found(SCORES.split(7))
    assert same(found.match(Acceptance(0.01)), best_match(SCORES, 0.01))
    assert found.sequences == {}
    ranked = Matching(ranks=3, apart=4).found([SCORES])
    assert ranked.candidates.index.shape == (30, 3)
    places = ranked.candidates.index.sort(1).values
    assert (places.diff(dim=1) > 4).all()
    assert same(ranked.match(), best_match(SCORES))


def test_of_several_candidates_the_first_has_the_probability_and_is_accepted_by_it() -> None:
    candidates = Candidates(torch.tensor([[1, 7], [3, -1]]), torch.tensor([[0.1, 0.2], [0.3, math.inf]]))
    found = Found(candidates, probability=torch.tensor([0.9, 0.4], dtype=torch.float64))
    for rule, accepted in (
        (Acceptance(precision=0.5), [True, False, False, False]),
        (Acceptance(0.25), [True, True, False, False]),  # of scores, which all candidates have
        (Acceptance(), [True, True, True, False]),
    ):
        match = found.ranked(rule)
        assert match.index.tolist() == [1, 7, 3, -1]
        assert match.accepted.tolist() == accepted
        assert match.probability is not None
        assert match.probability.isnan().tolist() == [False, True, False, True]
        assert match.probability[::2].tolist() == [0.9, 0.4]
        assert same(found.match(rule), match.map(lambda column: column[::2]))
        assert same(found.first(1).ranked(rule), found.match(rule))
    alone = found._replace(probability=None)
    assert alone.ranked(Acceptance(precision=0.5)).probability is None


def test_nothing_found_needs_a_gradient() -> None:
    scores = SCORES.clone().requires_grad_()
    for sequence in (None, SequenceMatcher(3), PlaceFilter()):
        assert not Matching(sequence).found([scores]).candidates.score.requires_grad


def test_places_are_renumbered_everywhere() -> None:
    match = Match(torch.tensor([3, -1]), torch.tensor([0.0, math.inf]), torch.tensor([True, False]))
    found = Found(Candidates(torch.tensor([[1, 2], [3, -1]]), torch.zeros(2, 2)), {5: match})
    moved = found.moved(lambda place: torch.where(place >= 0, 10 * place, -1))
    assert moved.candidates.index.tolist() == [[10, 20], [30, -1]]
    assert moved.sequences[5].index.tolist() == [30, -1]
    assert moved.match().index.tolist() == [10, 30]


def test_lengths_that_there_is_room_for() -> None:
    assert lengths_beside(None, 100, 100) == ()
    assert lengths_beside(PlaceFilter(), 100, 100) == (1, 5, 11, 21)
    assert lengths_beside(SequenceMatcher(11), 21, 100) == (1, 5, 11, 21)
    assert lengths_beside(SequenceMatcher(11), 100, 20) == (1, 5, 11)
    assert lengths_beside(SequenceMatcher(30), 29, 100) == (1, 5, 11, 21)
    beside = lengths_beside(SequenceMatcher(30), 30, 30)
    assert all(one < other for one, other in pairwise(beside))
    assert 30 in beside
