"""`dejavu train` as a user meets it: files, figures, what it says, and one line for each mistake."""

from __future__ import annotations

import csv
import shlex
import signal
from functools import wraps
from importlib import import_module

import numpy as np
import pytest
import torch
import yaml
from command_line import fails, run
from pytorch_lightning import Trainer
from small_training import CONFIG, DESCRIPTOR, FRAMES, footage, train, warned

from dejavu_torch import DejaVu, TemplateMap
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.maps.spectral_map import SpectralMap


def figures(folder):
    rows = list(csv.DictReader((folder / "lightning_logs" / "version_0" / "metrics.csv").open()))
    return {name: [float(row[name]) for row in rows if row[name]] for name in rows[0]}


# what it does --------------------------------------------------------------------------------------------


def test_a_fit_leaves_a_map_a_checkpoint_figures_and_its_config(folder):
    assert [path.name for path in (folder / "run" / "checkpoints").iterdir()] == ["last.ckpt"]
    assert (folder / "run" / "lightning_logs" / "version_0" / "config.yaml").is_file()
    seen = figures(folder / "run")
    assert {"val/auc_augmented", "val/recall_at_1_augmented", "train/left_out"} <= set(seen)
    assert len(seen["val/auc_augmented"]) == 1  # at the last step, which is before the first 500
    model = DejaVu.load(folder / "run" / "map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.trained.seed) == (4, 0)
    assert model.calibration is None  # training has seen all of it


def test_test_and_validate_take_the_last_checkpoint(folder, capsys):
    """And say what the figures are of, and which command scores the map."""
    match = DejaVu.load("run/map.safetensors").localize(ArrayTraverse(footage(0.1)))
    scores = evaluate(match, torch.arange(FRAMES)[:, None], tolerance=2)._asdict()
    compare = "dejavu compare one.npy two.npy --map run/map.safetensors --truth 0 --tolerance 2 --out report"
    for command, name, truth, prefix in (
        ("test", "query", "truth", "test/"),
        ("validate", "validation", "validation_truth", "val/"),
    ):
        train(command, f"--data.{name}=two.npy", f"--data.{truth}=0")
        lines = capsys.readouterr().out.splitlines()
        assert lines[-2].endswith(".ckpt")
        assert lines[-1] == f"next: {compare}"
        # a table of rich, if that is installed
        rows = [line.replace("│", " ").split() for line in lines if prefix in line]
        expected = {prefix + name: value for name, value in scores.items()}
        assert {row[0]: float(row[1]) for row in rows} == pytest.approx(expected, abs=1e-6)


def test_a_trial_and_a_part_of_the_queries_are_told(folder, capsys):
    train("fit", "--trainer.fast_dev_run=2")
    assert "fast_dev_run: 2 steps and 2 batches of validation; nothing was written" in capsys.readouterr().out
    given = "--data.query=two.npy", "--data.truth=0", "--data.batch_size=8", "--trainer.limit_test_batches=2"
    train("test", *given)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].endswith(".ckpt, of a part of the queries (trainer.limit_test_batches is 2)")


def test_a_source_alone_is_enough(tmp_path, monkeypatch):
    """Steps, validations and checkpoints have defaults; here but a few steps are taken."""
    monkeypatch.chdir(tmp_path)
    np.save("photos.npy", np.random.default_rng(0).integers(0, 255, (12, 120, 160, 3), dtype=np.uint8))
    seen = {}

    @wraps(Trainer.fit)  # of which the parser takes its options
    def taken(self, model, datamodule, **_):
        seen.update(steps=self.max_steps, every=self.val_check_interval, epochs=self.check_val_every_n_epoch)
        self.fit_loop.epoch_loop.max_steps = 2
        Trainer.fit(self, model, datamodule=datamodule)  # type: ignore[arg-type]
        assert datamodule.sets["reference"].values.shape == (12, 3, 96, 96)

    monkeypatch.setattr("dejavu_torch.cli.train.MapTrainer.fit", taken)
    run("train", "fit", "--data.source", "photos.npy", "--trainer.accelerator", "cpu")
    assert seen == {"steps": 3000, "every": 3000, "epochs": None}
    assert DejaVu.load("dejavu_train/map.safetensors").frame_shape == (3, 120, 160)


