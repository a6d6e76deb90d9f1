"""What README and every page of docs show works as it stands there."""

from __future__ import annotations

import inspect
import io
import json
import os
import re
import shlex
import subprocess
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path

import pytest
import torch
import yaml

from benchmarks.__main__ import BENCHES
from dejavu_torch import DescriptorTask, TemplateTask
from dejavu_torch.cli import COMMANDS, train
from dejavu_torch.cli.names import function_of
from dejavu_torch.cli.parser import command_parser
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.model_file import CLASSES

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "benchmarks" / "results"
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted(MEASURED.glob("*.md"))]
}
# words; 900 elsewhere
LONGEST = {"README.md": 800, "docs/results/index.md": 700, "docs/reference/files.md": 1000}
OF_OTHER_TOOLS = {"--save_descriptors"}
FENCED = re.compile(r"(<!-- not run: [^>]+-->\n+)?^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BLOCKS = {
    name: [found[3] for found in FENCED.finditer(text) if found[2] in ("python", "py") and not found[1]]
    for name, text in PAGES.items()
}


def with_block(*words):
    """Blocks of all pages that have these words."""
    return [
        pytest.param(found[3], id=f"{name}:{found[2]}")
        for name, text in PAGES.items()
        for found in FENCED.finditer(text)
        if all(word in found[3] for word in words)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("page", [name for name, blocks in BLOCKS.items() if blocks])
def test_python_runs_and_its_shapes_are_true(page, tmp_path, monkeypatch):
    """The blocks of a page one after another; a comment ahead of one says why it is not run."""
    monkeypatch.chdir(tmp_path)
    space = {"__name__": "__main__"}
    for block in BLOCKS[page]:
        exec(compile(block, page, "exec"), space)
        for name, shape in re.findall(r"^(\w+) = .*# \(([\d,]+)\)", block, re.MULTILINE):
            assert str(tuple(space[name].shape)).replace(" ", "") == f"({shape})", name


def test_readme_shows_the_whole_in_twelve_lines():
    (block,) = BLOCKS["README.md"]
    assert len([line for line in block.splitlines() if line.strip()]) <= 12
    assert all(word in block for word in (".learn(", ".localize(", ".backward()", ".save("))


@pytest.mark.parametrize("page", [name for name in PAGES if not name.startswith("benchmarks")])
def test_a_page_is_short(page):
    """The tables of results do not count, nor those that are generated."""
    text = re.sub(r"<!-- table: .*?<!-- end of table -->", "", PAGES[page], flags=re.S)
    text = re.sub(r"^\|.*\n", "", text, flags=re.M) if "/results/" in page else text
    assert len(text.split()) <= LONGEST.get(page, 900)


@cache
def kept():
    """Files of the repository, those that are about to be added among them."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a clone of the repository")
    return {ROOT / line for line in listed.stdout.splitlines()}


def test_every_linked_file_is_there():
    """Where GitHub looks for it: generated and ignored files are not."""
    lost = []
    for name, text in PAGES.items():
        page = ROOT / name
        for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)):
            file, _, anchor = link.partition("#")
            target = Path(os.path.normpath(page.parent / file)) if file else page
            known = re.match(r"\w+:", link) or (
                (target in kept() or target.is_dir()) and (not anchor or anchor in anchors_of(target))
            )
            lost += [] if known else [f"{name}: {link}"]
    assert len(PAGES) > 20
    assert lost == []


@cache
def anchors_of(page):
    """Of the headings of a page."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = [line.lstrip("# ").lower() for line in text.splitlines() if line[:1] == "#"]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in headings}


class Understood(Exception):
    """A command line of `dejavu train` has been parsed."""


PROGRAMS = "dejavu|python -m benchmarks"


class ParseOnly(train.TrainCLI):
    """Reads a command line, and neither seeds, instantiates nor runs anything."""

    def parse_arguments(self, parser, args):
        super().parse_arguments(parser, args)
        raise Understood


@cache
def parser_of(program, name):
    """The parser of a command, which takes as long to make as to read a line with."""
    if program != "dejavu":
        return command_parser(name, BENCHES[name])
    return command_parser(name, function_of(name))


def understand(line):
    """Parse a command as it is shown, without running it."""
    program, line = re.match(f"({PROGRAMS}) (.*)", line, re.DOTALL).groups()
    name, *words = shlex.split(line, comments=True)
    for end in {"|", ">", ">>", "&&", ";", "&"} & {*words}:  # what the shell does with it
        words = words[: words.index(end)] if end in words else words
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)  # where the configs lie
        if program != "dejavu" or name != "train":
            parser_of(program, name).parse_args(words)
            return
        patch.setattr(train, "TrainCLI", ParseOnly)
        with pytest.raises(Understood):
            train.run_train(words)


