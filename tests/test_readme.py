"""What README and docs show works as it stands there."""

from __future__ import annotations

import json
import re
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.__main__ import BENCHES
from dejavu_torch import DejaVu, ImposedPeriods, PlaceFilter, TemplateMapper
from dejavu_torch.cli import commands, train
from dejavu_torch.cli.parser import command_parser
from dejavu_torch.features.cnn import SmallCNN

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
DOCS = {path.stem: path.read_text() for path in (ROOT / "docs").glob("*.md")}
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
TRAINING = DOCS["training"].replace("\n  ", " ")
OPTIONS = [
    option
    for option in re.findall(r"`(--(?:model|data|trainer)\.[^`*\s]+ [^`]+)`", TRAINING)
    if "my_module" not in option
]


def test_python_runs_and_its_shapes_are_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    (block,) = BLOCKS
    assert len([line for line in block.splitlines() if line.strip()]) <= 12
    assert block.count("1024") == 5
    exec(block.replace("1024", "128"), space)  # a shorter route
    assert tuple(space["frames"].shape) == (4, 3, 64, 64)
    assert tuple(space["scores"].shape) == (4, 128)
    assert space["frames"].grad.abs().sum() > 0
    assert (tmp_path / "road.safetensors").is_file()


def test_every_linked_file_is_there() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    lost = []
    for page in pages:
        links = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
        assert links
        for link in links:
            file, _, anchor = link.partition("#")
            target = page.parent / file if file else page
            known = link.startswith("http") or (
                target.exists() and (not anchor or anchor in anchors_of(target))
            )
            lost += [] if known else [f"{page.name}: {link}"]
    assert lost == []


def anchors_of(page: Path) -> set[str]:
    """Of the headings of a page."""
    headings = [line.lstrip("# ").lower() for line in page.read_text().splitlines() if line[:1] == "#"]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in headings}


class Understood(Exception):
    """A command line of `dejavu train` has been parsed."""


PROGRAMS = "dejavu|python -m benchmarks"


class ParseOnly(train.TrainCLI):
    """Reads a command line, and neither seeds, instantiates nor runs anything."""

    def parse_arguments(self, parser: Any, args: Any) -> None:
        super().parse_arguments(parser, args)
        raise Understood


@cache
def parser_of(program: str, name: str) -> Any:
    """The parser of a command, which takes as long to make as to read a line with."""
    return command_parser(name, getattr(commands, f"run_{name}") if program == "dejavu" else BENCHES[name])


def understand(line: str) -> None:
    """Parse a command as it is shown, without running it."""
    program, line = re.match(f"({PROGRAMS}) (.*)", line, re.DOTALL).groups()
    name, *words = shlex.split(line, comments=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)  # where the configs lie
        if program != "dejavu" or name != "train":
            parser_of(program, name).parse_args(words)
            return
        patch.setattr(train, "TrainCLI", ParseOnly)
        with pytest.raises(Understood):
            train.run_train(words)


SHOWN = ("training", "real_routes", "spectral_maps", "sequences", "storage", "live", "rejection", "growing")


@pytest.mark.parametrize("page", ["README", *SHOWN, "scale", "cluster"])
def test_every_command_shown_is_understood(page: str) -> None:
    text = (DOCS | {"README": README})[page]
    setting = r"(?:[A-Z_]+=\S+ )*"  # of the environment
    shown = re.findall(rf"^{setting}((?:{PROGRAMS}) .*)$", text.replace("\\\n", " "), re.MULTILINE)
    inline = re.findall(rf"`{setting}((?:{PROGRAMS}) [^`]+)`", text)
    shown += [line for line in inline if " -" in line.removeprefix("python -m") and "--help" not in line]
    assert len(shown) >= 2
    for line in dict.fromkeys(shown):
        understand(line)


def test_every_command_on_pretrained_networks_is_understood() -> None:
    """With the words that its shell puts in; what is loaded is not asked for here."""
    pytest.importorskip("efficientnet_lite_pytorch")
    text = DOCS["pretrained"].replace("\\\n", " ").replace("$weights", "weights.pth")
    (lite,) = re.findall(r'^lite="(.*)"$', text, re.MULTILINE)
    (road,) = re.findall(r"^road=\((.*)\)$", text, re.MULTILINE)
    text = text.replace("$lite", lite).replace('"${road[@]}"', road)
    shown = re.findall(r"^(?:dejavu|python -m benchmarks) .*$", text, re.MULTILINE)
    assert len(shown) == 9
    for line in shown:
        understand(line)


