"""Learned whitening: directions of a descriptor that distinguish places but change little at one place."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.memory import without_autocast
from dejavu_torch.text import settings_of
from dejavu_torch.types import Facts, InputError, check_shape, expect

log = logging.getLogger("dejavu_torch")

ROWS = 1024  # in double precision at a time
SAMPLED = 4096  # rows in which principal components are found
DIMENSIONS = 128  # by default
WIDEST = 256  # default dimensions without views
PLACES_PER_DIMENSION = 2  # on a short route, at least
COMPONENTS = 400  # principal components that are whitened, by default
VIEWS = 2  # of a frame, at least
VIEWS_PER_COMPONENT = 15  # at least: as 2 views of each of 3000 frames
INDEPENDENT = 4  # copies of a frame; further ones are so much like these that they are no further samples
MOST_VIEWS = 20_000  # in all: of more, frames are drawn evenly
MAX_VIEWS = 12  # of a frame, unless a short route has fewer than COPIES then
COPIES, MOST_OF_SHORT = 4000, 36  # of all frames, of each: chance decides less on a short route
BITS = (4, 8, 16)  # of a number of the projection
FULL_BITS = 4 * DIMENSIONS  # per row of the projection of a long route
SHRINKAGE = 0.03  # at least
VISIT = 16.0  # how many augmented copies a frame of a drive counts as
LIGHT = 50  # frames of a drive that its mean change is shrunk by
SPARE = 32  # further directions of the randomised subspace, for accuracy
ROUNDS = 3  # of its iteration
STRENGTHS: Facts = {  # defaults of `Augmentation`
    name: [*strength] if len(strength) > 1 else strength[0]
    for name, strength in Augmentation().strengths.items()
    if max(strength)
}
LEVELLING = 0.25  # joined dimensions are divided by this power of their root mean square
STRETCH = 2000  # places of a stretch that shows whether lengths count
STRIDES = 4, 8  # of which one place is kept there, to find the others
VARYING, CLEARLY = 0.05, 0.05  # deviation of such lengths over their mean; share by which they miss less
ROUNDING = 1e-7  # of the largest variance: smaller ones count as 0
_Components: TypeAlias = tuple[Tensor, Tensor, Tensor, int]  # mean, basis, variances, dimensions to keep


class Visits(NamedTuple):
    """Frames of drives that a smoother has placed: batches of descriptors (B,D) and places (B,), as of views,
    and (n,) int64 the drive of each frame, in the order of the batches."""

    batches: Iterable[tuple[Tensor, Tensor]]
    drive: Tensor


def learned_whitening(
    views: Tensor,
    places: Tensor,
    kept: int,
    shrinkage: float | None = 0.5,
    samples: int | None = None,
    weight: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The projection to directions that distinguish places but change little between two views of one.

    With d = (view - place) / 2, m = (view + place) / 2, C = E[d d^T], B = Cov[m], shrinkage a in (0, 1] (None
    is `oracle_shrinkage` of `samples` independent views, n if None, at least 0.03) and
    W = (1 - a) C + a tr(C) / K I, P has the `kept` directions with the largest p^T B p / p^T W p, scaled to
    p^T W p = 1 (Mikolajczyk and Matas, ICCV 2007). A pair of `weight` (n,) w counts as w pairs.

    Shape: (n,K), (n,K) -> mean (K,), P (K,kept), float32.
    """
    n, k = views.shape
    share = views.new_ones(n) if weight is None else weight.to(views) * n / weight.sum()
    within, second = views.new_zeros(2, k, k, dtype=torch.float64)
    mean = views.new_zeros(k, dtype=torch.float64)
    for view, place, part in zip(views.split(ROWS), places.split(ROWS), share.split(ROWS), strict=True):
        change, middle = (view.double() - place.double()) / 2, (view.double() + place.double()) / 2
        weighted = middle * part.double()[:, None]
        within += (change * part.double()[:, None]).T @ change / n
        second += weighted.T @ middle / n
        mean += weighted.sum(0) / n
    scale, size = within.diagonal().mean(), second.diagonal().mean()
    if not scale.isfinite() or not scale > 1e-10 * size:
        seen = f"the mean square difference of {n} views from their places is {scale.item():.2g}"
        raise InputError(f"{seen}; expected a finite one above rounding: augmentation or a second traverse")
    if shrinkage is None:
        shrinkage = max(SHRINKAGE, oracle_shrinkage(within, min(n, samples or n)))
    within = (1 - shrinkage) * within
    within.diagonal().add_(shrinkage * scale)
    # P = L^-T E, where W = L L^T and E holds the eigenvectors of L^-1 B L^-T
    unit = torch.linalg.inv(torch.linalg.cholesky(within))
    vectors = torch.linalg.eigh(unit @ (second - torch.outer(mean, mean)) @ unit.T).eigenvectors.flip(1)
    return mean.float(), (unit.T @ vectors[:, :kept]).float()


