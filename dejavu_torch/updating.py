"""A map that grows by every drive: what a drive changes refines it, and ground that it lacks is appended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.source import Source
from dejavu_torch.growth import free_name, joined_names
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral import encode_chunk
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.places.states import Link
from dejavu_torch.recognition.calibration import TOLERANCE
from dejavu_torch.recognition.drive import Answers, DriveQuery, answer_drives
from dejavu_torch.recognition.evidence import spacing_of
from dejavu_torch.recognition.scorer import OfMap, Scorer, Wrapped
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.teaching import FEWEST, SHARE, SURE, Refinement, described, in_its_light, refined_by
from dejavu_torch.types import Match, Traverse

NEWEST, TAUS = 20, 2  # frames of a stretch that is stored, and correlation times, at least
PIECE = 100  # frames that are stored at a time, so that another lap over them is found there
OFF, SURELY = 0.5, 0.9  # probability of being off the map of a frame that is, and mean of a new stretch
HEADED, NEAR = 10, 10  # frames that tell a direction of travel, and places between two of them, at most
RECOGNISED = 0.9  # share of placed frames of which a single image finds the place: where so many are known,
# frames that are not known show new ground; else only beyond the ends of a route
BATCH = 256  # queries at a time
BRANCH = 0.5  # probability of a link from or to a place within a route; from end to start it is 1

Stretch = tuple[int, int]  # frames [first, last) of a drive


class NewGround(NamedTuple):
    """What a drive shows of ground that a map lacks: stretches to store, others that may only be hard to
    recognise, and the answers of the map that has the first."""

    new: list[Stretch]
    unknown: list[Stretch]
    answers: Answers


class Update(NamedTuple):
    """What a drive has brought to a map.

    refinement: None if the drive has too few frames to teach. is_drive: whether it is one of the map.
    stretches: frames [first, last) of the drive that were stored, each as a route of this name.
    unknown: those that may be new or hard to recognise, which were not.
    """

    refinement: Refinement | None
    is_drive: bool
    stretches: tuple[Stretch, ...] = ()
    names: tuple[str, ...] = ()
    unknown: tuple[Stretch, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether the map is another one."""
        return bool(self.stretches) or (self.refinement is not None and self.refinement.changed)

    def __str__(self) -> str:
        if not self.is_drive:
            return "not a drive on this map; nothing is learned, the map stays as it was"
        told = "too few frames to learn from" if self.refinement is None else str(self.refinement)
        pairs = zip(self.stretches, self.names, strict=True)
        new = [f"frames {first}-{last - 1} are new, the route {name}" for (first, last), name in pairs]
        hard = [f"frames {first}-{last - 1} may be new, or hard to recognise" for first, last in self.unknown]
        return "; ".join([told, *(new + hard or ["nothing new"])])


