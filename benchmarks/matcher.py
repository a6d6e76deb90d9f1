"""HOG, L1 distances, sequences, filters, exported maps: timed beside what computes the same."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

import dejavu_torch
from benchmarks.plots import plot_ratios
from dejavu_torch.data.output import check_output_folder, whole_folder
from dejavu_torch.evaluation.plots import Plot
from dejavu_torch.features.hog import HOG, hog
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.distance import l1_backend, phase_distances
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.text import one_line
from dejavu_torch.types import FrequencyLayer, InputError

BATCH = 64
AT_MOST = 60  # seconds for all runs of one contender together
COMPARED = ("torch", "numpy", "numba", "scikit-image", "scipy", "faiss-cpu", "onnxruntime")
PERIODS = (191, 193, 197, 199, 211)  # of the layers that sequences are matched in: 991 phases
WIDE = 64  # numbers of the descriptors that are filtered
NUMBERS = 128  # of those of single frames
MEMORY = Path("/proc/self/statm")

Sizes = Sequence[tuple[int, int]]
Run = Callable[[], Tensor]


class Program(NamedTuple):
    """A contender: a program that can do the work of a case.

    name: ours start with "dejavu". threads: that it may use. prepare: imports what it needs and returns
    what does the work; a result with fewer rows than the case has stands for a part of the work.
    """

    name: str
    threads: int
    prepare: Callable[[], Run]


class Row(NamedTuple):
    """What one contender took for one case; None where it is not known.

    seconds: for the whole case, best of the repeats. seconds_first: of the first run, with all that is
    loaded and compiled for it. ratio_to_ours: seconds over those of our fastest. peak_bytes: most
    memory held during a run beyond what was held before. bytes: of the result. difference: largest to
    our result. measured_rows: where only a part of the case was run: seconds and bytes are scaled up
    from it, seconds_first and peak_bytes are its own. skipped: why there are no figures. recall_at_1: share
    of queries that were found, where the case is to find places. file_bytes: of the file that it runs.
    cpu_seconds: of all processors together, which other programs change little; the least of the repeats.
    """

    case: str
    contender: str
    seconds: float | None = None
    seconds_first: float | None = None
    ratio_to_ours: float | None = None
    peak_bytes: int | None = None
    bytes: int | None = None
    threads: int | None = None
    difference: float | None = None
    measured_rows: int | None = None
    skipped: str | None = None
    recall_at_1: float | None = None
    file_bytes: int | None = None
    cpu_seconds: float | None = None


def bench_matcher(
    frames: int = 2000,
    repeats: int = 3,
    images: Sizes = ((64, 64), (256, 192)),
    distances: Sequence[tuple[int, int, int]] = ((512, 2640, 1000),),
    sequences: Sequence[tuple[int, int, int]] = ((64, 21, 100_000),),
    filters: Sequence[tuple[int, int]] = ((200, 100_000),),
    exports: Sequence[tuple[int, int, int, int]] = ((50, 64, 64, 3072), (20, 480, 640, 100_000)),
    torch_compile: bool = True,
    seed: int = 0,
) -> list[Row]:
    """Time HOG beside scikit-image, L1 distances beside torch, scipy and faiss; sequences, filters two ways;
    frames one by one beside the same in onnxruntime.

    Args:
        frames: grey frames to describe, of each size in `images` (height, width in pixels).
        repeats: timed runs of each contender, in turn; the best counts.
        distances: queries, features and templates of each case of L1.
        sequences: queries, queries of a sequence and places of each case of a template map whose sequences
            are matched in one batch, beside a query at a time.
        filters: queries and places of each case of a filter that searches all places for every 50th query,
            beside one that does for every query; the difference is one of probabilities.
        exports: frames, their height and width, and places of each case of single frames, found one behind
            the other on a spectral map, beside its ONNX file.
        torch_compile: also a sum that `torch.compile` makes a loop of; compiling takes its time.
        seed: of the random frames and features.

    Convention: one process, float32, and the same number of threads, torch.get_num_threads(), for all
        that can use several; ours with one thread as well.

    Raises:
        InputError: a number below 1.
    """
    if (
        min(
            frames,
            repeats,
            *(n for size in (*images, *distances, *sequences, *filters, *exports) for n in size),
        )
        < 1
    ):
        raise InputError(
            f"the bench got frames={frames}, repeats={repeats}, images {images}, distances {distances}, "
            f"sequences {sequences}, filters {filters} and exports {exports}; expected at least 1 of each"
        )
    generator = torch.Generator().manual_seed(seed)
    rows = []
    with torch.no_grad():
        for height, width in images:
            some = torch.rand(min(frames, BATCH), 1, height, width, generator=generator)
            rows += _hog_case(f"hog {height} x {width}", some, frames, repeats)
        for q, f, p in distances:
            query, templates = (torch.rand(n, f, generator=generator) for n in (q, p))
            rows += _l1_case(f"l1 {q} x {f} x {p}", query, templates, repeats, torch_compile)
        for q, length, places in sequences:
            query, templates = (torch.rand(n, len(PERIODS), generator=generator) for n in (q, max(PERIODS)))
            rows += _sequence_case(
                f"sequence {q} x {length} x {places}", query, templates, length, places, repeats
            )
        for q, places in filters:
            route = _smooth(torch.randn(places, WIDE, generator=generator))
            noise = torch.randn(q, WIDE, generator=generator)
            rows += _filter_case(f"filter {q} x {places}", route, noise, repeats)
        for count, height, width, places in exports:
            some = torch.rand(count, 1, height, width, generator=generator)
            route = _smooth(torch.randn(places, NUMBERS, generator=generator))
            case = f"single frames {count} x {height} x {width} on {places}"
            rows += _export_case(case, some, route, repeats, generator)
    return rows


def in_one_thread(run: Run) -> Run:
    """The same work where torch may use one thread only."""

    def alone() -> Tensor:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return run()
        finally:
            torch.set_num_threads(threads)

    return alone


def _ours(run: Run) -> list[Program]:
    """Our work with all threads and, where there are several, with one."""
    threads = torch.get_num_threads()
    alone = Program("dejavu (one thread)", 1, lambda: in_one_thread(run))
    return [Program("dejavu", threads, lambda: run), *([alone] if threads > 1 else [])]


def _hog_case(case: str, some: Tensor, frames: int, repeats: int) -> list[Row]:
    """All `frames`, of which `some` differ."""
    dimension = hog(some[:1]).shape[1]

    def ours() -> Tensor:
        out = torch.empty(frames, dimension)
        for start in range(0, frames, BATCH):
            out[start : start + BATCH] = hog(some[: frames - start])
        return out

    def skimage() -> Run:
        from skimage.feature import hog as theirs

        one = partial(theirs, orientations=9, pixels_per_cell=(8, 8), cells_per_block=(2, 2))
        pictures = some[:, 0].numpy()
        one(pictures[0])
        began = time.perf_counter()
        one(pictures[0])
        possible = AT_MOST / (repeats + 2) / (time.perf_counter() - began)
        part = min(frames, 1 + int(possible))

        def run() -> Tensor:
            out = torch.empty(part, dimension)
            for i in range(part):
                out[i] = torch.from_numpy(one(pictures[i % len(pictures)]))
            return out

        return run

    return benchmark(case, [*_ours(ours), Program("scikit-image", 1, skimage)], repeats)


def _l1_case(case: str, query: Tensor, templates: Tensor, repeats: int, torch_compile: bool) -> list[Row]:
    threads = torch.get_num_threads()

    def eager() -> Run:
        wanted = query.clone().requires_grad_()

        def run() -> Tensor:
            with torch.enable_grad():  # gradients are torch's
                return phase_distances(wanted, templates).detach()

        return run

    def compiled() -> Run:
        if not torch_compile:
            raise RuntimeError("not asked for")
        if shutil.which("c++") is None and shutil.which("g++") is None:
            raise RuntimeError("no C++ compiler")
        loop = torch.compile(lambda a, b: (a[:, None] - b).abs().sum(2))
        return lambda: loop(query, templates)

    def scipy() -> Run:
        from scipy.spatial.distance import cdist

        return lambda: torch.from_numpy(cdist(query.numpy(), templates.numpy(), "cityblock"))

    def faiss() -> Run:
        import faiss

        faiss.omp_set_num_threads(threads)
        pairwise = partial(faiss.pairwise_distances, metric=faiss.METRIC_L1)
        return lambda: torch.from_numpy(pairwise(query.numpy(), templates.numpy()))

    contenders = [
        *_ours(partial(phase_distances, query, templates)),
        Program("dejavu (eager torch)", threads, eager),
        Program("torch.cdist", threads, lambda: partial(torch.cdist, query, templates, p=1.0)),
        Program("torch.compile", threads, compiled),
        Program("scipy cdist", 1, scipy),
        Program("faiss", threads, faiss),
    ]
    return benchmark(case, contenders, repeats)


def _sequence_case(
    case: str, query: Tensor, templates: Tensor, length: int, places: int, repeats: int
) -> list[Row]:
    """A feature a layer, so that it is not the distances that take the time."""
    plan = tuple(FrequencyLayer(Fraction(tau), tau, 0, places, (j,)) for j, tau in enumerate(PERIODS))
    blocks = [templates[:tau, j, None] for j, tau in enumerate(PERIODS)]
    route, matcher = TemplateMap(plan, blocks, places, len(plan)), SequenceMatcher(length)

    def drive(size: int) -> Tensor:
        rows, state = [], matcher.start(places)
        for scores in route.scores(query).split(size):
            found, state = matcher.step(scores, state)
            rows.append(found)
        return torch.cat(rows)[:, length:]  # before it some are +inf

    one_by_one = Program("dejavu (a query at a time)", torch.get_num_threads(), lambda: partial(drive, 1))
    return benchmark(case, [*_ours(partial(drive, len(query))), one_by_one], repeats)


def _smooth(steps: Tensor) -> Tensor:
    """A route whose descriptors change little from place to place: the mean of 16 random steps. (N,K)"""
    summed = F.pad(steps.T, (15, 0))[None]
    return F.avg_pool1d(summed, 16, 1)[0].T * 4


def _filter_case(case: str, route: Tensor, noise: Tensor, repeats: int) -> list[Row]:
    """A drive along the middle of a route, seen with as much noise as there is route."""
    spectral = SpectralMapper(None, step=2.0, chunk=1024)(route)
    first = max(0, (len(route) - len(noise)) // 2)
    queries = (route[first : first + len(noise)] + noise).split(16)

    def drive(every: int) -> Tensor:
        with torch.no_grad():
            rows: list[Tensor] = []
            matching = Matching(PlaceFilter(search_every=every), on_scores=rows.append)
            localizer = Localizer(spectral, matching)
            for part in queries:
                localizer(part)
            return torch.cat([(-row).exp() for row in rows])

    beside = Program("dejavu (all places)", torch.get_num_threads(), lambda: partial(drive, 1))
    return benchmark(case, [*_ours(partial(drive, 50)), beside], repeats)


def _export_case(
    case: str, frames: Tensor, route: Tensor, repeats: int, generator: torch.Generator
) -> list[Row]:
    """HOG, a whitening and a map made of random numbers: what they find takes as long as what is right."""
    whitening = Whitening(numbers=NUMBERS)
    model = DejaVu(HOG(), whitening, SpectralMapper(None, step=0.05))
    features = model.describe(frames[:1]).shape[1]
    projection = torch.randn(features, NUMBERS, generator=generator)
    whitening.take(torch.rand(features, generator=generator), projection, None)
    model.learn_features(nn.functional.normalize(route, dim=1))
    model.eval().frame_shape = tuple(frames.shape[1:])
    threads, size = torch.get_num_threads(), 0

    def ours() -> Tensor:
        return torch.cat([model(frame) for frame in frames.split(1)])

    def exported() -> Run:
        nonlocal size
        from dejavu_torch.export import export_onnx, run_session, session_of

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "map.onnx"
            size = export_onnx(model, path).bytes
            session = session_of(str(path), threads)
        return lambda: torch.cat([run_session(session, frame) for frame in frames.split(1)])

    rows = benchmark(case, [*_ours(ours), Program("onnxruntime", threads, exported)], repeats)
    return [*rows[:-1], rows[-1]._replace(file_bytes=size or None)]


def benchmark(case: str, contenders: Sequence[Program], repeats: int) -> list[Row]:
    """Time all in turn, round after round, and compare every result with that of the first, which is ours.

    Convention: not counted are one run of each that loads and compiles, and one that measures memory.
        An error of the first is raised; one of another is a row that names it.
    """
    rows: dict[str, Row] = {}
    runs: dict[str, tuple[Run, float]] = {}
    expected: Tensor | None = None
    bar = tqdm(total=len(contenders) * (1 + repeats), desc=case, disable=None, leave=False)
    for name, threads, prepare in contenders:
        bar.update()
        try:
            began = time.perf_counter()
            run = prepare()
            result = run()
            first = time.perf_counter() - began
            peak = peak_memory(run)
            expected = result if expected is None else expected
            difference = float((result - expected[: len(result)]).abs().max())
        except Exception as error:  # whatever another program fails with
            if expected is None:
                raise
            line = one_line(error)
            rows[name] = Row(case, name, skipped=f"{type(error).__name__}: {line}"[:200])
            continue
        rows[name] = Row(
            case,
            name,
            seconds_first=first,
            peak_bytes=peak,
            bytes=result.nbytes * len(expected) // len(result),
            threads=threads,
            difference=difference,
            measured_rows=len(result) if len(result) < len(expected) else None,
        )
        runs[name] = run, len(expected) / len(result)
        del result  # it would hide what the next one needs
    best = dict.fromkeys(runs, inf)
    for _ in range(repeats):
        for name, (run, scale) in runs.items():
            began = time.perf_counter()
            run()
            best[name] = min(best[name], scale * (time.perf_counter() - began))
            bar.update()
    bar.close()
    fastest = min(seconds for name, seconds in best.items() if name.startswith("dejavu"))
    for name, seconds in best.items():
        rows[name] = rows[name]._replace(seconds=seconds, ratio_to_ours=seconds / fastest)
    return list(rows.values())


def peak_memory(run: Callable[[], object]) -> int | None:
    """Most bytes of memory during a run beyond those before it; None where the system has no /proc."""
    if not MEMORY.exists():
        return None
    before = most = resident()
    done = threading.Event()

    def watch() -> None:
        nonlocal most
        while not done.wait(0.002):
            most = max(most, resident())

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        result = run()
        last = resident()  # with the result: a run that keeps Python's lock stops the watcher
        del result
    finally:
        done.set()
        watcher.join()
    return max(most, last) - before


def resident() -> int:
    """Bytes of memory that this process holds now."""
    return int(MEMORY.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


BENCHES = {"matcher": bench_matcher}


def run_bench(what: str, out: Path, frames: int = 2000, repeats: int = 3) -> list[Row]:
    """Run a bench with its default sizes, and write bench.json and bench.png into the folder `out`.

    Raises:
        InputError: an unknown bench, or a folder that cannot be made or written in.
    """
    if what not in BENCHES:
        raise InputError(
            f"bench {what!r} is unknown; expected {', '.join(BENCHES)}, live, train, memory, "
            "cluster, storage or scale"
        )
    check_output_folder(out)  # before the long work
    rows = BENCHES[what](frames, repeats)
    with whole_folder(out) as folder:
        write_bench(folder, rows)
    return rows


def write_bench(folder: Path, rows: Sequence[Row], picture: Plot | None = None) -> None:
    """Write bench.json and bench.png into a folder that exists.

    Args:
        picture: None draws the seconds over ours.
    """
    facts = {"rows": [row._asdict() for row in rows]} | programs()
    figure, _ = picture or plot_ratios(bars(rows, lambda row: row.ratio_to_ours))
    figure.savefig(folder / "bench.png")
    (folder / "bench.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def programs() -> dict[str, Any]:
    """What figures depend on beside the machine, as bench.json names it."""
    return {
        "threads": torch.get_num_threads(),
        "l1_backend": l1_backend(),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "versions": {"dejavu_torch": dejavu_torch.__version__} | {name: _version(name) for name in COMPARED},
    }


def bars(rows: Sequence[Row], height: Callable[[Row], float | None]) -> dict[str, dict[str, float]]:
    """A figure of each row that has it, by case and contender, as `plot_ratios` draws it."""
    cases: dict[str, dict[str, float]] = {}
    for row in rows:
        value = height(row)
        if value is not None:
            cases.setdefault(row.case, {})[row.contender] = value
    return cases


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def bench_table(rows: Sequence[Row]) -> list[list[str]]:
    """The figures as rows of text, the header first.

    Example:
        >>> bench_table([Row("l1", "dejavu", 0.5, ratio_to_ours=1.0)])[1][:3]
        ['l1: dejavu', '0.500', '1.0']
    """
    head = [
        "",
        "seconds",
        "x ours",
        "first run",
        "threads",
        "peak MB",
        "result MB",
        "file MB",
        "difference",
        "",
    ]
    return [head, *([f"{row.case}: {row.contender}", *_figures(row)] for row in rows)]


def _figures(row: Row) -> list[str]:
    def text(value: float | None, form: str, unit: float = 1) -> str:
        return "" if value is None else format(value / unit, form)

    note = f"skipped: {row.skipped}" if row.skipped else ""
    return [
        text(row.seconds, ".3f"),
        text(row.ratio_to_ours, ".1f"),
        text(row.seconds_first, ".2f"),
        text(row.threads, ".0f"),
        text(row.peak_bytes, ".1f", 1e6),
        text(row.bytes, ".1f", 1e6),
        text(row.file_bytes, ".1f", 1e6),
        text(row.difference, ".1e"),
        f"{row.measured_rows} measured" if row.measured_rows else note,
    ]
