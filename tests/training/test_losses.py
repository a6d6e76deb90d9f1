"""Losses: closed forms, literal loops, gradients also where a feature is constant or a place uncovered."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from fractions import Fraction

import pytest
import reference
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import CompressedMap, Matcher
from dejavu_torch.training.losses import (
    aliased_pairs,
    decorrelation_loss,
    periodicity_loss,
    phase_cross_entropy,
    place_cross_entropy,
    support_loss,
)
from dejavu_torch.types import FrequencyLayer, Plan

INF = math.inf
PLAN: Plan = (
    FrequencyLayer(Fraction(4), 4, 0, 12, (0, 2)),
    FrequencyLayer(Fraction(5, 2), 3, 6, 20, (0, 1, 3)),
)


def normal(*shape: int, grad: bool = False) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, requires_grad=grad)


def close(a: Tensor, b: float | Tensor, atol: float = 1e-12) -> None:
    torch.testing.assert_close(a, torch.as_tensor(b, dtype=a.dtype), rtol=0, atol=atol)


def blocks(grad: bool = False) -> list[Tensor]:
    return [normal(layer.phases, len(layer.features), grad=grad) for layer in PLAN]


# ------------------------------------------------------------------------ places


def share(row: list[float], right: list[int], temperature: float) -> float:
    """-log of what the softmax of -row / T gives to the right ones."""
    weights = [math.exp(-value / temperature) for value in row]
    return -math.log(sum(weights[i] for i in right) / sum(weights))


@given(
    st.integers(1, 9).flatmap(
        lambda n: st.lists(
            st.tuples(
                st.lists(st.one_of(st.floats(0, 3), st.just(INF)), min_size=n, max_size=n),
                st.lists(st.integers(-1, n - 1), min_size=3, max_size=3),
            ),
            min_size=1,
            max_size=5,
        )
    ),
    st.integers(0, 10),
)
def test_the_place_loss_is_the_literal_one(rows: list[tuple[list[float], list[int]]], tolerance: int) -> None:
    losses = []
    for row, places in rows:
        right = [i for i in range(len(row)) if any(p >= 0 and abs(i - p) <= tolerance for p in places)]
        if any(row[i] < INF for i in right):
            losses.append(share(row, right, 0.7))
    scores = torch.tensor([row for row, _ in rows], dtype=torch.float64, requires_grad=True)
    loss, counted, left_out = place_cross_entropy(scores, torch.tensor([p for _, p in rows]), tolerance, 0.7)
    assert (counted, left_out) == (len(losses), len(rows) - len(losses))
    close(loss.detach(), sum(losses) / max(1, len(losses)), 1e-10)
    (gradient,) = torch.autograd.grad(loss, scores)
    assert gradient.isfinite().all()
    assert (gradient[scores.isposinf()] == 0).all()


def test_equal_scores_give_the_logarithm_of_the_share() -> None:
    scores = torch.full((2, 100), 3.0)
    loss, counted, left_out = place_cross_entropy(scores, torch.tensor([[50, -1], [0, 99]]), 5, 0.1)
    close(loss, (math.log(100 / 11) + math.log(100 / 12)) / 2, 1e-6)
    assert (counted, left_out) == (2, 0)


def test_the_place_loss_of_a_batch_is_the_mean_of_its_queries() -> None:
    scores, places = normal(6, 30), torch.randint(0, 30, (6, 2))
    alone = [place_cross_entropy(scores[q, None], places[q, None], 2, 0.5).loss for q in range(6)]
    close(place_cross_entropy(scores, places, 2, 0.5).loss, torch.stack(alone).mean())


def test_gradients_of_the_place_loss_reach_scores_and_temperature() -> None:
    scores, temperature = normal(3, 8, grad=True), torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    places, gap = torch.tensor([[1, 6], [4, -1], [-1, -1]]), torch.arange(8) == 2

    def loss(scores: Tensor, temperature: Tensor) -> Tensor:
        return place_cross_entropy(scores.masked_fill(gap, INF), places, 1, temperature).loss

    assert torch.autograd.gradcheck(loss, (scores, temperature))


@pytest.mark.parametrize("scores", [torch.full((2, 5), INF), torch.rand(2, 5), torch.rand(0, 5)])
def test_where_no_place_counts_the_loss_and_its_gradients_are_0(scores: Tensor) -> None:
    places = torch.full((len(scores), 3), 0 if scores.isinf().any() else -1)
    temperature = torch.tensor(0.5, requires_grad=True)
    scores = scores.clone().requires_grad_()
    loss, counted, left_out = place_cross_entropy(scores, places, 1, temperature)
    loss.backward()
    assert (loss.item(), counted, left_out) == (0, 0, len(scores))
    for leaf in (scores, temperature):
        assert leaf.grad is not None
        assert (leaf.grad == 0).all()


def test_half_scores_are_summed_in_single_precision() -> None:
    scores = torch.rand(4, 3000).half()
    loss = place_cross_entropy(scores, torch.arange(4)[:, None], 0, 0.01).loss
    assert loss.dtype == torch.float32
    close(loss, place_cross_entropy(scores.double(), torch.arange(4)[:, None], 0, 0.01).loss.float(), 1e-3)


def test_the_place_loss_builds_nothing_of_queries_times_places_times_answers(largest_tensor: type) -> None:
    with largest_tensor() as seen:
        place_cross_entropy(torch.rand(16, 500), torch.randint(0, 500, (16, 40)), 5, 0.1)
    assert seen.numel <= 16 * 501


def test_phase_loss_is_the_literal_one() -> None:
    distances = [normal(4, layer.phases).abs() for layer in PLAN]
    places = torch.tensor([[2, 9, 15], [7, 11, -1], [19, -1, -1], [-1, -1, -1]])
    losses = []
    for block, layer in zip(distances, PLAN, strict=True):
        for row, right in zip(block.tolist(), places.tolist(), strict=True):
            phases = {reference.phase(i, layer) for i in right if layer.start <= i < layer.stop}
            losses += [share(row, list(phases), 0.3)] if phases else []
    assert len(losses) == 5
    close(phase_cross_entropy(distances, PLAN, places, 0.3), sum(losses) / 5)


def test_gradients_of_the_phase_loss_and_none_where_nothing_is_covered() -> None:
    temperature = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    distances = [normal(3, layer.phases, grad=True) for layer in PLAN]
    places = torch.tensor([[2, 9], [15, -1], [-1, -1]])
    assert torch.autograd.gradcheck(
        lambda t, *d: phase_cross_entropy(d, PLAN, places, t), (temperature, *distances)
    )
    loss = phase_cross_entropy(distances, PLAN, torch.full((3, 1), 25), temperature)
    assert loss.item() == 0
    assert all((g == 0).all() for g in torch.autograd.grad(loss, [temperature, *distances]))


# ------------------------------------------------------------------- periodicity


def explained(x: list[float], frames: list[int], period: Fraction, cycles: int) -> float:
    """1 - SSE / SST, frame by frame."""
    phases = round(period)
    place = [
        (math.floor(i / period) % cycles, math.floor(i % period * phases / period) % phases) for i in frames
    ]
    pairs = []
    for value, (fold, phase) in zip(x, place, strict=True):
        others = [y for y, (f, p) in zip(x, place, strict=True) if f != fold and p == phase]
        pairs += [(value, sum(others) / len(others))] if others else []
    mean = sum(value for value, _ in pairs) / len(pairs)
    return 1 - sum((a - b) ** 2 for a, b in pairs) / sum((a - mean) ** 2 for a, _ in pairs)


@pytest.mark.parametrize("cycles", [2, 3, 5])
@pytest.mark.parametrize("periods", [[4], [Fraction(7, 2)], [3, Fraction(11, 3)], [2, 5, 9, 19]], ids=str)
def test_periodicity_is_the_literal_one(periods: list[Fraction | int], cycles: int) -> None:
    frames = torch.randperm(70)[:41] + 3
    x = normal(41, 3) + (frames % 4)[:, None]
    expected = []
    for column in x.T.tolist():
        r = [explained(column, frames.tolist(), Fraction(period), cycles) for period in periods]
        expected.append(-0.2 * math.log(sum(math.exp(value / 0.2) for value in r) / len(r)))
    close(periodicity_loss(x, frames, periods, 0.2, cycles), sum(expected) / 3, 1e-10)


def test_periodicity_in_closed_form() -> None:
    frames = torch.arange(60)
    wave = torch.tensor([1.0, -2.0, 4.0])[frames % 3][:, None]
    turned = (1 - 2 * (frames // 3 % 2))[:, None].float()  # what one cycle shows, the next shows upside down
    close(periodicity_loss(wave, frames, [3]), -1.0, 1e-6)
    close(periodicity_loss(turned, frames, [3]), 3.0, 1e-6)  # SSE / SST = 2^2
    close(periodicity_loss(torch.cat([wave, turned], 1), frames, [3]), 1.0, 1e-6)
    close(periodicity_loss(turned, frames, [3, 6]), -0.1 * math.log((math.exp(-30) + math.exp(10)) / 2), 1e-6)


@given(st.floats(0.01, 100), st.floats(-100, 100), st.randoms(use_true_random=False))
def test_scale_offset_and_order_of_frames_do_not_count(scale: float, offset: float, random: object) -> None:
    x, frames = normal(50, 2), torch.arange(50)
    order = list(range(50))
    random.shuffle(order)  # type: ignore[attr-defined]
    expected = periodicity_loss(x, frames, [4, 7])
    close(periodicity_loss((scale * x + offset)[order], frames[order], [4, 7]), expected, 1e-8)


def test_a_group_of_features_has_the_mean_of_their_losses() -> None:
    x, frames = normal(50, 4), torch.arange(50)
    alone = [periodicity_loss(x[:, j, None], frames, [4, 7]) for j in range(4)]
    close(periodicity_loss(x, frames, [4, 7]), torch.stack(alone).mean())


@pytest.mark.parametrize("value", [0.0, 0.3, 1e4])
@pytest.mark.parametrize(
    "loss",
    [
        lambda x, other: periodicity_loss(x, torch.arange(len(x)), [4, 9]),
        lambda x, other: decorrelation_loss([x, other]),
        lambda x, other: decorrelation_loss([other, x]),
    ],
)
def test_a_constant_feature_counts_as_0_with_finite_gradients(
    loss: Callable[[Tensor, Tensor], Tensor], value: float
) -> None:
    """At the singular point itself, where variance and covariance are 0 / 0."""
    x = torch.full((701, 3), value, requires_grad=True)
    result = loss(x, torch.randn(701, 2))
    (gradient,) = torch.autograd.grad(result, x)
    close(result.detach(), 0.0, 1e-7)
    assert (gradient == 0).all()


def test_a_constant_feature_leaves_the_others_theirs() -> None:
    x, frames = normal(50, 2, grad=True), torch.arange(50)
    losses = [
        periodicity_loss(torch.cat([x, torch.full_like(x, 0.3)], 1), frames, [4]),
        periodicity_loss(x, frames, [4]),
    ]
    first, second = (torch.autograd.grad(loss, x)[0] for loss in losses)
    close(2 * first, second)
    assert second.count_nonzero() > 0


def test_half_features_are_compared_in_single_precision() -> None:
    x, frames = torch.randn(50, 4).bfloat16(), torch.arange(50)
    for loss in (lambda x: periodicity_loss(x, frames, [4, 7]), lambda x: decorrelation_loss([x[:, :2], x])):
        assert loss(x).dtype == torch.float32
        close(loss(x), loss(x.float()), 1e-6)


def test_gradients_of_periodicity() -> None:
    x, frames = normal(24, 2, grad=True), torch.randperm(30)[:24]
    assert torch.autograd.gradcheck(lambda x: periodicity_loss(x, frames, [3, Fraction(9, 2)], 0.3, 3), x)


def hidden_wave() -> tuple[Tensor, Tensor]:
    """16 numbers per frame in which a weak wave of period 7 lies under strong correlated noise."""
    frames = torch.arange(700)
    noise = 3 * normal(700, 16) @ normal(16, 16)
    return noise + normal(7)[frames % 7, None] * normal(16), frames


def fisher(x: Tensor, label: Tensor) -> Tensor:
    """Fisher's discriminant: the top generalised eigenvector of between-class against total scatter."""
    x = x - x.mean(0)
    means = torch.stack([x[label == k].mean(0) for k in range(int(label.max()) + 1)])[label]
    whiten = torch.linalg.inv(torch.linalg.cholesky(x.T @ x))
    top: Tensor = torch.linalg.eigh(whiten @ means.T @ means @ whiten.T).eigenvectors[:, -1]
    best: Tensor = whiten.T @ top
    return best


