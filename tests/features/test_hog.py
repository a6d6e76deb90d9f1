"""HOG: skimage is the oracle of the values, gradcheck that of the gradients."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from helpers import refused
from skimage.feature import hog as skimage_hog

from dejavu_torch import HOG, hog
from dejavu_torch.features.hog import cell_histograms, gradients
from dejavu_torch.resize import resize_frames

SIZES = [(16, 16), (37, 45), (33, 100)]


def picture(height, width, channels, seed=0):
    """Random uint8 pixels (H,W,C)."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def frames_of(image, dtype):
    return torch.from_numpy(image).permute(2, 0, 1)[None].to(dtype)


def oracle(frames, orientations=9, cell=8, block=2):
    """skimage on the very numbers we get: it too works in the precision of its input."""
    return skimage_hog(
        frames[0].permute(1, 2, 0).numpy(),
        orientations=orientations,
        pixels_per_cell=(cell, cell),
        cells_per_block=(block, block),
        channel_axis=2,
    )


def test_convention_9_equals_skimage_on_whole_numbers():
    for dtype in (torch.float64, torch.float32):
        for channels in (1, 3):
            for height, width in SIZES:
                frames = frames_of(picture(height, width, channels), dtype)
                ours = hog(frames)[0]
                assert ours.dtype == dtype
                np.testing.assert_allclose(ours.numpy(), oracle(frames), rtol=0, atol=1e-6)


def test_convention_9_equals_skimage_on_grey_frames():
    for dtype in (torch.float64, torch.float32):
        for height, width in SIZES:
            frames = frames_of(picture(height, width, 1), dtype) / 255
            np.testing.assert_allclose(hog(frames)[0].numpy(), oracle(frames), rtol=0, atol=1e-6)


def test_convention_9_equals_skimage_on_colour_frames():
    for seed in range(40):  # little contrast: two channels often have gradients of one length
        frames = frames_of(100 + picture(16, 16, 3, seed) % 16, torch.float32) / 255
        np.testing.assert_allclose(hog(frames)[0].numpy(), oracle(frames), rtol=0, atol=1e-6)


def test_convention_9_equals_skimage_on_real_values():
    for channels in (1, 3, 4):
        for height, width in SIZES:
            frames = torch.rand(1, channels, height, width, dtype=torch.float64)
            np.testing.assert_allclose(hog(frames)[0].numpy(), oracle(frames), rtol=0, atol=1e-6)


def test_convention_9_equals_skimage_in_other_layouts():
    for dtype in (torch.float64, torch.float32):
        for orientations, cell, block in ((4, 4, 1), (6, 5, 3), (8, 8, 2), (12, 5, 2)):
            # whole numbers: with 4, 8 or 12 bins 45 degrees is a bin edge; only exact differences lie on it
            frames = frames_of(picture(37, 45, 3), dtype)
            ours = hog(frames, orientations, cell, block)[0]
            np.testing.assert_allclose(
                ours.numpy(), oracle(frames, orientations, cell, block), rtol=0, atol=1e-6
            )


def test_convention_9_gradients_are_finite_on_a_flat_image():
    for bins in ("hard", "linear"):
        half_flat = torch.full((1, 3, 32, 32), 0.4)
        half_flat[..., 16:] = torch.rand(16)
        for frames in (torch.full((2, 1, 32, 32), 0.5), torch.zeros(1, 3, 32, 32), half_flat):
            frames.requires_grad_()
            features = hog(frames, bins=bins)
            features.square().sum().backward()
            assert features.isfinite().all()
            assert frames.grad is not None
            assert frames.grad.isfinite().all()


def test_convention_3_default_layout():
    """9 unsigned bins, 8 x 8 cells, 2 x 2 blocks that move by one cell, no resize."""
    assert hog(torch.rand(1, 1, 96, 96)).shape == (1, 4356)
    assert HOG()(torch.rand(1, 1, 72, 48)).shape == (1, 8 * 5 * 4 * 9)
    image = torch.rand(1, 1, 32, 32)
    assert torch.equal(HOG()(image), hog(image, orientations=9, cell=8, block=2, resize=None))
    # unsigned: light on dark and dark on light look alike
    torch.testing.assert_close(hog(image), hog(1 - image))


@pytest.mark.parametrize(
    ("shape", "settings"),
    [
        # random pixels keep clear of bin edges, of the clip at 0.2 and of ties between channels
        ((2, 1, 9, 8), {}),
        ((2, 3, 9, 8), {}),
        ((2, 1, 9, 8), {"bins": "linear"}),
        ((1, 1, 12, 12), {"resize": (8, 8)}),
    ],
)
def test_gradients_are_right(shape, settings):
    frames = torch.rand(shape, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: hog(x, orientations=4, cell=4, block=2, **settings), frames)


def test_frames_are_resized_as_everywhere():
    frames = torch.rand(2, 3, 50, 70)
    assert torch.equal(hog(frames, resize=(32, 40)), hog(resize_frames(frames, (32, 40))))


