"""Local contrast against numpy, and the small CNN."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import refused
from torch import nn

from dejavu_torch.features.cnn import FLAT, SmallCNN, local_contrast
from dejavu_torch.features.embedding import Embedding


def small(**settings):
    return SmallCNN(**{"dimension": 6, "resize": (16, 24), "widths": (4, 6), "squeeze": 3} | settings)


# local contrast


def around(image, cell):
    """Means of the cells of one channel, interpolated between their centres; whole cells."""
    values = image.unflatten(0, (-1, cell)).unflatten(2, (-1, cell)).mean((1, 3)).numpy()
    for size in image.shape:  # rows, then columns
        centres = (np.arange(len(values)) + 0.5) * cell - 0.5
        values = np.stack([np.interp(np.arange(size), centres, line) for line in values.T])
    return torch.from_numpy(values)


@pytest.mark.parametrize("channels", [1, 3])
def test_local_contrast_is_that_of_cells(channels):
    frame = torch.rand(channels, 12, 20, dtype=torch.float64)
    centred = torch.stack([channel - around(channel, 4) for channel in frame])
    contrast = (around(centred.square().mean(0), 4) + FLAT**2).sqrt()
    torch.testing.assert_close(local_contrast(frame[None], 4)[0], centred / contrast, rtol=0, atol=1e-12)


def test_gain_and_offset_change_almost_nothing():
    frames = torch.rand(2, 3, 32, 40, dtype=torch.float64)
    plain = local_contrast(frames)
    torch.testing.assert_close(local_contrast(frames + 0.3), plain, rtol=0, atol=1e-12)
    torch.testing.assert_close(local_contrast(0.5 * frames), plain, rtol=0, atol=0.01)
    assert plain.mean().abs() < 0.05
    assert 0.5 < plain.std() < 1.5


def test_gradients_of_local_contrast_are_right_and_finite_on_a_flat_frame():
    frames = torch.rand(1, 2, 5, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: local_contrast(x, 3), frames)
    flat = torch.full((1, 1, 8, 8), 0.5, requires_grad=True)
    local_contrast(flat, 4).square().sum().backward()
    assert flat.grad is not None
    assert flat.grad.isfinite().all()


# the network


def test_frames_in_double_precision_are_described_in_that_of_the_weights():
    net, frames = small().eval(), torch.rand(2, 3, 20, 20)
    torch.testing.assert_close(net(frames.double()), net(frames))
    of_any = Embedding(nn.Conv2d(3, 4, 3), dimension=5, resize=(16, 24)).eval()
    torch.testing.assert_close(of_any(frames.double()), of_any(frames))


def test_the_contrast_is_that_of_local_contrast_unless_it_is_left():
    frames, net = torch.rand(4, 3, 16, 24), small().eval()
    found, net.cell = net(frames), 0
    assert torch.equal(found, net(local_contrast(frames, 8)))
    assert not torch.allclose(found, net(frames))
    assert not torch.allclose(net(frames.flip(3)), net(frames), atol=1e-3)  # it knows where things are


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: small(dimension=0), ("dimension=0", "at least 1 each")),
        (lambda: small(channels=0), ("channels=0", "at least 1 each")),
        (lambda: small(resize=(16,)), ("resize=(16,)", "at least 1 each")),
        (lambda: small(widths=()), ("widths=()", "at least 1 each")),
        (lambda: small(widths=(4, 0)), ("widths=(4, 0)", "at least 1 each")),
        (lambda: small(squeeze=0), ("squeeze=0", "at least 1 each")),
        (lambda: small(cell=-1), ("cell=-1", "cell 0 or more")),
        (lambda: small()(torch.rand(2, 1, 16, 24)), ("(2, 1, 16, 24)", "(B, 3, H, W)")),
        (lambda: small()(torch.rand(3, 16, 24)), ("(3, 16, 24)", "(B, 3, H, W)")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()
