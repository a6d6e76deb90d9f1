"""What a user would store instead of the map, and the null controls: every contender of a report."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from dejavu_torch.database.distance import Metric, phase_distances
from dejavu_torch.database.spectral import SpectralMap
from dejavu_torch.database.template_map import TemplateMap
from dejavu_torch.evaluation.controls import leave_out_match, null_control
from dejavu_torch.features.hog import HOG
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.periods.finder import ForeignPeriods
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import InputError, Match, SequenceModel, Traverse

log = logging.getLogger("dejavu_torch")

DISTANCES_AT_ONCE = 2**22


class Baseline(NamedTuple):
    """Matches of another way to store the route.

    name: for tables. bytes: that it stores. k: where it stores every k-th frame. fixed: those of the bytes
    that do not grow with the route, such as a backbone's.
    """

    name: str
    match: Match
    bytes: int | None = None
    k: int | None = None
    fixed: int = 0


def nearest_frames(
    reference: Tensor,
    query: Tensor,
    strides: Sequence[int] = (1,),
    metric: Metric = "l1",
    progress: str | None = None,
    sequence: SequenceModel | None = None,
) -> list[Match]:
    """Nearest stored frame of each query, where every k-th reference frame is stored.

    Args:
        reference: (N,D) features. query: (Q,D) features.
        strides: each k; 1 stores all frames.
        progress: text of a progress bar on a terminal; None is no bar.
        sequence: as of `DejaVu.localize`; a frame that is not stored has the distance of the one before it.

    Returns:
        For each k a Match of (Q,), index in reference frames, which is one that is stored.
    """
    rows, matches = max(1, DISTANCES_AT_ONCE // len(reference)), []
    for k in strides:
        batches = tqdm(query.split(rows), progress, disable=None if progress else True, leave=False)
        stored = reference[::k]
        with torch.no_grad():
            scores: Iterable[Tensor] = (
                phase_distances(batch.to(stored.device), stored, metric) for batch in batches
            )
            if sequence is not None:
                before = torch.arange(len(reference), device=stored.device) // k
                scores = sequence.stream(part[:, before] for part in scores)
            found = [best_match(part) for part in scores]
        match = Match(*(torch.cat(column).cpu() for column in zip(*found, strict=True)))
        frame = match.index // k * k if sequence is not None else match.index * k
        matches.append(match._replace(index=torch.where(match.index >= 0, frame, -1)))
    return matches


def stride_bytes(frames: int, dimension: int, itemsize: int, k: int) -> int:
    """Bytes of every k-th of `frames` frames."""
    return -(-frames // k) * dimension * itemsize


def fair_stride(frames: int, dimension: int, itemsize: int, map_bytes: int, tolerance: int) -> int:
    """The largest k, at most twice the tolerance, whose frames take at least the map's bytes.

    Example:
        >>> fair_stride(frames=1000, dimension=10, itemsize=4, map_bytes=8000, tolerance=5)
        5
    """
    strides = range(1, max(1, 2 * tolerance) + 1)
    fair = [k for k in strides if stride_bytes(frames, dimension, itemsize, k) >= map_bytes]
    return max(fair, default=1)


def baselines_of(
    model: DejaVu,
    reference: Tensor,
    query: Tensor,
    tolerance: int,
    seed: int = 0,
    leave_out: int | None = None,
    progress: bool = False,
    sequence: SequenceModel | None = None,
) -> dict[str, Baseline]:
    """The baselines and null controls that every report sets beside the map, by their keys in report.json.

    Args:
        model: with the map. reference: (N,D) its features. query: (Q,D) those of the queries.
        tolerance: the coarsest stride is twice as much. seed: of the shuffle of the null controls.
        leave_out: also query the reference with itself, see `leave_out_match`.
        progress: show progress bars on a terminal. sequence: as of `DejaVu.localize`, of all but `leave_out`.
    """
    store = _compact_stores if isinstance(model.map, SpectralMap) else _plain_stores
    text = "baselines: what is stored as it is" if progress else None
    found = store(model, reference, query, tolerance, text, sequence)
    one = "place" if len(model.map.positions) else "frame"
    foreign = isinstance(getattr(model.mapper, "periods", None), ForeignPeriods)
    if foreign:
        log.warning("no null control learned anew: what found the map's periods is not of this package")
    if (model.trained is None or isinstance(model.map, SpectralMap)) and not foreign:
        anew = null_control(model, reference, query, seed, sequence=sequence)
        name = f"null: everything learned from shuffled {one}s"
        if isinstance(model.map, SpectralMap):
            name = f"null: shuffled {one}s, as many bytes"
        found["null"] = Baseline(name, anew)
    if isinstance(model.map, TemplateMap):
        same = null_control(model, reference, query, seed, same_plan=True, sequence=sequence)
        if model.trained is None:
            found["null_same_plan"] = Baseline(f"null: this map's layers, shuffled {one}s", same)
        else:  # training anew is a run of its own
            found["null"] = Baseline(f"null: templates of shuffled {one}s", same)
    if leave_out is not None:
        itself = leave_out_match(model, reference, leave_out)
        found["leave_out"] = Baseline(f"reference on itself, +-{leave_out} left out", itself)
    return found


def _plain_stores(
    model: DejaVu,
    reference: Tensor,
    query: Tensor,
    tolerance: int,
    progress: str | None,
    sequence: SequenceModel | None,
) -> dict[str, Baseline]:
    """The features that a template map is made of, of all frames and of every k-th."""
    frames, dimension = reference.shape
    summary, itemsize = model.summary(), reference.element_size()
    backbone = summary.fixed.get("backbone", 0)  # frames need it as well
    fair = fair_stride(frames, dimension, itemsize, summary.map_bytes - backbone, tolerance)
    strides = {"uncompressed": 1, "stride": fair, "stride_coarsest": max(1, 2 * tolerance)}
    of = "" if isinstance(model.features, HOG) else "same features, "
    one = "place" if len(model.map.positions) else "frame"
    skipped = "" if tolerance else ", of which tolerance 0 lets none be left out"
    names = {
        "uncompressed": f"{of}all {frames} {one}s{skipped}",
        "stride": f"{of}{every(fair, one)} (at least the map's bytes)",
        "stride_coarsest": f"{of}{every(strides['stride_coarsest'], one)} (2 x tolerance)",
    }
    metric = model.map.metric if isinstance(model.map, TemplateMap) else "l1"
    nearest = nearest_frames(reference, query, tuple(strides.values()), metric, progress, sequence)
    return {
        key: Baseline(names[key], match, stride_bytes(frames, dimension, itemsize, k) + backbone, k, backbone)
        for (key, k), match in zip(strides.items(), nearest, strict=True)
    }


def _compact_stores(
    model: DejaVu,
    reference: Tensor,
    query: Tensor,
    tolerance: int,
    progress: str | None,
    sequence: SequenceModel | None,
) -> dict[str, Baseline]:
    """The descriptors that a spectral map codes: all in float, every k-th and interpolated ones in int8."""
    frames, dimension = reference.shape
    summary = model.summary()
    fixed = summary.fixed_bytes - summary.fixed.get("header", 0)  # whitening and backbone: all need them
    one = "place" if len(model.map.positions) else "frame"
    apart, short = max(1, 2 * tolerance), as_int8(reference)
    between, spaced, keys = interpolated(short, model.map.summary().route_bytes)
    contenders = {
        "uncompressed": (f"its descriptors of all {frames} {one}s, float", reference, 1, frames * 4),
        "stride": (f"its descriptors of {every(apart, one)}, int8", short, apart, -(-frames // apart)),
        "interpolated": (f"interpolated between {every(spaced, one)}, int8", between, spaced, keys),
    }
    metric = model.map.metric
    found = {}
    for key, (name, stored, k, numbers) in contenders.items():
        apart = k if key == "stride" else 1
        near = "l2" if metric == "l2" else "cosine"
        (match,) = nearest_frames(stored, query, (apart,), near, progress, sequence)
        found[key] = Baseline(name, match, numbers * dimension + fixed, k, fixed)
    return found


def as_int8(descriptors: Tensor) -> Tensor:
    """Descriptors as a store of int8 with one scale gives them back. (N,K) -> (N,K) float."""
    scale = descriptors.abs().max().clamp(min=1e-30) / 127
    return (descriptors / scale).round() * scale


def interpolated(descriptors: Tensor, route_bytes: float) -> tuple[Tensor, int, int]:
    """Descriptors of all frames on straight lines between keyframes: every k-th, and the last.

    k is the smallest whose keyframes take at most so many bytes, at a byte a number; two of them where none
    do.

    Shape: (N,K) -> (N,K), k, number of keyframes.
    """
    frames, dimension = descriptors.shape
    fair = (k for k in range(1, frames) if (-(-(frames - 1) // k) + 1) * dimension <= route_bytes)
    k = next(fair, max(1, frames - 1))
    keys = descriptors[torch.arange(0, frames + k - 1, k).clamp(max=frames - 1)]
    position = torch.arange(frames, device=keys.device)
    low = (position // k).clamp(max=len(keys) - 1)
    high = (low + 1).clamp(max=len(keys) - 1)
    width = ((high * k).clamp(max=frames - 1) - low * k).clamp(min=1)
    share = ((position - low * k) / width)[:, None].to(keys)
    return torch.lerp(keys[low], keys[high], share), k, len(keys)


def hog_baselines(
    reference: Traverse,
    query: Traverse,
    batch_size: int,
    tolerance: int,
    progress: bool = False,
    sequence: SequenceModel | None = None,
) -> dict[str, Baseline]:
    """What a map of other features is set beside: HOG of all frames, and of every k-th, k = 2 x tolerance.

    Nothing where the traverses hold ready features, or frames too small for HOG.
    """
    if len(reference.frame_shape) != 3:
        return {}
    plain = DejaVu(batch_size=batch_size)
    try:
        stored = plain.extract_all(reference, "baselines: HOG of the reference" if progress else None)
        queries = plain.extract_all(query, "baselines: HOG of the query" if progress else None)
    except InputError as error:
        log.info("no HOG to compare with: %s", error)
        return {}
    one = "place" if isinstance(reference, ResampledTraverse) else "frame"
    strides = {"hog": 1, "hog_stride_coarsest": max(1, 2 * tolerance)}
    text = "baselines: HOG of all frames" if progress else None
    nearest = nearest_frames(stored, queries, tuple(strides.values()), "l1", text, sequence)
    frames, dimension = stored.shape
    return {
        key: Baseline(
            f"HOG, {every(k, one)}", match, stride_bytes(frames, dimension, stored.element_size(), k), k
        )
        for (key, k), match in zip(strides.items(), nearest, strict=True)
    }


def every(k: int, one: str) -> str:
    """In words: every k-th frame, or place where these are not frames."""
    ending = "th" if k % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(k % 10, "th")
    return f"every {one}" if k == 1 else f"every {k}{ending} {one}"
