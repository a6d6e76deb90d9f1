"""Even spacing along the ground, through learning, localizing, truth, files and commands."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import Fixed, refused
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from dejavu_torch import DejaVu, FrequencyLayer, GroundOdometry, ImageFolder
from dejavu_torch.cli import main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import Shown, as_ground_truth, places_of_frames, truth_of_places
from dejavu_torch.data.truthfile import describe_truth, find_truth
from dejavu_torch.evaluation.matches import write_matches
from dejavu_torch.experiments.compare import compare
from dejavu_torch.motion.resampling import ResampledTraverse

SIDE, STEP, CYCLE = 48, 6, 60  # pixels
WHOLE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))  # the camera looks straight down
CORNERS = ["--velocity.corners", "[[0,0],[1,0],[1,1],[0,1]]", "--velocity.size", f"[{SIDE},{SIDE}]"]
OPTIONS = [*CORNERS, "--velocity.step", str(STEP), "--periods.false_alarm", "null"]


def positions(*speeds: tuple[int, int]) -> Tensor:
    """Pixels of ground at each frame, from (pixels per frame, frames)."""
    steps = [speed for speed, frames in speeds for _ in range(frames)]
    return torch.tensor([0, *steps]).cumsum(0)


# both come 603 pixels far; each stands for a while, at another place
REFERENCE = positions((4, 60), (0, 25), (9, 40), (3, 1))
QUERY = positions((8, 45), (0, 10), (5, 48), (3, 1))


def footage(where: Tensor, noise: float = 0.0) -> Tensor:
    """(N,1,48,48) frames over a ground that repeats every 60 pixels and differs a little everywhere."""
    random = torch.Generator().manual_seed(0)
    cycle = torch.rand(1, 1, CYCLE // 4, SIDE // 4, generator=random).repeat(1, 1, 12, 1)
    coarse = 0.5 * cycle + 0.5 * torch.rand(cycle.shape, generator=random)
    ground = interpolate(coarse, scale_factor=4, mode="bicubic")[0, 0]
    last = len(ground) - SIDE  # forward: the ground comes nearer, down the frame
    frames = torch.stack([ground[last - p : last - p + SIDE] for p in where.tolist()])[:, None]
    return (frames + noise * torch.randn(frames.shape, generator=random)).clamp(0, 1)


def camera(**settings: object) -> GroundOdometry:
    return GroundOdometry(WHOLE, (SIDE, SIDE), **{"step": float(STEP), **settings})


def everything(places: int) -> Fixed:
    """A layer that stores every place."""
    return Fixed(FrequencyLayer(places, places, 0, places, tuple(range(900))))


@pytest.fixture(scope="module")
def model() -> DejaVu:
    return DejaVu(periods=everything(101), velocity=camera()).learn(footage(REFERENCE))


def test_convention_11_places_are_even_steps_and_a_stop_adds_none(model: DejaVu) -> None:
    assert model.map.places == 600 // STEP + 1
    where = REFERENCE[model.map.frame.long()]
    assert (where - STEP * torch.arange(101)).abs().max() <= 4.5  # half of the fastest step
    assert not [frame for frame in model.map.frame.tolist() if 60 < frame < 85]  # it stands


def test_queries_are_spaced_by_the_step_of_the_map() -> None:
    model = DejaVu(periods=everything(101), velocity=camera(step=None))
    model.periods = everything(
        len(ResampledTraverse(ArrayTraverse(footage(REFERENCE)), model.velocity).frame)
    )
    model.learn(footage(REFERENCE))
    assert model.step == pytest.approx(4, abs=0.05)  # the median of the moving frames
    match = model.localize(footage(QUERY))
    assert len(match.index) == 600 // 4 + 1  # though the median step of the query is 8
    assert (match.index - torch.arange(151)).abs().max() <= 3  # the query shows each frame twice


def test_another_speed_and_other_stops_are_found(model: DejaVu) -> None:
    match = model.localize(footage(QUERY, noise=0.02))
    assert len(match.index) == 101
    assert (match.index - torch.arange(101)).abs().max() <= 1


def test_a_single_frame_and_ready_features_are_queries_as_they_are(model: DejaVu) -> None:
    frames = footage(torch.tensor([300]))
    assert model.localize(frames).index.tolist() == [50]
    features = model.features(footage(torch.tensor([300, 300])))
    assert model.localize(features).index.tolist() == [50, 50]


def test_a_traverse_that_is_even_already_stays_as_it_is(model: DejaVu) -> None:
    even = model.evenly(ArrayTraverse(footage(QUERY)), model.step)
    assert model.evenly(even, model.step) is even
    alone = DejaVu()
    traverse = ArrayTraverse(footage(QUERY))
    assert alone.evenly(traverse) is traverse


def test_the_file_keeps_the_step_and_the_frames(model: DejaVu, tmp_path: Path) -> None:
    model.save(tmp_path / "map.safetensors")
    again = DejaVu.load(tmp_path / "map.safetensors")
    assert again.step == model.step
    assert repr(again.velocity) == repr(model.velocity)
    assert torch.equal(again.map.frame, model.map.frame)
    for one, other in zip(again.localize(footage(QUERY)), model.localize(footage(QUERY)), strict=True):
        assert torch.equal(one, other)
    empty = DejaVu(velocity=camera())
    empty.load_state_dict(model.state_dict(), strict=False)
    assert empty.step == model.step
    assert model.map_bytes == (tmp_path / "map.safetensors").stat().st_size


def test_a_map_learnt_from_features_takes_queries_as_they_come() -> None:
    features = torch.rand(40, 900)
    model = DejaVu(periods=everything(40), velocity=camera()).learn_features(features)
    assert model.step is None
    assert len(model.map.frame) == 0
    assert len(model.localize(footage(QUERY)).index) == len(QUERY)


def test_ready_features_cannot_be_spaced() -> None:
    with refused("(64, 8)", "ready features show no ground"):
        DejaVu(velocity=camera()).learn(torch.rand(90, 8))


# truth ---------------------------------------------------------------------------------------------------


def shown(queries: int | None = 11) -> Shown:
    """Two queries show frames 3 and 9 of 11; three places show frames 0, 4 and 9 of 12."""
    place_of = torch.tensor([0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 2])
    return Shown(torch.tensor([3, 9]), torch.tensor([0, 4, 9]), place_of, queries)


def test_a_frame_belongs_to_the_place_nearest_to_it() -> None:
    frames = torch.tensor([[0, 2], [3, 7], [8, 11], [-1, 4]])
    assert places_of_frames(frames, shown()).tolist() == [[0, 0], [1, 2], [2, 2], [-1, 1]]
    with refused("frame 12 of the reference", "from 0 to 11"):
        places_of_frames(torch.tensor([12]), shown())


def test_all_places_that_show_the_right_frame_are_right() -> None:
    """16 pixels a frame at a pixel a step: each frame is shown at 16 places."""
    even = ResampledTraverse(ArrayTraverse(footage(positions((16, 12)))), camera(step=1.0))
    where = Shown(None, even.frame, even.place_of)
    right = truth_of_places(as_ground_truth(torch.tensor([[5], [0]])), where).positives
    for row, frame in zip(right, (5, 0), strict=True):
        assert row[row >= 0].tolist() == (even.frame == frame).nonzero()[:, 0].tolist()
    assert 14 <= int((right[0] >= 0).sum()) <= 18


def test_the_way_back_belongs_to_the_places_it_passes() -> None:
    where = positions((6, 50), (-6, 15), (6, 40))
    even = ResampledTraverse(ArrayTraverse(footage(where)), camera())
    assert (even.place_of - where / STEP).abs().max() <= 1
    away = ResampledTraverse(ArrayTraverse(footage(200 + positions((-6, 3), (6, 30)))), camera())
    assert away.place_of[:5].tolist() == [0, -1, -1, -1, -1]  # behind where it began


def test_the_map_knows_the_frames_as_the_traverse_does(model: DejaVu) -> None:
    even = ResampledTraverse(ArrayTraverse(footage(REFERENCE)), camera())
    assert torch.equal(model.map.frame, even.frame)
    assert torch.equal(model.map.place_of, even.place_of)


def test_convention_11_a_csv_says_in_its_header_what_it_counts(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("query_frame,place_frame,place_frame\n3,4\n4,0\n9,11,2\n")
    found = find_truth(str(path), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[1, -1], [2, 0]]
    assert describe_truth(str(path), spaced=True).endswith("which counts frames")
    path.write_text("query,place\n0,2\n1,1\n")
    found = find_truth(str(path), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[2], [1]]
    # where nothing is spaced, frames are places
    path.write_text("query_frame,place_frame\n0,2\n1,1\n")
    found = find_truth(str(path), None, None, 3, 2)
    assert found is not None
    assert found.positives.tolist() == [[2], [1]]


def test_a_frame_that_no_query_shows_tells_of_the_nearest_one_that_does(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("query_frame,place_frame\n1,0\n10,4\n")
    found = find_truth(str(path), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[0], [1]]
    assert found.judged.all()


def test_frames_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("query_frame,place_frame\n3,99999\n")
    with refused("frame 99999 of the reference", "from 0 to 11"):
        find_truth(str(path), None, None, 3, 2, shown=shown())
    path.write_text("query_frame,place_frame\n11,1\n")
    with refused("lists query frame 11", "from 0 to 10"):
        find_truth(str(path), None, None, 3, 2, shown=shown())
    path.write_text("query,place\n1,8\n")
    with refused("place 8", "query_frame,place_frame"):
        find_truth(str(path), None, None, 3, 2, shown=shown())


def test_a_csv_of_frames_is_interpolated_between_frames(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("query_frame,place_frame\n0,0\n10,11\n")
    found = find_truth(str(path), None, None, 3, 2, interpolate=True, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[1], [2]]  # frames 3 and 10 of the reference


@pytest.mark.parametrize("head", ["query_frame,place", "query,place_frame", "query_frame,place_frame,place"])
def test_a_csv_that_mixes_frames_and_places_is_refused(tmp_path: Path, head: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(f"{head}\n0,2\n")
    with refused("truth.csv, line 1", "query_frame,place_frame"):
        find_truth(str(path), None, None, 3, 2, shown=shown())


def test_matrices_as_large_as_the_traverses_are_of_frames(tmp_path: Path) -> None:
    hard, soft = np.zeros((12, 11), bool), np.zeros((12, 11), bool)
    hard[11, 3] = hard[0, 9] = hard[5, 0] = soft[4, 3] = True
    np.savez(tmp_path / "frames.npz", GThard=hard, GTsoft=soft)
    for count in (11, None):
        found = find_truth(str(tmp_path / "frames.npz"), None, None, 3, 2, shown=shown(count))
        assert found is not None
        assert found.positives.tolist() == [[2], [0]]
        assert found.ignored.tolist() == [[1], [-1]]
    np.savez(tmp_path / "places.npz", GThard=np.eye(3, 2, dtype=bool))
    found = find_truth(str(tmp_path / "places.npz"), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[0], [1]]
    np.savez(tmp_path / "number.npz", GThard=np.array(True))
    with refused("number.npz", "expected a matrix"):
        find_truth(str(tmp_path / "number.npz"), None, None, 3, 2, shown=shown())
    np.savez(tmp_path / "neither.npz", GThard=np.eye(5, 6, dtype=bool))
    with refused("(5, 6)", "(3, 2)"):
        find_truth(str(tmp_path / "neither.npz"), None, None, 3, 2, shown=shown())


def test_coordinates_are_of_frames(tmp_path: Path) -> None:
    for name, count, first in (("reference", 12, 0), ("query", 11, 1)):
        (tmp_path / name).mkdir()
        for i in range(count):
            Image.new("L", (8, 8)).save(tmp_path / name / f"@{10 * (first + i)}@0@{i:03}@.png")
    folders = [ImageFolder(tmp_path / name) for name in ("reference", "query")]
    found = find_truth("utm:1", *folders, 3, 2, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[1], [2]]  # frames 4 and 10 of the reference


def test_as_many_even_steps_are_no_truth() -> None:
    pair = ArrayTraverse(torch.rand(12, 3)), ArrayTraverse(torch.rand(11, 3))
    assert find_truth(None, *pair, 2, 2, shown=shown()) is None


def test_queries_as_they_came_have_no_offset_to_even_steps() -> None:
    with refused("queries are frames as they came", "query_frame,place_frame"):
        find_truth("0", None, None, 3, 2, shown=shown()._replace(query=None))


def test_positions_are_of_frames() -> None:
    reference, query = ArrayTraverse(torch.rand(12, 3)), ArrayTraverse(torch.rand(10, 3))
    reference.place, query.place = torch.arange(12.0), torch.arange(10.0) + 1
    found = find_truth(None, reference, query, 3, 2, shown=shown())
    assert found is not None
    assert found.positives.tolist() == [[1], [2]]  # positions 4 and 10


# the commands --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Footage of both traverses, their truth in frames and in places, a map and its matches."""
    folder = tmp_path_factory.mktemp("evenly")
    for name, where, noise in (("reference", REFERENCE, 0.0), ("query", QUERY, 0.02)):
        np.save(folder / f"{name}.npy", (255 * footage(where, noise)[:, 0]).byte().numpy())
    nearest = (REFERENCE - QUERY[:, None]).abs().argmin(1).tolist()
    rows = "".join(f"{q},{p}\n" for q, p in enumerate(nearest))
    (folder / "frames.csv").write_text("query_frame,place_frame\n" + rows)
    (folder / "places.csv").write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(101)))
    main(["learn", f"{folder}/reference.npy", "--map", f"{folder}/m.safetensors", *OPTIONS])
    localize(folder, "matches.csv")
    return folder


