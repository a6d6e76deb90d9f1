"""Learned whitening in closed form, and the code behind it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from dejavu_torch import DejaVu
from dejavu_torch.features.coder import SHRINKAGE, Coder, learned_whitening
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.periods.imposed import ImposedPeriods


def pairs(n: int = 200, k: int = 6, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Views and their places: the first numbers change most, the last ones tell most of the place."""
    random = torch.Generator().manual_seed(seed)
    places = torch.randn(n, k, generator=random) * torch.linspace(0.5, 3, k)
    return places + torch.randn(n, k, generator=random) * torch.linspace(3, 0.5, k), places


@given(st.integers(0, 99), st.integers(1, 6))
def test_what_changes_is_alike_in_all_directions(seed: int, kept: int) -> None:
    views, places = pairs(seed=seed)
    mean, projection = learned_whitening(views, places, kept)
    change = (views - places).double() / 2
    within = change.T @ change / len(change)
    shrunk = within + SHRINKAGE * within.diagonal().mean() * torch.eye(6)
    p = projection.double()
    torch.testing.assert_close(p.T @ shrunk @ p, torch.eye(kept).double(), rtol=0, atol=1e-5)
    middle = (views + places).double() / 2 - mean
    between = p.T @ middle.T @ middle @ p
    torch.testing.assert_close(between, between.diagonal().diag(), rtol=0, atol=1e-3 * between.max().item())
    assert (between.diagonal().diff() <= 0).all()


def test_in_closed_form_where_the_numbers_are_independent() -> None:
    """Four pairs: the change has variances 16 and 1, the places 0 and 9, so the second direction is kept."""
    views = torch.tensor([[4.0, 4.0], [-4.0, 4.0], [4.0, -4.0], [-4.0, -4.0]])
    places = torch.tensor([[-4.0, 2.0], [4.0, 2.0], [-4.0, -2.0], [4.0, -2.0]])
    mean, projection = learned_whitening(views, places, 1)
    assert mean.tolist() == [0, 0]
    expected = 1 / math.sqrt(1 + SHRINKAGE * (16 + 1) / 2)
    torch.testing.assert_close(projection.abs(), torch.tensor([[0.0], [expected]]), rtol=0, atol=1e-6)


def test_a_season_is_whitened_away() -> None:
    """What a season changes alike everywhere tells nothing any more, though it is the largest change."""
    _, places = pairs(k=20)
    season = torch.cat([torch.tensor([90.0, -50.0, 40.0]), torch.zeros(17)])
    winter = places + season + 0.1 * torch.randn(places.shape, generator=torch.Generator().manual_seed(1))
    raw = torch.cdist(winter, places).argmin(1) == torch.arange(len(places))
    mean, projection = learned_whitening(winter[:100], places[:100], 16)
    projected = [(x[100:] - mean) @ projection for x in (winter, places)]
    unit = [nn.functional.normalize(x, dim=1) for x in projected]
    found = torch.cdist(*unit).argmin(1) == torch.arange(100)
    assert raw.float().mean() < 0.3
    assert found.float().mean() > 0.9


@pytest.mark.parametrize(
    ("views", "places", "kept", "words"),
    [
        (torch.ones(3, 2), torch.ones(3, 2), 1, ("the descriptors of 3 views", "by 0 in", "an augmentation")),
        (torch.zeros(0, 2), torch.zeros(0, 2), 1, ("of 0 views", "more than rounding")),
        (torch.full((3, 2), math.nan), torch.ones(3, 2), 1, ("by nan", "expected a finite number")),
        (torch.ones(3, 2) + 1e-6, torch.ones(3, 2), 1, ("by 2", "more than rounding")),
        (torch.ones(3, 2), torch.ones(2, 2), 1, ("(3, 2), (2, 2)", "expected (n,K) twice")),
        (torch.ones(3, 2), torch.zeros(3, 2), 3, ("3 to keep", "1 to K to keep")),
        (torch.ones(3), torch.zeros(3), 1, ("(3,), (3,)",)),
    ],
    ids=str,
)
def test_what_cannot_be_whitened(views: Tensor, places: Tensor, kept: int, words: tuple[str, ...]) -> None:
    with refused(*words):
        learned_whitening(views, places, kept)
    if kept == 1 and views.ndim == 2:
        coder = Coder(2, 3, hidden=4)
        with refused(*words):
            coder.whiten(views, places)
        assert not coder.whitened
        assert torch.equal(coder.projection, torch.eye(2))


@pytest.mark.parametrize(
    "settings",
    [{"inputs": 0}, {"dimension": 0}, {"hidden": 0}, {"kept": 0}, {"noise": -1.0}, {"noise": math.inf}],
)
def test_settings_out_of_range(settings: dict[str, float]) -> None:
    with refused("Coder got", "expected at least 1 each, the noise 0 or more"):
        Coder(**{"inputs": 6, "dimension": 3} | settings)  # type: ignore[arg-type]


def test_components_are_whitened_and_of_one_length() -> None:
    views, places = pairs()
    coder = Coder(6, 3, hidden=5, kept=4).eval()
    coder.whiten(views, places)
    mean, projection = learned_whitening(views, places, 4)
    components = (views - mean) @ projection
    components = components * (2 / components.norm(dim=1, keepdim=True))
    torch.testing.assert_close(coder(views), coder.layers(components))
    torch.testing.assert_close(coder(mean + 7 * (views - mean)), coder(views), rtol=1e-4, atol=1e-4)


def test_noise_is_for_training_alone() -> None:
    views, _ = pairs()
    coder = Coder(6, 3, hidden=5, noise=0.5)
    coder.layers[1].momentum = 0.0  # its statistics stay
    assert not torch.equal(coder(views), coder(views))
    coder.noise = 0.0
    assert torch.equal(coder(views), coder(views))
    coder.noise = 0.5
    coder.eval()
    assert torch.equal(coder(views), coder(views))


def test_gradients_reach_the_descriptor() -> None:
    coder = Coder(4, 2, hidden=3, noise=0.0).double().eval()
    views = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(coder, (views,))


def test_a_map_brings_the_whitening_back(tmp_path: Path) -> None:
    frames = torch.rand(12, 3, 16, 16)
    net = Embedding(nn.Conv2d(3, 4, 3), dimension=5, resize=(16, 16), grid=2, hidden=6, noise=0.3, kept=7)
    assert isinstance(net.linear, Coder)
    net.linear.whiten(*net.describe(torch.rand(40, 3, 16, 16)).detach().split(20))
    net.eval()
    model = DejaVu(net, ImposedPeriods([3], bin=1)).learn(frames)
    model.save(tmp_path / "map.safetensors")
    empty = Embedding(nn.Conv2d(3, 4, 3), dimension=5, resize=(16, 16), grid=2, hidden=6, noise=0.3, kept=7)
    again = DejaVu.load(tmp_path / "map.safetensors", features=empty)
    assert torch.equal(again(frames), model(frames))
    assert isinstance(empty.linear, Coder)
    assert empty.linear.whitened
