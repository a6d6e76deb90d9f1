"""The lines of a long route, made and gone through in blocks, and the step that is found for them."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import refused
from test_spectral import held, levels_of, route

from dejavu_torch import memory
from dejavu_torch.maps import quantisation
from dejavu_torch.maps.spectral import SpectralMapper

SETTINGS: list[dict[str, Any]] = [
    {},
    {"chunk": 700, "resolution": 4.0},
    {"transform": "dct", "resolution": 4.0},
]


@pytest.fixture
def in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every route is a long one; its lines are in a file."""
    monkeypatch.setattr(quantisation, "BLOCK", 1000)
    monkeypatch.setattr(quantisation, "empty", lambda *size: memory.empty(*size, in_memory=0))


@pytest.mark.parametrize("settings", SETTINGS)
def test_in_blocks_a_map_of_a_step_holds_the_same(
    settings: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    descriptors = route(2000, 24)
    whole = SpectralMapper(None, step=0.1, **settings)(descriptors)
    request.getfixturevalue("in_blocks")
    parts = SpectralMapper(None, step=0.1, **settings)(descriptors)
    assert torch.equal(parts.means, whole.means)
    differ = (levels_of(parts) != levels_of(whole)).sum()  # sums of floats in another order
    assert differ <= 1e-3 * (levels_of(whole) != 0).sum()
    assert torch.allclose(held(parts), held(whole), atol=0.02)


@pytest.mark.usefixtures("in_blocks")
@pytest.mark.parametrize(("budget", "settings"), [(0.7, SETTINGS[0]), (4.0, SETTINGS[1]), (4.0, SETTINGS[2])])
def test_in_blocks_the_route_is_within_the_budget(settings: dict[str, Any], budget: float) -> None:
    descriptors = route(2000, 24)
    learned = SpectralMapper(budget, **settings)(descriptors)
    assert 0.98 * budget <= learned.summary().route_bytes / 2000 <= budget
    error = (held(learned) - descriptors).square().mean()
    assert error < (0.7 if budget < 1 else 0.1) * descriptors.var()


@pytest.mark.usefixtures("in_blocks")
def test_descriptors_may_be_halves_in_a_file(tmp_path: Path) -> None:
    descriptors = route(900, 24).half()
    descriptors.numpy().tofile(tmp_path / "d")
    mapped = torch.from_numpy(np.memmap(tmp_path / "d", np.float16, "c", shape=(900, 24)))
    learned, own = SpectralMapper(3.0)(mapped), SpectralMapper(3.0)(descriptors.float())
    assert torch.equal(levels_of(learned), levels_of(own))
    assert torch.equal(learned.steps, own.steps)


def test_there_may_be_no_room_for_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, refused("1000 x 3", "No space left", "TMPDIR"):
        patch.setattr(os, "posix_fallocate", full)
        memory.empty(1000, 3, torch.device("cpu"), in_memory=0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with refused("temporary file", "TMPDIR"):
        memory.empty(1000, 3, torch.device("cpu"), in_memory=0)