def lines_shown(page):
    """Command lines of a page, in blocks and in prose, with the variables of its shell put in."""
    text = PAGES[page].replace("\\\n", " ")
    variables = re.findall(r"^(\w+)=(?:[\"(]|\$\()(.*)[\")]$", text, re.MULTILINE)
    for name, value in variables + re.findall(r"^for (\w+) in ([^\s;]+)", text, re.MULTILINE):
        value = "weights.pth" if "python" in value else value
        for used in (rf'"\$\{{{name}\[@\]\}}"', rf"\$(?:{name}\b|\{{{name}\}})"):
            text = re.sub(used, lambda _, value=value: value, text)
    setting = r"(?:[A-Z_]+=\S+ )*"  # of the environment
    shown = re.findall(rf"^{setting}((?:{PROGRAMS}) .*)$", text, re.MULTILINE)
    inline = re.findall(rf"`{setting}((?:{PROGRAMS}) [^`]+)`", text)
    shown += [line for line in inline if " -" in line.removeprefix("python -m")]
    return [
        line
        for line in dict.fromkeys(shown)
        if not re.search(r"help(_all)?\b|--version|\.\.\.|COMMAND|my_module", line)
    ]


@pytest.mark.parametrize("page", [name for name in PAGES if lines_shown(name)])
def test_every_command_shown_is_understood(page, tmp_path):
    """A configuration that the page shows is in the file that its commands name."""
    for found in FENCED.finditer(PAGES[page]):
        if found[2] == "yaml":
            (tmp_path / "shown.yaml").write_text(found[3])
    for line in lines_shown(page):
        understand(re.sub(r"(?<=--config )(?!configs/)[\w/]+\.yaml", str(tmp_path / "shown.yaml"), line))


def test_commands_are_shown():
    shown = {" ".join(line.split()[:2]) for page in PAGES for line in lines_shown(page)}
    assert {f"dejavu {name}" for name in COMMANDS} - shown <= {"dejavu info", "dejavu completion"}


@cache
def options():
    """Names of options of all commands, and of the arguments of the classes that they take."""
    parsers = [parser_of("dejavu", name) for name in COMMANDS if name != "train"]
    parsers += [parser_of("python -m benchmarks", name) for name in BENCHES]
    classes = [*CLASSES, Augmentation, train.RouteData, DescriptorTask, TemplateTask]
    printed = io.StringIO()
    with redirect_stdout(printed), pytest.raises(SystemExit):
        train.run_train(["fit", "--help"])
    known = {option for parser in parsers for option in parser._option_string_actions}
    known |= {*re.findall(r"--[a-z][\w.]*", printed.getvalue())}
    return known | {f".{name}" for one in classes for name in inspect.signature(one).parameters}


@pytest.mark.parametrize("page", PAGES)
def test_options_in_prose_exist(page):
    """`--mapper.hold .85` is known by its last part."""
    prose = re.sub(r"^```.*?^```$", "", PAGES[page], flags=re.MULTILINE | re.DOTALL)
    shown = re.findall(r"`(--[a-z]\w*(?:\.\w+)*)[^`]*`", prose)
    unknown = [
        name
        for name in dict.fromkeys(shown)
        if name not in OF_OTHER_TOOLS
        and not name.startswith("--features.network.")  # of the user's own network
        and name not in options()
        and "." + name.rpartition(".")[2] not in options()
        and not name.endswith("help")
    ]
    assert unknown == []


TRAINING = [
    pytest.param(option, id=f"{name}:{option}")
    for name, text in PAGES.items()
    for option in re.findall(r"`(--(?:model|data|trainer)\.[^`*\s]+ [^`]+)`", text.replace("\n  ", " "))
    if "my_module" not in option
]


@pytest.mark.parametrize("option", TRAINING)
def test_options_of_training_in_prose_are_understood(option):
    """Without a preset, by the preset of phase templates, or by that of spectral maps."""
    templates = ".mapper.periods" in option
    preset = "train_residues" if templates else "train_road"
    for config in ("", f"--config {preset}"):
        understand(f"dejavu train fit {config} --data.source sim:aerial {option}")


@pytest.mark.parametrize("shown", with_block("class_path:"))
def test_yaml_is_understood(shown, tmp_path):
    (tmp_path / "shown.yaml").write_text(shown)
    if {*yaml.safe_load(shown)} & {"trainer", "model", "data"}:
        config = f"--config train_road --config {tmp_path / 'shown.yaml'}"
        understand(f"dejavu train fit {config} --data.source sim:aerial")
    else:
        understand(f"dejavu learn morning/ --map route.safetensors --config {tmp_path / 'shown.yaml'}")


@pytest.mark.slow
@pytest.mark.parametrize("shown", with_block("MapExport()", "RouteData("))
def test_training_in_python_as_shown(shown, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shorter = {"max_steps=3000": "max_steps=2, logger=False", "morning/": "sim:aerial?frames=80"}
    for given, short in shorter.items():
        assert given in shown
        shown = shown.replace(given, short)
    space = {"my_backbone": SmallCNN(dimension=4, resize=(16, 16), widths=(2,), squeeze=2)}
    exec(shown, space)
    assert space["model"](torch.rand(2, 3, 64, 64)).shape == (2, 80)


@pytest.mark.parametrize("shown", with_block('"reference_frame":'))
def test_the_line_of_json_shown_has_the_keys_of_those_printed(shown):
    from dejavu_torch.cli.live import line_of
    from dejavu_torch.data.camera import Frame
    from dejavu_torch.live.localizer import LiveMatch

    printed = line_of(Frame(0, 0.0, torch.zeros(1, 1, 1)), LiveMatch(0, 0, "", 0.0, 1.0, 1.0, True, 1.0))
    assert list(json.loads(shown)) == list(json.loads(printed))
