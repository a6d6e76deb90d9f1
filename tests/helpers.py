"""What several test files need."""

from __future__ import annotations

from contextlib import contextmanager

import pytest
import torch

from dejavu_torch import learning
from dejavu_torch.features import descriptor, views
from dejavu_torch.maps.template_map import TemplateMap, TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.types import FrequencyLayer, InputError


@contextmanager
def refused(*words):
    """The block is refused in one line that holds these words."""
    with pytest.raises(InputError) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message


def streamed(model, batches):
    """`step` over consecutive batches of scores (B,N)."""
    state = None
    for scores in batches:
        state = model.start(scores.shape[1]) if state is None else state
        found, state = model.step(scores, state)
        yield found


def long_from(monkeypatch, frames):
    """Routes of more frames are learned from a sample, chunk by chunk."""
    for module in (views, descriptor, learning):
        monkeypatch.setattr(module, "SAMPLE", frames)
    monkeypatch.setattr(views, "OF_AREA", frames)
    monkeypatch.setattr(learning, "LARGE", frames)


def all_of(traverse, batch=64):
    return torch.cat(list(traverse.batches(batch)))


class Fixed(PeriodFinder):
    """Layers that are known beforehand."""

    def __init__(self, *layers: FrequencyLayer) -> None:
        super().__init__()
        self.layers = layers

    def plan(self, features):
        return self.layers


def scored(queries, route, metric="l1", reduction="mean", temperature=None):
    """Scores of the layers and templates of a map with other settings."""
    settings = metric, reduction, temperature
    weights = route.weights if len(route.weights) else None
    other = TemplateMap(route.plan, route.blocks(), route.places, route.dimension, *settings, weights)  # type: ignore[arg-type]
    return other.scores(queries)


def template_model(features=None, periods=None, metric="l1", reduction="mean", temperature=None, **settings):
    """A model whose map is of templates, with what its mapper is told beside the model's own settings."""
    mapper = TemplateMapper(periods, metric, reduction, temperature)  # type: ignore[arg-type]
    return DejaVu(features, mapper=mapper, **settings)  # type: ignore[arg-type]
