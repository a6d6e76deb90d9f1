"""Windows of a picture described together: equal to windows alone away from their borders."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from dejavu_torch import HOG, DejaVu, Preprocess, SpectralMapper, Whitening
from dejavu_torch.data.grid import Grid
from dejavu_torch.data.traverse import Cropped, Part, kept
from dejavu_torch.features import shared
from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.shared import Blocks, Sharing, Windows
from dejavu_torch.features.views import Sample

CPU = torch.device("cpu")
CLOSE = {"rtol": 1e-3, "atol": 1e-3}  # sums of other lengths round otherwise


def ground(height=150, width=190, channels=3, seed=0):
    """A picture of textures of two sizes, (C,H,W) uint8."""
    draw = torch.Generator().manual_seed(seed)
    noise = [torch.rand(1, channels, height // n + 1, width // n + 1, generator=draw) for n in (3, 9)]
    grown = [nn.functional.interpolate(one, (height, width), mode="bicubic") for one in noise]
    return (255 * (sum(grown) / 2)).clamp(0, 255)[0].byte()  # type: ignore[union-attr]


def both(features, grid, preprocess=None):
    """Features of all windows together, and of each alone."""
    sharing = Sharing(preprocess or Preprocess(), features, CPU)
    windows = Windows.of(grid)
    assert windows is not None
    assert sharing.fits(grid)
    with torch.no_grad():
        return torch.cat([*sharing.batches(windows)]), features(grid[:])


@pytest.mark.parametrize("stride", [3, 4, 8])
@pytest.mark.parametrize("bins", ["hard", "linear"])
def test_inner_cells_of_hog_are_those_of_windows_alone(small_tiles, stride, bins):
    hog = HOG(orientations=5, block=1, bins=bins)
    grid = Grid(ground(), 48, stride)
    assert len(grid.layout.tiles) > 1
    together, alone = (one.view(len(grid), 6, 6, 5) for one in both(hog, grid))
    torch.testing.assert_close(together[:, 1:-1, 1:-1], alone[:, 1:-1, 1:-1], rtol=1e-4, atol=1e-4)
    assert not torch.allclose(together[:, 0], alone[:, 0], atol=1e-3)  # gradients reach over the border


@pytest.mark.parametrize("stride", [4, 1])
def test_inner_blocks_are_in_the_order_of_hog(small_tiles, stride):
    hog, grid = HOG(cell=8, block=2), Grid(ground(56 + 5 * stride, 56 + 8 * stride), 56, stride)
    together, alone = (one.view(len(grid), 6, 6, 36) for one in both(hog, grid))
    torch.testing.assert_close(together[:, 1:-1, 1:-1], alone[:, 1:-1, 1:-1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("window", "stride"), [(64, 4), (64, 8), (64, 2), (96, 1), (96, 7), (128, 16)])
@pytest.mark.parametrize("channels", [1, 3])
def test_inner_features_of_the_network_are_those_of_windows_alone(small_tiles, window, stride, channels):
    grid = Grid(ground(window + 5 * stride, window + 9 * stride, channels), window, stride)
    together, alone = (one.view(len(grid), 40, 6, 6) for one in both(Distilled(), grid))
    scale = float(alone.abs().max())
    torch.testing.assert_close(together[..., 2:4, 2:4], alone[..., 2:4, 2:4], rtol=1e-3, atol=1e-4 * scale)


def test_windows_that_show_nothing_have_no_features(small_tiles):
    picture = ground()
    picture[:, :70, :80] = 128
    grid, own = Grid(picture, 64, 8), Descriptor(whitening=Whitening(4))
    own.adapt(grid)
    together = torch.cat([*own.features_in(grid, shared=True)])
    alone = torch.cat([*own.features_in(grid)])
    blank = ~alone.any(1)
    assert 0 < int(blank.sum()) < len(grid)
    assert torch.equal(~together.any(1), blank)


def test_the_mean_is_that_of_windows_alone(small_tiles):
    grid, own = Grid(ground(), 64, 8), Descriptor(whitening=Whitening(4))
    own.adapt(grid)
    together = torch.cat([*own.features_in(grid, shared=True)])
    alone = torch.cat([*own.features_in(grid)])
    assert torch.equal(together, torch.cat([*own.features_in(Part(grid, range(len(grid))), shared=True)]))
    before = (together - own.offset - alone).mean(0)
    assert float((together - alone).mean(0).norm()) < 0.2 * float(before.norm())


def test_tiles_of_a_picture_are_described_alike_by_themselves(small_tiles):
    grid = Grid(ground(), 64, 8)
    sharing = Sharing(Preprocess(), Joined([HOG(), Distilled()]), CPU)
    every = Windows.of(grid)
    assert every is not None
    whole = torch.cat([*sharing.batches(every)])
    rows, columns = grid.layout.tiles[0]
    part = Windows.of(Part(grid, range(rows * columns, len(grid))))
    assert part is not None
    torch.testing.assert_close(torch.cat([*sharing.batches(part)]), whole[rows * columns :], **CLOSE)
    assert Windows.of(Part(grid, range(1, len(grid)))) is None  # no whole tile
    assert Windows.of(Part(grid, torch.arange(len(grid)))) is None
    sample = Sample.of_area(grid.layout)
    blocks = Windows.of(Blocks(grid, sample.frame, sample.sizes))
    assert blocks is not None
    torch.testing.assert_close(torch.cat([*sharing.batches(blocks)]), whole[sample.frame], **CLOSE)


def test_frames_that_were_changed_are_described_alone(small_tiles):
    grid = Grid(ground(), 64, 8)
    black = torch.zeros(1, 64, 64)
    assert Windows.of(Cropped(grid, [0, 0, 0, 0], black)) is None  # a mask
    assert Windows.of(kept(grid)) is not None


def test_large_blocks_are_described_in_bands(monkeypatch):
    grid, sharing = Grid(ground(), 64, 4), Sharing(Preprocess(), Joined([HOG(), Distilled()]), CPU)
    windows = Windows.of(grid)
    assert windows is not None
    whole = [*sharing.batches(windows)]
    monkeypatch.setattr(shared, "WINDOWS", 3 * grid.layout.columns)
    parts = [*sharing.batches(windows)]
    assert len(whole) == 1
    assert max(map(len, parts)) == 3 * grid.layout.columns
    torch.testing.assert_close(torch.cat(parts), whole[0], **CLOSE)


def test_other_features_and_strides_are_described_alone(small_tiles):
    grid = Grid(ground(), 64, 5)
    assert not Sharing(Preprocess(), Distilled(), CPU).fits(grid)  # 7.5 pixels of the network's frames
    assert Sharing(Preprocess(), HOG(), CPU).fits(grid)
    finest = Windows.of(Grid(ground(130, 131), 128, 1))
    assert finest is not None
    assert sum(map(len, Sharing(Preprocess(), HOG(), CPU).batches(finest))) == 3 * 4
    assert not Sharing(Preprocess(contrast="patch"), HOG(), CPU).fits(grid)
    assert not Sharing(Preprocess(), HOG(resize=(32, 32)), CPU).fits(grid)
    assert not Sharing(Preprocess(), nn.Flatten(), CPU).fits(grid)
    model = DejaVu(features=nn.Sequential(nn.AvgPool2d(16), nn.Flatten()), mapper=SpectralMapper(step=0.05))
    assert model.learn(grid).localize(grid).index.tolist() == [*range(len(grid))]


def test_a_map_of_windows_described_together_finds_windows_alone(small_tiles):
    grid = Grid(ground(), 64, 8)
    model = DejaVu(mapper=SpectralMapper(step=0.05)).learn(grid)
    found = model.localize(grid).index
    assert float((found == torch.arange(len(grid))).double().mean()) > 0.95
