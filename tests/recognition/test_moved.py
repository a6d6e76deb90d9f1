"""How far a camera moved, where odometry tells it: held against literal sums, and used end to end."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
import torch
from command_line import run
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from reference import Steps, forward_backward
from test_smoother import noise, shown

from dejavu_torch import (
    DejaVu,
    LiveLocalizer,
    PlaceFilter,
    PlaceSmoother,
    Querying,
    SequenceMatcher,
    compare,
)
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.matches import write_matches
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen, engine, large, odometry
from dejavu_torch.recognition.drive import DriveQuery, localize_drives, speed_of
from dejavu_torch.recognition.engine import Rates
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.odometry import moves_of
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.smoother import rows_of
from dejavu_torch.recognition.speeds import FREE, steady
from dejavu_torch.types import Coordinates, Odometer

SLIP = chosen.ODOMETRY / 2
ONE = (SLIP, 1 - 2 * SLIP, SLIP)


def test_a_drive_in_steps_of_one_place():
    moved = torch.tensor([0.0, 1, 0, 3, 0.4, 0.4, 0.4])
    queries, still = odometry.steps_of(odometry.checked_moved(moved, 7))
    assert queries.tolist() == [0, 1, 2, -1, -1, 3, 4, 5, 6]
    assert still.tolist() == [True, False, True, False, False, False, True, False, True]


@given(st.lists(st.floats(0, 3), min_size=1, max_size=8), st.integers(0, 99))
def test_a_smoother_takes_steps_of_one_place(moved, seed):
    """Forward-backward over all steps; those on the way say nothing."""
    moved = torch.tensor(moved).double()
    moved[0] = 0
    scores = noise(len(moved), 5, seed=seed).double()
    smoother = PlaceSmoother(moved=moved).double()
    drive = smoother.drive(scores)
    queries, still = odometry.steps_of(drive.moved)
    log = drive.log_likelihood(torch.arange(len(moved)))
    rows = [log[i].tolist() if i >= 0 else [0.0] * 5 for i in queries.tolist()]
    jump, leave, enter = 0.001, 0.001, 0.01
    with torch.no_grad():
        known, _ = forward_backward(Steps(5, ONE, jump, leave, enter, smoother.turn), rows, still.tolist())
    states = torch.tensor(known)[queries >= 0]
    there, back = states[:, :-1].chunk(2, 1)
    expected = torch.cat([there + back.flip(1), states[:, -1:]], 1).double()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chosen, "SCALES", (1.0,))
        torch.testing.assert_close(smoother.posterior(scores), expected, atol=1e-5, rtol=1e-4)


@given(st.integers(0, 4), st.sampled_from([FREE, steady([1]), steady([0.5, 2])]), st.integers(1, 2))
def test_a_step_of_so_many_places(places, speeds, directions):
    """Any speed that was kept before tells nothing of it."""
    states = States(6, directions, turn=0.1)
    rates = Rates(*(torch.tensor(one).double() for one in ([0.2, 0.8], 0.01, 0.02, 0.1)))
    motion = AlongRoute(states, rates, speeds)
    told = odometry.Told(motion, places)
    size = len(motion.anywhere())
    matrix = told.moved(torch.eye(size).double())
    torch.testing.assert_close(told.expected(torch.eye(size).double()), matrix.mT)
    torch.testing.assert_close(matrix.sum(1), torch.ones(size).double())
    moves = [1.0]
    for _ in range(places):
        longer = [0.0] * (len(moves) + 2)
        for i, share in enumerate(moves):
            for j, part in enumerate(ONE):
                longer[i + j] += share * part
        moves = longer
    literal = torch.tensor(Steps(6, moves, 0.01, 0.02, 0.1, 0.1, directions).transitions()).double()
    own = torch.eye(6 * directions).double().repeat(motion.chains, 1)
    own = torch.block_diag(own, torch.ones(1, 1).double())  # of each state, that of a single chain
    torch.testing.assert_close(matrix @ own, own @ literal)


def irregular(frames, places):
    """A drive that moves on by 0 to 4 places, and its moves."""
    draw = torch.Generator().manual_seed(3)
    moved = torch.randint(0, 5, (frames,), generator=draw)
    moved[0] = 0
    at = moved.cumsum(0)
    kept = at < places
    return at[kept], moved[kept].double()


@torch.no_grad()
@pytest.mark.parametrize("lag", [0, 3])
def test_a_filter_is_told_of_moves_in_batches_of_any_size(lag):
    at, moved = irregular(60, 120)
    moved = moved + 0.3
    scores, filter = shown(120, at.tolist(), clear=2.0), PlaceFilter(lag=lag)
    found = []
    for size in (1, 7, 60):
        state, answers = filter.start(120), []
        for rows, told in zip(scores.split(size), moved.split(size), strict=True):
            own, state = filter.step(rows, state, moved=told)
            answers.append(own)
        answers.append(filter.finish(state)[0])
        found.append(torch.cat(answers))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found[0], found[2], rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_where_nothing_is_told_a_filter_moves_as_without():
    scores, filter = shown(50, [*range(40)]), PlaceFilter()
    unknown = torch.full((40,), math.nan)
    found, _ = filter.step(scores, filter.start(50), moved=unknown)
    torch.testing.assert_close(found, filter.step(scores, filter.start(50))[0])


@pytest.fixture(scope="module")
def route():
    """Descriptors that say little each."""
    return torch.randn(300, 32, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def model(route):
    return DejaVu(whitening="none").learn(route)


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_a_drive_of_irregular_speed_is_found_by_its_moves(model, route, scale):
    at, moved = irregular(150, 300)
    queries = route[at] + 1.5 * torch.randn(len(at), 32, generator=torch.Generator().manual_seed(1))

    def found(**told):
        match = model.localize(queries, sequence=PlaceSmoother(within=2), centre=False, **told)
        assert match.is_drive
        return float(((match.index - at).abs() <= 2).double().mean()), float(match.probability.mean())

    (right, sure), (plain, unsure) = found(moved=scale * moved), found()
    assert right == 1
    assert right > plain
    assert sure > unsure + 0.02


@torch.no_grad()
@pytest.mark.parametrize("scale", [0.87, 1.15])
def test_a_whole_drive_finds_the_scale_of_its_odometry(scale):
    path = torch.arange(0, 280, 2)
    scores = shown(300, path.tolist(), clear=1.0)

    def sure(moved):
        smoother = PlaceSmoother(separation=2.0, moved=torch.full((140,), moved))
        return float(smoother.posterior(scores, noise(140, 16)).gather(1, path[:, None]).mean())

    assert sure(2 * scale) > 0.85 * sure(2.0)


def test_a_filter_and_a_live_one_follow_the_moves(model, route):
    at, moved = irregular(150, 300)
    queries = route[at] + 1.2 * torch.randn(len(at), 32, generator=torch.Generator().manual_seed(1))
    told = model.localize(queries, sequence=PlaceFilter(), moved=moved)
    plain = model.localize(queries, sequence=PlaceFilter())
    right = [float(((one.index - at).abs() <= 2).double().mean()) for one in (told, plain)]
    assert right[0] > max(0.8, right[1])
    live = LiveLocalizer(model, PlaceFilter())
    found = [live(row, moved=places).place for row, places in zip(queries, moved.tolist(), strict=True)]
    assert found == told.index.tolist()


def test_a_csv_of_moves(model, route, tmp_path):
    at, moved = irregular(150, 300)
    queries = route[at] + 1.2 * torch.randn(len(at), 32, generator=torch.Generator().manual_seed(1))
    np.save(tmp_path / "query.npy", queries.numpy())
    model.save(tmp_path / "map.safetensors")
    with (tmp_path / "moved.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("frame", "moved"), *enumerate(moved.tolist())])
    command = ["localize", tmp_path / "map.safetensors", tmp_path / "query.npy", "--match", "filter"]
    run(*command, "--moved", tmp_path / "moved.csv", "--out", tmp_path / "m.csv")
    with (tmp_path / "m.csv").open() as file:
        found = [int(row["place"]) for row in csv.DictReader(file)]
    assert found == model.localize(queries, sequence=PlaceFilter(), moved=moved).index.tolist()


def metres(moved, spread=math.nan, each=0.5):
    """An odometer in metres that tells of these moves in places."""
    variance = torch.full_like(moved, spread * each).square()
    return Odometer(torch.stack([each * moved, variance], 1).cumsum(0), metres=True)


@torch.no_grad()
@pytest.mark.parametrize("noisy", [0.0, 0.2])
@pytest.mark.parametrize("pace", [0.4, 1.0, 2.7, 5.0])
def test_a_whole_drive_finds_metres_a_place(pace, noisy):
    path = (pace * torch.arange(min(150, int(380 / pace)))).long()
    draw = torch.randn(len(path), generator=torch.Generator().manual_seed(2))
    moved = (path.double().diff(prepend=path[:1].double()) * (1 + noisy * draw)).clamp(min=0)
    scores = shown(400, path.tolist(), clear=3.0)
    smoother = PlaceSmoother(separation=3.0, moved=metres(moved, each=7.3))
    posterior = smoother.posterior(scores, noise(len(path), 16))
    assert float(((posterior[:, :-1].argmax(1) - path).abs() <= 3).double().mean()) > 0.95


def test_a_camera_that_stands_has_any_scale():
    smoother = PlaceSmoother(moved=metres(torch.zeros(30).double()))
    posterior = smoother.posterior(shown(50, [20] * 30, clear=3.0), noise(30, 16))
    assert posterior.sum(1).tolist() == pytest.approx([1] * 30)
    assert len(smoother.posterior(noise(0, 50))) == 0


def test_a_spread_widens_a_step_in_the_unit_of_its_odometer():
    """The share s of a place that is missed or passed twice gives n places the variance n s."""
    way, spread = torch.tensor([4.0, 4, 1, 0, 0, 2]), torch.tensor([1.0, 2, 0.3, 1, 0, math.nan])
    assert odometry.slips(way, spread).tolist() == pytest.approx([0.25, 1, 0.09, 1, 0, chosen.ODOMETRY])
    states, rates = States(60, 1), Rates(*(torch.tensor(one).double() for one in ([1.0], 0, 0, 0)))
    moved = odometry.moving(states, rates, 4, 0.25).moved(torch.eye(61)[10].double())[:-1]
    at = torch.arange(60).double()
    mean = (moved * at).sum()
    assert float(mean) == pytest.approx(14)
    assert float((moved * (at - mean) ** 2).sum()) == pytest.approx(1)
    odometer = metres(torch.full((9,), 2.0).double(), 0.6).times(2.0)
    assert not odometer.metres
    assert torch.allclose(odometer.moves[1:], torch.tensor([2.0, 0.6]).double())
    whole_drive = odometer.between(0, -1)
    assert float(odometry.slips(*whole_drive)) == pytest.approx(0.18)


@torch.no_grad()
@pytest.mark.parametrize("kind", ["filter", "drive"])
def test_odometry_that_is_said_to_be_poor_is_believed_less(kind):
    """Moves of three places and four more or less, of a camera that moves by three."""
    path = torch.arange(0, 300, 3)
    off = torch.randint(-1, 2, (100,), generator=torch.Generator().manual_seed(1))
    moved, scores = (3 + 2 * off).double(), shown(320, path.tolist(), clear=1.5)

    def sure(spread):
        told = moved, torch.full((100,), spread).double()
        if kind == "drive":
            posterior = PlaceSmoother(separation=2.0, moved=told).posterior(scores, noise(100, 16))
            return float(posterior.gather(1, path[:, None]).log().mean())
        model = PlaceFilter(within=0)
        found, _ = model.step(scores, model.start(320), moved=told)
        return float(-found.gather(1, path[:, None]).mean())

    assert sure(1.7) > sure(0.1) + 0.1


def test_a_source_tells_how_far_it_moved(model, route, tmp_path, caplog):
    """By a column of its coordinates' file, or by these, where the reference tells metres a place."""
    at, moved = irregular(150, 300)
    queries = route[at] + 1.2 * torch.randn(len(at), 32, generator=torch.Generator().manual_seed(1))
    expected = model.localize(queries, sequence=PlaceFilter(), moved=moved)
    np.save(tmp_path / "query.npy", queries.numpy())
    np.save(tmp_path / "map.npy", route.numpy())
    named = [f"{2 * float(place)},0,{one}" for place, one in zip(at, moved, strict=True)]
    (tmp_path / "query.csv").write_text("\n".join(["x,y,moved", *named]))
    (tmp_path / "map.csv").write_text("\n".join(["x,y", *(f"0,{2 * i}" for i in range(300))]))
    source, reference = (f"{tmp_path / one}.npy?coordinates={tmp_path / one}.csv" for one in ("query", "map"))
    found = model.localize(source, sequence=PlaceFilter())
    assert torch.equal(found.index, expected.index)
    for each in (2, "2.0", reference):
        querying = Querying(PlaceFilter(), moved="coordinates", metres_per_place=each)
        (match,) = model.matches(source, querying)
        assert torch.equal(match.index, expected.index)
    drive = model.localize(source, sequence=PlaceSmoother(), moved="coordinates")
    assert float(((drive.index - at).abs() <= 2).double().mean()) > 0.95
    assert all("the column moved is read as odometry" in one.getMessage() for one in caplog.records)
    model.localize(source, sequence=None)
    assert "moved is not used: places moved, and single images" in caplog.text
    with refused("metres moved, and a filter", "--metres_per_place"):
        model.localize(source, sequence=PlaceFilter(), moved="coordinates")
    for each, told in (
        (0, "0 metres a place"),
        (-1, "a number above 0"),
        (tmp_path / "map.npy", "coordinates"),
    ):
        with refused(told):
            [*model.matches(source, Querying(PlaceFilter(), moved="coordinates", metres_per_place=str(each)))]
    with refused("and moves in places", "metres"):
        [*model.matches(source, Querying(PlaceFilter(), metres_per_place=2.0))]