@pytest.mark.parametrize("optimiser", ["lbfgs", "adam"])
def test_training_a_linear_feature_reaches_fishers_discriminant(optimiser: str) -> None:
    x, frames = hidden_wave()
    w = torch.randn(16, dtype=torch.float64, requires_grad=True)

    def loss(w: Tensor) -> Tensor:
        return periodicity_loss(x @ w[:, None], frames, [7])

    def step() -> float:
        optimizer.zero_grad()
        value = loss(w)
        value.backward()
        return value.item()

    optimizer: torch.optim.Optimizer
    if optimiser == "lbfgs":
        optimizer = torch.optim.LBFGS([w], max_iter=100, line_search_fn="strong_wolfe")
        optimizer.step(step)
    else:
        optimizer = torch.optim.Adam([w], lr=0.1)
        for _ in range(400):
            optimizer.step(step)
    best = fisher(x, frames % 7)
    assert all(periodicity_loss(x[:, [j]], frames, [7]) > -0.1 for j in range(16))  # it was hidden
    assert loss(best) < -0.5
    close(loss(w).detach() / loss(best), 1.0, 0.02)
    assert torch.cosine_similarity(w, best, dim=0).abs() > 0.98


# ----------------------------------------------------------------- decorrelation


def test_decorrelation_is_the_mean_squared_correlation_across_layers() -> None:
    groups = [normal(40, features) for features in (2, 3, 1)]
    layer = torch.tensor([0, 0, 1, 1, 1, 2])
    squared = torch.corrcoef(torch.cat(groups, 1).T) ** 2
    close(decorrelation_loss(groups), squared[layer[:, None] != layer].mean())
    close(decorrelation_loss([3 * groups[0] - 7, *groups[1:]]), decorrelation_loss(groups))
    with torch.autocast("cpu", torch.bfloat16):
        close(
            decorrelation_loss([group.float() for group in groups]), decorrelation_loss(groups).float(), 1e-6
        )


