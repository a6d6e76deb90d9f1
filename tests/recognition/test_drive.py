"""The matches of a whole drive."""

from __future__ import annotations

import math

import pytest
import torch
from devices import pretend
from test_smoother import noise, shown

from dejavu_torch import DejaVu, Whitening, open_source
from dejavu_torch.data.traverse import fitted
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.motion.resampling import ground_truth_of
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition import drive as driving
from dejavu_torch.recognition import engine
from dejavu_torch.recognition import smoother as smoothing
from dejavu_torch.recognition.calibration import Platt, confidence_of
from dejavu_torch.recognition.drive import DriveQuery, doubt, localize_drive, localize_drives
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.smoother import PlaceSmoother

PLATT = Platt(3.0, 0.5)


def localized(scores, smoother, k=1, platt=None):
    """Of scores of which some are asked for at a time."""
    scorer = by_rows(smoothing.rows_of(scores), noise(len(scores), 16, seed=8), scores.shape[1])
    return localize_drive(DriveQuery(scorer, smoother, k, 4, platt=platt))


def by_rows(rows, descriptors, places=80):
    return OfRows(rows, descriptors, Layout(places))


def test_an_answer_has_the_most_mass_around_it():
    scores, smoother = shown(80, [*range(5, 75), *range(74, 40, -1)]), PlaceSmoother(within=3)
    match = localized(scores, smoother, platt=PLATT)
    assert match.is_drive
    assert smoother.log_likelihood is None  # it stays as it was
    smoother = match.smoother
    posterior = smoother.posterior(scores, noise(len(scores), 16, seed=8))[:, :-1]
    ranked = smoother(scores, noise(len(scores), 16, seed=8))
    answer, own = ranked.argmin(1), scores.gather(1, ranked.argmin(1)[:, None])[:, 0]
    assert torch.equal(match.index[:, 0], answer)
    assert torch.allclose(match.score[:, 0], ranked.amin(1) + doubt(own), atol=1e-5)
    assert match.accepted.all()
    assert match.probability is not None
    assert match.confidence is not None
    for t, place in enumerate(answer.tolist()):
        mass = posterior[t, max(0, place - 3) : place + 4].sum().item()
        assert match.probability[t].item() == pytest.approx(mass, abs=1e-5)
        beyond = [one for i, one in enumerate(ranked[t].tolist()) if abs(i - place) > 5]
        stands_out = -max(0, ranked[t, place].item()) / min(beyond) ** 0.75 - doubt(own)[t].item()
        assert match.confidence[t].item() == pytest.approx(stands_out, abs=1e-3)
    assert ((-match.score[:, 0]).exp() <= match.probability[:, 0] + 1e-6).all()


def test_candidates_are_apart_and_the_first_is_the_answer():
    scores = shown(80, range(5, 75))
    best, four = localized(scores, PlaceSmoother()), localized(scores, PlaceSmoother(), k=4)
    assert four.index.shape == (70, 4)
    apart = (four.index[:, :, None] - four.index[:, None]).abs() + 99 * torch.eye(4)
    assert apart.min() > 4
    assert (four.score.diff(dim=1) >= 0).all()
    for name, column in best.columns.items():
        assert torch.equal(four.columns[name][:, :1], column)
    assert four.probability is not None
    assert four.confidence is not None
    assert four.probability[:, 1:].isnan().all()
    assert four.confidence[:, 1:].isnan().all()


def test_what_is_no_drive_is_answered_by_single_queries():
    scores, smoother, platt = 5 + noise(80, 100), PlaceSmoother(within=5), Platt(10.0, 14.0)
    match, alone = localized(scores, smoother, platt=platt), localized(scores, PlaceSmoother(within=5))
    assert not match.is_drive
    assert torch.equal(match.index[:, 0], scores.argmin(1))
    assert torch.equal(match.score[:, 0], scores.amin(1))
    assert alone.probability is not None
    assert match.probability is not None
    single = platt.probability(confidence_of(scores))
    assert torch.allclose(match.probability[:, 0], torch.minimum(alone.probability[:, 0], single))
    assert single.max() > 0.9 > 0.5 > match.probability.max()
    best = scores.gather(1, match.index)
    far = (torch.arange(100) - match.index).abs() > 5
    second = scores.masked_fill(~far, math.inf).amin(1)
    assert match.confidence is not None
    assert torch.allclose(match.confidence[:, 0], -best[:, 0].clamp(min=0) / second.clamp(min=1e-38) ** 0.75)


