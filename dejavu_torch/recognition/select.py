"""The best places, and which of them are accepted (section III-C, eq. 5 and eq. 6)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.types import Match, check_shape, expect

HIGHEST = torch.finfo(torch.float64).max  # threshold that accepts every finite score; JSON has no infinity
PROBABLE = 0.5  # minimum probability that a calibrated map accepts by default


class Acceptance(NamedTuple):
    """Which answers are accepted; `DejaVu.acceptance` chooses it."""

    threshold: float | None = None  # scores below it; None accepts every finite score
    precision: float | None = None  # instead, probabilities of at least this
    given: bool = True  # whether the user gave one of the two, or the map stores it

    def __str__(self) -> str:
        if self.precision is not None:
            if not self.given:
                return f"accepting answers with a probability of at least {self.precision:.9g} (--precision)"
            rule = f"accepted if the probability is at least {self.precision:.9g}"
        elif self.threshold is None or self.threshold >= HIGHEST:
            rule = "every query with a finite score is accepted"
        elif self.given:
            rule = f"accepted if the score is below {self.threshold:.9g}"
        else:
            rule = f"accepted if the filter's own probability is above {math.exp(-self.threshold):.9g}"
        return rule if self.given else f"default for this way of matching: {rule}"


def best_match(scores: Tensor, threshold: float | None = None) -> Match:
    """b = argmin_i S(i) (eq. 5), accepted if S(b) < threshold (eq. 6); None accepts every finite score.

    Shape: (..., Q, N) -> Match of (..., Q).

    Convention: S is a difference, so a match is *below* the threshold, as the text of section III-C says, not
        the printed eq. 6. The lowest place wins among equal scores. A query whose best score is +inf
        reports nothing: place -1, not accepted.

    Raises:
        InputError: not (Q,N) with N >= 1.

    Example:
        >>> match = best_match(torch.tensor([[3.0, 1.0, 1.0], [2.0, 4.0, 9.0]]), threshold=2.0)
        >>> match.index, match.score, match.accepted
        (tensor([1, 0]), tensor([1., 2.]), tensor([ True, False]))
    """
    lead = scores.shape[:-1] if isinstance(scores, Tensor) and scores.ndim > 2 else ()
    found = best_candidates(scores.flatten(0, -2) if lead else scores, 1, 0)
    match = found.map(lambda column: column[:, 0].view(lead or -1))
    return replace(match, accepted=accept(match.score, threshold))


def best_candidates(
    scores: Tensor, k: int, radius: int, places: Tensor | None = None, layout: Layout = ROUTE
) -> Match:
    """The k best places of each query, by non-maximum suppression with a radius in places.

    Args:
        places: (Q,N) of the scores, if they are not all places in order. layout: where the places lie, by
            default along a route.

    Shape: (Q,N) -> Match of (Q,k).

    Convention: the first wins among equal scores. A candidate without a finite score is place -1 with score
        +inf; all others are accepted.
    """
    expect(isinstance(scores, Tensor), "a tensor (Q,N)", f"scores are a {type(scores).__name__}")
    check_shape(scores, "Q N>=1", "scores are")
    check_candidates(k, radius, scores.shape[1])
    layout, found = layout.reaching(scores.shape[1]), []
    for rank in range(k):
        score, at = scores.min(1)
        index = at if places is None else places.gather(1, at[:, None])[:, 0]
        found.append((index, score))
        if rank + 1 == k:
            break
        if places is None:  # a border of the map may be named twice
            scores = scores.scatter(1, layout.around(at, radius), torch.inf)
        else:
            scores = scores.masked_fill(layout.distance(places, index[:, None]) <= radius, torch.inf)
    index, score = (torch.stack(column, 1) for column in zip(*found, strict=True))
    finite = score.isfinite()
    if k > 1:  # NaN in a query leaves it without candidates
        finite = finite & finite[:, :1]
        score = score.masked_fill(~finite, torch.inf)
    index = torch.where(finite, index, -1)
    return Match(index, score, finite)


def check_candidates(k: int, radius: int, places: int | None = None) -> None:
    """Refuse k or a radius out of range; `places` is None if unknown."""
    expect(k >= 1, "at least 1", f"{k} candidates per query")
    expect(places is None or k <= places, f"at most {places}", f"{k} candidates per query on {places} places")
    expect(radius >= 0, "at least 0", f"the suppression radius is {radius} places")


def accept(score: Tensor, threshold: float | None) -> Tensor:
    """Eq. 6: which finite scores are below the threshold; None accepts all."""
    found = score.isfinite()
    return found if threshold is None else found & (score < threshold)