def test_a_large_map_refuses_in_a_line_what_a_source_has_not_asked_for(model, route, monkeypatch, caplog):
    monkeypatch.setattr(large, "LARGE_MAP", 200)
    at, moved = irregular(150, 300)
    queries = ArrayTraverse(route[at])
    with refused(
        f"places moved, and {len(at)} queries on 300 places", "a route of fewer places, or", "a filter"
    ):
        model.localize(queries, sequence=PlaceSmoother(), moved=moved)
    queries.odometer = odometry.checked_moved(moved, len(at))
    assert model.localize(queries, sequence=PlaceSmoother()).is_drive
    assert "its column moved is not used: places moved" in caplog.text


def test_the_speed_of_a_drive(model, route, tmp_path):
    """By its answers: two places a query, back at one, a stop, and a jump."""
    path = [*range(0, 120, 2), *range(118, 60, -1), *[60] * 30, *range(200, 290, 2)]
    right = torch.tensor(path)
    queries = route[right] + 0.3 * torch.randn(len(path), 32, generator=torch.Generator().manual_seed(1))
    match = model.localize(queries, sequence=PlaceSmoother(), centre=False)
    assert match.is_drive
    speed = match.speed.tolist()
    for some, expected in (
        (slice(5, 55), 2),
        (slice(65, 110), -1),
        (slice(125, 142), 0),
        (slice(155, 185), 2),
    ):
        assert speed[some] == pytest.approx([expected] * len(speed[some]), abs=0.2)
    assert float(match[150:160].speed.abs().max()) <= 2.2
    assert model.localize(queries, sequence=PlaceFilter()).speed is None
    found = speed_of(torch.tensor([0, 3, 6, 9]), torch.tensor([0.9, 0.9, 0.2, 0.9]))
    assert found.tolist() == [3, 3, 3, 3]
    assert bool(speed_of(torch.tensor([0, 3]), torch.tensor([0.9, 0.2])).isnan().all())
    elsewhere = torch.randn(60, 32, generator=torch.Generator().manual_seed(7))
    assert model.localize(elsewhere, sequence=PlaceSmoother()).speed is None
    write_matches(tmp_path / "m.csv", [match])
    with (tmp_path / "m.csv").open() as file:
        written = [float(row["speed"]) for row in csv.DictReader(file)]
    assert written == pytest.approx(speed, abs=0.01)


