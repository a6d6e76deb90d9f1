"""HOG, L1 distances, sequences, filters, exported maps: timed beside what computes the same."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.measure import Column, Contender, Row, Run, bars, benchmark, in_one_thread, write_bench
from dejavu_torch.data.output import check_output_folder
from dejavu_torch.features.hog import HOG, hog
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.distance import phase_distances
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import FrequencyLayer, InputError

BATCH = 64
AT_MOST = 60  # seconds for all runs of one contender together
PERIODS = (191, 193, 197, 199, 211)  # of the layers that sequences are matched in: 991 phases
WIDE = 64  # numbers of the descriptors that are filtered
NUMBERS = 128  # of those of single frames
COLUMNS: dict[str, Column] = {
    "seconds": ("seconds", ".3f"),
    "x ours": ("ratio_to_ours", ".1f"),
    "first run": ("seconds_first", ".2f"),
    "threads": ("threads", ".0f"),
    "peak MB": ("peak_bytes", ".1f", 1e6),
    "result MB": ("bytes", ".1f", 1e6),
    "file MB": ("file_bytes", ".1f", 1e6),
    "difference": ("difference", ".1e"),
}

Sizes = Sequence[tuple[int, int]]


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


def _ours(run: Run) -> list[Contender]:
    """Our work with all threads and, where there are several, with one."""
    threads = torch.get_num_threads()
    alone = Contender("dejavu (one thread)", lambda: in_one_thread(run), 1)
    return [Contender("dejavu", lambda: run, threads), *([alone] if threads > 1 else [])]


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

    return benchmark(case, [*_ours(ours), Contender("scikit-image", skimage, 1)], repeats)


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
        Contender("dejavu (eager torch)", eager, threads),
        Contender("torch.cdist", lambda: partial(torch.cdist, query, templates, p=1.0), threads),
        Contender("torch.compile", compiled, threads),
        Contender("scipy cdist", scipy, 1),
        Contender("faiss", faiss, threads),
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

    one_by_one = Contender("dejavu (a query at a time)", lambda: partial(drive, 1), torch.get_num_threads())
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

    beside = Contender("dejavu (all places)", lambda: partial(drive, 1), torch.get_num_threads())
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

    rows = benchmark(case, [*_ours(ours), Contender("onnxruntime", exported, threads)], repeats)
    rows[-1]["file_bytes"] = size or None
    return rows


def run_matcher(out: Path) -> list[Row]:
    """`bench_matcher`, written as bench.json and bench.png into the folder `out`.

    Raises:
        InputError: a folder that cannot be made or written in.
    """
    check_output_folder(out)  # before the long work
    rows = bench_matcher()
    write_bench(out, rows, bars(rows))
    return rows
