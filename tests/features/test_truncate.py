"""A network up to a layer: the same output, nothing behind it, and what cannot be ended there."""

from __future__ import annotations

import pytest
import torch
from helpers import refused
from torch import Tensor, nn

from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.truncate import run, up_to

FRAMES = torch.rand(2, 3, 12, 16)


class Block(nn.Module):
    """Adds what a convolution makes."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, maps):
        return maps + self.convolution(maps).relu()


class Net(nn.Module):
    """Blocks of one resolution, a head, and a weight of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.rand(3, 1, 1))
        self.blocks = nn.ModuleList(Block(3) for _ in range(3))
        self.head = nn.Linear(3, 50)

    def forward(self, frames):
        maps = frames * self.scale
        for block in self.blocks:
            maps = block(maps)
        return self.head(maps.mean((2, 3)))


class Tokens(nn.Module):
    """Attention, whose last weights are used without being run."""

    def __init__(self) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(3, 1, batch_first=True)
        self.head = nn.Linear(3, 50)

    def forward(self, frames):
        tokens = frames.flatten(2).mT
        return self.head(self.attention(tokens, tokens, tokens)[0])


class Anxious(Net):
    """Looks at its head ahead of everything."""

    def forward(self, frames):
        return super().forward(frames * self.head.out_features / 50)


@pytest.mark.parametrize("layer", ["blocks.1", "blocks.1.convolution"])
def test_the_output_is_the_layers_and_nothing_behind_it_is_run_or_kept(layer):
    net = Net().eval()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    ended = up_to(net, layer, FRAMES)
    maps = net.blocks[0](FRAMES * net.scale)
    whole = layer == "blocks.1"
    expected = net.blocks[1](maps) if whole else net.blocks[1].convolution(maps)
    found = run(ended, FRAMES)
    assert isinstance(found, Tensor)
    assert torch.equal(found, expected)
    assert set(ended.state_dict()) == {name for name in before if not name.startswith(("blocks.2", "head"))}
    assert net.state_dict().keys() == before.keys()
    assert net(FRAMES).shape == (2, 50)


def test_weights_that_are_used_without_being_run_are_kept():
    net = Tokens().eval()
    ended = up_to(net, "attention", FRAMES)
    assert set(ended.state_dict()) == {name for name in net.state_dict() if name.startswith("attention")}
    found = run(ended, FRAMES)
    assert isinstance(found, tuple)
    tokens = FRAMES.flatten(2).mT
    assert torch.equal(found[0], net.attention(tokens, tokens, tokens)[0])


def test_a_network_that_needs_what_lies_behind_keeps_all_of_it():
    net = Anxious().eval()
    ended = up_to(net, "blocks.0", FRAMES)
    assert ended.state_dict().keys() == net.state_dict().keys()
    found = run(ended, FRAMES)
    assert isinstance(found, Tensor)
    torch.testing.assert_close(found, net.blocks[0](FRAMES * net.scale))


def test_ended_again_it_is_the_same():
    once = up_to(Net(), "blocks.1", FRAMES)
    again = up_to(once, "blocks.1", FRAMES)
    assert again.state_dict().keys() == once.state_dict().keys()


@pytest.mark.parametrize(
    ("layer", "facts"),
    [
        ("", ("Net has no layer ''", "blocks.0", "head")),
        ("blocks.7", ("Net has no layer 'blocks.7'", "blocks.0", "head")),
        ("x" * 10**5, (f"no layer '{'x' * 79}; expected one such as blocks",)),
        ("blocks", ("Net does not run its layer blocks",)),
    ],
    ids=lambda value: str(value)[:9],
)
def test_what_is_no_layer_is_refused(layer, facts):
    with refused(*facts):
        Embedding(Net(), None, resize=(12, 16), layer=layer)


def test_it_can_be_exported_compiled_and_trained():
    net = Embedding(Net(), 4, resize=(12, 16), layer="blocks.1", mean=0.5).eval()
    frames = torch.rand(3, 1, 20, 20)
    batch = {"frames": {0: torch.export.Dim("batch")}}
    for strict in (False, True):
        program = torch.export.export(net, (frames,), dynamic_shapes=batch, strict=strict)
        torch.testing.assert_close(program.module()(frames[:2]), net(frames[:2]))
    compiled = torch.compile(net, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(frames), net(frames))
    net(frames).square().sum().backward()
    assert all(p.grad is not None for p in net.network.parameters())
