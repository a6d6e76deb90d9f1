"""`benchmarks order`: in which order the answers of single images should be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import ROUTES as DRIVES
from benchmarks.measure import Row, some_of, table, truth_of, write_bench
from benchmarks.results import FOOTAGE
from benchmarks.trainings import Route, drive
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.curves import area, by_confidence, curve_of, recall_at_precision
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.calibration import best_pair
from dejavu_torch.recognition.centring import centred
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import Match

BEYOND = 20  # places elsewhere whose mean score is compared with
WEIGHTS = (0.5, 2.0, 4.0)  # of the margin
POWERS = (0.5, 0.75, 1.0)  # of the best score elsewhere; `POWER` was chosen among them


def confidences(best: Tensor, other: Tensor, some: Tensor) -> dict[str, Tensor]:
    """By name from the best scores (Q,), the best ones elsewhere and the means of `BEYOND` elsewhere."""
    return {
        "score": -best,
        "margin": other - best,
        **{f"{weight:g} margin - score": weight * (other - best) - best for weight in WEIGHTS},
        **{f"score / elsewhere^{power:g}": -best / other.clamp(min=1e-12) ** power for power in POWERS},
        "mean of twenty elsewhere - score": some - best,
    }


def simulated(kind: str, seed: int) -> Route:
    source = f"sim:{kind}?seed={seed}"
    return Route(source, f"{source}&traverse=1", 5)


def road(half: str) -> Route:
    footage = FOOTAGE[f"road, {half} half"]
    return Route(footage.reference, footage.query, 5)


KNOWN = {name: route for name, (route, _) in DRIVES.items()}
CHOSEN = {  # half of the routes, of each kind, to choose on
    **{name: KNOWN[name] for name in ("city 2", "city 3", "railway, second half", "lidar", "floors")},
    **{"wifi": drive("wifi_mall", 0), "road, second half": road("second")},
    **{f"sim:{kind}, seed 4": simulated(kind, 4) for kind in ("aerial", "outdoor", "underground")},
}
REPORTED = {
    **{name: KNOWN[name] for name in ("city 1", "laps", "corridor", "railway, first half")},
    **{name: KNOWN[name] for name in ("magnetometer", "gardens")},
    **{"corridor laps": drive("corridor_laps", 0), "road, first half": road("first")},
    **{f"sim:{kind}, seed 3": simulated(kind, 3) for kind in ("aerial", "outdoor", "underground")},
}
HALVES = {"chosen on": CHOSEN, "reported": REPORTED}


@torch.no_grad()
def ordered(place_map: PlaceMap, queries: Tensor) -> Iterator[tuple[str, Match]]:
    """The answers of single queries (Q,K) by each order, with its confidence."""
    found = []
    for part in queries.split(256):
        scores = place_map.scores(part)
        pair = best_pair(scores)
        beyond = best_candidates(scores, 1, 0).index  # the places around it are no answers
        far = (torch.arange(place_map.places) - beyond).abs() > 5
        some = scores.masked_fill(~far, torch.inf).topk(min(BEYOND, int(far.sum(1).min())), largest=False)
        found.append((pair.index[:, 0], pair.score[:, 0], pair.score[:, 1], some.values.mean(1)))
    index, best, other, some_mean = map(torch.cat, zip(*found, strict=True))
    for name, confidence in confidences(best, other, some_mean).items():
        yield name, Match(index, best, best.isfinite(), confidence=confidence)


def bench_order(half: str, name: str, route: Route) -> Iterator[Row]:
    """A row for each order of the answers on the default map of a route, its queries centred.

    Yields:
        auc, recall_at_99_precision: by that order.
    """
    reference, query = open_source(route.reference), open_source(route.query)
    model = DejaVu().learn(reference)
    queries = model.descriptor.all_of(query).float()
    queries = centred(model.map, queries) if model.centres(len(queries)) else queries
    truth = truth_of(reference, query, route.truth)
    for order, match in ordered(model.map, queries):
        curve = curve_of(by_confidence(match), truth, route.tolerance)
        figures = {"auc": area(curve), "recall_at_99_precision": recall_at_precision(curve, 0.99)}
        yield {"case": name, "contender": order, "half": half} | figures


def gains(rows: Sequence[Row]) -> list[Row]:
    """For each half and order the mean gain over the score, and the worst of a route."""
    figures, found = ("auc", "recall_at_99_precision"), []
    base = {row["case"]: row for row in rows if row["contender"] == "score"}
    for half in HALVES:
        for order in dict.fromkeys(row["contender"] for row in rows):
            own = [row for row in rows if (row["half"], row["contender"]) == (half, order)]
            row: Row = {"case": half, "contender": order}
            for key in figures if own else ():
                each = [one[key] - base[one["case"]][key] for one in own]
                row |= {key: mean(each), f"worst_{key}": min(each)}
            found += [row] if own else []
    return found


COLUMNS = {
    **{"AUC": ("auc", "+.3f"), "worst": ("worst_auc", "+.3f")},
    **{
        "R@99P": ("recall_at_99_precision", "+.3f"),
        "worst of these": ("worst_recall_at_99_precision", "+.3f"),
    },
}


def run_order(data: Path, *, out: Path, routes: Sequence[str] = ()) -> list[str]:
    """Single answers in the order of their scores, and of what these are beside the best places elsewhere.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes; all if not given
    """
    known = CHOSEN | REPORTED
    some = some_of(known, routes)
    planned = [(half, name) for half, own in HALVES.items() for name in own if name in some]
    rows: list[Row] = []
    for half, name in tqdm(planned, "routes", disable=None, leave=False):
        rows += bench_order(half, name, known[name].below(data))
        write_bench(out, rows)
    return [table(gains(rows), COLUMNS), "means of what each order gains over the score"]
