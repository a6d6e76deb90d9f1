"""`evaluate` over all batches of an epoch, as a metric of torchmetrics."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from dejavu_torch.data.ground_truth import GroundTruth, Truth, scored_and_right
from dejavu_torch.evaluation.curves import Scores, by_confidence, check_truth, evaluate
from dejavu_torch.types import Match, expect


class PlaceRecognition(Metric):
    """The scores of `evaluate` over all queries of an epoch, in any batches and processes (section IV-C).

    Args:
        tolerance: in the unit of the places (frames, or evenly spaced places), inclusive.

    Shape: update(match of (Q,), truth (Q,R) int64 with -1 as padding, or a `GroundTruth`); R may differ from
        batch to batch. compute() -> float64 scalars, the fields of `Scores` by name.

    Convention: queries that `evaluate` excludes (not judged, or reporting an ignored place) are excluded
        here. Without any query, for example before the first update, every figure is NaN. The state is four
        numbers per query, on the device of the metric.

    Raises:
        InputError: in update, a negative tolerance, a NaN score, or a truth that does not fit the matches.

    Example:
        >>> metric = PlaceRecognition(tolerance=0)
        >>> found = Match(torch.tensor([0, 7]), torch.tensor([0.1, 0.2]), torch.tensor([True, True]))
        >>> metric.update(found, torch.tensor([[0], [1]]))
        >>> metric.compute()["recall_at_1"].item()
        0.5
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    plot_lower_bound = 0.0
    plot_upper_bound = 1.0

    rows: list[Tensor]

    def __init__(self, tolerance: int, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.tolerance = tolerance
        # one-dimensional, so that batches and processes can be joined for any R; float64, so that a process
        # without queries gives it too
        self.set_dtype(torch.float64)
        self.add_state("rows", [], dist_reduce_fx="cat")

    def update(self, match: Match, truth: Truth) -> None:
        """Add the queries of a batch."""
        truth = check_truth(match, truth, self.tolerance)
        if match.index.ndim == 2:
            match = match.map(lambda column: column[:, 0])
        expect(not match.score.isnan().any(), "numbers or +inf", "a score is NaN")
        index, score = match.index.cpu(), match.score.detach().cpu()
        truth = GroundTruth(*(part.cpu() for part in truth))
        kept, good = scored_and_right(index, truth, self.tolerance)
        answerable = (truth.positives >= 0).any(1)
        # the same queries on a map of two places: the reported place is 0, and the right one is 0 or 1
        placed, sure = (index >= 0).double() - 1, by_confidence(match).score.detach().cpu()
        rows = torch.stack([score, placed, torch.where(answerable, (~good).double(), -1), sure], 1)
        self.rows.append(rows[kept].flatten().to(self.device))

    def compute(self) -> dict[str, Tensor]:
        """The figures by name."""
        figures = Scores(*[float("nan")] * len(Scores._fields))
        rows = dim_zero_cat(self.rows).cpu() if len(self.rows) else torch.zeros(0)
        if len(rows):
            score, found, right, sure = rows.view(-1, 4).T
            match = Match(found.long(), score, found >= 0, confidence=-sure)
            figures = evaluate(match, right.long()[:, None], tolerance=0)
        values = torch.tensor(figures, dtype=torch.float64, device=self.device)
        return dict(zip(Scores._fields, values, strict=True))
