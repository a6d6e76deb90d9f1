"""The best places of a query, no two of them near each other."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.recognition.select import accept
from dejavu_torch.types import InputError, Match


class Candidates(NamedTuple):
    """Where each query may be, the best place first.

    index: (Q,k) int64, places, -1 behind the last one that has a finite score.
    score: (Q,k) float, S of each; lower is better, +inf where there is no place.
    """

    index: Tensor  # type: ignore[assignment]  # the field shadows tuple.index
    score: Tensor

    def as_match(self, threshold: float | None = None) -> Match:
        """Every candidate as a match of its own: (Q * k,), the k of a query together, best first.

        Args:
            threshold: accept a candidate when its score is below; None accepts every finite score.
        """
        score = self.score.flatten()
        return Match(self.index.flatten(), score, accept(score, threshold))


def best_candidates(scores: Tensor, k: int, apart: int) -> Candidates:
    """The best place, then again and again the best of those further than `apart` from all before.

    Args:
        scores: S, lower is better.
        k: how many, from 1 to N.
        apart: places, at least 0: any two candidates differ by more.

    Shape: (Q,N) -> Candidates of (Q,k).

    Convention: the first candidate is `best_match`'s. Of equal scores the lowest place wins. Where no place
        with a finite score is left, the place is -1 and the score +inf.

    Raises:
        InputError: not (Q,N), or k or apart out of range.

    Example:
        >>> best_candidates(torch.tensor([[5.0, 1.0, 2.0, 4.0, 3.0]]), k=3, apart=1)
        Candidates(index=tensor([[ 1,  4, -1]]), score=tensor([[1., 3., inf]]))
    """
    if scores.ndim != 2 or scores.shape[1] < 1:
        raise InputError(f"scores are {tuple(scores.shape)}; expected (Q,N) with N >= 1")
    places = scores.shape[1]
    check_candidates(k, apart, places)
    near = torch.arange(-min(apart, places), min(apart, places) + 1, device=scores.device)
    score, index = scores.min(1)
    ranks, left = [(index, score)], scores.clone() if k > 1 else scores
    for _ in range(k - 1):
        # a window cut off at an end of the route repeats that end, which is in it
        window = (index[:, None] + near).clamp(0, places - 1)
        left.scatter_(1, window, torch.inf).masked_fill_(~score.isfinite()[:, None], torch.inf)
        score, index = left.min(1)
        ranks.append((index, score))
    index, score = (torch.stack(column, 1) for column in zip(*ranks, strict=True))
    return Candidates(torch.where(score.isfinite(), index, -1), score)


def check_candidates(k: int, apart: int, places: int | None = None) -> None:
    """Refuse early how many candidates there cannot be.

    Args:
        places: of the map, None where unknown.

    Raises:
        InputError: k below 1 or above the number of places, or apart below 0.
    """
    if k < 1:
        raise InputError(f"{k} candidates a query; expected at least 1")
    if places is not None and k > places:
        raise InputError(f"{k} candidates a query on {places} places; expected at most {places}")
    if apart < 0:
        raise InputError(f"candidates more than {apart} places apart; expected at least 0")