def test_copies_and_independent_features() -> None:
    t = 2 * math.pi * torch.arange(60, dtype=torch.float64)[:, None] / 60
    close(decorrelation_loss([t.sin(), -2 * t.sin() + 1]), 1.0)
    close(decorrelation_loss([t.sin(), torch.cat([t.cos(), (2 * t).sin()], 1)]), 0.0)
    close(decorrelation_loss([torch.cat([t.sin(), t.sin()], 1)]), 0.0)  # within a layer nothing counts


def test_gradients_of_decorrelation() -> None:
    assert torch.autograd.gradcheck(lambda *x: decorrelation_loss(x), (normal(9, 2, grad=True), normal(9, 3)))


# ----------------------------------------------------------------------- support


@pytest.mark.parametrize("metric", ["l1", "l2", "cosine"])
def test_support_is_judged_by_the_matchers_scores(metric: str) -> None:
    """Where both layers cover i and j, d_ij is the score of place j for templates of place i."""
    templates = blocks()
    plan = tuple(
        FrequencyLayer(x.period, x.phases, x.start, x.stop, features)
        for x, features in zip(PLAN, ((0, 1), (2, 3, 4)), strict=True)
    )
    route = CompressedMap(plan, templates, 20, 5)
    for i, j in ((6, 11), (7, 10), (8, 8)):
        query = torch.cat(
            [block[layer.phase(torch.tensor([i]))] for block, layer in zip(templates, plan, strict=True)], 1
        )
        d = Matcher(metric)(query, route)[0, j]
        expected = torch.relu(1.5 - d) ** 2 / 1.5**2
        close(support_loss(templates, plan, torch.tensor([[i, j]]), 1.5, metric), expected)


