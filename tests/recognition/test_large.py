"""A drive on a large map, coarse to fine, held against the smoother of all places."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from test_smoother import noise, shown

from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.rectangles import Rectangle
from dejavu_torch.places.states import States
from dejavu_torch.recognition import drive as driving
from dejavu_torch.recognition import large
from dejavu_torch.recognition.drive import DriveQuery, localize_drive
from dejavu_torch.recognition.engine import Rates
from dejavu_torch.recognition.large import LargeDrive, is_large
from dejavu_torch.recognition.localizer import Matching, answer
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.scorer import OfMap, OfRows
from dejavu_torch.recognition.smoother import PlaceSmoother


class InBlocks(OfRows):
    """Scores of which some places are computed at a time."""

    def blocks(self, queries):
        for start in range(0, self.layout.places, 70):
            yield start, self.rows(queries)[:, start : start + 70]

    @property
    def width(self):
        return 2**18


def by_rows(scores, descriptors):
    return OfRows(scores.__getitem__, descriptors, Layout(scores.shape[1]))


def both(scores, monkeypatch, starts=(0,), **settings):
    """Matches by the smoother of all places, and coarse to fine with scores of a few places at a time."""

    ends = (*starts[1:], scores.shape[1])
    parts = [Rectangle(end - start, route=i) for i, (start, end) in enumerate(zip(starts, ends, strict=True))]
    layout, found = Layout.of(parts), []
    queries = noise(len(scores), 16, seed=8)
    for coarse in (False, True):
        monkeypatch.setattr(driving, "is_large", lambda *_, answer=coarse: answer)
        scorer = InBlocks(scores.__getitem__, queries, layout)
        match = localize_drive(DriveQuery(scorer, PlaceSmoother(within=3), radius=4, **settings))  # type: ignore[arg-type]
        found.append(match)
    return found


PATHS = {
    "on": [*range(20, 320)],
    "back": [*range(320, 20, -1)],
    "there and back": [*range(100, 250), *range(250, 100, -1)],
    "off the map in between": [*range(40, 140), *[-1] * 60, *range(200, 340)],
    "slow": [i // 3 for i in range(300, 900)],
    "in stretches": [i for first in (300, 20, 180, 250, 90) for i in range(first, first + 60)],
}


@pytest.mark.parametrize("name", PATHS)
def test_answers_are_those_of_all_places(name, monkeypatch):
    path = torch.tensor(PATHS[name])
    monkeypatch.setattr(large, "WINDOW", 120)
    monkeypatch.setattr(large, "MARGIN", 40)
    one, two = both(shown(400, PATHS[name]), monkeypatch)
    assert one.is_drive
    assert two.is_drive
    on = path >= 0
    right = [((match.index[:, 0] - path).abs() <= 3)[on].double().mean() for match in (one, two)]
    assert right[1] > 0.95
    assert abs(right[1] - right[0]) <= 0.01
    assert one.probability is not None
    assert two.probability is not None
    assert float((one.probability - two.probability)[on].abs().median()) < 0.02
    assert (two.probability[~on] < 0.5).double().mean() > 0.8 or on.all()
    agreeing = one.index == two.index
    assert torch.allclose(
        one.score[agreeing & on[:, None]].exp(), two.score[agreeing & on[:, None]].exp(), atol=0.2
    )


def test_only_likely_places_are_looked_at(monkeypatch):
    monkeypatch.setattr(large, "WINDOW", 100)
    scores = shown(4000, range(1008, 1408), clear=9.0)
    drive = LargeDrive(by_rows(scores, noise(400, 8)), PlaceSmoother())
    assert len(drive.windows) == 4
    for window in drive.windows:
        assert window.stop - window.start <= 300
        assert len(window.places) < 600
        around = torch.arange(1008 + window.start - 5, 1008 + window.stop + 5)  # `within` is 5
        seen = torch.isin(around, window.places)
        assert seen.all()
        assert torch.equal(window.places.unique(), window.places)


@pytest.mark.parametrize("kind", ["equal", "none", "few"])
def test_no_drive_looks_at_more_places_than_it_may(kind, monkeypatch):
    monkeypatch.setattr(large, "LOOKED", 320)
    monkeypatch.setattr(large, "WINDOW", 100)
    scores = noise(300, 4000)
    if kind == "equal":
        scores[:] = 1.0
    elif kind == "none":
        scores[:] = math.nan
    else:
        scores[:, 40:] = math.inf
    drive = LargeDrive(by_rows(scores, noise(300, 8)), PlaceSmoother(), candidates=4, radius=10**4)
    assert not drive.smoother.is_drive
    assert all(0 < len(window.places) <= 3 * 320 for window in drive.windows)
    assert [len(own) for _, own, *_ in drive.masses(drive.smoother)] == [100, 100, 100]


def test_a_drive_is_fitted_to_no_more_queries_than_it_may():
    walk = F.avg_pool1d(noise(4039, 4, seed=1).T[None], 40, 1)[0].T  # few are independent
    scores = noise(4000, 300)
    drive = LargeDrive(by_rows(scores, walk), PlaceSmoother())
    assert drive.spacing.correlation > 5
    assert 500 < sum(drive._fitted().values()) <= 1000


def test_scores_of_windows_are_those_that_were_given(monkeypatch):
    scores = shown(300, range(20, 280))
    drive = LargeDrive(by_rows(scores, noise(260, 8)), PlaceSmoother())
    for first, mass, own, places in drive.masses(drive.smoother):
        assert bool((mass >= 0).all() and (mass.sum(1) <= 1 + 1e-5).all() and (mass.amax(1) > 0.1).all())
        assert torch.allclose(own, scores[first : first + len(own)][:, places], atol=0.01)


def test_another_route_is_answered_by_single_queries(monkeypatch):
    scores = shown(400, [-1] * 200)
    _, two = both(scores, monkeypatch)
    assert not two.is_drive
    assert torch.equal(two.index[:, 0], scores.argmin(1))
    assert torch.equal(two.score[:, 0], scores.amin(1))
    assert two.probability is not None
    assert float(two.probability.max()) < 0.5


def test_queries_and_places_without_scores(monkeypatch):
    scores = shown(400, range(50, 250))
    scores[30] = math.nan
    scores[60] = 1.0
    scores[90] = math.inf
    scores[:, 100:110] = math.inf
    one, two = both(scores, monkeypatch)
    assert two.is_drive
    assert (one.index - two.index).abs().max() <= 1
    assert two.index[[30, 90], 0].tolist() == [-1, -1]
    assert two.index[60, 0] == 110 or abs(int(two.index[60, 0]) - 110) <= 4


def test_candidates_are_apart(monkeypatch):
    _, four, *_ = both(shown(400, range(50, 250)), monkeypatch, k=4)
    assert four.index.shape == (200, 4)
    apart = (four.index[:, :, None] - four.index[:, None]).abs() + 99 * torch.eye(4)
    assert apart[(four.index >= 0).all(1)].min() > 4


def test_routes_and_circuits_end_where_they_say(monkeypatch):
    whole = States(10, 2, (0, 6), ((9, 6, 1.0), (2, 0, 0.5)))
    some = whole.of(torch.tensor([0, 1, 2, 5, 6, 7, 9]))
    assert some.route_starts == (0, 3, 4, 6)
    assert some.links == ((6, 4, 1.0), (2, 0, 0.5))
    assert some.share == 0.7
    rates = Rates(torch.tensor([0.0, 1.0]), *torch.tensor([0.1, 0.0, 0.2]).unbind())
    motion = AlongRoute(some, rates)
    belief = torch.eye(15)[4]
    moved = motion.moved(belief)
    assert float(moved.sum()) == pytest.approx(1)
    assert float(moved[5]) == pytest.approx(0.9 + 0.1 * 0.7 / 14)
    assert float(moved[14]) == pytest.approx(0.1 * 0.3)  # jumped to a place that is left out
    assert float(motion.anywhere().sum()) == pytest.approx(1)
    assert torch.allclose(motion.expected(torch.ones(15)), torch.ones(15))
    message = noise(15).abs()
    assert float(motion.moved(belief) @ message) == pytest.approx(
        float(belief @ motion.expected(message)), rel=1e-5
    )


@pytest.mark.parametrize("room", [5.0, 0.5])
def test_few_bytes_are_placed_as_by_all_places(room, monkeypatch):
    places, queries = 3000, 400
    smooth = F.avg_pool1d(noise(places + 15, 64, seed=1).T[None], 16, 1)[0].T
    route = F.normalize(smooth)
    learned = SpectralMapper(room)(route)
    asked = F.normalize(route[500 : 500 + queries] + 0.7 / 8 * noise(queries, 64, seed=2))
    truth, found = torch.arange(500, 500 + queries), []
    for coarse in (False, True):
        monkeypatch.setattr(driving, "is_large", lambda *_, answer=coarse: answer)
        match = answer(OfMap(learned, asked), Matching(PlaceSmoother(within=5), radius=5))
        assert match.is_drive
        found.append(float(((match.index - truth).abs() <= 5).double().mean()))
    assert found[1] > 0.95
    assert found[1] >= found[0] - 0.01


def test_large_maps_and_long_drives_are_large():
    assert not is_large(1000, 4000)
    assert not is_large(1, 10**6)
    assert is_large(100, 10**5)
    assert is_large(10**5, 4000)


def test_a_prior_of_a_camera_that_is_very_fast():
    scores = shown(700, range(20, 680, 20))
    drive = LargeDrive(by_rows(scores, noise(33, 8)), PlaceSmoother((0,) * 20 + (1.0,)))
    assert sum(len(own) for _, _, own, _ in drive.masses(drive.smoother)) == 33
