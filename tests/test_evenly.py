"""Even spacing along the ground, through learning, localizing, truth, files and commands."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import Fixed, refused
from torch import Tensor
from torch.nn.functional import interpolate

from dejavu_torch import DejaVu, FrequencyLayer, VelocityNormalizer
from dejavu_torch.cli import main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.truth import Shown, places_of_frames
from dejavu_torch.data.truthfile import find_truth
from dejavu_torch.experiments.compare import compare
from dejavu_torch.features.spacing import EvenlySpaced

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


def camera(**settings: object) -> VelocityNormalizer:
    return VelocityNormalizer(WHOLE, (SIDE, SIDE), **{"step": float(STEP), **settings})


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
    model.periods = everything(len(EvenlySpaced(ArrayTraverse(footage(REFERENCE)), model.velocity).frame))
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


def shown() -> Shown:
    """Two queries show frames 3 and 9; three places show frames 0, 4 and 10."""
    return Shown(torch.tensor([3, 9]), torch.tensor([0, 4, 10]))


def test_a_frame_belongs_to_the_place_that_shows_the_nearest_one() -> None:
    frames = torch.tensor([[0, 2], [3, 7], [8, 99], [-1, 4]])
    assert places_of_frames(frames, shown()).tolist() == [[0, 0], [1, 1], [2, 2], [-1, 1]]


def test_convention_11_a_csv_says_in_its_header_what_it_counts(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("query_frame,place_frame,place_frame\n3,4\n4,0\n9,11,2\n")
    found = find_truth(str(path), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.right.tolist() == [[1, -1], [2, 0]]
    path.write_text("query,place\n0,2\n1,1\n")
    found = find_truth(str(path), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.right.tolist() == [[2], [1]]
    # where nothing is spaced, frames are places
    path.write_text("query_frame,place_frame\n0,2\n1,1\n")
    found = find_truth(str(path), None, None, 3, 2)
    assert found is not None
    assert found.right.tolist() == [[2], [1]]


def test_a_csv_of_frames_is_interpolated_between_frames(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("query_frame,place_frame\n0,0\n12,12\n")
    found = find_truth(str(path), None, None, 3, 2, interpolate=True, shown=shown())
    assert found is not None
    assert found.right.tolist() == [[1], [2]]  # frames 3 and 9


@pytest.mark.parametrize("head", ["query_frame,place", "query,place_frame", "query_frame,place_frame,place"])
def test_a_csv_that_mixes_frames_and_places_is_refused(tmp_path: Path, head: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(f"{head}\n0,2\n")
    with refused("truth.csv, line 1", "query_frame,place_frame"):
        find_truth(str(path), None, None, 3, 2, shown=shown())


def test_matrices_as_large_as_the_traverses_are_of_frames(tmp_path: Path) -> None:
    hard = np.zeros((12, 11), bool)
    hard[11, 3] = hard[0, 9] = hard[5, 0] = True
    np.savez(tmp_path / "frames.npz", GThard=hard)
    found = find_truth(str(tmp_path / "frames.npz"), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.right.tolist() == [[2], [0]]
    np.savez(tmp_path / "places.npz", GThard=np.eye(3, 2, dtype=bool))
    found = find_truth(str(tmp_path / "places.npz"), None, None, 3, 2, shown=shown())
    assert found is not None
    assert found.right.tolist() == [[0], [1]]
    np.savez(tmp_path / "neither.npz", GThard=np.eye(5, 6, dtype=bool))
    with refused("(5, 6)", "(3, 2)"):
        find_truth(str(tmp_path / "neither.npz"), None, None, 3, 2, shown=shown())


def test_positions_are_of_frames() -> None:
    reference, query = ArrayTraverse(torch.rand(12, 3)), ArrayTraverse(torch.rand(10, 3))
    reference.place, query.place = torch.arange(12.0), torch.arange(10.0) + 1
    found = find_truth(None, reference, query, 3, 2, shown=shown())
    assert found is not None
    assert found.right.tolist() == [[1], [2]]  # positions 4 and 10


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


def evaluate(folder: Path, truth: str, out: Path, *options: str) -> dict:
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
        evaluate(folder, truth, tmp_path / f"{k}", *given)
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
    alone = evaluate(folder, "frames.csv", tmp_path / "e", "--map", f"{folder}/m.safetensors")
    for key in ("auc", "recall_at_1", "recall_at_100_precision", "judged", "accepted_right"):
        assert report[key] == pytest.approx(alone[key], rel=1e-6), key
    assert report["spacing"] == {"step": STEP, "reference_frames": len(REFERENCE), "query_frames": len(QUERY)}
    assert report["frames"] == report["queries"] == 101
    assert (tmp_path / "c" / "velocity.png").stat().st_size > 1000
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
    assert "VelocityNormalizer: corners=((0.0, 0.0)" in told


def test_another_camera_and_frames_as_they_come(folder: Path) -> None:
    # half the rows: half the pixels of ground a frame, and so half as many steps
    rows = localize(folder, "half.csv", *CORNERS[:2], "--velocity.size", f"[{SIDE // 2 + 8},{SIDE}]")
    assert len(rows) == pytest.approx(101 * (SIDE // 2 + 8) / SIDE, abs=2)
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
        (["--velocity", "true"], "--velocity"),
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


def test_a_map_that_was_not_matched_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["learn", f"{folder}/reference.npy", "--map", f"{tmp_path}/plain.safetensors"])
    judge = ["evaluate", folder / "matches.csv", "--truth", "0", "--out", tmp_path / "e", "--map"]
    fails(*judge, tmp_path / "plain.safetensors")
    told = capsys.readouterr().err
    assert "matches.csv has query_frame" in told
    assert "are frames; expected the map that was matched" in told
    (tmp_path / "short.csv").write_text("query,place,score\n0,5,0.1\n")
    fails("evaluate", tmp_path / "short.csv", *judge[2:], folder / "m.safetensors")
    assert "short.csv has no query_frame" in capsys.readouterr().err
    fails(
        "localize",
        tmp_path / "plain.safetensors",
        folder / "query.npy",
        "--out",
        tmp_path / "m.csv",
        *CORNERS,
    )
    assert "learnt without --velocity; expected a map of evenly spaced places" in capsys.readouterr().err
