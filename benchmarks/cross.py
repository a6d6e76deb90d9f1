"""`benchmarks cross`: the map of every route asked by a drive over every route."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.areas import RADIUS, STRIDE, flight
from benchmarks.drives import AS_IT_WAS, HALF, Known, asked, drives_of
from benchmarks.measure import Row, truth_of, write_bench
from benchmarks.trainings import ROAD
from dejavu_torch.data.demo import open_area
from dejavu_torch.data.grid import Grid
from dejavu_torch.data.ground_truth import GroundTruth, all_judged, widened
from dejavu_torch.data.simulate.terrain import open_terrain
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Part, fitted
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.rejection import calibration_error, judged
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.growth import calibrate_if_possible, merge
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.centring import centred
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.taken import NATS, PER_QUERY, STANDS_OUT
from dejavu_torch.recognition.views import Views
from dejavu_torch.types import InputError, Match, SequenceModel, Traverse

ASKED = 400  # queries of a drive over another route, from its middle
SHARES = (0.5, 0.9, 0.99)
HALF_AS_LONG = "half as long"
FEW = 20  # answers, of fewer of which no share of right ones is told
CUTS = (
    *(AS_IT_WAS, HALF_AS_LONG, "a third of the speed", "three times the speed", "reversed", "there and back"),
    *("stretches of 5 to 40, others between", HALF),
)
WAYS = ("drive", "filter", "one")
CHOSEN = (
    "road",
    "railway",
    "city",
    "sim:aerial",
    "area",
)  # begin the names of footage that `--choose` looks at
OWN, SHARED, REPEATED, KIND, OTHER = (
    *("own", "shares ground", "the road's other half", "another route of the kind", "another kind"),
)


class Footage(NamedTuple):
    """Two traverses; {data} is the folder of the footage.

    truth: as of `find_ground_truth`; None: frame i shows place i, or what the sources tell. ground, kind:
    footage of one ground shares places, and of one kind looks alike. features: those with the same name can
    be asked on each other's maps. part: which half of its places is the route.
    """

    reference: str
    query: str
    tolerance: int
    truth: str | None
    ground: str
    kind: str
    features: str = "images"
    part: int | None = None


def filmed(name: str, tolerance: int, ground: str, kind: str) -> Footage:
    first, second, truth = (f"{{data}}/{name}/{file}" for file in ("reference.npy", "query.npy", "truth.csv"))
    return Footage(first, second, tolerance, truth, ground, kind)


def halves(name: str, tolerance: int, truth: str | None = "truth.csv") -> dict[str, Footage]:
    """The two halves of a route of features, which no other route has."""
    one = filmed(name, tolerance, name, name)._replace(truth=truth and f"{{data}}/{name}/{truth}")
    parts = (one._replace(features=name, ground=f"{name}, {i}", part=i) for i in (0, 1))
    return dict(zip((f"{name}, first half", f"{name}, second half"), parts, strict=True))


def road(part: str) -> Footage:
    first, second = (ROAD.format(i, part).format(data="{data}") for i in (1, 2))
    return Footage(first, second, 5, None, f"road{part}", "road from above")


def railway(part: str) -> Footage:
    first, second = (f"{{data}}/nordland/{season}?{part}" for season in ("summer", "winter"))
    return Footage(first, second, 1, "0", f"railway {part}", "railway")


def simulated(kind: str, seed: int) -> Footage:
    first, second = (f"sim:{kind}?seed={seed}&traverse={i}&stop=1000" for i in (0, 1))
    return Footage(first, second, 5, None, f"sim:{kind}, {seed}", f"sim:{kind}")


LAPS = "{data}/rc_car_laps/frames?start="
# seen once: every other frame is asked by those between
MOTORWAY = "{data}/highway/solidWhiteRight.mp4?width=160&stop=220&step=2&start="
FOOTAGE = {
    "road, first half": road("&stop=1348"),
    "road, second half": road("&start=1348"),
    "railway, first half": railway("stop=900"),
    "railway, second half": railway("start=900"),
    **{f"city {i}": filmed(f"robotcar/{t}", 2, "city", "city") for i, t in enumerate(("t1", "t2", "t5"), 1)},
    "laps": filmed("donkey_lap", 10, "mat", "mat"),
    "laps of another car": Footage(LAPS + "194&stop=590", LAPS + "590&stop=986", 20, None, "mat", "mat"),
    "motorway": Footage(MOTORWAY + "0", MOTORWAY + "1", 5, None, "motorway", "motorway"),
    "corridor": Footage(
        "{data}/corridor/ref",
        "{data}/corridor/query",
        0,
        "{data}/corridor/truth.csv",
        "corridor",
        "corridor",
    ),
    "corridor laps": filmed("corridor_laps", 0, "corridor laps", "corridor"),
    "floors": filmed("floors_rejection", 1, "floors", "corridor"),
    **{
        f"sim:{kind}, seed {seed}": simulated(kind, seed)
        for kind in ("aerial", "outdoor", "underground")
        for seed in (1, 2)
    },
    **halves("gardens_night_hdc", 1, None),
    **halves("wifi_mall", 0),
    **halves("magnetic_laps", 5),
    **halves("lidar_fhw", 1),
}

METRES = 80  # of simulated ground
# windows of a flight at a stride
AREAS: dict[str, Callable[[int, int], Grid]] = {
    "area of the road, first half": lambda flight, stride: open_area(flight, stride=stride, columns="0:1396"),
    "area of the road, second half": lambda flight, stride: open_area(
        flight, stride=stride, columns="1396:2792"
    ),
    "simulated ground": lambda flight, stride: open_terrain(1, flight, METRES, stride=stride),
}
MERGED = "a merged map"
PARTS_OF_MERGED = ("city 1", "laps")
MAPS = (*FOOTAGE, *AREAS, MERGED)


class Board(NamedTuple):
    """A map, the routes that it shows, and the drive over its own ground: descriptors of all views of its
    queries, (Q, V x K), and truth."""

    model: DejaVu
    shows: tuple[str, ...]
    queries: Tensor
    truth: GroundTruth
    tolerance: int


def run_cross(
    data: Path,
    *,
    out: Path,
    maps: Sequence[str] = (),
    seed: int = 0,
    choose: bool = False,
    rate: float | None = None,
) -> list[str]:
    """The map of every route asked by a drive over every route: which are taken for a drive of the map?

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        maps: names of those that are asked; all if not given
        seed: of the stretches in random order
        choose: print where a drive is best told from others by its single images and by its motion, on some
            of the footage, for the constants of `recognition.taken`
        rate: bytes per place of the maps' lines, instead of the default
    """
    if unknown := [name for name in maps if name not in MAPS]:
        raise InputError(f"{unknown[0]!r} is no map; expected one of {', '.join(map(repr, MAPS))}")
    rows: list[Row] = []
    for name in tqdm(maps or MAPS, "maps", disable=None, leave=False):
        rows += bench_cross(name, data, seed, rate)
        write_bench(out, rows, seed=seed)  # as soon as a map is finished
    found = [chosen(rows)] if choose else []
    return [text_table(summary(rows)), *found, "drives over other ground and over the map's own"]


def chosen(rows: Sequence[Row]) -> str:
    """Between what drives are told from others, on the footage of `CHOSEN` and on all other: by their single
    images, where the motion makes a drive, and the other way round; and by the motion alone."""

    def surer(row: Row) -> float:
        return 1 - float(row["shown"]) / float(row["null"])

    def per_query(row: Row) -> float:
        return float(row["nats_per_query"]) if row["log_likelihood"] >= NATS else 0.0

    ways: dict[str, tuple[Callable[[Row], float], Callable[[Row], bool]]] = {
        "surer by": (surer, lambda row: per_query(row) >= PER_QUERY),
        "nats": (per_query, lambda row: surer(row) >= STANDS_OUT),
        "nats alone": (per_query, lambda row: True),
        "surer alone": (surer, lambda row: True),
    }
    lines = []
    for (way, (value, told)), wanted, flights in product(ways.items(), (True, False), (False, True)):
        some = [row for row in rows if (row["case"] in AREAS) == flights and told(row)]
        some = [row for row in some if row["case"].startswith(CHOSEN) == wanted]
        some = [row for row in some if row["contender"].startswith(CHOSEN) == wanted]
        if not some:
            continue
        own = [value(row) for row in some if row["relation"] in (OWN, SHARED)]
        low = max((value(row) for row in some if row["relation"] not in (OWN, SHARED)), default=0.0)
        over = [one for one in own if one > low]
        found = f"others up to {low:.3f}, {len(over)} of {len(own)} own ones above"
        between = f", from {min(over):.3f}, between {(low + min(over)) / 2:.3f}" if over else ""
        where = f"{'chosen on' if wanted else 'reported'}{', areas' if flights else ''}"
        lines.append(f"{way}, {where}: {found}{between}")
    return "\n".join(lines)


def bench_cross(name: str, data: Path, seed: int = 0, rate: float | None = None) -> Iterator[Row]:
    """A row for each drive on a map.

    Yields:
        relation: of the drive and the map; further, see `facts_of`.
    """
    board = board_of(name, data, rate)
    foreign = dict(asked_of(board, data))
    beside = next((rows for other, rows in foreign.items() if related(board, other) == OTHER), None)
    known = Known(board.model, board.queries, board.truth, board.tolerance, beside)
    count, whole = min(ASKED, len(board.queries)), torch.arange(len(board.queries))
    first = (len(whole) - count) // 2
    drives = drives_of(count, beside, seed)
    drives |= {HALF_AS_LONG: torch.arange(count // 2)}
    for cut, numbers in drives.items():
        if cut not in CUTS or numbers is None:  # no other footage has some features
            continue
        numbers = torch.where(numbers >= 0, numbers + first, numbers)
        numbers = whole if cut == AS_IT_WAS else numbers
        row: Row = {"case": name, "contender": name, "cut": cut, "relation": OWN}
        yield row | facts_of(board, *asked(known, numbers))
    for other, queries in foreign.items():
        row = {"case": name, "contender": other, "cut": "", "relation": related(board, other)}
        yield row | facts_of(board, queries)


def flown(name: str) -> tuple[Grid, Grid, Tensor]:
    """The reference of an area, and a flight over it: windows at each pixel, and the numbers of some."""
    first, second = AREAS[name](0, STRIDE), AREAS[name](1, 1)
    path = flight(second.layout, torch.Generator().manual_seed(0))
    return first, second, second.layout.place_at(path)


def board_of(name: str, data: Path, rate: float | None = None) -> Board:
    """A map with all default settings, of one route, of two, or of an area."""
    model = DejaVu(mapper=SpectralMapper(rate))
    if name in AREAS:
        first, second, path = flown(name)
        model.learn(first)
        places = first.layout.place_near(second.layout.coordinates(path))[:, None]
        radius = round(RADIUS / STRIDE)
        truth = widened(all_judged(places), first.layout, radius)
        return Board(model, (name,), described(model, Part(second, path)), truth, radius)
    routes: tuple[str, ...] = PARTS_OF_MERGED if name == MERGED else (name,)
    reference, query, truth = traverses(FOOTAGE[routes[0]], data)
    model.learn(reference)
    calibrate_if_possible(model, reference)
    if name == MERGED:
        added = fitted(opened(FOOTAGE[routes[1]].reference, data), reference.frame_shape)
        model = merge([model, map_beside(model, added)], routes)
    return Board(model, routes, described(model, query), truth, FOOTAGE[routes[0]].tolerance)


def map_beside(model: DejaVu, traverse: Traverse) -> DejaVu:
    """A map of other footage by the descriptor of a model, to be merged."""
    other = copy.deepcopy(model)
    other.learn_features(other.descriptor.all_of(traverse), traverse)
    return other


def traverses(footage: Footage, data: Path) -> tuple[Traverse, Traverse, GroundTruth]:
    """Reference, queries and truth of a route."""
    reference, query = (opened(one, data) for one in (footage.reference, footage.query))
    truth = truth_of(reference, query, footage.truth and footage.truth.format(data=data))
    if footage.part is not None:
        half = len(reference) // 2
        start, stop = ((0, half), (half, len(reference)))[footage.part]
        reference = Part(reference, range(start, stop))
        shown = truth.positives
        inside = (shown >= start) & (shown < stop)
        some = inside.any(1).nonzero()[:, 0]
        query = Part(query, some)
        truth = all_judged(torch.where(inside, shown - start, -1)[some])
    return reference, query, truth


def views_of(model: DejaVu) -> Views:
    """Those of a drive on a map, before the drive has shown which are of use."""
    return model.views_at_first(Querying(), len(model.frame_shape or ()) == 3, True)


def described(model: DejaVu, drive: Traverse) -> Tensor:
    """Descriptors of all views of the queries of a drive, (Q, V x K)."""
    rows = model.descriptor.all_of(views_of(model).of(drive)).float()
    return rows.reshape(len(drive), -1)


def opened(source: str, data: Path) -> Traverse:
    return open_source(source.format(data=data))


def asked_of(board: Board, data: Path) -> Iterator[tuple[str, Tensor]]:
    """Queries over the ground of all other routes that the map can be asked by, from their middle."""
    own = FOOTAGE.get(board.shows[0])
    for name, footage in FOOTAGE.items():
        if name in board.shows or footage.features != (own.features if own else "images"):
            continue
        query = opened(footage.query, data)
        some = torch.arange(len(query))
        if footage.part is not None:
            reference = opened(footage.reference, data)
            shown = truth_of(reference, query, footage.truth and footage.truth.format(data=data)).positives
            half = len(reference) // 2
            inside = (shown >= half) == bool(footage.part)
            some = some[((shown < 0) | inside).all(1) & (shown >= 0).any(1)]
        most = ASKED if own else ASKED // 2  # flights take longer
        first = max(0, len(some) - most) // 2
        shape = board.model.frame_shape
        moved = query if shape is None else fitted(query, shape)
        yield name, described(board.model, Part(moved, some[first : first + most]))
    for name in AREAS if board.shows[0] in AREAS else ():
        if name not in board.shows:
            _, second, path = flown(name)
            yield name, described(board.model, Part(second, path))


def related(board: Board, drive: str) -> str:
    """How a drive over other ground is related to a map."""
    if drive in AREAS:
        return OTHER if "simulated ground" in (drive, *board.shows) else REPEATED
    if drive.startswith("road") and board.shows[0].startswith("area"):  # one road, cut otherwise
        return SHARED if drive.split(", ")[1] == board.shows[0].split(", ")[1] else REPEATED
    asked_, shown = FOOTAGE[drive], [FOOTAGE[one] for one in board.shows if one in FOOTAGE]
    if any(one.ground == asked_.ground for one in shown):
        return SHARED
    if any(one.kind == asked_.kind for one in shown):
        return REPEATED if asked_.kind == "road from above" else KIND
    return OTHER


def facts_of(board: Board, queries: Tensor, truth: GroundTruth | None = None) -> dict[str, Any]:
    """The figures of a drive.

    Returns:
        taken: whether the smoother took it for a drive of the map. drive_above, filter_above, one_above:
        shares of answers with at least each of `SHARES`. Of drives over the map's own ground also drive_right
        and so on, the share of right ones of these, None for fewer than `FEW`; drive_auc; drive_error, of the
        probabilities.
    """
    ways = matches(board, queries)
    drive = ways["drive"]
    assert drive.smoother is not None
    found: dict[str, Any] = {"queries": len(queries), "taken": drive.is_drive}
    found |= {"views": drive.shift is not None}
    found |= {key: value for key, value in drive.smoother.settled().items() if isinstance(value, float)}
    # the truth has all windows of an area
    within = {1: max(1, board.tolerance), 2: 0}[board.model.map.layout.dimensions]
    for way, match in ways.items():
        assert match.probability is not None
        probability = match.probability
        found[f"{way}_above"] = [float((probability >= share).double().mean()) for share in SHARES]
        if truth is None:
            continue
        known, right = judged(match, truth, within)
        kept = [right[known >= share] for share in SHARES]
        found[f"{way}_right"] = [float(one.double().mean()) if len(one) >= FEW else None for one in kept]
        found[f"{way}_error"] = calibration_error(known, right)
        found[f"{way}_auc"] = evaluate(match, truth, within).auc
    return found


def matches(board: Board, queries: Tensor) -> dict[str, Match]:
    """The answers to a drive, descriptors of all views (Q, V x K), by each of `WAYS` that there is."""
    model, tolerance = board.model, board.tolerance
    views, count, smoother = views_of(model), len(queries), PlaceSmoother(within=max(1, tolerance))
    queries = queries.reshape(count * len(views.shifts), -1)
    moved = centred(model.map, queries, len(views.shifts)) if model.centres(count) else queries

    def matching(way: SequenceModel | None = None) -> Matching:
        return model.matching(way)._replace(radius=tolerance, wrappers=(views,))

    ways = {"drive": model.localize_descriptors(moved, matching(smoother))}
    if model.calibration is not None:
        ways["one"] = model.localize_descriptors(moved, matching())
        if model.calibration.filter is not None:
            ways["filter"] = model.localize_descriptors(queries, matching(PlaceFilter()))
    return ways


def summary(rows: Sequence[Row]) -> list[list[str]]:
    """What is taken for a drive of each map, and the largest shares accepted of drives over other ground."""

    def worst(some: Sequence[Row], way: str) -> str:
        found = [row[f"{way}_above"] for row in some if f"{way}_above" in row]
        return " ".join(f"{max(column):.2f}" for column in zip(*found, strict=True)) if found else ""

    head = ["map", "own taken", *(f"{kind}: taken" for kind in (REPEATED, KIND, OTHER))]
    lines = [[*head, *(f"worst {way}, p > .5 .9 .99" for way in WAYS)]]
    for case in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == case]
        groups = [[row for row in own if row["relation"] == kind] for kind in (OWN, REPEATED, KIND, OTHER)]
        taken = (f"{sum(row['taken'] for row in some)} of {len(some)}" if some else "" for some in groups)
        foreign = [row for some in groups[1:] for row in some]
        lines.append([case, *taken, *(worst(foreign, way) for way in WAYS)])
    return lines
