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
from benchmarks.leaves import leaves
from dejavu_torch import HOG, DejaVu, SpectralMapper, evaluate, open_source
from dejavu_torch.features import distilled
from dejavu_torch.features.distilled import STRIDES, WEIGHTS, Distilled, distilled_maps, loaded
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.motion.resampling import ground_truth_of
from dejavu_torch.resize import resize_frames


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


def test_grey_frames_are_colours_alike_and_other_channels_their_mean():
    net, frames = Distilled(), torch.rand(2, 2, 40, 70)
    grey = frames.mean(1, keepdim=True)
    torch.testing.assert_close(net(grey), net(grey.expand(-1, 3, -1, -1)), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(net(frames), net(grey))


def test_gradients_reach_the_frames_and_no_weight():
    net, frames = Distilled(), torch.rand(1, 3, 32, 32, requires_grad=True)
    net(frames).square().sum().backward()
    assert frames.grad is not None
    assert frames.grad.abs().sum() > 0
    assert not [*net.parameters()]


def test_settings_out_of_range_are_refused():
    for settings, seen in (({"grid": 0}, "grid=0"), ({"grid": 13}, "1 to 12"), ({"weights": "vgg"}, "lite0")):
        with refused(seen):
            Distilled(**settings)


def test_no_map_holds_its_weights(tmp_path):
    route, again = (open_source(f"sim:aerial?frames=120&traverse={i}") for i in (0, 1))
    model = DejaVu(Joined([HOG(), Distilled()])).learn(route)
    model.save(tmp_path / "map.safetensors")
    stored = load_file(tmp_path / "map.safetensors")
    (own,) = [tensor for name, tensor in stored.items() if name.startswith("features")]
    assert own.nbytes == 40
    loaded_again = DejaVu.load(tmp_path / "map.safetensors")  # without saying the features
    torch.testing.assert_close(loaded_again.localize(again).score, model.localize(again).score)


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


def test_of_unseen_frames_it_tells_what_its_teacher_does():
    pytest.importorskip("efficientnet_lite_pytorch")
    network = distil.teacher()
    frames = torch.cat([leaves(32, 96, 10_000), *(part for part in _held("aerial"))])
    with torch.no_grad():
        found, target = distilled_maps(frames, loaded(WEIGHTS["lite0"])), distil.maps_of(network, frames)
    # of the best constant, and of the best linear function of each cell's colours
    shown = torch.cat([adaptive_avg_pool2d(frames, 12), torch.ones_like(frames[:, :1, :12, :12])], 1)
    columns, rows = (one.transpose(0, 1).flatten(1).T for one in (shown, target))
    linear = rows - columns @ torch.linalg.lstsq(columns, rows).solution
    error = (found - target).square().mean()
    assert error < 0.3 * (target - target.mean((0, 2, 3), keepdim=True)).square().mean()
    assert error < 0.4 * linear.square().mean()


def _held(kind):
    route = open_source(f"sim:{kind}?seed={distil.HELD}&frames=320")
    return [resize_frames(route[::10], (96, 96))]


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


def test_normalisation_and_scale_are_folded_into_the_weights(tmp_path):
    student, frames = distil.Student(), torch.rand(16, 3, 96, 96)
    for _ in range(20):  # running statistics
        student(2 * frames - 1)
    scale, mean = torch.rand(40) + 0.5, torch.randn(40)
    distil.save_file(student.eval().stored(scale, mean), tmp_path / "stored.safetensors")
    with torch.no_grad():
        expected = student(2 * frames - 1) * scale[:, None, None] + mean[:, None, None]
    found = distilled_maps(frames, loaded(tmp_path / "stored.safetensors"))
    assert (found - expected).square().mean() < 1e-3 * expected.var()  # of 8 bits


def test_beside_hog_it_is_worth_more_than_pixels_in_the_city(data_dir):
    city = data_dir / "robotcar" / "t5"
    reference, query = (open_source(city / f"{name}.npy") for name in ("reference", "query"))
    truth = ground_truth_of(str(city / "truth.csv"), reference, query)
    assert truth is not None
    pixels = Joined([HOG(), PatchPixels((24, 48), channel="grey")])
    areas = []
    for features in (pixels, None):  # with it is the default
        model = DejaVu(features, mapper=SpectralMapper(5.0)).learn(reference)
        areas.append(evaluate(model.localize(query), truth, 2).auc)
    assert areas[1] > areas[0] + 0.04
