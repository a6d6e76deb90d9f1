"""The network that comes with the package, its teacher, and how it is made."""

from __future__ import annotations

import json

import pytest
import torch
from command_line import benchmark, benchmark_fails
from helpers import refused
from safetensors.torch import load_file
from torch import nn
from torch.nn.functional import adaptive_avg_pool2d

from benchmarks import distil
from dejavu_torch import DejaVu, open_source
from dejavu_torch.features import distilled
from dejavu_torch.features.distilled import STRIDES, WEIGHTS, Distilled


def layers():
    """The network as torch's own modules, made from the file."""
    stored, made = load_file(WEIGHTS["lite0"]), []
    for i, stride in enumerate(STRIDES):
        whole = stored[f"{i}.weight"]
        convolution = nn.Conv2d(whole.shape[1], whole.shape[0], whole.shape[2], stride, whole.shape[2] // 2)
        weight = whole.float() * stored[f"{i}.scale"].float()[:, None, None, None]
        convolution.load_state_dict({"weight": weight, "bias": stored[f"{i}.bias"]})
        made += [convolution, nn.ReLU()]
    return nn.Sequential(*made[:-1])


def test_it_is_the_layers_of_the_file_pooled():
    frames = torch.rand(3, 3, 96, 96)
    expected = adaptive_avg_pool2d(layers()(2 * frames - 1), 4)
    torch.testing.assert_close(Distilled(4)(frames).view_as(expected), expected, rtol=1e-4, atol=1e-4)


def test_settings_out_of_range_are_refused():
    for settings, seen in (({"grid": 0}, "grid=0"), ({"grid": 13}, "1 to 12"), ({"weights": "vgg"}, "lite0")):
        with refused(seen):
            Distilled(**settings)


def test_a_map_of_other_weights_is_refused(tmp_path, monkeypatch):
    model = DejaVu(Distilled()).learn(open_source("sim:aerial?frames=60"))
    model.save(tmp_path / "map.safetensors")
    stored = load_file(WEIGHTS["lite0"])
    stored["2.weight"] = stored["2.weight"].flip(0)  # the same numbers in another order
    distil.save_file(stored, tmp_path / "other.safetensors")
    monkeypatch.setitem(distilled.WEIGHTS, "lite0", tmp_path / "other.safetensors")
    for given in (None, Distilled()):
        with refused("map.safetensors", "other weights lite0", "learned anew"):
            DejaVu.load(tmp_path / "map.safetensors", given)


def test_the_bench_makes_weights_that_the_class_reads(tmp_path, monkeypatch, capsys):
    pytest.importorskip("efficientnet_lite_pytorch")
    for name, few in {"IMAGES": 16, "JUDGED_ON": 16, "FRAMES": 8, "BATCH": 8, "JUDGED": 2}.items():
        monkeypatch.setattr(distil, name, few)
    monkeypatch.setattr(distil, "ROUTES", {"underground": 1})
    benchmark("distil", "--out", tmp_path / "out", "--steps", "30")
    assert "65 kB" in capsys.readouterr().out
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert {row["case"] for row in rows} == {"leaves", "underground"}
    assert all(0 < row["explained"] < 1 for row in rows)  # after 30 steps more than a constant does
    before = Distilled(1)
    monkeypatch.setitem(distilled.WEIGHTS, "lite0", tmp_path / "out" / "lite0.safetensors")
    frames = torch.rand(2, 3, 96, 96)
    assert Distilled(1)(frames).isfinite().all()
    assert not torch.equal(Distilled(1)(frames), before(frames))
    assert (tmp_path / "out" / "bench.png").is_file()
    assert "at least 30" in benchmark_fails(capsys, "distil", "--out", tmp_path / "no", "--steps", "20")