def test_lines_over_cycles_are_those_of_the_code_shown(capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = re.findall(r"```python\n(.*?)```", DOCS["spectral_maps"], re.DOTALL)
    exec(shown, {})
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = [
        line.strip("| ").split(" | ")
        for line in DOCS["spectral_maps"].splitlines()
        if line.startswith(("| dft", "| dct"))
    ]
    assert len(rows) == len(printed) == 12
    for row, line in zip(rows, printed, strict=True):
        assert row[:3] == line[:3]
        assert [float(cell) for cell in row[3:]] == pytest.approx([float(cell) for cell in line[3:]], rel=0.1)


def test_the_python_on_rejection_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = re.findall(r"```python\n(.*?)```", DOCS["rejection"], re.DOTALL)
    exec(shown.replace("frames=400", "frames=100"), {})
    assert capsys.readouterr().out.count("tensor(") == 2


@pytest.mark.parametrize("option", OPTIONS)
def test_options_that_the_text_on_training_names_are_understood(option: str) -> None:
    understand(f"dejavu train fit --config train_small --data.source sim:aerial {option}")


def test_yaml_on_training_is_understood(tmp_path: Path) -> None:
    (shown,) = re.findall(r"```yaml\n(.*?)```", DOCS["training"], re.DOTALL)
    (tmp_path / "stop.yaml").write_text(shown)
    config = f"--config train_small --config {tmp_path / 'stop.yaml'}"
    understand(f"dejavu train fit {config} --data.source sim:aerial")


def test_export_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "road").mkdir()
    shown = re.findall(r"```py\n(.*?)```", DOCS["training"], re.DOTALL)[-1]
    features = SmallCNN(dimension=4, resize=(16, 16), widths=(2,), squeeze=2).eval()
    model = DejaVu(features, mapper=TemplateMapper(ImposedPeriods([3, 4]))).learn(torch.rand(50, 3, 64, 64))
    model.save("road/map.safetensors")
    exec(shown, {})
    frames, program = torch.rand(5, 3, 64, 64), torch.export.load(tmp_path / "road.pt2")
    torch.testing.assert_close(program.module()(frames), model.eval()(frames))


def test_training_in_python_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shown = re.findall(r"```py\n(.*?)```", DOCS["training"], re.DOTALL)[0]
    shorter = {"max_steps=3000": "max_steps=2, logger=False", "morning/": "sim:aerial?frames=80"}
    for given, short in shorter.items():
        assert given in shown
        shown = shown.replace(given, short)
    space: dict[str, Any] = {"my_backbone": SmallCNN(dimension=4, resize=(16, 16), widths=(2,), squeeze=2)}
    exec(shown, space)
    assert space["model"](torch.rand(2, 3, 64, 64)).shape == (2, 80)


def test_a_filter_is_learned_as_the_documentation_shows() -> None:
    (shown,) = re.findall(r"```python\n(.*?)```", DOCS["sequences"], re.DOTALL)
    quick = (("max_epochs=30", "max_epochs=2"), ("=240", "=60"))
    for slow, fast in quick:
        assert slow in shown
        shown = shown.replace(slow, fast)
    space: dict[str, Any] = {}
    exec(shown, space)
    learned, fresh = space["learn"].filter, PlaceFilter()
    near, scores = space["near"], space["scores"]
    right = [float((one.posterior(scores)[:, :-1] * near).sum(1).log().mean()) for one in (fresh, learned)]
    assert right[1] > right[0]
    assert (space["match"].index - torch.arange(60)).abs().median() <= 5


def test_live_in_python_as_shown(capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = re.findall(r"```python\n(.*?)```", DOCS["live"], re.DOTALL)
    assert shown.count("frames=256") == 2
    space: dict[str, Any] = {}
    exec(shown.replace("frames=256", "frames=64"), space)
    assert capsys.readouterr().out == f"{space['match'].place} True\n"
    assert abs(space["match"].place - 63) <= 5


def test_the_line_of_json_shown_has_the_keys_of_those_printed() -> None:
    from dejavu_torch.cli.live import line_of
    from dejavu_torch.data.camera import Frame
    from dejavu_torch.live.localizer import LiveMatch

    (shown,) = re.findall(r"```json\n(.*?)```", DOCS["live"], re.DOTALL)
    printed = line_of(Frame(0, 0.0, torch.zeros(1, 1, 1)), LiveMatch(0, 0, "", 0.0, 1.0, 1.0, True, 1.0))
    assert list(json.loads(shown)) == list(json.loads(printed))
