"""The baselines, which a user could store instead of the map, and the null controls of a report."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dejavu_torch.evaluation.controls import leave_out_match, null_map, with_mapper
from dejavu_torch.evaluation.quantiser import CENTROIDS, product_quantised
from dejavu_torch.features.descriptor import is_ready
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.maps.distance import Metric
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.template_map import TemplateMap, TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import recipe_of
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.recognition.drive import DriveQuery, localize_drives
from dejavu_torch.recognition.localizer import SINGLE, Matching, answer, wrapped
from dejavu_torch.recognition.scorer import OfMap, OfStored, Reordered, Scorer
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import InputError, Match, Traverse

if TYPE_CHECKING:  # training needs the HOG baselines without matplotlib
    from dejavu_torch.evaluation.localization import Localization

log = logging.getLogger("dejavu_torch")

ASKED = 1000  # frames, at most, that a stride is chosen by
SAME_SIZE = 1.02  # times the bytes that a quantiser may take
INTERPOLATES = {1: True, 2: False}  # between frames, by the dimensions of a layout


class Baseline(NamedTuple):
    """Another way to store the route.

    name: for tables. scorer: of the same queries. bytes: in all. k: the stride, if every k-th frame is
    stored. fixed: the part of the bytes that does not grow with the route, such as a backbone. found: the
    matches, if they are known.
    """

    name: str
    scorer: Scorer | None
    bytes: int | None = None
    k: int | None = None
    fixed: int = 0
    found: Match | None = None

    def match(self, matching: Matching = SINGLE, progress: bool = False) -> Match:
        """The matches of its scores, unless they are known."""
        if self.found is not None:
            return self.found
        assert self.scorer is not None
        return replace(answer(self.scorer, matching, progress, "baselines"), probability=None)


def matched(
    baselines: Iterable[tuple[str, Baseline]],
    matching: Matching = SINGLE,
    smoother: PlaceSmoother | None = None,
    driven: Collection[str] | None = (),
    progress: bool = False,
) -> dict[str, tuple[Baseline, Match]]:
    """Baselines and their matches, without their descriptors but while a smoother drives them.

    Args:
        driven: keys of those that are also matched by the smoother, all in one pass; None are all.
    """
    found, asked = dict[str, tuple[Baseline, Match]](), dict[str, DriveQuery]()
    for key, one in baselines:
        found[key] = one._replace(scorer=None), one.match(matching, progress)
        if one.scorer is not None and smoother is not None and (driven is None or key in driven):
            asked[key] = DriveQuery(wrapped(one.scorer, matching), smoother, radius=0, asks=False)
        del one  # its descriptors, before those of the next
    for key, drive in zip(asked, localize_drives([*asked.values()], progress), strict=True):
        (one, match), best = found[key], drive.map(lambda column: column[:, 0])
        found[key] = one, replace(match, sequences={**match.sequences, "smoother": best})
    return found


def nearest_frames(
    reference: Tensor,
    query: Tensor,
    k: int = 1,
    metric: Metric = "l1",
    progress: bool = False,
    matching: Matching = SINGLE,
    layout: Layout = ROUTE,
) -> Match:
    """The nearest stored frame of each query, if every k-th reference frame is stored.

    Args:
        reference: (N,D) features. query: (Q,D) features.
        k: 1 stores all frames. Other frames have the distance of the nearest stored one.
        progress: show progress on stderr.
        layout: of the frames: every k-th is stored in each direction.

    Returns:
        Match of (Q,). Single queries find stored frames only, sequences also frames between these.
    """
    scorer = OfStored(reference, query, k, metric, layout)
    return replace(answer(scorer, matching, progress, "baselines"), probability=None)


def stored_frames(frames: int, k: int, layout: Layout = ROUTE) -> tuple[Tensor, Tensor]:
    """The frames that a stride of k stores, (n,), and of each frame which of these is nearest, (N,)."""
    return layout.reaching(frames).strided(k)


def stride_bytes(frames: int, dimension: int, itemsize: int, k: int, layout: Layout = ROUTE) -> int:
    """Bytes of every k-th of `frames` frames."""
    return len(stored_frames(frames, k, layout)[0]) * dimension * itemsize


def fair_stride(frames: int, dimension: int, itemsize: int, map_bytes: int, tolerance: int) -> int:
    """The largest stride k, at most twice the tolerance, whose frames take at least the map's bytes.

    Example:
        >>> fair_stride(frames=1000, dimension=10, itemsize=4, map_bytes=8000, tolerance=5)
        5
    """
    coarsest = max(1, 2 * tolerance)
    strides = *range(1, min(coarsest, frames) + 1), coarsest  # a stride beyond the route stores one frame
    fair = [k for k in strides if stride_bytes(frames, dimension, itemsize, k) >= map_bytes]
    return max(fair, default=1)


class Quantised(NamedTuple):
    """Every k-th frame, coded by a product quantiser.

    restored: (N,K) descriptors, those of the stored frames as they are decoded. k: the stride. bytes: of all
    codes. codebooks: their bytes. share: of the frames that are found by the mean of their neighbours.
    """

    restored: Tensor
    k: int
    bytes: int
    codebooks: int
    share: float


def quantised_every_kth(
    descriptors: Tensor,
    each: float,
    tolerance: int,
    layout: Layout = ROUTE,
    seed: int = 0,
    centroids: int = CENTROIDS,
    training: Tensor | None = None,
) -> Quantised:
    """Every k-th frame with k times the bytes: of the k up to 2 x tolerance + 1 the one that finds most
    frames by the mean of their two neighbours, the smallest of the best. The queries have no say in it.

    Args:
        descriptors: (N,K). each: bytes per frame, of the codes. tolerance: in frames.
        layout: of the frames: every k-th is stored in each direction.
        seed, centroids, training: see `product_quantised`.
    """
    frames, width = descriptors.shape
    middle = torch.arange(frames)[1:-1]
    layout = layout.reaching(frames)
    middle = middle[layout.distance(middle - 1, middle + 1) == 2]
    middle = middle[torch.linspace(0, len(middle) - 1, min(ASKED, len(middle))).round().long()]
    asked, bits = (descriptors[middle - 1] + descriptors[middle + 1]) / 2, math.log2(centroids)
    best: Quantised | None = None
    fits = SAME_SIZE * each * frames
    for k in range(1, 2 * tolerance + 2):
        stored = layout.strided(k)[0]
        codes = min(width, max(1, int(8 * fits / len(stored) / bits)))
        size = math.ceil(codes * bits * len(stored) / 8)
        if size > fits and (best is not None or k <= 2 * tolerance):  # one is taken in any case
            continue
        decoded, books = product_quantised(descriptors[stored], codes, seed, centroids, training)
        index = stored[(normalize(asked) @ normalize(decoded).T).argmax(1).cpu()]
        share = float((layout.distance(index, middle) <= tolerance).double().mean())
        if best is None or share > best.share:
            best, kept = Quantised(descriptors, k, size, books, share), (stored, decoded)
        if share == 1:  # no larger stride finds more
            break
    assert best is not None
    stored, decoded = kept
    return best._replace(restored=descriptors.index_copy(0, stored.to(descriptors.device), decoded))


def baselines_of(
    run: Localization, seed: int = 0, leave_out: int | None = None, progress: bool = False
) -> Iterator[tuple[str, Baseline]]:
    """The baselines and null controls of a run, each when it is asked for, with their keys in report.json
    (convention 8).

    Args:
        seed: for shuffling the null controls.
        leave_out: also query the reference with itself, see `leave_out_match`; single queries.
        progress: show progress bars on a terminal.
    """
    model, reference = run.model, run.reference_features
    layout = model.map.layout
    spectral = isinstance(model.map, SpectralMap)
    one = "place" if len(model.map.positions) else layout.noun
    summary, coarsest, (frames, dimension) = model.summary(), run.coarsest, reference.shape
    needed = ("backbone", "whitening") if spectral else ("backbone",)  # by every baseline
    fixed = sum(summary.fixed.get(part, 0) for part in needed)
    metric: Metric = getattr(model.map, "metric", "l1")
    if spectral and metric != "l2":
        metric = "cosine"

    def nearest(name: str, stored: Tensor, k: int, bytes: int, stride: int = 1, more: int = 0) -> Baseline:
        scorer = run.scorer_by(lambda queries: OfStored(stored, queries, stride, metric, layout))
        return Baseline(name, scorer, bytes + fixed + more, k, fixed + more)

    size, own = partial(stride_bytes, frames, dimension, layout=layout), reference.element_size()
    if spectral:
        short, name, strided = as_int8(reference), "its descriptors", f"{every(coarsest, one)}, int8"
        if is_ready(run.reference):
            yield from _as_given(run, summary.route_bytes / frames, seed, one, progress).items()
        if summary.route_bytes >= 1.5 * frames:
            yield from _in_one_byte(run, one).items()
        yield "uncompressed", nearest(f"{name}, {every(1, one)}, float", reference, 1, size(4, 1))
        if not is_ready(run.reference):
            coded = quantised_every_kth(reference, summary.route_bytes / frames, coarsest // 2, layout, seed)
            restored, k, taken, books, _ = coded
            quantiser = f"{name}, {every(k, one)}, product quantiser"
            yield "product_quantiser", nearest(quantiser, restored, k, taken, k, books)
            del coded, restored
        yield "stride", nearest(f"{name}, {strided}", short, coarsest, size(1, coarsest), coarsest)
        if INTERPOLATES[layout.dimensions]:
            between, spaced, keys = interpolated(short, summary.route_bytes)
            interpolating = f"{name}, {every(spaced, one)}, interpolated"
            yield "interpolated", nearest(interpolating, between, spaced, keys * dimension)
    else:
        fair = fair_stride(frames, dimension, own, summary.map_bytes - fixed, run.tolerance)
        name = "" if isinstance(model.features, HOG) else "same features, "
        skipped = "" if run.tolerance else " (tolerance 0 needs all of them)"
        names = {
            "uncompressed": (f"{name}all {frames} {one}s{skipped}", 1),
            "stride": (f"{name}{every(fair, one)} (at least the map's bytes)", fair),
            "stride_coarsest": (f"{name}{every(coarsest, one)} (2 x tolerance)", coarsest),
        }
        for key, (name, k) in names.items():
            yield key, nearest(name, reference, k, size(own, k), k)

    yield from _null_controls(run, seed, one).items()
    if leave_out is not None:
        itself = leave_out_match(model, reference, leave_out)
        itself = replace(itself, accepted=itself.score.isfinite())
        yield "leave_out", Baseline(f"reference on itself, +-{leave_out} left out", None, found=itself)
    pair, batch = (run.reference, run.asked), model.batch_size
    if not _is_plain_hog(model):
        same = recipe_of(model.preprocess) == recipe_of(Preprocess())
        known = [model.descriptor.hog_of(traverse) for traverse in pair] if same else []
        yield from hog_baselines(*pair, batch, run.coarsest // 2, progress, known).items()
    if run.sequence is not None:  # SeqSLAM compares the grey pixels of small frames by L1
        plain = DejaVu(PatchPixels(), "none", batch_size=batch, preprocess=Preprocess("grey"))
        names = {"seqslam": ("SeqSLAM's pixels: grey, patches normalised", 1)}
        yield from _described_baselines(plain, names, pair, progress).items()


def _in_one_byte(run: Localization, one: str) -> dict[str, Baseline]:
    """The run's map coded in one route byte per place, if that can be met."""
    model, place_map = run.model, run.model.map
    assert isinstance(place_map, SpectralMap)
    same = place_map.chunk, place_map.transform, place_map.metric, place_map.resolution
    small = with_mapper(model, SpectralMapper(1.0, None, *same))
    try:
        small.learn_features(run.reference_features, layout=place_map.layout)
    except InputError:  # less than the mean takes
        return {}
    fixed, route = model.summary().fixed_bytes, small.summary().route_bytes
    scorer = run.scorer_by(partial(OfMap, small.map))
    return {"one_byte": Baseline(f"this map in 1 byte per {one}", scorer, fixed + route, None, fixed)}


