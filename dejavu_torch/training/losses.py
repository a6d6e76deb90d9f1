"""To find the place, to repeat, to tell places apart: scalars in float32 at least, 0 where nothing counts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.database.distance import Metric, phase_distances
from dejavu_torch.database.template_map import weight_per_feature
from dejavu_torch.types import FrequencyLayer, InputError, Plan


class PlaceLoss(NamedTuple):
    """loss: scalar. counted: queries it is the mean of. left_out: queries without a right answer."""

    loss: Tensor
    counted: int
    left_out: int


def place_cross_entropy(
    scores: Tensor, places: Tensor, tolerance: int, temperature: Tensor | float
) -> PlaceLoss:
    """Mean over queries of -log sum_{i right} p_i, where p = softmax(-S / T) over all places (S of eq. 4).

    Args:
        scores: S, lower is better, +inf where no layer covers the place: p = 0 there.
        places: the right places of each query, -1 as padding.
        tolerance: places within so many of a right one, inclusive, are right as well.
        temperature: T > 0, in units of the scores; may be learnt.

    Shape: (Q,N), (Q,R) int64 -> PlaceLoss.

    Convention: a query of which no right place is covered is left out.

    Raises:
        InputError: shapes that do not fit, places outside the N, a tolerance < 0 or temperature <= 0.

    Example:
        >>> scores = torch.tensor([[0.0, 0.0, 0.0, torch.inf]])
        >>> place_cross_entropy(scores, torch.tensor([[0]]), 1, 0.5)  # two of three equal places are right
        PlaceLoss(loss=tensor(0.4055), counted=1, left_out=0)
    """
    _check_places(places, scores)
    queries, n = scores.shape
    outside = places[(places < -1) | (places >= n)].tolist()
    if tolerance < 0 or outside:
        seen = f"the tolerance is {tolerance} and places outside the route are {outside[:3]}"
        raise InputError(f"{seen}; expected at least 0, and places in 0..{n - 1} or -1")
    # +1 where a right stretch begins, -1 behind its end: no Q x N x R
    known = (places >= 0).int()
    steps = known.new_zeros(queries, n + 1)
    steps.scatter_add_(1, (places - tolerance).clamp(min=0), known)
    steps.scatter_add_(1, (places + tolerance + 1).clamp(max=n), -known)
    missed = _missed(scores, steps.cumsum(1)[:, :n] > 0, temperature)
    return PlaceLoss(missed.sum() / max(1, len(missed)), len(missed), queries - len(missed))


def phase_cross_entropy(
    distances: Sequence[Tensor], plan: Plan, places: Tensor, temperature: Tensor | float
) -> Tensor:
    """Mean over layers and queries of -log sum_{k right} p_k, p = softmax(-d / T) over the layer's phases.

    Args:
        distances: d of each layer, as `phase_distances` gives them.
        places: the right places of each query, -1 as padding; their phases in the layer are right.
        temperature: T > 0, in units of the distances; may be learnt.

    Shape: L tensors (Q,P), (Q,R) int64 -> scalar.

    Convention: a query counts once for each layer that covers a right place of it, all with equal weight.

    Raises:
        InputError: no layers, shapes that do not fit the plan, a temperature <= 0.

    Example:
        >>> plan = (FrequencyLayer(2, 2, 0, 10, (0,)),)
        >>> phase_cross_entropy([torch.tensor([[3.0, 3.0]])], plan, torch.tensor([[5]]), 1.0)
        tensor(0.6931)
    """
    _check_blocks("distances", distances, [(len(places), layer.phases) for layer in plan])
    missed = []
    for block, layer in zip(distances, plan, strict=True):
        _check_places(places, block)
        covered = (places >= layer.start) & (places < layer.stop)
        hits = torch.zeros(block.shape, dtype=torch.int32, device=block.device)
        hits.scatter_add_(1, layer.phase(places), covered.int())
        missed.append(_missed(block, hits > 0, temperature))
    every = torch.cat(missed)
    return every.sum() / max(1, len(every))


def periodicity_loss(
    features: Tensor,
    frames: Tensor,
    periods: Sequence[Fraction | int],
    temperature: float = 0.1,
    cycles: int = 2,
    phases: Sequence[int] | None = None,
) -> Tensor:
    """Mean over features of -T log mean_tau exp(r / T), where r = 1 - SSE / SST on cycles held out.

    Frame i is in fold floor(i / tau) mod `cycles`. SSE sums the squared differences between the frames and
    the mean of their phase over the *other* folds, SST those between the same frames and their own mean. So
    -1 is a feature that repeats exactly (T -> 0), and 0 or more one that does not repeat.

    Args:
        features: of the frames, in any order and with gaps.
        frames: index of each along the route.
        periods: candidates tau >= 2, in frames. phases: of each; None is round(tau).
        temperature: T > 0; the smaller, the more each feature keeps to its best period.
        cycles: number of folds, at least 2.

    Shape: (n,F), (n,) int64 -> scalar.

    Convention: frames whose phase no other fold holds do not count. Scale and offset of a feature do not
        count either; a constant one has r = 0 and zero gradients, as have all where no frame counts. With
        one period a linear feature has its optimum in closed form, a generalised eigenvector. Periods are
        exact numbers and get no gradient.

    Raises:
        InputError: shapes or numbers that do not fit.

    Example:
        >>> periodicity_loss(torch.tensor([1.0, 5.0, 3.0]).repeat(4)[:, None], torch.arange(12), [3])
        tensor(-1.)
    """
    if features.ndim != 2 or frames.shape != features.shape[:1] or frames.dtype != torch.int64:
        seen = f"features {tuple(features.shape)} and frames {tuple(frames.shape)} {frames.dtype}"
        raise InputError(f"periodicity_loss got {seen}; expected (n,F) and (n,) int64")
    if not periods or min(periods) < 2 or not temperature > 0 or cycles < 2:
        seen = f"periods {[str(period) for period in periods]}, temperature {temperature}, {cycles} cycles"
        raise InputError(f"periodicity_loss got {seen}; expected periods >= 2, T > 0, at least 2 cycles")
    pairs = zip(periods, phases or [round(period) for period in periods], strict=True)
    r = torch.stack([_explained(features, frames, Fraction(tau), count, cycles) for tau, count in pairs])
    return temperature * (math.log(len(periods)) - (r / temperature).logsumexp(0)).mean()


def decorrelation_loss(groups: Sequence[Tensor]) -> Tensor:
    """Mean of the squared correlations between features of different layers: 0 independent, 1 copies.

    Args:
        groups: the features of each layer, over the same frames.

    Shape: L tensors (n,F) -> scalar.

    Convention: a constant feature correlates with nothing and gets zero gradients. Layers that share their
        features are copies of each other; `ImposedPeriods(separate=True)` gives each its own.

    Raises:
        InputError: no layers, or shapes that do not fit.

    Example:
        >>> wave = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]])
        >>> decorrelation_loss([wave, 5 - 2 * wave]), decorrelation_loss([wave, wave.sort(0).values])
        (tensor(1.), tensor(0.))
    """
    if not groups or any(group.ndim != 2 or len(group) != len(groups[0]) for group in groups):
        seen = ", ".join(str(tuple(group.shape)) for group in groups) or "no layers"
        raise InputError(f"decorrelation_loss got {seen}; expected (n,F) of the same n for each layer")
    units = []
    for group in groups:
        values, scatter, constant = _centred(group)
        units.append((values / scatter.masked_fill(constant, 1).sqrt()).masked_fill(constant, 0))
    total, count = 0 * units[0].sum(), 0
    with torch.autocast(units[0].device.type, enabled=False):
        for a, b in combinations(units, 2):
            total = total + (a.T @ b).square().sum()
            count += a.shape[1] * b.shape[1]
    return total / max(1, count)


def support_loss(
    templates: Sequence[Tensor], plan: Plan, pairs: Tensor, margin: float, metric: Metric = "l1"
) -> Tensor:
    """Mean over pairs of places of (relu(margin - d_ij) / margin)^2: no two should have alike templates.

    d_ij = sum_l |mu_l(phase of i) - mu_l(phase of j)| / features summed over, l over the layers that cover
    both: the score that `combine_layers` gives place j where the query shows the templates of place i.

    Args:
        templates: mu of each layer.
        pairs: places i and j, as `aliased_pairs` draws them.
        margin: > 0, in units of a feature.
        metric: see `phase_distances`.

    Shape: L tensors (P,F), (M,2) int64 -> scalar.

    Convention: a pair that no layer covers both of is left out.

    Raises:
        InputError: no layers, shapes that do not fit the plan, a margin <= 0, an unknown metric.

    Example:
        >>> plan = (FrequencyLayer(2, 2, 0, 9, (0,)),)
        >>> support_loss([torch.tensor([[0.0], [3.0]])], plan, torch.tensor([[0, 5], [0, 8]]), 4.0)
        tensor(0.5312)
    """
    _check_blocks("templates", templates, [(layer.phases, len(layer.features)) for layer in plan])
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype != torch.int64 or not margin > 0:
        seen = f"pairs {tuple(pairs.shape)} {pairs.dtype} and margin {margin}"
        raise InputError(f"support_loss got {seen}; expected (M,2) int64 and a margin > 0")
    total, weight = [], []
    for block, layer in zip(templates, plan, strict=True):
        both = ((pairs >= layer.start) & (pairs < layer.stop)).all(1)
        distances = phase_distances(block, block, metric)[layer.phase(pairs[:, 0]), layer.phase(pairs[:, 1])]
        total.append(distances * both)
        weight.append(both.to(distances.dtype) * weight_per_feature(metric, len(layer.features)))
    summed, weights = torch.stack(total).sum(0), torch.stack(weight).sum(0)
    d = summed[weights > 0] / weights[weights > 0]
    return (1 - d / margin).relu().square().sum() / max(1, len(d))


def aliased_pairs(
    places: int, count: int, tolerance: int, generator: torch.Generator | None = None
) -> Tensor:
    """Random pairs of places further apart than the tolerance, every such pair equally likely.

    Args:
        places: N. count: M. tolerance: in places. generator: None is the default one.

    Shape: -> (M,2) int64 on the generator's device, the lower place first.

    Raises:
        InputError: a route too short for such a pair, a count or tolerance < 0.

    Example:
        >>> aliased_pairs(7, 1, 5)
        tensor([[0, 6]])
    """
    free = places - tolerance
    if free < 2 or count < 0 or tolerance < 0:
        seen = f"{places} places, count {count} and tolerance {tolerance}"
        raise InputError(f"aliased_pairs got {seen}; expected none below 0, and tolerance + 2 places or more")
    # any two of the first N - tolerance places, the upper one then moved up by the tolerance
    device = None if generator is None else generator.device
    one = torch.randint(free, (count,), generator=generator, device=device)
    other = torch.randint(free - 1, (count,), generator=generator, device=device)
    other = other + (other >= one)
    return torch.stack([torch.minimum(one, other), torch.maximum(one, other) + tolerance], 1)


def _missed(scores: Tensor, right: Tensor, temperature: Tensor | float) -> Tensor:
    """-log of the softmax's share of what is right, for the rows that have it. (Q,K), (Q,K) -> (counted,)."""
    smallest = torch.as_tensor(temperature).min().item()
    if not smallest > 0:
        raise InputError(f"the temperature is {smallest}; expected a number above 0")
    covered = ~scores.isposinf()
    right = right & covered
    kept = right.any(1)
    # +inf is taken out ahead of the division: inf times a gradient of 0 is NaN
    scores = scores.to(torch.promote_types(scores.dtype, torch.float32)).masked_fill(~covered, 0)
    logits = (-scores / temperature).masked_fill(~covered, -math.inf)[kept]
    return logits.logsumexp(1) - logits.masked_fill(~right[kept], -math.inf).logsumexp(1)