def localize(folder: Path, name: str, *options: str) -> list[dict[str, str]]:
    command = ["localize", f"{folder}/m.safetensors", f"{folder}/query.npy", "--out", f"{folder}/{name}"]
    main([*command, *options])
    return list(csv.DictReader((folder / name).open()))


def evaluate_file(folder: Path, truth: str, out: Path, *options: str) -> dict:
    truth = truth if truth.isdigit() else f"{folder}/{truth}"
    main(["evaluate", f"{folder}/matches.csv", "--truth", truth, "--out", str(out), *options])
    return json.loads((out / "report.json").read_text())


def test_convention_11_matches_name_the_frames_as_well(folder: Path) -> None:
    rows = localize(folder, "again.csv")
    assert list(rows[0]) == ["query", "place", "score", "accepted", "query_frame", "place_frame"]
    assert [int(row["query"]) for row in rows] == list(range(101))
    for row in rows:
        assert abs(int(QUERY[int(row["query_frame"])]) - STEP * int(row["query"])) <= 4
        assert abs(int(REFERENCE[int(row["place_frame"])]) - STEP * int(row["place"])) <= 4.5


def test_truth_in_frames_and_in_places_and_positions_agree(folder: Path, tmp_path: Path) -> None:
    given = ["--map", f"{folder}/m.safetensors"]
    reports = [
        evaluate_file(folder, truth, tmp_path / f"{k}", *given)
        for k, truth in enumerate(("frames.csv", "places.csv", "0"))
    ]
    assert {report["places"] for report in reports} == {101}
    assert {report["judged"] for report in reports} == {101}
    # tolerance 5; the truths differ by a place at most
    assert max(abs(report["recall_at_1"] - reports[0]["recall_at_1"]) for report in reports) < 0.05
    assert reports[0]["recall_at_1"] > 0.5


