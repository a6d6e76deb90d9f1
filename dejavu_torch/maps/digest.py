"""Digests of descriptors: 64 signs each, by which frames of one drive are told from those of another."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

BITS, BYTES = 64, 9  # of a digest: signs, and the number of those that change to the next place
PLACES = 256  # of a map, or of a drive, at most
UNKNOWN = BITS  # changes to a next place that was not described
ROWS = 1024  # descriptors at a time
SEED = b"places"


class Digest(NamedTuple):
    """Digests (n,9) of some places (n,), which ascend."""

    places: Tensor
    rows: Tensor

    def within(self, start: int, stop: int) -> Digest:
        """Those of places [start, stop), counted from the first of these."""
        inside = (self.places >= start) & (self.places < stop)
        return Digest(self.places[inside] - start, self.rows[inside])

    def of(self, places: Tensor) -> Tensor:
        """The digests of these places, (m,) -> (m,9), 0 where it is not known; (0,9) if none is."""
        rows = self.rows.new_zeros(len(places), BYTES)
        known = torch.isin(places, self.places)
        rows[known] = self.rows[torch.searchsorted(self.places, places[known])]
        return rows if rows.any() else rows[:0]


@torch.no_grad()
def digests_of(descriptors: Tensor, follow: bool = True) -> Tensor:
    """The signs of a fixed random projection of descriptors, (n,K) -> (n,9) uint8 on the CPU; of a descriptor
    of 0 they are 0. The same for any part of them but for the last byte of the last.

    Args:
        follow: each is of the place behind the one before it.
    """
    parts = [descriptors[:0].cpu().double() @ projection(descriptors.shape[1])]
    for part in descriptors.split(ROWS):  # in doubles, where sums of floats do not depend on their order
        parts.append(part.cpu().double() @ projection(descriptors.shape[1]))
    signs = torch.cat(parts) > 0
    changed = torch.full((len(signs),), UNKNOWN, dtype=torch.uint8)
    if follow and len(signs) > 1:
        steps = (signs[1:] != signs[:-1]).sum(1).to(torch.uint8)
        changed = torch.cat([steps, steps[-1:]])
    packed = torch.from_numpy(np.packbits(signs.numpy(), axis=1))
    return torch.cat([packed, changed[:, None]], 1) * signs.any(1, keepdim=True)


def signs_of(digests: Tensor) -> Tensor:
    """The signs of digests, (n,9) -> (n,64) float32, 1 or -1."""
    bits = np.unpackbits(digests[:, : BYTES - 1].contiguous().numpy(), axis=1)
    return torch.from_numpy(bits).float() * 2 - 1


@lru_cache(maxsize=4)
def projection(dimension: int) -> Tensor:
    """The same on every machine and for every version: 1 and -1, (K,64) float64."""
    drawn = np.frombuffer(hashlib.shake_256(SEED).digest(BITS // 8 * dimension), dtype=np.uint8)
    return torch.from_numpy(np.unpackbits(drawn).reshape(dimension, BITS).astype(np.float64) * 2 - 1)