def test_support_is_the_literal_one() -> None:
    templates, penalties = blocks(), []
    pairs = torch.tensor([[0, 5], [7, 10], [3, 15], [13, 19], [6, 11], [2, 25]])
    for i, j in pairs.tolist():
        total, summed = 0.0, 0
        for mu, layer in zip(templates, PLAN, strict=True):
            if layer.start <= min(i, j) and max(i, j) < layer.stop:
                a, b = (mu[reference.phase(place, layer)].tolist() for place in (i, j))
                total += sum(abs(u - v) for u, v in zip(a, b, strict=True))
                summed += len(layer.features)
        if summed:
            penalties.append(max(0.0, 1.5 - total / summed) ** 2 / 1.5**2)
    assert len(penalties) == 4
    close(support_loss(templates, PLAN, pairs, 1.5), sum(penalties) / 4)


def test_gradients_of_support_and_none_where_no_pair_counts() -> None:
    templates, pairs = blocks(grad=True), torch.tensor([[0, 5], [7, 10], [13, 18], [3, 15]])
    assert torch.autograd.gradcheck(lambda *mu: support_loss(mu, PLAN, pairs, 3.0), templates)
    for none in (pairs[3:], pairs[:0]):
        loss = support_loss(templates, PLAN, none, 3.0)
        assert loss.item() == 0
        assert all((g == 0).all() for g in torch.autograd.grad(loss, templates))


def test_aliased_pairs_are_every_pair_beyond_the_tolerance_equally_often() -> None:
    pairs = aliased_pairs(7, 15000, 2, torch.Generator().manual_seed(0))
    counts = Counter(map(tuple, pairs.tolist()))
    assert sorted(counts) == [(i, j) for i in range(7) for j in range(i + 3, 7)]
    assert all(abs(count - 1500) < 200 for count in counts.values())  # 5 standard deviations
    again = aliased_pairs(7, 15000, 2, torch.Generator().manual_seed(0))
    assert torch.equal(pairs, again)


