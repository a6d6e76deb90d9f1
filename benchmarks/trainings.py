"""`benchmarks trainings`: trained maps against untrained ones on routes of many kinds."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.measure import Row, done_once, some_of, truth_of, write_bench
from benchmarks.plots import OURS, plot_areas
from benchmarks.train import spread
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.baselines import hog_baselines
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError, Match

SEEDS = (0, 1, 2)
ROAD = "strip:{{data}}/aerial_road/pass{}.png?halve=1&rows=32:128&width=96{}"
TRAINED, UNTRAINED, HOG = "trained", "untrained", "HOG of all frames"
NULL = "null"  # shuffled frames in the same bytes
SIZES = {"1 B": SpectralMapper(1.0), "5 B": SpectralMapper(5.0), "default": SpectralMapper()}


class Route(NamedTuple):
    """Two traverses and their truth; {data} is the folder of the footage.

    preset, options: of the training. start: another training, whose weights it starts from.
    """

    reference: str
    query: str
    tolerance: int = 5
    truth: str | None = None
    preset: str = "train_road"
    options: str = ""
    start: Route | None = None

    def below(self, data: Path) -> Route:
        """The route with the folder filled in."""
        placed: dict[str, Any] = {
            name: one.format(data=shlex.quote(str(data)) if name == "options" else data)
            for name, one in self._asdict().items()
            if isinstance(one, str)
        }
        return self._replace(**placed, start=self.start and self.start.below(data))


def road(part: str = "", preset: str = "train_road") -> Route:
    return Route(ROAD.format(1, part), ROAD.format(2, part), preset=preset)


def drive(name: str, tolerance: int) -> Route:
    folder = f"{{data}}/{name}"
    return Route(f"{folder}/reference.npy", f"{folder}/query.npy", tolerance, f"{folder}/truth.csv")


ROUTES = {
    "road, first half": road("&stop=1348"),
    "road, second half": road("&start=1348"),
    **{f"city {i}": drive(f"robotcar/{name}", 2) for i, name in enumerate(("t1", "t2", "t5"), 1)},
    "corridor": Route("{data}/corridor/ref", "{data}/corridor/query", 0, "{data}/corridor/truth.csv"),
    "laps": drive("donkey_lap", 10),
}
# the other preset, which starts with the descriptor of a training with the first
PRESETS = {"train_residues, road": road(preset="train_residues")._replace(start=road())}


def trained(name: str, route: Route, seed: int, out: Path, options: Sequence[str]) -> Path | str:
    """The map of a training by the user's command, or the error of that.

    If the same command has succeeded before, its map is reused, so that a stopped run can continue.
    """
    folder = out / f"{name.replace(', ', '_').replace(' ', '_').replace(':', '_')}_{seed}"
    words = ["train", "fit", "--config", route.preset, "--data.source", route.reference]
    words += ["--seed_everything", str(seed), *shlex.split(route.options), *options]
    if route.start is not None:
        start = trained(f"{name} start", route.start, seed, out, options)
        if not isinstance(start, Path):
            return start
        words += ["--model.start", str(start)]
    words += ["--trainer.default_root_dir", str(folder)]
    path = folder / "map.safetensors"
    if (said := done_once(words, folder, path)) is not None:
        return said
    return path


class Judge:
    """Evaluates maps of a route on its second traverse."""

    def __init__(self, name: str, route: Route) -> None:
        self.name, self.tolerance = name, route.tolerance
        self.reference, self.query = open_source(route.reference), open_source(route.query)
        self.truth = truth_of(self.reference, self.query, route.truth)

    def row(self, contender: str, found: Match, seed: int | None = None, size: float | None = None) -> Row:
        scores = evaluate(found, self.truth, self.tolerance)
        row = {"case": self.name, "contender": contender, "seed": seed, "tolerance": self.tolerance}
        return row | {"auc": scores.auc, "recall_at_1": scores.recall_at_1, "route_bytes_per_place": size}

    def of(self, contender: str, model: DejaVu, seed: int | None = None) -> list[Row]:
        """Rows for maps of a model's descriptors by size, or for its templates, and for their nulls."""
        places, queries = model.descriptor.all_of(self.reference), model.descriptor.all_of(self.query)
        rows = []
        for name, mapper in SIZES.items() if isinstance(model.map, SpectralMap) else [("", None)]:
            if mapper is not None:
                model.mapper = mapper
                try:
                    model.learn_features(places, self.reference)
                except InputError:
                    if mapper.route_bytes_per_place is None:
                        raise
                    continue  # too few bytes for a short route
            size = model.map.summary().route_bytes / model.map.places
            founds = model.localize_descriptors(queries), null_control(model, places, queries)
            for kind, found in zip((contender, f"{contender}, {NULL}"), founds, strict=True):
                rows.append(self.row(f"{kind} {name}".strip(), found, seed, size))
        return rows

    def hog(self) -> Row:
        hog = hog_baselines(self.reference, self.query, 64, self.tolerance)
        return self.row(HOG, hog["hog"].match())


