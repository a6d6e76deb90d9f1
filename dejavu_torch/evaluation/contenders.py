"""What stands side by side in a report: ways to store a route, their scores, and a fixed colour for each."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth, counted
from dejavu_torch.evaluation.curves import PRCurve, Scores, curve_of, evaluate
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match, SequenceModel, Together

LENGTHS = (1, 5, 11, 21)  # queries of the sequences that a report sets side by side

# Told apart by the colour-blind where they share a picture; keys are those of report.json, `map` is ours.
COLOURS = {
    "map": "#0072b2",
    "uncompressed": "#222222",
    "stride": "#f2b80f",
    "stride_coarsest": "#c21f0a",
    "interpolated": "#5d0b81",
    "hog": "#10b248",
    "hog_stride_coarsest": "#8fdccb",
    "paper": "#e377c2",
    "seqslam": "#b43cff",
    "null": "#adadad",
    "null_same_plan": "#785567",
    "leave_out": "#8c6d1f",
    "ideal": "#56b4e9",
    "ideal_leave_out": "#9ecae1",
    "comparable": "#4a6fe3",
    "known_boundaries": "#1b2a6b",
}


def colour_of(key: str) -> str:
    """The colour of a contender by its key; dark grey for one that has none of its own."""
    return COLOURS.get(key, "#555555")


class Contender(NamedTuple):
    """One way to store the route, how well it is recognised, and what it costs.

    scores, curve: None where there is no ground truth. bytes: None where nothing is stored, as by a null.
    k: where every k-th frame is stored. fixed: those of the bytes that do not grow with the route.
    sequences: by T, the scores of sequences of T queries, and of a filter; empty where there are none.
    """

    name: str
    scores: Scores | None
    bytes: int | None = None
    k: int | None = None
    curve: PRCurve | None = None
    fixed: int = 0
    sequences: Mapping[Together, Scores] = MappingProxyType({})

    @property
    def by_length(self) -> Mapping[Together, Scores]:
        """`sequences`, and by 1 the scores of single queries, where there are any."""
        if not self.sequences or 1 in self.sequences or self.scores is None:
            return self.sequences
        return {1: self.scores, **self.sequences}

    @property
    def route_bytes(self) -> int | None:
        """Those of the bytes that grow with the route."""
        return None if self.bytes is None else self.bytes - self.fixed

    @property
    def starts(self) -> float | None:
        """Recall at which the curve starts: that of all queries that share the best score."""
        return float(self.curve.recall[0]) if self.curve and len(self.curve.recall) else None

    def as_json(self) -> dict[str, Any]:
        """The nested entry of report.json."""
        scores = self.scores._asdict() if self.scores else dict.fromkeys(Scores._fields)
        extra: dict[str, Any] = {
            "bytes": self.bytes,
            "route_bytes": self.route_bytes,
            "k": self.k,
            "curve_starts_at_recall": self.starts,
        }
        if self.sequences:
            extra["sequences"] = sequences_as_json(self.sequences)
        return scores | {name: value for name, value in extra.items() if value is not None}


def sequences_as_json(sequences: Mapping[Together, Scores]) -> dict[str, dict[str, float]]:
    """What report.json holds of sequences, by T, and of a filter."""
    return {str(T): {"auc": one.auc, "recall_at_1": one.recall_at_1} for T, one in sequences.items()}


def contend(
    name: str,
    match: Match,
    truth: Tensor | GroundTruth | None,
    tolerance: int,
    bytes: int | None = None,
    k: int | None = None,
    fixed: int = 0,
) -> Contender:
    """Matches as a contender, without scores where there is no ground truth or no query that it scores."""
    if truth is None or not counted(match.index, as_ground_truth(truth), tolerance).any():
        return Contender(name, None, bytes, k, fixed=fixed)
    scores, curve = evaluate(match, truth, tolerance), curve_of(match, truth, tolerance)
    return Contender(name, scores, bytes, k, curve, fixed, evaluate_each(match.sequences, truth, tolerance))


def evaluate_each(
    sequences: Mapping[Together, Match], truth: Tensor | GroundTruth, tolerance: int
) -> dict[Together, Scores]:
    """Scores by T, see `evaluate`; a T of which no query is left to judge is left out."""
    truth = as_ground_truth(truth)
    judged = {T: one for T, one in sequences.items() if counted(one.index, truth, tolerance).any()}
    return {T: evaluate(one, truth, tolerance) for T, one in judged.items()}


def distinct(contenders: Mapping[str, Contender]) -> dict[str, Contender]:
    """Contenders without those that store the same frames as one before.

    Example:
        >>> row = Contender("every 2nd frame", None, bytes=100, k=2)
        >>> list(distinct({"stride": row, "stride_coarsest": row, "null": Contender("null", None)}))
        ['stride', 'null']
    """
    kept: dict[str, Contender] = {}
    for key, one in contenders.items():
        same = [(other.k, other.bytes, other.scores) for other in kept.values()]
        if one.k is None or (one.k, one.bytes, one.scores) not in same:
            kept[key] = one
    return kept


def models_beside(
    sequence: SequenceModel | None, ordered: bool, queries: int, places: int, within: int = 5
) -> dict[Together, SequenceModel]:
    """What is set beside a sequence: others, its own length among them, that so many queries and places have
    room for, and a filter; beside single queries in order the filter alone.

    Example:
        >>> [*models_beside(SequenceMatcher(7), True, queries=100, places=12)]
        [1, 5, 7, 11, 'filter']
    """
    found: dict[Together, SequenceModel] = {}
    beside = PlaceFilter(within=within)
    if sequence is not None:
        own = {sequence.length} if isinstance(sequence, SequenceMatcher) else set()
        speeds = sequence.speeds if isinstance(sequence, SequenceMatcher) else (1.0,)
        lengths = (length for length in sorted({*LENGTHS, *own}) if length <= min(queries, places))
        found |= {length: SequenceMatcher(length, speeds) for length in lengths}
    if isinstance(sequence, PlaceFilter):
        found["filter"] = sequence
    elif ordered and queries > 1 and places >= len(beside.move_logits):
        found["filter"] = beside
    return found
