"""One line for every mistake that `dejavu train` can meet."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_training import CONFIG

from dejavu_torch.cli import main

STOP = ["--trainer.callbacks+", "EarlyStopping"]
SPECTRAL = ["--model.mapper", "SpectralMapper"]


@pytest.mark.parametrize(
    ("command", "options", "words"),
    [
        (
            "fit",
            [*SPECTRAL, "--model.mapper.periods", "ImposedPeriods"],
            ["--model.mapper.periods is not accepted"],
        ),
        ("fit", ["--model.mapper", "Nix"], ["model.mapper", "Nix"]),
        ("export", ["--trainer.default_root_dir", "never"], ["no checkpoint in never/checkpoints"]),
        ("fit", ["--model.backbone", "mine.Broken"], ["cannot be built", "no weights to be had"]),
        ("fit", ["--trainer.max_steps", "0"], ["no steps", "above 0"]),
        ("fit", ["--trainer.val_check_interval", "0"], ["trainer.val_check_interval is 0"]),
        ("fit", ["--trainer.max_steps", "-2"], ["max_steps", "-2"]),
        (
            "fit",
            ["--trainer.devices", "[0, 1]", "--trainer.strategy", "fsdp"],
            ["strategy is fsdp", "or ddp"],
        ),
        ("fit", ["--trainer.devices", "[1]"], ["CPUAccelerator"]),  # one, which this machine does not have
        ("fit", ["--trainer.num_nodes", "2"], ["num_nodes is 2", "MASTER_ADDR"]),
        ("fit", ["--model.backbone", "mine.Hungry"], ["not enough memory: it ran out"]),
        ("fit", ["--seed_everything", str(2**63)], ["seed_everything", "expected whole numbers of at most"]),
        ("fit", ["--data.resize", "[1000000,1000000]"], ["frames of 1000000 x 1000000", "GB free"]),
        ("fit", ["--model.backbone.widths", "[1000000,1000000]"], ["cannot be built", "memory"]),
        ("fit", ["--trainer.overfit_batches", "2"], ["overfit_batches", "trainer.limit_train_batches"]),
        ("fit", ["--data.source", "gone.npy"], ["gone.npy is not there", "expected a folder"]),
        ("fit", ["--trainer.default_root_dir", "a_file"], ["a_file cannot be made a folder"]),
        ("fit", [*STOP, "--trainer.callbacks.monitor=nix"], ["early stopping", "`nix`"]),
        ("fit", ["--trainer.accelerator", "mps"], ["mps", "not available"]),
        ("fit", ["--model.backbone", "mine.Nothing"], ["model.backbone", "no attribute 'Nothing'"]),
        ("fit", ["--config", "train_smal"], ["train_smal is not there", "train_small"]),
    ],
    ids=str,
)
def test_a_mistake_is_one_line(
    folder: Path,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    command: str,
    options: list[str],
    words: list[str],
) -> None:
    written = tmp_path / "run"
    if command == "fit":
        options = ["--trainer.default_root_dir", str(written), *options]
    fails(capfd, [command, "--config", "train.yaml", *options], words)
    # a training that fails on the way leaves what it wrote, but no empty folders
    assert not written.exists() or any(path.is_file() for path in written.rglob("*"))


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("tolerance: 2", "tolerance: 2, augmentation: {clop: 3}", ["--data.augmentation.clop"]),
        ("source: one.npy, ", "", ["required: --data.source"]),
        ("max_steps: 4, ", "max_steps: null, ", ["trainer.max_steps is null"]),
        ("max_steps: 4, ", "max_steps: -1, ", ["no end", "trainer.max_epochs"]),
        ("data: {", "data: [", ["is no YAML"]),
    ],
    ids=str,
)
def test_a_mistake_in_the_config_is_one_line(
    folder: Path, capfd: pytest.CaptureFixture[str], tmp_path: Path, before: str, after: str, words: list[str]
) -> None:
    (tmp_path / "bad.yaml").write_text(CONFIG.replace(before, after))
    fails(capfd, ["fit", "--config", str(tmp_path / "bad.yaml")], words)


@pytest.mark.parametrize("options", [["--data.source", "short.npy"], ["--ckpt_path", "run/map.safetensors"]])
def test_a_mistake_leaves_no_folder_that_was_made_for_the_run(
    folder: Path, capfd: pytest.CaptureFixture[str], tmp_path: Path, options: list[str]
) -> None:
    """Up to those that were there before."""
    (tmp_path / "kept").mkdir()
    root = tmp_path / "kept" / "nest" / "a" / "b"
    fails(capfd, ["fit", "--config", "train.yaml", "--trainer.default_root_dir", str(root), *options], [])
    assert [*tmp_path.rglob("*")] == [tmp_path / "kept"]


def fails(capfd: pytest.CaptureFixture[str], arguments: list[str], words: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", *arguments])
    assert stop.value.code == 2
    error = capfd.readouterr().err
    assert error.startswith("dejavu: ")
    assert error.count("\n") == 1, error
    assert [word for word in words if word.lower() not in error.lower()] == [], error
