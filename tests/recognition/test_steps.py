"""A query at a time gives what a sequence or a filter gives of all."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused
from torch import Tensor

from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.recognition.steps import FilterStep, SequenceStep, step_of
from dejavu_torch.types import SequenceModel

MODELS = {
    "one": SequenceMatcher(1),
    "two": SequenceMatcher(2),
    "eleven": SequenceMatcher(11),
    "speeds": SequenceMatcher(5, (1, 0.75, 2.5)),
    "backwards": SequenceMatcher(7, (-1, 0)),
    "filter": PlaceFilter(),
    "filter alone": PlaceFilter(within=0, moves=(0.5, 0.0, 0.25, 0.25), jump=0.05, off_map=2.0),
}


def drive(kind: str, queries: int = 30, places: int = 25) -> Tensor:
    """Scores of queries that pass places 3, 4, .., some of which are not covered."""
    scores = torch.rand(queries, places)
    scores[torch.arange(queries), (torch.arange(queries) + 3) % places] -= 0.5
    if kind == "gaps":
        scores[:, 7:9] = math.inf
        scores[4], scores[20, ::2] = math.inf, math.inf
    if kind == "flat":
        scores[:3] = 1
    return scores


def stepwise(model: SequenceModel, scores: Tensor) -> Tensor:
    step, found = step_of(model), []
    state = step.start(scores.shape[1])
    for row in scores:
        together, state = step(row, state)
        found.append(together)
    return torch.stack(found)


@pytest.mark.parametrize("kind", ["covered", "gaps", "flat"])
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_steps_are_the_stream(model: SequenceModel, kind: str) -> None:
    scores = drive(kind)
    with torch.no_grad():
        (expected,) = model.stream([scores])
        torch.testing.assert_close(stepwise(model, scores), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("model", [SequenceMatcher(3), PlaceFilter()], ids=["sequence", "filter"])
def test_a_row_of_scores_may_be_of_two_dimensions(model: SequenceModel) -> None:
    step, scores = step_of(model), torch.rand(9)
    flat, state = step(scores, step.start(9))
    row, same = step(scores[None], step.start(9))
    assert row.shape == (1, 9)
    torch.testing.assert_close(row[0], flat)
    torch.testing.assert_close(state, same, equal_nan=True)


def test_the_state_of_a_filter_is_its_posterior() -> None:
    scores, model = drive("covered"), PlaceFilter()
    step = FilterStep(model)
    state = step.start(25)
    with torch.no_grad():
        for row, expected in zip(scores, model.posterior(scores), strict=True):
            _, state = step(row, state)
            torch.testing.assert_close(state, expected)


@pytest.mark.parametrize("model", [SequenceMatcher(4), PlaceFilter()], ids=["sequence", "filter"])
def test_steps_are_exported(model: SequenceModel) -> None:
    scores, step = drive("gaps", queries=21), step_of(model).eval()
    state = step.start(25)
    run = torch.export.export(step, (scores[0], state)).module()
    for row in scores:
        expected, after = step(row, state)
        found, own = run(row, state)
        torch.testing.assert_close(found, expected)
        torch.testing.assert_close(own, after, equal_nan=True)
        state = after


def test_gradients_reach_scores_and_settings() -> None:
    scores, model = drive("covered").requires_grad_(), PlaceFilter()
    stepwise(model, scores).amin(1).sum().backward()
    assert scores.grad is not None
    assert scores.grad.isfinite().all()
    assert scores.grad[0].abs().sum() > 0  # through the state
    assert model.log_sharpness.grad is not None
    assert model.log_sharpness.grad.isfinite()


def test_what_does_not_fit_is_refused() -> None:
    sequence, filter = SequenceStep(SequenceMatcher(3)), FilterStep(PlaceFilter())
    for step in (sequence, filter):
        for scores in (torch.rand(2, 9), torch.zeros(9, dtype=torch.int64), torch.zeros(())):
            with refused("expected floats (N,) or (1,N)"):
                step(scores, step.start(9))
    with refused("(2, 8)", "(2, 9)"):
        sequence(torch.rand(9), sequence.start(8))
    with refused("(9,)", "(10,)"):
        filter(torch.rand(9), filter.start(8))
    with refused("10 places", "map of 9"):
        SequenceStep(SequenceMatcher(11))(torch.rand(9), torch.rand(10, 9))
    with refused("expected a SequenceMatcher or a PlaceFilter"):
        step_of(torch.nn.Identity())  # type: ignore[arg-type]
