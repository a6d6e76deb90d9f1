"""Backbone and matcher as one exported module: the scores of `DejaVu.forward`, whatever the batch."""

from __future__ import annotations

import io
import math
from fractions import Fraction
from typing import Any

import pytest
import reference
import torch
from helpers import Fixed, refused
from hypothesis import given
from torch import Tensor, nn

from dejavu_torch import CompressedMap, DejaVu, Matcher, PhaseTemplates
from dejavu_torch.recognition.deploy import Localizer
from dejavu_torch.types import FrequencyLayer, Plan

CHUNKS: Plan = (
    FrequencyLayer(Fraction(4), 4, 0, 20, (0, 2)),
    FrequencyLayer(Fraction(5, 2), 3, 5, 25, (0, 1)),
    FrequencyLayer(Fraction(7), 7, 10, 25, (3,)),
    FrequencyLayer(Fraction(7), 7, 30, 50, (1, 2, 3)),
)
UNCOVERED = [*range(25, 30), *range(50, 60)]


def backbone() -> nn.Sequential:
    convolution = nn.Conv2d(1, 4, 3)
    return nn.Sequential(convolution, nn.BatchNorm2d(4), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten())


def pair(**settings: Any) -> tuple[DejaVu, Localizer, Tensor]:
    """A model with a map of several chunks, the same as one module, and the frames it was learnt from."""
    frames = torch.rand(60, 1, 6, 6)
    model = DejaVu(backbone(), Fixed(*CHUNKS), **settings).learn(frames).eval()
    return model, Localizer(model.pipeline, model.map, model.matcher).eval(), frames


def exported(module: nn.Module, frames: Tensor) -> torch.export.ExportedProgram:
    return torch.export.export(module, (frames,), dynamic_shapes={"frames": {0: torch.export.Dim("batch")}})


@pytest.mark.parametrize(
    "settings",
    [
        {"metric": "l1", "reduction": "mean"},
        {"metric": "l1", "reduction": "sum"},
        {"metric": "l2", "reduction": "mean"},
        {"metric": "cosine", "reduction": "sum"},
        {"temperature": 0.1},
    ],
    ids=str,
)
def test_the_exported_scores_are_the_models(settings: dict[str, Any]) -> None:
    model, module, frames = pair(**settings)
    buffer = io.BytesIO()
    program = exported(module, frames[:2])
    torch.export.save(program, buffer)
    buffer.seek(0)
    loaded = torch.export.load(buffer).module()
    for batch in (1, 3, 7):
        query = torch.rand(batch, 1, 6, 6)
        expected = model(query)
        assert expected[:, UNCOVERED].isposinf().all()
        for run in (module, program.module(), loaded):
            scores = run(query)
            assert scores.dtype == torch.float32
            torch.testing.assert_close(scores, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("training", [True, False])
def test_the_weights_of_the_features_count(training: bool) -> None:
    model, module, frames = pair()
    before = model(frames[:5])
    model.map.trainable(weights=True, start=torch.tensor([0.5, 1.0, 2.0, 0.0]))
    if not training:
        model.map.settle()
    expected = model(frames[:5])
    assert not torch.allclose(expected[:, :20], before[:, :20])
    for run in (module, exported(module, frames[:2]).module()):
        torch.testing.assert_close(run(frames[:5]), expected, rtol=0, atol=1e-6)


def test_a_callable_metric_is_exported_too() -> None:
    model, module, frames = pair(metric=lambda a, b: (a[:, None] - b).abs().amax(2))
    run = exported(module, frames[:2]).module()
    torch.testing.assert_close(run(frames[:5]), model(frames[:5]), rtol=0, atol=1e-6)


@given(route=reference.routes())
def test_any_plan_gives_the_matchers_scores(route: reference.Route) -> None:
    values, plan = route
    found = CompressedMap(plan, PhaseTemplates()(values, plan), *values.shape)
    queries = values.flip(0) + 0.1
    for metric, reduction in (("l1", "mean"), ("l1", "sum"), ("l2", "mean"), ("cosine", "mean")):
        matcher = Matcher(metric, reduction)  # type: ignore[arg-type]
        scores = Localizer(nn.Identity(), found, matcher)(queries)
        torch.testing.assert_close(scores, matcher(queries, found), rtol=0, atol=1e-12)


def test_scores_by_hand() -> None:
    plan = (FrequencyLayer(Fraction(2), 2, 0, 4, (0,)), FrequencyLayer(Fraction(3), 3, 2, 6, (0, 1)))
    blocks = (torch.tensor([[1.0], [2.0]]), torch.tensor([[0.0, 10.0], [0.0, 20.0], [0.0, 30.0]]))
    route = CompressedMap(plan, blocks, 7, 2)
    scores = Localizer(nn.Identity(), route, Matcher())(torch.zeros(1, 2))
    torch.testing.assert_close(scores, torch.tensor([[1, 2, 31 / 3, 4, 10, 15, math.inf]]))


def test_convention_10_scores_are_float32_whatever_the_autocast() -> None:
    _, module, frames = pair()
    with torch.autocast("cpu", torch.bfloat16):
        scores = module(frames[:3])
    assert scores.dtype == torch.float32
    torch.testing.assert_close(scores, module(frames[:3]), rtol=0, atol=0.02)  # the backbone is the coarser


def test_convention_10_nothing_of_queries_times_phases_times_features_is_built(largest_tensor: type) -> None:
    queries, phases, features, places = 40, 50, 60, 300
    plan = (FrequencyLayer(Fraction(phases), phases, 0, places, tuple(range(features))),)
    route = CompressedMap(plan, (torch.rand(phases, features),), places, features)
    with largest_tensor() as seen:
        Localizer(nn.Identity(), route, Matcher())(torch.rand(queries, features))
    assert seen.numel <= queries * places < queries * phases * features


def test_the_state_dict_goes_into_another_localizer_of_the_same_plan() -> None:
    _, module, frames = pair()
    _, other, _ = pair()
    assert not torch.equal(other(frames[:3]), module(frames[:3]))
    other.load_state_dict(module.state_dict())
    assert torch.equal(other(frames[:3]), module(frames[:3]))


def test_gradients_reach_the_backbone() -> None:
    _, module, frames = pair()
    scores = module(frames[:3])
    scores[scores.isfinite()].sum().backward()
    for parameter in module.parameters():
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0


def test_a_map_without_layers_is_refused() -> None:
    with refused("20 places", "no layers", "at least one"):
        Localizer(nn.Identity(), CompressedMap((), (), 20, 4), Matcher())


@pytest.mark.parametrize("shape", [(3, 5), (3, 4, 1), (4,)])
def test_features_of_another_dimension_are_refused(shape: tuple[int, ...]) -> None:
    _, module, _ = pair()
    module.pipeline = nn.Identity()
    with refused(str(shape), "(B, 4)"):
        module(torch.rand(shape))
