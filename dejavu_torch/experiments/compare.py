"""Learn, localize, judge, and set it beside the baselines and the null control."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

import dejavu_torch
from dejavu_torch.data.truth import Shown, as_truth, unit_of
from dejavu_torch.data.truthfile import check_truth_text, describe_truth, find_truth
from dejavu_torch.database.l1 import l1_backend
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.controls import leave_out_match
from dejavu_torch.evaluation.curves import (
    RECALL_DEFINITION,
    count_queries,
    curve_of,
    threshold_of_full_precision,
)
from dejavu_torch.evaluation.pictures import Localization, draw_pictures
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.report import Report
from dejavu_torch.experiments.others import Other, hog_others, others_of
from dejavu_torch.features.extract import feature_batches, frame_shape
from dejavu_torch.features.hog import HOG
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.periods.stft import BACKEND
from dejavu_torch.types import GroundTruth, InputError, Match, Traverse

log = logging.getLogger("dejavu_torch")


class Comparison(NamedTuple):
    """A comparison's figures, matches and pictures.

    model holds the map; stored (N,D) and seen (Q,D) are the features of reference and query; truth is
    None where there is none; reference and query are the traverses as they were learnt and localized, shown
    tells the frames of both where they are evenly spaced, else None.
    """

    report: Report
    match: Match
    model: DejaVu
    pictures: Mapping[str, Picture]
    stored: Tensor
    seen: Tensor
    truth: GroundTruth | None
    reference: Traverse
    query: Traverse
    shown: Shown | None


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
    learn: bool = True,
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
        learn: False judges the map that the model has, of this very reference, as training made it.

    Raises:
        InputError: bad input of any of the stages, or a map of another number of places.
    """
    if tolerance < 0 or (leave_out is not None and leave_out < 0):
        raise InputError(f"tolerance is {tolerance}, leave_out {leave_out}; expected at least 0")
    if leave_out is not None and not learn and model is not None and model.trained is not None:
        raise InputError(
            f"leave_out is {leave_out}, but trained templates are no means of frames to leave out"
        )
    if truth is not None:
        check_truth_text(truth, interpolate)
    known = None
    model = DejaVu() if model is None else model
    _check_sizes(model, reference, query)
    came, shown, clock = (reference, query), None, Clock()
    with clock("learn"):
        reference = model.evenly(reference, None if learn else model.step, progress)
    if isinstance(reference, ResampledTraverse):
        with clock("localize"):
            query = model.evenly(query, reference.step, progress)
        frame = query.frame if isinstance(query, ResampledTraverse) else None
        shown = Shown(frame, reference.frame, reference.place_of, came[1].length)
    early = reference.length is not None and query.length is not None
    if early:  # a truth that does not fit is told before the long work
        known = find_truth(truth, *came, reference.length, query.length or 0, interpolate, shown)
        if not learn:
            _check_places(model, reference, reference.length or 0)
    if reference.name == query.name:
        log.warning(
            "%s is matched with itself, every frame with its own; judge on a second traverse", query.name
        )
    with clock("learn"):
        stored = model.extract_all(reference, "learning" if progress else None)
        if learn:
            model.learn_features(stored, reference)
        else:
            _check_places(model, reference, len(stored))
            _check_own(model, stored, tolerance, reference.name)
    with clock("localize"):
        seen = model.extract_all(query, "localizing" if progress else None)
        model.check_queries(frame_shape(query), seen.shape[1], query.name)
        match = model.localize(seen)

    if not early:
        known = find_truth(truth, *came, len(stored), len(seen), interpolate, shown)
    others = others_of(model, stored, seen, tolerance, seed, progress)
    if not isinstance(model.features, HOG) and len(frame_shape(reference)) == 3:
        others |= hog_others(reference, query, model.batch_size, tolerance, progress)
    if leave_out is not None:
        itself = leave_out_match(model, stored, leave_out)
        others["leave_out"] = Other(f"reference on itself, +-{leave_out} left out", itself)
    contenders = {}
    for key, (name, other, bytes, k) in others.items():
        own = as_truth(torch.arange(len(stored))[:, None]) if key == "leave_out" else known
        contenders[key] = contend(name, other, own, tolerance, bytes, k)

    size = model.map_bytes
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
        "full_bytes": stored.numel() * model.map.templates.element_size(),
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
        "seconds_learn": clock.seconds["learn"] + (model.trained.seconds if model.trained else 0.0),
        "seconds_localize": clock.seconds["localize"],
        "accepted": int(match.accepted.sum()),
        "l1_backend": l1_backend(),
        "spectrogram_backend": BACKEND,
        "threshold": model.threshold,
        "trained": model.trained and model.trained._asdict(),
        "reference": reference.name,
        "query": query.name,
        "version": dejavu_torch.__version__,
        "torch": torch.__version__,
    }
    if isinstance(reference, ResampledTraverse):
        facts["spacing"] = {
            "step": reference.step,
            "reference_frames": len(reference.way),
            "query_frames": len(query.way) if isinstance(query, ResampledTraverse) else None,
        }
    if known is not None:
        positions = reference.place is not None and query.place is not None
        facts |= count_queries(match, known, tolerance)
        facts["truth"] = describe_truth(truth, interpolate, positions, spaced=shown is not None)
        facts["threshold_of_full_precision"] = threshold_of_full_precision(curve_of(match, known, tolerance))
    ours = contend("this map", match, known, tolerance, size)
    run = Localization(model, reference, query, stored, seen, match, known, tolerance)
    pictures = draw_pictures(run, {"map": ours, **contenders})
    facts |= {name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers}
    report = Report(ours, contenders, facts)
    return Comparison(report, match, model, pictures, stored, seen, known, reference, query, shown)


class Clock:
    """Adds up the seconds of what is done under a name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - began


def _check_sizes(model: DejaVu, reference: Traverse, query: Traverse) -> None:
    """Refuse, before the long work, traverses whose frames do not give as many features."""
    told, counts = [], []
    for traverse in (reference, query):
        counts.append(next(feature_batches(traverse, model.pipeline, 1)).shape[1])
        size = " x ".join(map(str, frame_shape(traverse)))
        told.append(f"{traverse.name} gives {counts[-1]} features a frame of {size}")
    if counts[0] != counts[1]:
        raise InputError(f"{' and '.join(told)}; expected as many, as ?width= and ?height= behind both make")


def _check_places(model: DejaVu, reference: Traverse, places: int) -> None:
    if places != model.map.places:
        raise InputError(
            f"{reference.name} gives {places} places, the map holds {model.map.places}; "
            "expected the reference that it was made of"
        )


def _check_own(model: DejaVu, stored: Tensor, tolerance: int, name: str) -> None:
    """Tell of a map that finds few of the frames that it should be made of."""
    sample = torch.arange(0, len(stored), max(1, len(stored) // 256))
    right = (model.localize(stored[sample]).index - sample).abs() <= tolerance
    if model.map.plan and right.float().mean() < 0.5:
        told = "the map finds %d of %d frames of %s; expected the reference that it was made of"
        log.warning(told, int(right.sum()), len(sample), name)


def _plain(period: object) -> int | float:
    value = float(period)  # type: ignore[arg-type]
    return int(value) if value.is_integer() else value