def test_compare_is_learn_localize_and_evaluate(folder: Path, tmp_path: Path) -> None:
    pair, truth = [f"{folder}/reference.npy", f"{folder}/query.npy"], ["--truth", f"{folder}/frames.csv"]
    main(["compare", *pair, *truth, "--out", f"{tmp_path}/c", *OPTIONS])
    report = json.loads((tmp_path / "c" / "report.json").read_text())
    alone = evaluate_file(folder, "frames.csv", tmp_path / "e", "--map", f"{folder}/m.safetensors")
    for key in ("auc", "recall_at_1", "recall_at_100_precision", "judged", "accepted_right"):
        assert report[key] == pytest.approx(alone[key], rel=1e-6), key
    assert report["spacing"] == {"step": STEP, "reference_frames": len(REFERENCE), "query_frames": len(QUERY)}
    assert report["frames"] == report["queries"] == 101
    for picture in ("velocity", "ground"):
        assert (tmp_path / "c" / f"{picture}.png").stat().st_size > 1000
    assert (tmp_path / "c" / "matches.csv").read_text() == (folder / "matches.csv").read_text()
    page = (tmp_path / "c" / "index.html").read_text()
    assert "right within 5 evenly spaced places" in page
    assert "even steps of 6 pixels of ground" in page


