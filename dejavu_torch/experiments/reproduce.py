"""The paper's experiments on simulated routes, beside the paper's own numbers (section V)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dejavu_torch.data.source import open_source
from dejavu_torch.data.truth import places_of_frames
from dejavu_torch.database.scores import Matcher
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.controls import leave_out_match, same_settings
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.pictures import Localization, paper_pictures
from dejavu_torch.evaluation.report import Report
from dejavu_torch.evaluation.score_plots import Length
from dejavu_torch.experiments.boundaries import known_boundaries
from dejavu_torch.experiments.compare import Comparison, compare
from dejavu_torch.experiments.section_five import PUBLISHED
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import InputError, Traverse

LENGTHS = (256, 512, 1024, 2048)
PATCH = (32, 32)  # pixels: as many rows as the region of ground has in a frame, and some more


def paper_model(reference: Traverse | None = None) -> DejaVu:
    """The paper's letter: the settings of configs/paper.yaml.

    Args:
        reference: a railway, whose `ground` gives the velocity (section IV-B); others are taken as they come.
    """
    periods = SpectrogramAnalysis(min_period=8, peaks="bins", false_alarm=None, short="refuse")
    ground = getattr(reference, "ground", None)
    velocity = None if ground is None else GroundOdometry(ground, PATCH)
    return DejaVu(periods=periods, reduction="sum", velocity=velocity)


def reproduce(
    dataset: str,
    model: DejaVu | None = None,
    tolerance: int = 5,
    seed: int = 0,
    frames: int | None = None,
    lengths: Sequence[int] = LENGTHS,
    progress: bool = False,
) -> Comparison:
    """One of the paper's datasets: a second traverse, and the database queried with itself.

    Args:
        dataset: a key of `PUBLISHED`.
        model: settings; None is `paper_model` of the dataset.
        tolerance: frames within which a place is right, inclusive.
        seed: of the simulated route. frames: its length, None is the simulator's own.
        lengths: of chunks, frames, to compare.
        progress: show progress bars on a terminal.

    Returns:
        The comparison of the second traverse. Its report has two more entries: `ideal`, the paper's
        conditions, in which the database itself is queried and every frame stands in its own templates;
        and `ideal_leave_out`, where all frames within the tolerance of the query are left out of every
        mean. The fact `chunk_lengths` tells recall and bytes for each of `lengths`. Where the simulator
        tells where structures start and stop, two entries tell what that costs: `comparable`, the same
        chunks with scores that are comparable between them, and `known_boundaries`, chunks cut there; the
        fact `boundaries` tells recall near to the cuts and far from them in both.

    Raises:
        InputError: an unknown dataset, or bad input of any of the stages.
    """
    if dataset not in PUBLISHED:
        raise InputError(f"there is no dataset {dataset!r}; expected {', '.join(PUBLISHED)}")
    address = f"sim:{dataset}?seed={seed}" + (f"&frames={frames}" if frames else "")
    reference, query = open_source(address), open_source(f"{address}&traverse=1")
    result = compare(
        reference,
        query,
        model=paper_model(reference) if model is None else model,
        tolerance=tolerance,
        progress=progress,
    )
    model, stored = result.model, result.stored
    itself = torch.arange(len(stored))[:, None]
    matches = {
        "ideal": ("ideal: the database itself", model.localize(stored)),
        "ideal_leave_out": (
            f"ideal, +-{tolerance} frames left out",
            leave_out_match(model, stored, tolerance),
        ),
    }
    contenders = dict(result.report.contenders)
    for key, (name, match) in matches.items():
        contenders[key] = contend(name, match, itself, tolerance)
    found = chunk_lengths(result, tolerance, lengths)
    facts = {
        **result.report.facts,
        "published": PUBLISHED[dataset]._asdict(),
        "chunk_lengths": [row._asdict() for row in found],
    }
    if isinstance(result.reference, ResampledTraverse) and isinstance(result.query, ResampledTraverse):
        shares = {"reference": way_share(result.reference), "query": way_share(result.query)}
        facts["way_measured"] = shares
    cuts = structure_places(result, structure_cuts(reference))
    if cuts and result.truth is not None:
        known = known_boundaries(result, cuts, tolerance)
        contenders |= {"comparable": known.fixed, "known_boundaries": known.known}
        facts["boundaries"] = {
            "cuts": len(cuts),
            "comparable": known.fixed_effect._asdict(),
            "known_boundaries": known.known_effect._asdict(),
        }
    run = Localization(
        *(model, result.reference, result.query, stored, result.seen, result.match, result.truth, tolerance)
    )
    pictures = paper_pictures(run) | dict(result.pictures)
    return result._replace(report=Report(result.report.ours, contenders, facts), pictures=pictures)


def chunk_lengths(result: Comparison, tolerance: int = 5, lengths: Sequence[int] = LENGTHS) -> list[Length]:
    """Recall and storage of maps whose chunks have other lengths (section VI).

    Args:
        result: with the other settings. lengths: in frames; those longer than the reference are left out.
    """
    rows: list[Length] = []
    model, stored = result.model, result.stored
    if result.truth is None or not isinstance(model.periods, SpectrogramAnalysis):
        return rows
    names = ("min_period", "strongest", "peaks", "false_alarm", "similar", "short")
    kept = {name: getattr(model.periods, name) for name in names}
    for window in lengths:
        if window <= len(stored):
            other = same_settings(model)
            other.periods = SpectrogramAnalysis(window, **kept)
            other.learn_features(stored, result.reference)
            size, found = other.map_bytes, []
            for reduction in (model.matcher.reduction, "mean"):
                other.matcher = Matcher(model.matcher.metric, reduction)
                found.append(evaluate(other.localize(result.seen), result.truth, tolerance))
            scores = found[0].recall_at_1, found[0].auc, found[1].recall_at_1
            rows.append(Length(window, *scores, size, size / len(stored)))
    return rows


def structure_cuts(reference: Traverse) -> list[int]:
    """Reference frames at which something that repeats starts or stops, where the traverse tells.

    A simulated railway has `structures`, (name, period, start, stop) in metres, and `distance`, (N,)
    metres of each frame.
    """
    structures, distance = (getattr(reference, name, None) for name in ("structures", "distance"))
    if structures is None or distance is None:
        return []
    metres = {float(edge) for _, _, start, stop in structures for edge in (start, stop)}
    inside = [edge for edge in sorted(metres) if float(distance[0]) < edge < float(distance[-1])]
    return sorted(
        set(torch.searchsorted(distance.double(), torch.tensor(inside, dtype=torch.float64)).tolist())
    )


def way_share(even: ResampledTraverse) -> float | None:
    """How far the ground says that a simulated train came, as a share of how far it did; None elsewhere."""
    span, metres = (getattr(even.traverse, name, None) for name in ("ground_span", "distance"))
    if span is None or metres is None:
        return None
    rows = float(even.way[-1]) * even.step
    return rows * float(span) / (even.normalizer.size[0] - 1) / float(metres[-1] - metres[0])


def structure_places(result: Comparison, cuts: Sequence[int]) -> list[int]:
    """Frames of the reference as places of its map, each once."""
    if result.shown is None:
        return list(cuts)
    places: list[int] = places_of_frames(torch.tensor(cuts), result.shown).unique().tolist()
    return places
