"""Each strength changes what it says and no more; a clip is one day."""

from __future__ import annotations

import copy
import json
from inspect import signature

import pytest
import torch
from helpers import refused
from kornia.geometry.transform import get_affine_matrix2d, warp_affine

from dejavu_torch.features.augmentation import LARGEST, Augmentation

OFF = {name: 0.0 if len(most) == 1 else (0.0, 0.0) for name, most in LARGEST.items()}
DEFAULTS = {name: argument.default for name, argument in signature(Augmentation).parameters.items()}
DEFAULTS["perspective"] = 10.0  # which is off unless it is asked for
CHANCES = {
    **dict.fromkeys(("rotation", "shift", "scale", "perspective"), 0.9),
    **dict.fromkeys(("gamma", "occlusion", "noise"), 0.7),
    **dict.fromkeys(("illumination", "blur"), 0.5),
}


def only(**strengths):
    return Augmentation(**{**OFF, **strengths})


def flat(value, channels=1):
    return torch.full((200, channels, 12, 12), value)


def changed(before, after):
    """Which entries of the batch changed by more than rounding."""
    return ((before - after).abs() > 1e-4).flatten(1).any(1)


def assert_spread(values, most, middle=0.0):
    """Drawn evenly from middle - most to middle + most."""
    assert -1.005 * most <= values.min() - middle < -0.85 * most
    assert 0.85 * most < values.max() - middle <= 1.005 * most


def test_eval_gives_the_input_itself_and_training_leaves_it_alone():
    frames = torch.rand(2, 3, 9, 11, requires_grad=True)
    before = frames.detach().clone()
    assert Augmentation().eval()(frames) is frames
    assert not Augmentation()(frames).requires_grad
    off = only()(frames)
    assert torch.equal(off, frames)
    off.zero_()
    assert torch.equal(frames, before)


@pytest.mark.parametrize("name", DEFAULTS)
def test_each_alone_acts_on_some_or_all_clips_and_alike_on_the_frames_of_one(name):
    alone = only(**{name: DEFAULTS[name]})
    frames = torch.rand(300, 1, 16, 16) * 0.5 + 0.25
    share = changed(frames, alone(frames)).float().mean().item()
    assert share == pytest.approx(CHANCES.get(name, 1.0), abs=0.1)
    after = alone(torch.rand(8, 1, 3, 16, 16).expand(8, 4, 3, 16, 16))
    assert torch.allclose(after, after[:, :1].expand_as(after), atol=1e-6) == (name != "noise")


def test_the_seed_repeats_it():
    for shape in ((6, 3, 16, 20), (2, 3, 3, 16, 20)):
        frames, augmentation = torch.rand(shape), Augmentation()
        torch.manual_seed(3)
        first, second = augmentation(frames), augmentation(frames)
        torch.manual_seed(3)
        channels_last = frames.transpose(-1, -3).contiguous().transpose(-1, -3)
        assert torch.allclose(Augmentation()(channels_last), first, atol=1e-5)
        assert not torch.allclose(second, first, atol=1e-2)
        assert first.shape == shape
        assert 0 <= first.min() < first.max() <= 1


def test_colour_is_of_the_channel_and_exposure_of_all():
    for name, gain, offset in (("colour", 0.2, 0.05), ("exposure", 0.4, 0.3)):
        brighter = only(**{name: (gain, 0.0)})(flat(0.5, channels=3))
        assert (brighter.amax((2, 3)) == brighter.amin((2, 3))).all()
        level = brighter[:, :, 0, 0] / 0.5
        assert_spread(level, gain, 1.0)
        assert (level.std(1) > 0).all() == (level.std(1) > 0).any() == (name == "colour")
        assert_spread(only(**{name: (0.0, offset)})(flat(0.5))[:, 0, 0, 0] - 0.5, offset)


def test_gamma_is_a_power():
    after = only(gamma=0.5)(flat(0.25))[:, 0, 0, 0]
    power = after.log() / torch.tensor(0.25).log()
    assert 0.66 <= power.min() < 0.75 < 1.4 < power.max() <= 1.501
    ends = torch.tensor([0.0, 1.0]).expand(50, 1, 2, 2)
    assert torch.allclose(only(gamma=0.5)(ends), ends)


