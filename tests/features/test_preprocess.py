"""Preprocess: a literal loop in float64 is the oracle of the values, gradcheck that of the gradients."""

from __future__ import annotations

import math

import kornia
import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from kornia.enhance import equalize_clahe

from dejavu_torch import DejaVu, SpectralMapper
from dejavu_torch.data.source import as_traverse
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess, equalise, normalise_patches
from dejavu_torch.features.views import augmented_segments
from dejavu_torch.features.whitening import Whitening

ANY_GRID = tuple(map(int, kornia.__version__.split(".")[:2])) >= (0, 9)  # before, CLAHE has square ones only


def patch_oracle(image, patch):
    """Patch normalisation of one channel (H,W), pixel by pixel, in float64."""
    image = image.astype(np.float64)
    out, reach = np.zeros_like(image), patch // 2
    for y, x in np.ndindex(image.shape):
        near = image[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1]
        out[y, x] = (image[y, x] - near.mean()) / max(near.std(), 1 / 255)
    return out


def uneven(height, width, channels=1):
    """Frames whose brightness and contrast change across them, in [0, 1]."""
    light = torch.linspace(0.1, 0.9, width) * torch.linspace(0.5, 1, height)[:, None]
    return (light + 0.2 * light * torch.randn(2, channels, height, width)).clamp(0, 1)


# --- channel


def test_channels():
    frames = torch.rand(2, 3, 4, 5)
    red, green, blue = (frames[:, k, None] for k in range(3))
    for name, expected in {
        "R": red,
        "g": green,
        "B": blue,
        "R-B": red - blue,
        "b-g": blue - green,
        "Grey": 0.299 * red + 0.587 * green + 0.114 * blue,
    }.items():
        torch.testing.assert_close(Preprocess(channel=name)(frames), expected)
    assert torch.equal(Preprocess("grey")(red), red)


# --- patch normalisation


def test_patches_equal_a_literal_loop():
    for dtype in (torch.float64, torch.float32):
        for height, width, patch in ((9, 9, 9), (12, 17, 3), (20, 13, 7), (11, 30, 11)):
            frames = uneven(height, width, 3).to(dtype)
            ours = normalise_patches(frames, patch)
            assert ours.dtype == dtype
            for frame, expected in zip(ours.flatten(0, 1), frames.flatten(0, 1), strict=True):
                np.testing.assert_allclose(frame, patch_oracle(expected.numpy(), patch), rtol=0, atol=1e-6)


def test_patches_of_little_contrast_in_bright_light():
    """Where the difference of the squares cancels most: a deviation of two grey levels near white."""
    frames = (0.99 + torch.randn(1, 1, 24, 24) * 2 / 255).clamp(max=1)
    np.testing.assert_allclose(
        normalise_patches(frames)[0, 0], patch_oracle(frames[0, 0].numpy(), 9), rtol=0, atol=1e-6
    )


@given(gain=st.floats(0.2, 5), offset=st.floats(-1, 1), seed=st.integers(0, 99))
def test_patches_do_not_see_gain_and_offset(gain, offset, seed):
    frames = torch.rand(1, 2, 12, 14, generator=torch.Generator().manual_seed(seed))  # far above the floor
    torch.testing.assert_close(
        normalise_patches(gain * frames + offset, 5), normalise_patches(frames, 5), rtol=0, atol=1e-5
    )


def test_the_floor_keeps_noise_small():
    noise = torch.randn(1, 1, 32, 32) * 0.01 / 255
    sky = normalise_patches(0.7 + noise)
    assert 0 < sky.abs().max() < 0.05
    flat = normalise_patches(torch.full((1, 1, 16, 16), 0.3))
    torch.testing.assert_close(flat, torch.zeros(1, 1, 16, 16), rtol=0, atol=1e-9)


def test_gradients_of_patches():
    frames = torch.rand(2, 1, 6, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: normalise_patches(x, 3), frames)
    flat = torch.full((1, 1, 6, 5), 0.4, dtype=torch.float64, requires_grad=True)  # below the floor: linear
    assert torch.autograd.gradcheck(lambda x: normalise_patches(x, 3), flat)


# --- CLAHE


