"""Learned whitening: the directions of a descriptor that tell places apart and change little on one place."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError

log = logging.getLogger("dejavu_torch")

ROWS = 1024  # in double precision at a time
SAMPLED = 4096  # rows that principal components are found in
DIMENSIONS = 128  # unless said otherwise
WIDEST = 256  # dimensions without whitening
PLACES_PER_DIMENSION = 4  # a short route does not fill as many dimensions
COMPONENTS = 400  # that whitening works on
VIEWS = 4  # of a frame, on a long route
VIEWS_PER_COMPONENT = 30  # on any: as 4 views of each of 3000 frames
ENOUGH = 12  # views of a frame: more cost time and change nothing
SHRINKAGE = 0.03  # at least
SPARE = 32  # further directions of the randomised subspace, which make it accurate
ROUNDS = 3  # of its iteration
STRENGTHS: Mapping[str, Any] = {  # of augmented copies: those of `Augmentation`
    name: [*strength] if len(strength) > 1 else strength[0]
    for name, strength in Augmentation().strengths.items()
    if max(strength)
}
LEAST = 1e-12  # absolute value that a power is applied to: keeps gradients finite
ROUNDING = 1e-7  # of the largest variance: below it there is none


def learned_whitening(
    views: Tensor, places: Tensor, kept: int, shrinkage: float | None = 0.5
) -> tuple[Tensor, Tensor]:
    """The projection to what tells places apart and changes little between two views of one place.

    With d = (view - place) / 2, m = (view + place) / 2, C = E[d d^T], B = Cov[m] and
    W = (1 - a) C + a tr(C) / K I, the columns of P are the `kept` directions with the largest
    p^T B p / p^T W p, scaled to p^T W p = 1 (Mikolajczyk and Matas, ICCV 2007). The shrinkage a is above 0
    and at most 1; None is `oracle_shrinkage`, and at least 0.03.

    Shape: (n,K), (n,K) -> mean (K,), P (K,kept), float32.
    """
    n, k = views.shape
    within, second = views.new_zeros(2, k, k, dtype=torch.float64)
    mean = views.new_zeros(k, dtype=torch.float64)
    for view, place in zip(views.split(ROWS), places.split(ROWS), strict=True):
        change, middle = (view.double() - place.double()) / 2, (view.double() + place.double()) / 2
        within += change.T @ change / n
        second += middle.T @ middle / n
        mean += middle.sum(0) / n
    scale, size = within.diagonal().mean(), second.diagonal().mean()
    if not scale.isfinite() or not scale > 1e-10 * size:
        raise InputError(
            f"the descriptors of {n} views differ from those of their places by {scale.item():.2g} in the "
            "mean square; expected a finite number, and more than rounding: an augmentation, or a second "
            "traverse"
        )
    if shrinkage is None:
        shrinkage = max(SHRINKAGE, oracle_shrinkage(within, n))
    within = (1 - shrinkage) * within
    within.diagonal().add_(shrinkage * scale)
    # P = L^-T E, where W = L L^T and E holds the eigenvectors of L^-1 B L^-T
    unit = torch.linalg.inv(torch.linalg.cholesky(within))
    vectors = torch.linalg.eigh(unit @ (second - torch.outer(mean, mean)) @ unit.T).eigenvectors.flip(1)
    return mean.float(), (unit.T @ vectors[:, :kept]).float()


def oracle_shrinkage(covariance: Tensor, samples: int) -> float:
    """How much of a covariance (K,K) of Gaussian samples to replace by a multiple of the identity, 0 to 1
    (Chen, Wiesel, Eldar and Hero, IEEE Transactions on Signal Processing 58, 2010, eq. 23)."""
    size, trace = len(covariance), float(covariance.trace())
    square = float(covariance.square().sum())
    spread = (samples + 1 - 2 / size) * (square - trace**2 / size)
    wanted = (1 - 2 / size) * square + trace**2
    return min(1.0, wanted / spread) if spread > 0 else 1.0


class Whitening(nn.Module):
    """A descriptor of few dimensions, which tells places apart and changes little with light and view: for
    one route, principal components, then `learned_whitening` by views of its places, which are augmented
    copies of its frames, or frames of a second traverse.

    Args:
        numbers: K, at most the rank. None is 128, on a short route a quarter of its places; without views
            256.
        components: principal components that are whitened, at least K.
        shrinkage: of `learned_whitening`. None is 0.03, and more if there are few views.
        views: augmented copies of each frame. None is 4, up to 12 on a short route: 30 for each component.
        most_views: copies in all; frames are drawn evenly if there would be more.
        strengths: arguments of `Augmentation`, in place of those of `STRENGTHS`.
        seed: of the copies.
        bits: of each number of the projection: 4, two to a byte, 8 or 16.
        power: of the absolute value of each whitened number, above 0 and at most 1. Below 1 large ones, such
            as those of something new in the frame, count for less.

    Shape: (B,D) -> (B,K).

    Convention: descriptors have length 1. Without views they are the principal components, with their
        variances, and a constant number, the root mean square of these. Before `learn` descriptors pass.

    Raises:
        InputError: settings out of range; learn: descriptors that do not vary, views that equal their places,
            more `numbers` than the rank; forward: descriptors of another dimension.

    Example:
        >>> route, whitening = torch.randn(400, 16), Whitening(numbers=4)
        >>> whitening.learn(route, [(route + 0.1 * torch.randn(400, 16), torch.arange(400))])
        >>> whitening(route).shape
        torch.Size([400, 4])
    """

    projection: Tensor
    scale: Tensor
    offset: Tensor
    length: Tensor

    def __init__(
        self,
        numbers: int | None = None,
        components: int = COMPONENTS,
        shrinkage: float | None = None,
        views: int | None = None,
        most_views: int = 20000,
        strengths: Mapping[str, Any] | None = None,
        seed: int = 0,
        bits: int = 4,
        power: float = 1.0,
    ) -> None:
        super().__init__()
        if not isinstance(strengths, Mapping | None):
            raise InputError(f"the strengths are {strengths!r}; expected arguments of Augmentation by name")
        self.numbers, self.components, self.shrinkage, self.views = numbers, components, shrinkage, views
        self.most_views, self.seed, self.bits, self.power = most_views, seed, bits, power
        least, shares = 1 if numbers is None else numbers, (power, 1 if shrinkage is None else shrinkage)
        counts = 1 <= least <= components and (views or 0) >= 0 and most_views >= 1
        if not counts or bits not in (4, 8, 16) or not all(0 < share <= 1 for share in shares):
            raise InputError(
                f"Whitening got {settings_of(self, 'strengths', 'seed')}; expected numbers of at least 1 and "
                "at most components, 0 views or more, at least 1 in all, a shrinkage and a power above 0 "
                "and at most 1, bits of 4, 8, 16"
            )
        self.strengths = {**STRENGTHS, **(strengths or {})}
        self.fixed = False  # learned elsewhere: it serves this route unchanged
        self.register_buffer("projection", torch.zeros(0, 0, dtype=torch.int8))  # (D,K), see `take`
        self.register_buffer("scale", torch.zeros(0))  # (K,)
        self.register_buffer("offset", torch.zeros(0))  # (K,), of the mean
        self.register_buffer("length", torch.zeros(0))  # (1,), the constant number, or (0,)

    @property
    def whole(self) -> Tensor:
        """(D,K): the projection in units of `scale`."""
        if self.projection.dtype != torch.uint8:
            return self.projection
        halves = torch.cat([self.projection & 15, self.projection >> 4], 1)
        return halves[:, : self.scale.shape[0]].to(torch.int8) - 8

    def unpacked(self) -> Tensor:
        """`whole` as float32, by columns in memory, for a fast `forward` of single descriptors."""
        return self.whole.T.float().contiguous().T

    @property
    def learned(self) -> bool:
        """Whether there is a projection."""
        return self.projection.numel() > 0

    @property
    def dimension(self) -> int:
        """Of a whitened descriptor, once there is a projection."""
        return len(self.scale) + len(self.length)

    def forward(self, descriptors: Tensor, unpacked: Tensor | None = None) -> Tensor:
        """Descriptors (B,D) -> (B,K); `unpacked`: the result of that method, if it is kept."""
        if not self.learned:
            return descriptors
        shape = tuple(descriptors.shape)
        if shape[1:] != (len(self.projection),):
            raise InputError(f"the whitening got descriptors {shape}; expected (B, {len(self.projection)})")
        # bf16 is too coarse for the small differences that whitening enlarges
        with torch.autocast(descriptors.device.type, enabled=False):
            exact = descriptors.to(torch.promote_types(descriptors.dtype, torch.float32))
            whole = self.whole if unpacked is None else unpacked
            whitened = (exact @ whole.to(exact)) * self.scale.to(exact) - self.offset.to(exact)
            if len(self.length):
                whitened = torch.cat([whitened, self.length.to(whitened).expand(whitened.shape[0], 1)], 1)
            elif self.power < 1:
                whitened = whitened.sign() * whitened.abs().clamp(min=LEAST) ** self.power
            return nn.functional.normalize(whitened, dim=1)

    def copies(self, frames: int, features: int) -> int:
        """Augmented copies of each frame, by the numbers of frames and features."""
        if self.views is not None:
            return self.views
        components = min(frames, features, self.components)
        return min(ENOUGH, max(VIEWS, math.ceil(VIEWS_PER_COMPONENT * components / frames)))

    def kept(self, places: int, features: int, views: bool) -> int:
        """Dimensions that are kept, unless the rank of the route is lower."""
        if self.numbers is not None:
            return self.numbers
        return min(DIMENSIONS, features, max(1, places // PLACES_PER_DIMENSION)) if views else WIDEST

    @torch.no_grad()
    def learn(self, places: Tensor, views: Iterable[tuple[Tensor, Tensor]] | None = None) -> None:
        """Find the projection for one route.

        Args:
            places: (N,D), the descriptors of the route; they may lie in a file.
            views: batches of descriptors (B,D) and the places (B,) that they show; None has no views.
        """
        kept = self.kept(len(places), places.shape[1], views is not None)
        found = principal_components(places, kept if views is None else self.components, self.seed)
        # many descriptors lie in a file, wherever the model is
        mean, basis, variances = (one.to(self.scale.device) for one in found)
        rank = int((variances > ROUNDING * variances[0]).sum())
        if kept > rank and self.numbers is not None:
            raise InputError(f"numbers is {kept}, but the descriptors of this route have rank {rank}")
        if kept > rank and views is not None:
            log.warning("the descriptors of this route have rank %d: as many numbers, not %d", rank, kept)
        kept = min(kept, rank)
        if views is None:
            self.take(mean, basis[:, :kept], variances[:kept].mean().sqrt())
            return
        basis, pairs = basis[:, :rank], []
        for view, place in views:
            if view.shape[1] != len(mean):
                raise InputError(
                    f"the views have {view.shape[1]} features; expected {len(mean)} as in the route"
                )
            own = places[place.to(places.device)].to(mean)
            pairs.append(torch.stack([(part - mean) @ basis for part in (view, own)]))
        if not pairs:
            raise InputError("there are no views to whiten with; expected some, or None for none")
        shown, own = torch.cat(pairs, 1)
        centre, projection = learned_whitening(shown, own, kept, self.shrinkage)
        self.take(mean + basis @ centre, basis @ projection, None)

    def take(self, mean: Tensor, projection: Tensor, length: Tensor | None) -> None:
        """Set mean (D,), projection (D,K), rounded to `bits`, and the constant number, if any.

        Of 4 bits two numbers are a byte, the first half of the columns the lower ones.
        """
        self.scale = projection.abs().amax(0) / (2 ** (self.bits - 1) - 1)
        whole = (projection / self.scale).round()
        self.projection = whole.to(torch.int8 if self.bits <= 8 else torch.int16)
        if self.bits == 4:
            low, high = nn.functional.pad(whole + 8, (0, whole.shape[1] % 2)).to(torch.uint8).chunk(2, 1)
            self.projection = low | high << 4
        self.offset = (mean @ whole) * self.scale
        self.length = self.scale.new_zeros(0) if length is None else length.to(self.scale).view(1)

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *args: Any) -> None:
        buffers = {name: state.get(prefix + name, own) for name, own in self.named_buffers(recurse=False)}
        kind, seen = buffers["projection"].dtype, [tuple(one.shape) for one in buffers.values()]
        width = tuple((count + 1) // 2 if kind == torch.uint8 else count for count in seen[1])
        fits = len(seen[0]) == 2 and seen[0][1:] == width and seen[2] == seen[1] and seen[3] in ((0,), (1,))
        finite = all(bool(stored.isfinite().all()) for stored in buffers.values())
        if not fits or not finite or kind not in (torch.uint8, torch.int8, torch.int16):
            raise InputError(
                f"the whitening has a projection, scale, offset and length of {seen}; expected finite (D,K), "
                "two numbers to a byte in uint8, (K,), (K,), and one number or none"
            )
        for name, stored in buffers.items():
            setattr(self, name, torch.empty_like(stored, device=self.scale.device))
        super()._load_from_state_dict(state, prefix, *args)

    def extra_repr(self) -> str:
        return settings_of(self, *(["strengths"] if self.strengths == STRENGTHS else []))


def principal_components(rows: Tensor, count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """The directions in which SAMPLED of the descriptors, drawn evenly, vary most, by subspace iteration
    (Halko, Martinsson and Tropp, SIAM Review 53, 2011, algorithm 4.4), faster than `torch.svd_lowrank`.

    Shape: (N,D) -> mean (D,), basis (D,C), variances (C,), the largest first; C is `count` at most.
    """
    if rows.ndim != 2 or len(rows) < 2:
        raise InputError(f"the descriptors are {tuple(rows.shape)}; expected (N,D), N at least 2")
    sample = rows[:: max(1, len(rows) // SAMPLED)].float()
    mean = sample.mean(0)
    centred = sample - mean
    width = min(count + SPARE, len(sample), rows.shape[1])
    generator = torch.Generator().manual_seed(seed)
    basis = torch.randn(rows.shape[1], width, generator=generator).to(centred)
    for _ in range(ROUNDS):
        basis = torch.linalg.qr(centred.T @ (centred @ basis)).Q
    inside = (centred @ basis).double()
    variances, turn = torch.linalg.eigh(inside.T @ inside / len(sample))
    variances, turn = variances.flip(0)[:count], turn.flip(1)[:, :count]
    if not variances[0] > ROUNDING * sample.square().mean():
        raise InputError(f"the {len(rows)} descriptors are all alike; expected a route that changes")
    return mean, basis @ turn.to(basis), variances.float()
