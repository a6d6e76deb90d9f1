"""The commands as a user meets them: their output, their files, and one line for every mistake."""

from __future__ import annotations

import csv
import os
import re
import shlex
import subprocess
import sys
import webbrowser
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import TEMPLATES, fails, frames, report_of, run, write_images

from dejavu_torch import DejaVu, SpectrogramAnalysis, TemplateMapper, open_source
from dejavu_torch.cli import COMMANDS, commands
from dejavu_torch.cli.names import FIRST_OPTIONS
from dejavu_torch.features.joined import Joined
from dejavu_torch.types import Training

SMALL = "sim:aerial?frames=96"
QUERY = "sim:aerial?frames=96&traverse=1"


@pytest.fixture(scope="module")
def small_map(tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "small.safetensors"
    run("learn", SMALL, "--map", path)
    return path


# what works


def test_localize_writes_one_row_a_query_as_python_finds_them(small_map, tmp_path):
    run("localize", small_map, QUERY, "--out", tmp_path / "m.csv")
    rows = list(csv.DictReader((tmp_path / "m.csv").open()))
    model = DejaVu.load(small_map)
    match = model.localize(open_source(QUERY))
    columns = ["query", "place", "score", "accepted", "probability", "confidence", "stale", "speed"]
    assert list(rows[0]) == [*columns, "query_name", "place_name"]
    assert [int(row["query"]) for row in rows] == list(range(96))
    assert match.probability is not None
    assert [float(row["probability"]) for row in rows] == pytest.approx(match.probability.tolist(), abs=1e-4)
    assert [int(row["place"]) for row in rows] == match.index.tolist()
    assert torch.allclose(torch.tensor([float(row["score"]) for row in rows]), match.score, rtol=1e-5)


def test_one_damaged_image_does_not_stop_the_others(small_map, tmp_path, capsys):
    images = (255 * open_source(QUERY)[:].permute(0, 2, 3, 1)).round().byte().numpy()
    folder = write_images(tmp_path / "q", images)
    damaged = folder / "40.png"
    damaged.write_bytes(b"no image")
    words = ("localize", small_map, folder, "--unordered", "--out", tmp_path / "m.csv")
    assert damaged.name in fails(capsys, *words)
    run(*words, "--skip_damaged")
    assert f"1 frame could not be read, such as 40: {damaged}" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "m.csv").open()))
    assert len(rows) == 96
    assert rows[40]["accepted"] == "0"
    assert sum(row["accepted"] == "1" for row in rows) > 80


def test_wide_descriptors_are_told_to_be_reduced_not_whitened(tmp_path, capsys):
    np.save(tmp_path / "wide.npy", np.random.default_rng(0).normal(size=(120, 300)).astype(np.float32))
    run("learn", tmp_path / "wide.npy", "--whitening", "none", "--map", tmp_path / "m.safetensors")
    run("info", tmp_path / "m.safetensors")
    told = capsys.readouterr().out
    assert told.count("descriptors of 300 dimensions are reduced to ") == 2
    assert "Whitening, " not in told


def test_convention_4_threshold_option_then_map_then_probability_then_all(small_map, tmp_path, capsys):
    route, out = tmp_path / "a.safetensors", tmp_path / "m.csv"

    def accepted():
        return sum(row["accepted"] == "1" for row in csv.DictReader(out.open()))

    run("localize", small_map, QUERY, "--out", out)
    assert "accepting answers with a probability of at least 0.5" in capsys.readouterr().out
    assert accepted() == sum(float(row["probability"]) >= 0.5 for row in csv.DictReader(out.open()))
    np.save(tmp_path / "other.npy", np.random.default_rng(0).integers(0, 256, (96, 64, 64, 3), np.uint8))
    run("localize", small_map, tmp_path / "other.npy", "--ordered", "--out", out)
    assert "do not look like a drive on this map" in capsys.readouterr().out
    assert accepted() == sum(float(row["probability"]) >= 0.5 for row in csv.DictReader(out.open())) == 0
    run("localize", small_map, QUERY, "--sequence", 5, "--out", out)  # which has no probabilities
    assert "every query with a finite score" in capsys.readouterr().out
    assert accepted() == 96
    single = "--match", "single"
    run("localize", small_map, QUERY, *single, "--threshold", ".inf", "--out", out)
    assert "accepting answers with" not in capsys.readouterr().out
    assert accepted() == 96
    score = sorted(float(row["score"]) for row in csv.DictReader(out.open()))[40]
    run("learn", SMALL, "--map", route, "--threshold", str(score))
    capsys.readouterr()
    run("localize", route, QUERY, *single, "--out", out)
    assert "accepting answers with" not in capsys.readouterr().out
    assert 35 <= accepted() <= 41
    run("localize", route, QUERY, "--out", out, "--threshold", "0")
    assert accepted() == 0


