"""The paper's experiments (section V) on simulated routes, with the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch

from dejavu_torch.data.ground_truth import GroundTruth, scored_and_right
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.activation import share
from dejavu_torch.evaluation.compare import Comparison, compare
from dejavu_torch.evaluation.contenders import Contender, contend
from dejavu_torch.evaluation.controls import leave_out_match, with_mapper
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.evaluation.paper_tables import PUBLISHED
from dejavu_torch.evaluation.pictures import paper_pictures
from dejavu_torch.evaluation.report import Report
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import Facts, InputError, Match, Traverse

PATCH = (32, 32)  # pixels: slightly more rows than the region of ground has in a frame
PAPER: Facts = {"min_period": 8, "peaks": "bins", "false_alarm": None, "short": "refuse"}
SETTINGS = ("min_period", "strongest", "peaks", "false_alarm", "short")  # of the analysis, except its chunks


def paper_model(reference: Traverse | None = None) -> DejaVu:
    """The settings of configs/paper.yaml, which follow the paper literally.

    Args:
        reference: a traverse; if it has `corners`, they give the velocity (section IV-B).
    """
    periods = SpectrogramAnalysis(**PAPER)
    ground = getattr(reference, "corners", None)
    velocity = None if ground is None else GroundOdometry(ground, PATCH)
    return DejaVu(mapper=TemplateMapper(periods, reduction="sum"), velocity=velocity)


def reproduce(
    dataset: str,
    model: DejaVu | None = None,
    *,
    tolerance: int = 5,
    seed: int = 0,
    frames: int | None = None,
    progress: bool = False,
) -> Comparison:
    """One of the paper's datasets: a second traverse, and the database queried with itself.

    Args:
        dataset: a key of `PUBLISHED`.
        model: settings; None is `paper_model` of the dataset.
        tolerance: places within which one is right, inclusive.
        seed: of the simulated route. frames: its length; None is the simulator's default.
        progress: show progress bars on a terminal.

    Returns:
        The comparison of the second traverse, with additional entries in its report:

        - `ideal`, the paper's conditions: the database itself is queried, and every frame is part of its own
          templates; `ideal_leave_out`, without the frames within the tolerance of the query in any mean;
        - `comparable` and `known_boundaries`, if the simulator knows the route's structures, see
          `known_boundaries`; the fact `boundaries` has their `BoundaryEffect`;
        - the facts `published`, and `measured_distance` of a train.

    Raises:
        InputError: an unknown dataset, or bad input of any of the stages.
    """
    if dataset not in PUBLISHED:
        raise InputError(f"there is no dataset {dataset!r}; expected {', '.join(PUBLISHED)}")
    address = f"sim:{dataset}?seed={seed}" + (f"&frames={frames}" if frames else "")
    reference, query = open_source(address), open_source(f"{address}&traverse=1")
    model = paper_model(reference) if model is None else model
    reporting = Reporting(progress=progress)
    result = compare(reference, query, model=model, tolerance=tolerance, reporting=reporting)
    places = result.run.reference_features
    itself = torch.arange(len(places))[:, None]
    left_out = f"ideal, +-{tolerance} {result.run.unit} left out"
    contenders = {
        **result.report.contenders,
        "ideal": contend("ideal: the database itself", model.localize(places), itself, tolerance),
        "ideal_leave_out": contend(left_out, leave_out_match(model, places, tolerance), itself, tolerance),
    }
    facts: Facts = {
        **result.report.facts,
        "published": PUBLISHED[dataset]._asdict(),
    }
    first, second = result.run.reference, result.run.query
    if isinstance(first, ResampledTraverse) and isinstance(second, ResampledTraverse):
        distances = {"reference": measured_distance(first), "query": measured_distance(second)}
        facts["measured_distance"] = distances
    frames_of_cuts = torch.tensor(structure_cuts(reference), dtype=torch.int64)
    cuts: list[int] = result.run.model.map.place_of(frames_of_cuts).unique().tolist()
    if cuts:
        boundaries = known_boundaries(result, cuts)
        contenders |= {key: contender for key, (contender, _) in boundaries.items()}
        effects = {key: effect._asdict() for key, (_, effect) in boundaries.items()}
        facts["boundaries"] = {"cuts": len(cuts), **effects}
    report, pictures = Report(result.report.ours, contenders, facts), paper_pictures(result.run)
    return result._replace(report=report, pictures={**pictures, **result.pictures})


def measured_distance(resampled: ResampledTraverse) -> float | None:
    """The distance measured on the ground, as a share of a simulated train's true one; None otherwise."""
    span, metres = (getattr(resampled.traverse, name, None) for name in ("ground_span", "distance"))
    if span is None or metres is None:
        return None
    rows = float(resampled.positions[-1]) * resampled.step  # of pixels; the patch spans `ground_span` metres
    measured = rows / (resampled.odometry.size[0] - 1) * float(span)
    return measured / float(metres[-1] - metres[0])