def test_options_of_our_own_parts_need_no_class_name(folder, tmp_path):
    (tmp_path / "short.yaml").write_text(
        "model: {class_path: TemplateTask, init_args: {mapper: {class_path: TemplateMapper,\n"
        "  init_args: {periods: {class_path: dejavu_torch.ImposedPeriods}}}, backbone:\n"
        "  {class_path: SmallCNN, init_args: {dimension: 8, channels: 1, resize: [16, 16], widths: [4]}}}}\n"
        "data: {source: one.npy, batch_size: 20}\n"
        "trainer: {max_steps: 2, accelerator: cpu, enable_progress_bar: false, devices: auto}\n"
    )
    options = ["--model.mapper.periods.periods", "[11,12,13,17]", "--data.augmentation.rotation", 0]
    options += ["--model.mapper.reduction=sum", "--model.preprocess.contrast=patch"]
    options += ["--trainer.default_root_dir", tmp_path, "--trainer.log_every_n_steps", 1]
    options += ["--model.losses.phase", 0.5]
    train("fit", *options, config=str(tmp_path / "short.yaml"))
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert [layer.phases for layer in model.map.plan] == [11, 12, 13, 17]
    assert isinstance(model.map, TemplateMap)
    assert (model.map.reduction, model.preprocess.contrast) == ("sum", "patch")
    assert type(model.features) is SmallCNN
    (path,) = tmp_path.rglob("config.yaml")
    config = yaml.safe_load(path.read_text())
    assert config["data"]["augmentation"]["class_path"] == "dejavu_torch.features.augmentation.Augmentation"
    assert config["data"]["augmentation"]["init_args"]["rotation"] == 0
    assert config["trainer"]["devices"] == 1  # auto is one of however many
    seen = figures(tmp_path)
    expected = np.array(seen["train/place"]) + 0.5 * np.array(seen["train/phase"])
    np.testing.assert_allclose(seen["train/loss"], expected, rtol=1e-4)


def test_a_users_own_checkpoints_decide_which_is_the_map(folder, tmp_path):
    text = CONFIG.partition("trainer:")[0]
    text += """
trainer:
  max_epochs: 4
  check_val_every_n_epoch: 1
  accelerator: cpu
  enable_progress_bar: false
  callbacks:
  - class_path: ModelCheckpoint
    init_args: {monitor: val/auc_augmented, mode: max, filename: best}
  - class_path: EarlyStopping
    init_args: {monitor: val/auc_augmented, mode: max, stopping_threshold: 0.0}
"""
    (tmp_path / "watch.yaml").write_text(text)
    train("fit", "--trainer.default_root_dir", tmp_path / "run", config=str(tmp_path / "watch.yaml"))
    (best,) = (tmp_path / "run" / "checkpoints").iterdir()  # no other is written
    checkpoint = torch.load(best, weights_only=True)
    templates = DejaVu.load(tmp_path / "run" / "map.safetensors").map.templates
    assert torch.equal(templates, checkpoint["state_dict"]["dejavu.map.templates"])
    assert checkpoint["epoch"] == 0  # stopped at the first


def test_a_spectral_map_whatever_mapper_a_preset_has(folder, tmp_path, capfd, caplog):
    chosen = [*DESCRIPTOR, "--model.mapper.route_bytes_per_place", 12]
    train("fit", *chosen, "--trainer.default_root_dir", tmp_path / "fit")
    assert warned(caplog) == []
    said = capfd.readouterr()
    assert said.err == ""
    assert "coefficients kept" in said.out
    for size in (12, 1.2):  # the map is made anew of the checkpoint's features
        options = [*chosen[:-1], size, "--trainer.default_root_dir", tmp_path / str(size)]
        options += ["--data.validation=two.npy", "--data.validation_truth=0"]  # which calibrates the map
        train("export", "--ckpt_path", tmp_path / "fit" / "checkpoints" / "last.ckpt", *options)
    maps = [DejaVu.load(tmp_path / name / "map.safetensors") for name in ("fit", "12", "1.2")]
    assert all(isinstance(model.map, SpectralMap) for model in maps)
    assert [model.calibration is not None for model in maps] == [False, True, True]
    assert torch.equal(maps[0].map.streams, maps[1].map.streams)  # type: ignore[arg-type]
    assert len(maps[2].map.level) < len(maps[1].map.level)  # type: ignore[arg-type]


