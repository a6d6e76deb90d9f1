"""`dejavu train` as a user meets it: files, figures, and what it says."""

from __future__ import annotations

import csv
import importlib.util
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from test_task import FRAMES, footage, warned
from torch import nn
from training_config import CONFIG, MINE, train

from dejavu_torch import DejaVu
from dejavu_torch.cli import main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.database.mapfile import read_map
from dejavu_torch.database.summary import describe
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.cnn import SmallCNN


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
    scores = evaluate(match, torch.arange(FRAMES)[:, None], tolerance=2)
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


@pytest.mark.parametrize("backbone", ["torch.nn.Identity", None])
def test_ready_features(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, backbone: str | None
) -> None:
    """A backbone that has parameters is left out."""
    np.save(tmp_path / "features.npy", np.random.default_rng(0).normal(size=(FRAMES, 6)).astype("float32"))
    options = ["--data.source", tmp_path / "features.npy", "--trainer.default_root_dir", tmp_path]
    train("fit", *options, *(["--model.backbone", backbone] if backbone else []))
    assert warned(caplog) == ([] if backbone else ["these are ready features: the backbone is left out"])
    model = DejaVu.load(tmp_path / "map.safetensors", nn.Identity() if backbone else None)
    assert (model.map.dimension, model.backbone_bytes) == (6, 0)
    main(["info", f"{tmp_path}/map.safetensors", *(["--features", backbone] if backbone else [])])


def test_options_of_our_own_parts_need_no_class_name(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(
        "model: {backbone: {init_args: {dimension: 8, channels: 1, resize: [16, 16], widths: [4]}}}\n"
        "data: {source: one.npy, batch_size: 20}\n"
        "trainer: {max_steps: 2, accelerator: cpu, enable_progress_bar: false}\n"
    )
    options = ["--model.periods.periods", "[11,12,13,17]", "--data.augmentation.rotation", 0]
    options += ["--model.preprocess.contrast", "patch", "--trainer.default_root_dir", tmp_path / "run"]
    train("fit", *options, config=str(tmp_path / "short.yaml"))
    model = DejaVu.load(tmp_path / "run" / "map.safetensors")
    assert [layer.phases for layer in model.map.plan] == [11, 12, 13, 17]
    assert model.preprocess.contrast == "patch"
    assert type(model.features) is SmallCNN
    (config,) = (tmp_path / "run").rglob("config.yaml")
    kept = yaml.safe_load(config.read_text())["data"]["augmentation"]
    assert kept["class_path"] == "dejavu_torch.features.augmentation.Augmentation"
    assert kept["init_args"]["rotation"] == 0


def test_a_class_in_the_current_folder_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by the console command, whose first path is that of its script."""
    np.save(tmp_path / "one.npy", footage().numpy())
    (tmp_path / "own_classes.py").write_text(MINE)
    (tmp_path / "train.yaml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    train("fit", "--model.backbone", "own_classes.Plain")
    header = read_map(tmp_path / "run" / "map.safetensors")[1]
    assert "own_classes.Plain" in str(header["features"])


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
def test_a_normal_run_tells_of_its_map_alone(
    folder: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    recwarn: pytest.WarningsRecorder,
    options: list[str],
) -> None:
    for expected in ([], [f"{tmp_path} holds an earlier run, which this one replaces"]):
        caplog.clear()
        train("fit", *options, "--trainer.default_root_dir", tmp_path)
        assert warned(caplog) == expected
        said = capfd.readouterr()
        assert said.err == ""
        plan = describe(DejaVu.load(tmp_path / "map.safetensors").certificate)
        written = f"written to {tmp_path}/map.safetensors; `dejavu compare --map` judges it"
        assert f"{plan}\n{written}\n" in said.out
    # Python itself keeps deprecations to those who develop
    assert [str(w.message) for w in recwarn if not issubclass(w.category, DeprecationWarning)] == []


def test_a_trial_run_leaves_an_earlier_run_as_it_is(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder / "run", tmp_path / "run")
    before = contents(tmp_path / "run")
    options = ["--trainer.default_root_dir", tmp_path / "run", "--seed_everything", 5]
    train("fit", *options, "--trainer.fast_dev_run", "true")
    assert contents(tmp_path / "run") == before
    assert "written to" not in capsys.readouterr().out
    assert not [told for told in warned(caplog) if "earlier run" in told]


def contents(folder: Path) -> dict[str, bytes]:
    kept = [folder / "map.safetensors", *(folder / "checkpoints").iterdir()]
    return {path.name: path.read_bytes() for path in kept}


def test_a_run_without_batches_leaves_no_map(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    train("fit", "--trainer.limit_train_batches", 0, "--trainer.default_root_dir", tmp_path)
    assert "no step was taken: no map is written" in warned(caplog)
    assert not (tmp_path / "map.safetensors").exists()


def test_a_run_that_is_over_is_told(folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    last = folder / "run" / "checkpoints" / "last.ckpt"
    train("fit", "--ckpt_path", last, "--trainer.default_root_dir", tmp_path)
    assert [told for told in warned(caplog) if told.startswith("nothing was trained")]


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