def test_compare_of_a_single_query_frame() -> None:
    model = DejaVu(periods=everything(101), velocity=camera())
    one = ArrayTraverse(footage(torch.tensor([300])))
    result = compare(ArrayTraverse(footage(REFERENCE)), one, "50", model)
    assert result.match.index.tolist() == [50]
    assert result.report.as_json()["recall_at_1"] == 1.0


def test_learn_and_localize_tell_the_steps(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    localize(folder, "told.csv")
    assert f"{len(QUERY)} frames make 101 even steps of 6 pixels of ground" in capsys.readouterr().out
    main(["learn", f"{folder}/reference.npy", "--map", f"{folder}/told.safetensors", *OPTIONS])
    assert f"{len(REFERENCE)} frames make 101 even steps of 6 pixels" in capsys.readouterr().out


def test_info_tells_how_the_ground_was_measured(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["info", f"{folder}/m.safetensors"])
    told = capsys.readouterr().out
    assert "places are 6 pixels of ground apart" in told
    assert "GroundOdometry: corners=((0.0, 0.0)" in told


def test_another_camera_and_frames_as_they_come(folder: Path) -> None:
    # half of the ground fills the patch: it seems to move twice as fast
    rows = localize(folder, "half.csv", "--corners", "[[0,0.5],[1,0.5],[1,1],[0,1]]")
    assert len(rows) == pytest.approx(2 * 101, rel=0.05)
    rows = localize(folder, "as_is.csv", "--as_is")
    assert [int(row["query_frame"]) for row in rows] == list(range(len(QUERY)))


# bad input -----------------------------------------------------------------------------------------------


def fails(*command: object) -> None:
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in command])
    assert caught.value.code == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--velocity.corners", "[[0,0],[1,0],[1,1.5],[0,1]]"], "lie outside the frame"),
        (["--velocity.corners", "[[0,0],[1,0],[1,1]]"], "3 corners; expected four"),
        (["--velocity.corners", "[[1,1],[0,1],[0,0]]"], "3 corners"),
        (["--velocity.size", "[8,8]"], "(8, 8)"),
        (["--velocity.step", "-1"], "step is -1"),
        (["--velocity.step", "4000", *CORNERS], "expected at least one step, 4000"),
        (["--velocity.step", "1e-9", *CORNERS], "at most 20 a frame"),
        (["--velocity.step", "1e-300", *CORNERS], "at most 20 a frame"),
        (["--velocity", "true"], "--velocity is true; expected the name of a class, see --velocity.help"),
    ],
)
def test_ground_that_cannot_be_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    fails("learn", folder / "reference.npy", "--map", tmp_path / "m.safetensors", *options)
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_footage_that_stands_still_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = (255 * footage(torch.zeros(30, dtype=torch.int64))[:, 0]).byte().numpy()
    np.save(tmp_path / "still.npy", still)
    fails("learn", tmp_path / "still.npy", "--map", tmp_path / "m.safetensors", *CORNERS)
    assert "still.npy stands still in all of its 30 frames; expected motion" in capsys.readouterr().err