@torch.no_grad()
def update(
    model: DejaVu, drive: Source, progress: bool = False, name: str | None = None, own: str = "map"
) -> Update:
    """Refine a map by a drive, see `refine`, and append stretches of the drive that are off the map.

    A stretch is new if the smoother is sure that at least 20 frames, and two correlation times, are off the
    map, and if it lies beyond the ends of a route, or single images find the other frames. It becomes a route
    at the end of the map, coded as the map is, without the light of that day; the map keeps how it is
    connected to where the drive came from and went on. The rest of the drive is matched to the grown map, so
    that two laps over new ground are stored once.

    Args:
        model: with a spectral map. Its calibration stays, or is that of `refine`.
        drive: at least 30 frames in order, or descriptors as the map's; fewer than 60 do not refine.
        name: of the new routes; None is that of the drive. own: of the map's route, if it has none.

    Raises:
        InputError: no spectral map, or a drive that does not fit it; the model stays unchanged.

    Example:
        >>> noise = torch.randn(300, 8, generator=torch.Generator().manual_seed(0))
        >>> model = DejaVu(whitening="none").learn(noise[:200])
        >>> update(model, noise[120:280], name="monday").stretches
        ((80, 160),)
        >>> [route.name for route in model.map.routes]
        ['map', 'monday']
    """
    traverse, descriptors = described(model, drive, "update", progress)
    answers = _answered(model.map, in_its_light(model, descriptors), [], progress)
    sure = (answers.match.probability[:, 0] >= SURE).sum()  # type: ignore[index]
    if not answers.match.is_drive or int(sure) < max(NEWEST, SHARE * len(descriptors)):
        return Update(None, False)
    refined = refined_by(model, descriptors) if len(descriptors) >= FEWEST else None
    refinement = refined and refined.told
    place_map, queries = refined.map if refined else model.map, in_its_light(model, descriptors)
    assert isinstance(place_map, SpectralMap)
    stretches, unknown, answers = _new_ground(place_map, queries, progress)
    if not stretches:
        if refined:
            refined.into(model)
            if refined.told.accepted:
                model.taught_by(traverse)
        return Update(refinement, True, unknown=tuple(unknown))
    grown, links, names, shown = place_map, [*place_map.known_links], [], [model.frame_names]
    for first, last in stretches:
        taken = {own, *grown.layout.routes}
        names.append(free_name(name or Path(traverse.name).stem or traverse.name, taken))
        joins, back = _joins(answers, (first, last), grown)
        links += joins
        rows, frames = queries[first:last], torch.arange(first, last)
        rows, frames = (rows.flip(0), frames.flip(0)) if back else (rows, frames)
        grown = grown.with_route(names[-1], _coded(place_map, rows), own)
        shown.append(_names_of(traverse, frames))
    sizes = [place_map.table.frames, *(last - first for first, last in stretches)]
    calibration = refined.calibration if refined else model.calibration
    grown, known = grown.linked(links), joined_names(shown, sizes)
    model.replace_map(grown)
    model.frame_names, model.calibration = known, calibration
    model.taught_by(traverse)
    return Update(refinement, True, tuple(stretches), tuple(names), tuple(unknown))


def _new_ground(place_map: SpectralMap, queries: Tensor, progress: bool) -> NewGround:
    """The stretches of a drive that are off the map."""
    least = math.ceil(max(NEWEST, TAUS * spacing_of(queries).correlation))
    new: list[Stretch] = []
    while True:
        grown = place_map
        for i, (first, last) in enumerate(new):
            grown = grown.with_route(f"new {i}", _coded(place_map, queries[first:last]), "map")
        answers = _answered(grown, queries, new, progress)
        unknown = _runs(answers.absent, new, least) if answers.match.is_drive else []
        told = bool(unknown) and _recognised(grown, queries, answers.match)
        found = [stretch for stretch in unknown if told or _at_an_end(grown, answers.match, stretch)]
        if not found:
            return NewGround(new, unknown, answers)
        new = _with_piece(new, found[0], least)


def _recognised(place_map: SpectralMap, queries: Tensor, match: Match) -> bool:
    """Whether single images find the places of which the smoother is sure, so that it can be sure that a
    stretch of which they find nothing is not a hard one of the map."""
    assert match.probability is not None
    sure = (match.probability[:, 0] >= SURE).nonzero()[:, 0]
    best = [place_map.scores(part).argmin(1) for part in queries[sure.to(queries.device)].split(BATCH)]
    near = place_map.layout.distance(torch.cat(best).cpu(), match.index[sure, 0]) <= TOLERANCE
    return float(near.double().mean()) >= RECOGNISED


def _at_an_end(place_map: SpectralMap, match: Match, stretch: Stretch) -> bool:
    """Whether a drive came from an end of a route, and went on at one, if it did."""
    first, last = stretch
    beside = [match.index[frame, 0] for frame in (first - 1, last) if 0 <= frame < len(match.index)]
    starts = torch.tensor([*place_map.route_starts, place_map.places])
    return all(bool(((starts - place).abs() <= NEAR).any()) for place in beside)