@pytest.mark.parametrize(
    "words",
    [
        ("--features", "my_network.Net"),
        ("--features", "[{class_path: my_network.Net}]"),
        ("--features", "my_network.made"),
        ("--config", "own.yaml"),
    ],
)
def test_classes_of_the_current_folder(tmp_path, monkeypatch, words):
    """Only if they are named: the folder may have modules of any name."""
    (tmp_path / "my_network.py").write_text(
        "import torch\nclass Net(torch.nn.Flatten):\n    pass\ndef made(): return Net()\n"
    )
    (tmp_path / "own.yaml").write_text("features: {class_path: my_network.Net}")
    np.save(tmp_path / "frames.npy", frames(64))
    monkeypatch.chdir(tmp_path)
    # as for an installed command, which does not look there by itself
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place and Path(place) != tmp_path])
    run("learn", "frames.npy", "--map", "a.safetensors")
    assert str(tmp_path) not in sys.path
    with pytest.raises(ImportError):
        import_module("my_network")
    run("learn", "frames.npy", "--map", "a.safetensors", *words)
    own = sys.modules.pop("my_network").Net()
    assert DejaVu.load("a.safetensors", Joined([own]) if "[" in words[1] else own).map.places == 64


def test_what_learn_says_to_do_next_can_be_done(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("learn", SMALL, "--map", tmp_path / "my map.safetensors")

    def next_words():
        words = shlex.split(capsys.readouterr().out.splitlines()[-1])
        assert words[:2] == ["next:", "dejavu"]
        return words[2:]

    run(*(QUERY if word == "QUERY" else word for word in next_words()))
    assert (tmp_path / "matches.csv").is_file()
    run(*("0" if word == "TRUTH" else word for word in next_words()))
    assert (tmp_path / "scores" / "index.html").is_file()


def test_a_route_that_does_not_repeat(tmp_path, capsys):
    noise = np.random.default_rng(0)
    for name in ("a", "b"):
        np.save(tmp_path / f"{name}.npy", noise.normal(size=(200, 40)).astype(np.float32))
    pair = tmp_path / "a.npy", tmp_path / "b.npy"
    run("compare", *pair, "--truth", "0", *TEMPLATES, "--out", tmp_path / "report")
    assert "this route does not repeat" in capsys.readouterr().out.splitlines()
    report = report_of(tmp_path / "report")
    assert report["recall_at_1"] == report["auc"] == report["accepted"] == 0
    assert report["periods"] == report["chunks"] == []
    run("localize", tmp_path / "report" / "map.safetensors", pair[1], "--out", tmp_path / "m.csv")
    assert "the map has no layers" in capsys.readouterr().out


def test_without_truth_there_are_no_scores_but_answers_that_ask_for_one(tmp_path, capsys):
    for name, start in (("a", 0), ("b", 16)):
        part = f"sim:aerial?frames=112&traverse={int(start > 0)}&start={start}&stop={start + 96}"
        pixels = 255 * torch.cat(list(open_source(part).batches(64))).permute(0, 2, 3, 1)
        np.save(tmp_path / f"{name}.npy", pixels.byte().numpy())
    pair, out = (tmp_path / "a.npy", tmp_path / "b.npy"), tmp_path / "report"
    run("compare", *pair, "--out", out)
    told, report, page = capsys.readouterr().out, report_of(out), (out / "index.html").read_text()
    assert report["auc"] is None
    assert not {"uncompressed", "stride", "null", "hog"} & report.keys()  # nothing could be scored
    rows = list(csv.DictReader((out / "matches.csv").open()))
    sure = [sum(float(row["probability"]) >= least for row in rows) for least in (0.9, 0.5)]
    assert report["probably_right"] == {"0.9": sure[0], "0.5": sure[1]}
    assert report["line"]["offset"] == 16
    for text in (told, page.partition("<details>")[0]):  # on the first screen
        assert (
            f"{sure[0]} of 96 answers have a probability of at least 0.9, {sure[1]} of at least 0.5" in text
        )
        assert "give --truth 16" in text
    for truth, contradicts in (("0", True), ("16", False)):
        run("evaluate", out / "matches.csv", f"--truth={truth}", "--out", tmp_path / "scores")
        assert capsys.readouterr().out.startswith("the answers contradict") == contradicts
        assert ("line" in report_of(tmp_path / "scores")) == contradicts
    run("localize", out / "map.safetensors", pair[1], "--filter", "--out", tmp_path / "m.csv")
    assert "of 96 answers have a probability" in capsys.readouterr().out


def test_a_negative_offset_and_a_map_that_is_given(tmp_path, capsys):
    pair, out = (tmp_path / "a.npy", tmp_path / "a.npy", "--tolerance", 0), tmp_path / "report"
    np.save(pair[0], frames(64))
    run("compare", *pair, "--truth", "-3", "--out", out)
    learned, before = report_of(out), (out / "map.safetensors").read_bytes()
    assert (learned["tolerance"], learned["with_answer"]) == (0, 61)
    told = capsys.readouterr().out
    assert "Learning took" in told
    assert told.splitlines()[-1] == f"next: open {out / 'index.html'}"
    run("compare", *pair, "--truth=-3", "--map", out / "map.safetensors", "--threshold", 0.01, "--out", out)
    assert (out / "map.safetensors").read_bytes() == before
    assert "Learning" not in capsys.readouterr().out
    given = report_of(out)
    assert given["seconds_learn"] == 0 < learned["seconds_learn"]
    assert {key: given[key] for key in ("auc", "null")} == {key: learned[key] for key in ("auc", "null")}


def test_a_comparison_needs_nothing_but_two_visits(tmp_path, monkeypatch, capsys):
    """Its folder is a new one, and the page is shown where there is a browser."""
    monkeypatch.chdir(tmp_path)
    shown = []
    monkeypatch.setattr(webbrowser, "open", lambda address: shown.append(address) or len(shown) < 2)
    pair = "sim:aerial?frames=40", "sim:aerial?frames=40&traverse=1", "--features", "HOG"
    run("compare", *pair, "--bytes", "2")
    assert shown == []
    assert report_of(tmp_path / "dejavu_report")["route_bytes_per_place"] == pytest.approx(2, rel=0.2)
    run("compare", *pair, "--bytes=4", "--open")
    assert report_of(tmp_path / "dejavu_report_2")["route_bytes_per_place"] == pytest.approx(4, rel=0.2)
    run("compare", *pair, "--open")
    assert "there is no browser here" in capsys.readouterr().out
    assert [address.rsplit("/", 2)[1] for address in shown] == ["dejavu_report_2", "dejavu_report_3"]
    assert "--bytes is many" in fails(capsys, "compare", *pair, "--bytes", "many")
    assert "--bytes without a number" in fails(capsys, "compare", *pair, "--bytes")
    assert "--bytes with TemplateMapper" in fails(
        capsys, "compare", *pair, "--bytes", 2, "--mapper", "TemplateMapper"
    )
    given = "--map", tmp_path / "dejavu_report" / "map.safetensors"
    assert "has its own settings" in fails(capsys, "compare", *pair, *given, "--bytes", 3)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "train"])
