"""What answers tell where nothing says which of them are right."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.data.coordinates import Near
from dejavu_torch.evaluation.answers import (
    answer_facts,
    confident,
    describe_line,
    line_of,
    shift_facts,
    shift_of,
)
from dejavu_torch.types import Match


def answers(index, probability=None, score=None):
    score = torch.zeros(len(index)) if score is None else score
    return Match(index, score, torch.ones(len(index), dtype=torch.bool), probability)


def test_confident_are_the_probable_else_the_third_of_the_best_scores():
    index, score = torch.arange(7), torch.tensor([3.0, 1.0, 2.0, torch.inf, 9.0, 8.0, 7.0])
    sure = torch.tensor([0.5, 0.9, 0.49, 0.0, 1.0, 0.2, 0.3])
    assert confident(answers(index, sure)).nonzero().flatten().tolist() == [0, 1, 4]
    assert confident(answers(index, score=score)).nonzero().flatten().tolist() == [1, 2]
    assert not confident(answers(index, score=torch.full((7,), torch.inf))).any()


@given(st.integers(-60, 60), st.integers(0, 40), st.integers(0, 2**16))
def test_most_answers_near_a_line_tell_its_offset(offset, wrong, seed):
    """Up to two frames off it, and 40 of 100 anywhere."""
    noise = torch.Generator().manual_seed(seed)
    queries = torch.arange(100)
    places = queries + offset + torch.randint(-2, 3, (100,), generator=noise)
    lost = torch.randperm(100, generator=noise)[:wrong]
    places[lost] = torch.randint(-60, 160, (wrong,), generator=noise)
    line = line_of(places, queries, within=5)
    assert line is not None
    assert abs(line.offset - offset) <= 1
    assert line.answers >= 100 - wrong
    assert line.confident == 100


@pytest.mark.parametrize(
    "places",
    [
        torch.randperm(100, generator=torch.Generator().manual_seed(3)),  # in no order
        torch.arange(100).flip(0),
        torch.arange(100) // 3,  # another speed
        2 * torch.arange(100),
        torch.full((100,), 50),  # one place for all
        torch.arange(100) + torch.tensor([0, 30, 60]).repeat(34)[:100],  # three lines
        torch.arange(9),
        torch.arange(12),  # any order would be near it
    ],
    ids=["shuffled", "backwards", "slow", "fast", "one place", "three lines", "nine", "twelve"],
)
def test_no_line_no_offset(places):
    assert line_of(places, torch.arange(len(places)), within=5) is None


@pytest.mark.parametrize(
    ("scored", "offset", "asks"),
    [
        (False, None, True),
        (True, 0, True),
        (True, 20, False),
        (True, 15, False),  # within the tolerance
        (True, 14, True),
        (True, None, False),  # a ground truth that is no offset
    ],
)
def test_what_is_asked_of_a_line(scored, offset, asks):
    queries = torch.arange(60)
    sure = torch.where(queries < 40, 0.8, 0.1)
    match = answers(torch.where(queries < 40, queries + 20, -1), sure)
    facts = answer_facts(match, queries, 5, scored, offset)
    assert facts["probably_right"] == {"0.9": 0, "0.5": 40}
    assert facts.get("line") == ({"offset": 20, "answers": 40, "confident": 40} if asks else None)
    told = describe_line(facts | {"truth": "place = query + 0"}, scored)
    assert ("40 of 40" in told) == ("give --truth 20" in told) == asks
    assert ("contradict the truth (place = query + 0)" in told) == (asks and scored)


def test_queries_that_run_backwards_are_told():
    queries = torch.arange(60)
    facts = answer_facts(answers(80 - queries), queries, 5, False)
    assert facts["line"] == {"offset": 80, "answers": 60, "confident": 60, "backwards": True}
    assert "run backwards" in describe_line(facts, False)
    assert "place = 80 - query" in describe_line(facts, False)


@given(st.floats(-50, 50), st.floats(-50, 50), st.integers(0, 40), st.integers(0, 2**16))
def test_most_answers_in_one_direction_tell_how_far(x, y, wrong, seed):
    noise = torch.Generator().manual_seed(seed)
    asked = 200 * torch.rand(100, 2, generator=noise, dtype=torch.float64)
    found = asked + torch.tensor([x, y]) + torch.rand(100, 2, generator=noise) - 0.5
    found[:wrong] = 200 * torch.rand(wrong, 2, generator=noise, dtype=torch.float64)
    shift = shift_of(found, asked, 2.0, "m")
    if x**2 + y**2 > 3**2:
        assert shift is not None
        assert (shift.x, shift.y) == (pytest.approx(x, abs=0.5), pytest.approx(y, abs=0.5))
        assert shift.answers >= 100 - wrong
    elif x**2 + y**2 < 1:
        assert shift is None


@pytest.mark.parametrize("case", ["anywhere", "one place", "two directions", "a small area"])
def test_no_direction_no_shift(case):
    asked = 100 * torch.rand(100, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = {
        "anywhere": asked.roll(31, 0),
        "one place": torch.full_like(asked, 50),
        "two directions": asked + torch.tensor([[20.0, 0.0], [0.0, 20.0]]).repeat(50, 1),
        "a small area": asked / 25 + 10 * torch.tensor([0.3, 0.3]),
    }[case]
    assert shift_of(found, asked / 25 if case == "a small area" else asked, 2.5, "m") is None


@pytest.mark.parametrize(("kind", "unit"), [("metres", "m"), ("pixels", "px"), ("utm", "m")])
def test_a_shift_is_told(kind, unit):
    asked = torch.rand(60, 3, dtype=torch.float64) * 100
    asked[55:] = torch.nan
    match = answers(torch.where(torch.arange(60) < 40, torch.arange(60), -1))
    facts = shift_facts(Near(kind, 5.0), match, asked + torch.tensor([-4.0, 30.0, 99.0]), asked)
    told = describe_line(facts | {"truth": "within 5 m"}, True)
    assert f"lie at x - 4 {unit}, y + 30 {unit}" in told
    assert "contradict the truth (within 5 m)" in told
    assert not shift_facts(Near(kind, 5.0), match, asked + 1, asked)