def test_a_comparison_by_odometry(route, tmp_path):
    at, moved = irregular(150, 300)
    queries = route[at] + 1.5 * torch.randn(len(at), 32, generator=torch.Generator().manual_seed(1))
    truth = {query: [int(place)] for query, place in enumerate(at)}
    (tmp_path / "t.csv").write_text("query,place\n" + "\n".join(f"{q},{p[0]}" for q, p in truth.items()))

    def scores(**told):
        model = DejaVu(whitening="none")
        querying = Querying("drive", centre="none", **told)
        found = compare(route, queries, str(tmp_path / "t.csv"), model, querying=querying).report
        return found.ours.sequences, found.facts["drive"]

    (plain, _), (told, drive) = scores(), scores(moved=moved)
    assert told["filter"].auc > plain["filter"].auc + 0.05
    assert told["smoother"].auc > 0.95
    assert drive["speed"] == pytest.approx(float(moved.mean()), abs=0.4)
    in_metres, _ = scores(moved=metres(moved))  # which only the drive can use
    assert in_metres["smoother"].auc == pytest.approx(told["smoother"].auc, abs=0.02)
    assert in_metres["filter"] == plain["filter"]


class Own(AlongRoute):
    """A motion of one's own."""


@torch.no_grad()
def test_a_gap_and_moves_beyond_the_map():
    """Of more places than a block has, and than there are."""
    moved = torch.full((60,), 2.0)
    moved[0], moved[30] = 1e6, 600  # the first does not count
    path = [2 * t if t < 30 else 660 + 2 * (t - 30) for t in range(60)]
    scores = shown(800, path, clear=3.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "NUMBERS_AT_ONCE", 2**12)
        posterior = PlaceSmoother(moved=moved).posterior(scores, noise(60, 16))
    assert float(((posterior[:, :-1].argmax(1) - torch.tensor(path)).abs() <= 2).double().mean()) > 0.9
    found = PlaceSmoother(moved=moved).posterior(noise(60, 9), noise(60, 16))
    assert found.isfinite().all()


