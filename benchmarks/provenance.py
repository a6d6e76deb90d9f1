"""`benchmarks provenance`: by what queries of a map's own drive, and of other networks, are told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import ROUTES
from benchmarks.measure import Column, Row, new_row, table, write_bench
from benchmarks.trainings import Route, road
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Part, kept
from dejavu_torch.features.descriptor import is_ready
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.maps.digest import digests_of
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.provenance import Spread, alike, relation
from dejavu_torch.types import Traverse

VISIT, FAST, PART = "second visit", "every third frame of it", "a third of it"
OWN, BETWEEN = "every third of the map's frames", "odd frames on a map of the even ones"
NETWORK = "another network"
NUMBERS = 256  # of a descriptor of each network
KEYS = ("chosen", "places", "same", "beyond", "both", "steady", "correlation", "told")
COLUMNS: dict[str, Column] = {
    **{
        "equal": ("same", ".2f"),
        "signs beyond": ("beyond", ".2f"),
        "of differing": ("both", ".2f"),
        "parts": ("steady", ".2f"),
    },
    "means": ("correlation", ".2f"),
}
LAPS = "{data}/rc_car_laps/frames?start="
PAIRS: dict[str, Route] = {
    **{name: route for name, (route, _) in ROUTES.items()},
    **{"road, first half": road("&stop=1348"), "road, second half": road("&start=1348")},
    "laps of another car": Route(LAPS + "194&stop=590", LAPS + "590&stop=986"),
    **{
        f"sim:{kind}": Route(f"sim:{kind}?seed=1&stop=1000", f"sim:{kind}?seed=1&traverse=1&stop=1000")
        for kind in ("aerial", "outdoor", "underground")
    },
}


def run_provenance(data: Path, *, out: Path) -> list[str]:
    """By what queries of a map's own drive, and descriptors of other networks, are told from second visits.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
    """
    rows: list[Row] = []
    for i, (name, route) in enumerate(tqdm(PAIRS.items(), "provenance", disable=None, leave=False)):
        rows += [row | {"chosen": i % 2 == 0} for row in bench_route(name, route.below(data))]
        write_bench(out, rows)
    parts = [[row for row in rows if row["chosen"] == chosen] for chosen in (True, False)]
    return [*(table(part, COLUMNS) for part in parts), "thresholds were chosen on the first table"]


def bench_route(name: str, route: Route) -> Iterator[Row]:
    """Rows of a route: a second visit as it is and cut, the map's own frames, and other networks.

    Yields:
        places, same, beyond, both: see `Alike`, same as a share of them. steady, correlation: of ready
        descriptors or, for other networks, of what each makes of the frames. told: what is said.
    """
    reference, query = (kept(open_source(one)) for one in (route.reference, route.query))
    model = DejaVu().learn(reference)
    rows = described(model, query)
    third = len(rows) // 3
    asked = {VISIT: rows, FAST: rows[::3], PART: rows[third : 2 * third]}
    asked[OWN] = described(model, reference)[1::3]
    for contender, some in asked.items():
        yield new_row(name, contender, KEYS) | related(model, some)
    if is_ready(reference):
        yield new_row(name, VISIT, KEYS) | spread(reference, query)
    even, odd = (Part(reference, range(i, len(reference), 2)) for i in (0, 1))
    model = DejaVu().learn(kept(even))
    yield new_row(name, BETWEEN, KEYS) | related(model, described(model, odd))
    if not is_ready(reference):
        made = [networks(one) for one in (reference, query)]
        for one in made[0]:
            yield new_row(name, f"{VISIT}, {one}", KEYS) | spread(made[0][one], made[1][one])
            for other in made[0].keys() - {one}:
                row = spread(made[0][one], made[1][other])
                yield new_row(name, f"{NETWORK}, {other} on {one}", KEYS) | row


def described(model: DejaVu, traverse: Traverse) -> Tensor:
    return model.descriptor.all_of(model.at_map_size(traverse, model.frame_shape)).float()


def related(model: DejaVu, queries: Tensor) -> Row:
    asked = digests_of(queries, follow=False)
    places, same, beyond, both = alike(model.map.digest, asked)
    told = relation(model.map, model.map.digest, asked)
    shares = {"same": same / max(1, places), "beyond": beyond, "both": both}
    return {"places": places, **shares, "told": told}


def spread(reference: Traverse, query: Traverse) -> Row:
    one, other = Spread.of(reference), Spread.of(query)
    if one is None or other is None:
        return {}
    told = "unlike" if one.unlike(other) else ""
    return {"steady": one.steady, "correlation": one.correlation(other), "told": told}


def networks(traverse: Traverse) -> dict[str, ArrayTraverse]:
    """Ready descriptors of a traverse by three networks, each drawn to as many numbers."""
    found = {}
    for name, features in (("HOG", HOG()), ("distilled", Distilled()), ("pixels", PatchPixels())):
        model = DejaVu(features, "none")
        rows = model.descriptor.all_of(model.at_map_size(traverse)).float()
        drawn = torch.randn(rows.shape[1], NUMBERS, generator=torch.Generator().manual_seed(len(name)))
        found[name] = ArrayTraverse(torch.nn.functional.normalize(rows @ drawn), name)
    return found
