"""`dejavu train` as a user meets it: files, figures, what it says, and one line for every mistake."""

from __future__ import annotations

import csv
import importlib.util
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from test_task import FRAMES, footage
from torch import nn

from dejavu_torch import DejaVu
from dejavu_torch.cli import main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import judge

CONFIG = """
model:
  backbone:
    class_path: dejavu_torch.features.cnn.SmallCNN
    init_args: {dimension: 8, channels: 1, resize: [16, 16], widths: [4, 8], squeeze: 4}
  periods:
    class_path: dejavu_torch.periods.imposed.ImposedPeriods
    init_args: {periods: [3, 4, 5], bin: 2}
data: {source: one.npy, batch_size: 20, tolerance: 2}
trainer: {max_steps: 4, accelerator: cpu, enable_progress_bar: false, default_root_dir: run}
"""
MINE = """
import torch
from torch import nn

class Plain(nn.Module):
    def __init__(self, dimension: int = 8) -> None:
        super().__init__()
        self.linear = nn.Linear(256, dimension)
        self.calls = 0
    def forward(self, frames):
        self.calls += self.training
        return self.linear(frames.flatten(1))

class Deep(Plain):
    def forward(self, frames):
        return super().forward(frames)[..., None]

class Late(Plain):
    def forward(self, frames):
        return super().forward(frames) * (float("nan") if self.calls > 2 else 1.0)

class Interrupted(Plain):
    def forward(self, frames):
        if self.calls > 2:
            raise KeyboardInterrupt
        return super().forward(frames)
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with traverses, a config, a user's module, and a training."""
    folder = tmp_path_factory.mktemp("train")
    arrays = {"one": footage(), "two": footage(0.1), "short": footage()[:2], "single": footage()[:1]}
    arrays |= {"thirty": footage()[:30], "large": footage(side=24)}
    for name, frames in arrays.items():
        np.save(folder / f"{name}.npy", frames.numpy())
    (folder / "train.yaml").write_text(CONFIG)
    (folder / "mine.py").write_text(MINE)
    (folder / "a_file").write_text("not a folder, not a checkpoint")
    (folder / "empty").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train("fit")
    return folder


