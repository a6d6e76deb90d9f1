"""Scores of several queries added up along trajectories."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import Fixed, refused, streamed, template_model
from hypothesis import example, given
from hypothesis import strategies as st

from dejavu_torch import DejaVu, SequenceMatcher, compare
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.types import FrequencyLayer


def literal(scores, length, speeds):
    """Each query, place, speed and step in a loop of its own."""
    places, found = len(scores[0]), []
    for t in range(len(scores)):
        row = []
        for i in range(places):
            best, used = math.inf, min(length, t + 1)
            for speed in speeds:
                passed = [i - math.floor(speed * k + 0.5) for k in range(used)]
                on_map = [
                    scores[t - k][place]
                    for k, place in enumerate(passed)
                    if 0 <= place < places and math.isfinite(scores[t - k][place])
                ]
                if math.isfinite(scores[t][i]) and 2 * len(on_map) >= used:
                    best = min(best, sum(on_map) / len(on_map))
            row.append(best)
        found.append(row)
    return found


SCORE = st.one_of(st.integers(0, 3).map(float), st.just(math.inf))
TABLE = st.integers(1, 7).flatmap(
    lambda n: st.lists(st.lists(SCORE, min_size=n, max_size=n), min_size=1, max_size=9)
)
SPEEDS = st.lists(st.sampled_from([1.0, 0.0, 0.5, 2.0, -1.0, 1.3]), min_size=1, max_size=3)


@given(TABLE, st.integers(1, 12), SPEEDS)
def test_equals_a_literal_loop(rows, length, speeds):
    found = SequenceMatcher(length, speeds)(torch.tensor(rows, dtype=torch.float64))
    expected = torch.tensor(literal(rows, length, speeds), dtype=torch.float64)
    assert torch.allclose(found, expected, atol=1e-12)
    assert torch.equal(found.isfinite(), expected.isfinite())


@given(TABLE, st.integers(1, 12), SPEEDS, st.integers(1, 4))
@example([[0.0, 3.0], [1.0, 0.0], [5.0, 0.0], [0.0, 1.0]], 3, [1.0], 2)  # a batch after whole sequences
def test_batches_do_not_matter(rows, length, speeds, size):
    matcher, scores = SequenceMatcher(length, speeds), torch.tensor(rows)
    assert torch.equal(torch.cat(list(streamed(matcher, scores.split(size)))), matcher(scores))


@given(TABLE, st.integers(1, 12), SPEEDS)
def test_a_score_is_the_mean_of_its_trajectory(rows, length, speeds):
    matcher, scores = SequenceMatcher(length, speeds), torch.tensor(rows, dtype=torch.float64)
    for place, score in enumerate(matcher(scores)[-1].tolist()):
        if math.isfinite(score):
            query, passed = matcher.trajectory(scores, place).T
            assert (int(query[0]), int(passed[0])) == (len(scores) - 1, place)
            assert float(scores[query, passed].mean()) == pytest.approx(score)


@given(TABLE, st.integers(1, 12), SPEEDS, st.integers(0, 7))
def test_trajectories_stay_on_their_route(rows, length, speeds, cut):
    matcher, scores, cut = SequenceMatcher(length, speeds), torch.tensor(rows), min(cut, len(rows[0]))
    found, _ = matcher.step(scores, matcher.start(len(rows[0])), (0, cut))
    parts = [matcher(part) for part in (scores[:, :cut], scores[:, cut:])]
    assert torch.equal(found, torch.cat(parts, 1))


@given(TABLE, st.integers(1, 12), SPEEDS)
def test_a_fixed_state_of_nan_is_no_query(rows, length, speeds):
    matcher, scores = SequenceMatcher(length, speeds), torch.tensor(rows)
    state = matcher.start(scores.shape[1], fixed=True)
    for row, expected in zip(scores.split(1), matcher(scores).split(1), strict=True):
        found, state = matcher.step(row, state)
        assert state.shape == (length - 1, scores.shape[1])
        assert torch.equal(found, expected)


def test_gradients_reach_every_score_of_a_trajectory():
    scores = torch.rand(4, 6, dtype=torch.float64, requires_grad=True)
    matcher = SequenceMatcher(3, [1.0, 2.0])
    finite = matcher(scores).isfinite()
    assert torch.autograd.gradcheck(lambda scores: matcher(scores)[finite], (scores,))
    (gradient,) = torch.autograd.grad(SequenceMatcher(3)(scores)[3, 4], scores)
    assert gradient.nonzero().tolist() == [[1, 2], [2, 3], [3, 4]]


def route(noise):
    fresh = torch.Generator().manual_seed(noise)
    places = torch.rand(200, 4, generator=torch.Generator().manual_seed(9))
    return places + 0.2 * torch.randn(200, 4, generator=fresh)


@pytest.mark.parametrize("kind", ["templates", "spectral"])
def test_a_sequence_finds_what_single_frames_do_not(kind):
    if kind == "templates":
        layer = FrequencyLayer(200, 200, 0, 200, (0, 1, 2, 3))
        model = template_model(periods=Fixed(layer))
    else:
        model = DejaVu(whitening="none")
    model.learn(route(0))
    single, many = model.localize(route(1)), model.localize(route(1), sequence=SequenceMatcher(15))

    def right(match):
        return float((match.index == torch.arange(200)).float().mean())

    assert right(single) < 0.5
    assert right(many) > 0.9
    model.batch_size = 7
    assert torch.equal(model.localize(route(1), sequence=SequenceMatcher(15)).index, many.index)


def test_a_sequence_longer_than_the_queries_is_told_once(caplog):
    model = DejaVu(whitening="none")
    compare(route(0), route(1)[:6], "0", model, querying=Querying(match=SequenceMatcher(11)))
    told = [line for line in caplog.messages if "sequence" in line]
    assert told == ["a sequence of 11 queries, but there are 6: all are used"]
    SequenceMatcher(11).check(11, 11)
    with refused("a sequence of 11 queries at 1 places per query on 10 places"):
        SequenceMatcher(11).check(20, 10)
    with refused("a sequence of 41 queries at 1 places per query on 40 places"):
        model.learn(route(0)[:40]).localize(route(1), sequence=SequenceMatcher(41))
    with refused("a sequence of 3 queries at -5 places per query on 10 places"):
        SequenceMatcher(3, [1, -5]).check(None, 10)
    SequenceMatcher(11, [0]).check(None, 1)


def test_convention_2_a_place_that_nothing_covers_is_not_reported():
    layer = FrequencyLayer(20, 20, 0, 80, (0, 1, 2, 3))
    model = template_model(periods=Fixed(layer)).learn(route(0)[:90])
    found = model.localize(route(1)[:90], sequence=SequenceMatcher(9))
    assert found.index.max() < 80


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SequenceMatcher(0), ["a sequence of 0 queries", "expected a whole number, 1 to "]),
        (lambda: SequenceMatcher(2.5), ["a sequence of 2.5 queries", "whole number"]),  # type: ignore[arg-type]
        (lambda: SequenceMatcher(3, []), ["speeds are []", "at least one finite"]),
        (lambda: SequenceMatcher(3, [1.0, math.nan]), ["speeds are [1.0, nan]", "finite"]),
        (lambda: SequenceMatcher(3)(torch.zeros(3, 4).long()), ["(3, 4) torch.int64", "floats"]),
        (lambda: SequenceMatcher(3)(torch.rand(4)), ["scores are (4,)", "(Q,N)"]),
        (lambda: SequenceMatcher(3)(torch.rand(2, 4), torch.rand(3, 4)), ["after (3, 4)", "at most (2,N)"]),
        (lambda: SequenceMatcher(3)(torch.rand(2, 4), torch.rand(2, 5)), ["(2, 4)", "after (2, 5)"]),
    ],
)
def test_settings_that_make_no_sequence_are_refused(make, words):
    with refused(*words):
        make()
