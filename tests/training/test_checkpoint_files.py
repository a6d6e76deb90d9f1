"""Checkpoint files: no code of theirs is run, damage and claims are refused, and they are written whole."""

from __future__ import annotations

import os
import resource
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import fails
from helpers import refused
from pytorch_lightning.plugins import AsyncCheckpointIO, TorchCheckpointIO
from small_training import data_of, new_task, train, trainer, warned
from torch import Tensor

from dejavu_torch import DejaVu
from dejavu_torch.training.checkpoint import CheckpointFiles, read_checkpoint
from dejavu_torch.training.export import LastCheckpoint
from dejavu_torch.training.task import load_weights

HUGE = 10**12
FIT = ("train", "fit", "--config", "train.yaml")
EVIL = """
from pathlib import Path
Path("executed").touch()
class Net: pass
"""


@pytest.fixture
def last(made: Path) -> Path:
    return made / "run" / "checkpoints" / "last.ckpt"


def changed(last: Path, path: Path, keys: tuple[Any, ...], value: Any) -> Path:
    """The checkpoint with another value, or without it if the value is `...`.

    A tensor of one number fills the one that was there.
    """
    whole = place = torch.load(last, weights_only=True)
    for key in keys[:-1]:
        place = place[key]
    if value is ...:
        del place[keys[-1]]
    elif isinstance(value, Tensor) and not value.ndim:
        place[keys[-1]] = value.expand_as(place[keys[-1]]).clone()
    else:
        place[keys[-1]] = value
    torch.save(whole, path)
    return path


