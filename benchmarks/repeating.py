"""Descriptors of ground that repeats exactly, made from its two tiles: `sim:aerial?ground=repeat`."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.aerial import TILES, AerialRoad
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.quantisation import quantise
from dejavu_torch.maps.spectrum import spectrum
from dejavu_torch.model import DejaVu
from dejavu_torch.types import Traverse

LOOKED_AT = 16  # dimensions of a descriptor by which a step is chosen
HALVINGS = 12
ROWS = 8192


@torch.no_grad()
def tiles_of(model: DejaVu) -> dict[str, Tensor]:
    """The part of each tile in whitened descriptors of HOG, before scaling to length 1, by phase: (P,K).

    A block of HOG sees one tile or the road between them, which is the same everywhere, so without noise,
    drift and yaw a descriptor is the sum of two parts.
    """
    assert isinstance(model.features, HOG)
    assert model.whitening is not None
    whitening, road = model.whitening, AerialRoad(frames=max(TILES), ground="repeat", noise=0, drift=0, yaw=0)
    features = torch.cat([model.descriptor.describe(part) for part in road.batches(64)])
    middle = features.shape[1] // 7 * 3  # rows of blocks: three see the first tile
    (whole,), scale = whitening.all_unpacked(), whitening.scale
    first = features[: TILES[0], :middle] @ whole[:middle] * scale - whitening.offset
    second = features[: TILES[1], middle:] @ whole[middle:] * scale
    return {"first": first, "second": second}


class TiledRoute(Traverse):
    """Descriptors of two tiles that repeat; first, second: see `tiles_of`."""

    def __init__(self, first: Tensor, second: Tensor, length: int) -> None:
        self.first, self.second, self.length = first, second, length
        self.name = f"{length} places of two tiles"

    def __len__(self) -> int:
        return self.length

    def read(self, frames: range | list[int]) -> Tensor:
        at = torch.as_tensor(frames)
        return F.normalize(self.first[at % len(self.first)] + self.second[at % len(self.second)], dim=1)


def step_that_holds(share: float, route: Traverse, chunk: int) -> float:
    """The step of a spectral map that holds this share of a route's variance, by some of its dimensions."""
    columns = torch.linspace(0, route.frame_shape[0] - 1, LOOKED_AT).long()
    series = torch.cat([part[:, columns] for part in route.batches(ROWS)])
    series -= series.mean(0)
    parts = series.split(chunk)
    lines = torch.cat([spectrum(part.T).T for part in parts])
    total = float(lines.square().sum())
    low, high = 1e-3 * math.sqrt(total / lines.numel()), 2 * float(lines.abs().max())
    for _ in range(HALVINGS):
        step = math.sqrt(low * high)
        lost = float((lines - step * quantise(lines, step)).square().sum())
        low, high = (step, high) if 1 - lost / total > share else (low, step)
    return low