def test_help_reads_well(command, capsys):
    first, lines = FIRST_OPTIONS.get(command), {}
    for word in ("--help", "--help_all")[: 1 + (first is not None)]:
        with pytest.raises(SystemExit) as stop:
            run(command, word)
        out = capsys.readouterr().out
        assert stop.value.code == 0
        assert "known subclasses" not in out
        assert "<class" not in out
        lines[word] = out.splitlines()
        assert lines[word][0].startswith(f"usage: dejavu {command}")
    if first is None:
        assert len(lines["--help"]) < 165
        return
    listed = re.findall(r"^  (?:-\w.*, )?--(\w+)\b", "\n".join(lines["--help"]), re.MULTILINE)
    assert {*listed} == {*first, "help", "help_all"}
    assert len(lines["--help"]) < 70 < len(lines["--help_all"]) < 205
    assert f"`dejavu {command} --help_all` shows all options" in " ".join(lines["--help"])
    assert FIRST_OPTIONS.keys() <= COMMANDS.keys()


@pytest.fixture(scope="module")
def helped():
    """What a process in which every help is asked for prints, and what it and OpenMP say on stderr."""
    code = (
        "import sys, dejavu_torch.cli as cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit: assert 'torch' not in sys.modules\n"
        f"for command in {[name for name in COMMANDS if name not in ('train', 'completion')]}:\n"
        "    try: cli.main([command, '--help'])\n"
        "    except SystemExit: pass\n"
        "heavy = 'kornia', 'matplotlib', 'pytorch_lightning', 'torchmetrics', 'av', 'numba', 'cv2', 'scipy'\n"
        "print([name for name in (*heavy, 'dejavu_torch.cli.completion', 'shtab') if name in sys.modules])"
    )
    kept = {name: value for name, value in os.environ.items() if "OMP_" not in name}
    environment = {**kept, "OMP_DISPLAY_ENV": "verbose"}
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return ran.stdout, ran.stderr