def test_a_truth_of_frames_needs_the_frames_of_the_places(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fails("evaluate", folder / "matches.csv", "--truth", folder / "frames.csv", "--out", tmp_path / "e")
    assert "expected the map (--map)" in capsys.readouterr().err


def test_even_steps_at_constant_speed_may_be_judged_by_an_offset(tmp_path: Path) -> None:
    """Every step shows the frame of its own number, in the map as in the matches."""
    np.save(tmp_path / "even.npy", (255 * footage(positions((STEP, 80)))[:, 0]).byte().numpy())
    source, map_ = f"{tmp_path}/even.npy", f"{tmp_path}/m.safetensors"
    main(["learn", source, "--map", map_, *OPTIONS])
    main(["localize", map_, source, "--out", f"{tmp_path}/matches.csv"])
    rows = list(csv.DictReader((tmp_path / "matches.csv").open()))
    assert [row["query"] for row in rows] == [row["query_frame"] for row in rows]
    assert evaluate_file(tmp_path, "0", tmp_path / "e", "--map", map_)["judged"] == len(rows)


def test_a_map_that_was_not_matched_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["learn", f"{folder}/reference.npy", "--map", f"{tmp_path}/plain.safetensors"])
    judge = ["evaluate", folder / "matches.csv", "--truth", "0", "--out", tmp_path / "e", "--map"]
    fails(*judge, tmp_path / "plain.safetensors")
    told = capsys.readouterr().err
    assert "matches.csv has place_frame" in told
    assert "are frames; expected the map that was matched" in told
    (tmp_path / "short.csv").write_text("query,place,score\n0,5,0.1\n")
    fails("evaluate", tmp_path / "short.csv", *judge[2:], folder / "m.safetensors")
    assert "short.csv has no place_frame" in capsys.readouterr().err
    other = [*CORNERS, "--velocity.step", "5.5", "--periods.false_alarm", "null"]
    main(["learn", f"{folder}/reference.npy", "--map", f"{tmp_path}/other.safetensors", *other])
    fails(*judge, tmp_path / "other.safetensors")
    assert (
        "tell other frames of the same places; expected the map that was matched" in capsys.readouterr().err
    )