@pytest.fixture
def folder(made: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(made)
    monkeypatch.syspath_prepend(str(made))
    return made


def train(command: str, *options: object, config: str = "train.yaml") -> None:
    main(["train", command, "--config", config, *map(str, options)])


def figures(path: Path) -> dict[str, list[float]]:
    rows = list(csv.DictReader(path.open()))
    return {name: [float(row[name]) for row in rows if row[name]] for name in rows[0]}


def told(capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    """The table of figures that a test or validation prints."""
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    return {row[0]: float(row[1]) for row in rows if row and row[0].startswith(("test/", "val/"))}


# what it does --------------------------------------------------------------------------------------------


def test_a_fit_leaves_a_map_checkpoints_figures_and_its_config(folder: Path) -> None:
    log = folder / "run" / "lightning_logs" / "version_0"
    kept = sorted(path.name for path in (folder / "run" / "checkpoints").iterdir())
    assert kept == ["last.ckpt", "step=4.ckpt"]
    assert (log / "config.yaml").is_file()
    assert {"val/auc", "val/recall_at_1", "train/left_out"} <= set(figures(log / "metrics.csv"))
    model = DejaVu.load(folder / "run" / "map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.trained.seed) == (4, 0)


def test_its_map_is_localized_on(folder: Path, tmp_path: Path) -> None:
    main(["localize", "run/map.safetensors", "two.npy", "--out", str(tmp_path / "m.csv")])
    assert len((tmp_path / "m.csv").read_text().splitlines()) == 1 + FRAMES


def test_test_and_validate_judge_the_last_checkpoint(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train("test", "--data.query", "two.npy")
    match = DejaVu.load("run/map.safetensors").localize(ArrayTraverse(footage(0.1)))
    scores = judge(match, torch.arange(FRAMES)[:, None], tolerance=2)
    assert told(capsys) == pytest.approx({f"test/{n}": f for n, f in scores._asdict().items()}, abs=1e-6)
    train("validate", "--data.validation", "two.npy")
    assert told(capsys) == pytest.approx({f"val/{n}": f for n, f in scores._asdict().items()}, abs=1e-6)


def test_a_built_in_route(folder: Path, tmp_path: Path) -> None:
    options = ["--data.source", "sim:aerial?frames=48", "--data.resize", "[16,16]"]
    train("fit", *options, "--model.backbone.channels", 3, "--trainer.default_root_dir", tmp_path)
    assert DejaVu.load(tmp_path / "map.safetensors").learnt_from == (3, 16, 16)


def test_it_resumes(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "run", tmp_path / "run")
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    before = torch.load(last, weights_only=True)
    options = ["--ckpt_path", last, "--trainer.default_root_dir", tmp_path / "run"]
    train("fit", *options, "--trainer.max_steps", 6)
    after = torch.load(last, weights_only=True)
    assert (before["global_step"], after["global_step"]) == (4, 6)
    assert after["seconds"] > before["seconds"]


def test_a_seed_repeats_a_map(folder: Path, tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        train("fit", "--seed_everything", seed, "--trainer.default_root_dir", tmp_path / name)
    one, same, other = (DejaVu.load(tmp_path / name / "map.safetensors").state_dict() for name in "abc")
    tensors = [name for name, value in one.items() if isinstance(value, torch.Tensor)]
    assert all(torch.equal(one[name], same[name]) for name in tensors)
    assert not torch.equal(one["map.templates"], other["map.templates"])


def test_losses_and_a_users_backbone_by_name(folder: Path, tmp_path: Path) -> None:
    losses = ("phase", "periodicity", "decorrelation", "support")
    every = [f"--model.losses.{name}=0.5" for name in losses]
    options = ["--model.backbone", "mine.Plain", "--trainer.default_root_dir", tmp_path]
    train("fit", *every, *options, "--trainer.log_every_n_steps", 1)
    seen = figures(tmp_path / "lightning_logs" / "version_0" / "metrics.csv")
    others = sum(np.array(seen[f"train/{name}"]) for name in losses)
    np.testing.assert_allclose(seen["train/loss"], np.array(seen["train/place"]) + 0.5 * others, rtol=1e-4)
    main(["info", f"{tmp_path}/map.safetensors", "--features", "mine.Plain"])


def test_ready_features(folder: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "features.npy", np.random.default_rng(0).normal(size=(FRAMES, 6)).astype("float32"))
    options = ["--data.source", tmp_path / "features.npy", "--model.backbone", "torch.nn.Identity"]
    train("fit", *options, "--trainer.default_root_dir", tmp_path)
    assert DejaVu.load(tmp_path / "map.safetensors", nn.Identity()).map.dimension == 6


def test_a_watched_figure_decides_which_checkpoint_is_the_map(folder: Path, tmp_path: Path) -> None:
    text = CONFIG.partition("trainer:")[0]
    text += """
trainer:
  max_epochs: 4
  accelerator: cpu
  enable_progress_bar: false
  callbacks:
  - class_path: ModelCheckpoint
    init_args: {monitor: val/auc, mode: max, filename: best}
  - class_path: EarlyStopping
    init_args: {monitor: val/auc, mode: max, stopping_threshold: 0.0}
"""
    (tmp_path / "watch.yaml").write_text(text)
    train("fit", "--trainer.default_root_dir", tmp_path / "run", config=str(tmp_path / "watch.yaml"))
    checkpoints = tmp_path / "run" / "checkpoints"
    state = torch.load(checkpoints / "best.ckpt", weights_only=True)["state_dict"]
    templates = DejaVu.load(tmp_path / "run" / "map.safetensors").map.templates
    assert torch.equal(templates, state["dejavu.map.templates"])
    assert torch.load(checkpoints / "last.ckpt", weights_only=True)["epoch"] == 0  # stopped at the first


def test_rare_validation_leaves_a_last_checkpoint_all_the_same(folder: Path, tmp_path: Path) -> None:
    train("fit", "--trainer.check_val_every_n_epoch", 20, "--trainer.default_root_dir", tmp_path)
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 4


@pytest.mark.skipif(importlib.util.find_spec("tensorboard") is None, reason="tensorboard is not installed")
def test_tensorboard_is_used_where_it_is(folder: Path, tmp_path: Path) -> None:
    logger = ["--trainer.logger", "TensorBoardLogger", "--trainer.logger.save_dir", tmp_path]
    train("fit", *logger, "--trainer.default_root_dir", tmp_path)
    assert list(tmp_path.rglob("events.out.tfevents*"))


def test_help_names_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in ((["--help"], "{fit,validate,test}"), (["fit", "--help"], "--data.second_truth")):
        with pytest.raises(SystemExit) as stop:
            main(["train", *arguments])
        assert stop.value.code == 0
        told = capsys.readouterr().out
        assert told.startswith("usage: dejavu train ")
        assert words in told


# what it says --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [[], ["--trainer.precision=bf16-mixed"], ["--model.freeze=['']"]])
def test_a_normal_run_says_nothing(
    folder: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    recwarn: pytest.WarningsRecorder,
    options: list[str],
) -> None:
    for _ in range(2):  # the folder is there the second time
        train("fit", *options, "--trainer.default_root_dir", tmp_path)
    assert capfd.readouterr().err == ""
    # Python itself keeps deprecations to those who develop
    assert [str(w.message) for w in recwarn if not issubclass(w.category, DeprecationWarning)] == []


def test_an_interrupt_is_one_line_and_130(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    handler = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop:
            train("fit", "--model.backbone", "mine.Interrupted", "--trainer.default_root_dir", tmp_path)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert stop.value.code == 130
    assert capsys.readouterr().err == "dejavu: interrupted\n"


STOP, WATCH = (["--trainer.callbacks+", name] for name in ("EarlyStopping", "ModelCheckpoint"))
ANOTHER = ["--ckpt_path", "run/checkpoints/last.ckpt"]


@pytest.mark.parametrize(
    ("command", "options", "words"),
    [
        ("fit", ["--model.backbone", "mine.Deep"], ["Deep made (40, 8, 1)", "expected features (40, D)"]),
        ("fit", ["--model.backbone", "mine.Late"], ["the loss is nan at step 1", "expected a finite number"]),
        ("fit", ["--model.lr", "1e30"], ["the loss is", "try a lower lr"]),
        ("fit", ["--model.lr", "-1"], ["lr is -1.0", "above 0"]),
        ("fit", ["--model.losses.phase", "-1"], ["'phase': -1.0", "expected 0 or more"]),
        ("fit", ["--model.freeze", "[nix]"], ["'nix'", "expected one of convolutions, linear"]),
        ("fit", [*ANOTHER, "--model.periods.periods", "[3,4,7]"], ["5 in 10", "7 in 14", "same route"]),
        ("fit", [*ANOTHER, "--model.backbone.dimension", "9"], ["8 features", "9 features"]),
        ("fit", [*ANOTHER, "--model.backbone", "mine.Plain"], ["another model", "convolutions"]),
        ("fit", ["--ckpt_path", "gone.ckpt"], ["gone.ckpt"]),
        ("fit", ["--ckpt_path", "a_file"], ["checkpoint cannot be read"]),
        ("fit", ["--data.validation", "short.npy"], ["short.npy has 2 frames", "tolerance is 2", "longer"]),
        ("fit", ["--data.validation", "thirty.npy"], ["30 frames of thirty.npy", "data.validation_truth"]),
        ("test", ["--data.query", "large.npy"], ["(1, 24, 24)", "(1, 16, 16)", "data.resize"]),
        ("test", [], ["nothing to test on", "data.query"]),
        ("test", ["--trainer.default_root_dir", "never"], ["no never/checkpoints/last.ckpt", "--ckpt_path"]),
        ("validate", ["--trainer.default_root_dir", "never"], ["no never/checkpoints/last.ckpt"]),
        ("fit", ["--data.source", "gone.npy"], ["gone.npy is not there", "expected a folder"]),
        ("fit", ["--data.source", "empty"], ["empty holds no images"]),
        ("fit", ["--data.source", "single.npy"], ["single.npy has 1 frame and", "longer"]),
        ("fit", ["--data.source", "single.npy", "--data.tolerance", "0"], ["single.npy has 1 frame and"]),
        ("fit", ["--trainer.default_root_dir", "a_file"], ["a_file cannot be made a folder"]),
        ("fit", ["--trainer.max_steps", "-1"], ["no end", "trainer.max_steps or trainer.max_epochs"]),
        ("fit", ["--trainer.accelerator", "nix"], ["nix", "accelerator"]),
        ("fit", [*STOP, "--trainer.callbacks.monitor=nix"], ["early stopping", "`nix`"]),
        ("fit", [*WATCH, "--trainer.callbacks.monitor=nix"], ["monitor='nix'"]),
        ("fit", ["--trainer.max_steps", "x"], ["--trainer.max_steps is x", "a whole number"]),
        ("fit", ["--trainer.accelerator", "mps"], ["mps", "not available"]),
        ("fit", ["--model.backbone", "nix.Nothing"], ["--model.backbone", "No module named 'nix'"]),
        ("fit", ["--model.backbone", "mine.Nothing"], ["--model.backbone", "no attribute 'Nothing'"]),
        ("fit", ["--clop", "3"], ["--clop"]),
        ("fit", ["--config", "gone.yaml"], ["gone.yaml", "does not exist"]),
        ("predict", [], ["'predict'", "fit"]),
    ],
    ids=str,
)
def test_a_mistake_is_one_line(
    folder: Path, capfd: pytest.CaptureFixture[str], command: str, options: list[str], words: list[str]
) -> None:
    if command == "fit":
        options = ["--trainer.default_root_dir", "bad", *options]
    fails(capfd, [command, "--config", "train.yaml", *options], words)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("model:", "clop: 3\nmodel:", ["'clop'"]),
        ("model:", "model:\n  clop: 3", ["'model.clop'"]),
        ("tolerance: 2", "tolerance: 2, augmentation: {clop: 3}", ["data.augmentation", "'clop'"]),
        ("source: one.npy, ", "", ["required: --data.source"]),
        ("max_steps: 4, ", "", ["no end", "trainer.max_epochs"]),
        ("data: {", "data: [", ["parsing config"]),
    ],
    ids=str,
)
def test_a_mistake_in_the_config_is_one_line(
    folder: Path, capfd: pytest.CaptureFixture[str], tmp_path: Path, before: str, after: str, words: list[str]
) -> None:
    (tmp_path / "bad.yaml").write_text(CONFIG.replace(before, after))
    fails(capfd, ["fit", "--config", str(tmp_path / "bad.yaml")], words)


def fails(capfd: pytest.CaptureFixture[str], arguments: list[str], words: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", *arguments])
    assert stop.value.code == 2
    error = capfd.readouterr().err
    assert error.startswith("dejavu: ")
    assert error.count("\n") == 1, error
    assert [word for word in words if word.lower() not in error.lower()] == [], error