@pytest.mark.parametrize("drives", [True, False])
def test_blocks_give_what_the_whole_gives(drives, monkeypatch):
    scores = shown(80, range(70), clear=2.5 if drives else 0.0)
    whole = localized(scores, PlaceSmoother(), k=2, platt=PLATT)
    monkeypatch.setattr(engine, "NUMBERS_AT_ONCE", 1)
    parts = localized(scores, PlaceSmoother(), k=2, platt=PLATT)
    for name, column in whole.columns.items():
        assert torch.allclose(parts.columns[name], column, atol=1e-5, equal_nan=True)


def test_doubt_grows_with_the_distance_from_what_is_usual():
    """.1 nats for each standard deviation above the median, by the median absolute deviation."""
    own = torch.tensor([1.0, 2, 3, 4, 5, 9, -9, math.inf, math.nan, 1e9])
    expected = [0, 0, 0, 0.1 / (2 * 1.4826), 0.2 / (2 * 1.4826), 0.6 / (2 * 1.4826), 0, 0, 0, 10]
    known = own[own.isfinite()]
    assert float((known - 3).abs().median()) == 2
    assert doubt(own).tolist() == pytest.approx(expected)
    assert doubt(torch.full((4,), math.inf)).tolist() == [0] * 4
    assert doubt(torch.full((4,), 2.0)).tolist() == [0] * 4


def test_places_and_queries_without_scores_are_not_answered():
    scores = shown(80, range(70))
    scores[:, 40:50], scores[20], scores[25] = math.inf, math.inf, math.nan
    for one in (scores, torch.where(scores.isfinite(), noise(70, 80), scores)):  # a drive, and none
        match = localized(one, PlaceSmoother(), platt=PLATT)
        assert not ((match.index >= 40) & (match.index < 50)).any()
        assert match.index[[20, 25], 0].tolist() == [-1, -1]
        assert match.score[[20, 25], 0].tolist() == [math.inf, math.inf]
        assert match.probability is not None
        assert match.probability[[20, 25], 0].tolist() == [0, 0]
        assert not match.accepted[[20, 25]].any()
        assert match.accepted.sum() == 68


class Plain(AlongRoute):
    """Without steady speeds, which slip."""


def test_answers_that_are_nearly_sure_have_different_scores():
    sure = PlaceSmoother((0.0, 1.0), jump=1e-9, leave=1e-9, within=3, motion=Plain)
    match = localized(shown(80, range(80), clear=9.0), sure)
    assert match.index[:, 0].tolist() == [*range(80)]
    assert float(match.score.min()) < 1e-12
    assert len(match.score.unique()) > 60


def test_drives_are_matched_together_as_each_by_itself():
    path, descriptors = [*range(5, 65)], noise(60, 16, seed=8)
    scores = [shown(80, path), shown(80, path[::-1]), noise(60, 80, seed=1), shown(90, path)]
    scores[1][7] = math.nan
    links = ((64, 5, 0.5),)

    def asked():
        asked = [by_rows(smoothing.rows_of(one), descriptors, one.shape[1]) for one in scores]
        drives = [DriveQuery(one, PlaceSmoother(within=3), 2, 4, platt=PLATT) for one in asked]
        linked = PlaceSmoother(links=links)
        return [
            *drives,
            drives[0]._replace(smoother=linked),
            drives[0]._replace(smoother=PlaceSmoother(MOVES)),
        ]

    together, alone = asked(), asked()
    matches = localize_drives(together)
    for found, expected in zip(matches, map(localize_drive, alone), strict=True):
        assert torch.equal(found.index, expected.index)
        for name, column in expected.columns.items():
            assert torch.allclose(found.columns[name], column, rtol=1e-4, equal_nan=True), name
        assert found.smoother.links == expected.smoother.links
    assert [one.is_drive for one in matches] == [True, True, False, True, True, True]


@pytest.mark.parametrize("kept", [0, 2**26])
def test_scores_are_computed_once_if_they_can_be_kept(kept, monkeypatch):
    monkeypatch.setattr(driving, "SCORES_KEPT", kept)
    monkeypatch.setattr(engine, "NUMBERS_AT_ONCE", 2**12)
    monkeypatch.setattr(engine, "HELD", 2**12)
    scores, asked = shown(80, [*range(5, 75)]), torch.zeros(70)

    def rows(numbers):
        asked[numbers] += 1
        return scores[numbers]

    smoother, descriptors = PlaceSmoother().fit(rows, noise(70, 16, seed=8)), noise(70, 16, seed=8)
    fitted = asked.clone()
    expected = localize_drive(DriveQuery(by_rows(smoothing.rows_of(scores), descriptors), PlaceSmoother()))
    found = localize_drive(DriveQuery(by_rows(rows, descriptors), PlaceSmoother()))
    assert smoother.is_drive
    assert torch.equal(found.index, expected.index)
    assert int((asked - 2 * fitted)[1:].max()) == (1 if kept else 2)