def test_help_loads_nothing_that_only_a_run_needs(helped):
    own = re.sub(
        r"\s*OPENMP DISPLAY ENVIRONMENT BEGIN.*?OPENMP DISPLAY ENVIRONMENT END\s*", "", helped[1], flags=re.S
    )
    assert (helped[0].splitlines()[-1], own) == ("[]", "")


@pytest.mark.skipif(sys.platform != "linux", reason="libgomp is the OpenMP of Linux builds")
def test_threads_spin_only_for_a_moment_while_they_wait(helped):
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in helped[1]
    assert "GOMP_SPINCOUNT = '10000'" in helped[1]


def test_several_sources_are_one_route(tmp_path):
    images = frames(60, size=16)
    every = write_images(tmp_path / "every", images)
    parts = write_images(tmp_path / "a", images[:25]), write_images(tmp_path / "b", images[25:])
    settings = ("--whitening", "none", "--calibration", "none", "--mapper.route_bytes_per_place", "20")
    run("learn", *parts, "--map", tmp_path / "parts.safetensors", *settings)
    run("learn", every, "--map", tmp_path / "every.safetensors", *settings)
    one, other = (DejaVu.load(tmp_path / f"{name}.safetensors") for name in ("parts", "every"))
    assert one.frame_names[24:26] == ["a/24.png", "b/0.png"]
    assert one.map.places == other.map.places == 60
    queries = torch.rand(3, 1, 16, 16)
    assert torch.allclose(one(queries), other(queries), atol=0.05)


# a map that is evaluated as it is


@pytest.fixture
def trained_map(tmp_path):
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


def test_compare_judges_the_map_of_a_file(trained_map, capsys):
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
    capsys.readouterr()
    run("info", trained_map, "--features", "torch.nn.Flatten")
    assert "trained for 30 steps, seed 3" in capsys.readouterr().out
    (folder / "c.yaml").write_text("batch_size: 9\n")
    for words in (["--mapper.metric", "l2"], ["--config", folder / "c.yaml"], ["--second_truth=0"]):
        error = fails(capsys, "compare", *pair, "--map", trained_map, "--out", folder / "new", *words)
        assert f"{str(words[0]).partition('=')[0]}: the map of --map has its own settings" in error
    assert not (folder / "new").exists()


# what is refused

WRONG = {  # a line of words behind `dejavu`, and what its one line holds
    "dance": ("dance", "localize"),
    "bench scale --out r --places 8": ("python -m benchmarks", "clone"),
    "compare a b --tolerance 5m --out o": ("--tolerance is 5m", "metres", "--truth metres:5"),
    "demo --seed x": ("--seed is x", "expected int"),
    "learn a.npy --map m --threshold high": ("--threshold is high", "expected float"),
    "learn a.npy --map m --weight_bits 4": ("--weight_bits is 4", "[8, 32]"),
    "learn a.npy --map m --seed 99999999999999999999": ("--seed is 99999999999999999999", "at most"),
    "learn a.npy --map m --features hog": ("not hog; did you mean HOG?",),
    "learn a.npy --map m --velocity none": ("not none; did you mean null?",),
    "learn a.npy --map m --preprocess.size none": ("--preprocess.size is none; expected null, or int",),
    "learn a.npy --map m --features short": ("--features", "import path of a class, not short"),
    "learn a.npy --map m --features no.such.Net": ("--features", "'no'"),
    "learn a.npy --map m --features torch.nn.Linear": ("--features.in_features", "required"),
    "learn a.npy --map m --features.cel 3": ("--features.cel", "not accepted"),
    "learn a.npy --map m --whitening unc": ("class, none or a map file, not unc",),
    "learn a.npy --map m --whitening none --whitening.bits 4": ("--whitening.bits", "no settings"),
    "learn a.npy --map m --whitening.bits 5": ("--whitening.bits is 5", "4, 8, 16"),
    "learn a.npy --map m --velocity.corners 3": ("--velocity.corners is 3", "Sequence"),
    "learn a.npy --map m --config local_maxima --mapper.periods.windw 3": ("--mapper.periods.windw",),
    "learn a.npy --map m --config local_maxima --mapper.periods.window 3": ("window=3",),
    "learn a.npy --map m --config key.yaml": ("--mapper.stepp", "not accepted", "key.yaml"),
    "learn a.npy --map m --config part.yaml": ("--mapper", "HOG", "subclass of Mapper"),
    "learn a.npy --map m --config nowhere.yaml": ("nowhere.yaml is not there", "paper", "train_road"),
    "learn a.npy --map m --config": ("--config", "expected one argument"),
    "learn a.npy --map m --conf paper": ("--conf",),  # options are not guessed from their beginnings
    "learn a.npy --map m.safetensors --second c.npy": ("6 frames", "60 frames in order", "--second_truth"),
    "learn a.npy --map m.safetensors --average c.npy": ("6 frames", "60 frames in order", "--average_truth"),
    "learn a.npy --map m.safetensors --calibration c.npy": (
        "6 frames",
        "60 frames in order",
        "--calibration_truth",
    ),
    "learn nowhere --map m.safetensors": ("nowhere is not there", "expected"),
    "learn nowhere --map a.txt": ("--map a.txt", "a.safetensors"),
    "learn a.npy": ("required: --map",),
    "localize m": ("required: source, --out",),
    "localize m a.npy --out m.csv --speeds [fast]": ("--speeds", "fast", "float"),
    "compare a.npy b.npy --out r --config paper": ("18 places", "1024", "--mapper.periods.short shrink"),
    "evaluate nowhere.csv --truth 0 --out new/r": ("nowhere.csv",),
    "compare a.npy b.npy --out new/r --map m -cpaper": ("-cpaper: the map of --map has its own settings",),
    "live m a.npy --page many": ("--page is many", "int"),
    "completion fish": ("dejavu: shell is fish; expected one of ['bash', 'zsh']",),
    "train": ("no stage given", "fit, validate, test, export"),
    "train fit --data.source a.npy --model.lr fast": ("--model.lr is fast", "float"),
    "train fit --data.source a.npy --trainer.accelerator abacus": ("accelerator='abacus'", "cpu"),
    f"train fit --trainer.max_steps {10**30}": ("--trainer.max_steps", "at most"),
}


