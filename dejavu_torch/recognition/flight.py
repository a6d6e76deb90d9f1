"""The places of all queries of a flight over an area, each given all of them: a smoother in the plane.

As along a route, but the states are the windows of an area and being off it, and moves are a kernel over rows
and columns, which is learned from the queries as the rest is. A step over the border leaves the area.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn

from dejavu_torch.memory import check_room
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import Counts, Evidence, Fit, FittedPart, Rates, explained, learn, nats
from dejavu_torch.recognition.evidence import RankTable, Spacing, place_means, standardised
from dejavu_torch.recognition.motion import logits
from dejavu_torch.recognition.plane import PlaneMotion, rings
from dejavu_torch.recognition.smoother import (
    PlaceSmoother,
    Rows,
    first_that_explains,
    tempering_of,
)
from dejavu_torch.recognition.taken import moves_along

BYTES = 45  # of memory for each query and window


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
    if not queries:
        return scores, smoother.forgetful()
    weight = spacing.weight.to(scores)
    means = smoother.removed * place_means(scores, weight)
    std, ranks = standardised(scores, means), RankTable()
    ranks.add(std.z, std.only((weight * std.speaks)[:, None].expand_as(std.z), 0))
    tempering = tempering_of(spacing)
    smoother = smoother.forgetful().changed(correlation=spacing.correlation, tempering=tempering)
    reach, first = len(smoother.move_logits) - 1, max(0, (queries - chosen.FLIGHT_FITTED) // 2)
    part = slice(first, first + chosen.FLIGHT_FITTED)
    some, own = std.map(lambda column: column[part]), weight[part]
    away, over = torch.arange(-reach, reach + 1).square(), partial(PlaneMotion, layout)
    sample, _, *rare = FittedPart(some, own, spacing.still[part], over), *smoother.rates(own)

    def fitted(spread: float) -> Fit:
        kernel = torch.exp(-(away[:, None] + away) / (2 * spread**2)).flatten()
        prior = chosen.MOVE_SHARE * len(own) * kernel / kernel.sum()

        def again(counts: Counts) -> Rates:
            moves = counts.moves + prior
            return Rates(moves / moves.sum(), *rare)  # jumps are not learned

        first = Evidence(ranks.values, chosen.FLIGHT_SEPARATION, tempering)
        rates, least = Rates(kernel / kernel.sum(), *rare), chosen.LEAST_FLIGHT_SEPARATION
        rates, found = learn([sample], ranks, rates, first, least, again)
        (log,) = nats([sample], found, rates)
        return Fit(rates, found, log, log)

    moving = float((~sample.still).sum())
    rates, found, *_ = first_that_explains(map(fitted, chosen.SPREADS), moving, float(own.sum()))
    every, motion = FittedPart(std, weight, spacing.still, over), over(rates)
    mass, log = scores.new_empty(queries, layout.places), 0.0
    for block in explained(every, found, motion):
        mass[block.first : block.first + len(block.log)] = motion.folded(block.posterior)[:, :-1]
        log += float(block.log.sum())
    log = log if math.isfinite(log) else -math.inf
    nats_per_query = tempering * log / max(1.0, float(weight.sum()))
    moves = torch.zeros(reach + 1).index_add_(0, rings(reach).flatten(), rates.moves)
    return mass, smoother.changed(
        separation=found.separation,
        log_likelihood=log,
        nats_per_query=nats_per_query,
        is_drive=moves_along(log, nats_per_query),
        move_logits=nn.Parameter(logits(*moves.tolist()).to(smoother.move_logits)),
    )
