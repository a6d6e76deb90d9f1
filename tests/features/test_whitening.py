"""Learned whitening in closed form."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from reference import joined_rows

from dejavu_torch import DejaVu, PlaceSmoother
from dejavu_torch.features.embedding import Coder
from dejavu_torch.features.whitening import (
    Whitening,
    learned_whitening,
    oracle_shrinkage,
    principal_components,
)


def pairs(n=200, k=6, seed=0):
    """Views and their places: the first numbers change most, the last ones tell most of the place."""
    random = torch.Generator().manual_seed(seed)
    places = torch.randn(n, k, generator=random) * torch.linspace(0.5, 3, k)
    return places + torch.randn(n, k, generator=random) * torch.linspace(3, 0.5, k), places


@given(st.integers(0, 99), st.integers(1, 6), st.sampled_from([0.03, 0.5, 1.0]))
def test_changes_are_alike_in_all_directions(seed, kept, shrinkage):
    views, places = pairs(seed=seed)
    mean, projection = learned_whitening(views, places, kept, shrinkage)
    change = (views - places).double() / 2
    within = change.T @ change / len(change)
    shrunk = (1 - shrinkage) * within + shrinkage * within.diagonal().mean() * torch.eye(6)
    p = projection.double()
    torch.testing.assert_close(p.T @ shrunk @ p, torch.eye(kept).double(), rtol=0, atol=1e-5)
    middle = (views + places).double() / 2 - mean
    between = p.T @ middle.T @ middle @ p
    torch.testing.assert_close(between, between.diagonal().diag(), rtol=0, atol=1e-3 * between.max().item())
    assert (between.diagonal().diff() <= 0).all()


def test_in_closed_form_where_the_numbers_are_independent():
    """Four pairs: the change has variances 16 and 1, the places 0 and 9, so the second direction is kept."""
    views = torch.tensor([[4.0, 4.0], [-4.0, 4.0], [4.0, -4.0], [-4.0, -4.0]])
    places = torch.tensor([[-4.0, 2.0], [4.0, 2.0], [-4.0, -2.0], [4.0, -2.0]])
    mean, projection = learned_whitening(views, places, 1)
    assert mean.tolist() == [0, 0]
    expected = 1 / math.sqrt((1 + (16 + 1) / 2) / 2)
    torch.testing.assert_close(projection.abs(), torch.tensor([[0.0], [expected]]), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("views", "places", "facts"),
    [
        (torch.ones(3, 2), torch.ones(3, 2), ("of 3 views", "is 0;", "augmentation")),
        (torch.zeros(0, 2), torch.zeros(0, 2), ("of 0 views", "above rounding")),
        (torch.full((3, 2), math.nan), torch.ones(3, 2), ("is nan", "expected a finite one")),
        (torch.ones(3, 2) + 1e-6, torch.ones(3, 2), ("is 2", "above rounding")),
    ],
)
def test_what_cannot_be_whitened(views, places, facts):
    coder = Coder(2, 3, hidden=4)
    with refused(*facts):
        coder.whiten(views, places)
    assert not coder.whitened
    assert torch.equal(coder.projection, torch.eye(2))


def test_shrinkage_in_closed_form():
    """Two numbers of variance 3 and 1: tr(S^2) = 10, tr^2(S) = 16, so 16 / (n (10 - 8))."""
    for samples in (10, 100):
        assert oracle_shrinkage(torch.diag(torch.tensor([3.0, 1.0])), samples) == pytest.approx(8 / samples)
    assert oracle_shrinkage(torch.eye(4), 1000) == 1
    assert oracle_shrinkage(torch.diag(torch.tensor([3.0, 1.0])), 2) == 1


@pytest.mark.parametrize(("count", "alike"), [(40, False), (4000, True)])
def test_few_views_shrink_more_than_many(count, alike):
    views, places = pairs(count, 20)
    own, fixed = (learned_whitening(views, places, 20, shrinkage)[1] for shrinkage in (None, 0.03))
    assert torch.equal(own, fixed) == alike


# the module -------------------------------------------------------------------------------------------


def route(places=600, features=40, rank=12):
    """Descriptors of a route and of another visit, whose light adds far more than places differ by."""
    random = torch.Generator().manual_seed(0)
    basis = torch.randn(rank, features, generator=random)
    own = torch.randn(places, rank, generator=random)
    light = 6 * torch.randn(places, 2, generator=random) @ torch.randn(2, features, generator=random)
    return own @ basis + 3, own @ basis + 3 + light


PLACES, VIEWS = route()


def learned(places=PLACES, views=VIEWS, **settings):
    whitening = Whitening(**settings)
    whitening.learn(places, None if views is None else [(views, torch.arange(len(views)))])
    return whitening


def found(whitening, views, places):
    similar = whitening(views) @ whitening(places).T
    return float((similar.argmax(1) == torch.arange(len(places))).float().mean())


@pytest.mark.parametrize("bits", [4, 8, 16])
def test_what_changes_between_visits_is_whitened_away(bits):
    plain, whitening = learned(views=None, bits=bits), Whitening(numbers=10, bits=bits)
    batches = [(VIEWS[:100], torch.arange(100)), (VIEWS[100:300], torch.arange(100, 300))]
    whitening.learn(PLACES[:300], batches)
    assert found(whitening, VIEWS[300:], PLACES[300:]) > 0.95 > 0.5 > found(plain, VIEWS[300:], PLACES[300:])
    torch.testing.assert_close(whitening(VIEWS).norm(dim=1), torch.ones(600))
    assert whitening.projection.nbytes == 40 * 10 * bits // 8


def test_numbers_of_four_bits_come_back_from_their_bytes():
    for numbers in (1, 2, 7, 10):
        whole = torch.randint(-7, 8, (30, numbers), generator=torch.Generator().manual_seed(numbers))
        projection = whole * torch.linspace(0.5, 2, numbers)  # each column holds its largest number
        projection[0] = 7 * torch.linspace(0.5, 2, numbers)
        whole[0] = 7
        whitening = Whitening(bits=4)
        whitening.take(torch.zeros(30), projection, None)
        assert torch.equal(whitening.unpacked, whole.to(torch.int8))
        torch.testing.assert_close(whitening.scale, torch.linspace(0.5, 2, numbers))
        assert whitening.projection.nbytes == 30 * math.ceil(numbers / 2)


def test_without_views_components_keep_their_variances():
    described = learned(views=None, bits=16)(PLACES)
    assert described.shape == (600, 13)  # the rank, and one constant number
    torch.testing.assert_close(described.norm(dim=1), torch.ones(600))
    number = ((PLACES - PLACES.mean(0)).square().sum(1).mean() / 12).sqrt()  # the constant, before that
    components = described[:, :-1] / described[:, -1:] * number
    distances = torch.cdist(components, components)
    torch.testing.assert_close(distances, torch.cdist(PLACES, PLACES), rtol=1e-2, atol=5e-2)


def ranges(turns=3.3):
    """A route of 256 features whose lengths, 1 to 3, tell the place, and whose directions repeat."""
    at = torch.arange(256.0)
    around = 2 * math.pi * turns * at / 256
    return torch.stack([around.cos(), around.sin()], 1) * torch.linspace(1, 3, 256)[:, None]


def test_lengths_that_tell_the_place_are_kept(caplog):
    whitening = Whitening(views=0)
    whitening.learn(ranges())
    assert whitening.lengths is True
    rows = whitening(ranges())
    found = (rows @ rows.T).masked_fill(torch.eye(256).bool(), -1).argmax(1)
    assert float(((found - torch.arange(256)).abs() <= 2).float().mean()) > 0.9
    for same in (torch.nn.functional.normalize(ranges(), dim=1), ranges()[:20]):  # unit length; too short
        whitening.learn(same)
        assert whitening.lengths is None
    for lengths in (True, False):
        settled = Whitening(views=0, lengths=lengths)
        settled.learn(ranges())
        assert settled.lengths is lengths
    model = DejaVu().learn(ranges())
    assert "lengths of its descriptors are kept" in caplog.text
    assert not model.centres(1000)
    assert DejaVu().learn(torch.nn.functional.normalize(ranges(), dim=1)).centres(1000)


def test_kept_lengths_are_told_by_the_file(tmp_path):
    DejaVu().learn(ranges()).save(tmp_path / "map.safetensors")
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert model.descriptor.keeps_lengths
    assert torch.equal(model.localize(ranges()).index, torch.arange(256))
    match = model.localize(ranges(), sequence=PlaceSmoother())
    assert match.smoother.removed == 0.5  # else nothing but inner products would be left of distances
    model.learn(torch.randn(60, 12))  # which a file settles
    assert model.descriptor.keeps_lengths


def test_numbers_follow_the_rank_and_the_length_of_the_route(caplog):
    assert len(learned(PLACES[:20], VIEWS[:20]).scale) == 10  # half of the places
    assert len(learned(PLACES[:, :8], VIEWS[:, :8]).scale) == 8  # all there are
    many = torch.randn(400, 300, generator=torch.Generator().manual_seed(0))
    assert [len(learned(many, None, numbers=count).scale) for count in (None, 20)] == [256, 20]
    assert not caplog.text
    assert len(learned().scale) == 12
    assert "rank 12" in caplog.text


def test_short_routes_are_looked_at_more_often():
    frames = 60, 400, 1000, 2700, 3000, 90_000
    assert [Whitening().copies(count, 1764) for count in frames] == [36, 12, 6, 3, 2, 2]
    assert Whitening().copies(2000, 40) == 2  # 40 features have no more components
    assert Whitening(components=100).copies(1000, 1764) == 4
    assert Whitening(views=2).copies(60, 1764) == 2


def test_views_that_are_no_samples_of_their_own_do_not_lower_the_shrinkage():
    views, places = (
        PLACES[:200] + torch.randn(200, 40, generator=torch.Generator().manual_seed(2)),
        PLACES[:200],
    )
    change = ((views - places) / 2).double()
    shrinkage = oracle_shrinkage(change.T @ change / 200, 50)
    assert shrinkage > oracle_shrinkage(change.T @ change / 200, 200)
    expected = learned_whitening(views, places, 5, shrinkage)
    found = learned_whitening(views, places, 5, None, samples=50)
    torch.testing.assert_close(found[1].abs(), expected[1].abs())


def test_fewer_numbers_have_more_bits_in_as_many_bytes():
    def size(places, views=True, **settings):
        """Bytes of each number of the projection."""
        shown = VIEWS[:places] if views else None
        whitening = learned(PLACES[:places], shown, **settings)
        return whitening.projection.nbytes / (40 * len(whitening.scale))

    assert [size(places) for places in (20, 65, 66, 100, 129, 600)] == [2, 2, 1, 1, 1, 0.5]
    assert size(20, numbers=4) == size(20, views=False) == 0.5
    assert size(20, bits=8) == 1


@pytest.mark.parametrize("bits", [4, 8, 16])
@pytest.mark.parametrize("numbers", [5, 8])
def test_a_state_of_any_size_is_loaded(bits, numbers):
    one, other = learned(numbers=numbers, bits=bits), learned(PLACES[:, :9], None)
    other.load_state_dict(one.state_dict())
    assert torch.equal(other(VIEWS), one(VIEWS))
    assert not Whitening().learned
    assert torch.equal(Whitening()(VIEWS), VIEWS)


def test_gradients_reach_the_features():
    places, views = route(200, 6, 4)
    for seen in (views, None):
        some = views[:3].double().requires_grad_()
        assert torch.autograd.gradcheck(learned(places, seen, numbers=3), (some,))


@pytest.mark.parametrize("features", [30, 300])
def test_principal_components_are_those_of_the_covariance(features):
    random = torch.Generator().manual_seed(0)
    rows = torch.randn(500, features, generator=random, dtype=torch.float64) * 0.9 ** torch.arange(features)
    mean, basis, variances = principal_components(rows.float(), 10)
    centred = rows - rows.mean(0)
    values, vectors = torch.linalg.eigh(centred.T @ centred / 500)
    torch.testing.assert_close(mean, rows.mean(0).float(), rtol=0, atol=1e-5)
    torch.testing.assert_close(variances, values.flip(0)[:10].float(), rtol=1e-3, atol=0)
    agreement = (basis.double() * vectors.flip(1)[:, :10]).sum(0).abs()
    assert agreement.min() > 0.99


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: Whitening(numbers=0), ("numbers=0", "1 <= numbers")),
        (lambda: Whitening(numbers=500), ("numbers=500", "components=400")),
        (lambda: Whitening(views=-1), ("views=-1", "views >= 0")),
        (lambda: Whitening(shrinkage=0.0), ("shrinkage=0.0", "above 0")),
        (lambda: Whitening(bits=6), ("bits=6", "4, 8 or 16")),
        (lambda: Whitening(strengths="all"), ("strengths", "'all'")),
        (lambda: learned(torch.ones(600, 4), None), ("600 descriptors", "all the same")),
        (lambda: learned(PLACES[:1], None), ("(1, 40)", "N>=2")),
        (lambda: Whitening().learn(PLACES, []), ("no views", "or None")),
        (lambda: learned(views=PLACES), ("views", "augmentation")),
        (lambda: learned(numbers=20), ("numbers is 20", "rank 12")),
        (lambda: learned(views=VIEWS[:, :7]), ("(600, 7)", "(V, 40)")),
        (lambda: learned()(VIEWS[:, :7]), ("(600, 7)", "(B, 40)")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


# members side by side ---------------------------------------------------------------------------------

OTHER = route(600, 25, 9)  # another member's descriptors of the same places
SIDE = torch.cat([PLACES, OTHER[0]], 1), torch.cat([VIEWS, OTHER[1]], 1)
GROUPS = [40, 25]


def joined(views=True, groups=GROUPS, **settings):
    whitening = Whitening(groups=groups, **{"bits": 16} | settings)
    whitening.learn(SIDE[0], [(SIDE[1], torch.arange(600))] if views else None)
    return whitening


@pytest.mark.parametrize("views", [True, False])
def test_members_are_whitened_one_by_one_and_joined(views):
    members = []
    for places, other in ((PLACES, VIEWS), OTHER):
        member = learned(places, other if views else None, bits=16)
        members.append((member(places).tolist(), member(other).tolist()))
    whitening = joined(views)
    sides = map(list, zip(*members, strict=True))
    expected = joined_rows(*sides, whitening.dimension, 0.25 if views else 0)
    found, places = whitening(SIDE[1]), whitening(SIDE[0])
    torch.testing.assert_close(found.norm(dim=1), torch.ones(600))
    torch.testing.assert_close(found @ places.T, expected, rtol=0, atol=2e-3)


def test_one_group_has_the_numbers_of_a_whitening_without_levelled():
    plain = learned(*SIDE, bits=16)
    one = joined(groups=[65], numbers=plain.dimension)
    assert len(one.members) == 1
    sides = ([plain(rows).tolist()] for rows in SIDE)
    expected = joined_rows(*sides, plain.dimension, 0.25)
    torch.testing.assert_close(one(SIDE[1]) @ one(SIDE[0]).T, expected, rtol=0, atol=1e-3)
    again = Whitening(bits=16)
    again.learn(SIDE[0], [(SIDE[1], torch.arange(600))], None)
    assert torch.equal(again(SIDE[1]), plain(SIDE[1]))


@pytest.mark.parametrize("bits", [4, 8, 16])
@pytest.mark.parametrize("views", [True, False])
def test_a_state_of_groups_is_loaded(bits, views):
    one, other = joined(views, bits=bits), learned()
    other.load_state_dict(one.state_dict())
    assert torch.equal(other(SIDE[1]), one(SIDE[1]))
    torch.testing.assert_close(one(SIDE[1], one.all_unpacked()), one(SIDE[1]))
    exact = copy.deepcopy(one).double()(SIDE[1].double())
    assert exact.dtype == torch.float64
    torch.testing.assert_close(exact.float(), one(SIDE[1]), rtol=0, atol=1e-4)
    other.load_state_dict(learned().state_dict())
    assert not other.members
    assert torch.equal(other(VIEWS), learned()(VIEWS))


def test_gradients_reach_the_members():
    some = SIDE[1][:2].double().requires_grad_()
    assert torch.autograd.gradcheck(joined(bits=4), (some,))


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: Whitening(groups=[]), ("the groups are []", "at least 1")),
        (lambda: Whitening(groups=[40, 0]), ("the groups are [40, 0]", "at least 1")),
        (lambda: joined(groups=[40, 20]), ("groups of 40 + 20", "(600, 65)", "expected (N, 60)")),
        (lambda: joined(numbers=50), ("numbers is 50", "rank 21")),
        (lambda: joined()(VIEWS), ("(600, 40)", "(B, 65)")),
    ],
)
def test_groups_that_do_not_fit(call, facts):
    with refused(*facts):
        call()
