"""Ways to store descriptors in few bytes, and their decoded descriptors: keyframes, PCA, quantisers."""

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

Code = Callable[[Tensor], Tensor]  # descriptors (n,K) -> encoded and decoded, (n,K)


class Kept(NamedTuple):
    """Decoded descriptors (N,K) of all places, and the bytes of their store.

    route: bytes that grow with the route, including codebooks fitted on it. fixed: the others, without the
    whitening. apart: k, if only every k-th place is stored and repeated for those after it.
    """

    descriptors: Tensor
    route: int
    fixed: int = 0
    apart: int = 1


def spectral(places: Tensor, budget: float, seed: int | None = None) -> Kept:
    """The spectral map with this many route bytes per place; with a seed its null, of shuffled places."""
    order = torch.arange(len(places)) if seed is None else shuffled(places, seed)[0]
    route = SpectralMapper(budget)(places[order])
    back = torch.empty_like(places)
    back[order] = route.decode(0)
    return Kept(back, sum(tensor.nbytes for name, tensor in route.packed().items() if name != "digest"))


def every_kth(
    places: Tensor, k: int, each: int, code: Code | None = None, between: bool = False, overhead: int = 0
) -> Kept:
    """Every k-th place, coded by `code` in `each` bytes, plus `overhead` bytes once.

    between: also store the last place, and interpolate linearly between the stored ones.
    """
    count = len(places)
    chosen = keyframes(count, k) if between else torch.arange(0, count, k)
    keys = places[chosen] if code is None else code(places[chosen])
    size = len(keys) * each + overhead
    if between:
        return Kept(between_keyframes(keys, count, k), size)
    return Kept(keys.repeat_interleave(k, 0)[:count], size, apart=k)


def principal(places: Tensor, numbers: int, k: int = 1) -> Kept:
    """The strongest principal components of every k-th place, in int8 with a scale each, interpolated.

    The mean and the axes, in one byte per number, count as fixed although they are fitted on the route: those
    of another route would do nearly as well.
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
    """Descriptors coded in one bit per dimension: 1 or -1."""
    return torch.where(places >= 0, 1.0, -1.0)


class Quantiser:
    """Descriptors coded by faiss, by the key of its factory: product codes `PQ8x8np` (Jegou et al.,
    2011) and `OPQ8,PQ8x8np` (Ge et al., 2013), residual ones `RQ8x8`, `LSQ8x8`, `PRQ2x4x8`, and without
    codebooks `PCAR64,SQtqmse1` (TurboQuant), `RR128,RaBitQ`, `RR128,EDEN`.

    Args:
        training: descriptors (n,K).
        multiple: divisor that the code needs K to have; descriptors are padded with zeros.

    each: bytes of a code. width: K, padded.

    Raises:
        InputError: faiss lacks the code, or cannot train it on these descriptors.
    """

    def __init__(self, training: Tensor, key: str, multiple: int = 1) -> None:
        import faiss

        if "x8" in key and len(training) < CENTROIDS:
            raise InputError(
                f"{len(training)} places to train codebooks; expected at least {CENTROIDS}, one per centroid"
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
    """Silence stderr in the block: faiss warns of each codebook with fewer than 39 places per centroid."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
