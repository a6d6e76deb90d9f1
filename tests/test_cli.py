"""The commands as a user meets them: their output, their files, and one line for every mistake."""

from __future__ import annotations

import csv
import os
import re
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import TEMPLATES, fails, frames, report_of, run, write_images
from PIL import Image

from dejavu_torch import DejaVu, SpectrogramAnalysis, TemplateMapper, open_source
from dejavu_torch.cli import COMMANDS, commands
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.types import Training

SMALL = "sim:aerial?frames=96"
QUERY = "sim:aerial?frames=96&traverse=1"
LONG = "sim:aerial?frames=256"  # longer than the window of periods that some tests give


@pytest.fixture(scope="module")
def small_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "small.safetensors"
    run("learn", SMALL, "--map", path)
    return path


# what works


def test_learn_prints_plan_summary_and_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("learn", SMALL, "--map", tmp_path / "a.safetensors")
    out = capsys.readouterr().out
    assert "strongest periods" in out
    assert "places covered" in out
    assert "lines of their spectra" in out
    assert f"{(tmp_path / 'a.safetensors').stat().st_size} bytes" in out
    assert [file.name for file in tmp_path.iterdir()] == ["a.safetensors"]


def test_localize_writes_one_row_a_query_as_python_finds_them(small_map: Path, tmp_path: Path) -> None:
    run("localize", small_map, QUERY, "--out", tmp_path / "m.csv")
    rows = list(csv.DictReader((tmp_path / "m.csv").open()))
    model = DejaVu.load(small_map)
    match = model.localize(open_source(QUERY))
    columns = ["query", "place", "score", "accepted", "probability", "query_name", "place_name"]
    assert list(rows[0]) == columns
    assert [int(row["query"]) for row in rows] == list(range(96))
    assert match.probability is not None
    assert [float(row["probability"]) for row in rows] == pytest.approx(match.probability.tolist(), abs=1e-4)
    assert [int(row["place"]) for row in rows] == match.index.tolist()
    assert torch.allclose(torch.tensor([float(row["score"]) for row in rows]), match.score, rtol=1e-5)