# what it says --------------------------------------------------------------------------------------------


def test_a_normal_run_prints_its_map_and_what_to_do_next(
    folder, tmp_path, capfd, caplog, recwarn, monkeypatch
):
    monkeypatch.setattr("dejavu_torch.cli.train.has_bf16", lambda: True)  # others are told
    for expected in ([], [f"{tmp_path} holds an earlier run, which this one replaces"]):
        caplog.clear()
        options = ["--trainer.precision=bf16-mixed", "--model.freeze=['']"]
        train("fit", *options, "--trainer.default_root_dir", tmp_path)
        assert warned(caplog) == expected
        said = capfd.readouterr()
        assert said.err == ""
        plan, *rest = said.out.split("written to ")
        assert plan.endswith(f"{DejaVu.load(tmp_path / 'map.safetensors').summary()!s}\n")
        assert "only a second visit" in rest[0]
        scored = f"--map {tmp_path}/map.safetensors --tolerance 2 --out report"
        assert rest[0].splitlines()[-1] == f"next: dejavu compare one.npy SECOND {scored}"
    # Python itself keeps deprecations to those who develop
    assert [str(w.message) for w in recwarn if not issubclass(w.category, DeprecationWarning)] == []


def test_a_second_traverse_shows_a_trained_map_beside_untrained_ones(folder, tmp_path, caplog, capsys):
    """Two steps of a tiny rate teach nothing, so that HOG is better, and is said to be."""
    np.save(tmp_path / "first.npy", footage(side=32).numpy())
    np.save(tmp_path / "second.npy", footage(0.1, side=32).numpy())
    options = ["--data.source", tmp_path / "first.npy", "--data.truth", "0"]
    options += ["--data.query", tmp_path / "second.npy"]
    options += ["--model.lr", 1e-6, "--trainer.max_steps", 2, "--trainer.default_root_dir", tmp_path / "run"]
    train("fit", *options)
    lines = [line for line in capsys.readouterr().out.splitlines() if "recall@1" in line]
    auc = {line[:20].strip(): float(line[20:].split()[1].rstrip(",")) for line in lines}
    assert list(auc) == ["the trained map", "HOG of all frames", "the untrained map"]
    query, truth = ArrayTraverse(footage(0.1, side=32)), torch.arange(FRAMES)[:, None]
    trained = DejaVu.load(tmp_path / "run" / "map.safetensors")
    untrained = DejaVu().learn(ArrayTraverse(footage(side=32)))
    for model, name in ((trained, "the trained map"), (untrained, "the untrained map")):
        assert auc[name] == pytest.approx(evaluate(model.localize(query), truth, tolerance=2).auc, abs=6e-4)
    assert auc["HOG of all frames"] > auc["the trained map"]
    assert [line for line in warned(caplog) if "worse than" in line and "HOG of all frames" in line]
    logged = figures(tmp_path / "run")["unseen/auc_of_HOG_of_all_frames"]
    assert logged[-1] == pytest.approx(auc["HOG of all frames"], abs=6e-4)


def test_an_interrupt_is_one_line_and_130_and_leaves_a_map(folder, tmp_path, capsys):
    handler = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop:
            train("fit", "--model.backbone", "mine.Interrupted", "--trainer.default_root_dir", tmp_path)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert stop.value.code == 130
    said = capsys.readouterr()
    assert said.err == "dejavu: interrupted\n"
    assert "written to " in said.out
    again = shlex.split(said.out.splitlines()[-1].removeprefix("to go on: dejavu "))
    assert again[:2] == ["train", "fit"]
    assert again[-2:] == ["--ckpt_path", str(tmp_path / "checkpoints" / "last.ckpt")]
    (file,) = (tmp_path / "checkpoints").iterdir()
    last = torch.load(file, weights_only=True)
    model = DejaVu.load(tmp_path / "map.safetensors", import_module("mine").Interrupted())
    assert model.trained is not None
    assert model.trained.steps == last["global_step"] == 3