# no code -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["fit", "validate", "export"])
def test_settings_in_a_checkpoint_import_nothing(
    folder: Path, last: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """Lightning's command line would take them, and import a module of the current folder."""
    settings = {"backbone": {"class_path": "evil_of_a_checkpoint.Net"}}
    bad = changed(last, tmp_path / "bad.ckpt", ("hyper_parameters",), settings)
    for name in ("one.npy", "two.npy", "train.yaml"):
        shutil.copy(folder / name, tmp_path)
    (tmp_path / "evil_of_a_checkpoint.py").write_text(EVIL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    train(command, "--ckpt_path", bad, "--data.query", "two.npy", "--data.truth", "0")
    assert not (tmp_path / "executed").exists()


class Touch:
    """Runs code if it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("executed"),)


def test_a_pickle_runs_nothing_whatever_the_config_says(
    folder: Path, last: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bad = changed(last, tmp_path / "bad.ckpt", ("more",), Touch())
    words = ["--ckpt_path", bad, "--weights_only", "false", "--trainer.default_root_dir", tmp_path / "new"]
    assert "more than tensors and plain data" in fails(capfd, *FIT, *words)
    assert not (tmp_path / "new").exists()
    assert not (folder / "executed").exists()


# what is no checkpoint, or damaged -----------------------------------------------------------------------


def claims(path: Path, last: Path, pickle: bytes, packing: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", packing) as archive:
        archive.writestr("archive/data.pkl", pickle)
        archive.writestr("archive/version", "3\n")


def flip(path: Path, last: Path, record: str) -> None:
    """One bit, at whose checksum torch itself does not look."""
    with zipfile.ZipFile(last) as archive:
        content = archive.read(next(one for one in archive.namelist() if one.endswith(record)))
    data = bytearray(last.read_bytes())
    data[data.index(content) + len(content) // 2] ^= 16
    path.write_bytes(data)


BYTES = b"\x80\x02cbuiltins\nbytearray\n(\x8a\x08" + HUGE.to_bytes(8, "little") + b"tR."  # torch makes them
OLD = {"_use_new_zipfile_serialization": False}


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (lambda path, last: None, ["is not there"]),
        (lambda path, last: path.mkdir(), ["is a folder"]),
        (lambda path, last: os.mkfifo(path), ["is not a regular file"]),
        (lambda path, last: path.write_text("no checkpoint"), ["cannot be read"]),
        (lambda path, last: torch.save([1, 2], path), ["is of type list"]),
        (lambda path, last: torch.save({"epoch": 1}, path), ["pytorch-lightning_version None"]),
        (lambda path, last: torch.save({"epoch": 1}, path, **OLD), ["cannot be read"]),
        (lambda path, last: flip(path, last, "data.pkl"), ["damaged", "data.pkl", "checksum"]),
        (lambda path, last: flip(path, last, "data/5"), ["damaged", "data/5", "checksum"]),
        (lambda path, last: claims(path, last, BYTES), ["claims more bytes"]),
        (lambda path, last: claims(path, last, b"\x80\x02]." + bytes(10**6), 8), ["claims more bytes"]),
    ],
)
def test_what_is_no_checkpoint(
    tmp_path: Path, last: Path, make: Callable[[Path, Path], object], facts: list[str]
) -> None:
    make(tmp_path / "bad.ckpt", last)
    with refused("bad.ckpt", *facts, "expected a checkpoint that `dejavu train fit` wrote"):
        read_checkpoint(tmp_path / "bad.ckpt")


def test_a_word_is_a_file_name(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for word in ("registry:model", "best"):
        assert "is not there" in fails(capfd, *FIT, "--ckpt_path", word)


@pytest.mark.parametrize(
    ("keys", "value", "facts"),
    [
        (("state_dict",), [1], ["state_dict [1], not of type dict"]),
        (("state_dict", "log_temperature"), "x", ["log_temperature", "no tensor"]),
        (("state_dict", "log_temperature"), torch.tensor(float("nan")), ["log_temperature", "NaN"]),
        (("state_dict", "log_temperature"), ..., ["of another model", "log_temperature"]),
        (("state_dict", "dejavu.map.templates"), torch.zeros(1).expand(HUGE), ["more numbers than the file"]),
        (("state_dict", "dejavu.map.templates"), torch.empty(HUGE, device="meta"), ["more numbers"]),
        (("state_dict", "dejavu._extra_state"), {}, ["state", "frame_shape"]),
        (("global_step",), 2**62, ["global_step 4611686018427387904"]),
        (("stage",), 10**9, ["does not fit this training"]),
        (("trained",), ..., ["trained None, not of type list"]),
    ],
    ids=str,
)
def test_an_odd_value_is_refused(
    last: Path, tmp_path: Path, keys: tuple[Any, ...], value: Any, facts: list[str]
) -> None:
    with refused(*facts):
        load_weights(new_task(), changed(last, tmp_path / "bad.ckpt", keys, value))


STEP = ("loops", "fit_loop", "epoch_loop.automatic_optimization.optim_progress", "optimizer", "step", "total")


@pytest.mark.parametrize(
    ("keys", "value", "facts"),
    [
        (("loops",), None, ["of step 4", "loops are at 0"]),
        ((*STEP, "completed"), -(10**18), ["of step 4", "loops are at"]),
        (("optimizer_states",), ..., ["does not fit this training"]),
        (("optimizer_states", 0, "param_groups", 0, "betas"), ("x", 0.9), ["does not fit this training"]),
        (("optimizer_states", 0, "state", 0, "exp_avg"), torch.zeros(3), ["does not fit this training"]),
        (("optimizer_states", 0, "state", 0, "exp_avg"), torch.tensor(float("-inf")), ["the loss is"]),
        (("lr_schedulers",), ..., ["does not fit this training"]),
    ],
    ids=str,
)
def test_what_cannot_be_resumed_is_one_line_of_the_command(
    folder: Path,
    last: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    keys: tuple[Any, ...],
    value: Any,
    facts: list[str],
) -> None:
    bad, root = changed(last, tmp_path / "bad.ckpt", keys, value), tmp_path / "new"
    options = ["--ckpt_path", bad, "--trainer.default_root_dir", root, "--trainer.logger", "false"]
    line = fails(capfd, *FIT, *options, "--trainer.max_steps", 6)
    assert [fact for fact in facts if fact not in line] == [], line
    assert not root.exists()


def test_a_backbone_may_hold_what_it_likes(folder: Path, tmp_path: Path) -> None:
    """Infinite and expanded buffers, a state of its own, lazy layers: what a training wrote is taken over."""
    kept = tmp_path / "checkpoints" / "last.ckpt"
    options = ["--model.backbone", "mine.Masked", "--trainer.default_root_dir", tmp_path]
    train("fit", *options)
    for command in ("fit", "export"):
        train(command, *options, "--trainer.max_steps", 6, "--ckpt_path", kept)
    assert read_checkpoint(kept)["global_step"] == 6


# writing -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "lost"), [(500, "config.yaml"), (20_000, "last.ckpt")])
def test_a_full_disk_is_one_line_and_leaves_what_was_there(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    size: int,
    lost: str,
) -> None:
    """A limit on the size of files is a disk that is full after so many bytes."""
    shutil.copytree(folder / "run", tmp_path / "run")
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))
    try:
        error = fails(capsys, *FIT, "--trainer.default_root_dir", tmp_path / "run", "--seed_everything=9")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    (warning,) = warned(caplog)
    assert "holds an earlier run" in warning
    assert f"{lost} was not written" in error
    assert {path: path.read_bytes() for path in before} == before
    new = {path.name for path in (tmp_path / "run").rglob("*") if path.is_file()}
    assert new == {path.name for path in before}


class Own(TorchCheckpointIO):
    """A user's own way to keep checkpoints."""


@pytest.mark.parametrize(
    ("plugins", "expected"),
    [([], CheckpointFiles), ([Own()], Own), ([AsyncCheckpointIO()], AsyncCheckpointIO)],
)
def test_the_plugin_of_a_user_is_kept(tmp_path: Path, plugins: list[Any], expected: type) -> None:
    again, running = new_task(), trainer(tmp_path, LastCheckpoint(), plugins=plugins)
    running.fit(new_task(), data_of())
    assert type(running.strategy.checkpoint_io) is expected
    load_weights(again, tmp_path / "checkpoints" / "last.ckpt")
    assert torch.equal(again.route.templates, DejaVu.load(tmp_path / "map.safetensors").map.templates)


def test_the_same_training_leaves_the_same_checkpoint(folder: Path, last: Path, tmp_path: Path) -> None:
    """Byte for byte, and from process to process: no clock is in it."""
    train("fit", "--trainer.default_root_dir", tmp_path)
    assert (tmp_path / "checkpoints" / "last.ckpt").read_bytes() == last.read_bytes()
