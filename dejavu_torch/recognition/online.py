"""What a filter learns of a drive on the way: how far right places stand out, how the camera moves, how near
queries come to the map."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from typing_extensions import Self

from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.evidence import LEAST_WIDE, LOW, MIDDLE, MIN_SHARE, Presence

MEAN_OF = 25  # queries, whose mean varies by as much as they depend on each other
PRIOR, MOVE_PRIOR = 100.0, 50.0  # queries that the given sharpness, and the given moves, count as
LEAST_MEAN = 0.3  # mean z of right places
MIN_VARIANCE = 1e-6
BEYOND = 3.0  # deviations beyond queries that show nothing, where a histogram of best scores ends


class Learned(NamedTuple):
    """Sums over the queries so far; z is how far a score lies below the mean of its query, in deviations.

    total: (N,) of z, in whole blocks. block: (N,) of z, in the latest one. numbers: (4,) of the queries, of
    the mean squares of a block's mean z, of z where a place was expected, and of the mass expected.
    moves: (V+1,) of the moves.
    """

    total: Tensor
    block: Tensor
    numbers: Tensor
    moves: Tensor

    @classmethod
    def size(cls, places: int, moves: int) -> int:
        """How many numbers these are."""
        return 2 * places + 4 + moves

    @classmethod
    def unpacked(cls, numbers: Tensor, places: int, moves: int) -> Self:
        return cls(*numbers[: cls.size(places, moves)].split([places, places, 4, moves]))

    def after(self, z: Tensor, speaks: Tensor, expected: Tensor, moves: Tensor) -> Learned:
        """The sums after another query.

        Args:
            z: (N,), 0 where nothing covers a place. speaks: (), whether scores differ. expected: (N,),
                probabilities given the queries before. moves: (V+1,), expected numbers.
        """
        speaks = speaks.to(z)
        queries, squares, mean, mass = self.numbers.unbind()
        queries, block = queries + speaks, self.block + speaks * z
        full = (queries.remainder(MEAN_OF) == 0) * speaks
        squares = squares + full * (block / MEAN_OF).square().mean()
        mean, mass = mean + speaks * (expected * z).sum(), mass + speaks * expected.sum()
        numbers = torch.stack([queries, squares, mean, mass])
        return Learned(self.total + full * block, (1 - full) * block, numbers, self.moves + moves)

    def likelihood(self, sharpness: Tensor, off_map: Tensor) -> tuple[Tensor, Tensor]:
        """Sharpness and off-map z, from those given: the geometric mean of the given sharpness and mu / tau.

        mu is the mean z of the expected places, which leaves out each query's own evidence; tau, how many
        queries in a row say as much as one, the variance of the means of blocks in relation to that of z.
        The off-map state is half as far out as a right place, where Gaussian likelihoods are equal.
        """
        queries, squares, total, mass = self.numbers.unbind()
        given = (2 * off_map).clamp(min=LEAST_MEAN)
        mu = ((PRIOR * given + total) / (PRIOR + mass)).clamp(min=LEAST_MEAN)
        blocks = (queries / MEAN_OF).floor()
        common = (self.total / (blocks * MEAN_OF).clamp(min=1)).square().mean()
        between = (squares / blocks.clamp(min=1) - common) * blocks / (blocks - 1).clamp(min=1)
        tau = (MEAN_OF * between / (1 - common).clamp(min=MIN_VARIANCE)).clamp(min=1)
        weight = torch.where(blocks > 1, blocks * MEAN_OF, 0)
        tau = (PRIOR * given / sharpness + weight * tau) / (PRIOR + weight)
        return (sharpness * mu / tau).sqrt(), torch.where(mass > 0, mu / 2, off_map)

    def moves_after(self, given: Tensor) -> Tensor:
        """Probabilities of the moves, from those given."""
        return (MOVE_PRIOR * given + self.moves) / (MOVE_PRIOR + self.moves.sum())


class Nearness(NamedTuple):
    """`Presence` by a histogram of the best scores so far: of one size, for the state of an exported filter.

    Args:
        off, spread: of best scores of queries that show nothing of the map, see `Presence`.
        bins: of the histogram; with 0 nothing is counted, and nothing said.
    """

    off: float = 0.0
    spread: float = 0.0
    bins: int = 0

    def after(self, scores: Tensor, speaks: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Nats that speak for being off the map at each of the next queries, (B,), and the counts after them.

        Args:
            scores: (B,N). speaks: (B,) bool, whether they differ; else they do not count. counts: (bins,), of
                the queries before.

        Convention: 0 for the first `chosen.KNOWN` queries, and while queries come hardly nearer than those
            that show nothing.
        """
        if not self.bins:
            return scores.new_zeros(len(scores)), counts
        best = scores.where(scores.isfinite(), math.inf).amin(1)
        top = self.off + BEYOND * self.spread
        at = (best / top * self.bins).clamp(0, self.bins - 1).floor()
        bins = torch.arange(self.bins, device=best.device)
        each = counts + ((at[:, None] == bins) & speaks[:, None]).to(counts).cumsum(0)
        low, on = (top / self.bins * _reached(each, share) for share in chosen.NEAREST)
        wide = ((on - low) / (MIDDLE - LOW)).clamp(min=LEAST_WIDE * self.off + MIN_SHARE)
        known = (each.sum(1) >= chosen.KNOWN) & (self.off - on >= chosen.STANDS_APART * wide)
        told = Presence(on, wide, self.off, self.spread).absent(best) / chosen.FILTERED
        return torch.where(known, told, 0), each[-1] if len(best) else counts


UNKNOWN = Nearness()


def _reached(counts: Tensor, share: float) -> Tensor:
    """Up to where a share of what is counted lies, in bins: (B,bins) -> (B,)."""
    before, wanted = counts.cumsum(1) - counts, share * counts.sum(1, keepdim=True)
    return ((wanted - before) / counts.clamp(min=MIN_SHARE)).clamp(0, 1).sum(1)