def test_corners_of_another_camera_need_ground(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["learn", f"{folder}/reference.npy", "--map", f"{tmp_path}/plain.safetensors"])
    rest = [folder / "query.npy", "--out", tmp_path / "m.csv", "--corners", "[[0,0],[1,0],[1,1],[0,1]]"]
    fails("localize", tmp_path / "plain.safetensors", *rest)
    assert "learnt without --velocity" in capsys.readouterr().err
    fails("localize", folder / "m.safetensors", *rest, "--as_is")
    assert "--as_is measures no ground" in capsys.readouterr().err
    fails("localize", folder / "m.safetensors", *rest[:-1], "[[0,0],[1,0],[1,2],[0,1]]")
    assert "lie outside the frame" in capsys.readouterr().err
    assert not (tmp_path / "m.csv").exists()


def test_queries_that_stand_are_told_of_as_is(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "still.npy", np.load(folder / "query.npy")[[7] * 9])
    fails("localize", folder / "m.safetensors", tmp_path / "still.npy", "--out", tmp_path / "m.csv")
    assert "stands still in all of its 9 frames; expected motion to space evenly, or --as_is" in (
        capsys.readouterr().err
    )


def test_a_source_of_unknown_length_is_taken_as_it_is(folder: Path, tmp_path: Path) -> None:
    model = DejaVu.load(folder / "m.safetensors")
    model.velocity = None
    queries = ArrayTraverse(footage(QUERY)[:20])
    queries.length = None
    count, _ = write_matches(tmp_path / "m.csv", model.matches(queries), Shown(None, model.map.frame))
    rows = list(csv.DictReader((tmp_path / "m.csv").open()))
    assert [int(row["query_frame"]) for row in rows] == list(range(20)) == list(range(count))


def test_a_bare_velocity_is_understood(folder: Path, tmp_path: Path) -> None:
    command = ["learn", f"{folder}/reference.npy", "--map", f"{tmp_path}/m.safetensors", "--velocity"]
    main([*command, *OPTIONS])
    assert DejaVu.load(tmp_path / "m.safetensors").step == STEP


def test_ground_that_moves_to_and_fro_is_told(caplog: pytest.LogCaptureFixture) -> None:
    where = 100 + positions(*[(4, 2), (-4, 1)] * 10)
    with caplog.at_level("WARNING", "dejavu_torch"):
        ResampledTraverse(ArrayTraverse(footage(where)), camera())
    assert any("20 of 30 steps go forward and 10 backwards" in line for line in caplog.messages)


def test_a_step_may_be_a_whole_number(tmp_path: Path) -> None:
    model = DejaVu(periods=everything(101), velocity=camera(step=6)).learn(footage(REFERENCE))
    model.save(tmp_path / "m.safetensors")
    assert DejaVu.load(tmp_path / "m.safetensors").step == 6


def test_nan_is_told_by_the_frame_as_it_came() -> None:
    frames = footage(REFERENCE)
    velocity = camera()
    even = ResampledTraverse(ArrayTraverse(frames), velocity)
    frames[30, :, :3, :3] = torch.nan
    even.traverse = ArrayTraverse(frames)
    with refused("frame 30 gives NaN"):
        DejaVu(velocity=velocity).learn(even)
