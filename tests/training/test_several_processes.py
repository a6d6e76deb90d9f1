"""`dejavu train` in two processes: both see a part of each batch, and one map is written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from small_training import DESCRIPTOR, data_of, footage, recall

from dejavu_torch import DejaVu

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_two_processes_write_one_map_that_finds_its_places(folder, tmp_path):
    words = ["--config", "train.yaml", *DESCRIPTOR, "--trainer.devices", "2", "--trainer.strategy", "ddp"]
    words += ["--trainer.max_steps", "6", "--trainer.default_root_dir", str(tmp_path)]
    alone = {name: value for name, value in os.environ.items() if name != "PL_GLOBAL_SEED"}
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "dejavu_torch.cli", "train", "fit", *words]
    settings = {"OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    ran = subprocess.run(command, env=alone | settings, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("written to") == 1
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert model.trained is not None
    assert model.trained.steps == 6
    assert model.map.places == 40
    assert recall(model, footage()) > 0.9


def test_parts_of_a_batch_are_those_of_one_process():
    torch.manual_seed(0)
    whole = data_of(batch_size=8, clip=2)
    whole.setup("fit")
    torch.manual_seed(3)
    alone = [batch.truth.positives[:, 0].tolist() for batch in whole.training_batches()]
    parts = []
    for process in range(2):
        torch.manual_seed(3)
        loader = whole.training_batches(process, 2)
        parts.append([batch.truth.positives[:, 0].tolist() for batch in loader])
    assert [one + other for one, other in zip(*parts, strict=True)] == alone
