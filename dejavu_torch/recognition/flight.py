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


class Flight:
    """A flight over an area, and a smoother that is fitted to its queries.

    Args:
        rows: scores (B,N) of queries by their numbers. queries: Q. spacing: `spacing_of` their descriptors.

    Attributes:
        scores: (Q,N). smoother: has learned from the queries, and knows whether they are over it at all.

    Raises:
        InputError: more queries and windows than fit into memory.
    """

    @torch.no_grad()
    def __init__(
        self, smoother: PlaceSmoother, rows: Rows, queries: int, layout: Layout, spacing: Spacing
    ) -> None:
        cells = layout.rows * layout.columns
        check_room(BYTES * queries * cells, f"a drive of {queries} images over {cells} rows x columns")
        self.scores, self.layout = rows(torch.arange(queries)).float().cpu(), layout
        self.smoother = smoother.forgetful()
        if not queries:
            return
        weight = spacing.weight.to(self.scores)
        self.means = smoother.removed * place_means(self.scores, weight)
        std, ranks = standardised(self.scores, self.means), RankTable()
        ranks.add(std.z, std.only((weight * std.speaks)[:, None].expand_as(std.z), 0))
        tempering = tempering_of(spacing)
        reach, first = len(smoother.move_logits) - 1, max(0, (queries - chosen.FLIGHT_FITTED) // 2)
        self.whole = FittedPart(std, weight, spacing.stopped, partial(PlaneMotion, layout))
        sample = self.whole.part(first, min(queries, first + chosen.FLIGHT_FITTED))
        away, (_, *rare) = torch.arange(-reach, reach + 1).square(), smoother.rates(weight)

        def fitted(spread: float) -> Fit:
            kernel = torch.exp(-(away[:, None] + away) / (2 * spread**2)).flatten()
            prior = chosen.MOVE_SHARE * len(sample.weight) * kernel / kernel.sum()

            def again(counts: Counts) -> Rates:
                moves = counts.moves + prior
                return Rates(moves / moves.sum(), *rare)  # jumps are not learned

            evidence = Evidence(ranks.values, chosen.FLIGHT_SEPARATION, tempering)
            rates, least = Rates(kernel / kernel.sum(), *rare), chosen.LEAST_FLIGHT_SEPARATION
            rates, found = learn([sample], ranks, rates, evidence, least, again)
            (log,) = nats([sample], found, rates)
            return Fit(rates, found, log, log)

        moving = float((~sample.still).sum())
        fits = map(fitted, chosen.SPREADS)
        self.rates, self.evidence, *_ = first_that_explains(fits, moving, float(sample.weight.sum()))
        (log,) = nats([self.whole], self.evidence, self.rates)
        log = log if math.isfinite(log) else -math.inf
        nats_per_query = tempering * log / max(1.0, float(weight.sum()))
        moves = torch.zeros(reach + 1).index_add_(0, rings(reach).flatten(), self.rates.moves)
        self.smoother = self.smoother.changed(
            correlation=spacing.correlation,
            tempering=tempering,
            separation=self.evidence.separation,
            log_likelihood=log,
            nats_per_query=nats_per_query,
            is_drive=moves_along(log, nats_per_query),
            move_logits=nn.Parameter(logits(*moves.tolist()).to(smoother.move_logits)),
        )

    @torch.no_grad()
    def masses(self, smoother: PlaceSmoother) -> Tensor:
        """The mass of each window for each query, (Q,N), without what is off the area.

        Args:
            smoother: that of the flight, which may know what single images say.
        """
        if not len(self.scores):
            return self.scores
        presence = None if smoother.singly is None else smoother.singly.presence
        std = standardised(self.scores, self.means, presence)
        whole, mass = self.whole._replace(std=std), torch.empty_like(self.scores)
        states = chosen.HEADINGS * math.isqrt(len(mass)) * self.layout.rows * self.layout.columns
        motion = PlaneMotion(self.layout, self.rates, chosen.HEADINGS if states <= chosen.MOST_STATES else 1)
        for block in explained(whole, self.evidence, motion):
            last = block.first + len(block.log)
            mass[block.first : last] = motion.folded(block.posterior)[:, :-1]
        return mass