def run_trainings(
    data: Path,
    *,
    out: Path,
    routes: Sequence[str] = (),
    seeds: Sequence[int] = (),
    presets: bool = False,
    jobs: int = 1,
    options: str = "",
) -> list[str]:
    """Accuracy of `dejavu train` on routes of many kinds, against the untrained map and HOG.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json, bench.png and the trained maps, which later runs reuse
        routes: names of routes; all seven if not given
        seeds: seeds, with a training each; 0, 1 and 2 if not given
        presets: run the other presets, each on its own route, instead of `train_road` on all
        jobs: trainings that run in parallel, with one thread each
        options: further options of `dejavu train fit` for all trainings, as in '--options=--model.rate 0'

    Convention: no training sees the second traverse; its tolerance is that of the preset. Bytes are route
        bytes per place; there is no row if they are too few for a short route.

    Raises:
        InputError: an unknown route, or a seed out of range.
    """
    cases, seeds = PRESETS if presets else ROUTES, list(dict.fromkeys(seeds or SEEDS))
    try:
        words = shlex.split(options)
    except ValueError as error:
        raise InputError(f"--options is {options!r} ({error}); expected words of a command line") from error
    names = some_of(cases, routes)
    if jobs < 1 or not all(0 <= seed < 2**32 for seed in seeds):
        seen = f"bench trainings got {jobs} jobs and seeds {seeds}"
        raise InputError(f"{seen}; expected at least one, and seeds from 0 to 2^32 - 1")
    chosen = {name: cases[name].below(data) for name in names}
    judges = {name: Judge(name, route) for name, route in chosen.items()}  # refuses missing sources
    works = [(name, seed) for name in chosen for seed in seeds]
    with ThreadPoolExecutor(jobs) as pool:
        made = pool.map(lambda work: trained(work[0], chosen[work[0]], work[1], out, words), works)
        maps = dict(zip(works, tqdm(made, "trainings", len(works), disable=None, leave=False), strict=True))
    rows: list[Row] = []
    for name, judge in judges.items():
        found = {seed: maps[name, seed] for seed in seeds}
        rows.append(judge.hog())
        rows += judge.of(UNTRAINED, DejaVu().learn(judge.reference))
        for seed, one in found.items():
            if isinstance(one, Path):
                rows += judge.of(TRAINED, DejaVu.load(one), seed)
            else:
                rows.append({"case": name, "contender": TRAINED, "seed": seed, "skipped": one})
    areas: dict[str, dict[str, list[float]]] = {name: {} for name in chosen}
    for row in rows:
        if "auc" in row:
            areas[row["case"]].setdefault(row["contender"], []).append(row["auc"])
    means = {
        name: {key: sum(of) / len(of) for key, of in own.items() if NULL not in key}
        for name, own in areas.items()
    }
    kinds = {HOG: COLOURS["hog"], UNTRAINED: "#222222", TRAINED: OURS}
    write_bench(out, rows, plot_areas(means, kinds), options=options)
    keys = dict.fromkeys(key for own in areas.values() for key in own)
    table = [["", *areas], *([key, *(spread(own.get(key, [])) for own in areas.values())] for key in keys)]
    said = [f"{row['case']}, seed {row['seed']}: {row['skipped']}" for row in rows if "skipped" in row]
    return [text_table(table), *said, f"AUC of the second traverse, one query; seeds {seeds}"]
