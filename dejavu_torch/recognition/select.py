"""The best place and whether to believe it (section III-C, eq. 5 and eq. 6)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.types import InputError, Match

HIGHEST = torch.finfo(torch.float64).max  # of the numbers that a file can hold: every score is below
PROBABLE = 0.5  # what a calibrated map accepts from, where nobody says otherwise


class Acceptance(NamedTuple):
    """Which answers are accepted; `DejaVu.acceptance` chooses it.

    threshold: those whose score is below; None accepts every finite score. precision: instead, those that are
    at least so probably right. given: whether one of the two was asked for, or is stored in the map.
    """

    threshold: float | None = None
    precision: float | None = None
    given: bool = True

    def __str__(self) -> str:
        if self.precision is not None:
            told = f"accepted where the probability is at least {self.precision:.9g}"
        elif self.threshold is None or self.threshold >= HIGHEST:
            told = "every query with a finite score is accepted"
        elif self.given:
            told = f"accepted where the score is below {self.threshold:.9g}"
        else:
            told = f"accepted where the filter itself gives more than {math.exp(-self.threshold):.9g}"
        return told if self.given else f"no threshold given or stored for this way of matching: {told}"


def best_match(scores: Tensor, threshold: float | None = None) -> Match:
    """b = argmin_i S(i) (eq. 5), accepted where S(b) < threshold (eq. 6).

    Args:
        scores: S, lower is better.
        threshold: None accepts every query with a finite score.

    Shape: (Q,N) -> Match of (Q,).

    Convention: S is a difference, so a match is *below* the threshold: the text of section III-C,
        not eq. 6 as printed. Of equal scores the lowest place wins. A query whose best score is
        +inf reports nothing: place -1, not accepted.

    Raises:
        InputError: not (Q,N) with N >= 1.

    Example:
        >>> best_match(torch.tensor([[3.0, 1.0, 1.0], [2.0, 4.0, 9.0]]), threshold=2.0)
        Match(index=tensor([1, 0]), score=tensor([1., 2.]), accepted=tensor([ True, False]))
    """
    if not isinstance(scores, Tensor):
        raise InputError(f"scores are a {type(scores).__name__}; expected a tensor (Q,N)")
    if scores.ndim != 2 or scores.shape[1] < 1:
        raise InputError(f"scores are {tuple(scores.shape)}; expected (Q,N) with N >= 1")
    score, index = scores.min(1)
    return Match(torch.where(score.isfinite(), index, -1), score, accept(score, threshold))


def accept(score: Tensor, threshold: float | None) -> Tensor:
    """Eq. 6: which finite scores are below the threshold; None accepts all of them."""
    found = score.isfinite()
    return found if threshold is None else found & (score < threshold)