def _as_given(run: Localization, each: float, seed: int, one: str, progress: bool) -> dict[str, Baseline]:
    """Descriptors of another program as they are, by cosine: all of them, and in `each` bytes per frame."""
    plain = DejaVu(whitening="none", batch_size=run.model.batch_size)
    stored, queries = (plain.descriptor.all_of(one, progress) for one in (run.reference, run.query))
    stored, layout = normalize(stored.float()), run.model.map.layout
    restored, k, taken, books, _ = quantised_every_kth(stored, each, run.coarsest // 2, layout, seed)

    def baseline(name: str, rows: Tensor, bytes: int, k: int = 1, fixed: int = 0) -> Baseline:
        scorer = OfStored(rows, queries, k, "cosine", layout)
        return Baseline(f"your descriptors, {every(k, one)}{name}", scorer, bytes + fixed, k, fixed)

    return {
        "exact": baseline(", exact cosine", stored, stored.nbytes),
        "product_quantiser": baseline(", product quantiser", restored, taken, k, books),
    }


def _null_controls(run: Localization, seed: int, one: str) -> dict[str, Baseline]:
    """Maps of the same frames in random order; `one` is the word for a place."""
    model, spectral = run.model, isinstance(run.model.map, SpectralMap)
    found = {}

    def null(name: str, same_plan: bool = False) -> Baseline:
        shuffled, order = null_map(model, run.reference_features, seed, same_plan)
        scorer = run.scorer_by(lambda queries: Reordered(OfMap(shuffled.map, queries), order))
        return Baseline(f"control: {name}", scorer)

    foreign = isinstance(model.mapper, TemplateMapper) and model.mapper.periods is None
    if foreign:
        log.warning("no null control with new periods: the map's periods come from outside this package")
    if spectral:
        found["null"] = null(f"shuffled {one}s, as many bytes")
    elif model.trained is None and not foreign:
        found["null"] = null(f"everything learned from shuffled {one}s")
    if isinstance(model.map, TemplateMap):
        if model.trained is None:
            found["null_same_plan"] = null(f"this map's layers, shuffled {one}s", same_plan=True)
        else:  # a second training would take too long
            found["null"] = null(f"templates of shuffled {one}s", same_plan=True)
    return found


def _is_plain_hog(model: DejaVu) -> bool:
    """Whether the uncompressed baseline is default HOG by L1."""
    pairs = (model.preprocess, Preprocess()), (model.features, HOG())
    same = all(recipe_of(own) == recipe_of(plain) for own, plain in pairs)
    return same and model.whitening is None and getattr(model.map, "metric", "l1") == "l1"


def as_int8(descriptors: Tensor) -> Tensor:
    """Descriptors rounded to int8 with one scale for all. (N,K) -> (N,K) float."""
    scale = descriptors.abs().max().clamp(min=1e-30) / 127
    return (descriptors / scale).round() * scale


def interpolated(descriptors: Tensor, route_bytes: float) -> tuple[Tensor, int, int]:
    """Descriptors of all frames, interpolated between keyframes: (N,K) -> (N,K), k, number of keyframes.

    k is the smallest stride whose `keyframes` fit in `route_bytes`, at one byte per dimension; at least two
    keyframes are used.
    """
    frames, dimension = descriptors.shape
    fitting = (k for k in range(1, frames) if (-(-(frames - 1) // k) + 1) * dimension <= route_bytes)
    k = next(fitting, max(1, frames - 1))
    keys = descriptors[keyframes(frames, k)]
    return between_keyframes(keys, frames, k), k, len(keys)


def keyframes(frames: int, k: int) -> Tensor:
    """The numbers of every k-th frame and of the last.

    Example:
        >>> keyframes(10, 4)
        tensor([0, 4, 8, 9])
    """
    return torch.arange(0, frames + k - 1, k).clamp(max=frames - 1)


def between_keyframes(keys: Tensor, frames: int, k: int) -> Tensor:
    """Descriptors of all frames, interpolated linearly between those of `keyframes`. (n,K) -> (N,K)."""
    position = torch.arange(frames, device=keys.device)
    low = (position // k).clamp(max=len(keys) - 1)
    high = (low + 1).clamp(max=len(keys) - 1)
    width = ((high * k).clamp(max=frames - 1) - low * k).clamp(min=1)
    share = ((position - low * k) / width)[:, None].to(keys)
    return torch.lerp(keys[low], keys[high], share)


def hog_baselines(
    reference: Traverse,
    query: Traverse,
    batch_size: int,
    tolerance: int,
    progress: bool = False,
    known: Sequence[Tensor | None] = (),
) -> dict[str, Baseline]:
    """HOG of all frames and of every k-th, k = 2 x tolerance, by L1; empty if HOG cannot be computed.

    known: HOG of both traverses, if it has been computed before.
    """
    one = "place" if isinstance(reference, ResampledTraverse) else reference.layout.noun
    strides = {"hog": 1, "hog_stride_coarsest": max(1, 2 * tolerance)}
    names = {key: (f"HOG, {every(k, one)}", k) for key, k in strides.items()}
    plain = DejaVu(whitening="none", batch_size=batch_size)
    return _described_baselines(plain, names, (reference, query), progress, known)


def _described_baselines(
    plain: DejaVu,
    names: Mapping[str, tuple[str, int]],
    traverses: tuple[Traverse, Traverse],
    progress: bool,
    known: Sequence[Tensor | None] = (),
) -> dict[str, Baseline]:
    """Baselines by L1 that store every k-th reference frame, described by `plain`."""
    if len(traverses[0].frame_shape) != 3:
        return {}
    try:
        stored, queries = (
            plain.descriptor.all_of(traverse, progress) if rows is None else rows
            for traverse, rows in zip(traverses, known or (None, None), strict=True)
        )
    except InputError as error:
        log.info("no %s to compare with: %s", type(plain.features).__name__, error)
        return {}
    layout = traverses[0].layout
    size = partial(stride_bytes, len(stored), stored.shape[1], stored.element_size(), layout=layout)

    def baseline(name: str, k: int) -> Baseline:
        return Baseline(name, OfStored(stored, queries, k, layout=layout), size(k), k)

    return {key: baseline(name, k) for key, (name, k) in names.items()}


def every(k: int, one: str) -> str:
    """Every k-th frame or place, in words."""
    ending = "th" if k % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(k % 10, "th")
    return f"every {one}" if k == 1 else f"every {k}{ending} {one}"
