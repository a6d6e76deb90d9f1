"""The places of all queries of a flight over an area, each given all of them: a smoother in the plane.

As along a route, but the states are the windows of an area and being off it, and moves are a kernel over rows
and columns, which is learned from the queries as the rest is. A step over the border leaves the area.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.area import Area
from dejavu_torch.memory import check_room
from dejavu_torch.recognition.evidence import RankTable, Spacing, Standardised, place_means, standardised
from dejavu_torch.recognition.motion import logits
from dejavu_torch.recognition.smoother import (
    DRIVE,
    MOVE_SHARE,
    RADIUS,
    ROUNDS,
    PlaceSmoother,
    Rows,
    log_likelihood,
    tempering_of,
)

# of which the fit starts: among so many windows a right one has to stand out more than along a route
SEPARATION, SPREAD = 3.0, 2.0  # standard deviations of scores; windows that a step goes in each direction
FITTED = 300  # queries in a row, from the middle, that a smoother is fitted to
BYTES = 70  # of memory for each query and window
TINY = 1e-30


class Swept(NamedTuple):
    """mass: (T,R,C), of windows. others: the same without a query's own evidence. moves: (2 V + 1, 2 V + 1),
    expected steps. log: nats above being off the area throughout."""

    mass: Tensor
    others: Tensor
    moves: Tensor
    log: float


@torch.no_grad()
def place_flight(smoother: PlaceSmoother, rows: Rows, queries: int, area: Area, spacing: Spacing) -> Tensor:
    """The mass of each window of an area for each query of a flight, (Q,N); what is off the area is missing.
    The smoother knows afterwards what was learned from the queries, and whether they are a flight over it.

    Args:
        rows: scores (B,N) of queries by their numbers. queries: Q. spacing: `spacing_of` their descriptors.

    Raises:
        InputError: more queries and windows than fit into memory.
    """
    check_room(BYTES * queries * area.places, f"a drive of {queries} images over {area.places} windows")
    scores = rows(torch.arange(queries)).float().cpu()
    weight = spacing.weight.to(scores)
    means = smoother.removed * place_means(scores, weight)
    std, ranks = standardised(scores, means), RankTable()
    ranks.add(std.z, std.only((weight * std.speaks)[:, None].expand_as(std.z), 0))
    smoother.correlation, smoother.tempering = spacing.correlation, tempering_of(spacing)
    reach, first = len(smoother.move_logits) - 1, max(0, (queries - FITTED) // 2)
    part = slice(first, first + FITTED)
    some, own = std.map(lambda column: column[part]), weight[part]
    away = torch.arange(-reach, reach + 1).square()
    prior = torch.exp(-(away[:, None] + away) / (2 * SPREAD**2))
    kernel, prior = prior / prior.sum(), MOVE_SHARE * len(own) * prior / prior.sum()
    separation, table = SEPARATION, ranks
    for _ in range(ROUNDS):
        values = table.values
        swept = _sweep(smoother, area, some, own, spacing.still[part], values, separation, kernel)
        others = _by_place(swept.others, area) * (own * some.speaks)[:, None]
        known = some.only(RankTable.look_up(values, some.z), 0)
        separation = max(1.0, float((others * known).sum() / others.sum().clamp(min=TINY)))
        table = RankTable(ranks.counts)
        near = _by_place(boxes(swept.mass, RADIUS).clamp(0, 1), area)
        table.add(some.z, some.only(-near * (own * some.speaks)[:, None], 0))
        kernel = swept.moves + prior
        kernel = kernel / kernel.sum()
    swept = _sweep(smoother, area, std, weight, spacing.still, table.values, separation, kernel)
    smoother.separation, smoother.log_likelihood = separation, swept.log
    smoother.is_drive = swept.log >= DRIVE
    steps = torch.maximum(*torch.meshgrid(away.sqrt(), away.sqrt(), indexing="ij")).round().long()
    moves = torch.zeros(reach + 1).index_add_(0, steps.flatten(), kernel.flatten())
    smoother.move_logits.copy_(logits(*moves.tolist()))
    return _by_place(swept.mass, area)


def near_in_plane(mass: Tensor, radius: int, area: Area, weighted: bool = False) -> Tensor:
    """The mass of each window and those up to a radius in rows and columns, or `weighted` by a pyramid that
    is highest at the window, (Q,N) -> (Q,N)."""
    plane = _as_plane(mass, area)
    if not weighted:
        return _by_place(boxes(plane, radius), area).clamp(0, 1)
    half = max(1, radius // 2)  # two boxes make a pyramid
    return _by_place(boxes(boxes(plane, half), half) / (2 * half + 1) ** 2, area).clamp(0, 1)


def boxes(mass: Tensor, radius: int) -> Tensor:
    """Sums over squares of 2 radius + 1 windows to a side, (T,R,C) -> (T,R,C)."""
    side = 2 * radius + 1
    sums: Tensor = F.avg_pool2d(mass[:, None], side, 1, radius, divisor_override=1)[:, 0]
    return sums


def _sweep(
    smoother: PlaceSmoother,
    area: Area,
    std: Standardised,
    weight: Tensor,
    still: Tensor,
    values: Tensor,
    separation: float,
    kernel: Tensor,
) -> Swept:
    """Forward and backward over the queries."""
    log = log_likelihood(values, std, weight, separation, smoother.tempering)
    seen = _as_plane(log.exp(), area)
    _, jump, leave = smoother.rate_logits.softmax(0)
    enter, stays, count = smoother.enter_logit.sigmoid(), 1 - jump - leave, area.places
    reach = len(kernel) // 2

    def moved(belief: Tensor, by: Tensor) -> Tensor:
        return F.conv2d(belief[None, None], by[None, None], padding=reach)[0, 0]

    belief, off, total = seen.new_full(seen.shape[1:], 0.5 / count), seen.new_tensor(0.5), 0.0
    before, after = torch.empty_like(seen), torch.empty_like(seen)  # beliefs without and with each query
    outside = seen.new_zeros(len(seen), 2)
    flipped = kernel.flip(0, 1)
    for t, likely in enumerate(seen):
        if t and not still[t]:
            on = belief.sum()
            goes = stays * moved(belief, flipped)
            lost = stays * on - goes.sum()
            belief = goes + (jump * on + enter * off) / count
            off = (1 - enter) * off + leave * on + lost
        before[t], outside[t, 0] = belief, off
        belief = belief * likely
        scale = belief.sum() + off
        belief, off, total = belief / scale, off / scale, total + float(scale.log())
        after[t], outside[t, 1] = belief, off
    message, absent = torch.ones_like(belief), seen.new_tensor(1.0)
    gone_over = leave + stays * (1 - moved(message, kernel))  # also over the border
    steps = torch.zeros_like(kernel)
    for t in reversed(range(len(seen))):
        others, gone = before[t] * message, outside[t, 0] * absent
        mass, away = after[t] * message, outside[t, 1] * absent
        later = message * seen[t]
        largest = torch.maximum(later.amax(), absent)
        later, later_off = later / largest, absent / largest
        if t and not still[t]:
            # expected steps: of each window with a belief before to each that the later queries like
            padded = F.pad(later, (reach,) * 4)[None, None]
            pairs = F.conv2d(padded, after[t - 1][None, None])[0, 0]
            anywhere = later.mean()
            back = stays * moved(later, kernel) + jump * anywhere + gone_over * later_off
            back_off = enter * anywhere + (1 - enter) * later_off
            explained = (after[t - 1] * back).sum() + outside[t - 1, 1] * back_off
            steps += stays * kernel * pairs / explained.clamp(min=TINY)
            message, absent = back, back_off
        else:
            message, absent = later, later_off
        before[t], after[t] = others / (others.sum() + gone), mass / (mass.sum() + away)
    return Swept(after, before, steps, total if math.isfinite(total) else -math.inf)


def _rows_first(area: Area) -> Tensor:
    """The places of an area row by row, (N,) int64."""
    cells = torch.cartesian_prod(torch.arange(area.rows), torch.arange(area.columns))
    return area.place_at(cells.view(-1, 2))


def _as_plane(values: Tensor, area: Area) -> Tensor:
    """Values by place, (T,N) -> (T,R,C)."""
    return values[:, _rows_first(area)].view(len(values), area.rows, area.columns)


def _by_place(values: Tensor, area: Area) -> Tensor:
    """Values of a plane by place, (T,R,C) -> (T,N)."""
    return values.flatten(1)[:, _rows_first(area).argsort()]