def test_clahe_is_kornias():
    frames = uneven(48, 40, 3)
    grid = (4, 2) if ANY_GRID else (4, 4)
    assert torch.equal(equalise(frames, 3.0, grid), equalize_clahe(frames, 3.0, grid))


@given(height=st.integers(1, 40), width=st.integers(1, 40), rows=st.integers(1, 9), columns=st.integers(1, 9))
def test_clahe_of_any_size_and_grid(height, width, rows, columns):
    frames = torch.rand(2, 1, height, width)
    if height <= rows or width <= columns:
        with refused(f"{height} x {width} pixels", f"at least {rows + 1} x {columns + 1}"):
            equalise(frames, grid=(rows, columns))
    elif rows != columns and not ANY_GRID:
        with refused(f"{rows} x {columns} tiles", "kornia 0.9"):
            equalise(frames, grid=(rows, columns))
    else:
        even = equalise(frames, grid=(rows, columns))
        assert even.shape == frames.shape
        assert ((even >= 0) & (even <= 1)).all()


def test_clahe_passes_gradients_straight_through_without_other_values():
    frames = uneven(32, 40)
    weights = torch.randn_like(frames)
    plain = equalise(frames, grid=(4, 4))
    leaf = frames.clone().requires_grad_()
    even = equalise(leaf, grid=(4, 4))
    torch.testing.assert_close(even, plain, rtol=0, atol=1e-6)
    (even * weights).sum().backward()
    torch.testing.assert_close(leaf.grad, weights)


# --- the module


def test_module_equals_functions():
    frames = torch.rand(2, 3, 24, 30)
    module = Preprocess(channel="g", contrast="patch", patch=5)
    assert torch.equal(module(frames), normalise_patches(frames[:, 1:2], 5))
    module = Preprocess(contrast="clahe", clip_limit=3.0, grid=(3, 3))
    assert torch.equal(module(frames), equalise(frames, 3.0, (3, 3)))
    difference = Preprocess("R-B", "clahe", grid=(2, 2))(frames)  # moved into range
    torch.testing.assert_close(difference, equalise((frames[:, :1] - frames[:, 2:] + 1) / 2, grid=(2, 2)))


def test_a_range_of_values_becomes_0_to_1():
    frames = torch.tensor([0.0, 0.2, 0.3, 0.6, 0.9]).view(1, 1, 1, 5)
    expected = torch.tensor([0.0, 0.0, 0.25, 1.0, 1.0]).view(1, 1, 1, 5)
    for given_range in ("0.2,0.6", (0.2, 0.6), f"{0.2 * 65535},{0.6 * 65535}"):
        torch.testing.assert_close(Preprocess(range=given_range)(frames), expected)
    patch = Preprocess(contrast="patch", patch=3, range=(0.2, 0.6))
    wide = torch.rand(1, 1, 5, 7)
    assert torch.equal(patch(wide), normalise_patches(((wide - 0.2) / (0.6 - 0.2)).clamp(0, 1), 3))


def test_frames_of_few_values_are_learned_as_if_they_used_all(caplog):
    frames = torch.rand(60, 1, 24, 24)
    frames[:, :, 0, 0] = torch.rand(60, 1).round()  # some percentiles lie at the ends
    narrow = 0.75 + frames / 64  # exact in float32 but for the last bits

    def learned(values, **settings):
        model = DejaVu(HOG(), Whitening(8), SpectralMapper(), preprocess=Preprocess(**settings))
        return model.learn(values).calibrate(values)

    full, few = learned(frames, range=(0.1, 0.9)), learned(narrow, range=(0.75 + 0.1 / 64, 0.75 + 0.9 / 64))
    own, other = full.localize(frames, sequence=None), few.localize(narrow, sequence=None)
    assert torch.equal(own.index, other.index)
    copies = [
        augmented_segments(as_traverse(values), 60, {}, span=model.preprocess.span)
        for model, values in ((full, frames), (few, narrow))
    ]
    seen = [model.preprocess(next(one.batches(60))) for model, one in zip((full, few), copies, strict=True)]
    torch.testing.assert_close(*seen, rtol=0, atol=1e-4)  # they are changed within the range
    model = learned(narrow, range="auto")
    low, high = model.preprocess.span  # of all but .5 % of the values at either end
    assert 0 < low - 0.75 < 0.01 / 64
    assert 0.99 / 64 < high - 0.75 < 1 / 64
    assert any(f"values from {low:.3g} to {high:.3g} are used" in line for line in caplog.messages)
    again = DejaVu(HOG(), Whitening(8), SpectralMapper(), preprocess=Preprocess(range="auto"))
    with refused("1 frame"):  # and what was measured is forgotten
        again.learn(narrow[:1])
    assert again.preprocess.range == "auto"


