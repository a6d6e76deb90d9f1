"""Learn, localize, judge, and set it beside the baselines and the null control."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

import dejavu_torch
from dejavu_torch.data.truth import Shown, as_truth, counted, unit_of
from dejavu_torch.data.truthfile import check_truth_text, describe_truth, find_truth
from dejavu_torch.evaluation.baselines import fair_stride, nearest_frames, stride_bytes
from dejavu_torch.evaluation.controls import leave_out_match, null_control
from dejavu_torch.evaluation.curves import (
    RECALL_DEFINITION,
    curve_of,
    tally,
    threshold_of_full_precision,
)
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.report import Contender, Report, contend
from dejavu_torch.evaluation.route_plots import plot_velocity
from dejavu_torch.experiments.pictures import draw_pictures
from dejavu_torch.features.extract import feature_batches, frame_shape
from dejavu_torch.features.spacing import EvenlySpaced, frames_of
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.stft import BACKEND
from dejavu_torch.recognition.l1 import l1_backend
from dejavu_torch.types import InputError, Match, Traverse, Truth

log = logging.getLogger("dejavu_torch")


class Comparison(NamedTuple):
    """A comparison's figures, matches and pictures.

    model holds the map; stored (N,D) and seen (Q,D) are the features of reference and query; truth is
    None where there is none; shown tells the frames of both where they are evenly spaced, else None;
    reference is the traverse as it was learnt.
    """

    report: Report
    match: Match
    model: DejaVu
    pictures: Mapping[str, Picture]
    stored: Tensor
    seen: Tensor
    truth: Truth | None
    shown: Shown | None
    reference: Traverse


def compare(
    reference: Traverse,
    query: Traverse,
    truth: str | None = None,
    model: DejaVu | None = None,
    tolerance: int = 5,
    leave_out: int | None = None,
    seed: int = 0,
    interpolate: bool = False,
    progress: bool = False,
) -> Comparison:
    """Learn the reference, find the queries on it, and judge that against what else could be stored.

    Args:
        reference: the traverse to learn. query: a second traverse of the route.
        truth: see `find_truth`; without a truth there are matches and pictures but no scores.
        model: settings; None is DejaVu with its defaults. It is taught the reference.
        tolerance: frames within which a place is right, inclusive.
        leave_out: also query the reference with itself, leaving out this many frames to each side of
            the query from every mean; a diagnostic.
        seed: of the shuffle of the null control.
        interpolate: see `read_truth`.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input of any of the stages.
    """
    if tolerance < 0 or (leave_out is not None and leave_out < 0):
        raise InputError(f"tolerance is {tolerance}, leave_out {leave_out}; expected at least 0")
    if truth is not None:
        check_truth_text(truth, interpolate)
    known = None
    model = DejaVu() if model is None else model
    _check_sizes(model, reference, query)
    came, shown = (reference, query), None
    began = time.perf_counter()
    reference = model.evenly(reference, progress=progress)
    measured = time.perf_counter()
    if isinstance(reference, EvenlySpaced):
        query = model.evenly(query, reference.step, progress)
        shown = Shown(frames_of(query), reference.frame)
    both = time.perf_counter()
    early = reference.length is not None and query.length is not None
    if early:  # a truth that does not fit is told before the long work
        known = find_truth(truth, *came, reference.length, query.length or 0, interpolate, shown)
    if reference.name == query.name:
        log.warning(
            "%s is matched with itself, every frame with its own; judge on a second traverse", query.name
        )
    ready = time.perf_counter()
    stored = model.extract_all(reference, "learning" if progress else None)
    model.learn_features(stored, reference)
    learnt = time.perf_counter()
    seen = model.extract_all(query, "localizing" if progress else None)
    model.check_queries(frame_shape(query), seen.shape[1], query.name)
    match = model.localize(seen)
    localized = time.perf_counter()

    if not early:
        known = find_truth(truth, *came, len(stored), len(seen), interpolate, shown)
    itemsize = model.map.templates.element_size()
    size = model.map_bytes
    frames, dimension = stored.shape
    k = fair_stride(frames, dimension, itemsize, size, tolerance)
    coarsest = max(1, 2 * tolerance)
    metric = model.matcher.metric
    everything, strided, sparse = nearest_frames(stored, seen, (1, k, coarsest), metric, progress)
    found = {
        "uncompressed": (f"all {len(stored)} frames", everything, 1),
        "stride": (f"{_every(k)} (at least the map's bytes)", strided, k),
        "stride_coarsest": (f"{_every(coarsest)} (2 x tolerance)", sparse, coarsest),
        "null": (
            "null: all learnt shuffled",
            null_control(model, stored, seen, seed, progress=progress),
            None,
        ),
        "null_same_plan": (
            "null: this map's layers, shuffled",
            null_control(model, stored, seen, seed, same_plan=True, progress=progress),
            None,
        ),
    }
    if leave_out is not None:
        itself = leave_out_match(model, stored, leave_out)
        found["leave_out"] = (f"reference on itself, +-{leave_out} left out", itself, None)

    def contender(
        name: str, match: Match, truth: Truth | None, bytes: int | None, k: int | None
    ) -> Contender:
        if truth is None or not counted(match.index, truth, tolerance).any():
            return Contender(name, None, bytes, k)
        return contend(name, match, truth, tolerance, bytes, k)

    contenders = {}
    for key, (name, other, stride) in found.items():
        bytes = None if stride is None else stride_bytes(frames, dimension, itemsize, stride)
        own = as_truth(torch.arange(len(stored))[:, None]) if key == "leave_out" else known
        contenders[key] = contender(name, other, own, bytes, stride)

    plan = model.map.plan
    chunks = model.certificate.chunks
    facts = {
        "frames": len(stored),
        "queries": len(seen),
        "tolerance": tolerance,
        "unit": unit_of(shown),
        "recall_definition": RECALL_DEFINITION,
        "map_bytes": size,
        "backbone_bytes": model.backbone_bytes,
        "bytes_per_place": size / len(stored),
        "full_bytes": stored.numel() * itemsize,
        "templates": sum(layer.phases for layer in plan),
        "template_numbers": model.map.templates.numel(),
        "periods": sorted({_plain(layer.period) for layer in plan}),
        "chunks": [
            {
                "start": c.start,
                "stop": c.stop,
                "periods": [_plain(period) for period in c.periods],
                "features": list(c.features),
            }
            for c in chunks
        ],
        "seconds_learn": measured - began + learnt - ready,
        "seconds_localize": both - measured + localized - learnt,
        "accepted": int(match.accepted.sum()),
        "l1_backend": l1_backend(),
        "spectrogram_backend": BACKEND,
        "threshold": model.threshold,
        "reference": reference.name,
        "query": query.name,
        "version": dejavu_torch.__version__,
        "torch": torch.__version__,
    }
    if isinstance(reference, EvenlySpaced):
        facts["spacing"] = {
            "step": reference.step,
            "reference_frames": len(reference.way),
            "query_frames": len(query.way) if isinstance(query, EvenlySpaced) else len(seen),
        }
    if known is not None:
        positions = reference.place is not None and query.place is not None
        facts |= tally(match, known, tolerance)
        facts["truth"] = describe_truth(truth, interpolate, positions)
        facts["threshold_of_full_precision"] = threshold_of_full_precision(curve_of(match, known, tolerance))
    ours = contender("this map", match, known, size, None)
    pictures = draw_pictures(model, reference, stored, seen, match, known, tolerance, found)
    if isinstance(reference, EvenlySpaced):
        pictures = {"velocity": _velocity(reference, query)} | pictures
    facts |= {name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers}
    report = Report(ours, contenders, facts)
    return Comparison(report, match, model, pictures, stored, seen, known, shown, reference)


def _velocity(reference: EvenlySpaced, query: Traverse) -> Picture:
    pair = [("reference", reference), ("query", query)]
    ways = {f"{role}: {one.name}": one.way for role, one in pair if isinstance(one, EvenlySpaced)}
    return Picture(
        plot_velocity(ways, reference.step),
        "how fast the ground moves",
        "The motion of the ground from frame to frame. Places are even steps along it: a camera that stands "
        "adds none.",
    )


def _check_sizes(model: DejaVu, reference: Traverse, query: Traverse) -> None:
    """Refuse, before the long work, traverses whose frames do not give as many features."""
    told, counts = [], []
    for traverse in (reference, query):
        counts.append(next(feature_batches(traverse, model.pipeline, 1)).shape[1])
        size = " x ".join(map(str, frame_shape(traverse)))
        told.append(f"{traverse.name} gives {counts[-1]} features a frame of {size}")
    if counts[0] != counts[1]:
        raise InputError(f"{' and '.join(told)}; expected as many, as ?width= and ?height= behind both make")


def _plain(period: object) -> int | float:
    value = float(period)  # type: ignore[arg-type]
    return int(value) if value.is_integer() else value


def _every(k: int) -> str:
    return "every frame" if k == 1 else f"every { ({2: '2nd', 3: '3rd'}.get(k, f'{k}th')) } frame"
