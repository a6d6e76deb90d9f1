"""The best place on long template maps, by a search in their layers and by the scores of all places."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial

import torch
from torch import Tensor

from benchmarks.layer_search import lowest
from benchmarks.measure import Contender, Row, benchmark
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import FrequencyLayer

PLACES = (10**4, 10**5, 10**6, 10**7)
FEATURES = 64  # of each layer
OURS, SCAN = "dejavu two layers", "scan"


def bench_templates(places: Sequence[int], queries: int = 8, repeats: int = 5) -> Iterator[Row]:
    """Time the best place of single queries on maps of two layers, a row at a time.

    Convention: seconds, also of the first run, are of a single query in one thread, including its distances
        to all templates. `file_bytes` are those that grow with the map: the templates and their layers.
    """
    generator = torch.Generator().manual_seed(0)
    for count in places:
        route = random_map(count, generator)
        asked = torch.rand(queries, route.dimension, generator=generator).split(1)
        contenders = [
            Contender(name, partial(partial, each, partial(find, route), asked))
            for name, find in ((OURS, lambda *given: in_layers(*given)[1]), (SCAN, scan))
        ]
        with torch.no_grad():
            rows = benchmark(f"templates={count}", contenders, repeats)
        for row in rows:
            single = {key: row[key] and row[key] / queries for key in ("seconds", "seconds_first")}
            yield row | single | {"file_bytes": route.summary().route_bytes}


def random_map(places: int, generator: torch.Generator) -> TemplateMap:
    """Random templates of two co-prime periods, the smallest that distinguish this many places."""
    short = math.isqrt(places)
    short += short * (short + 1) < places
    plan, blocks = [], []
    for k, period in enumerate((short, short + 1)):
        features = tuple(range(k * FEATURES, (k + 1) * FEATURES))
        plan.append(FrequencyLayer(Fraction(period), period, 0, places, features))
        blocks.append(torch.rand(period, FEATURES, generator=generator))
    return TemplateMap(tuple(plan), blocks, places, 2 * FEATURES)


def in_layers(route: TemplateMap, queries: Tensor) -> tuple[Tensor, Tensor]:
    """The lowest score of each query and its first place, -1 if none is finite, on a map of two layers that
    cover the same places."""
    ((start, stop),) = {(layer.start, layer.stop) for layer in route.plan}
    pairs = zip(route.distances(queries), route.lap_phases.split(route.laps), strict=True)
    one, other = (distances.index_select(1, lap) for distances, lap in pairs)
    score, place = lowest(one, other, stop - start, route.divisor([0, 1]))
    return score, torch.where(score.isfinite(), start + place, -1)


def scan(route: TemplateMap, query: Tensor) -> Tensor:
    return best_match(route.scores(query)).index


def each(find: Callable[[Tensor], Tensor], queries: Sequence[Tensor]) -> Tensor:
    return torch.cat([find(query) for query in queries])