# --------------------------------------------------------------------- bad input

SCORES, PLACES, X, FRAMES = (
    torch.rand(3, 9),
    torch.zeros(3, 2, dtype=torch.int64),
    torch.rand(30, 2),
    torch.arange(30),
)
PAIRS = torch.tensor([[0, 5]])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: place_cross_entropy(SCORES, PLACES[:2], 1, 1.0), ["(3, 9)", "(2, 2)", "(Q,R) int64"]),
        (lambda: place_cross_entropy(SCORES, PLACES.float(), 1, 1.0), ["torch.float32", "int64"]),
        (lambda: place_cross_entropy(SCORES, PLACES + 9, 1, 1.0), ["[9, 9, 9]", "0..8"]),
        (lambda: place_cross_entropy(SCORES, PLACES - 2, 1, 1.0), ["[-2, -2, -2]", "0..8"]),
        (lambda: place_cross_entropy(SCORES, PLACES, -1, 1.0), ["tolerance is -1", "at least 0"]),
        (lambda: place_cross_entropy(SCORES, PLACES, 1, 0.0), ["temperature is 0.0", "above 0"]),
        (lambda: place_cross_entropy(SCORES, PLACES, 1, torch.tensor(math.nan)), ["temperature is nan"]),
        (lambda: phase_cross_entropy([], (), PLACES, 1.0), ["distances are []", "at least one layer"]),
        (lambda: phase_cross_entropy([SCORES], PLAN, PLACES, 1.0), ["[(3, 9)]", "[(3, 4), (3, 3)]"]),
        (lambda: phase_cross_entropy([SCORES[:, :4], SCORES[:, :3]], PLAN, PLACES, -1.0), ["is -1.0"]),
        (lambda: periodicity_loss(X, FRAMES[1:], [3]), ["(30, 2)", "(29,)", "(n,F) and (n,)"]),
        (lambda: periodicity_loss(X, FRAMES.float(), [3]), ["torch.float32", "int64"]),
        (lambda: periodicity_loss(X, FRAMES, []), ["periods []", "periods >= 2"]),
        (lambda: periodicity_loss(X, FRAMES, [Fraction(3, 2)]), ["periods ['3/2']", "periods >= 2"]),
        (lambda: periodicity_loss(X, FRAMES, [3], 0.0), ["temperature 0.0", "T > 0"]),
        (lambda: periodicity_loss(X, FRAMES, [3], 0.1, 1), ["1 cycles", "at least 2 cycles"]),
        (lambda: decorrelation_loss([]), ["no layers", "(n,F)"]),
        (lambda: decorrelation_loss([X, X[1:]]), ["(30, 2), (29, 2)", "same n"]),
        (lambda: support_loss([X], PLAN, PAIRS, 1.0), ["templates are [(30, 2)]", "[(4, 2), (3, 3)]"]),
        (lambda: support_loss(blocks(), PLAN, PAIRS[0], 1.0), ["(2,)", "(M,2) int64"]),
        (lambda: support_loss(blocks(), PLAN, PAIRS, 0.0), ["margin 0.0", "margin > 0"]),
        (lambda: support_loss(blocks(), PLAN, PAIRS, 1.0, "l7"), ["'l7'"]),
        (lambda: aliased_pairs(6, 3, 5), ["6 places", "tolerance 5", "tolerance + 2 places"]),
        (lambda: aliased_pairs(6, -3, 5), ["count -3", "none below 0"]),
        (lambda: aliased_pairs(6, 3, -5), ["tolerance -5", "none below 0"]),
    ],
)
def test_bad_input_is_refused(call: Callable[[], object], words: list[str]) -> None:
    with refused(*words):
        call()


def test_periodicity_takes_the_phases_of_a_layer() -> None:
    frames = torch.arange(100)
    stairs = torch.tensor([3.0, 1.0, 4.0, 1.5, 9.0])[frames // 5 % 5][:, None]  # bins of 5 frames
    some = torch.randperm(100)[:60]
    by_bin = periodicity_loss(stairs[some], some, [25], phases=[5])
    assert by_bin.item() == pytest.approx(-1, abs=1e-6)
    assert periodicity_loss(stairs, frames, [25], phases=[5]) < periodicity_loss(stairs, frames, [20]) - 0.5
    with pytest.raises(ValueError, match="zip"):
        periodicity_loss(stairs, frames, [25, 30], phases=[5])