@pytest.mark.parametrize(
    "line", [pytest.param(one, marks=[pytest.mark.slow] * one.startswith("train")) for one in WRONG]
)
def test_what_is_wrong_is_told_by_options_and_without_python(line, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, count in (("a", 18), ("b", 18), ("c", 6)):
        np.save(f"{name}.npy", frames(count))
    Path("part.yaml").write_text("mapper: {class_path: dejavu_torch.HOG}\n")
    Path("key.yaml").write_text("mapper:\n  class_path: SpectralMapper\n  init_args: {stepp: 3}\n")
    there = {*tmp_path.iterdir()}
    error = fails(capsys, *line.split())
    assert [word for word in WRONG[line] if word not in error] == [], error
    assert not re.search(r"<class|typing\.|Parser key|NoneType|\bNone\b|import path string", error), error
    assert {*tmp_path.iterdir()} == there


def test_what_lacks_memory_is_one_line_and_a_bug_is_a_traceback(capsys, monkeypatch):
    def raises(problem):
        raise problem

    monkeypatch.setattr("dejavu_torch.cli.parser.parse", lambda *_: {})
    for work, told in (
        (lambda: torch.empty(10**17), "not enough memory: can't allocate"),
        (lambda: raises(MemoryError("for\nan array")), "not enough memory: for an array"),
        (lambda: raises(MemoryError()), "not enough memory: it ran out"),
        (lambda: raises(ImportError("libtorch.so: cannot allocate memory")), "not enough memory"),
        (lambda: raises(RecursionError("maximum recursion depth exceeded")), "nested too deeply"),
    ):
        monkeypatch.setattr(commands, "run_info", work)
        assert told in fails(capsys, "info", "a")
    monkeypatch.setattr(commands, "run_info", lambda: torch.zeros(2) @ torch.zeros(3))
    with pytest.raises(RuntimeError, match="inconsistent"):
        run("info", "a")


def test_quiet_where_not_a_terminal_and_a_warning_of_a_library_is_one_line(small_map, tmp_path):
    code = (
        "import sys, warnings; from dejavu_torch.cli import commands, main\n"
        f"main(['learn', {SMALL!r}, '--map', sys.argv[2], '--whitening.views', '1'])\n"
        "print('learned', file=sys.stderr)\n"
        "commands.print_map = lambda model: warnings.warn('two\\nlines')\nmain(['info', sys.argv[1]])"
    )
    words = [sys.executable, "-c", code, str(small_map), str(tmp_path / "a.safetensors")]
    assert subprocess.run(words, capture_output=True, text=True).stderr == "learned\ndejavu: two lines\n"
