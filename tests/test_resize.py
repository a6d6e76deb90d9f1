from __future__ import annotations

import pytest
import torch

from dejavu_torch.resize import resize_frames


@pytest.mark.parametrize("factor", [1, 2, 5])
def test_a_ramp_stays_a_ramp(factor):
    """Away from the borders, where nothing is mirrored: pixel centres keep their place in the scene."""
    ramp = torch.linspace(0, 1, 80, dtype=torch.float64).expand(1, 1, 40, 80)
    small = resize_frames(ramp, (40 // factor, 80 // factor))
    centres = (torch.arange(80 // factor, dtype=torch.float64) * factor + (factor - 1) / 2) / 79
    torch.testing.assert_close(small[0, 0, 2, 2:-2], centres[2:-2])


def test_it_is_antialiased():
    checks = ((torch.arange(64)[:, None] + torch.arange(64)) % 2).float()[None, None]
    small = resize_frames(checks, (8, 8))
    torch.testing.assert_close(small, torch.full_like(small, 0.5), atol=0.02, rtol=0)


def test_gradients_are_right():
    frames = torch.rand(1, 2, 6, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: resize_frames(x, (3, 9)), frames)


def test_frames_of_the_size_are_returned_as_they_are():
    frames = torch.rand(2, 1, 32, 40)
    assert resize_frames(frames, (32, 40)) is resize_frames(frames, None) is frames