def _with_piece(stretches: list[Stretch], found: Stretch, least: int) -> list[Stretch]:
    """The stretches with the first frames of another one, joined to its neighbours if little is between."""
    first, last = found
    if last - first >= PIECE + least:
        last = first + PIECE
    before = [stretch for stretch in stretches if stretch[1] <= first]
    after = [stretch for stretch in stretches if stretch[1] > first]
    if before and first - before[-1][1] < least:
        first = before.pop()[0]
    if after and after[0][0] - last < least:
        last = after.pop(0)[1]
    return [*before, (first, last), *after]


def _runs(absent: Tensor, stored: Sequence[Stretch], least: int) -> list[Stretch]:
    """The stretches of at least so many frames that are off the map, by their probability (Q,), and are not
    stored."""
    absent = absent.clone()
    for first, last in stored:
        absent[first:last] = 0
    values, counts = (absent > OFF).unique_consecutive(return_counts=True)
    ends = counts.cumsum(0)
    runs = zip(values.tolist(), (ends - counts).tolist(), ends.tolist(), strict=True)
    long = [(first, last) for off, first, last in runs if off and last - first >= least]
    return [(first, last) for first, last in long if float(absent[first:last].mean()) >= SURELY]


class Silent(Wrapped):
    """Scores of queries, of which those in some stretches say nothing."""

    def __init__(self, scorer: Scorer, stretches: Sequence[Stretch]) -> None:
        super().__init__(scorer)
        self.silent = torch.zeros(len(scorer), dtype=torch.bool)
        for first, last in stretches:
            self.silent[first:last] = True

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        return torch.where(self.silent[queries, None].to(scores.device), 0, scores)


def _answered(place_map: PlaceMap, queries: Tensor, stored: Sequence[Stretch], progress: bool) -> Answers:
    """What a smoother tells of queries (Q,K), of which those that are stored say nothing."""
    scorer = Silent(OfMap(place_map, queries), stored)
    return answer_drives([DriveQuery(scorer, PlaceSmoother())], progress)[0]


def _joins(answers: Answers, stretch: Stretch, grown: SpectralMap) -> tuple[list[Link], bool]:
    """The links of a stretch, which becomes the next places of the map, and whether its last frame comes
    first, where the map was driven backwards."""
    first, last = stretch
    start, stop = grown.places, grown.places + last - first - 1
    index, probability = answers.match.index[:, 0], answers.match.probability[:, 0]  # type: ignore[index]
    ends: list[tuple[int, int]] = []  # place and direction where the drive came from, and where it went on
    for frame, near in (
        (first - 1, slice(max(0, first - HEADED), first)),
        (last, slice(last, last + HEADED)),
    ):
        steps = index[near].diff()
        heading = int(steps[steps.abs() <= NEAR].sum().sign())
        located = 0 <= frame < len(index) and float(probability[frame]) >= BRANCH
        ends.append((int(index[frame]) if located else -1, heading))
    (came, there), (went, on) = ends
    back = min(there, on) < 0 and max(there, on) <= 0
    pairs = [(went, start), (stop, came)] if back else [(came, start), (stop, went)]
    headings = [on, there] if back else [there, on]
    starts, joins = {start, *grown.route_starts}, []
    ends_of = {first - 1 for first in starts} | {stop}
    for (one, two), heading in zip(pairs, headings, strict=True):
        if min(one, two) >= 0 and (heading >= 0) != back:
            joins.append((one, two, 1.0 if one in ends_of and two in starts else BRANCH))
    return joins, back


def _coded(place_map: SpectralMap, rows: Tensor) -> SpectralMap:
    """The map of descriptors (n,K), coded as those of another one."""
    mean = place_map.means[-1]
    route = SpectralMap(mean[None], **place_map.settings())
    settings = mean, place_map.step, place_map.transform, place_map.resolution
    route.extend(encode_chunk(part, *settings) for part in rows.cpu().split(place_map.chunk))
    if len(place_map.positions):  # even steps
        route.positions = torch.arange(len(rows)).float()
    return route


def _names_of(traverse: Traverse, frames: Tensor) -> list[str]:
    """The names of some frames (n,) of a drive; none if it has none."""
    names = source_of(traverse).names
    own = traverse.frame[frames] if isinstance(traverse, ResampledTraverse) else frames
    return [names[i] for i in own.tolist()] if names else []
