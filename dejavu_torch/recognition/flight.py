"""The places of all queries of a flight over an area, each given all of them: a smoother in the plane.

As along a route, but the states are the windows of an area and being off it, and moves are a kernel over rows
and columns, which is learned from the queries as the rest is. A step over the border leaves the area.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.memory import check_room
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.rectangles import boxes
from dejavu_torch.recognition.evidence import RankTable, Spacing, Standardised, place_means, standardised
from dejavu_torch.recognition.motion import MIN_PROBABILITY, logits
from dejavu_torch.recognition.plane import Steps, inside_of, rings
from dejavu_torch.recognition.smoother import (
    MOVE_SHARE,
    RADIUS,
    ROUNDS,
    PlaceSmoother,
    Rows,
    log_likelihood,
    tempering_of,
)
from dejavu_torch.recognition.taken import moves_along

# of which the fit starts: among so many windows a right one has to stand out more than along a route
SEPARATION, SPREAD = 3.0, 2.0  # standard deviations of scores; windows that a step goes in each direction
FITTED = 300  # queries in a row, from the middle, that a smoother is fitted to
BYTES = 70  # of memory for each query and window


class Swept(NamedTuple):
    """mass: (T,R,C), of windows. others: the same without a query's own evidence. moves: (2 V + 1, 2 V + 1),
    expected steps. log: nats above being off the area throughout."""

    mass: Tensor
    others: Tensor
    moves: Tensor
    log: float


@torch.no_grad()
def place_flight(
    smoother: PlaceSmoother, rows: Rows, queries: int, layout: Layout, spacing: Spacing
) -> tuple[Tensor, PlaceSmoother]:
    """The mass of each window of an area for each query of a flight, (Q,N), without what is off the area, and
    a smoother that has learned from the queries, which knows whether they are a flight over it.

    Args:
        rows: scores (B,N) of queries by their numbers. queries: Q. spacing: `spacing_of` their descriptors.

    Raises:
        InputError: more queries and windows than fit into memory.
    """
    cells = layout.rows * layout.columns
    check_room(BYTES * queries * cells, f"a drive of {queries} images over {cells} rows x columns")
    scores = rows(torch.arange(queries)).float().cpu()
    weight = spacing.weight.to(scores)
    means = smoother.removed * place_means(scores, weight)
    std, ranks = standardised(scores, means), RankTable()
    ranks.add(std.z, std.only((weight * std.speaks)[:, None].expand_as(std.z), 0))
    tempering = tempering_of(spacing)
    smoother = smoother.forgetful().changed(correlation=spacing.correlation, tempering=tempering)
    reach, first = len(smoother.move_logits) - 1, max(0, (queries - FITTED) // 2)
    part = slice(first, first + FITTED)
    some, own = std.map(lambda column: column[part]), weight[part]
    away = torch.arange(-reach, reach + 1).square()
    prior = torch.exp(-(away[:, None] + away) / (2 * SPREAD**2))
    kernel, prior = prior / prior.sum(), MOVE_SHARE * len(own) * prior / prior.sum()
    separation, table = SEPARATION, ranks
    for _ in range(ROUNDS):
        values = table.values
        swept = _sweep(smoother, layout, some, own, spacing.still[part], values, separation, kernel)
        others = layout.by_place(swept.others) * (own * some.speaks)[:, None]
        known = some.only(RankTable.look_up(values, some.z), 0)
        separation = max(1.0, float((others * known).sum() / others.sum().clamp(min=MIN_PROBABILITY)))
        table = RankTable(ranks.counts)
        near = layout.by_place(boxes(swept.mass, RADIUS).clamp(0, 1))
        table.add(some.z, some.only(-near * (own * some.speaks)[:, None], 0))
        kernel = swept.moves + prior
        kernel = kernel / kernel.sum()
    swept = _sweep(smoother, layout, std, weight, spacing.still, table.values, separation, kernel)
    nats_per_query = tempering * swept.log / max(1.0, float(weight.sum()))
    moves = torch.zeros(reach + 1).index_add_(0, rings(reach).flatten(), kernel.flatten())
    return layout.by_place(swept.mass), smoother.changed(
        separation=separation,
        log_likelihood=swept.log,
        nats_per_query=nats_per_query,
        is_drive=moves_along(swept.log, nats_per_query),  # jumps are not learned
        move_logits=nn.Parameter(logits(*moves.tolist()).to(smoother.move_logits)),
    )


def _sweep(
    smoother: PlaceSmoother,
    layout: Layout,
    std: Standardised,
    weight: Tensor,
    still: Tensor,
    values: Tensor,
    separation: float,
    kernel: Tensor,
) -> Swept:
    """Forward and backward over the queries."""
    log = log_likelihood(values, std, weight, separation, smoother.tempering)
    seen = layout.as_plane(log.exp())
    _, jump, leave = smoother.rate_logits.softmax(0)
    steps = Steps(
        (1 - jump - leave) * kernel, jump, leave, smoother.enter_logit.sigmoid(), inside_of(layout, seen)
    )
    off, total = seen.new_tensor(0.5), 0.0
    belief = 0.5 * steps.even(seen[0]).expand(seen.shape[1:])
    before, after = torch.empty_like(seen), torch.empty_like(seen)  # beliefs without and with each query
    outside = seen.new_zeros(len(seen), 2)
    for t, likely in enumerate(seen):
        if t and not still[t]:
            belief, off = steps.moved(belief, off)
        before[t], outside[t, 0] = belief, off
        belief = belief * likely
        scale = belief.sum() + off
        belief, off, total = belief / scale, off / scale, total + float(scale.log())
        after[t], outside[t, 1] = belief, off
    message, absent = torch.ones_like(belief), seen.new_tensor(1.0)
    moves = torch.zeros_like(kernel)
    for t in reversed(range(len(seen))):
        others, gone = before[t] * message, outside[t, 0] * absent
        mass, away = after[t] * message, outside[t, 1] * absent
        later = message * seen[t]
        largest = torch.maximum(later.amax(), absent)
        message, absent = later / largest, absent / largest
        if t and not still[t]:
            # of each window with a belief before to each that the later queries like
            pairs = steps.pairs(after[t - 1], message, absent)
            message, absent = steps.expected(message, absent)
            explained = (after[t - 1] * message).sum() + outside[t - 1, 1] * absent
            moves += pairs / explained.clamp(min=MIN_PROBABILITY)
        before[t], after[t] = others / (others.sum() + gone), mass / (mass.sum() + away)
    return Swept(after, before, moves, total if math.isfinite(total) else -math.inf)
