"""Learned whitening in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from dejavu_torch.features.embedding import Coder
from dejavu_torch.features.whitening import SHRINKAGE, learned_whitening


def pairs(n: int = 200, k: int = 6, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Views and their places: the first numbers change most, the last ones tell most of the place."""
    random = torch.Generator().manual_seed(seed)
    places = torch.randn(n, k, generator=random) * torch.linspace(0.5, 3, k)
    return places + torch.randn(n, k, generator=random) * torch.linspace(3, 0.5, k), places


@given(st.integers(0, 99), st.integers(1, 6))
def test_changes_are_alike_in_all_directions(seed: int, kept: int) -> None:
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