def test_a_large_batch_is_worked_off_in_parts(largest_tensor):  # type: ignore[no-untyped-def]
    frames = torch.rand(40, 1, 160, 160)
    with largest_tensor() as seen:
        features = hog(frames)
    torch.testing.assert_close(features[-3:], hog(frames[-3:]), rtol=0, atol=1e-6)
    assert seen.numel == features.numel()  # nothing of the size of all frames


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: hog(torch.rand(1, 1, 15, 40)), ("15 x 40", "16 x 16")),
        (lambda: hog(torch.rand(1, 1, 40, 15)), ("40 x 15", "16 x 16")),
        (lambda: HOG(orientations=0), ("orientations=0", "at least 1")),
        (lambda: HOG(cell=0), ("cell=0", "at least 1")),
        (lambda: HOG(block=-1), ("block=-1", "at least 1")),
        (lambda: HOG(resize=(32, 8)), ("resize=(32, 8)", "at least 16")),
        (lambda: HOG(resize=(32,)), ("resize=(32,)", "(height, width)")),
        (lambda: HOG(bins="soft"), ("bins='soft'", "'hard' or 'linear'")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


def test_cells_follow_the_size_of_frames_until_a_map_is_learned():
    small, large = torch.rand(2, 1, 80, 100), torch.rand(2, 1, 80, 101)
    features = HOG(cell=None)
    assert torch.equal(features(small), hog(small))
    assert torch.equal(features(large), hog(large, cell=16))
    for frames, cell in ((large, 16), (small, 8)):
        features = features.for_frames(*frames.shape[2:])
        assert features.cell == cell
    assert HOG(cell=4).for_frames(80, 101).cell == 4
    assert HOG(cell=None, resize=(64, 64))(large).shape == HOG(resize=(64, 64))(large).shape


def linear_oracle(image, orientations, cell, block):
    """HOG with shared votes of a grey image (H,W), pixel by pixel."""
    height, width = image.shape
    ny, nx = height // cell, width // cell
    cells = np.zeros((ny, nx, orientations))
    for y, x in itertools.product(range(ny * cell), range(nx * cell)):
        down = image[y + 1, x] - image[y - 1, x] if 0 < y < height - 1 else 0.0
        right = image[y, x + 1] - image[y, x - 1] if 0 < x < width - 1 else 0.0
        angle = math.degrees(math.atan2(down, right))
        for k in range(orientations):
            apart = abs(angle - (k + 0.5) * 180 / orientations) % 180
            share = max(0.0, 1 - min(apart, 180 - apart) / (180 / orientations))
            cells[y // cell, x // cell, k] += share * math.hypot(down, right) / cell**2
    features = []
    for y, x in itertools.product(range(ny - block + 1), range(nx - block + 1)):
        values = cells[y : y + block, x : x + block].ravel()
        values = np.minimum(values / np.sqrt((values**2).sum() + 1e-10), 0.2)
        features.append(values / np.sqrt((values**2).sum() + 1e-10))
    return np.concatenate(features)


def test_linear_bins_equal_a_literal_loop():
    for orientations, cell, block in ((9, 8, 2), (4, 5, 1), (2, 4, 3)):
        for levels in (3, 256):
            image = np.random.default_rng(0).integers(0, levels, (25, 30)) / 255
            frames = torch.from_numpy(image)[None, None]
            for dtype in (torch.float64, torch.float32):
                ours = hog(frames.to(dtype), orientations, cell, block, bins="linear")[0]
                expected = linear_oracle(image, orientations, cell, block)
                np.testing.assert_allclose(
                    ours.numpy(), expected, rtol=0, atol=1e-6 if dtype.itemsize == 8 else 1e-5
                )


@pytest.mark.parametrize("bins", ["hard", "linear"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradients_are_finite_at_the_singular_points(bins, dtype):
    """No gradient at all, one along an axis to either side, and those whose square underflows."""
    for small in (0.0, 1e-45, 1e-30, 1e-23, 1e-22, 3e-20, 1e-19, 1e-10):
        for down, right in itertools.product([0.0, -0.0, small, -small, 1.0], repeat=2):
            rows = torch.full((1, 4, 4), down, dtype=dtype, requires_grad=True)
            columns = torch.full((1, 4, 4), right, dtype=dtype, requires_grad=True)
            votes = cell_histograms(rows, columns, 9, 4, bins)
            slopes = torch.autograd.grad((votes * torch.arange(9)).sum(), [rows, columns])
            assert all(one.isfinite().all() for one in (votes, *slopes))


def test_each_pixel_takes_its_strongest_channel():
    frames = torch.rand(2, 4, 12, 13, dtype=torch.float64)
    alone = [gradients(frames[:, channel, None]) for channel in range(4)]
    strongest = torch.stack([torch.hypot(*pair) for pair in alone]).argmax(0)
    for together, apart in zip(gradients(frames), zip(*alone, strict=True), strict=True):
        expected = torch.stack(apart).gather(0, strongest[None])[0]
        torch.testing.assert_close(together, expected, rtol=0, atol=1e-12)
