"""The commands as a user calls them, for several test files."""

from __future__ import annotations

import csv
import json
import subprocess
import threading
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest
from PIL import Image

from benchmarks.__main__ import run as run_benchmark
from dejavu_torch.cli import main

started = subprocess.run
ONE_AT_A_TIME = threading.Lock()  # as what is printed is that of the process
TEMPLATES = ("--config", "local_maxima")  # the defaults are a spectral map


def run(*arguments):
    main([str(argument) for argument in arguments])


def run_here(command, **settings):
    """In the place of `subprocess.run`: a process of `dejavu` is a command of this one, with its output."""
    if "dejavu_torch.cli" not in command:
        return started(command, **settings)
    with ONE_AT_A_TIME, redirect_stdout(settings["stdout"]), redirect_stderr(settings["stderr"]):
        try:
            run(*command[command.index("dejavu_torch.cli") + 1 :])
        except SystemExit as stop:
            return subprocess.CompletedProcess(command, int(stop.code or 0))
    return subprocess.CompletedProcess(command, 0)


def benchmark(*arguments):
    main([str(argument) for argument in arguments], run_benchmark)


def benchmark_fails(capsys, *arguments):
    """Run a benchmark that must fail; its one line on stderr."""
    return fails(capsys, *arguments, call=benchmark)


def fails(capsys, *arguments, call=run):
    """Run a command that must fail; its one line on stderr."""
    with pytest.raises(SystemExit) as stop:
        call(*arguments)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("dejavu: ")
    assert error.count("\n") == 1
    assert error.endswith("\n")
    assert "Traceback" not in error
    return error


def frames(count, seed=0, size=32):
    """Frames of a texture that slides past with period 16, with noise."""
    noise = np.random.default_rng(seed)
    texture = np.random.default_rng(99).integers(40, 215, (size, size))
    rolled = [np.roll(texture, 2 * i, axis=1) for i in range(count)]
    return np.clip(np.stack(rolled) + noise.normal(0, 8, (count, size, size)), 0, 255).astype(np.uint8)


def write_images(folder, images):
    folder.mkdir()
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{i}.png")
    return folder


def rows_of(path):
    """The rows of a csv, such as matches.csv."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def report_of(folder):
    report = json.loads((folder / "report.json").read_text())
    return report