def _centred(features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Features less their mean, their scatter, whether that is mere rounding. (n,F) -> (n,F), (F,), (F,)."""
    features = features.to(torch.promote_types(features.dtype, torch.float32))
    values = features - features.mean(0)
    scatter = values.square().sum(0)
    rounding = (16 * torch.finfo(values.dtype).eps) ** 2
    return values, scatter, scatter <= rounding * features.square().sum(0)


def _explained(features: Tensor, frames: Tensor, period: Fraction, phases: int, cycles: int) -> Tensor:
    """r of each feature for one period. (n,F), (n,) -> (F,)."""
    layer = FrequencyLayer(period, phases, 0, 1, (0,))
    fold = (frames * period.denominator // period.numerator).remainder(cycles)
    cell = fold * layer.phases + layer.phase(frames)
    count = cell.bincount(minlength=cycles * layer.phases).view(cycles, -1)
    others = (count.sum(0) - count).flatten()[cell]
    seen = others > 0
    if not bool(seen.any()):
        return 0 * features.sum(0)
    values, scatter, constant = _centred(features[seen])
    total = values.new_zeros(count.numel(), values.shape[1]).index_add(0, cell[seen], values)
    total = total.view(*count.shape, -1)
    means = (total.sum(0) - total).flatten(0, 1)[cell[seen]] / others[seen][:, None]
    missed = (values - means).square().sum(0) / scatter.masked_fill(constant, 1)
    return (1 - missed).masked_fill(constant, 0)


def _check_places(places: Tensor, scores: Tensor) -> None:
    if scores.ndim != 2 or places.ndim != 2 or len(places) != len(scores) or places.dtype != torch.int64:
        seen = f"scores {tuple(scores.shape)} and places {tuple(places.shape)} {places.dtype}"
        raise InputError(f"the loss got {seen}; expected (Q,N) and (Q,R) int64")


def _check_blocks(name: str, blocks: Sequence[Tensor], expected: list[tuple[int, int]]) -> None:
    shapes = [tuple(block.shape) for block in blocks]
    if not shapes or shapes != expected:
        raise InputError(f"the {name} are {shapes}; expected at least one layer, of the plan's {expected}")