def test_a_threshold_is_of_a_probability_for_what_is_no_drive_too():
    route, other = noise(80, 12, seed=3).cumsum(0), noise(60, 12, seed=4)
    model = DejaVu(None, "none").learn(route)
    for threshold in (math.log(2), 1e-3):
        match = model.localize(other, sequence=PlaceSmoother(threshold=threshold))
        assert match.smoother is not None
        assert not match.is_drive
        assert match.probability is not None
        assert torch.equal(match.accepted, match.probability >= math.exp(-threshold))
        assert not match.accepted.any()


def test_frames_that_are_no_drive_are_localized_as_if_in_no_order():
    features = noise(80, 12, seed=3).cumsum(0)
    model = DejaVu(None, "none").learn(features)
    other = noise(60, 12, seed=4) + 5
    match = model.localize(other, sequence=PlaceSmoother())
    assert not match.is_drive
    assert torch.equal(match.index, model.localize(other, sequence=None, centre=True).index)
    assert not torch.equal(match.index, model.localize(other, sequence=None, centre=False).index)


def test_few_queries_and_places_have_answers():
    scores = noise(30, 20)
    none, one = (localized(scores[:n], PlaceSmoother(), k=2, platt=PLATT) for n in (0, 1))
    assert {name: column.shape for name, column in none.columns.items()} == dict.fromkeys(one.columns, (0, 2))
    assert one.index[0, 0] == scores[0].argmin()
    assert one.probability is not None
    assert one.probability[0, 0] == PLATT.probability(confidence_of(scores[:1]))[0]
    alone = localized(scores[:, :1], PlaceSmoother(), platt=PLATT)
    assert alone.index.unique().tolist() == [0]
    assert alone.confidence is not None
    own = alone.score[:, 0]  # compared with itself
    expected = torch.where(own > 1e-6, -(own.clamp(min=0) ** 0.25), -1.0)
    assert torch.allclose(alone.confidence[:, 0], expected)


@pytest.mark.parametrize("clear", [3.0, 0.0])
def test_a_device_finds_what_the_cpu_finds(clear):
    scores, descriptors = shown(20, range(16), clear=clear).double(), noise(16, 4)

    def found(scores, descriptors):
        scorer = by_rows(smoothing.rows_of(scores), descriptors, scores.shape[1])
        return localize_drive(DriveQuery(scorer, PlaceSmoother(MOVES), 2, 4, platt=PLATT))

    expected = found(scores, descriptors)
    with pretend() as device:
        there = found(scores.to(device), descriptors.to(device))
    for name, column in expected.columns.items():
        assert there.columns[name].device.type == "cpu"
        assert torch.allclose(there.columns[name], column, rtol=1e-5, equal_nan=True)


MOVES = (0.2, 0.6, 0.2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "names", "tolerance", "area", "other"),
    [
        ("robotcar/t1", ("reference.npy", "query.npy"), 2, 0.99, "nordland/winter?stop=150"),
        ("corridor", ("ref", "query"), 0, 0.98, "floors_rejection/query.npy?stop=150"),
    ],
)
def test_a_drive_is_found_in_another_season_and_another_route_is_not(
    data_dir, folder, names, tolerance, area, other
):
    reference, queries = (open_source(data_dir / folder / name) for name in names)
    truth = ground_truth_of(str(data_dir / folder / "truth.csv"), reference, queries)
    assert truth is not None
    model = DejaVu(whitening=Whitening(views=1)).learn(reference)
    found = model.localize(queries, sequence=PlaceSmoother())
    assert evaluate(found, truth, tolerance).auc > area
    assert evaluate(model.localize(queries, sequence=None), truth, tolerance).auc < area
    assert found.accepted.double().mean() > 0.9
    elsewhere = fitted(open_source(f"{data_dir}/{other}"), model.frame_shape)
    wrong = model.localize(elsewhere, sequence=PlaceSmoother())
    assert not wrong.accepted.any()
    assert wrong.probability is not None
    assert wrong.probability.max() < 0.5
