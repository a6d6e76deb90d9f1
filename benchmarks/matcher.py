"""`benchmarks matcher`: HOG, L1 distances, sequences, filters and exported maps timed against other code."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.measure import Column, Contender, Row, Run, bars, benchmark, table, write_bench
from dejavu_torch.features.hog import HOG, hog
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.distance import phase_distances
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import FrequencyLayer

BATCH = 64
AT_MOST = 60  # seconds for all runs of one contender together
PERIODS = (191, 193, 197, 199, 211)  # of the layers for sequences: 991 phases
WIDE = 64  # dimensions of the descriptors for filters
NUMBERS = 128  # dimensions of the descriptors of single frames
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


def run_matcher(*, out: Path) -> list[str]:
    """Time of HOG, L1 distances, sequences, filters and exported maps.

    Args:
        out: folder for bench.json and bench.png
    """
    rows = list(bench_matcher())
    write_bench(out, rows, bars(rows))
    absent = any("No module" in (row["skipped"] or "") for row in rows)
    hint = ["skipped contenders need pip install '.[bench,export]'"] * absent
    return [table(rows, COLUMNS), *hint, "x ours: seconds / seconds of the fastest dejavu"]


@torch.no_grad()
def bench_matcher(
    frames: int = 2000,
    repeats: int = 3,
    images: Sequence[tuple[int, int]] = ((64, 64), (256, 192)),
    distances: Sequence[tuple[int, int, int]] = ((512, 2640, 1000),),
    sequences: Sequence[tuple[int, int, int]] = ((64, 21, 100_000),),
    filters: Sequence[tuple[int, int]] = ((200, 100_000),),
    exports: Sequence[tuple[int, int, int, int]] = ((50, 64, 64, 3072), (20, 480, 640, 100_000)),
    torch_compile: bool = True,
) -> Iterator[Row]:
    """Time HOG against scikit-image, L1 distances against torch, scipy and faiss, sequences and filters in
    two ways, and single frames against onnxruntime.

    Args:
        frames: of each HOG case. repeats: timed runs of each contender, in turn; the best counts.
        images: height, width. distances: queries, features, templates. sequences: queries, T, places.
        filters: queries, places; the difference is in probabilities.
        exports: frames, height, width, places.
        torch_compile: also time a sum compiled by `torch.compile`; compiling is slow.

    Convention: one process, float32, and torch.get_num_threads() threads for all that can use several; ours
        also with one thread.
    """
    generator = torch.Generator().manual_seed(0)
    for height, width in images:
        some = torch.rand(min(frames, BATCH), 1, height, width, generator=generator)
        yield from benchmark(f"hog {height} x {width}", hog_contenders(some, frames, repeats), repeats)
    for q, f, p in distances:
        query, templates = (torch.rand(n, f, generator=generator) for n in (q, p))
        yield from benchmark(f"l1 {q} x {f} x {p}", l1_contenders(query, templates, torch_compile), repeats)
    for q, length, places in sequences:
        query, templates = (torch.rand(n, len(PERIODS), generator=generator) for n in (q, max(PERIODS)))
        contenders = sequence_contenders(query, templates, length, places)
        yield from benchmark(f"sequence {q} x {length} x {places}", contenders, repeats)
    for q, places in filters:
        route = smooth(torch.randn(places, WIDE, generator=generator))
        noise = torch.randn(q, WIDE, generator=generator)
        yield from benchmark(f"filter {q} x {places}", filter_contenders(route, noise), repeats)
    for count, height, width, places in exports:
        some = torch.rand(count, 1, height, width, generator=generator)
        model = random_model(some, smooth(torch.randn(places, NUMBERS, generator=generator)), generator)
        sizes: list[int] = []
        case = f"single frames {count} x {height} x {width} on {places}"
        *ours, exported = benchmark(case, export_contenders(model, some, sizes), repeats)
        yield from (*ours, exported | {"file_bytes": sizes[0] if sizes else None})


def both(run: Run) -> list[Contender]:
    """Our code with all threads and, if there are several, with one."""
    threads = torch.get_num_threads()
    alone = Contender("dejavu (one thread)", lambda: run)
    return [Contender("dejavu", lambda: run, threads), *[alone] * (threads > 1)]


def hog_contenders(some: Tensor, frames: int, repeats: int) -> list[Contender]:
    """HOG of `frames` frames, which repeat `some`."""
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

    return [*both(ours), Contender("scikit-image", skimage)]


def l1_contenders(query: Tensor, templates: Tensor, torch_compile: bool) -> list[Contender]:
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

    return [
        *both(partial(phase_distances, query, templates)),
        Contender("dejavu (eager torch)", eager, threads),
        Contender("torch.cdist", lambda: partial(torch.cdist, query, templates, p=1.0), threads),
        Contender("torch.compile", compiled, threads),
        Contender("scipy cdist", scipy),
        Contender("faiss", faiss, threads),
    ]


def sequence_contenders(query: Tensor, templates: Tensor, length: int, places: int) -> list[Contender]:
    """Sequences on layers of one feature, so that the distances take little time."""
    plan = tuple(FrequencyLayer(Fraction(tau), tau, 0, places, (j,)) for j, tau in enumerate(PERIODS))
    blocks = [templates[:tau, j, None] for j, tau in enumerate(PERIODS)]
    route, matcher = TemplateMap(plan, blocks, places, len(plan)), SequenceMatcher(length)

    def drive(size: int) -> Tensor:
        rows, state = [], matcher.start(places)
        for scores in route.scores(query).split(size):
            found, state = matcher.step(scores, state)
            rows.append(found)
        return torch.cat(rows)[:, length:]  # earlier ones may be +inf

    one_by_one = Contender("dejavu (a query at a time)", lambda: partial(drive, 1), torch.get_num_threads())
    return [*both(partial(drive, len(query))), one_by_one]


def smooth(steps: Tensor) -> Tensor:
    """A route whose descriptors change little from place to place: the mean of 16 random steps. (N,K)"""
    summed = F.pad(steps.T, (15, 0))[None]
    return F.avg_pool1d(summed, 16, 1)[0].T * 4


def filter_contenders(route: Tensor, noise: Tensor) -> list[Contender]:
    """Filters on a drive along the middle of a route, with noise as large as the signal."""
    spectral = SpectralMapper(None, step=2.0, chunk=1024)(route)
    first = max(0, (len(route) - len(noise)) // 2)
    queries = (route[first : first + len(noise)] + noise).split(16)

    def drive() -> Tensor:
        rows: list[Tensor] = []
        localizer = Localizer(spectral, Matching(PlaceFilter(), callback=rows.append))
        for part in queries:
            localizer(part)
        return torch.cat([(-row).exp() for row in rows])

    return both(drive)


def random_model(frames: Tensor, route: Tensor, generator: torch.Generator) -> DejaVu:
    """HOG with a whitening and a map of random numbers, which take as long as learned ones."""
    whitening = Whitening(numbers=NUMBERS)
    model = DejaVu(HOG(), whitening, SpectralMapper(None, step=0.05))
    features = model.descriptor.describe(frames[:1]).shape[1]
    projection = torch.randn(features, NUMBERS, generator=generator)
    whitening.take(torch.rand(features, generator=generator), projection, None)
    model.learn_features(F.normalize(route, dim=1))
    model.eval().frame_shape = tuple(frames.shape[1:])
    return model


def export_contenders(model: DejaVu, frames: Tensor, sizes: list[int]) -> list[Contender]:
    """Single frames; appends the bytes of the exported file to `sizes`."""
    threads = torch.get_num_threads()

    def exported() -> Run:
        from dejavu_torch.export import export_onnx, run_session, session_of

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "map.onnx"
            sizes.append(export_onnx(model, path).bytes)
            session = session_of(str(path), threads)
        return lambda: torch.cat([run_session(session, frame) for frame in frames.split(1)])

    ours = both(lambda: torch.cat([model(frame) for frame in frames.split(1)]))
    return [*ours, Contender("onnxruntime", exported, threads)]