def test_drives_with_the_same_moves_are_matched_together():
    scores, smoother = shown(80, [*range(60)]), PlaceSmoother(moved=torch.ones(60))
    scorer = OfRows(rows_of(scores), noise(60, 16), Layout(80))
    one, two = localize_drives([DriveQuery(scorer, smoother), DriveQuery(scorer, smoother)])
    assert torch.equal(one.index, two.index)
    assert float(((one.index[:, 0] - torch.arange(60)).abs() <= 2).double().mean()) > 0.9


def test_what_cannot_be_moves_is_refused(model, route, tmp_path):
    queries, fits = route[:20], torch.ones(20)
    smoother = PlaceSmoother()
    with refused("moved is (19,) for 20 queries", "as many"):
        model.localize(queries, sequence=smoother, moved=fits[1:])
    with refused("moved is -1 at query 3", "0 to 1000"):
        model.localize(queries, sequence=smoother, moved=torch.where(torch.arange(20) == 3, -1.0, 1.0))
    with refused("moved is 475.9", "at most 100"):
        model.localize(queries, sequence=smoother, moved=501 * fits)
    with refused("moved is nan at query 2"):
        model.localize(queries, sequence=smoother, moved=fits.index_fill(0, torch.tensor(2), math.nan))
    for wrong in (19, 21):
        with refused(f"moved is of {wrong} queries", "20 queries"):
            model.localize(queries, sequence=smoother, moved=Odometer(torch.zeros(wrong, 2)))
        with refused(f"moved is ({wrong},) for 20 queries"):
            model.localize(queries, sequence=PlaceSmoother(moved=torch.ones(wrong)))
    with refused("a path, and places moved", "posterior"):
        PlaceSmoother(moved=fits).path(noise(20, 30))
    with refused("a motion of one's own"):
        PlaceSmoother(moved=fits, motion=Own).posterior(noise(20, 30))
    for sequence in (None, SequenceMatcher(3)):
        with refused("places moved, and single images", "a drive or a filter"):
            model.localize(queries, sequence=sequence, moved=fits)
    with refused("moved 1 without a filter", "PlaceFilter"):
        LiveLocalizer(model, None)(route[0], moved=1.0)
    with refused("moved is inf", "0 to 1000"):
        LiveLocalizer(model)(route[0], moved=math.inf)


