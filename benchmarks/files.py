"""`benchmarks files`: what a file weighs for routes of 300 to 10^6 places, all of it counted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.made import MadeRoute, likeness
from benchmarks.measure import Column, Row, table, write_bench
from dejavu_torch.data.ground_truth import is_right
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Part
from dejavu_torch.evaluation.baselines import as_int8, nearest_frames, quantised_every_kth, stride_bytes
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError

ROAD, SIMULATED, MADE = "road", "simulated", "made"
ROUTES = {300: ROAD, 2697: ROAD, 30_000: SIMULATED, 1_000_000: MADE}  # places, and where they are
SOURCES = {ROAD: "demo:road?stop={places}&traverse={traverse}"}
SOURCES |= {SIMULATED: "sim:aerial?frames={places}&size=96&traverse={traverse}"}
QUERIES, TOLERANCE, STRIDE = 1000, 5, 10
LIKE = 10_000  # places of a simulated route that made descriptors are like
NAMES = {
    "map": "this map",
    "product_quantiser": "product quantiser of every k-th frame",
    "stride": f"int8 of every {STRIDE}th frame",
}
COLUMNS: dict[str, Column] = {
    **{"file, kB": ("bytes", ".0f", 1e3), "of these fixed": ("whitening_bytes", ".0f", 1e3)},
    **{"codebooks": ("codebook_bytes", ".0f", 1e3), "bytes per place": ("bytes_per_place", ".2f")},
    **{"k": ("k", ".0f"), "recall@1": ("recall_at_1", ".3f")},
}


class Seen(NamedTuple):
    """A route as descriptors: places (N,K), queries (Q,K) and the places that these show (Q,); whitening: its
    bytes in a map file, with all else that does not grow."""

    places: Tensor
    queries: Tensor
    shown: Tensor
    whitening: int


def described(kind: str, count: int) -> Seen:
    """A route of so many places, and frames of a second traverse, evenly along it."""
    if kind == MADE:
        like = described(SIMULATED, LIKE)
        route = MadeRoute(likeness(like.places, like.queries, like.shown), count)
        shown = torch.arange(QUERIES) * (count // QUERIES)
        return Seen(route[:], route.seen_again(shown), shown, like.whitening)
    first, second = (open_source(SOURCES[kind].format(places=count, traverse=i)) for i in (0, 1))
    model, step = DejaVu(), max(1, count // QUERIES)
    places, shown = model.descriptor.learn(first, None, True), torch.arange(0, count, step)
    model.learn_features(places, first)
    queries = model.descriptor.all_of(Part(second, range(0, count, step)), True)
    return Seen(places.float(), queries.float(), shown, model.summary().fixed_bytes)


def bench_files(kind: str, count: int) -> Iterator[Row]:
    """A row for each way to store a route at the rate of its map.

    Yields:
        bytes: of the file, all counted. bytes_per_place: those that grow. whitening_bytes, codebook_bytes:
        the others. k: the stride. recall_at_1: of single images, not centred.
    """
    places, queries, shown, whitening = described(kind, count)
    model = DejaVu(whitening="none").learn(places)
    route = model.summary().route_bytes
    coded = quantised_every_kth(places, route / count, TOLERANCE)
    keys = stride_bytes(count, places.shape[1], 1, STRIDE)
    stores = {
        "map": (model.localize_descriptors(queries).index, route, 0, 1),
        "product_quantiser": (
            *(nearest_frames(coded.restored, queries, coded.k, "cosine").index, coded.bytes),
            *(coded.codebooks, coded.k),
        ),
        "stride": (nearest_frames(as_int8(places), queries, STRIDE, "cosine").index, keys, 0, STRIDE),
    }
    for name, (index, growing, codebooks, k) in stores.items():
        found = float(is_right(index, shown[:, None], TOLERANCE).double().mean())
        row: Row = {"case": f"{count} places, {kind}", "contender": name, "places": count, "route": kind}
        row |= {"bytes": whitening + codebooks + growing, "bytes_per_place": growing / count, "k": k}
        yield row | {"whitening_bytes": whitening, "codebook_bytes": codebooks, "recall_at_1": found}


def run_files(*, out: Path, places: Sequence[int] = ()) -> list[str]:
    """The files of routes of 300 to 10^6 places: a map, a product quantiser and int8 frames, all counted.

    Args:
        out: folder for bench.json
        places: some of 300, 2697 (the road of the demo), 30000 (simulated) and 1000000 (made descriptors)
    """
    if unknown := [count for count in places if count not in ROUTES]:
        raise InputError(f"{unknown[0]} places; expected some of {', '.join(map(str, ROUTES))}")
    rows: list[Row] = []
    for count in tqdm(places or list(ROUTES), "routes", disable=None, leave=False):
        rows += bench_files(ROUTES[count], count)
        write_bench(out, rows, tolerance=TOLERANCE)
    return [table(rows, COLUMNS), "whole files; 30,000 places are simulated, 10^6 made"]
