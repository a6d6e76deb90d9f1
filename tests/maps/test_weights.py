"""Weights in 8 bits: how far off they are, that they come back bit for bit, and what is refused."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from torch import nn

from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.file import read_map
from dejavu_torch.maps.weights import fits, in_bits, is_rounded, packed, quantised, round_weights, rounded
from dejavu_torch.model import DejaVu

FINITE = st.floats(-(2.0**126), 2.0**126, width=32)
MATRICES = arrays(np.float32, array_shapes(min_dims=2, max_dims=4, max_side=6), elements=FINITE)


class Net(nn.Module):
    """A user's network: tied weights, infinities, an expanded buffer, 16 bits, a channel of 0."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(64, 16)
        self.again = nn.Linear(64, 16, bias=False)
        self.again.weight = self.first.weight
        self.mask = nn.Parameter(torch.tensor([[0.0, -torch.inf]]))
        self.narrow = nn.Parameter(torch.rand(2, 2).half())
        self.register_buffer("table", torch.rand(4, 1).expand(4, 4))
        with torch.no_grad():
            self.first.weight[3] = 0

    def forward(self, frames):
        flat = frames.flatten(1)
        return self.first(flat) + self.again(flat.square())


def frames(count=64):
    return torch.rand(count, 1, 8, 8, generator=torch.Generator().manual_seed(0))


def small():
    torch.manual_seed(0)
    return SmallCNN(16, channels=1, resize=(16, 16), widths=(8, 16), squeeze=8)


@given(MATRICES)
def test_each_number_is_off_by_half_a_step_of_its_channel(values):
    weight = torch.from_numpy(values)
    whole, scale = quantised(weight)
    exact = whole.double() * scale.double().view(-1, *[1] * (weight.ndim - 1))
    # a channel below what a scale can tell is 0
    half = scale.double().div(2).clamp(min=128 * torch.finfo(torch.float32).tiny)
    error = (weight.double() - exact).abs().flatten(1).amax(1)
    assert bool((error <= half).all())
    assert torch.equal(rounded(weight).double(), exact)  # the product is exact


@given(MATRICES)
def test_what_is_rounded_stays_as_it_is(values):
    once = rounded(torch.from_numpy(values))
    assert torch.equal(once.view(torch.int32), rounded(once).view(torch.int32))
    for one, other in zip(quantised(once), quantised(torch.from_numpy(values)), strict=True):
        assert torch.equal(one, other)


def test_the_closed_form():
    whole, scale = quantised(torch.tensor([[127.0, 63.4, -0.6], [-254.0, 3.1, 0.9]]))
    assert whole.tolist() == [[127, 63, -1], [-127, 2, 0]]
    assert scale.tolist() == [1.0, 2.0]
    for weight in (torch.rand(3), torch.rand(2, 2).double(), torch.rand(0, 2), torch.ones(2, 2).int()):
        assert not fits(weight)


def test_parameters_alone_are_rounded():
    net = Net()
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    assert not is_rounded(net)
    assert round_weights(net)
    assert is_rounded(net)
    after = net.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"first.weight", "again.weight"}
    assert {name for name, tensor in packed(net).items() if tensor.dtype == torch.int8} == changed


def test_a_network_is_rounded_for_a_while():
    net = small()
    before = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    with suppress(KeyError), in_bits(net, 8):
        assert is_rounded(net)
        raise KeyError
    assert all(torch.equal(tensor, before[name]) for name, tensor in net.state_dict().items())
    with in_bits(net, 32):
        assert not is_rounded(net)


@pytest.fixture
def path(tmp_path):
    """The map of a network in 8 bits."""
    DejaVu(small(), weight_bits=8).learn(frames()).save(tmp_path / "map.safetensors")
    return tmp_path / "map.safetensors"


@pytest.mark.parametrize("make", [small, Net])
def test_a_file_gives_back_the_network_bit_for_bit(tmp_path, make):
    model = DejaVu(make(), weight_bits=8).learn(frames()).eval()
    model.save(path := tmp_path / "map.safetensors")
    again = DejaVu.load(path, make())
    assert again.weight_bits == 8
    loaded = again.features.state_dict()
    assert all(torch.equal(tensor, loaded[name]) for name, tensor in model.features.state_dict().items())
    assert all(tensor.dtype != torch.int8 for tensor in loaded.values())
    assert torch.equal(again(frames(9)), model(frames(9)))
    assert path.stat().st_size == model.summary().map_bytes == again.summary().map_bytes
    again.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("whitening", [True, False])
def test_what_another_map_brings_stays_in_8_bits(path, whitening):
    model = DejaVu()
    model.descriptor.take(DejaVu.load(path).descriptor, whitening)
    model.learn(frames()).save(other := path.with_name("other.safetensors"))
    assert DejaVu.load(other).weight_bits == 8


def test_bits_that_do_not_fit_are_refused(tmp_path):
    for features, bits, words in (
        (HOG(), 8, ("weight_bits is 8", "HOG has no", "expected 32")),
        (nn.LazyLinear(3), 8, ("LazyLinear", "yet")),
        (small(), 4, ("weight_bits is 4", "8, 32")),
    ):
        with refused(*words):
            DejaVu(features, weight_bits=bits)
    model = DejaVu(network := small(), weight_bits=8).learn(frames())
    with torch.no_grad():
        network.linear.weight[0, 0] += 1e-4
    with refused("SmallCNN", "8 bits"):
        model.save(tmp_path / "map.safetensors")
    assert not list(tmp_path.iterdir())


WEIGHT, SCALES = "features.linear.weight", "features.linear.weight.scale"


def test_a_file_of_the_time_before_is_as_it_was(tmp_path):
    """Weights of 32 bits are written as ever, and nothing says so."""
    model = DejaVu(small()).learn(frames())
    model.save(path := tmp_path / "map.safetensors")
    tensors, header = read_map(path)
    own = {name: tensor for name, tensor in tensors.items() if name.startswith("features.")}
    assert own.keys() == {f"features.{name}" for name in model.features.state_dict()}
    assert "weight_bits" not in header
    assert DejaVu.load(path).weight_bits == 32