# mistakes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "facts"),
    [
        (
            [*DESCRIPTOR, "--model.mapper.periods", "ImposedPeriods"],
            ["--model.mapper.periods is not accepted"],
        ),
        (["--model.mapper", "Nix"], ["model.mapper", "Nix"]),
        (["--model.backbone", "mine.Broken"], ["cannot be built", "no weights to be had"]),
        (["--trainer.max_steps", "-1"], ["no end", "trainer.max_epochs"]),
        (["--trainer.max_steps", "0"], ["no steps", "above 0"]),
        (["--seed_everything", "-1"], ["seed_everything is -1", "2^32 - 1"]),
        (["--trainer.val_check_interval", "0"], ["trainer.val_check_interval is 0"]),
        (["--trainer.accumulate_grad_batches", "0"], ["accumulate_grad_batches is 0", "at least 1"]),
        (["--trainer.check_val_every_n_epoch", "0"], ["check_val_every_n_epoch is 0", "at least 1"]),
        (["--trainer.devices", "[0, 1]", "--trainer.strategy", "fsdp"], ["strategy is fsdp", "or ddp"]),
        (["--trainer.devices", "[1]"], ["CPUAccelerator"]),  # one, which this machine does not have
        (["--trainer.num_nodes", "2"], ["num_nodes is 2", "MASTER_ADDR"]),
        (["--model.backbone", "mine.Hungry"], ["not enough memory: it ran out"]),
        (["--seed_everything", str(2**63)], ["seed_everything", "expected whole numbers of at most"]),
        (["--model.backbone.widths", "[1000000,1000000]"], ["cannot be built", "memory"]),
        (["--trainer.overfit_batches", "2"], ["overfit_batches is 2", "expected 0"]),
        (["--data.augmentation.clop", "3"], ["clop"]),
        (
            ["--trainer.callbacks+", "EarlyStopping", "--trainer.callbacks.monitor=nix"],
            ["early stopping", "`nix`"],
        ),
        (["--trainer.default_root_dir", "a_file"], ["a_file cannot be made a folder"]),
        (["--trainer.accelerator", "mps"], ["mps", "not available"]),
        (["--model.backbone", "mine.Nothing"], ["model.backbone", "no attribute 'Nothing'"]),
        (["--config", "train_roa"], ["train_roa is not there", "train_road"]),
        (["--ckpt_path", "run/map.safetensors"], ["map.safetensors", "dejavu train fit"]),
    ],
    ids=str,
)
def test_a_mistake_is_one_line_and_leaves_no_empty_folder(folder, capfd, tmp_path, options, facts):
    root = tmp_path / "nest" / "run"
    words = ["--config", "train.yaml", "--trainer.default_root_dir", root, *options]
    error = fails(capfd, "train", "fit", *words)
    assert [fact for fact in facts if fact.lower() not in error.lower()] == [], error
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files or not any(tmp_path.iterdir())  # a training that fails on the way leaves what it wrote


@pytest.mark.parametrize(
    ("command", "before", "after", "facts"),
    [
        ("fit", "source: one.npy, ", "", ["required: --data.source"]),
        ("fit", "data: {", "data: [", ["is no YAML"]),
        ("export", "dir: run", "dir: never", ["no checkpoint in never/checkpoints"]),
    ],
    ids=str,
)
def test_a_mistake_in_the_config_is_one_line(folder, capfd, tmp_path, command, before, after, facts):
    (tmp_path / "bad.yaml").write_text(CONFIG.replace(before, after))
    error = fails(capfd, "train", command, "--config", tmp_path / "bad.yaml")
    assert [fact for fact in facts if fact not in error] == [], error