def test_blur_reaches_as_far_as_sigma():
    dots = torch.zeros(60, 1, 15, 15)
    dots[:, :, 7, 7] = 1
    for sigma, reach in ((0.3, 1), (1.2, 1), (2.0, 2), (2.6, 3)):
        row = only(blur=sigma)(dots)[:, 0, 7].amax(0)
        assert ((row > 0).nonzero() - 7).abs().max() == reach


@pytest.mark.parametrize("most", [0.01, 0.15, 0.6])
def test_occlusion_covers_one_rectangle_of_at_most_its_fraction(most):
    side, levels = 60, torch.arange(1.0, 201.0) / 201
    frames = levels[:, None, None, None].expand(-1, 2, side, side).contiguous()
    after = only(occlusion=most)(frames)
    other = after != frames
    assert torch.equal(after[other], frames.roll(1, 0)[other])  # of the clip before
    assert torch.equal(other[:, 0], other[:, 1])
    height, width = other[:, 0].any(2).sum(1), other[:, 0].any(1).sum(1)
    covered = other[:, 0].sum((1, 2))
    assert torch.equal(covered, height * width)
    assert ((height - 0.5).clamp(min=0) * (width - 0.5).clamp(min=0)).max() <= most * side**2
    assert covered.max() > 0.6 * most * side**2
    sides = height[covered > 100] / width[covered > 100]
    assert ((sides > 0.28) & (sides < 3.5)).all()
    if most > 0.1:
        assert other[covered > 0, 0].float().mean(0)[5:-5, 5:-5].min() > 0  # anywhere


@pytest.mark.parametrize("drawn", [1e-6, 1 - 1e-6])
def test_warps_are_those_of_kornia(drawn, monkeypatch):
    """Drawn to either end: kornia turns, scales and moves the frame by as much."""
    frames, sign = torch.rand(2, 3, 20, 30), -1 if drawn < 0.5 else 1
    monkeypatch.setattr(torch, "rand", lambda shape, **_: torch.full(shape, drawn))
    monkeypatch.setattr("dejavu_torch.features.augmentation.WARPED", 1.0)
    centre, pixels = torch.tensor([[29 / 2, 19 / 2]]), sign * torch.tensor([[0.3 * 30, 0.2 * 20]])
    zoom, turn = torch.full((1, 2), 1 + 0.3 * sign), torch.tensor([-25.0 * sign])
    matrix = get_affine_matrix2d(pixels, centre, zoom, turn)[:, :2]
    settings = {"padding_mode": "border", "align_corners": True}
    expected = warp_affine(frames, matrix.expand(2, 2, 3), (20, 30), **settings)
    found = only(rotation=25.0, scale=0.3, shift=(0.3, 0.2))(frames)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


def test_it_is_plain_numbers_with_nothing_to_save():
    frames, augmentation = torch.rand(3, 3, 16, 16), Augmentation(**json.loads(json.dumps(DEFAULTS)))
    augmentation(frames)
    assert not augmentation.state_dict()
    assert copy.deepcopy(augmentation)(frames).shape == frames.shape
    assert "shift=(0.02, 0.04), scale=0.05" in repr(augmentation)


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: only(rotation=-0.01), ("rotation is", "expected a number from 0 to")),
        (lambda: only(scale=float("nan")), ("scale is", "expected a number from 0 to")),
        (lambda: only(shift=("much", 0.0)), ("shift is", "expected a number from 0 to")),
        (lambda: only(perspective=181.0), ("perspective is", "expected a number from 0 to")),
        (lambda: only(colour=0.1), ("colour is",)),
        (lambda: only(noise=(0.1, 0.1)), ("noise is",)),
        (lambda: only()(torch.rand(3, 16, 16)), ("(3, 16, 16) torch.float32", "(B,C,H,W)", "(B,T,C,H,W)")),
        (lambda: only()(torch.rand(2, 3, 16, 16).double()), ("torch.float64", "float32 (B,C,H,W)")),
        (lambda: only(blur=4.0)(torch.rand(2, 3, 4, 16)), ("(2, 3, 4, 16)", "more than 4 pixels")),
        (lambda: only()(torch.rand(2, 0, 16, 16)), ("(2, 0, 16, 16)", "float32 (B,C,H,W)")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()
