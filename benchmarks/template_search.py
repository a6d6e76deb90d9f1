"""The best place on long template maps, searched in their layers and by the scores of all places."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial

import torch
from torch import Tensor

from benchmarks.measure import Contender, Row, benchmark, in_one_thread
from dejavu_torch.maps.layer_search import lowest
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import FrequencyLayer, InputError

PLACES = (10**4, 10**5, 10**6, 10**7)
FEATURES = 64  # of each layer
QUERIES = 8
REPEATS = 5
OURS, SCAN = "dejavu two layers", "scan"


def bench_templates(
    places: Sequence[int] = PLACES, queries: int = QUERIES, repeats: int = REPEATS, seed: int = 0
) -> Iterator[list[Row]]:
    """Time the best place of single queries on maps of two layers; the rows of a size at a time.

    Args:
        places: N of each map. queries: matched one behind the other. repeats: of which the best counts.
        seed: of the templates and queries.

    Convention: seconds, those of the first run too, are of a single query, in one thread, with its distances
        to all templates. `file_bytes` are what grows of the map's file: the templates and their layers.

    Raises:
        InputError: fewer than 4 places, or a number below 1.
    """
    if min(places, default=4) < 4 or min(queries, repeats) < 1:
        raise InputError(
            f"template search got places={tuple(places)}, queries={queries} and repeats={repeats}; expected "
            "at least 4 places and 1 of the others"
        )
    generator = torch.Generator().manual_seed(seed)
    for count in places:
        yield list(_case(random_map(count, generator), queries, repeats, generator))


def random_map(places: int, generator: torch.Generator) -> TemplateMap:
    """Random templates of two co-prime periods, the least that tell so many places apart."""
    short = math.isqrt(places)
    short += short * (short + 1) < places
    plan, blocks = [], []
    for k, period in enumerate((short, short + 1)):
        features = tuple(range(k * FEATURES, (k + 1) * FEATURES))
        plan.append(FrequencyLayer(Fraction(period), period, 0, places, features))
        blocks.append(torch.rand(period, FEATURES, generator=generator))
    return TemplateMap(tuple(plan), blocks, places, 2 * FEATURES)


def _case(route: TemplateMap, queries: int, repeats: int, generator: torch.Generator) -> Iterator[Row]:
    asked = torch.rand(queries, route.dimension, generator=generator).split(1)

    def in_layers(query: Tensor) -> Tensor:
        one, other = route.distances(query)
        return lowest(one, other, route.places, route.divisor([0, 1]))[1]

    def scan(query: Tensor) -> Tensor:
        return best_match(route.scores(query)).index

    def each(found: Callable[[Tensor], Tensor]) -> Tensor:
        return torch.cat([found(query) for query in asked])

    contenders = [
        Contender(name, partial(in_one_thread, partial(each, found)))
        for name, found in ((OURS, in_layers), (SCAN, scan))
    ]
    with torch.no_grad():
        rows = benchmark(f"templates={route.places}", contenders, repeats)
    for row in rows:
        single = {key: row[key] and row[key] / queries for key in ("seconds", "seconds_first")}
        yield row | single | {"file_bytes": route.summary().route_bytes}