def test_convention_4_threshold_option_then_map_then_probability_then_all(
    small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    route, out = tmp_path / "a.safetensors", tmp_path / "m.csv"

    def accepted() -> int:
        return sum(row["accepted"] == "1" for row in csv.DictReader(out.open()))

    run("localize", small_map, QUERY, "--out", out)
    assert "probability is at least 0.5" in capsys.readouterr().out
    assert accepted() == sum(float(row["probability"]) >= 0.5 for row in csv.DictReader(out.open()))
    run("localize", small_map, "sim:aerial?frames=96&seed=9", "--out", out)  # another road
    assert accepted() == sum(float(row["probability"]) >= 0.5 for row in csv.DictReader(out.open())) < 96
    run("localize", small_map, QUERY, "--sequence", 5, "--out", out)  # which has no probabilities
    assert "every query with a finite score" in capsys.readouterr().out
    assert accepted() == 96
    run("localize", small_map, QUERY, "--threshold", ".inf", "--out", out)
    assert "no threshold" not in capsys.readouterr().out
    assert accepted() == 96
    score = sorted(float(row["score"]) for row in csv.DictReader(out.open()))[40]
    run("learn", SMALL, "--map", route, "--threshold", str(score))
    capsys.readouterr()
    run("localize", route, QUERY, "--out", out)
    assert "no threshold" not in capsys.readouterr().out
    assert 35 <= accepted() <= 41
    run("localize", route, QUERY, "--out", out, "--threshold", "0")
    assert accepted() == 0


def test_folder_of_images_to_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = write_images(tmp_path / "first", frames(128, seed=1))
    second = write_images(tmp_path / "second", frames(128, seed=2))
    run("compare", first, second, *TEMPLATES, "--out", tmp_path / "report")
    report = report_of(tmp_path / "report")
    assert report["frames"] == report["queries"] == 128
    assert 16 in report["periods"]
    assert {file.name for file in (tmp_path / "report").iterdir()} >= {
        "report.json",
        "index.html",
        "matches.csv",
        "pr.png",
        "coverage.png",
        "chunks.png",
    }


def test_config_and_options(tmp_path: Path) -> None:
    config = tmp_path / "mine.yaml"
    config.write_text(
        "mapper: {class_path: dejavu_torch.TemplateMapper, init_args: {reduction: sum, "
        "periods: {class_path: dejavu_torch.SpectrogramAnalysis, init_args: {window: 128}}}}\n"
    )
    route = tmp_path / "a.safetensors"
    run("learn", LONG, "--map", route, "--config", config, "--batch_size", "16")
    model = DejaVu.load(route)
    assert model.mapper.periods.window == 128
    assert model.map.reduction == "sum"
    assert model.batch_size == 16
    assert {(layer.start, layer.stop) for layer in model.map.plan} == {(0, 128), (128, 256)}


def test_parts_of_a_mapper_of_templates_as_options(tmp_path: Path) -> None:
    route = tmp_path / "a.safetensors"
    np.save(tmp_path / "frames.npy", frames(64, size=16))
    window = "--mapper.periods.window", "32"
    run("learn", tmp_path / "frames.npy", "--map", route, *TEMPLATES, *window)
    model = DejaVu.load(route)
    assert (model.mapper.periods.window, model.mapper.periods.peaks) == (32, "local")
    assert model.whitening is None


def test_features_of_another_package_are_named_again_to_localize(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "frames.npy", frames(64))
    route = tmp_path / "a.safetensors"
    monkeypatch.chdir(tmp_path)
    flat = "--features", "torch.nn.Flatten", "--features.start_dim=1", "--features.end_dim", "-1"
    run("learn", tmp_path / "frames.npy", "--map", route, *flat)
    learned = capsys.readouterr().out.splitlines()[-1]
    assert "torch.nn" in fails(capsys, "info", route)
    run("info", route, *flat)
    assert capsys.readouterr().out.splitlines()[-1] == learned
    run(*("frames.npy" if word == "QUERY" else word for word in shlex.split(learned)[2:]))
    assert len((tmp_path / "matches.csv").read_text().splitlines()) == 65


def test_classes_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_network.py").write_text("import torch\nclass Net(torch.nn.Flatten):\n    pass\n")
    np.save(tmp_path / "frames.npy", frames(64))
    words = ["learn", "frames.npy", "--map", "a.safetensors", "--features", "my_network.Net"]
    monkeypatch.chdir(tmp_path)
    # as for an installed command, which does not look there by itself
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place and Path(place) != tmp_path])
    with pytest.raises(ImportError):
        import_module("my_network")
    run(*words)
    assert DejaVu.load("a.safetensors", sys.modules.pop("my_network").Net()).map.places == 64


def test_a_route_that_does_not_repeat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(0)
    for name in ("a", "b"):
        np.save(tmp_path / f"{name}.npy", noise.normal(size=(200, 40)).astype(np.float32))
    run("learn", tmp_path / "a.npy", "--map", tmp_path / "a.safetensors", *TEMPLATES)
    assert "this route does not repeat" in capsys.readouterr().out.splitlines()
    assert DejaVu.load(tmp_path / "a.safetensors").map.plan == ()
    pair = tmp_path / "a.npy", tmp_path / "b.npy"
    run("compare", *pair, "--truth", "0", *TEMPLATES, "--out", tmp_path / "report")
    report = report_of(tmp_path / "report")
    assert report["recall_at_1"] == report["auc"] == 0
    assert report["accepted"] == 0
    assert report["periods"] == report["chunks"] == []


def test_compare_without_truth_gives_matches_and_no_scores(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "a.npy", frames(96))
    np.save(tmp_path / "b.npy", frames(64, seed=5))
    run("compare", tmp_path / "a.npy", tmp_path / "b.npy", "--out", tmp_path / "report")
    assert "no scores" in capsys.readouterr().out
    report = report_of(tmp_path / "report")
    assert report["auc"] is None
    # nothing that else is stored, or learned from shuffled frames, could be scored
    assert not {"uncompressed", "stride", "null", "hog"} & report.keys()
    assert (tmp_path / "report" / "coverage.png").is_file()
    page = (tmp_path / "report" / "index.html").read_text()
    assert "--truth" in page
    assert "<table" not in page
    assert len((tmp_path / "report" / "matches.csv").read_text().splitlines()) == 65
    known = "--map", tmp_path / "report" / "map.safetensors"
    pair = tmp_path / "a.npy", tmp_path / "b.npy"
    run("compare", *pair, *known, "--truth", "16", "--out", tmp_path / "report")
    report = report_of(tmp_path / "report")
    assert report["auc"] is not None