def structure_cuts(reference: Traverse) -> list[int]:
    """Reference frames at which a repeating structure starts or stops; empty if the traverse has none.

    A simulated railway has `structures`, (name, period, start, stop) in metres, and `distance`, (N,)
    metres of each frame.
    """
    structures, distance = (getattr(reference, name, None) for name in ("structures", "distance"))
    if structures is None or distance is None:
        return []
    metres = {float(edge) for _, _, start, stop in structures for edge in (start, stop)}
    inside = [edge for edge in metres if float(distance[0]) < edge < float(distance[-1])]
    frames = torch.searchsorted(distance.double(), torch.tensor(inside, dtype=torch.float64))
    return sorted(set(frames.tolist()))


class GivenChunks(SpectrogramAnalysis):
    """The spectrogram analysis on given chunks; one shorter than 2 * min_period joins the one before it."""

    def __init__(self, cuts: Sequence[int], **settings: Any) -> None:
        super().__init__(**settings)
        self.cuts = list(cuts)

    def chunks(self, places: int) -> list[tuple[int, int]]:
        """The chunks [start, stop) of a route of this many places."""
        shortest = 2 * self.min_period
        if places < shortest:
            raise InputError(f"the route has {places} places; expected at least {shortest}, two periods")
        edges = [0]
        for cut in self.cuts:
            if edges[-1] + shortest <= cut <= places - shortest:
                edges.append(cut)
        return list(pairwise([*edges, places]))


class BoundaryEffect(NamedTuple):
    """Recall@1 of the queries within `near` places of a cut, and of the others; None without any."""

    near: int
    queries_near: int
    queries_far: int
    recall_at_1_near: float | None
    recall_at_1_far: float | None


def boundary_effect(
    match: Match, truth: GroundTruth, cuts: Sequence[int], tolerance: int, near: int = 32
) -> BoundaryEffect:
    """Recall@1 near the cuts, places at which a structure starts or stops, and far from them."""
    if not cuts:
        raise InputError("there are no cuts; expected at least one place where a structure starts or stops")
    scored, right = scored_and_right(match.index, truth, tolerance)
    answered = scored & (truth.positives >= 0).any(1)
    distance = (truth.positives[:, :, None] - torch.tensor(list(cuts))).abs().amin(2)
    close = ((distance <= near) & (truth.positives >= 0)).any(1)
    inside, outside = answered & close, answered & ~close
    recalls = share(right, inside), share(right, outside)
    return BoundaryEffect(near, int(inside.sum()), int(outside.sum()), *recalls)


def known_boundaries(result: Comparison, cuts: Sequence[int]) -> dict[str, tuple[Contender, BoundaryEffect]]:
    """The cost of chunks that do not end where structures start and stop (section V, underground).

    Raises:
        InputError: a comparison without ground truth, or whose periods are not of `SpectrogramAnalysis`.
    """
    mapper, truth = _mapper(result.run.model), result.run.truth
    if truth is None or mapper is None:
        raise InputError("the comparison lacks a ground truth or SpectrogramAnalysis; expected both")
    same, given = "the same chunks", "chunks cut where structures start and stop"
    ways = {
        "comparable": (same, mapper.periods),
        "known_boundaries": (given, GivenChunks(cuts, **_settings(mapper))),
    }
    effects = {}
    for key, (name, periods) in ways.items():
        model = _learned(result, TemplateMapper(periods, mapper.metric, "mean"))
        match = _localized(model, result)
        contender = result.run.contend(f"{name}, comparable scores", match, model)
        effects[key] = contender, boundary_effect(match, truth, cuts, result.run.tolerance)
    return effects


def _mapper(model: DejaVu) -> TemplateMapper | None:
    """The model's mapper, if it makes templates from a spectrogram analysis."""
    mapper = model.mapper
    if isinstance(mapper, TemplateMapper) and isinstance(mapper.periods, SpectrogramAnalysis):
        return mapper
    return None


def _settings(mapper: TemplateMapper) -> Facts:
    """The settings of a spectrogram analysis, except its chunks."""
    return {name: getattr(mapper.periods, name) for name in SETTINGS}


def _learned(result: Comparison, mapper: TemplateMapper) -> DejaVu:
    """The model of a comparison, with a map by another mapper."""
    model = with_mapper(result.run.model, mapper)
    return model.learn_features(result.run.reference_features, result.run.reference)


def _localized(model: DejaVu, result: Comparison) -> Match:
    """The matches of a model, with the places that are scored."""
    return model.localize(result.run.query_features).renumbered(model.map.table.scored)
