"""A localization run, from which pictures and storage curves are made."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, scored_and_right
from dejavu_torch.evaluation.contenders import Contender, contend
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.places.positions import unit_of
from dejavu_torch.recognition.localizer import SINGLE, Matching, wrapped
from dejavu_torch.recognition.querying import QUERYING, Querying
from dejavu_torch.recognition.scorer import OfMap, Scorer
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import Match, SequenceModel, Traverse

NOTHING = Match(torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0, dtype=torch.bool))


class Localization(NamedTuple):
    """A map, its reference traverse, a query traverse, and the matches.

    reference_features (N,D) and query_features (Q,D), or those of all copies, may lie in a file.
    truth: None if unknown. tolerance: in places, inclusive. matching: for the map and all baselines.
    querying: as asked for. causal_features: the queries for sequences and filters, if query_features are
    centred, which takes all of them. match: the answers. judged: the matches that the scores at top level
    judge, with those of other models. beside: a smoother to compare all contenders by, if any. radius: over
    an area, the distance within which a match is right, in the unit of its coordinates; tolerance is 0. Along
    a route the tolerance once more.

    Convention 11: match and truth count places and queries, pictures show frames of the sources.
    """

    model: DejaVu
    reference: Traverse
    query: Traverse
    reference_features: Tensor
    query_features: Tensor
    match: Match
    truth: GroundTruth | None
    tolerance: int
    matching: Matching = SINGLE
    querying: Querying = QUERYING
    causal_features: Tensor | None = None
    judged: Match = NOTHING
    beside: PlaceSmoother | None = None
    radius: float = 0.0

    def __repr__(self) -> str:
        return f"{self.query.name} on {self.reference.name}"

    @property
    def sequence(self) -> SequenceModel | None:
        """The model that scores consecutive queries together, if any."""
        return self.matching.sequence

    @property
    def way(self) -> SequenceModel | None:
        """How the answers were found; None of single images."""
        return self.match.smoother or self.sequence

    @property
    def asked(self) -> Traverse:
        """The frames whose descriptors the queries have: all copies, if there are several of them."""
        return self.querying.copies_of(self.query, self.model.map.layout)

    def scorer_by(self, make: Callable[[Tensor], Scorer]) -> Scorer:
        """Other scores of the queries, which also know them uncentred."""
        scorer, causal = make(self.query_features), self.causal_features
        return scorer if causal is None else scorer.beside(make(causal))

    @property
    def coarsest(self) -> int:
        """The largest stride of stored frames that lets every place be found: twice the tolerance."""
        return max(1, 2 * self.tolerance, int(2 * self.radius / self.model.map.layout.spacing))

    @property
    def answers(self) -> str:
        """How the answers were found: loops, drive, filter, sequence or single."""
        if self.querying.loops is not None:
            return "loops"
        if self.match.smoother is not None:
            return "drive" if self.match.is_drive else "single"
        return "single" if self.sequence is None else self.sequence.answers

    @property
    def scored(self) -> Match:
        """The matches with the places that are scored."""
        return self.match.renumbered(self.model.map.table.scored)

    @property
    def by_one(self) -> Match:
        """As `scored`; where a drive answers, the answers by one image, of which all are accepted."""
        match = self.judged if self.answers == "drive" else self.match
        return match.renumbered(self.model.map.table.scored)

    @property
    def borders(self) -> Tensor:
        """(N+1,) the first reference frame of each place, and the number of frames."""
        return self.model.map.table.borders.cpu()

    @property
    def query_frames(self) -> Tensor:
        """(Q,) the frame of its source that each query shows."""
        if isinstance(self.query, ResampledTraverse):
            return self.query.frame
        return torch.arange(len(self.query_features) // self.querying.copies)

    @property
    def unit(self) -> str:
        """The unit of periods and of the tolerance."""
        return unit_of(self.model.map.positions)

    @property
    def reach(self) -> tuple[float, str]:
        """The tolerance and its unit: in an area a distance."""
        return max(self.tolerance, self.radius), self.model.map.layout.units or self.unit

    @property
    def within(self) -> str:
        """The tolerance with its unit."""
        number, unit = self.reach
        return f"{number:g} {unit}"

    @property
    def has_frames(self) -> bool:
        """Whether both traverses hold frames rather than ready features."""
        return len(self.reference.frame_shape) == len(self.query.frame_shape) == 3

    def contend(self, name: str, match: Match, model: DejaVu) -> Contender:
        """Matches with the places that are scored, on the map of this or another model, as a contender."""
        size = model.summary()
        return contend(name, match, self.truth, self.tolerance, size.map_bytes, fixed=size.fixed_bytes)

    @torch.no_grad()
    def scores(self, numbers: Tensor) -> Tensor:
        """Scores of single queries, on the CPU: their indices (B,) -> (B,N)."""
        scorer = wrapped(OfMap(self.model.map, self.query_features), self.matching)
        return scorer.rows(numbers).float().cpu()

    def example_query(self, start: int, stop: int) -> tuple[int, list[int]]:
        """A query near the middle of a chunk, and its right places there; without truth the middle query."""
        if self.truth is None:
            return len(self.query_frames) // 2, []
        query = nearest_query(self.truth, (start + stop) / 2)
        right = self.truth.positives[query].tolist() if self.truth.judged[query] else []
        return query, [place for place in right if start <= place < stop]


def faults(match: Match, truth: GroundTruth | None, tolerance: int) -> tuple[Tensor, Tensor]:
    """Which answers are judged, without truth all, and which of these are wrong: two (Q,) bool."""
    told = match.index >= 0
    scored, right = (told, told) if truth is None else scored_and_right(match.index, truth, tolerance)
    return told & scored, told & scored & ~right


def nearest_query(truth: GroundTruth, place: float) -> int:
    """The query with the right place nearest to a place; the first one if none has any."""
    right = torch.where(truth.judged[:, None] & (truth.positives >= 0), truth.positives, torch.inf)
    return int((right - place).abs().amin(1).argmin())


def frame_at(traverse: Traverse, number: int) -> Tensor:
    """One frame of a traverse, (C,H,W)."""
    return traverse[number].float().cpu()