def test_as_many_frames_are_no_truth_but_their_answers_ask_for_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, start in (("a", 0), ("b", 16)):
        part = f"sim:aerial?frames=112&traverse={int(start > 0)}&start={start}&stop={start + 96}"
        pixels = 255 * torch.cat(list(open_source(part).batches(64))).permute(0, 2, 3, 1)
        np.save(tmp_path / f"{name}.npy", pixels.byte().numpy())
    pair, out = (tmp_path / "a.npy", tmp_path / "b.npy"), tmp_path / "report"
    run("compare", *pair, "--out", out)
    told, report, page = capsys.readouterr().out, report_of(out), (out / "index.html").read_text()
    assert report["auc"] is None
    assert report["least_probability"] == 0.5
    rows = list(csv.DictReader((out / "matches.csv").open()))
    sure = [sum(float(row["probability"]) >= least for row in rows) for least in (0.9, 0.5)]
    assert report["probably_right"] == {"0.9": sure[0], "0.5": sure[1]}
    assert report["accepted"] == sure[1] > 48
    assert report["line"]["offset"] == 16
    for text in (told, page.partition("</p>")[0]):
        assert f"{sure[0]} of 96 answers are probably right (at least .9), {sure[1]} at .5" in text
        assert "is it --truth 16?" in text
        assert "--filter" in text
    run("compare", *pair, "--map", out / "map.safetensors", "--truth", "0", "--out", tmp_path / "zero")
    first = capsys.readouterr().out.splitlines()[0]
    lead = (tmp_path / "zero" / "index.html").read_text().partition("<p>")[2]
    for text in (first, lead):
        assert text.lower().startswith("the answers contradict the truth (place = query)")
    for truth, contradicts in (("0", True), ("16", False)):
        run("evaluate", out / "matches.csv", "--truth", truth, "--out", tmp_path / "scores")
        assert capsys.readouterr().out.startswith("the answers contradict") == contradicts
        assert ("line" in report_of(tmp_path / "scores")) == contradicts
    run("localize", out / "map.safetensors", pair[1], "--filter", "--out", tmp_path / "m.csv")
    told = capsys.readouterr().out
    assert "of 96 answers are probably right" in told
    assert "--filter" not in told


def test_negative_offset_is_a_truth(tmp_path: Path) -> None:
    reference, matches = tmp_path / "a.npy", tmp_path / "m.csv"
    np.save(reference, frames(64))
    rows = "".join(f"{i},{i},0.5\n" for i in range(64))
    matches.write_text(f"query,place,score\n{rows}")
    run("compare", reference, reference, "--truth", "-3", "--tolerance", "0", "--out", tmp_path / "apart")
    exact = "--tolerance", "0", "--reference", reference, "--out", tmp_path / "joined"
    run("evaluate", matches, "--truth=-3", *exact)
    for name in ("apart", "joined"):
        report = report_of(tmp_path / name)
        assert (report["tolerance"], report["with_answer"]) == (0, 61)


