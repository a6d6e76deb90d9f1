"""The best place, found in the layers of a map, is that of a scan: bit for bit, the first of equal ones."""

from __future__ import annotations

import random
from fractions import Fraction
from unittest.mock import patch

import torch

from benchmarks import layer_search
from benchmarks.template_search import in_layers
from dejavu_torch import FrequencyLayer, TemplateMap
from dejavu_torch.recognition.select import best_match


def random_values(draw, generator, *shape):
    """Many equal ones, sums that are equal once rounded, or neither."""
    kind = draw.choice(["few", "rounded", "any", "flat"])
    if kind == "few":
        return torch.randint(0, 3, shape, generator=generator).float()
    if kind == "rounded":
        small = 1e-4 * torch.rand(shape, generator=generator)
        return small + 1000.0 * torch.randint(0, 3, shape, generator=generator)
    return torch.ones(shape) if kind == "flat" else torch.rand(shape, generator=generator)


def random_map(draw, generator):
    """Two layers, whose periods share any factor or are equal, over a part of the route or all of it."""
    start, factor = draw.choice([0, 0, 1, 7, 30]), draw.choice([1, 1, 2, 3, 6])
    stop = start + factor * 14 + draw.choice([draw.randint(1, 60), draw.randint(60, 1200)])
    plan = []
    for _ in range(2):
        period = Fraction(factor * draw.randint(1, 14), draw.choice([1, 1, 1, 2, 5]))
        phases = draw.choice([period.numerator, period.numerator, 1, 4])
        some = tuple(sorted(draw.sample(range(3), draw.randint(1, 3))))
        plan.append(FrequencyLayer(period, phases, start, stop, some))
    blocks = [random_values(draw, generator, layer.phases, len(layer.features)) for layer in plan]
    metric, reduction = draw.choice(["l1", "l2"]), draw.choice(["sum", "mean"])
    return TemplateMap(tuple(plan), blocks, stop + draw.choice([0, 0, 5]), 3, metric, reduction)


def check(route, queries):
    found, expected = in_layers(route, queries), best_match(route.scores(queries))
    assert torch.equal(found[0], expected.score)
    assert torch.equal(found[1], expected.index)


def test_equals_the_scan_in_random_cases():
    for seed in range(3):
        draw, generator = random.Random(seed), torch.Generator().manual_seed(seed)
        for _ in range(300):
            route = random_map(draw, generator)
            with patch.object(layer_search, "AHEAD", draw.choice([1, 7, 4096])):
                check(route, random_values(draw, generator, draw.randint(1, 5), 3))
