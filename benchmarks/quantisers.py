"""Ways to store descriptors in few bytes, and what each gives back: keyframes, PCA, quantisers."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.evaluation.baselines import as_int8, between_keyframes, keyframes
from dejavu_torch.evaluation.controls import shuffled
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

CENTROIDS = 256  # of a codebook: a code is a byte

Code = Callable[[Tensor], Tensor]  # descriptors (n,K) -> what a store gives back of them, (n,K)


class Kept(NamedTuple):
    """Descriptors (N,K) of all places as a store gives them back, and the bytes that it takes.

    route: those that grow with the route, codebooks fitted on it included. fixed: the others, beside the
    whitening. apart: k, if only every k-th place is stored and the others are given back as the one before.
    """

    descriptors: Tensor
    route: int
    fixed: int = 0
    apart: int = 1


def spectral(places: Tensor, budget: float, seed: int | None = None) -> Kept:
    """The spectral map of so many route bytes per place; with a seed that of shuffled places, the null."""
    order = torch.arange(len(places)) if seed is None else shuffled(places, seed)[0]
    route = SpectralMapper(budget)(places[order])
    back = torch.empty_like(places)
    back[order] = route.decode(0)
    return Kept(back, sum(tensor.nbytes for tensor in route.packed().values()))


def every_kth(
    places: Tensor, k: int, each: int, code: Code | None = None, between: bool = False, beside: int = 0
) -> Kept:
    """Every k-th place, at `each` bytes and `beside` bytes once; `code` is what the store gives back of them.

    between: also store the last place, and give back straight lines between the stored ones.
    """
    count = len(places)
    chosen = keyframes(count, k) if between else torch.arange(0, count, k)
    keys = places[chosen] if code is None else code(places[chosen])
    size = len(keys) * each + beside
    if between:
        return Kept(between_keyframes(keys, count, k), size)
    return Kept(keys.repeat_interleave(k, 0)[:count], size, apart=k)


def principal(places: Tensor, numbers: int, k: int = 1) -> Kept:
    """The strongest principal components of every k-th place, in int8 with a scale each; between them lines.

    The mean and the axes, a byte a number, count as fixed, though they are fitted on the route: axes of
    another one would do nearly as well.
    """
    if numbers > min(places.shape):
        raise InputError(f"{numbers} principal components of descriptors {tuple(places.shape)}")
    mean = places.mean(0)
    axes = as_int8(torch.linalg.svd(places - mean, full_matrices=False).Vh[:numbers])
    scores = (places - mean) @ axes.T
    scale = scores.abs().amax(0).clamp(min=1e-30) / 127
    back = ((scores / scale).round() * scale) @ axes + mean
    kept = every_kth(back, k, numbers, between=k > 1)
    return kept._replace(fixed=axes.numel() + 4 * numbers + 4 * len(mean))


def signs(places: Tensor) -> Tensor:
    """What a bit a number gives back: 1 and -1."""
    return torch.where(places >= 0, 1.0, -1.0)


class Quantiser:
    """What a code of faiss gives back, by the key of its factory: product codes `PQ8x8np` (Jegou et al.,
    2011) and `OPQ8,PQ8x8np` (Ge et al., 2013), residual ones `RQ8x8`, `LSQ8x8`, `PRQ2x4x8`, and without
    codebooks `PCAR64,SQtqmse1` (TurboQuant), `RR128,RaBitQ`, `RR128,EDEN`.

    Args:
        training: descriptors (n,K).
        multiple: of K that the code needs; descriptors are padded by zeros.

    each: bytes of a code. width: K, padded.

    Raises:
        InputError: a code that faiss lacks, or that it cannot train on these.
    """

    def __init__(self, training: Tensor, key: str, multiple: int = 1) -> None:
        import faiss

        if "x8" in key and len(training) < CENTROIDS:
            raise InputError(
                f"{len(training)} places to train codebooks on; expected at least {CENTROIDS}, one a centroid"
            )
        self.numbers = training.shape[1]
        self.width = -(-self.numbers // multiple) * multiple
        try:
            self.index = faiss.index_factory(self.width, key)
            with silent():
                self.index.train(self._padded(training))
        except RuntimeError as error:
            raise InputError(f"faiss {faiss.__version__} refuses {key}: {one_line(error)}"[:200]) from error
        self.each: int = self.index.sa_code_size()

    def _padded(self, rows: Tensor) -> Any:
        return F.pad(rows.float(), (0, self.width - self.numbers)).contiguous().numpy()

    def __call__(self, descriptors: Tensor) -> Tensor:
        """Shape: (n,K) -> (n,K)."""
        codes = self.index.sa_encode(self._padded(descriptors))
        return torch.from_numpy(self.index.sa_decode(codes))[:, : self.numbers]


@contextmanager
def silent() -> Iterator[None]:
    """In the block no warnings: faiss has one for each codebook with fewer than 39 places a centroid."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
