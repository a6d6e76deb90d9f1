"""Views of a query: a camera that points a little further right or left than at learning."""

from __future__ import annotations

import copy
import csv
import json
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from command_line import run
from helpers import refused

from dejavu_torch import (
    DejaVu,
    LiveLocalizer,
    Match,
    PlaceFilter,
    SpectralMapper,
    Whitening,
    compare,
    open_source,
)
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.moving import Moved, moved, unmoved
from dejavu_torch.data.traverse import Part, chained
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.export import export_onnx, run_session, session_of
from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.growth import calibrate_if_possible, merge, second_traverse
from dejavu_torch.places.layout import ROUTE
from dejavu_torch.recognition.querying import Querying, Sequences
from dejavu_torch.recognition.scorer import BestOf, OfMap, OfRows, OfStored, Reordered
from dejavu_torch.recognition.views import (
    ALONE,
    FIRST,
    SHIFTS,
    BestView,
    Views,
    degrees,
    penalties_of,
    shift_of,
)
from dejavu_torch.teaching import refine, straightened

PLACES, WIDE, SIDE = 130, 112, 64  # pixels of the scenes, and of what a camera sees of them
OFFSET = 8 / SIDE  # by which it points further right on the second visit


def visit(number, offset=0.0, places=PLACES):
    """A drive through scenes that follow each other slowly, by a camera that points further right."""
    draw = torch.Generator().manual_seed(0)
    scenes = torch.randn(PLACES // 5 + 2, 1, 8, WIDE // 4, generator=draw)
    scenes = F.interpolate(scenes, (32, WIDE), mode="bicubic")
    at = torch.arange(places) / 5
    low, share = at.long(), (at % 1).view(-1, 1, 1, 1)
    frames = scenes[low] * (1 - share) + scenes[low + 1] * share
    noise = torch.randn(frames.shape, generator=torch.Generator().manual_seed(1 + number))
    first = (WIDE - SIDE) // 2 + round(offset * SIDE)
    frames = (0.5 + 0.2 * frames + 0.03 * noise)[..., first : first + SIDE].clamp(0, 1)
    drive = ArrayTraverse(frames, f"visit {number}")
    drive.ordered = True
    return drive


def small():
    return DejaVu(whitening=Whitening(48, views=1))


@pytest.fixture(scope="module")
def model():
    return small().learn(visit(0)).calibrate(visit(0))


def found(match):
    return float(((match.index - torch.arange(len(match))).abs() <= 5).double().mean())


def literally_moved(frame, shift):
    """A frame (C,H,W) of numpy, moved sideways pixel by pixel."""
    out, width = np.zeros_like(frame), frame.shape[2]
    for x in range(width):
        at = x - shift * width
        low = math.floor(at)
        for column, weight in ((low, 1 - (at - low)), (low + 1, at - low)):
            column = -1 - column if column < 0 else column
            column = 2 * width - 1 - column if column >= width else column
            out[:, :, x] += weight * frame[:, :, column]
    return out


@pytest.mark.parametrize("shift", [0.0, 0.125, -0.125, 0.1, -0.23])
def test_frames_are_moved_and_reflected_at_their_borders(shift):
    frames = torch.rand(2, 3, 4, 16)
    expected = np.stack([literally_moved(frame, shift) for frame in frames.numpy()])
    assert np.allclose(moved(frames, [shift]), expected, atol=1e-6)
    traverse = Moved(ArrayTraverse(frames), (0.0, shift))
    assert len(traverse) == 4
    assert torch.equal(traverse[[0, 2]], frames)
    assert np.allclose(traverse[[1, 3]], expected, atol=1e-6)


def test_a_camera_that_points_right_sees_what_lies_there():
    wide = torch.rand(1, 1, 8, 96)
    straight, right = wide[..., 16:80], wide[..., 24:88]
    assert torch.allclose(moved(right, [8 / 64])[..., 8:], straight[..., 8:], atol=1e-6)


@pytest.mark.parametrize("bins", ["hard", "linear"])
@pytest.mark.parametrize("cell", [8, 6, 5])
def test_hog_moves_by_whole_cells_as_pictures_do(cell, bins):
    frames, hog = torch.rand(3, 1, 4 * cell, 8 * cell), HOG(cell=cell, bins=bins)
    features = hog.moved(frames, [0.0, 1 / 8])
    assert torch.allclose(features[:, 0], hog(frames), atol=1e-5)
    of_pictures = hog(moved(frames, [1 / 8]))
    inside = torch.zeros(3, 7, dtype=torch.bool)
    inside[:, 2:6] = True  # blocks without the pixels at the borders of either
    inside = inside.flatten().repeat_interleave(36)
    assert torch.allclose(features[:, 1, inside], of_pictures[:, inside], atol=1e-5)


def test_a_mirrored_picture_moves_the_other_way():
    frames, hog = torch.rand(2, 1, 32, 64), HOG(bins="linear")
    right, left = hog.moved(frames, [0.11]), hog.moved(frames.flip(3), [-0.11])
    mirrored = left.view(2, 3, 7, 2, 2, 9).flip(2).flip(4).flip(5).flatten(1)
    assert torch.allclose(right[:, 0], mirrored, atol=1e-5)


def test_a_reflected_cell_has_mirrored_edges():
    across = torch.arange(64) + torch.arange(32)[:, None]
    stripes = (across / 3).sin()[None, None] / 2 + 0.5  # whose gradient points to 45 degrees
    blocks = HOG(orientations=6).moved(stripes, [1 / 8])[0, 0].view(3, 7, 2, 2, 6)
    assert blocks[1, 3, 0, 0].argmax() == 1
    assert blocks[1, 0, 0, 0].argmax() == 4


def test_the_network_moves_its_maps():
    frames, net = torch.rand(2, 3, 96, 96), Distilled()
    features = net.moved(frames, [0.0, 1 / 6])
    assert torch.allclose(features[:, 0], net(frames), atol=1e-5)
    cells = features.view(2, 2, 40, 6, 6)
    assert torch.allclose(cells[:, 1, ..., 1:], cells[:, 0, ..., :-1], atol=1e-5)


def test_other_features_are_those_of_moved_pictures():
    frames, pixels = torch.rand(2, 1, 32, 64), PatchPixels()
    features = Joined([HOG(), pixels]).moved(frames, [0.0, 0.1])
    assert features.shape == (2, 2, HOG()(frames).shape[1] + pixels(frames).shape[1])
    expected = pixels(moved(frames, [0.0, 0.1])).view(2, 2, -1)
    assert torch.allclose(features[..., -expected.shape[2] :], expected, atol=1e-5)


@pytest.mark.parametrize("features", [HOG(), PatchPixels()])
def test_copies_of_a_traverse_are_described_together(features):
    frames = torch.rand(5, 1, 32, 64)
    frames[3] = 0.5  # shows nothing
    descriptor, shifts = Descriptor(features=features, batch_size=2), (0.0, 0.125, -0.04)
    seen = []
    rows = descriptor.all_of(Moved(ArrayTraverse(frames), shifts), False, lambda f, x: seen.append(x.shape))
    assert torch.allclose(rows.view(5, 3, -1), descriptor.describe_moved(frames, shifts), atol=1e-5)
    assert torch.allclose(rows[::3], descriptor(frames), atol=1e-5)
    assert (rows[9:12] == 0).all()
    assert seen == [(2, rows.shape[1])]


def test_moved_features_have_gradients():
    frames = torch.rand(1, 1, 16, 32, dtype=torch.float64, requires_grad=True)
    hog = HOG(cell=4, bins="linear")
    assert torch.autograd.gradcheck(lambda x: hog.moved(x, [0.1])[:, :, ::7], frames, eps=1e-7, atol=1e-3)


def scorer_of(scores):
    """Of rows (Q,N), each query with so many copies."""
    return OfRows(
        lambda queries: scores[queries], torch.zeros(len(scores), 1), ROUTE.reaching(scores.shape[1])
    )


def test_the_best_copy_answers_after_its_penalty():
    scores = torch.rand(12, 30)
    best = BestOf(scorer_of(scores), 3, torch.tensor([0.0, 0.2, math.inf]))
    pairs = scores.view(4, 3, 30)
    expected = torch.minimum(pairs[:, 0], pairs[:, 1] + 0.2)
    assert torch.allclose(best.rows(torch.arange(4)), expected)
    assert torch.allclose(best.rows(torch.tensor([2])), expected[2:3])
    before = torch.tensor([0.0, math.inf, 0.1])
    first = BestOf(scorer_of(scores), 3, torch.tensor([0.0, 0.2, math.inf]), before, 2)
    assert torch.allclose(first.rows(torch.arange(2, 4)), expected[2:])
    assert torch.allclose(first.rows(torch.arange(2)), torch.minimum(pairs[:2, 0], pairs[:2, 2] + 0.1))


def test_penalties_are_in_units_of_the_scores():
    rows = torch.rand(40, 6)
    penalties = torch.tensor([0.0, 0.1])
    for metric in ("cosine", "l1"):
        small = BestOf(OfStored(rows, rows[:8], metric=metric), 2, penalties)
        large = BestOf(OfStored(10 * rows, 10 * rows[:8], metric=metric), 2, penalties)
        own, other = (one.rows(torch.arange(4)) for one in (small, large))
        assert torch.allclose(own, other / (1 if metric == "cosine" else 10), atol=1e-4)


def pairs_of(answers, copies, places=400):
    """The two best places of copies: of query i, copy answers[i] finds place i surely, others look around."""
    draw = torch.Generator().manual_seed(0)
    count = len(answers)
    index = torch.randint(places, (count, copies, 2), generator=draw)
    score = 0.6 + 0.1 * torch.rand(count, copies, 2, generator=draw).sort(2).values
    for i, view in enumerate(answers):
        index[i, view, 0], score[i, view, 0] = i, 0.1 + 0.3 * float(torch.rand(1, generator=draw))
    pair = Match(index.flatten(1), score.flatten(1), torch.ones(count, 2 * copies, dtype=torch.bool))
    return pair, ROUTE.reaching(places)


def test_rare_views_cost_more_and_chance_ones_are_left_out():
    answers = [0] * 30 + [1] * 60 + [2] * 40 + [3]
    penalties = penalties_of(*pairs_of(answers, 13))
    assert penalties.isfinite().tolist() == [True, True, True] + 10 * [False]
    assert penalties[1] == 0
    assert penalties[2] > 0


def test_views_are_left_out_unless_answers_follow_each_other_more_often():
    pairs, layout = pairs_of([i // 30 for i in range(60)], 2)
    assert penalties_of(pairs, layout).isfinite().all()
    for found in (lambda i: 300, lambda i: 150 + 90 * (i % 3)):  # where a camera stands, or jumps
        index = pairs.index.view(60, 2, 2).clone()
        index[30:, 1, 0] = torch.tensor([found(i) for i in range(30, 60)])
        jumping = Match(index.flatten(1), pairs.score, pairs.accepted)
        assert penalties_of(jumping, layout).isfinite().tolist() == [True, False]


@pytest.mark.parametrize("shift", [0.0, 0.013, -0.1, 0.2, 0.24, -0.24])
def test_a_shift_lies_between_the_views(shift):
    scores = 0.3 + (torch.tensor(SHIFTS) - shift).square()[None]
    assert shift_of(scores, SHIFTS)[0] == pytest.approx(shift, abs=1e-4)
    assert shift_of(torch.full((1, len(SHIFTS)), 0.3), SHIFTS).isnan()
    assert shift_of(torch.tensor([[0.5, 0.3]]), (0.0, 0.1))[0] == pytest.approx(0.1)


def test_degrees_by_the_field_of_view():
    told = degrees(torch.tensor([0.5, -0.1]), 60)
    expected = [30, -math.degrees(math.atan(0.2 * math.tan(math.pi / 6)))]
    assert told.tolist() == pytest.approx(expected, abs=1e-4)


def test_a_drive_learns_where_its_camera_points(model):
    drive = visit(1, OFFSET)
    plain, auto = (model.localize(drive, shifts=shifts) for shifts in ("none", "auto"))
    assert plain.shift is None
    assert found(auto) >= max(0.95, found(plain))
    assert float(auto.shift.median()) == pytest.approx(OFFSET, abs=0.02)
    left = model.localize(visit(1, -OFFSET))
    assert float(left.shift.median()) == pytest.approx(-OFFSET, abs=0.02)


def test_single_images_of_a_drive_gain(model):
    drive = visit(1, OFFSET)
    shares = [
        found(Match.joined(model.matches(drive, Querying(match="single", ordered=True, shifts=shifts))))
        for shifts in ("none", "auto")
    ]
    assert shares[1] >= shares[0] + 0.1


def test_a_camera_that_points_as_before_changes_nothing(model):
    plain, auto = (model.localize(visit(1), shifts=shifts) for shifts in ("none", "auto"))
    assert auto.shift is None
    assert torch.equal(plain.index, auto.index)
    assert torch.equal(plain.score, auto.score)


def test_what_is_not_in_order_is_compared_as_it_is(model):
    plain = Match.joined(model.matches(visit(1, OFFSET), Querying(unordered=True)))
    assert plain.shift is None
    few = Part(visit(1, OFFSET), range(39))
    assert model.localize(few, sequence=None).shift is None


def test_given_shifts_are_compared(model):
    asked = Querying(unordered=True, shifts=[OFFSET])
    match = Match.joined(model.matches(visit(1, OFFSET), asked))
    plain = Match.joined(model.matches(visit(1, OFFSET), Querying(unordered=True)))
    assert found(match) >= found(plain) + 0.1
    assert float(match.shift.median()) == pytest.approx(OFFSET)
    one = Match.joined(model.matches(Part(visit(1, OFFSET), range(70, 71)), asked))
    assert one.index[0] == match.index[70]
    assert one.score[0] == pytest.approx(float(match.score[70]), abs=1e-5)


def test_candidates_have_the_answers_of_localize(model):
    drive = visit(1, OFFSET)
    top = model.candidates(drive, 3)
    assert torch.equal(top.index[:, 0], model.localize(drive).index)
    assert top.shift.shape == (PLACES, 3)
    assert top.shift[:, 1:].isnan().all()


@pytest.mark.parametrize("sequence", [PlaceFilter(), None])
@pytest.mark.parametrize("centre", [False, True])
def test_live_learns_the_views_as_it_drives(model, sequence, centre):
    drive = visit(1, OFFSET)
    live = LiveLocalizer(model, sequence, centre=centre)
    answers = [live(frame) for frame in drive]
    before, after = answers[:FIRST], answers[FIRST:]
    right = [abs(answer.place - i) <= 5 for i, answer in enumerate(after, FIRST)]
    assert np.mean(right) >= 0.9
    assert np.median([answer.shift for answer in after]) == pytest.approx(OFFSET, abs=0.02)
    none = LiveLocalizer(model, sequence, centre=centre, looking=Sequences(shifts="none"))
    assert [none(frame).place for frame in drive][:FIRST] == [answer.place for answer in before]


def test_a_filter_answers_as_it_does_live(model):
    drive = visit(1, OFFSET)
    match, live = model.localize(drive, sequence=PlaceFilter()), LiveLocalizer(model)
    answers = [live(frame) for frame in drive]
    assert [answer.place for answer in answers] == match.index.tolist()
    assert [answer.score for answer in answers] == pytest.approx(match.score.tolist(), abs=1e-4)
    report = compare(visit(0), drive, "0", model, querying=Querying(match="filter", ordered=True))
    assert report.run.match.index.tolist() == match.index.tolist()


def test_a_filter_whose_given_views_are_of_no_use_answers_each_query(model):
    for drive in (visit(1), Part(visit(1), range(105))):
        match = model.localize(drive, sequence=PlaceFilter(), shifts=[0.1])
        assert len(match) == len(drive)
        assert found(match) >= 0.95


def test_live_describes_one_view_where_no_other_is_of_use(model, monkeypatch):
    live, seen = LiveLocalizer(model), []
    own = Descriptor.describe_moved
    monkeypatch.setattr(Descriptor, "describe_moved", lambda *args: seen.append(1) or own(*args))
    for frame in visit(1):
        live(frame)
    assert len(seen) == FIRST
    live.reset()
    live(visit(1)[0])
    assert len(seen) == FIRST + 1


def test_a_visit_shows_the_views_of_single_images(tmp_path, model):
    places = torch.arange(PLACES)
    own = small().learn(visit(0))
    assert own.views is None
    own.calibrate(visit(0), LabelledFrames(visit(2, OFFSET), places))
    assert dict(zip(*own.views.known, strict=True))[0.12] == 0
    images = Querying(unordered=True)
    match = Match.joined(own.matches(visit(1, OFFSET), images))
    plain = Match.joined(own.matches(visit(1, OFFSET), Querying(unordered=True, shifts="none")))
    assert found(match) >= found(plain) + 0.1
    alone = Match.joined(own.matches(Part(visit(1, OFFSET), range(9, 10)), images))
    assert alone.index[0] == match.index[9]
    as_before = Match.joined(own.matches(visit(3), images))  # another camera may still have taken one
    assert found(as_before) >= 0.9
    own.save(tmp_path / "map.safetensors")
    loaded = DejaVu.load(tmp_path / "map.safetensors")
    assert loaded.views == own.views
    assert torch.equal(Match.joined(loaded.matches(visit(1, OFFSET), images)).index, match.index)
    exported = export_onnx(own, tmp_path / "map.onnx")
    assert exported.facts["views"].keys() == {str(shift) for shift in own.views.shifts}
    scores = run_session(session_of(tmp_path / "map.onnx"), visit(1, OFFSET)[:])
    assert torch.allclose(scores.amin(1), match.score, atol=1e-3)


def test_penalties_of_exported_views_are_in_units_of_the_scores(tmp_path):
    own = DejaVu(whitening=Whitening(48, views=1), mapper=SpectralMapper(metric="l2")).learn(visit(0))
    export_onnx(own, tmp_path / "map.onnx", shifts=[OFFSET])
    scores = run_session(session_of(tmp_path / "map.onnx"), visit(1, OFFSET)[:])
    match = Match.joined(own.matches(visit(1, OFFSET), Querying(unordered=True, shifts=[OFFSET])))
    assert torch.allclose(scores.amin(1), match.score, atol=1e-3, rtol=1e-3)


def test_ready_features_of_images_are_not_described_again():
    rows = torch.randn(PLACES, 16)
    for own in (DejaVu(whitening="none"), DejaVu()):
        second = LabelledFrames(visit(2), torch.arange(PLACES))
        assert own.learn_features(rows, visit(0), second).views is None


def test_merged_maps_have_views_if_each_has(model):
    looks = [copy.deepcopy(model) for _ in range(2)]
    for views, expected in ((ALONE, ALONE), (Views((0.0, 0.1), (0.0, 0.1)), None), (None, None)):
        looks[0].views = views
        assert merge(looks, ["one", "two"]).views == expected


def test_a_drive_without_truth_is_placed_by_its_views():
    own = small().learn(visit(0))
    own.calibrate(visit(0))
    calibrate_if_possible(own, visit(0), visit(2, OFFSET))
    assert dict(zip(*own.views.known, strict=True))[0.12] == 0
    assert refine(small().learn(visit(0)), visit(2, OFFSET)).placed == PLACES


def test_a_drive_that_comes_back_with_another_camera_finds_its_loops():
    both = ArrayTraverse(torch.cat([visit(0)[:], visit(1, OFFSET)[:]]), "twice")
    both.ordered = True
    own = small().learn(both)
    alone, match = (own.loops(both, 60, shifts=shifts) for shifts in ("none", "auto"))
    right = [(one.index[PLACES:] - torch.arange(PLACES)).abs() <= 5 for one in (alone, match)]
    assert right[1].double().mean() > right[0].double().mean() + 0.2
    assert not match.accepted[:PLACES].any()
    shift = match.shift[PLACES:][right[1]]
    assert abs(float(shift.nanmedian()) - OFFSET) < 0.02
    (same,) = own.matches(both, Querying(match="drive", loops=60, fov=90))
    assert torch.equal(same.index, match.index)
    assert same.shift_degrees is not None
    given = own.loops(both, 60, shifts=[OFFSET])
    assert ((given.index[PLACES:] - torch.arange(PLACES)).abs() <= 5).double().mean() > 0.9


def test_a_drive_teaches_as_the_camera_before_would_see_it(model):
    moved_back = straightened(model, visit(1, OFFSET))
    assert moved_back.shifts == (0.12,)
    assert straightened(model, visit(1)).name == visit(1).name
    chain = chained([moved_back, visit(1)])
    assert [type(one) for one in unmoved(chain).traverses] == [ArrayTraverse] * 2


def test_whitening_learns_from_frames_that_are_moved_back(model):
    views = second_traverse(small(), visit(0), visit(1, OFFSET))
    assert (views.places >= 0).all()
    assert views.traverse.shifts == (0.12,)
    own = small().learn(visit(0), second=views)
    assert dict(zip(*own.views.known, strict=True))[0.12] == 0  # by the frames as they were


@pytest.mark.parametrize("metric", ["cosine", "l2"])
def test_some_places_have_the_scores_that_all_have(metric):
    rows = torch.randn(90, 12)
    route = SpectralMapper(chunk=32, metric=metric)(rows)
    queries, places = torch.randn(7, 12), torch.randint(90, (7, 3))
    expected = route.scores(queries).gather(1, places)
    assert torch.allclose(route.scores_at(queries, places), expected, atol=1e-5)
    many = queries.repeat(3, 1).double()  # more than the descriptors have numbers
    found = route.scores_at(many, places.repeat(3, 1))
    assert found.dtype == torch.float64
    assert torch.allclose(found, expected.repeat(3, 1).double(), atol=1e-5)
    shuffled = Reordered(OfMap(route, queries), torch.randperm(90))
    expected = shuffled.rows(torch.arange(7)).gather(1, places)
    assert torch.allclose(shuffled.at(torch.arange(7), places), expected, atol=1e-5)


def test_a_camera_that_looks_along_its_way_has_no_views():
    route = open_source("sim:aerial?frames=120")
    own = small().learn(route)
    assert own.views == ALONE
    other = open_source("sim:aerial?frames=120&traverse=1")
    assert own.localize(other).shift is None
    assert own.localize(other, shifts=[0.04]).shift is not None


def test_contenders_have_the_same_views(model):
    given = OfStored(torch.rand(PLACES, 8), torch.rand(PLACES, 8), metric="cosine")
    found = {}
    for shifts in ("none", "auto"):
        querying = Querying(ordered=True, shifts=shifts)
        reporting = Reporting(contenders={"given": ("given", 8, given)})
        found[shifts] = compare(
            visit(0), visit(1, OFFSET), "0", model, querying=querying, reporting=reporting
        )
    plain, report = (found[shifts].report.as_json() for shifts in ("none", "auto"))
    assert "views" not in plain
    assert report["views"]["shift"] == pytest.approx(OFFSET, abs=0.02)
    assert min(report["views"]["penalties"].values()) == 0
    for key in ("uncompressed", "hog", "null"):
        assert report[key]["recall_at_1"] > plain[key]["recall_at_1"]
    assert report["recall_at_1"] > plain["recall_at_1"]
    assert report["given"]["recall_at_1"] == plain["given"]["recall_at_1"]


def test_columns_of_shifts(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for number, offset in ((0, 0), (1, OFFSET)):
        np.save(f"{number}.npy", (255 * visit(number, offset)[0:PLACES][:, 0]).byte().numpy())
    words = ["--whitening.numbers", "48", "--whitening.views", "1"]
    run("learn", "0.npy", "--map", "map.safetensors", *words)
    run("localize", "map.safetensors", "1.npy", "--ordered", "--out", "m.csv", "--fov", "90")
    with open("m.csv") as file:
        rows = [*csv.DictReader(file)]
    shift = float(np.median([float(row["shift"]) for row in rows]))
    assert shift == pytest.approx(OFFSET, abs=0.02)
    turn = float(np.median([float(row["shift_degrees"]) for row in rows]))
    assert turn == pytest.approx(math.degrees(math.atan(2 * shift)), abs=0.1)
    capsys.readouterr()
    run("live", "map.safetensors", "1.npy", "--fov", "90")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    turn = math.degrees(math.atan(2 * lines[-1]["shift"]))
    assert lines[-1]["shift_degrees"] == pytest.approx(turn, abs=0.05)
    run("localize", "map.safetensors", "1.npy", "--ordered", "--out", "n.csv", "--shifts", "none")
    assert "shift" not in (tmp_path / "n.csv").read_text()
    for bad, seen in ((["--shifts", "[.6]"], "0.5"), (["--fov", "180"], "180"), (["--fov", "0"], "above 0")):
        with pytest.raises(SystemExit):
            run("localize", "map.safetensors", "1.npy", "--out", "b.csv", *bad)
        assert seen in capsys.readouterr().err


def test_what_has_no_views_is_refused():
    rows = torch.randn(60, 16)
    ready = DejaVu(whitening="none").learn(rows)
    assert ready.localize(ArrayTraverse(rows)).shift is None
    with refused("shifts [0.1]; expected images, on the spectral map of a route"):
        ready.localize(rows, shifts=[0.1])
    with refused("fov is 90; expected images, on the spectral map of a route"):
        [*ready.matches(rows, Querying(fov=90))]
    with pytest.raises(ValueError, match="expected some up to"):
        Views.given([0.7])


def test_the_unmoved_view_alone_is_no_wrapper():
    scorer = scorer_of(torch.rand(3, 9))
    assert ALONE(scorer) is scorer
    assert Querying().wrappers == ()
    known = Views((0.0, 0.1), (0.0, math.inf))
    assert known.known == ((0.0,), (0.0,))
    assert isinstance(known(scorer_of(torch.rand(4, 9))), BestView)
    assert OfMap(DejaVu(whitening="none").learn(torch.randn(30, 8)).map, torch.zeros(1, 8)).unit == 1