def test_covered_frames_are_never_found_and_find_nothing():
    generator = torch.Generator().manual_seed(0)
    frames = torch.rand(80, 3, 24, 24, generator=generator)
    covered = torch.arange(30, 42)
    frames[covered] = 0.02 + 0.5 / 255 * torch.rand(len(covered), 3, 24, 24, generator=generator)
    queries = frames * (1 + 0.05 * torch.rand(frames.shape, generator=generator)) / 1.05
    model = DejaVu(HOG(), Whitening(8), SpectralMapper()).learn(frames).calibrate(frames)
    assert model.map.visit_counts.tolist() == [int(i not in covered) for i in range(80)]
    shown = torch.ones(80, dtype=torch.bool)
    shown[covered] = False
    for threshold in (math.inf, None):
        model.threshold = threshold
        match = model.localize(queries, sequence=None)
        assert not torch.isin(match.index, covered).any()
        assert torch.equal(match.index[shown], torch.arange(80)[shown])
        assert not match.accepted[covered].any()


def test_frames_that_are_all_of_little_contrast_are_none_of_them_covered():
    frames = 0.5 + torch.rand(60, 1, 24, 24) / 1000
    for whitening in (Whitening(8), None):
        model = DejaVu(HOG(), whitening, SpectralMapper()).learn(frames)
        assert model.preprocess.blank == 0
        assert model.map.summary().covered == 60
        assert torch.equal(model.localize(frames, sequence=None).index, torch.arange(60))


def applied(frames, **choice):
    return Preprocess(**choice)(frames)


CHANNELS, WIDE = torch.rand(1, 4, 8, 8), torch.rand(1, 1, 8, 20)


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: Preprocess("gray2"), ("channel 'gray2' is unknown", "'grey', 'R', 'G', 'B'", "'R-B'")),
        (lambda: Preprocess("R-"), ("channel 'R-' is unknown",)),
        (lambda: Preprocess("R-R"), ("channel 'R-R' is unknown",)),
        (lambda: Preprocess(contrast="retinex"), ("contrast='retinex'", "'patch'", "'clahe'")),
        (lambda: Preprocess(patch=1), ("patch=1", "odd", "at least 3")),
        (lambda: Preprocess(patch=8), ("patch=8", "odd", "at least 3")),
        (lambda: Preprocess(grid=(0, 8)), ("grid=(0, 8)", "(rows, columns)")),
        (lambda: Preprocess(clip_limit=math.nan), ("clip_limit=nan", "expected 0 (no limit)")),
        (lambda: Preprocess(range="0.3"), ("range='0.3'", "LOW,HIGH", "auto")),
        (lambda: Preprocess(range=(0.4, 0.4)), ("range=(0.4, 0.4)", "LOW,HIGH")),
        (lambda: Preprocess(range="-1,0.5"), ("range='-1,0.5'", "[0, 1]")),
        (lambda: Preprocess(range="51000,70000"), ("range='51000,70000'", "65535")),
        (lambda: applied(CHANNELS[:, :1], channel="R"), ("'R'", "1 channels", "RGB")),
        (lambda: applied(CHANNELS, channel="G-B"), ("'G-B'", "4 channels", "RGB")),
        (lambda: applied(WIDE, contrast="patch"), ("8 x 20 pixels", "9 x 9")),
        (lambda: applied(WIDE + 1, contrast="clahe", grid=(2, 2)), ("values from 1", "[0, 1]")),
        (lambda: applied(WIDE * math.nan, contrast="clahe", grid=(2, 2)), ("nan", "[0, 1]")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()