def oracle_shrinkage(covariance: Tensor, samples: int) -> float:
    """The share of a covariance (K,K) of Gaussian samples to replace by a multiple of the identity, 0 to 1
    (Chen, Wiesel, Eldar and Hero, IEEE Transactions on Signal Processing 58, 2010, eq. 23)."""
    size, trace = len(covariance), float(covariance.trace())
    square = float(covariance.square().sum())
    spread = (samples + 1 - 2 / size) * (square - trace**2 / size)
    wanted = (1 - 2 / size) * square + trace**2
    return min(1.0, wanted / spread) if spread > 0 else 1.0


class Whitening(nn.Module):
    """Reduces descriptors to few dimensions that distinguish the places of a route but change little with
    light and view: principal components, then `learned_whitening` by augmented frames or a second traverse.

    Args:
        numbers: K, at most the rank. None is 128, but at most half the places; without views 256.
        components: principal components that are whitened, at least K.
        shrinkage: of `learned_whitening`. None is 0.03, or more if there are few views.
        views: augmented copies of each frame. None is 2, on a shorter route up to 12, 15 per component, or
            4000 in all if that is more, but at most 36 of each.
        strengths: arguments of `Augmentation`, instead of `STRENGTHS`.
        seed: of the copies.
        bits: of each number of the projection: 4 (two to a byte), 8 or 16. None is 4, or more on a route of
            under 130 places, whose fewer dimensions then take no more bytes than 128 of 4 bits, unless their
            number is set.
        groups: D_1, D_2, .. of concatenated descriptors, each whitened by itself and scaled to length 1; then
            follow the K dimensions that best keep their inner products, the largest lowered a little. None
            is the groups of `Joined` features, or one group.
        lengths: without views, whether the lengths of descriptors count, as of field strengths or ranges, or
            only their directions. None: if that finds clearly more places of a stretch of the route, of which
            every 4th or 8th is kept.

    Shape: (B,D) -> (B,K).

    Convention: descriptors have length 1. Without views they are the principal components, not scaled, and a
        constant: the root mean square of these or, if lengths count, of their length. Before `learn`
        descriptors pass unchanged.

    Raises:
        InputError: settings out of range; learn: constant descriptors, views equal to places, `numbers` above
            the rank, groups that do not add up to D; forward: another dimension.

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
        strengths: Mapping[str, Any] | None = None,
        seed: int = 0,
        bits: Literal[4, 8, 16] | None = None,
        groups: list[int] | None = None,
        lengths: bool | None = None,
    ) -> None:
        super().__init__()
        expect(isinstance(strengths, Mapping | None), "arguments of Augmentation", strengths=strengths)
        self.numbers, self.components, self.shrinkage, self.views = numbers, components, shrinkage, views
        self.seed, self.bits, self.groups = seed, bits, None if groups is None else [*groups]
        self.lengths, self.decides = lengths, lengths is None
        counts = 1 <= (1 if numbers is None else numbers) <= components and (views or 0) >= 0
        if not counts or bits not in (None, *BITS) or not 0 < (1 if shrinkage is None else shrinkage) <= 1:
            expected = "1 <= numbers <= components, views >= 0, shrinkage above 0 and at most 1, "
            expected += "bits of 4, 8 or 16, or None"
            raise InputError(f"Whitening got {settings_of(self, 'strengths', 'seed')}; expected {expected}")
        if groups is not None and min(groups, default=0) < 1:
            raise InputError(f"the groups are {self.groups}; expected a dimension of at least 1 for each")
        self.strengths = {**STRENGTHS, **(strengths or {})}
        self.fixed = False  # whether it comes from elsewhere and is not learned again
        self.register_buffer("projection", torch.zeros(0, 0, dtype=torch.int8))  # (D,K), see `take`
        self.register_buffer("scale", torch.zeros(0).float())  # (K,)
        self.register_buffer("offset", torch.zeros(0).float())  # (K,), the projected mean
        self.register_buffer("length", torch.zeros(0).float())  # (1,), the constant dimension, or (0,)
        self.members = nn.ModuleList()  # a whitening per group, whose outputs the projection joins

    @property
    def unpacked(self) -> Tensor:
        """(D,K): the projection in units of `scale`."""
        if self.projection.dtype != torch.uint8:
            return self.projection
        halves = torch.cat([self.projection & 15, self.projection >> 4], 1)
        return halves[:, : self.scale.shape[0]].to(torch.int8) - 8

    @property
    def parts(self) -> list[Whitening]:
        """This whitening, and those of its groups."""
        return [self, *(member for member in self.members if isinstance(member, Whitening))]

    def all_unpacked(self) -> list[Tensor]:
        """`unpacked` of all `parts` as float32, column-major, for a fast `forward` of single descriptors."""
        return [part.unpacked.T.float().contiguous().T for part in self.parts]

    @property
    def sizes(self) -> list[int]:
        """Dimension of each group of the input, once there is a projection."""
        return [len(member.projection) for member in self.parts[1:]] or [len(self.projection)]

    @property
    def learned(self) -> bool:
        """Whether there is a projection."""
        return self.projection.numel() > 0

    @property
    def dimension(self) -> int:
        """Of the output, once there is a projection."""
        return len(self.scale) + len(self.length)

    def forward(self, descriptors: Tensor, projections: Sequence[Tensor] | None = None) -> Tensor:
        """Descriptors (B,D) -> (B,K); `projections`: stored `all_unpacked`."""
        if not self.learned:
            return descriptors
        sizes = self.sizes
        check_shape(descriptors, f"B {sum(sizes)}", "the whitening got descriptors")
        # bf16 is too coarse for the small differences that whitening amplifies
        with torch.autocast(descriptors.device.type, enabled=False):
            exact = descriptors.to(torch.promote_types(descriptors.dtype, torch.float32))
            wholes = [part.unpacked for part in self.parts] if projections is None else projections
            if len(self.members):
                each = zip(self.parts[1:], exact.split(sizes, 1), wholes[1:], strict=True)
                exact = torch.cat([member._project(group, whole) for member, group, whole in each], 1)
            return self._project(exact, wholes[0])

    def _project(self, exact: Tensor, whole: Tensor) -> Tensor:
        """Projects rows (B,D) by `whole` (D,K), without the members, to length 1."""
        whitened = (exact @ whole.to(exact)) * self.scale.to(exact) - self.offset.to(exact)
        if len(self.length):
            whitened = torch.cat([whitened, self.length.to(whitened).expand(whitened.shape[0], 1)], 1)
        return nn.functional.normalize(whitened, dim=1)

    def copies(self, frames: int, features: int) -> int:
        """Number of augmented copies of each frame of a route."""
        if self.views is not None:
            return self.views
        components = min(frames, features, self.components)
        several = min(MAX_VIEWS, math.ceil(VIEWS_PER_COMPONENT * components / frames))
        return max(VIEWS, several, min(MOST_OF_SHORT, COPIES // frames))

    def kept(self, places: int, features: int, views: bool) -> int:
        """Dimensions to keep, unless the rank of the route is lower."""
        if self.numbers is not None:
            return self.numbers
        return min(DIMENSIONS, features, max(1, places // PLACES_PER_DIMENSION)) if views else WIDEST

    def bits_of(self, places: int, views: bool) -> int:
        """Bits of each number of the projection, if the constructor's are None."""
        if self.numbers is not None:
            return BITS[0]
        return max(
            bits for bits in BITS if bits * self.kept(places, WIDEST, views) <= FULL_BITS or bits == BITS[0]
        )

    @torch.no_grad()
    def learn(
        self,
        places: Tensor,
        views: Iterable[tuple[Tensor, Tensor]] | None = None,
        groups: Sequence[int] | None = None,
        samples: int | None = None,
        visits: Visits | None = None,
    ) -> None:
        """Find the projection for one route.

        Args:
            places: (N,D), the descriptors of the route; they may be in a file.
            views: batches of descriptors (B,D) and the places (B,) that they show, if any.
            groups: see `Joined`, if the constructor's groups are None.
            samples: number of independent views, for the shrinkage; None is all of them.
            visits: frames of drives, which count `VISIT` times as much as views, without the mean change of
                a drive, which is its own light.
        """
        groups = groups if self.groups is None else self.groups
        sizes = [places.shape[1]] if groups is None else [*groups]
        seen = f"groups of {' + '.join(map(str, sizes))} dimensions, descriptors {tuple(places.shape)}"
        expect(sum(sizes) == places.shape[1], f"(N, {sum(sizes)})", seen)
        compared = views is not None or visits is not None
        bits = self.bits_of(len(places), compared)
        members = [self] if groups is None else [self._member() for _ in sizes]
        bases = []
        for member, group in zip(members, places.split(sizes, 1), strict=True):
            kept = self.kept(len(places), group.shape[1], compared)
            bases.append(member._components(group, kept, self.components if compared else kept))
        pairs = None if views is None else _projected_views(places, views, bases)
        weight = None
        if visits is not None:
            shown = _projected_visits(places, visits, bases)
            weight = torch.ones(len(visits.drive)) * VISIT
            if pairs is not None:
                weight = torch.cat([torch.ones(pairs[0].shape[1]), weight])
                samples = samples and samples + len(visits.drive)
                shown = [torch.cat(both, 1) for both in zip(pairs, shown, strict=True)]
            pairs = shown
        with torch.autocast(self.scale.device.type, enabled=False):
            if pairs is None:
                parts = places.split(sizes, 1)
                for member, group, (mean, basis, variances, _) in zip(members, parts, bases, strict=True):
                    each, whole = variances.mean().sqrt(), variances.sum().sqrt()
                    if member.decides:
                        middle = group[max(0, len(group) - STRETCH) // 2 :][:STRETCH].to(mean)
                        member.lengths = _lengths_find_more(
                            middle, _projected(middle, mean, basis), each, whole
                        )
                    member.take(mean, basis, whole if member.lengths else each, bits)
            else:
                for member, (mean, basis, _, kept), (shown, place) in zip(members, bases, pairs, strict=True):
                    centre, projection = learned_whitening(
                        shown, place, kept, self.shrinkage, samples, weight
                    )
                    member.take(mean + basis @ centre, basis @ projection, None, bits)
            if groups is not None:
                some = places[:: max(1, len(places) // SAMPLED)].to(self.scale.device).split(sizes, 1)
                joined = torch.cat([member(group) for member, group in zip(members, some, strict=True)], 1)
                kept = self.kept(len(places), joined.shape[1], compared)
                # about zero, not the mean, to keep the inner products of all pairs, as cosines need
                mean, basis, squares, _ = self._components(joined, kept, kept, centre=False)
                if compared:
                    basis = basis / (squares / squares.mean()) ** (LEVELLING / 2)
                self.take(mean, basis, None, bits)
        self.members = nn.ModuleList([] if groups is None else members)

    def _member(self) -> Whitening:
        """The whitening of a group, not learned yet."""
        return Whitening(bits=self.bits, seed=self.seed).to(self.scale.device)

    def _components(self, places: Tensor, kept: int, count: int, centre: bool = True) -> _Components:
        """`principal_components` up to the rank, and how many dimensions to keep, `kept` at most."""
        # the descriptors of a long route are in a file, wherever the model is
        parts = principal_components(places, count, self.seed, centre)
        mean, basis, variances = (part.to(self.scale.device) for part in parts)
        rank = int((variances > ROUNDING * variances[0]).sum())
        if kept > rank and self.numbers is not None:
            raise InputError(f"numbers is {kept}, but the descriptors of this route have rank {rank}")
        if rank < kept < count:
            log.warning("the descriptors of this route have rank %d: as many dimensions, not %d", rank, kept)
        return mean, basis[:, :rank], variances[:rank], min(kept, rank)

    def take(self, mean: Tensor, projection: Tensor, length: Tensor | None, bits: int = BITS[0]) -> None:
        """Set mean (D,), projection (D,K), rounded to `self.bits`, or to `bits`, and the constant, if any.

        With 4 bits two numbers share a byte; the first half of the columns are the low bits.
        """
        bits = self.bits or bits
        self.scale = projection.abs().amax(0) / (2 ** (bits - 1) - 1)
        whole = (projection / self.scale).round()
        self.projection = whole.to(torch.int8 if bits <= 8 else torch.int16)
        if bits == 4:
            low, high = nn.functional.pad(whole + 8, (0, whole.shape[1] % 2)).to(torch.uint8).chunk(2, 1)
            self.projection = low | high << 4
        self.offset = (mean @ whole) * self.scale
        self.length = self.scale.new_zeros(0) if length is None else length.to(self.scale).view(1)

    def _load_from_state_dict(self, state: dict[str, Tensor], prefix: str, *args: object) -> None:
        inner = f"{prefix}members."
        groups = {name.removeprefix(inner).partition(".")[0] for name in state if name.startswith(inner)}
        self.members = nn.ModuleList(self._member() for _ in groups)  # torch loads them next
        for name, own in [*self.named_buffers(recurse=False)]:
            setattr(self, name, torch.empty_like(state.get(prefix + name, own), device=own.device))
        super()._load_from_state_dict(state, prefix, *args)

    def extra_repr(self) -> str:
        hidden = ["strengths"] * (self.strengths == STRENGTHS) + ["lengths"] * (self.lengths is None)
        return settings_of(self, *hidden)


def _projected_views(
    places: Tensor, views: Iterable[tuple[Tensor, Tensor]], bases: Sequence[_Components]
) -> list[Tensor]:
    """Components (2,n,C) of views, which are read batch by batch, and of their places, for each group."""
    sizes, pairs = [len(mean) for mean, *_ in bases], [list[Tensor]() for _ in bases]
    for view, place in views:
        check_shape(view, f"V {places.shape[1]}", "the views are")
        both = (rows.split(sizes, 1) for rows in (view, places[place.to(places.device)]))
        for held, (mean, basis, *_), *parts in zip(pairs, bases, *both, strict=True):
            held.append(torch.stack([_projected(part, mean, basis) for part in parts]))
    expect(pairs[0], "at least one batch, or None", "there are no views for whitening")
    return [torch.cat(held, 1) for held in pairs]


def _projected_visits(places: Tensor, visits: Visits, bases: Sequence[_Components]) -> list[Tensor]:
    """As `_projected_views`, of visits, whose mean change is removed, drive by drive."""
    pairs = _projected_views(places, visits.batches, bases)
    for drive in visits.drive.unique():
        own = (visits.drive == drive).nonzero()[:, 0].to(pairs[0].device)
        for pair in pairs:
            change = (pair[0, own] - pair[1, own]).sum(0) / (len(own) + LIGHT)
            pair[0, own] -= change
    return pairs


def _lengths_find_more(rows: Tensor, projected: Tensor, each: Tensor, whole: Tensor) -> bool | None:
    """Whether a constant `whole`, with which lengths count, finds more of a route than `each`; else None.

    Shape: rows (N,D), their components (N,C).
    """
    length = rows.float().norm(dim=1)
    if len(rows) < 4 * max(STRIDES) or not length.std() > VARYING * length.mean():
        return None
    missed = [sum(1 - _found(projected, constant, k) for k in STRIDES) for constant in (each, whole)]
    return missed[1] < (1 - CLEARLY) * missed[0] or None


def _found(rows: Tensor, constant: Tensor, stride: int) -> float:
    """Average precision at which rows, with a constant and length 1, find one of both beside them, if only
    every k-th is stored."""
    rows = nn.functional.normalize(nn.functional.pad(rows, (0, 1), value=float(constant)), dim=1)
    query = torch.arange((len(rows) - 1) // stride * stride, device=rows.device)
    query = query[query % stride > 0]
    score, stored = (rows[query] @ rows[::stride].T).max(1)
    beside = stored - query // stride
    right = ((beside == 0) | (beside == 1))[score.argsort(descending=True, stable=True)].double()
    precision = right.cumsum(0) / torch.arange(1, len(right) + 1, device=rows.device)
    return float((precision * right).mean())


@without_autocast
def _projected(rows: Tensor, mean: Tensor, basis: Tensor) -> Tensor:
    return (rows.to(mean) - mean) @ basis


@without_autocast
def principal_components(
    rows: Tensor, count: int, seed: int = 0, centre: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Principal components of SAMPLED evenly drawn descriptors, by subspace iteration (Halko, Martinsson and
    Tropp, SIAM Review 53, 2011, algorithm 4.4), which is faster than `torch.svd_lowrank`.

    Args:
        centre: subtract the mean; else it is 0.

    Shape: (N,D) -> mean (D,), basis (D,C), variances (C,), the largest first; C is at most `count`.
    """
    check_shape(rows, "N>=2 D", "the descriptors are")
    sample = rows[:: max(1, len(rows) // SAMPLED)].float()
    mean = sample.mean(0) if centre else sample.new_zeros(sample.shape[1])
    centred = sample - mean
    width = min(count + SPARE, len(sample), rows.shape[1])
    generator = torch.Generator().manual_seed(seed)
    basis = torch.randn(rows.shape[1], width, generator=generator, dtype=torch.float32).to(centred)
    for _ in range(ROUNDS):
        basis = torch.linalg.qr(centred.T @ (centred @ basis)).Q
    inside = (centred @ basis).double()
    variances, turn = torch.linalg.eigh(inside.T @ inside / len(sample))
    variances, turn = variances.flip(0)[:count], turn.flip(1)[:, :count]
    if not variances[0] > ROUNDING * sample.square().mean():
        raise InputError(f"the {len(rows)} descriptors are all the same; expected a route that changes")
    return mean, basis @ turn.to(basis), variances.float()
