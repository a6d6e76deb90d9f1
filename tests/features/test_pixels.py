"""Pixels of small frames, normalised in patches side by side."""

from __future__ import annotations

import pytest
import torch
from helpers import refused

from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.resize import resize_frames


def test_equals_a_literal_loop():
    frames = torch.rand(2, 1, 9, 12, dtype=torch.float64)
    frames[0, :, :, :6] = 0.7  # flat
    found = PatchPixels(size=(8, 12), patch=4)(frames).view(2, 8, 12)
    small = resize_frames(frames, (8, 12))[:, 0]
    for image, pixels in zip(small, found, strict=True):
        for top in range(0, 8, 4):
            for left in range(0, 12, 4):
                patch = image[top : top + 4, left : left + 4]
                expected = (patch - patch.mean()) / patch.std(correction=0).clamp(min=1 / 255)
                assert torch.allclose(pixels[top : top + 4, left : left + 4], expected)


@pytest.mark.parametrize(
    ("shape", "pixels"), [((480, 640), 32 * 64), ((64, 64), 32 * 64), ((30, 24), 24 * 24), ((8, 15), 8 * 8)]
)
def test_frames_are_made_small_and_small_ones_stay(shape, pixels):
    assert PatchPixels()(torch.rand(1, 1, *shape)).shape == (1, pixels)


def test_what_holds_no_patch_is_refused():
    with refused("7 x 40", "8 x 8"):
        PatchPixels()(torch.rand(1, 1, 7, 40))
    with refused("size=(8, 64)", "at least 9"):
        PatchPixels((8, 64), 9)
