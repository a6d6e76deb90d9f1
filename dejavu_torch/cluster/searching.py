"""The best places of queries on a map whose parts are on the workers of a cluster."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.cluster.session import RETRIES, Cluster, error_line
from dejavu_torch.maps.merged import MergedMap
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral import CodedChunk, SpectralMap
from dejavu_torch.recognition.search import SCORES_AT_ONCE, Best, empty_topk, merge_topk, with_block
from dejavu_torch.types import InputError


class Part(NamedTuple):
    """Chunks of a spectral map that follow each other, as they go to a worker.

    start: the place of the whole map that comes first. chunks, mean, settings: as of `SpectralMap.of_chunks`.
    audible, compiled: of the map that they are of.
    """

    start: int
    chunks: list[CodedChunk]
    mean: Tensor
    settings: dict[str, Any]
    audible: float
    compiled: bool

    @property
    def places(self) -> int:
        """How many there are."""
        return sum(chunk.places for chunk in self.chunks)


class ClusterSearcher:
    """As `search`, parts of the map being decoded and scored by one worker each.

    Args:
        cluster: its workers hold the parts; one that dies is started again. route: a spectral map, or one
            merged of several.

    Shape: queries (Q,K), n -> (Q,n) scores and places.

    Convention: scores are those of a scan here, to the bit, since parts begin where its blocks do; so are the
        places, ties included.

    Raises:
        InputError: a map of another kind; a worker that does not come back.
    """

    def __init__(self, cluster: Cluster, route: PlaceMap) -> None:
        self.cluster = cluster
        self.maps = _maps(route)
        sizes = [0] * cluster.workers
        dealt: list[list[tuple[int, Part]]] = [[] for _ in sizes]
        most = -(-route.places // cluster.workers)
        first = 0
        for number, one in enumerate(self.maps):
            for part in _parts(one, most, first):
                least = sizes.index(min(sizes))
                dealt[least].append((number, part))
                sizes[least] += part.places
            first += one.places
        ray = cluster.ray
        actor = ray.remote(num_cpus=1, max_restarts=RETRIES, max_task_retries=RETRIES)(_Worker)
        self.sent = [[ray.put(parts)] for parts in dealt if parts]
        self.actors = [actor.remote() for _ in self.sent]

    @torch.no_grad()
    def __call__(self, queries: Tensor, n: int) -> Best:
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        found = []
        longest = max(one.block_places for one in self.maps)
        for some in queries.split(max(1, SCORES_AT_ONCE // longest)):
            ways = [one.rebuilds(len(some)) for one in self.maps]
            try:
                pairs = zip(self.actors, self.sent, strict=True)
                asked = [actor.best.remote(sent, some.numpy(), n, ways) for actor, sent in pairs]
                answers = self.cluster.ray.get(asked)
            except self.cluster.ray.exceptions.RayError as error:
                seen = f"a worker died with its part of the map ({error_line(error)})"
                raise InputError(f"{seen}; expected workers that live, and memory for it") from error
            parts = (
                (torch.from_numpy(score.copy()), torch.from_numpy(place.copy())) for score, place in answers
            )
            found.append(reduce(merge_topk, parts))
        score, place = map(torch.cat, zip(*found, strict=True))
        return score, place


class _Worker:
    """Holds parts of maps: each with the number of the map that it is of."""

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self.parts: list[tuple[int, int, SpectralMap]] = []

    def process(self) -> int:
        """The number of this process."""
        return os.getpid()

    @torch.no_grad()
    def best(self, sent: list[Any], queries: Any, n: int, rebuild: list[bool]) -> tuple[Any, Any]:
        """The n best places on the parts that were sent, the same ones each time: scores and places.

        Args:
            rebuild: of each map, see `SpectralMap.score_blocks`.
        """
        if not self.parts:  # or the worker was started again
            import ray

            self.parts = [(number, part.start, _map_of(part)) for number, part in ray.get(sent[0])]
        some = torch.from_numpy(queries.copy())
        found = empty_topk(some, n)
        for number, first, route in self.parts:
            for start, scores in route.score_blocks(some, rebuild=rebuild[number]):
                found = with_block(found, scores, first + start)
        return found[0].numpy(), found[1].numpy()


def _map_of(part: Part) -> SpectralMap:
    route = SpectralMap.of_chunks(part.chunks, part.mean, **part.settings)
    route.audible, route.compiled = part.audible, part.compiled
    return route


def _maps(route: PlaceMap) -> list[SpectralMap]:
    """The spectral maps that a map is, one behind the other."""
    if isinstance(route, MergedMap):
        return [part for name in route.names for part in _maps(route.part(name))]
    if not isinstance(route, SpectralMap):
        raise InputError(
            f"a map of kind {route.kind!r} is not divided among workers; expected a spectral one"
        )
    return [route]


def _parts(route: SpectralMap, most: int, first: int) -> Iterator[Part]:
    """Parts of about `most` places at most, divided where the blocks of a scan are."""
    coded, settings, mean = route.coded(), route.settings(), route.mean.cpu()
    held: list[CodedChunk] = []
    for run in route.runs(range(len(coded)), route.dimension):
        block = coded[run.start : run.stop]
        if held and sum(one.places for one in [*held, *block]) > most:
            yield Part(first, held, mean, settings, route.audible, route.compiled)
            first += sum(one.places for one in held)
            held = []
        held = held + block
    yield Part(first, held, mean, settings, route.audible, route.compiled)
