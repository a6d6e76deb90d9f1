"""Steady speeds of a camera, beside a motion that is drawn anew at each query."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import accumulate
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from typing_extensions import Self

from dejavu_torch.recognition import chosen
from dejavu_torch.types import expect

MOST_CHAINS, FASTEST = 24, 100


class Speeds(NamedTuple):
    """A camera keeps one of n speeds, or moves freely, and changes between these now and then.

    A speed of p / q places a query is a cycle of q chains of states, which move on by p places in all: 3/2
    moves by 1, 2, 1, 2 and so on. A move may slip by a place. The free motion is the last chain.

    Attributes:
        speeds: in places a query, ascending.
        shares: (n+1,n+1), of each speed, and of the free motion, that goes on as each of them.
        first: (n+1,), share of each of a camera that comes from elsewhere.
    """

    speeds: tuple[Fraction, ...]
    shares: Tensor
    first: Tensor

    @property
    def owners(self) -> Tensor:
        """The speed of each chain, (M,) int64."""
        return torch.tensor(
            [i for i, speed in enumerate((*self.speeds, Fraction(1))) for _ in range(_cycle(speed))]
        )

    @property
    def change(self) -> Tensor:
        """The share of each chain that goes on as each chain, (M,M)."""
        owners, size = self.owners, torch.tensor([_cycle(speed) for speed in (*self.speeds, Fraction(1))])
        shares = (self.shares / size.to(self.shares))[owners][:, owners]
        same = owners[:, None] == owners
        # of the same speed, the next chain of its cycle
        first = torch.tensor([0, *accumulate(size.tolist())])[owners]
        at = torch.arange(len(owners))
        following = first + (at - first + 1) % size[owners] == at[:, None]
        return torch.where(same, following.mT * (size[owners] * shares.diagonal())[:, None], shares)

    @property
    def enter(self) -> Tensor:
        """The share of each chain of a camera that comes from elsewhere, (M,)."""
        owners = self.owners
        return (self.first / owners.bincount())[owners]

    def beside(self, free: Tensor) -> Tensor:
        """The moves of all chains, (...,V+1) of the free motion -> (...,M,W+1)."""
        rows = [_moves(speed, phase) for speed in self.speeds for phase in range(_cycle(speed))]
        width = max(free.shape[-1], *(1 + max(row) for row in rows)) if rows else free.shape[-1]
        free = F.pad(free, (0, width - free.shape[-1]))[..., None, :]
        if not rows:
            return free
        steady = free.new_tensor([[row.get(move, 0.0) for move in range(width)] for row in rows])
        return torch.cat([steady.expand(*free.shape[:-2], -1, -1), free], -2)

    def learned(self, changes: Tensor) -> Self:
        """By expected numbers of changes of the chain, (M,M), with those of a prior; speeds that hardly occur
        are left out."""
        owners, count = self.owners.to(changes.device), len(self.shares)
        found = changes.new_zeros(count, count)
        found.index_put_((owners[:, None].expand_as(changes), owners.expand_as(changes)), changes, True)
        kept = found.sum(0) >= chosen.SELDOM * found.sum()
        kept[-1] = True
        shares = (found + chosen.CHANGE_COUNTS * self.shares.to(found))[kept][:, kept]
        speeds = tuple(speed for speed, keeps in zip(self.speeds, kept[:-1].tolist(), strict=True) if keeps)
        return self._replace(speeds=speeds, shares=shares / shares.sum(1, keepdim=True), first=_first(speeds))


def _cycle(speed: Fraction) -> int:
    return speed.denominator


def _moves(speed: Fraction, phase: int) -> dict[int, float]:
    """Probabilities of the moves of a chain."""
    move, slip = (phase + 1) * speed // 1 - phase * speed // 1, chosen.SLIP / 2
    if not move:
        return {0: 1 - slip, 1: slip}
    return {move - 1: slip, move: 1 - 2 * slip, move + 1: slip}


def _first(speeds: Sequence[Fraction], usual: float = 0.0) -> Tensor:
    """Half of the cameras that come from elsewhere move freely, or as many of the rest as at one place a
    query, which `usual` of them do."""
    shares = torch.full((len(speeds) + 1,), 0.5 / max(1, len(speeds))).double()
    shares[-1] = 0.5
    if usual and 1 in speeds:
        shares[:-1] = (1 - 2 * usual) / max(1, len(speeds) - 1)
        shares[[speeds.index(Fraction(1)), -1]] = usual
    return shares / shares.sum()


def steady(
    speeds: Sequence[Fraction | float] = chosen.STEADY, keeps: float = chosen.KEEPS, usual: float = 0.0
) -> Speeds:
    """Speeds of which each is kept for long, then changes to the next ones or to free motion; `usual` of the
    cameras come at one place a query, and as many move freely.

    Raises:
        InputError: speeds out of range, or more than `MOST_CHAINS` in all.
    """
    given = [float(speed) for speed in speeds]
    fits = all(1 / MOST_CHAINS <= speed <= FASTEST for speed in given)
    expect(fits, f"{1 / MOST_CHAINS:.2g} to {FASTEST} places a query", f"the speeds are {given}")
    known = sorted({Fraction(speed).limit_denominator(MOST_CHAINS) for speed in speeds})
    chains = sum(map(_cycle, known))
    seen = f"the speeds {', '.join(map(str, known))} need {chains} chains of states"
    expect(chains <= MOST_CHAINS, f"at most {MOST_CHAINS}, as with speeds of small denominators", seen)
    count, near = len(known), chosen.TO_NEXT
    shares = torch.zeros(count + 1, count + 1).double()
    for i in range(count):
        beside = [j for j in (i - 1, i + 1) if 0 <= j < count]
        shares[i, beside] = (1 - keeps) * near / max(1, len(beside))
        shares[i, i], shares[i, count] = keeps, (1 - keeps) * (1 - near if beside else 1)
    if not known:
        return FREE
    shares[count, :count], shares[count, count] = (1 - chosen.STAYS_FREE) / count, chosen.STAYS_FREE
    return Speeds(tuple(known), shares, _first(known, usual))


FREE = Speeds((), torch.ones(1, 1).double(), torch.ones(1).double())
