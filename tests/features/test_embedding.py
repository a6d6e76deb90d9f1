"""Any network as a backbone: kornia's, our own, a plain convolution; what cannot be one; and its code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import refused
from kornia.contrib import TinyViT
from kornia.feature import HardNet
from torch import Tensor, nn

from dejavu_torch import DejaVu
from dejavu_torch.features.cnn import SmallCNN, local_contrast
from dejavu_torch.features.embedding import Coder, Embedding
from dejavu_torch.features.whitening import learned_whitening


class Maker(nn.Module):
    """Gives what a function makes of the frames."""

    def __init__(self, make: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.make = make

    def forward(self, frames):
        return self.make(frames)


class Picky(nn.Module):
    """Objects to every frame."""

    def forward(self, frames):
        raise AssertionError(f"frames of {frames.shape[-1]} are not\nwhat I want")


def tiny_vit():
    sizes = {"embed_dims": [8] * 4, "depths": [1] * 4, "num_heads": [1] * 4, "window_sizes": [2] * 4}
    return TinyViT(img_size=32, num_classes=10, **sizes)


def plain(**settings):
    return Embedding(nn.Conv2d(3, 4, 3), **{"dimension": 5, "resize": (12, 16)} | settings)


@pytest.mark.parametrize(
    ("make", "settings"),
    [
        (lambda: HardNet(pretrained=False), {"channels": 1, "resize": (32, 32)}),
        (tiny_vit, {"resize": (32, 32)}),
        (lambda: nn.Conv2d(3, 4, 3), {"grid": 2}),
    ],
    ids=["HardNet", "TinyViT", "Conv2d"],
)
def test_networks_of_all_kinds(make, settings):
    net = Embedding(make(), dimension=12, **settings)
    frames = torch.rand(3, 3, 40, 36)
    features = net(frames)
    assert (features.shape, features.dtype) == ((3, 12), torch.float32)
    features[:, 0].square().mul(torch.arange(3.0)).sum().backward()
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in net.network.parameters())
    net.eval()
    alone = torch.cat([net(frame[None]) for frame in frames])
    torch.testing.assert_close(net(frames), alone, rtol=0, atol=1e-4)


def test_the_features_are_the_pooled_maps_projected_and_standardised():
    net = plain(grid=2)
    frames = torch.rand(8, 3, 12, 16)
    maps = net.network(frames)  # 10 x 14, so that a cell of the grid is 5 x 7
    cells = [maps[:, :, y : y + 5, x : x + 7].mean((2, 3)) for y in (0, 5) for x in (0, 7)]
    projected = net.linear(torch.stack(cells, 2).flatten(1))
    expected = (projected - projected.mean(0)) / (projected.var(0, correction=0) + 1e-5).sqrt()
    torch.testing.assert_close(net(frames), expected, rtol=0, atol=1e-4)


def test_grey_is_repeated_and_colour_becomes_luminance():
    grey = torch.rand(2, 1, 12, 16)
    net = plain().eval()
    assert torch.equal(net(grey), net(grey.expand(-1, 3, -1, -1)))
    one = Embedding(nn.Conv2d(1, 4, 3), dimension=5, channels=1, resize=(12, 16)).eval()
    torch.testing.assert_close(one(grey.expand(-1, 3, -1, -1)), one(grey), rtol=0, atol=1e-5)
    red = torch.tensor([1.0, 0.0, 0.0])[:, None, None].expand(1, 3, 12, 16)
    torch.testing.assert_close(one(red), one(torch.full((1, 1, 12, 16), 0.299)), rtol=0, atol=1e-5)


def test_making_one_changes_nothing_of_the_network():
    """Neither running statistics nor the mode of any part."""
    network = nn.Sequential(nn.BatchNorm2d(3), nn.Conv2d(3, 4, 3), nn.Dropout())
    network[0].eval()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    Embedding(network)
    assert [module.training for module in network.modules()] == [True, False, True, True]
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


MEAN = lambda frames: frames.mean((2, 3))  # noqa: E731
TOKENS = lambda frames: frames.flatten(2).mT  # noqa: E731


@pytest.mark.parametrize(
    ("make", "output", "expected"),
    [
        (lambda f: (MEAN(f), f[:, :2, 0]), None, MEAN),  # as Bag of Queries: descriptor, attention
        (lambda f: (TOKENS(f), MEAN(f), 2 * MEAN(f)), None, MEAN),
        (lambda f: {"tokens": TOKENS(f), "more": [f, MEAN(f)]}, None, MEAN),
        (lambda f: (2 * f, None), None, lambda f: 2 * MEAN(f)),  # the only tensor
        (lambda f: (2 * f, MEAN(f)), 0, lambda f: 2 * MEAN(f)),
        (lambda f: [f, 2 * f, 3 * f], -1, lambda f: 3 * MEAN(f)),
        (lambda f: {"maps": f, "more": (TOKENS(f), MEAN(f))}, 1, MEAN),
        (MEAN, 0, MEAN),
        (TOKENS, None, MEAN),
    ],
)
def test_of_several_outputs_the_first_vectors_count_or_the_one_named(make, output, expected):
    frames = torch.rand(4, 3, 96, 96)
    several = Embedding(Maker(make), dimension=None, output=output)
    torch.testing.assert_close(several(frames), expected(frames))
    torch.testing.assert_close(several.without_code()(frames), expected(frames))


def test_mean_and_deviation_are_taken_out_last():
    frames = torch.rand(2, 3, 12, 16)
    net = plain(mean=[0.1, 0.2, 0.3], std=0.5, cell=4).eval()
    assert set(net.state_dict()) == set(plain().state_dict())
    other = plain(cell=4).eval()
    other.load_state_dict(net.state_dict())
    mean = torch.tensor([0.1, 0.2, 0.3])[:, None, None]
    other.cell = 0
    expected = other((local_contrast(frames, 4) - mean) / 0.5)
    torch.testing.assert_close(net(frames), expected)


NO_MAPS = "expected maps (B,K,h,w), vectors (B,K)"


@pytest.mark.parametrize(
    ("make", "output", "facts"),
    [
        (lambda: nn.Conv2d(1, 4, 3), None, ("Conv2d fails on frames", "(1, 3, 96, 96)", "channels")),
        (Picky, None, ("Picky fails on frames", "frames of 96 are not what I want")),
        (lambda: Maker(lambda f: f[..., None]), None, ("Maker made (1, 3, 96, 96, 1)", NO_MAPS)),
        (lambda: Maker(lambda f: f.mean()), None, ("Maker made ()", NO_MAPS)),
        (lambda: Maker(lambda f: []), None, ("Maker made list", NO_MAPS)),
        (lambda: Maker(lambda f: {"sizes": "96"}), None, ("Maker made dict", NO_MAPS)),
        (
            lambda: Maker(lambda f: [f, f[:, :2]]),
            None,
            ("Maker made 2 tensors", "(1, 3, 96, 96), (1, 2, 96, 96)", "output", "layer"),
        ),
        (lambda: Maker(lambda f: (MEAN(f), f)), 2, ("output is 2", "Maker made 2")),
        (lambda: Maker(lambda f: (MEAN(f), None)), 1, ("NoneType", "output")),
        (lambda: Maker(MEAN), 1, ("output is 1", "Maker made 1")),
    ],
)
def test_networks_that_do_not_fit_are_refused(make, output, facts):
    network = make().train()
    with refused(*facts):
        Embedding(network, output=output)
    assert network.training


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: Embedding(nn.functional.relu), ("function", "nn.Module")),
        (lambda: plain()(torch.rand(2, 2, 8, 8)), ("(2, 2, 8, 8)", "(B,1,H,W) or (B,3,H,W)")),
        (lambda: plain()(torch.rand(3, 8, 8)), ("(3, 8, 8)", "(B,1,H,W) or (B,3,H,W)")),
        (lambda: plain(dimension=0), ("dimension=0", "at least 1")),
        (lambda: plain(dimension=None, hidden=6), ("hidden=6", "or none and hidden 0")),
        (lambda: plain(channels=2), ("channels=2", "1 or 3")),
        (lambda: plain(resize=(8, 8, 8)), ("resize=(8, 8, 8)", "expected")),
        (lambda: plain(grid=0), ("grid=0", "1 to 256")),
        (lambda: plain(cell=-1), ("cell=-1", "0 or more")),
        (lambda: Coder(0, 3), ("Coder got", "expected at least 1 each, the noise 0 or more")),
        (lambda: Coder(6, 0), ("Coder got", "dimension=0")),
        (lambda: Coder(6, 3, hidden=0), ("Coder got", "hidden=0")),
        (lambda: Coder(6, 3, kept=0), ("Coder got", "kept=0")),
        (lambda: Coder(6, 3, noise=-1.0), ("Coder got", "noise=-1.0")),
        (lambda: Coder(6, 3, noise=math.inf), ("Coder got", "noise=inf")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


def test_a_map_brings_a_layer_back(tmp_path):
    network = SmallCNN(dimension=7, resize=(16, 16), widths=(4, 8))
    net = Embedding(network, None, layer="linear", mean=0.4, std=[0.2, 0.3, 0.4])
    frames = torch.rand(20, 3, 24, 24)
    model = DejaVu(net).learn(frames).eval()
    model.save(tmp_path / "map.safetensors")
    assert torch.equal(DejaVu.load(tmp_path / "map.safetensors")(frames), model(frames))


# the code ---------------------------------------------------------------------------------------------


def test_components_are_whitened_and_of_one_length():
    views, places = torch.randn(2, 200, 6)
    coder = Coder(6, 3, hidden=5, kept=4).eval()
    coder.whiten(views, places)
    mean, projection = learned_whitening(views, places, 4)
    largest = projection.abs().argmax(0)
    assert bool((coder.projection[largest, torch.arange(4)] > 0).all())
    components = (views - mean) @ projection * projection[largest, torch.arange(4)].sign()
    components = components * (2 / components.norm(dim=1, keepdim=True))
    torch.testing.assert_close(coder(views), coder.layers(components))
    torch.testing.assert_close(coder(mean + 7 * (views - mean)), coder(views), rtol=1e-4, atol=1e-4)


def test_gradients_reach_the_descriptor():
    coder = Coder(4, 2, hidden=3, noise=0.0).double().eval()
    views = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(coder, (views,))
