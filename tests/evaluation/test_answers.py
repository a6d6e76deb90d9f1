"""What answers tell where nothing says which of them are right."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.evaluation.answers import (
    answer_facts,
    confident,
    describe_line,
    describe_probable,
    line_of,
    next_steps,
    probable_counts,
)
from dejavu_torch.types import Match


def answers(index, probability=None, score=None):
    score = torch.zeros(len(index)) if score is None else score
    return Match(index, score, torch.ones(len(index), dtype=torch.bool), probability)


def test_probable_answers_are_counted_and_told():
    match = answers(torch.arange(5), torch.tensor([0.95, 0.9, 0.5, 0.49, 0.0]))
    counts = probable_counts(match)
    assert counts == {"0.9": 2, "0.5": 3}
    assert describe_probable(counts, 5) == "2 of 5 answers are probably right (at least .9), 3 at .5"
    assert probable_counts(answers(torch.arange(5))) == {}


def test_the_next_step_is_one_that_was_not_taken():
    first, second = next_steps(together=False, strict=False)
    assert "--ordered" in first
    assert "--precision .9" in second
    assert next_steps(together=True, strict=False) == [second]
    assert next_steps(together=True, strict=True) == []


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
    ],
    ids=["shuffled", "backwards", "slow", "fast", "one place", "three lines"],
)
def test_no_line_no_offset(places):
    assert line_of(places, torch.arange(100), within=5) is None


def test_few_answers_or_few_frames_show_no_line():
    assert line_of(torch.arange(9), torch.arange(9), within=5) is None
    assert line_of(torch.arange(12), torch.arange(12), within=5) is None  # any order would be near it
    assert line_of(torch.arange(40), torch.arange(40), within=5, min_answers=41) is None


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
    assert ("40 of 40" in told) == ("is it --truth 20?" in told) == asks
    assert ("contradict the truth (place = query + 0)" in told) == (asks and scored)


def test_queries_that_run_backwards_are_told():
    queries = torch.arange(60)
    facts = answer_facts(answers(80 - queries), queries, 5, False)
    assert facts["line"] == {"offset": 80, "answers": 60, "confident": 60, "backwards": True}
    assert "run backwards" in describe_line(facts, False)
    assert "place = 80 - query" in describe_line(facts, False)


@pytest.mark.parametrize(
    ("offset", "line"), [(-7, "query - 7: is it --truth -7?"), (0, "query: is it --truth 0?")]
)
def test_an_offset_may_be_negative_or_none(offset, line):
    queries = torch.arange(60)
    facts = answer_facts(answers(queries + offset), queries, 5, False)
    assert f"place = {line}" in describe_line(facts, False)
