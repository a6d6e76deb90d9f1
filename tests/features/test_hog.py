"""HOG: skimage is the oracle, gradcheck the judge of gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.geometry.transform import resize
from skimage.feature import hog as skimage_hog
from torch import Tensor

from dejavu_torch import HOG, InputError, hog

SIZES = [(16, 16), (64, 64), (37, 45), (64, 41), (33, 100), (21, 16)]


def picture(height: int, width: int, channels: int, seed: int = 0) -> np.ndarray:
    """Random uint8 pixels (H,W,C)."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def frames_of(image: np.ndarray, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].to(dtype)


def oracle(frames: Tensor, orientations: int = 9, cell: int = 8, block: int = 2) -> np.ndarray:
    """skimage on the very numbers we get: it too works in the precision of its input."""
    return skimage_hog(
        frames[0].permute(1, 2, 0).numpy(),
        orientations=orientations,
        pixels_per_cell=(cell, cell),
        cells_per_block=(block, block),
        channel_axis=2,
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_convention_9_equals_skimage_on_whole_numbers(
    height: int, width: int, channels: int, dtype: torch.dtype
) -> None:
    frames = frames_of(picture(height, width, channels), dtype)
    ours = hog(frames)[0]
    assert ours.dtype == dtype
    np.testing.assert_allclose(ours.numpy(), oracle(frames), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_convention_9_equals_skimage_on_grey_frames(height: int, width: int, dtype: torch.dtype) -> None:
    frames = frames_of(picture(height, width, 1), dtype) / 255
    np.testing.assert_allclose(hog(frames)[0].numpy(), oracle(frames), rtol=0, atol=1e-6)


def test_convention_9_equals_skimage_on_colour_frames() -> None:
    for seed in range(40):  # little contrast: two channels often have gradients of one length
        frames = frames_of(100 + picture(16, 16, 3, seed) % 16, torch.float32) / 255
        np.testing.assert_allclose(hog(frames)[0].numpy(), oracle(frames), rtol=0, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_convention_9_equals_skimage_on_real_values(height: int, width: int, channels: int) -> None:
    frames = torch.rand(1, channels, height, width, dtype=torch.float64)
    np.testing.assert_allclose(hog(frames)[0].numpy(), oracle(frames), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("block", [1, 2, 3])
@pytest.mark.parametrize("cell", [4, 5, 8])
@pytest.mark.parametrize("orientations", [4, 6, 8, 9, 12])
def test_convention_9_equals_skimage_in_other_layouts(
    orientations: int, cell: int, block: int, dtype: torch.dtype
) -> None:
    # whole numbers: with 4, 8 or 12 bins 45 degrees is a bin edge, and only exact differences lie on it
    frames = frames_of(picture(37, 45, 3), dtype)
    ours = hog(frames, orientations, cell, block)[0]
    np.testing.assert_allclose(ours.numpy(), oracle(frames, orientations, cell, block), rtol=0, atol=1e-6)


def test_convention_9_gradients_are_finite_on_a_flat_image() -> None:
    half_flat = torch.full((1, 3, 32, 32), 0.4)
    half_flat[..., 16:] = torch.rand(16)
    for frames in (torch.full((2, 1, 32, 32), 0.5), torch.zeros(1, 3, 32, 32), half_flat):
        frames.requires_grad_()
        features = hog(frames)
        features.square().sum().backward()
        assert features.isfinite().all()
        assert frames.grad is not None
        assert frames.grad.isfinite().all()


def test_convention_3_default_layout() -> None:
    """9 unsigned bins, 8 x 8 cells, 2 x 2 blocks that move by one cell, no resize."""
    assert hog(torch.rand(1, 1, 96, 96)).shape == (1, 4356)
    assert HOG()(torch.rand(1, 1, 72, 48)).shape == (1, 8 * 5 * 4 * 9)
    image = torch.rand(1, 1, 32, 32)
    assert torch.equal(HOG()(image), hog(image, orientations=9, cell=8, block=2, resize=None))
    # unsigned: light on dark and dark on light look alike
    torch.testing.assert_close(hog(image), hog(1 - image))


@pytest.mark.parametrize("channels", [1, 3])
def test_gradients_are_right(channels: int) -> None:
    # random pixels keep clear of bin edges, of the clip at 0.2 and of ties between channels
    frames = torch.rand(2, channels, 9, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: hog(x, orientations=4, cell=4, block=2), frames)


def test_gradients_pass_through_the_resize() -> None:
    frames = torch.rand(1, 1, 12, 12, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: hog(x, cell=4, block=2, resize=(8, 8)), frames)


def test_resize_is_kornias_antialiased_one() -> None:
    frames = torch.rand(2, 3, 50, 70)
    small = resize(frames, (32, 40), antialias=True)
    assert torch.equal(hog(frames, resize=(32, 40)), hog(small))


def test_resize_to_the_size_it_has_changes_nothing() -> None:
    frames = torch.rand(2, 1, 32, 40)
    assert torch.equal(hog(frames, resize=(32, 40)), hog(frames))


def test_frames_of_any_size_give_features_of_one_length() -> None:
    module = HOG(resize=(32, 32))
    assert {module(torch.rand(1, 1, *size)).shape[1] for size in SIZES} == {324}


@pytest.mark.parametrize("channels", [1, 3])
def test_a_batch_is_its_frames_one_by_one(channels: int) -> None:
    frames = torch.rand(6, channels, 40, 33)
    together = hog(frames)
    apart = torch.cat([hog(frame[None]) for frame in frames])
    torch.testing.assert_close(together, apart, rtol=0, atol=1e-6)
    order = torch.randperm(6)
    torch.testing.assert_close(hog(frames[order]), together[order], rtol=0, atol=1e-6)


def test_module_equals_function() -> None:
    frames = torch.rand(2, 3, 40, 40)
    module = HOG(orientations=6, cell=4, block=3, resize=(24, 28))
    assert torch.equal(module(frames), hog(frames, orientations=6, cell=4, block=3, resize=(24, 28)))


def test_state_dict_round_trip() -> None:
    module, other = HOG(), HOG()
    other.load_state_dict(module.state_dict())
    frames = torch.rand(1, 1, 32, 32)
    assert torch.equal(module(frames), other(frames))


def test_double_follows_the_input() -> None:
    assert HOG().double()(torch.rand(1, 1, 32, 32, dtype=torch.float64)).dtype == torch.float64


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (torch.rand(1, 32, 32), r"\(1, 32, 32\) torch\.float32; expected float frames \(B,C,H,W\)"),
        (torch.zeros(1, 1, 32, 32, dtype=torch.uint8), r"torch\.uint8; expected float frames"),
        (torch.rand(1, 1, 15, 40), r"15 x 40 pixels; expected at least one block, 16 x 16"),
        (torch.rand(1, 1, 40, 15), r"40 x 15 pixels; expected at least one block, 16 x 16"),
    ],
)
def test_frames_that_do_not_fit_are_refused(frames: Tensor, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        hog(frames)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"orientations": 0}, r"orientations=0.*expected at least 1"),
        ({"cell": 0}, r"cell=0.*expected at least 1"),
        ({"block": -1}, r"block=-1.*expected at least 1"),
        ({"resize": (32, 8)}, r"resize=\(32, 8\); expected .* at least 16"),
        ({"resize": (32,)}, r"resize=\(32,\); expected \(height, width\)"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        HOG(**arguments)