def test_what_learn_says_to_do_next_can_be_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run("learn", SMALL, "--map", tmp_path / "my map.safetensors")

    def next_words() -> list[str]:
        words = shlex.split(capsys.readouterr().out.splitlines()[-1])
        assert words[:2] == ["next:", "dejavu"]
        return words[2:]

    run(*(QUERY if word == "QUERY" else word for word in next_words()))
    assert (tmp_path / "matches.csv").is_file()
    run(*("0" if word == "TRUTH" else word for word in next_words()))
    assert (tmp_path / "scores" / "index.html").is_file()


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "train"])
def test_help_reads_well(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(command, "--help")
    out = capsys.readouterr().out
    assert stop.value.code == 0
    assert "known subclasses" not in out
    assert "<class" not in out
    assert len(out.splitlines()) < 150
    assert out.splitlines()[0].startswith(f"usage: dejavu {command}")


@pytest.fixture(scope="module")
def helped() -> tuple[str, str]:
    """What a process in which every help is asked for prints, and what it and OpenMP say on stderr."""
    code = (
        "import sys, dejavu_torch.cli as cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit: assert 'torch' not in sys.modules\n"
        f"for command in {[name for name in COMMANDS if name != 'train']}:\n"
        "    try: cli.main([command, '--help'])\n"
        "    except SystemExit: pass\n"
        "heavy = 'kornia', 'matplotlib', 'pytorch_lightning', 'torchmetrics', 'av', 'numba', 'cv2', 'scipy'\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    environment = {**kept, "OMP_DISPLAY_ENV": "true"}
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return ran.stdout, ran.stderr


def test_help_loads_nothing_that_only_a_run_needs(helped: tuple[str, str]) -> None:
    own = re.sub(
        r"\s*OPENMP DISPLAY ENVIRONMENT BEGIN.*?OPENMP DISPLAY ENVIRONMENT END\s*", "", helped[1], flags=re.S
    )
    assert (helped[0].splitlines()[-1], own) == ("[]", "")


@pytest.mark.skipif(sys.platform != "linux", reason="libgomp is the OpenMP of Linux builds")
def test_threads_do_not_spin_while_they_wait(helped: tuple[str, str]) -> None:
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in helped[1]


def test_threads_spin_where_that_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")  # which OpenMP reads where torch loads it
    with pytest.raises(SystemExit):
        run("info", "nowhere")
    assert os.environ["OMP_WAIT_POLICY"] == "active"


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_names_every_command(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(*arguments)
    out = capsys.readouterr().out
    assert stop.value.code == 0
    assert {line.split()[0] for line in out.splitlines() if line.strip()} >= set(COMMANDS)


# a map that is evaluated as it is


@pytest.fixture
def trained_map(tmp_path: Path) -> Path:
    """Arrays a.npy and b.npy, and a map of the first as training leaves it."""
    np.save(tmp_path / "a.npy", frames(96, size=8))
    np.save(tmp_path / "b.npy", frames(96, seed=5, size=8))
    periods = SpectrogramAnalysis(window=96, strongest=1)
    mapper = TemplateMapper(periods, metric="l2", temperature=0.2)
    model = DejaVu(torch.nn.Flatten(), mapper=mapper, threshold=2.5)
    model.learn(open_source(str(tmp_path / "a.npy")))
    model.map.templates *= 0.9
    model.trained = Training(steps=30, seed=3)
    model.save(tmp_path / "trained.safetensors")
    return tmp_path / "trained.safetensors"


def test_compare_judges_the_map_of_a_file(trained_map: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, before = trained_map.parent, trained_map.read_bytes()
    pair = folder / "a.npy", folder / "b.npy", "--truth", "0", "--features", "torch.nn.Flatten"
    run("compare", *pair, "--map", trained_map, "--out", folder / "r")
    report = report_of(folder / "r")
    assert report["trained"] == {"steps": 30, "seed": 3}
    assert report["seconds_learn"] == 0
    assert report["map_bytes"] == len(before)
    assert report["threshold"] == 2.5
    assert {"null", "uncompressed", "stride"} <= report.keys()
    assert "null_same_plan" not in report
    assert trained_map.read_bytes() == before
    match = DejaVu.load(trained_map, torch.nn.Flatten()).localize(open_source(str(folder / "b.npy")))
    rows = list(csv.DictReader((folder / "r" / "matches.csv").open()))
    assert [int(row["place"]) for row in rows] == match.index.tolist()
    assert torch.allclose(torch.tensor([float(row["score"]) for row in rows]), match.score, rtol=1e-4)
    assert report["accepted"] == int(match.accepted.sum())
    run("compare", *pair, "--map", trained_map, "--out", folder / "r", "--threshold", "0.5")
    assert report_of(folder / "r")["threshold"] == 0.5


@pytest.mark.parametrize(
    "option",
    [
        ["--mapper.metric", "l2"],
        ["--velocity"],
        ["--config", "c.yaml"],
        ["--second", "sim:aerial"],
        ["--second_truth", "0"],
    ],
)
def test_compare_with_a_map_takes_no_settings(
    trained_map: Path, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = trained_map.parent
    (folder / "c.yaml").write_text("batch_size: 9\n")
    option = [word.replace("c.yaml", str(folder / "c.yaml")) for word in option]
    pair = folder / "a.npy", folder / "b.npy"
    error = fails(capsys, "compare", *pair, "--map", trained_map, "--out", folder / "r", *option)
    assert f"{option[0].partition('.')[0]}: a --map has its own settings" in error
    assert not (folder / "r").exists()


def test_compare_builds_features_of_this_package_by_itself(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", frames(64, size=16))
    np.save(tmp_path / "b.npy", frames(64, seed=5, size=16))
    features = SmallCNN(dimension=8, channels=1, resize=(16, 16), widths=(4,), squeeze=2)
    model = DejaVu(features, mapper=TemplateMapper(SpectrogramAnalysis(window=64, strongest=1)))
    model.learn(open_source(str(tmp_path / "a.npy"))).save(tmp_path / "a.safetensors")
    pair = tmp_path / "a.npy", tmp_path / "b.npy"
    run("compare", *pair, "--truth", "0", "--map", tmp_path / "a.safetensors", "--out", tmp_path / "r")
    report = report_of(tmp_path / "r")
    assert report["trained"] is None
    assert report["map_bytes"] == (tmp_path / "a.safetensors").stat().st_size
    assert {"hog", "hog_stride_coarsest"} <= report.keys()


def test_info_says_how_a_map_was_trained(trained_map: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("info", trained_map, "--features", "torch.nn.Flatten")
    out = capsys.readouterr().out
    assert "trained for 30 steps, seed 3" in out
    assert "temperature=0.2" in out


def test_a_map_that_cannot_be_judged(trained_map: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = trained_map.parent
    np.save(folder / "short.npy", frames(95, size=8))

    def told(reference: str, *options: str | Path) -> str:
        out = "--features", "torch.nn.Flatten", "--out", folder / "r"
        return fails(capsys, "compare", folder / reference, folder / "b.npy", *out, *options)

    error = told("short.npy", "--map", trained_map)
    assert "short.npy gives 95 places, the map holds 96" in error
    assert "not there" in told("a.npy", "--map", folder / "nowhere.safetensors")
    assert "trained templates" in told("a.npy", "--map", trained_map, "--leave_out", "2")
    assert "expected a TemplateMapper" in told("a.npy", "--leave_out", "2", "--whitening.views", "1")
    pair = folder / "a.npy", folder / "b.npy"
    assert "Flatten" in fails(capsys, "compare", *pair, "--map", trained_map, "--out", folder / "r")


# what is refused

WRONG = {  # a line of words behind `dejavu`, and what its one line holds
    "demo --seed x": ("--seed is x", "integer"),
    "learn a.npy --map m.safetensors --batch_size 2.5": ("--batch_size is 2.5", "integer"),
    "learn a.npy --map m.safetensors --threshold high": ("--threshold is high", "a number"),
    "learn a.npy --map m.safetensors --weight_bits 4": ("--weight_bits is 4", "8 or 32"),
    "learn a.npy --map m.safetensors --seed 99999999999999999999": ("--seed is 99999999999999999999", "most"),
    "learn a.npy --map m.safetensors --features short": ("--features is short", "import path"),
    "learn a.npy --map m.safetensors --features no.such.Net": ("--features", "'no'"),
    "learn a.npy --map m.safetensors --features.cell big": ("--features.cell is big", "integer"),
    "learn a.npy --map m.safetensors --features.cel 3": ("--features.cel", "not accepted"),
    "learn a.npy --map m.safetensors --features.bins soft": ("--features.bins is soft", "hard or linear"),
    "learn a.npy --map m.safetensors --features torch.nn.Linear": ("--features.in_features", "required"),
    "learn a.npy --map m.safetensors --whitening some": (
        "--whitening is some",
        "Whitening",
        "none or a map file",
    ),
    "learn a.npy --map m.safetensors --whitening none --whitening.bits 4": (
        "--whitening.bits",
        "no settings",
    ),
    "learn a.npy --map m.safetensors --whitening.bits 5": ("shrinkage=null", "bits=5"),
    "learn a.npy --map m.safetensors --mapper HOG": ("--mapper is HOG", "Mapper"),
    "learn a.npy --map m.safetensors --mapper.chunk some": ("--mapper.chunk is some", "an integer"),
    "learn a.npy --map m.safetensors --config local_maxima --mapper.periods Foo": (
        "--mapper.periods is Foo",
    ),
    "learn a.npy --map m.safetensors --velocity.corners 3": ("--velocity.corners is 3", "a list"),
    "learn a.npy --map m.safetensors --config key.yaml": ("--mapper.stepp", "not accepted", "key.yaml"),
    "learn a.npy --map m.safetensors --config value.yaml": ("--batch_size is many", "value.yaml"),
    "learn a.npy --map m.safetensors --second c.npy": ("6 frames", "--second_truth"),
    "learn a.npy --map m.safetensors --average c.npy": ("6 frames", "--average_truth"),
    "learn a.npy --map m.safetensors --calibration c.npy": ("6 frames", "--calibration_truth"),
    "learn one.npy --map m.safetensors": ("one.npy has 1 frame", "at least 2"),
    "learn c.npy --map m.safetensors --config local_maxima": ("6 place", "at least 8"),
    "learn nan.npy --map m.safetensors": ("frame 70",),
    "learn text.npy --map m.safetensors": ("text.npy",),
    "learn nowhere --map m.safetensors": ("nowhere is not there", "expected"),
    "learn empty --map m.safetensors": ("no images",),
    "learn strip:a.png --map m.safetensors": ("expected",),
    "learn sim:moon --map m.safetensors": ("expected",),
    "learn sim:aerial?colour=red --map m.safetensors": ("expected",),
    "learn a.npy --map .": ("such as route.safetensors",),
    "learn nowhere --map a.txt": ("--map a.txt", "a.safetensors"),
    "learn nowhere --map no/a.safetensors": ("does not exist",),
    "learn a.npy --map m.safetensors --config": ("--config", "expected one argument"),
    "learn a.npy --map m.safetensors --config part.yaml": ("--mapper", "HOG"),
    "learn a.npy --map m.safetensors --config paper --colour red": ("--colour",),
    "learn a.npy --map m.safetensors --batch_size 0": ("batch_size is 0",),
    "learn a.npy --map m.safetensors --preprocess.contrast high": ("contrast is high", "patch", "clahe"),
    "learn a.npy --map m.safetensors --preprocess.grid 2,2": ("grid is 2,2", "a list"),
    "learn a.npy --map m.safetensors --config local_maxima --mapper.metric l3": ("l3", "l1, l2 or cosine"),
    "learn a.npy --map m.safetensors --config local_maxima --mapper.periods.windw 3": ("windw",),
    "learn a.npy --map m.safetensors --config local_maxima --mapper.periods.window 3": ("window=3",),
    "learn a.npy": ("required: --map",),
    "localize m": ("required: source, --out",),
    "evaluate": ("required: matches, --truth, --out",),
    "compare a.npy b.npy --out r --truth maybe": ("maybe",),
    "compare a.npy b.npy --out r --tolerance -1": ("tolerance is -1",),
    "dance": ("dance", "localize"),
    "learn sim:aerial?frames=many --map m.safetensors": ("frames is 'many'", "integer"),
    "localize m a.npy --out m.csv --top some": ("--top is some", "integer"),
    "localize m a.npy --out m.csv --speeds [fast]": ("--speeds is", "fast", "a list"),
    "localize m a.npy --out m.csv --search fast": ("--search is fast", "auto or scan"),
    "compare a.npy b.npy --out r --config paper": ("18 places", "1024", "--mapper.periods.short shrink"),
    "compare a.npy b.npy --out r --leave_out 3": ("leave_out is 3", "--config local_maxima"),
    "evaluate a.csv --truth 0 --out r --tolerance some": ("--tolerance is some", "integer"),
    "live m a.npy --page many": ("--page is many", "integer"),
    "merge m.safetensors --map n.safetensors": ("m.safetensors", "at least two maps"),
    "bench scale --out r --places 8": ("python -m benchmarks", "clone"),
    "train": ("fit, validate, test",),
    "train fit --data.source a.npy --model.lr fast": ("--model.lr is fast", "a number"),
    "train fit --data.source a.npy --trainer.accelerator abacus": ("--trainer.accelerator abacus", "cpu"),
    "train fit --data.source a.npy --model.mapper Nothing": ("--model.mapper is Nothing", "Mapper"),
}


@pytest.mark.parametrize("count", [2, 3, 5, 8, 12])
def test_short_routes_fit_or_are_refused_with_a_number_that_works(
    count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    np.save(tmp_path / "a.npy", frames(count))
    learn = "learn", tmp_path / "a.npy", "--map", tmp_path / "m.safetensors", "--calibration", "none"
    run(*learn)
    summary = DejaVu.load(tmp_path / "m.safetensors").summary()
    assert (summary.route_bytes > 5 * count) == (len(caplog.messages) == 1) == (count < 6)
    run(*learn, "--mapper.route_bytes_per_place", "null", "--mapper.step", "0.1")
    capsys.readouterr()
    error = fails(capsys, *learn, "--mapper.route_bytes_per_place", "5" if count < 6 else "0.2")
    run(*learn, "--mapper.route_bytes_per_place", re.findall(r"such as (\d+)", error)[0])


@pytest.mark.parametrize(
    "line", [pytest.param(one, marks=[pytest.mark.slow] * one.startswith("train")) for one in WRONG]
)
def test_what_is_wrong_is_told_by_options_and_without_python(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, count in (("a", 18), ("b", 18), ("c", 6), ("one", 1)):
        np.save(f"{name}.npy", frames(count))
    np.save("nan.npy", np.where(np.arange(100) == 70, np.nan, 1)[:, None] * np.ones(8))
    Path("text.npy").write_text("hello")
    Path("empty").mkdir()
    Path("part.yaml").write_text("mapper: {class_path: dejavu_torch.HOG}\n")
    Path("key.yaml").write_text("mapper:\n  class_path: SpectralMapper\n  init_args: {stepp: 3}\n")
    Path("value.yaml").write_text("batch_size: many\n")
    there = {*tmp_path.iterdir()}
    error = fails(capsys, *line.split())
    assert [word for word in WRONG[line] if word not in error] == [], error
    assert not re.search(r"<class|typing\.|Parser key|NoneType|\bNone\b|='|import path string", error), error
    assert {*tmp_path.iterdir()} == there


def test_mixed_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_images(tmp_path / "mixed", frames(40))
    Image.fromarray(frames(1, size=24)[0]).save(folder / "20.png")
    error = fails(capsys, "learn", folder, "--map", tmp_path / "a.safetensors")
    assert "20.png" in error
    assert "24 x 24" in error
    assert "32 x 32" in error


def test_unreadable_image_in_the_middle(
    small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_images(tmp_path / "broken", frames(100, size=64))
    (folder / "77.png").write_bytes(b"no image")
    assert "77.png" in fails(capsys, "localize", small_map, folder, "--out", tmp_path / "m.csv")
    # the first batch was matched by then: nothing of it may stay
    assert sorted(file.name for file in tmp_path.iterdir()) == ["broken"]


def test_features_of_another_dimension(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wave = np.sin(np.arange(100)[:, None] * np.array([0.4, 0.5, 0.6]))
    np.save(tmp_path / "three.npy", wave)
    np.save(tmp_path / "two.npy", wave[:, :2])
    run("learn", tmp_path / "three.npy", "--map", tmp_path / "a.safetensors")
    capsys.readouterr()
    error = fails(
        capsys, "localize", tmp_path / "a.safetensors", tmp_path / "two.npy", "--out", tmp_path / "m.csv"
    )
    assert "2)" in error
    assert "3)" in error
    assert not (tmp_path / "m.csv").exists()


def test_truncated_and_foreign_maps(
    small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cut.safetensors").write_bytes(small_map.read_bytes()[:-100])
    (tmp_path / "text.safetensors").write_text("not a map at all")
    for name in ("cut", "text", "missing"):
        path = tmp_path / f"{name}.safetensors"
        assert name in fails(capsys, "localize", path, QUERY, "--out", tmp_path / "m.csv")


def test_a_folder_is_no_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = fails(capsys, "localize", tmp_path, tmp_path, "--out", tmp_path / "m.csv")
    assert f"{tmp_path} is a folder; expected a map file" in error
    (tmp_path / "no_map.safetensors").touch()
    fails(capsys, "localize", tmp_path / "no_map.safetensors", QUERY, "--out", tmp_path / "m.csv")


@pytest.mark.parametrize("name", ["nowhere.yaml", "no_preset"])
@pytest.mark.parametrize("command", [["learn", SMALL, "--map", "a.safetensors"], ["train", "fit"]])
def test_missing_config(
    name: str, command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    error = fails(capsys, *command, "--config", name)
    assert name in error
    for preset in ("default", "paper", "train_small", "train_road"):
        assert preset in error


@pytest.mark.parametrize(
    "command",
    [
        "compare sim:aerial?frames=64 sim:aerial?frames=48 --truth maybe",
        "compare sim:aerial?frames=1 sim:aerial?frames=1&traverse=1",
        "evaluate nowhere.csv --truth 0",
        "reproduce mars",
    ],
)
def test_a_command_that_fails_leaves_no_folder(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fails(capsys, *command.split(), "--out", tmp_path / "new" / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_map_that_is_given_is_not_learned_and_stays_in_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "report"
    kept = folder / "map.safetensors"
    run("compare", SMALL, QUERY, *TEMPLATES, "--out", folder)
    learned, before = report_of(folder), kept.read_bytes()
    out = capsys.readouterr().out
    assert "Learning took" in out
    assert out.splitlines()[-1] == f"next: open {folder / 'index.html'}"
    assert len([line for line in caplog.messages if "window shrunk" in line]) == 1
    caplog.clear()
    run("compare", SMALL, QUERY, "--map", kept, "--threshold", "0.01", "--out", folder)
    assert kept.read_bytes() == before
    out = capsys.readouterr().out
    assert "Localizing took" in out
    assert "Learning" not in out
    assert "window shrunk" not in caplog.text
    given = report_of(folder)
    assert given["seconds_learn"] == 0 < learned["seconds_learn"]
    assert {key: given[key] for key in ("auc", "null")} == {key: learned[key] for key in ("auc", "null")}


def test_output_that_cannot_be_written(
    small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "is a folder" in fails(capsys, "localize", small_map, QUERY, "--out", tmp_path)
    (tmp_path / "file").write_text("in the way")
    assert "file" in fails(capsys, "compare", SMALL, QUERY, "--out", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "in the way"


def test_full_disk(
    small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "m.csv"
    out.write_text("old")

    def full(self: Path, *arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    assert "No space left" in fails(capsys, "localize", small_map, QUERY, "--out", out)
    assert [file.name for file in tmp_path.iterdir()] == ["m.csv"]
    assert out.read_text() == "old"


@pytest.mark.parametrize(
    ("problem", "told"),
    [
        (MemoryError(), "not enough memory: it ran out"),
        (
            MemoryError("Unable to allocate 7 GiB\nfor an array"),
            "not enough memory: Unable to allocate 7 GiB for",
        ),
        (RecursionError("maximum recursion depth exceeded"), "nested too deeply"),
        (ImportError("libtorch.so: cannot allocate memory"), "not enough memory"),
    ],
)
def test_what_lacks_memory_is_one_line(
    problem: Exception, told: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_info(map: Path) -> None:
        raise problem

    monkeypatch.setattr(commands, "run_info", run_info)
    monkeypatch.setattr("dejavu_torch.cli.parser.parse", lambda *_: {"map": Path("a")})
    assert told in fails(capsys, "info", "a")


def test_what_torch_cannot_allocate_is_one_line_and_a_bug_is_a_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dejavu_torch.cli.parser.parse", lambda *_: {})
    monkeypatch.setattr(commands, "run_info", lambda: torch.empty(10**17))
    assert "not enough memory: can't allocate" in fails(capsys, "info", "a")
    monkeypatch.setattr(commands, "run_info", lambda: torch.zeros(2) @ torch.zeros(3))
    with pytest.raises(RuntimeError, match="inconsistent"):
        run("info", "a")


@pytest.fixture(scope="module")
def own_process(small_map: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """What commands behind one another in a process of their own print, and what they say on stderr."""
    code = (
        "import resource, sys, warnings; from dejavu_torch.cli import commands, main\n"
        "for count in (128, 1280):\n"
        "    main(['localize', sys.argv[1], f'sim:aerial?frames={count}', '--out', sys.argv[2]])\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
        f"main(['learn', {SMALL!r}, '--map', sys.argv[3], '--whitening.views', '1'])\n"
        "print('learned', file=sys.stderr)\n"
        "commands.print_map = lambda model: warnings.warn('two\\nlines')\nmain(['info', sys.argv[1]])"
    )
    folder = tmp_path_factory.mktemp("process")
    words = map(str, (small_map, folder / "m.csv", folder / "a.safetensors"))
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


@pytest.mark.slow
def test_localize_memory_does_not_grow_with_the_queries(own_process: tuple[str, str]) -> None:
    few, many = (int(line) for line in own_process[0].splitlines() if line.isdigit())
    # features of the further frames would take 8 MB, their frames 57 MB, the painted route takes 2 MB
    assert many - few < 8_000


def test_quiet_where_not_a_terminal_and_a_warning_of_a_library_is_one_line(
    own_process: tuple[str, str],
) -> None:
    assert own_process[1] == "learned\ndejavu: two lines\n"
