"""Whether queries are a drive of a map: what single images say, and what their order says."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import DejaVu, PlaceFilter, PlaceSmoother, SpectralMapper
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.growth import learn_mean
from dejavu_torch.recognition import taken
from dejavu_torch.recognition.calibration import Platt
from dejavu_torch.recognition.evidence import presence_of
from dejavu_torch.recognition.localizer import Localizer
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.taken import (
    OF_AREA,
    Running,
    Singly,
    doubted,
    flipped,
    moves_along,
    singly,
    upper,
)


def walk(frames, seed, size=24, step=0.3):
    """Descriptors that change slowly, of length 1."""
    draw = torch.Generator().manual_seed(seed)
    rows = torch.empty(frames, size)
    at = torch.randn(size, generator=draw)
    for i in range(frames):
        at = math.sqrt(1 - step**2) * at + step * torch.randn(size, generator=draw)
        rows[i] = at
    return torch.nn.functional.normalize(rows, dim=1)


def seen_again(rows, seed, noise=0.1):
    draw = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(rows + noise * torch.randn(rows.shape, generator=draw), dim=1)


@pytest.fixture(scope="module")
def model():
    return DejaVu(whitening="none").learn(walk(400, 0))


def asked(model, queries):
    """A smoother that was fitted to the queries, and its match."""
    match = model.localize_descriptors(queries, model.matching(PlaceSmoother()))
    return match.smoother, match


def test_mirrored_queries_are_as_alike_as_they_were_and_have_the_same_mean():
    rows = walk(50, 1)
    other = flipped(rows, 3)
    assert torch.allclose(torch.cdist(other, other), torch.cdist(rows, rows), atol=1e-3)
    assert torch.allclose(other.mean(0), rows.mean(0), atol=1e-6)
    assert not torch.allclose(other, rows, atol=0.1)
    assert torch.equal(other, flipped(rows, 3))
    assert not torch.equal(other, flipped(rows, 4))
    about = flipped(rows[:1], 3, mean=torch.zeros(24))
    assert torch.equal(about.abs(), rows[:1].abs())


def test_the_upper_tenth_is_that_of_all_queries_asked():
    own = -torch.arange(1.0, 101)  # the confidence of each query
    found = singly(
        lambda n: own[n, None], lambda n, seed: -10 - own[n, None] * 0, torch.ones(100), lambda s: s[:, 0]
    )
    assert found._replace(presence=None) == Singly(-5.5, -10.0, 100)
    assert found.presence == presence_of(own, torch.full((600,), -10.0))
    assert upper(own[:4]) == -1.0  # at least one


def test_a_stop_counts_once():
    own = torch.cat([torch.full((900,), -1.0), torch.full((99,), -9.0)])
    weight = torch.cat([torch.full((900,), 1 / 1024), torch.ones(99)])  # which add up exactly
    found = singly(lambda n: own[n, None], lambda n, seed: -10 - own[n, None] * 0, weight, lambda s: s[:, 0])
    assert found.queries == 100
    assert found.shown == pytest.approx((-1 - 9 * 9) / 10)


@given(st.floats(0, 1), st.floats(0.01, 100))
def test_odds_change_by_a_factor(probability, odds):
    p = float(doubted(torch.tensor(probability, dtype=torch.float64), odds))
    assert p * (1 - probability) == pytest.approx(odds * probability * (1 - p), abs=1e-9)


def test_images_that_find_the_map_are_not_doubted():
    assert Singly(-0.5, -0.9, 100).odds == 1
    assert Singly(-0.8, -0.9, 100).odds == pytest.approx(1 / 9)


def test_single_images_that_find_the_map_plainly_need_no_motion(model):
    """Every other one is off the map, so that no path explains them."""
    platt = Platt(10.0, 7.0)
    draw = torch.Generator().manual_seed(4)
    own = seen_again(walk(400, 0)[torch.randperm(400, generator=draw)[:100]], 5)
    mixed = torch.stack([own, walk(100, 9)[torch.randperm(100, generator=draw)]], 1).flatten(0, 1)
    match = model.localize_descriptors(mixed, model.matching(PlaceSmoother())._replace(platt=platt))
    smoother = match.smoother
    assert not match.is_drive
    assert smoother.singly is not None
    assert smoother.singly.enough
    single = model.localize_descriptors(mixed, model.matching()._replace(platt=platt))
    assert torch.allclose(match.probability, single.probability, atol=1e-3)
    assert not Singly(-0.7, -0.95, 100).enough
    assert Singly(-0.5, -0.95, 100).enough


@pytest.mark.parametrize("queries", [1, 3, 9])
def test_of_few_queries_single_images_tell_nothing(model, queries):
    """They would be mirrored about themselves."""
    smoother, match = asked(model, seen_again(walk(400, 0)[100 : 100 + queries], 5))
    assert smoother.singly is None
    assert ((match.index - torch.arange(100, 100 + queries)).abs() <= 5).all()


def test_an_average_of_visits_is_a_faithful_map():
    """It is shorter than what one visit shows, not coarser."""
    rows = walk(400, 0)
    visits = LabelledFrames(ArrayTraverse(seen_again(rows, 5, noise=0.3)), torch.arange(400))
    averaged = learn_mean(DejaVu(whitening="none"), rows, visits)
    assert averaged.map.fidelity >= 0.7
    other, _ = asked(averaged, walk(300, 3))
    assert other.singly is not None
    assert not other.is_drive


def test_motion_has_to_pay_for_its_jumps():
    assert moves_along(100.0, 1.0)
    assert not moves_along(5.0, 1.0)  # in all
    assert not moves_along(100.0, 0.1)  # for each query


def test_a_running_number_is_that_of_all_so_far_in_any_batches():
    draw = torch.Generator().manual_seed(0)
    own, null = (-torch.rand(2, 300, generator=draw)).double()
    asked = torch.arange(300) % 4 == 0
    null = torch.where(asked, null * 1.5, math.nan)
    best, far = 0.2 + 0.1 * torch.rand(300, generator=draw).double(), torch.where(asked, 0.8, math.nan)
    far += 0.05 * torch.randn(300, generator=draw)
    best[200:] = 0.78  # off the map
    pairs = torch.stack([own, best], 1), torch.stack([null, far], 1)
    running, parts = Running(), Running()
    odds, absent = running(*pairs)
    some = [parts(*(one[a:b] for one in pairs)) for a, b in ((0, 1), (1, 90), (90, 300))]
    for whole, pieces in zip((odds, absent), zip(*some, strict=True), strict=True):
        assert torch.equal(whole, torch.cat(pieces))
    for n in (1, 57, 300):
        known = null[:n][~null[:n].isnan()]
        expected = Singly(upper(own[:n]), upper(known), n)
        assert float(odds[n - 1]) == expected.odds
    assert not absent[:76].any()  # of 19 mirrored ones
    assert float(absent[80:200].mean()) < 0
    assert float(absent[200:].min()) > 0.5
    alone = torch.stack([torch.full((3,), math.nan)] * 2, 1)
    assert [one.tolist() for one in Running()(pairs[0][:3], alone)] == [[1, 1, 1], [0, 0, 0]]


def test_other_ground_is_no_drive_although_its_frames_are_in_order(model):
    own, match = asked(model, seen_again(walk(400, 0)[50:350], 5))
    assert own.is_drive
    assert (match.index - torch.arange(50, 350)).abs().max() <= 5
    for seed in range(1, 6):
        other, match = asked(model, walk(300, seed))
        assert not other.is_drive
        assert other.singly is not None
        assert not other.singly.stands_out
        assert other.settled()["taken"] is False
        assert float((match.probability >= 0.5).double().mean()) <= 0.02


def test_a_drive_whose_mirrored_queries_find_the_map_as_well_is_none(model):
    own = seen_again(walk(400, 0)[50:350], 5)
    for mirrored, drives in (None, True), (lambda scorer: lambda queries, seed: scorer.rows(queries), False):

        def asks(scorer, mirrored=mirrored):
            null = None if mirrored is None else mirrored(scorer)
            return OfRows(scorer.rows, scorer.descriptors, scorer.layout, null)

        match = model.localize_descriptors(own, model.matching(PlaceSmoother()), asks)
        assert match.is_drive is drives


def test_a_part_over_the_map_is_a_drive(model):
    part = torch.cat([seen_again(walk(400, 0)[100:200], 5), walk(200, 9)])
    smoother, match = asked(model, part)
    assert smoother.is_drive
    assert (match.probability[:100] >= 0.5).double().mean() > 0.9
    assert (match.probability[110:] >= 0.5).double().mean() < 0.1


def test_a_filter_doubts_while_single_images_do_not_find_the_map(model, monkeypatch):
    platt = Platt(1.0, 0.0)
    matching = model.matching(PlaceFilter())._replace(platt=platt)
    drives = [walk(300, 2), seen_again(walk(400, 0)[50:350], 5)]
    other, own = (model.localize_descriptors(one, matching).probability for one in drives)
    monkeypatch.setattr(taken.Singly, "stands_out", True)  # any image will do
    trusted, same = (model.localize_descriptors(one, matching).probability for one in drives)
    assert torch.equal(own, same)
    assert torch.allclose(other[30:], doubted(trusted[30:], 1 / 9))
    alone = Platt(2.0, 1.0)
    monkeypatch.undo()
    capped = model.localize_descriptors(drives[0], matching._replace(single=alone)).probability
    single = model.localize_descriptors(drives[0], model.matching()._replace(platt=alone)).probability
    assert torch.allclose(capped[30:], doubted(torch.minimum(trusted, single)[30:], 1 / 9), atol=1e-5)
    parts = Localizer(model.map, matching._replace(sequence=PlaceFilter(lag=7), single=alone))
    late = torch.cat([parts(part).probability for part in drives[0].split(50)] + [parts.finish().probability])
    assert len(late) == 300
    assert bool((late[30:] <= doubted(single[30:], 1 / 9) + 1e-4).all())


def test_a_coarse_map_is_asked_by_motion_alone():
    """Its single images find little, and the drive finds nearly all."""
    rows = walk(400, 0, size=64)
    model = DejaVu(None, "none", SpectralMapper(1.0)).learn(rows)
    assert model.map.fidelity < 0.7 < DejaVu(whitening="none").learn(rows).map.fidelity
    smoother, match = asked(model, seen_again(rows[50:350], 5, noise=0.2))
    assert smoother.is_drive
    assert smoother.singly is None
    assert ((match.index - torch.arange(50, 350)).abs() <= 5).double().mean() > 0.95
    assert not asked(model, walk(300, 3, size=64))[0].is_drive


def test_a_drive_whose_motion_is_plain_needs_less_of_its_images():
    assert not Singly(-0.8, -0.95, 100, 2.9).stands_out
    assert Singly(-0.8, -0.95, 100, 3.1).stands_out
    assert not Singly(-0.9, -0.95, 100, 10.0).stands_out
    assert not Singly(-0.7, -0.95, 100, least=OF_AREA).stands_out  # over a plane
    assert Singly(-0.5, -0.95, 100, least=OF_AREA).stands_out
    model, rows = DejaVu(whitening="none"), walk(400, 0, size=64)
    smoother, match = asked(model.learn(rows), seen_again(rows[50:350], 5, noise=0.2))
    assert smoother.is_drive
    assert ((match.index - torch.arange(50, 350)).abs() <= 5).double().mean() > 0.95
