"""Ways to store descriptors in few bytes, and what each gives back: keyframes, PCA, product quantisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.evaluation.baselines import as_int8, between_keyframes, keyframes
from dejavu_torch.evaluation.controls import shuffled
from dejavu_torch.maps.spectral import SpectralMapper
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


class ProductQuantiser:
    """Codes of m bytes, each the nearest of 256 centroids of a part of the descriptor (Jegou et al., 2011).

    rotated: trains a rotation ahead of it too (OPQ: Ge et al., 2013). int8: keeps codebooks and rotation in
    int8, if they count; it changes next to nothing. bytes: of codebooks and rotation, a byte a number.
    """

    def __init__(self, training: Tensor, m: int, rotated: bool = False, int8: bool = False) -> None:
        import faiss

        if len(training) < CENTROIDS:
            raise InputError(
                f"{len(training)} places to train codebooks on; expected at least {CENTROIDS}, one a centroid"
            )
        self.numbers = training.shape[1]
        self.width = -(-self.numbers // m) * m
        rows = self._padded(training)
        self.rotation: Tensor | None = None
        if rotated:
            inner, turn = self._quantiser(m), faiss.OPQMatrix(self.width, m)
            turn.pq = inner  # which must outlive the training
            turn.train(rows.numpy())
            matrix = torch.from_numpy(faiss.vector_to_array(turn.A).reshape(self.width, self.width))
            self.rotation = as_int8(matrix) if int8 else matrix
            rows = rows @ self.rotation.T
        self.pq = self._quantiser(m)
        self.pq.train(rows.contiguous().numpy())
        if int8:
            centroids = torch.from_numpy(faiss.vector_to_array(self.pq.centroids))
            faiss.copy_array_to_vector(as_int8(centroids).numpy(), self.pq.centroids)
        self.bytes = CENTROIDS * self.width + (self.width**2 if rotated else 0)

    def _quantiser(self, m: int):  # type: ignore[no-untyped-def]
        import faiss

        pq = faiss.ProductQuantizer(self.width, m, 8)
        pq.cp.min_points_per_centroid = 1  # it warns of fewer than 39
        return pq

    def _padded(self, rows: Tensor) -> Tensor:
        return F.pad(rows.float(), (0, self.width - self.numbers)).contiguous()

    def __call__(self, descriptors: Tensor) -> Tensor:
        """What the codes of descriptors give back. Shape: (n,K) -> (n,K)."""
        rows = self._padded(descriptors)
        if self.rotation is not None:
            rows = rows @ self.rotation.T
        back = torch.from_numpy(self.pq.decode(self.pq.compute_codes(rows.contiguous().numpy())))
        if self.rotation is not None:
            back = back @ self.rotation
        return back[:, : self.numbers]
