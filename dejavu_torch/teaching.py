"""Drives that teach a map without ground truth: a smoother places their frames."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.maker import check_maker
from dejavu_torch.data.moving import Moved
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.data.traverse import chained
from dejavu_torch.features.views import LabelledFrames, Placed
from dejavu_torch.features.whitening import learned_whitening
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.memory import without_autocast
from dejavu_torch.model import DejaVu, check_queries, require_map
from dejavu_torch.recognition.calibration import TOLERANCE, Calibration, calibrated_by_drive
from dejavu_torch.recognition.centring import centred
from dejavu_torch.recognition.evidence import spacing_of
from dejavu_torch.recognition.provenance import check_independent
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import InputError, Traverse, expect

SURE = 0.9  # probability of a frame that teaches
FEWEST, SHARE = 60, 0.1  # frames of a drive that teaches, and their share of it, at least
ROUNDS = 2  # of placing: the second time on a map that the first one taught
SHORTEST = 30  # frames of a drive that is placed at all
SHRINKAGE = 0.3  # of what a drive changes, when a stage is learned from it
FOLDS = 4  # stretches of a drive, each asked after a stage that was learned from the others
APART = 2  # correlation times between a stretch and what teaches its stage
ERRORS = 1  # standard errors by which places have to rank higher after a new stage
SCORES_AT_ONCE = 2**22  # scores at a time


@torch.no_grad()
def place_drive(model: DejaVu, descriptors: Tensor) -> Tensor:
    """The place of each frame of a drive, as sure as `SURE`, by the drive as a whole: (Q,K) -> (Q,) int64, -1
    for the others. All are -1 if it is no drive of the map, or too few of its frames are sure."""
    queries = in_its_light(model, descriptors)
    match = model.localize_descriptors(queries, model.matching(PlaceSmoother()))
    assert match.probability is not None
    places = torch.where(match.probability >= SURE, match.index, -1)
    few = int((places >= 0).sum()) < max(FEWEST, SHARE * len(places))
    return torch.full_like(places, -1) if few or not match.is_drive else places


def straightened(model: DejaVu, drive: Traverse) -> Traverse:
    """A drive as a camera would see it that points where it did at learning, as far as its first frames tell
    how far to the side its own does."""
    shown = model.shown_by(drive)
    usual = min(zip(shown.penalties, shown.shifts, strict=True))[1]
    return Moved(drive, (usual,)) if usual else drive


def place_drives(
    model: DejaVu,
    reference: Traverse | None,
    drives: Sequence[tuple[Traverse, Tensor | None]],
    progress: bool = False,
    most: int = ROUNDS,
) -> LabelledFrames:
    """Place drives on a map of the reference, learned from augmented copies, and once more on one that the
    drives have taught. The frames of those of a camera that points to the side are moved sideways.

    Args:
        model: its settings. reference: None is the model's own map, which learns nothing.
        drives: in order, each with the place of each frame if it is known. most: rounds of placing.
    """
    lengths = [len(drive) for drive, _ in drives]
    which = torch.arange(len(drives)).repeat_interleave(torch.tensor(lengths))
    names = {i: drive.name for i, (drive, known) in enumerate(drives) if known is None}
    scratch, views = copy.deepcopy(model), None
    with scratch.descriptor.remembering():
        for rounds in range(1, most + 1):
            if reference is not None:
                scratch.learn(reference, progress, views)
            if views is None:
                own = (
                    drive if known is not None else straightened(scratch, drive) for drive, known in drives
                )
                frames = chained([*own])
            parts = scratch.descriptor.all_of(frames, progress).split(lengths)
            pairs = zip(parts, drives, strict=True)
            found = [place_drive(scratch, part) if known is None else known for part, (_, known) in pairs]
            before, places = views, torch.cat(found)
            views = LabelledFrames(frames, places, Placed(which, names, SURE, rounds))
            if not (places >= 0).any() or (before is not None and torch.equal(before.places, places)):
                break
    assert views is not None
    return views


def in_its_light(model: DejaVu, descriptors: Tensor) -> Tensor:
    """The descriptors (Q,K) of a drive, centred if they are enough."""
    return centred(model.map, descriptors) if model.centres(len(descriptors)) else descriptors


class Refinement(NamedTuple):
    """What a drive has taught a map.

    placed, of: frames of the drive that teach, and all. gain: mean log ratio of the rank of a frame's place
    by its image alone, before and after, in stretches that did not teach; error: its standard error.
    NaN if there are too few frames to tell. accepted: whether the map is refined.
    """

    placed: int
    of: int
    gain: float = math.nan
    error: float = math.nan
    accepted: bool = False

    @property
    def changed(self) -> bool:
        """As `accepted`."""
        return self.accepted

    def __str__(self) -> str:
        if not self.placed:
            return f"0 of {self.of} frames placed; nothing is learned, the map stays as it was"
        ranks = f"ranks {abs(math.expm1(self.gain)):.1%} {'higher' if self.gain >= 0 else 'lower'}"
        told = f"where it did not teach, a place {ranks} by one image"
        told = "too few to tell whether they help" if math.isnan(self.gain) else told
        after = "the map is refined" if self.accepted else "the map stays as it was"
        return f"{self.placed} of {self.of} frames placed; {told}; {after}"


def refine(model: DejaVu, drive: Source, progress: bool = False) -> Refinement:
    """Learn what a drive changes from its frames and the map alone: a linear stage after which queries and
    places are compared. The map's lines stay as they are.

    The stage is learned from frames that a smoother has placed, see `place_drive`. It is taken if, in
    stretches of the drive that did not teach it, places rank higher by `ERRORS` standard errors.

    Args:
        model: with a spectral map. If it is calibrated, that is done anew, by the drive.
        drive: at least 30 frames in order, or descriptors as the map's.

    Raises:
        InputError: no spectral map, or a drive that does not fit it; the model stays unchanged.

    Example:
        >>> noise = torch.randn(300, 8, generator=torch.Generator().manual_seed(0))
        >>> model = DejaVu(whitening="none").learn(noise)
        >>> print(refine(model, torch.rand(40, 8)))
        0 of 40 frames placed; nothing is learned, the map stays as it was
    """
    traverse, descriptors = described(model, drive, "refine", progress)
    refined = refined_by(model, descriptors)
    refined.into(model)
    if refined.told.accepted:
        model.taught_by(traverse).look_at(traverse)
    return refined.told


def described(model: DejaVu, drive: Source, verb: str, progress: bool = False) -> tuple[Traverse, Tensor]:
    """A drive, resampled as the map is, and its descriptors (Q,K); refuses one that does not fit."""
    require_map(model, f" to {verb}")
    place_map = model.map
    place_map.layout.expect_route("that of a route", f"this is the map of an area to {verb}")
    if not isinstance(place_map, SpectralMap):
        raise InputError(f"the map is of kind {place_map.kind!r}; expected one of kind 'spectral' to {verb}")
    traverse = model.resample(as_traverse(drive), model.step, progress, model.frame_shape)
    check_maker(model.provenance.maker, "the map", traverse)
    expect(len(traverse) >= SHORTEST, f"at least {SHORTEST}", f"{traverse.name} has {len(traverse)} frames")
    features = model.descriptor.count_features(traverse)
    check_queries(model, traverse.frame_shape, features, traverse.name)
    rows = model.described(straightened(model, traverse), progress=progress)
    return traverse, rows.float().to(place_map.device)


class Refined(NamedTuple):
    """A map that a drive has taught, or as it was, and its calibration."""

    told: Refinement
    map: SpectralMap
    calibration: Calibration | None

    def into(self, model: DejaVu) -> None:
        """Give them to a model."""
        if self.map is not model.map:
            model.replace_map(self.map)
            model.calibration = self.calibration


@torch.no_grad()
def refined_by(model: DejaVu, descriptors: Tensor) -> Refined:
    """As `refine`, by the descriptors (Q,K) of a drive; the model stays as it is."""
    place_map, calibration = model.map, model.calibration
    assert isinstance(place_map, SpectralMap)
    places = place_drive(model, descriptors).to(place_map.device)
    sure = (places >= 0).nonzero()[:, 0]
    count, queries = len(places), in_its_light(model, descriptors)
    if not len(sure):
        return Refined(Refinement(0, count), place_map, calibration)
    tau, gains = spacing_of(queries).correlation, torch.zeros(count)
    before, asked = _log_ranks(place_map, queries, places), []
    for fold in torch.arange(count).tensor_split(FOLDS):
        far = (sure < int(fold[0]) - APART * tau) | (sure > int(fold[-1]) + APART * tau)
        if int(far.sum()) < SHORTEST:
            return Refined(Refinement(len(sure), count), place_map, calibration)
        refined = place_map.refined(_stage(place_map, queries, places, sure[far]))
        gains[fold] = (before - _log_ranks(refined, queries, places))[fold]
        asked.append((refined, descriptors[fold.to(descriptors.device)]))
    blocks = torch.stack([block.mean() for block in gains[sure.cpu()].split(math.ceil(tau))])
    gain, error = float(blocks.mean()), float(blocks.std() / math.sqrt(len(blocks)))
    if accepted := gain > ERRORS * error:
        place_map = place_map.refined(_stage(place_map, queries, places, sure))
        if calibration is not None:  # by maps that have not learned from what they are asked
            scores = (part.scores(rows) for part, own in asked for rows in own.split(_at_once(place_map)))
            calibration = _calibration(place_map, queries, places, scores)
    return Refined(Refinement(len(sure), count, gain, error, accepted), place_map, calibration)


@torch.no_grad()
def calibrate_by(model: DejaVu, drive: Traverse, progress: bool = False) -> LabelledFrames:
    """Calibrate a map by all frames of a drive whose places nobody told, not only those that are placed; not
    if none is. Returns where they are."""
    descriptors = model.described(straightened(model, drive), progress=progress)
    descriptors = descriptors.float().to(model.map.device)
    check_independent(model.map, drive, descriptors)
    places = place_drive(model, descriptors)
    if (places >= 0).any():
        scores = (model.map.scores(rows) for rows in descriptors.split(_at_once(model.map)))
        model.calibration = _calibration(model.map, in_its_light(model, descriptors), places, scores)
        model.taught_by(drive, places).look_at(drive)
    placed = Placed(torch.zeros(len(places), dtype=torch.int64), {0: drive.name}, SURE, 1)
    return LabelledFrames(drive, places.cpu(), placed)


def _calibration(
    place_map: PlaceMap, queries: Tensor, places: Tensor, scores: Iterator[Tensor]
) -> Calibration:
    """The calibration by the scores of all queries of a drive, which the smoother has centred."""
    layout = place_map.layout

    def rows(numbers: Tensor) -> Tensor:
        return place_map.scores(queries[numbers])

    smoother = PlaceSmoother(links=place_map.connections).fit(rows, queries, layout.starts)
    return calibrated_by_drive(scores, places, smoother, smoother.drive(rows, queries), layout)


def _at_once(place_map: PlaceMap) -> int:
    return max(1, SCORES_AT_ONCE // place_map.places)


@without_autocast
def _stage(place_map: SpectralMap, queries: Tensor, places: Tensor, some: Tensor) -> Tensor:
    """A stage (K,K) behind the map's own, from some (n,) of the queries (Q,K) and their places (Q,)."""
    queries, places = queries[some], places[some]
    rows = torch.empty_like(queries)
    for g, (start, stop) in enumerate(place_map.chunks):
        inside = (places >= start) & (places < stop)
        if inside.any():
            rows[inside] = place_map.decode(g)[places[inside] - start]
    views, shown = (F.normalize(place_map.staged(one)) for one in (queries, rows))
    _, projection = learned_whitening(views, shown, queries.shape[1], SHRINKAGE)
    size: Tensor = torch.linalg.matrix_norm(projection)
    return projection * (math.sqrt(len(projection)) / size)


def _log_ranks(place_map: SpectralMap, queries: Tensor, places: Tensor) -> Tensor:
    """The logarithm of the rank of each query's place, or the best within the tolerance of it: (Q,)."""
    near, ranks = torch.arange(-TOLERANCE, TOLERANCE + 1, device=places.device), []
    size = _at_once(place_map)
    for part, place in zip(queries.split(size), places.split(size), strict=True):
        scores = place_map.scores(part)
        window = (place[:, None] + near).clamp(0, place_map.places - 1)
        own = scores.gather(1, window).amin(1, keepdim=True)
        better = (scores < own).sum(1)
        ranks.append((1.0 + better).log().cpu())
    return torch.cat(ranks)
