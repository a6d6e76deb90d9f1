"""Descriptors of a long route, made as they are read, with the statistics of a measured route."""

from __future__ import annotations

from functools import lru_cache
from itertools import groupby
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.types import InputError, Traverse

REACH = 2048  # places on either side that influence a made descriptor, at most
BLOCK = 4096  # places made together; each block has its own random numbers
PRIME = 1_000_003  # between the random numbers of one seed and the next


class Likeness(NamedTuple):
    """Statistics of descriptors of K dimensions along a route, and of their change on a second traverse.

    mean: (K,), of the route. axes: (K,K), its principal components as columns. filters: (2R,K), from white
    noise to each component, by its spectrum along the route. query_mean: (K,), of the second traverse. rho:
    (K,), regression of its dimensions on those of the route. spread: (K,K), from white noise to the residual.
    sizes: (n,), size of each query's residual over the root mean square.
    """

    mean: Tensor
    axes: Tensor
    filters: Tensor
    query_mean: Tensor
    rho: Tensor
    spread: Tensor
    sizes: Tensor


def likeness(places: Tensor, queries: Tensor, truth: Tensor) -> Likeness:
    """Measure a route (N,K) and a second traverse (Q,K); truth (Q,): the place that each query shows."""
    if min(len(places), len(queries)) < 16:
        raise InputError(
            f"{len(places)} places and {len(queries)} queries to measure; expected at least 16 each"
        )
    mean = places.mean(0)
    centred = places - mean
    _, axes = torch.linalg.eigh((centred.T @ centred / len(places)).double())
    axes = axes.float()
    seen = centred[truth]
    query_mean = queries.mean(0)
    moved = queries - query_mean
    about = seen - seen.mean(0)
    rho = (moved * about).mean(0) / about.square().mean(0).clamp(min=1e-12)
    left = moved - rho * about
    values, turn = torch.linalg.eigh((left.T @ left / len(left)).double())
    root = values.clamp(min=1e-9 * float(values[-1])).sqrt()
    white = left.double() @ turn / root
    sizes = white.square().mean(1).sqrt().float()
    return Likeness(mean, axes, _filters(centred @ axes), query_mean, rho, (turn * root).T.float(), sizes)


def _filters(series: Tensor) -> Tensor:
    """Filters (2R,K), centred at R, that give white noise the spectrum of (N,K) series."""
    count = len(series)
    reach = min(REACH, 1 << (count // 4).bit_length() - 1)
    window = torch.hann_window(2 * reach)[:, None]
    starts = range(0, count - 2 * reach + 1, reach)
    spectra = (torch.fft.rfft(series[s : s + 2 * reach] * window, dim=0).abs().square() for s in starts)
    power: Tensor = sum(spectra, torch.zeros(()))
    filters: Tensor = torch.fft.irfft(power.sqrt(), dim=0).roll(reach, 0) * window
    # keeps the variance of the series for white noise of variance 1
    size: Tensor = torch.linalg.vector_norm(filters, dim=0)
    return filters * (series.std(0) / size.clamp(min=1e-12))


class MadeRoute(Traverse):
    """Descriptors with the covariance, and the spectrum along the route, of one that was measured.

    Convention: Gaussian, then scaled to length 1 like whitened descriptors. A place depends only on its
        number and the seed, so any part of the route can be made by itself.
    """

    def __init__(self, like: Likeness, length: int, seed: int = 0) -> None:
        self.like, self.length, self.seed = like, length, seed
        self.name = f"{length} made descriptors"
        self._noise = lru_cache(4)(self._drawn)
        self._made = lru_cache(2)(self._block)

    def __len__(self) -> int:
        return self.length

    def read(self, frames: range | list[int]) -> Tensor:
        runs = groupby(frames, lambda i: i // BLOCK)
        return torch.cat([self._made(b)[[i - b * BLOCK for i in run]] for b, run in runs])

    def seen_again(self, places: Tensor) -> Tensor:
        """The same places on a second traverse. (Q,) -> (Q,K)"""
        like = self.like
        own = self[places]
        generator = torch.Generator().manual_seed(PRIME * self.seed + PRIME - 1)
        noise = torch.randn(own.shape, generator=generator) @ like.spread
        sizes = like.sizes[torch.randint(len(like.sizes), (len(own), 1), generator=generator)]
        return F.normalize(like.query_mean + like.rho * (own - like.mean) + sizes * noise, dim=1)

    def _drawn(self, block: int) -> Tensor:
        generator = torch.Generator().manual_seed(PRIME * self.seed + block + 1)
        return torch.randn(BLOCK, len(self.like.mean), generator=generator)

    def _block(self, block: int) -> Tensor:
        taps = self.like.filters
        reach = len(taps) // 2
        noise = torch.cat([self._noise(b) for b in (block - 1, block, block + 1)])
        noise = noise[BLOCK - reach : 2 * BLOCK + reach]
        size = len(noise) + len(taps)
        product = torch.fft.rfft(noise, size, dim=0) * torch.fft.rfft(taps, size, dim=0)
        components = torch.fft.irfft(product, size, dim=0)[2 * reach : 2 * reach + BLOCK]
        made: Tensor = F.normalize(self.like.mean + components @ self.like.axes.T, dim=1)
        return made
