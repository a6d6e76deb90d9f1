"""The contenders of a report: ways to store a route, with their scores and colours."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth, counted
from dejavu_torch.evaluation.curves import PRCurve, Scores, area, by_confidence, curve_of, evaluate
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Facts, Match, SequenceModel, Together

LENGTHS = (1, 5, 11, 21)  # queries of the sequences that a report compares

# By the keys of report.json; `map` is ours. The colour-blind can distinguish those that share a picture.
COLOURS = {
    "map": "#0072b2",
    "uncompressed": "#222222",
    "one_byte": "#74b3d8",
    "exact": "#555555",
    "product_quantiser": "#d55e00",
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
    """One way to store the route, with its scores (None without ground truth) and bytes (None for a null).

    k: the stride, if every k-th frame is stored. fixed: the part of the bytes that does not grow with the
    route. sequences: scores of sequences of T queries, by T, of a filter and of a smoother; may be empty.
    auc_by_confidence: area if answers are sorted by their confidence instead of their score.
    """

    name: str
    scores: Scores | None
    bytes: int | None = None
    k: int | None = None
    curve: PRCurve | None = None
    fixed: int = 0
    sequences: Mapping[Together, Scores] = MappingProxyType({})
    auc_by_confidence: float | None = None

    @property
    def by_length(self) -> Mapping[Together, Scores]:
        """`sequences` with the scores of single queries under 1; empty if `sequences` is."""
        if not self.sequences or 1 in self.sequences or self.scores is None:
            return self.sequences
        return {1: self.scores, **self.sequences}

    @property
    def route_bytes(self) -> int | None:
        """The part of the bytes that grows with the route."""
        return None if self.bytes is None else self.bytes - self.fixed

    @property
    def starts(self) -> float | None:
        """Recall at which the curve starts, that of the queries that share the best score."""
        return float(self.curve.recall[0]) if self.curve and len(self.curve.recall) else None

    def as_json(self) -> Facts:
        """The nested entry of report.json."""
        scores = self.scores._asdict() if self.scores else dict.fromkeys(Scores._fields)
        extra: Facts = {"bytes": self.bytes, "route_bytes": self.route_bytes, "k": self.k}
        extra |= {"curve_starts_at_recall": self.starts, "auc_by_confidence": self.auc_by_confidence}
        if self.sequences:
            extra["sequences"] = sequences_as_json(self.sequences)
        return scores | {name: value for name, value in extra.items() if value is not None}


def sequences_as_json(sequences: Mapping[Together, Scores]) -> dict[str, dict[str, float]]:
    """The entry `sequences` of report.json."""
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
    """Matches as a contender, without scores if there is no ground truth or it scores no query."""
    if truth is None or not counted(match.index, as_ground_truth(truth), tolerance).any():
        return Contender(name, None, bytes, k, fixed=fixed)
    scores, curve = evaluate(match, truth, tolerance), curve_of(match, truth, tolerance)
    sequences, sure = evaluate_each(match.sequences, truth, tolerance), None
    if match.confidence is not None:
        sure = area(curve_of(by_confidence(match), truth, tolerance))
    return Contender(name, scores, bytes, k, curve, fixed, sequences, sure)


def evaluate_each(
    sequences: Mapping[Together, Match], truth: Tensor | GroundTruth, tolerance: int
) -> dict[Together, Scores]:
    """Scores by T, see `evaluate`; without any T that has no query to judge."""
    truth = as_ground_truth(truth)
    judged = {T: one for T, one in sequences.items() if counted(one.index, truth, tolerance).any()}
    return {T: evaluate(one, truth, tolerance) for T, one in judged.items()}


def distinct(contenders: Mapping[str, Contender]) -> dict[str, Contender]:
    """Contenders, without any that stores the same frames as an earlier one.

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
    """The sequence models to compare: for a sequence, its own and other lengths up to the number of queries
    and places, and a filter; for single queries in order, a filter only.

    Example:
        >>> [*models_beside(SequenceMatcher(7), True, queries=100, places=12)]
        [1, 5, 7, 11, 'filter']
    """
    models: dict[Together, SequenceModel] = {}
    place_filter = PlaceFilter(within=within)
    if sequence is not None:
        lengths = (length for length in sorted({*LENGTHS, sequence.length}) if length <= min(queries, places))
        models |= {length: SequenceMatcher(length, sequence.speeds or (1.0,)) for length in lengths}
    if sequence is not None and sequence.answers == "filter":
        models["filter"] = sequence
    elif ordered and queries > 1 and places >= len(place_filter.move_logits):
        models["filter"] = place_filter
    return models