@torch.no_grad()
@pytest.mark.parametrize("filter", [PlaceFilter(learns=True), PlaceFilter().over(Layout(5, 10))])
def test_a_filter_that_learns_its_moves_still_does(filter):
    """Where something else is told of each query."""
    scores = shown(50, [t // 3 for t in range(90)])
    found, _ = filter.step(scores, filter.start(50), absent=torch.zeros(90))
    torch.testing.assert_close(found, filter.step(scores, filter.start(50))[0])
    if filter.layout.dimensions == 2:
        with refused("places moved, and the map of an area", "a route"):
            filter.step(scores, filter.start(50), moved=torch.ones(90))


def test_limits_are_of_places_not_of_metres(route):
    """A train has more than 100 metres to a frame, and a tunnel more than 1000."""
    at, moved = irregular(150, 300)
    metres, source = 500.0 * torch.cat([moved[:1] * 0, moved[1:]]).double(), ArrayTraverse(route[at])
    odometer = Odometer(torch.stack([metres, metres * math.nan], 1).cumsum(0), True)
    assert moves_of(source, odometer, None) is odometer
    assert torch.allclose(moves_of(source, odometer, 500).moves[1:, 0], moved[1:].double())
    for each in (0.1, 1e-300):
        with refused("moved is"):
            moves_of(source, odometer, each)


def test_coordinates_that_begin_late_and_end_early_move_evenly_there(route):
    """As of a receiver that has no fix yet; it was refused as nan."""
    at = torch.stack([2.0 * torch.arange(40), torch.zeros(40)], 1).double()
    at[:11], at[20], at[35:] = math.nan, math.nan, math.nan
    source = ArrayTraverse(route[:40]).changed(coordinates=Coordinates(at))
    odometer = moves_of(source, "coordinates", None)
    assert odometer.moves[1:, 0].tolist() == pytest.approx([2.0] * 39)
