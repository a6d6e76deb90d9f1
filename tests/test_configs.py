"""The presets: what they hold, and that they come with the package."""

from __future__ import annotations

import inspect
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from helpers import refused

from dejavu_torch import DejaVu, InputError
from dejavu_torch.cli.commands import run_learn
from dejavu_torch.cli.parser import parse
from dejavu_torch.cli.presets import find_config, preset_names
from dejavu_torch.evaluation.reproduce import paper_model
from dejavu_torch.model_file import PARTS, recipe_of

ROOT = Path(__file__).parents[1]
PRESETS = ["default", "local_maxima", "paper"]


def model_of(name):
    model = parse("learn", run_learn, ["x", "--map", "y", "--config", name])["model"]
    assert isinstance(model, DejaVu)
    return model


def settings(model):
    parts = {name: getattr(model, name) for name in PARTS}
    recipes = {name: part and recipe_of(part)._asdict() for name, part in parts.items()}
    rest = {name: value for name, value in model.settings().items() if name not in PARTS}
    return recipes | rest | {"whitening": recipes["whitening"] or "none"}


def written(name):
    """A preset as it is written, with classes by their names."""

    def plain(value):
        if isinstance(value, list):
            return [plain(one) for one in value]
        if not isinstance(value, dict):
            return value
        names = {"class_path": value["class_path"].rpartition(".")[2]} if "class_path" in value else {}
        return {key: plain(one) for key, one in value.items()} | names

    found = plain(yaml.safe_load((ROOT / "configs" / f"{name}.yaml").read_text()))
    return found


def test_default_yaml_is_the_constructors_defaults():
    assert settings(model_of("default")) == settings(DejaVu())


@pytest.mark.parametrize("name", PRESETS)
def test_presets_spell_out_every_argument(name):
    assert set(written(name)) == set(inspect.signature(DejaVu).parameters)
    given = {"features": None} if name == "default" else {}  # they depend on the whitening
    assert written(name) == settings(model_of(name)) | given


def test_convention_3_paper_yaml_is_the_letter():
    mapper = written("paper")["mapper"]["init_args"]
    letter = {"window": 1024, "hop": None, "min_period": 8, "strongest": 2, "peaks": "bins"}
    letter |= {"false_alarm": None, "short": "refuse"}
    found = mapper["periods"]["init_args"]
    assert {name: found[name] for name in letter} == letter
    assert (mapper["metric"], mapper["reduction"], mapper["temperature"]) == ("l1", "sum", None)


def test_reproduce_uses_the_papers_letter():
    assert settings(paper_model()) == settings(model_of("paper"))


def test_a_preset_is_found_by_name_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {path.stem for path in (ROOT / "configs").glob("*.yaml")}
    assert set(preset_names()) > names
    for name in preset_names():
        assert find_config(name) == ROOT / "configs" / f"{name}.yaml"
    (tmp_path / "paper").mkdir()  # such as a report of it
    assert find_config("paper") == ROOT / "configs" / "paper.yaml"
    (tmp_path / "mine.yaml").write_text("batch_size: 9")
    assert find_config("mine.yaml") == Path("mine.yaml")
    with pytest.raises(InputError, match=r"mine is not there.*train_road"):
        find_config("mine")


def test_a_config_stands_in_its_place():
    """Ahead of the options, which overrule it; the last of several counts."""
    words = ["--batch_size", "9", "x", "--config", "paper", "--config=local_maxima", "--map", "y"]
    model = parse("learn", run_learn, words)["model"]
    assert (model.mapper.periods.peaks, model.batch_size) == ("local", 9)


@pytest.mark.slow
def test_the_wheel_holds_package_and_presets(tmp_path):
    """Built and unpacked without a network; then used from elsewhere."""
    tree = tmp_path / "tree"
    tree.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    for name in ("dejavu_torch", "configs"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "import sys, setuptools.build_meta as b; b.build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, tmp_path], cwd=tree, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    package = tmp_path / "installed" / "dejavu_torch"
    found = (path for path in (ROOT / "dejavu_torch").rglob("*") if path.is_file())
    files = {path.relative_to(ROOT) for path in found if "__pycache__" not in path.parts}
    assert {path for path in files if not (tmp_path / "installed" / path).is_file()} == set()
    presets = {path.relative_to(ROOT) for path in (ROOT / "configs").rglob("*.yaml")}
    assert {path for path in presets if not (package / path).is_file()} == set()
    code = "import dejavu_torch.cli.presets as p; print(p.find_config('train_road'))"
    python = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(package.parent)!r}); {code}"]
    ran = subprocess.run(python, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert Path(ran.stdout.strip()) == package / "configs" / "train_road.yaml"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: " + "[" * 5_000, "maximum recursion depth"),
        ("batch_size: 3\nbatch_size: 4", "line 2: batch_size appears twice"),
        ("mapper: {class_path: a, class_path: b}", "class_path appears twice"),
        (" 1\n".join(f"a{i % 999}:" for i in range(1_000)), "a0 appears twice"),
        ("", "holds no options"),
        ("- 3", "holds no options"),
        ("a: *b", "no YAML"),
        ("a: 1\n---\nb: 2", "no YAML"),
        ("a: !!python/object/apply:os.mkdir ['ran']", "no YAML"),
        ("#" * 300_000, "larger than"),
        (b"\xff\xfea: 1", "UTF-8 text"),
        (b"a: \x07", "no YAML"),
    ],
    ids=range(12),
)
def test_a_config_that_is_none_is_refused_ahead_of_the_loader(tmp_path, text, words):
    path = tmp_path / "mine.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with refused("mine.yaml", words, "expected a YAML file of options"):
        parse("learn", run_learn, ["x", "--map", "y", f"--config={path}"])


@pytest.mark.parametrize("word", ["", "--batch_size="])
def test_an_empty_word_is_refused(word):
    with refused("is empty; expected"):
        parse("learn", run_learn, ["x", "--map", "y", word])
