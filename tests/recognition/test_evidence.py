"""What scores say of places by their rank, and how alike consecutive queries are."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.evidence import (
    Presence,
    RankTable,
    correlation_time,
    place_means,
    presence_of,
    repeats,
    spacing_of,
    speaking,
    standardised,
    unchanged,
)


def noise(rows, columns, seed=0):
    return torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed))


def remembering(rows, columns, share):
    """Queries that keep a share of the one before: their autocorrelation at lag k is share^k."""
    queries = noise(rows, columns)
    for t in range(1, rows):
        queries[t] = share * queries[t - 1] + math.sqrt(1 - share**2) * queries[t]
    return queries


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8, -0.5])
def test_queries_that_remember_say_as_much_as_fewer(share):
    """1 + 2 sum share^k up to the first lag below .05; (1 + share) / (1 - share) if it goes on."""
    lags = [share**k for k in range(1, 100) if min(share**j for j in range(1, k + 1)) >= 0.05]
    assert correlation_time(remembering(4000, 50, share)) == pytest.approx(1 + 2 * sum(lags), rel=0.05)
    if share > 0:
        assert 1 + 2 * sum(lags) == pytest.approx((1 + share) / (1 - share), rel=0.12)


def test_what_returns_makes_no_neighbours_alike():
    returning = torch.tensor([[1.0], [-0.5], [-0.5]]).repeat(1000, 1) * math.sqrt(2)  # every third query
    slow = remembering(3000, 1, 0.9)
    queries = torch.cat([slow / slow.std(), returning], 1)
    lags = [(0.9**k + (1 if k % 3 == 0 else -0.5)) / 2 for k in range(1, 4)]
    assert lags[2] > lags[1] > 0.05
    assert correlation_time(queries, monotone=True) == pytest.approx(1 + 2 * sum(lags[:2]), abs=0.15)
    assert correlation_time(queries) > 1 + 2 * sum(lags)


@given(st.integers(0, 9), st.integers(1, 30), st.booleans())
def test_the_correlation_time_is_a_sum_over_pairs(seed, rows, monotone):
    queries = noise(rows, 3, seed).cumsum(0)
    centred = (queries - queries.mean(0)).double()
    lags = [float((centred[k:] * centred[: rows - k]).sum() / (rows - k)) for k in range(rows)]
    total, k = 1.0, 1
    while (
        k < rows and lags[k] / lags[0] >= 0.05 and not (monotone and lags[k] > max(lags[max(0, k - 2) : k]))
    ):
        total, k = total + 2 * lags[k] / lags[0], k + 1
    if k < rows:
        assert correlation_time(queries, monotone) == pytest.approx(total)
    assert correlation_time(queries.repeat(3, 1)[:1]) == 1
    assert correlation_time(torch.ones(rows, 3)) == 1


def test_a_stop_counts_once():
    """30 repeats of the fifth query with little noise, and one frame that is nearly there twice."""
    moving = noise(40, 8)
    queries = torch.cat([moving[:5], moving[4:5] + 0.001 * noise(30, 8, 1), moving[5:], moving[-1:] + 0.001])
    stop = torch.zeros(71, dtype=torch.bool)
    stop[5:35] = True
    last = torch.arange(71) == 70
    spacing = spacing_of(queries)
    assert torch.equal(unchanged(queries), stop | last)
    assert torch.equal(spacing.stopped, stop)
    assert torch.allclose(spacing.weight[4:35], torch.tensor(1 / 31))
    assert torch.allclose(spacing.weight[69:], torch.tensor(0.5))
    assert (spacing.weight[:4] == 1).all()
    assert (spacing.weight[35:69] == 1).all()
    alone = spacing_of(moving)
    assert spacing.correlation == alone.correlation
    assert spacing_of(queries.half()).correlation == pytest.approx(alone.correlation, rel=0.01)


def test_a_picture_that_repeats_is_stale_and_says_nothing():
    moving = noise(60, 8)
    at = torch.tensor([*range(20), *[19] * 25, *range(20, 60), 59])
    spacing, alone = spacing_of(moving[at]), spacing_of(moving)
    assert spacing.stale.tolist() == [*[0] * 20, *range(1, 26), *[0] * 40, 1]
    assert spacing.weight.tolist() == (spacing.stale == 0).tolist()
    assert not spacing.stopped.any()
    assert spacing.correlation == alone.correlation
    assert repeats(moving[at][30:32], moving[19]).tolist() == [1, 2]
    assert repeats(moving[:0], moving[0]).tolist() == []
    assert repeats(moving[:1], 0 * moving[0]).tolist() == [0]


@given(st.integers(0, 99), st.sampled_from([0.1, 1.0, 50.0]))
def test_presence_is_that_of_its_densities(seed, scale):
    draw = torch.Generator().manual_seed(seed)
    near, far = torch.randn(400, generator=draw), torch.randn(300, generator=draw)
    near, far = scale * (1 + 0.2 * near), scale * (3 + 0.1 * far)
    found = presence_of(torch.cat([near, far[:100]]), far)
    assert found is not None
    assert abs(found.on / scale - 1) < 0.1  # though a fifth of them are off the map
    assert 0.1 < found.wide / scale < 0.35
    assert (found.off, found.spread) == pytest.approx((float(far.mean()), float(far.std())))
    best = scale * torch.linspace(-1, 5, 40)
    told = found.absent(best)
    for x, value in zip(best.double().clamp(found.on, found.off).tolist(), told.tolist(), strict=True):
        alike, z = 2 * (x - found.on) / (found.off - found.on) ** 2, (x - found.off) / found.spread
        off = (alike + math.exp(-z * z / 2) / found.spread / math.sqrt(2 * math.pi)) / 2
        t = (x - found.on) / found.wide
        on = 8 / (3 * math.pi * math.sqrt(5)) * (1 + t * t / 5) ** -3 / found.wide  # five degrees of freedom
        assert value == pytest.approx(min(5, max(-1, math.log(max(off, 1e-30) / on))), abs=1e-3)
    assert (told[1:] >= told[:-1] - 1e-4).all()
    assert found.absent(torch.tensor([math.nan])) == 0


@given(st.integers(0, 99), st.sampled_from([torch.float32, torch.float64]))
def test_presence_is_written_out_as_torchs_distributions(seed, dtype):
    draw = torch.Generator().manual_seed(seed)
    on, wide, apart, spread = (torch.rand(4, generator=draw) + 0.05).tolist()
    off = on + apart
    best = torch.linspace(on - 0.2, off + 0.2, 50, dtype=dtype)
    x = best.clamp(on, off)
    null = torch.distributions.Normal(off, spread).log_prob(x).exp()
    odds = (2 * (x - on) / (off - on) ** 2 + null) / 2
    expected = odds.clamp(min=1e-30).log() - torch.distributions.StudentT(chosen.TAIL, on, wide).log_prob(x)
    told = Presence(on, wide, off, spread).absent(best)
    assert told.dtype == dtype
    torch.testing.assert_close(
        told, expected.clamp(-chosen.MOST_PRESENT, chosen.MOST_ABSENT), rtol=0, atol=2e-5
    )
    each = Presence(torch.full((50,), on, dtype=dtype), torch.full((50,), wide, dtype=dtype), off, spread)
    torch.testing.assert_close(each.absent(best), told)


@pytest.mark.parametrize(
    "best", [torch.ones(9), torch.zeros(0), torch.full((9,), math.inf), torch.full((9,), 3.0)]
)
def test_queries_that_come_no_nearer_have_no_presence(best):
    assert presence_of(best, torch.ones(20)) is None
    assert presence_of(best, torch.zeros(0)) is None


def test_a_slow_drift_is_no_stop():
    """Each query is near the one before it, but not near the first of the stop."""
    turn = torch.linspace(0, 4, 200)
    drift = F.pad(20 * torch.stack([turn.cos(), turn.sin()], 1), (0, 62))
    queries = torch.cat([3 * noise(300, 64), drift])
    assert int(unchanged(queries)[300:].sum()) > 90
    assert spacing_of(queries).weight.min() > 0.19
    assert not spacing_of(queries).stopped.any()


@pytest.mark.parametrize("queries", [torch.zeros(0, 3), torch.zeros(1, 3), torch.zeros(4, 3), noise(2, 3)])
def test_few_queries_and_equal_ones_have_a_spacing(queries):
    spacing = spacing_of(queries)
    same = len(queries) == 4
    assert spacing.weight.tolist() == [0.25 if same else 1] * len(queries)
    assert spacing.correlation == 1
    assert not spacing.stopped.any()


def z_of(scores):
    return standardised(scores, place_means(scores, scores.new_ones(len(scores)))).z


@given(st.integers(0, 99), st.sampled_from([0.01, 3.0, 1000.0]))
def test_a_score_counts_beside_those_of_its_query_and_of_its_place(seed, scale):
    scores = noise(6, 9, seed).double()
    z = z_of(scores)
    query, place = noise(6, 1, seed + 1).double(), noise(1, 9, seed + 2).double()
    assert torch.allclose(z, z_of(scale * scores + query + place))
    assert torch.allclose(z.mean(1), torch.zeros(6, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(z.square().mean(1), torch.ones(6, dtype=torch.float64))
    double = scores - scores.mean(0)
    double = double - double.mean(1, keepdim=True)
    assert torch.allclose(z, -double / double.square().mean(1, keepdim=True).sqrt())


def test_queries_that_say_nothing_change_nothing():
    scores = noise(6, 9).double()
    silent = torch.stack([torch.full((9,), 2.0), torch.full((9,), math.inf), torch.full((9,), math.nan)])
    silent = torch.cat([silent, torch.where(torch.arange(9) == 4, math.nan, scores[:1])])
    one = torch.cat([torch.full((8,), math.inf), torch.zeros(1)])[None].double()  # no place to compare with
    mixed = torch.cat([scores[:3], silent, one, scores[3:]])
    weight = torch.ones(11, dtype=torch.float64)
    speaks = [True] * 3 + [False] * 5 + [True] * 3
    assert speaking(mixed).tolist() == speaks
    assert torch.allclose(place_means(mixed, weight), place_means(scores, weight[:6]))
    found = standardised(mixed, place_means(mixed, weight))
    assert found.speaks.tolist() == speaks
    assert torch.allclose(found.z[speaks], z_of(scores))
    assert found.z.isfinite().all()


def test_places_that_nothing_covers_are_left_out():
    scores = noise(6, 9)
    holes = scores.clone()
    holes[:, 4] = math.inf
    found = standardised(holes, place_means(holes, torch.ones(6)))
    kept = [0, 1, 2, 3, 5, 6, 7, 8]
    assert torch.allclose(found.z[:, kept], z_of(scores[:, kept]), atol=1e-6)
    assert not found.valid[:, 4].any()
    assert found.valid[:, kept].all()


def test_means_are_weighted_and_a_single_query_keeps_its_scores():
    scores, weight = noise(5, 4), torch.tensor([1.0, 0.25, 0.5, 1, 1])
    assert torch.allclose(place_means(scores, weight), (weight @ scores) / weight.sum())
    assert (place_means(scores[:1], weight[:1]) == 0).all()


def table_of(z, weight=None):
    table = RankTable()
    for part in torch.arange(len(z)).split(7):
        table.add(z[part], torch.ones_like(z[part]) if weight is None else weight[part])
    return table


def test_ranks_are_exact_at_the_edges_of_bins():
    """x = -Phi^-1((n + 1/2) / (N + 1)) for the n of N values that reach a z."""
    z, weight = noise(500, 4) * 2 + 1, torch.rand(500, 4)
    edges = torch.arange(-100, 300) / 64
    reached = ((z >= edges[:, None, None]) * weight.double()).sum((1, 2))
    expected = -torch.special.ndtri((reached + 0.5) / (weight.double().sum() + 1))
    found = RankTable.look_up(table_of(z, weight).values, edges)
    assert torch.allclose(found.double(), expected, atol=1e-5)


def test_normal_scores_of_gaussian_noise_are_itself():
    z = noise(1000, 1000)
    at = torch.linspace(-3, 3, 50)
    assert torch.allclose(RankTable.look_up(table_of(z).values, at), at, atol=0.03)


def test_normal_scores_rise_with_z_and_their_slope_is_the_gradient():
    values = table_of(noise(300, 3)).values
    assert (values.diff() >= 0).all()
    z = torch.linspace(-12, 50, 1001, dtype=torch.float64)  # beyond the table as well
    x = RankTable.look_up(values, z)
    assert x.isfinite().all()
    assert (x.diff() >= 0).all()
    inside = (torch.arange(-190, 190) / 64 + 0.004).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda z: RankTable.look_up(values, z), (inside,))
    (slope,) = torch.autograd.grad(RankTable.look_up(values, inside).sum(), inside)
    assert slope.max() > 0.5


def test_values_of_no_weight_are_not_counted():
    z = noise(200, 3)
    weight = (torch.arange(600).view(200, 3) % 2).float()
    assert torch.equal(table_of(z, weight).values, table_of(z[weight > 0][:, None]).values)


def test_a_place_is_a_hole_for_queries_that_do_not_see_it():
    scores = torch.tensor([[1.0, 2, math.inf], [2, 1, math.inf], [1, 3, 0.5]])
    std = standardised(scores, torch.tensor([1.0, 2, math.inf]))
    assert std.holes is not None
    assert std.holes.tolist() == [[False] * 2 + [True]] * 2 + [[False] * 3]
    assert std.z.isfinite().all()
    assert torch.equal(std.z[2:], standardised(scores[2:], torch.tensor([1.0, 2, 0])).z)
    assert standardised(scores, torch.ones(3)).holes is None
