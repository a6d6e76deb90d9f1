"""Sources whose frames are turned, see `?turn=`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import refused
from PIL import Image

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import at_size
from dejavu_torch.data.turning import TURNS, Upright

BY_PIL = {
    "90": Image.Transpose.ROTATE_270,  # which counts counterclockwise
    "180": Image.Transpose.ROTATE_180,
    "270": Image.Transpose.ROTATE_90,
    "mirror": Image.Transpose.FLIP_LEFT_RIGHT,
    "transpose": Image.Transpose.TRANSPOSE,
}
PIXELS = np.random.default_rng(0).integers(0, 256, (3, 8, 12, 3), np.uint8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Images as they are, and turned by another program."""
    base = tmp_path_factory.mktemp("turned")
    for turn, how in {"plain": None, **BY_PIL}.items():
        (base / turn).mkdir()
        for i, pixels in enumerate(PIXELS):
            image = Image.fromarray(pixels)
            (image if how is None else image.transpose(how)).save(base / turn / f"{i}.png")
    np.save(base / "frames.npy", PIXELS)
    return base


@pytest.mark.parametrize("turn", TURNS)
def test_frames_are_turned_as_other_programs_turn_them(turn, folders):
    expected = open_source(folders / turn)[:]
    for source in ("plain", "frames.npy"):
        turned = open_source(f"{folders / source}?turn={turn}")
        assert torch.equal(turned[:], expected)
        assert turned.frame_shape == tuple(expected.shape[1:])
        assert turned[:].is_contiguous()
    sized = at_size(turned, (6, 4))
    assert sized[:].shape[1:] == sized.frame_shape == (3, 6, 4)


def test_a_size_is_that_of_the_turned_frames_and_decoded_at_once(folders):
    sized = at_size(open_source(f"{folders / 'plain'}?turn=90"), (6, 4))
    assert torch.equal(sized[:], TURNS["90"](at_size(open_source(folders / "plain"), (4, 6))[:]))
    assert sized.traverse.frame_shape == (3, 4, 6)


def test_crop_and_parts_are_of_turned_frames(folders):
    cropped = open_source(f"{folders / 'plain'}?crop=1,2,0,3&turn=90&start=1")
    assert torch.equal(cropped[:], open_source(folders / "90")[1:][:, :, 1:-2, :-3])


def test_headings_turn_with_the_upper_side():
    drive = ArrayTraverse(torch.rand(3, 1, 4, 6))
    drive.headings = torch.tensor([0.0, 100.0, torch.nan]).double()
    found = Upright(drive, "90").headings
    assert found is not None
    assert found[:2].tolist() == [270, 10]
    assert found[2].isnan()
    assert Upright(drive, "mirror").headings[0] == 0  # type: ignore[index]


def test_what_cannot_be_turned_is_refused_in_one_line(folders, tmp_path):
    with refused("turn=45", "90, 180, 270, mirror, transpose, clockwise"):
        open_source(f"{folders / 'plain'}?turn=45")
    np.save(tmp_path / "features.npy", np.ones((4, 5), np.float32))
    with refused("features.npy: turn=90", "frames"):
        open_source(f"{tmp_path / 'features.npy'}?turn=90")
    with refused("turn=180", "--headings"):
        open_source("sim:terrain?metres=32&turn=180")
