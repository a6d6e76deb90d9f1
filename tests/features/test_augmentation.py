"""Each strength changes what it says and no more; a clip is one day."""

from __future__ import annotations

import copy
import json
from inspect import signature
from typing import Any

import pytest
import torch
from helpers import refused
from kornia.geometry.transform import get_affine_matrix2d, warp_affine
from torch import Tensor

from dejavu_torch.features.augmentation import LARGEST, Augmentation

OFF: dict[str, Any] = {name: 0.0 if len(most) == 1 else (0.0, 0.0) for name, most in LARGEST.items()}
DEFAULTS = {name: argument.default for name, argument in signature(Augmentation).parameters.items()}
DEFAULTS["perspective"] = 10.0  # which is off unless it is asked for
EACH = pytest.mark.parametrize("name", DEFAULTS)


def only(**strengths: Any) -> Augmentation:
    return Augmentation(**{**OFF, **strengths})


def flat(value: float, clips: int = 200, side: int = 12, channels: int = 1) -> Tensor:
    return torch.full((clips, channels, side, side), value)


def changed(before: Tensor, after: Tensor) -> Tensor:
    """Which entries of the batch changed by more than rounding."""
    return ((before - after).abs() > 1e-4).flatten(1).any(1)


def dots(clips: int = 200, height: int = 40, width: int = 60) -> Tensor:
    frames = torch.zeros(clips, 1, height, width)
    frames[:, :, height // 2, width // 2] = 1
    return frames


def centre_of(frames: Tensor) -> tuple[Tensor, Tensor]:
    """(x, y) of the light of each frame, pixels."""
    light = frames[:, 0] / frames[:, 0].sum((1, 2), keepdim=True)
    height, width = light.shape[1:]
    return light.sum(1) @ torch.arange(width).float(), light.sum(2) @ torch.arange(height).float()


def test_eval_gives_the_input_itself_and_training_leaves_it_alone() -> None:
    frames = torch.rand(2, 3, 9, 11, requires_grad=True)
    before = frames.detach().clone()
    assert Augmentation().eval()(frames) is frames
    assert not Augmentation()(frames).requires_grad
    off = only()(frames)
    assert torch.equal(off, frames)
    off.zero_()
    assert torch.equal(frames, before)


@EACH
def test_each_alone_acts_on_some_or_all_clips(name: str) -> None:
    frames = torch.rand(300, 1, 16, 16) * 0.5 + 0.25
    share = changed(frames, only(**{name: DEFAULTS[name]})(frames)).float().mean().item()
    half, most = ("illumination", "blur"), ("rotation", "shift", "scale", "perspective")
    often = ("gamma", "occlusion", "noise")
    chance = 0.5 if name in half else 0.9 if name in most else 0.7 if name in often else 1.0
    assert share == pytest.approx(chance, abs=0.1)


def test_a_clip_of_equal_frames_stays_one_but_for_noise() -> None:
    for name in DEFAULTS:
        clips = torch.rand(8, 1, 3, 16, 16).expand(8, 4, 3, 16, 16)
        after = only(**{name: DEFAULTS[name]})(clips)
        assert torch.allclose(after, after[:, :1].expand_as(after), atol=1e-6) == (name != "noise")


def test_noise_is_of_the_frame_and_whether_there_is_any_is_of_the_clip() -> None:
    clips = torch.full((100, 6, 1, 16, 16), 0.5)
    spread = (only(noise=0.03)(clips) - clips).flatten(2).std(2)
    noisy = spread[:, 0] > 0
    assert 50 < noisy.sum() < 90
    assert (spread[~noisy] == 0).all()
    assert spread[noisy].sub(0.03).abs().max() < 0.01
    assert spread.std(1)[noisy].min() > 0


def test_range_and_type_at_the_largest_strengths() -> None:
    wild = Augmentation(**{name: most if len(most) > 1 else most[0] for name, most in LARGEST.items()})
    frames = torch.rand(40, 3, 24, 28)
    after = wild(frames)
    assert after.dtype == torch.float32
    assert after.isfinite().all()
    assert 0 <= after.min() < after.max() <= 1


def test_the_seed_repeats_it() -> None:
    for shape in ((6, 3, 16, 20), (2, 3, 3, 16, 20)):
        frames, augmentation = torch.rand(shape), Augmentation()
        torch.manual_seed(3)
        first, second = augmentation(frames), augmentation(frames)
        torch.manual_seed(3)
        channels_last = frames.transpose(-1, -3).contiguous().transpose(-1, -3)
        assert torch.allclose(Augmentation()(channels_last), first, atol=1e-5)
        assert not torch.allclose(second, first, atol=1e-2)
        assert first.shape == shape


@pytest.mark.parametrize("occlusion", [0.0, 0.3])
def test_entries_see_none_but_what_covers_them(occlusion: float) -> None:
    frames, other = torch.rand(8, 3, 16, 16).expand(2, 8, 3, 16, 16).clone()
    other[3] = torch.rand(3, 16, 16)
    seen = set()
    for seed in range(8):
        torch.manual_seed(seed)
        first = Augmentation(occlusion=occlusion)(frames)
        torch.manual_seed(seed)
        second = Augmentation(occlusion=occlusion)(other)
        seen |= set(changed(first, second).nonzero().flatten().tolist())
    assert seen == ({3, 4} if occlusion else {3})


def test_colour_is_of_the_channel() -> None:
    after = only(colour=(0.2, 0.0))(flat(0.5, channels=3))
    assert (after.amax((2, 3)) == after.amin((2, 3))).all()
    level = after[:, :, 0, 0] / 0.5
    assert 0.8 <= level.min() < 0.82 < 1.18 < level.max() <= 1.2
    assert level.std(1).min() > 0
    offset = only(colour=(0.0, 0.05))(flat(0.5, channels=3))[:, :, 0, 0] - 0.5
    assert -0.0501 <= offset.min() < -0.04 < 0.04 < offset.max() <= 0.0501


def test_exposure_is_of_all_channels() -> None:
    torch.manual_seed(1)
    low = only(exposure=(0.4, 0.0))(flat(0.1, channels=3))
    torch.manual_seed(1)
    high = only(exposure=(0.4, 0.0))(flat(0.4, channels=3))
    gain = low.mean((1, 2, 3)) / 0.1
    assert 0.6 <= gain.min() < 0.65 < 1.35 < gain.max() <= 1.401
    assert torch.allclose(high, 4 * low)
    assert torch.equal(low[:, 0], low[:, 2])
    offset = only(exposure=(0.0, 0.3))(flat(0.5))[:, 0, 0, 0] - 0.5
    assert -0.301 <= offset.min() < -0.25 < 0.25 < offset.max() <= 0.301


def test_gamma_is_a_power() -> None:
    after = only(gamma=0.5)(flat(0.25))[:, 0, 0, 0]
    power = after.log() / torch.tensor(0.25).log()
    assert 0.66 <= power.min() < 0.75 < 1.4 < power.max() <= 1.501
    ends = torch.tensor([0.0, 1.0]).expand(50, 1, 2, 2)
    assert torch.allclose(only(gamma=0.5)(ends), ends)


def test_illumination_falls_evenly_from_one_side() -> None:
    change = only(illumination=0.25)(flat(0.5))[:, 0] - 0.5
    change = change[changed(torch.zeros_like(change), change)]
    assert 0.15 < change.abs().amax((1, 2)).max() <= 0.251
    assert change.abs().amin((1, 2)).max() < 1e-6
    for axis in (1, 2):
        assert change.diff(n=2, dim=axis).abs().max() < 1e-6


def test_blur_takes_variance_keeps_the_mean_and_reaches_as_far_as_sigma() -> None:
    frames = torch.rand(60, 1, 32, 32)
    blurred = only(blur=3.0)(frames)
    assert (blurred.var((1, 2, 3)) < 1.001 * frames.var((1, 2, 3))).all()  # a tiny sigma leaves it as it is
    assert blurred.var((1, 2, 3)).min() < 0.2 * frames.var((1, 2, 3)).min()
    assert (blurred - frames).mean((1, 2, 3)).abs().max() < 0.02
    for sigma, reach in ((0.3, 1), (1.2, 1), (2.0, 2), (2.6, 3)):
        row = only(blur=sigma)(dots(clips=60))[:, 0, 20].amax(0)
        lit = (row > 0).nonzero().flatten() - 30
        assert lit.abs().max() == reach


def test_shift_moves_by_at_most_its_fractions() -> None:
    for pair, x_most, y_most in (((0.1, 0.0), 6.0, 0.0), ((0.0, 0.05), 0.0, 2.0), ((0.1, 0.05), 6.0, 2.0)):
        x, y = centre_of(only(shift=pair)(dots()))
        for moved, most in (((x - 30).abs().max().item(), x_most), ((y - 20).abs().max().item(), y_most)):
            assert 0.9 * most <= moved <= most + 1e-3


def test_rotation_turns_and_scale_stretches_by_at_most_theirs() -> None:
    frames = torch.zeros(200, 1, 61, 61)
    frames[:, :, 30, 50] = 1  # 20 pixels right of the centre
    x, y = centre_of(only(rotation=10.0)(frames))
    assert 9 < torch.atan2(y - 30, x - 30).rad2deg().abs().max() < 10.3
    assert torch.hypot(y - 30, x - 30).sub(20).abs().max() < 0.3
    x, y = centre_of(only(scale=0.2)(frames))
    factor = (x - 30) / 20
    assert 0.78 < factor.min() < 0.83 < 1.17 < factor.max() < 1.22
    assert (y - 30).abs().max() < 1e-3


@pytest.mark.parametrize("most", [0.01, 0.15, 0.6])
def test_occlusion_covers_one_rectangle_of_at_most_its_fraction(most: float) -> None:
    side, levels = 60, torch.arange(1.0, 201.0) / 201
    frames = levels[:, None, None, None].expand(-1, 2, side, side).contiguous()
    after = only(occlusion=most)(frames)
    other = after != frames
    assert torch.equal(
        after[other], frames.roll(1, 0)[other]
    )  # of the clip before, the last ahead of the first
    assert torch.equal(other[:, 0], other[:, 1])
    height, width = other[:, 0].any(2).sum(1), other[:, 0].any(1).sum(1)
    covered = other[:, 0].sum((1, 2))
    assert torch.equal(covered, height * width)
    assert ((height - 0.5).clamp(min=0) * (width - 0.5).clamp(min=0)).max() <= most * side**2
    assert covered.max() > 0.6 * most * side**2
    sides = height[covered > 100] / width[covered > 100]
    assert ((sides > 0.28) & (sides < 3.5)).all()
    middle = other[covered > 0, 0].float().mean(0)
    if most > 0.1:
        assert middle[5:-5, 5:-5].min() > 0  # anywhere


def test_a_clip_alone_is_covered_with_black() -> None:
    after = torch.cat([only(occlusion=0.5)(torch.full((1, 3, 1, 20, 20), 0.5)) for _ in range(20)])
    assert set(after.unique().tolist()) == {0.0, 0.5}


def test_it_is_plain_numbers_with_nothing_to_save() -> None:
    strengths = json.loads(json.dumps(DEFAULTS))
    frames, augmentation = torch.rand(3, 3, 16, 16), Augmentation(**strengths)
    augmentation(frames)
    assert not augmentation.state_dict()
    assert copy.deepcopy(augmentation)(frames).shape == frames.shape
    assert "shift=(0.02, 0.04), scale=0.05" in repr(augmentation)


def test_a_wrong_strength_is_refused() -> None:
    for name in DEFAULTS:
        for wrong in (-0.01, float("nan"), 181.0, "much"):
            pair = isinstance(DEFAULTS[name], tuple)
            with refused(f"{name} is", "expected a number from 0 to"):
                only(**{name: (wrong, 0.0) if pair else wrong})
            with refused(f"{name} is"):
                only(**{name: 0.1 if pair else (0.1, 0.1)})


def test_wrong_frames_are_refused() -> None:
    with refused("(3, 16, 16) torch.float32", "(B,C,H,W)", "(B,T,C,H,W)"):
        Augmentation()(torch.rand(3, 16, 16))
    with refused("torch.float64", "float32 (B,C,H,W)"):
        Augmentation()(torch.rand(2, 3, 16, 16, dtype=torch.float64))
    with refused("(2, 3, 4, 16)", "more than 4 pixels"):
        only(blur=4.0)(torch.rand(2, 3, 4, 16))
    with refused("(0, 3, 16, 16)", "expected some"):
        Augmentation()(torch.rand(0, 3, 16, 16))


def test_a_slant_of_nothing_is_none() -> None:
    frames, moves = torch.rand(5, 3, 20, 30), {"rotation": 25.0, "scale": 0.3, "shift": (0.3, 0.2)}
    found = []
    for slant in (0.0, 1e-4):
        torch.manual_seed(0)
        found.append(only(**moves, perspective=slant)(frames))
    torch.testing.assert_close(*found, rtol=0, atol=1e-4)


def test_warps_are_those_of_kornia(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawn to their largest: kornia turns, enlarges and moves the frame by as much."""
    frames = torch.rand(2, 3, 20, 30)
    moves = {"rotation": 25.0, "scale": 0.3, "shift": (0.3, 0.2)}
    monkeypatch.setattr(torch, "rand", lambda *shape, device=None: torch.full(shape, 1 - 1e-6))
    monkeypatch.setattr("dejavu_torch.features.augmentation.WARPED", 1.0)
    centre, pixels = torch.tensor([[29 / 2, 19 / 2]]), torch.tensor([[0.3 * 30, 0.2 * 20]])
    matrix = get_affine_matrix2d(pixels, centre, torch.tensor([[1.3, 1.3]]), torch.tensor([-25.0]))[:, :2]
    settings: dict[str, Any] = {"padding_mode": "border", "align_corners": True}
    expected = warp_affine(frames, matrix.expand(2, 2, 3), (20, 30), **settings)
    torch.testing.assert_close(only(**moves)(frames), expected, rtol=0, atol=1e-4)


def test_perspective_keeps_the_middle_and_makes_one_side_larger() -> None:
    frames = torch.zeros(200, 1, 61, 61)
    frames[:, :, 30, 30] = 1
    x, y = centre_of(only(perspective=20.0)(frames))
    assert max((x - 30).abs().max(), (y - 30).abs().max()) < 0.1
    frames = torch.zeros(200, 1, 61, 61)
    frames[:, :, 20:41, 15] = frames[:, :, 20:41, 45] = 1
    after = only(perspective=20.0)(frames)[:, 0]
    ratio = (after[..., :30].sum((1, 2)) / after[..., 31:].sum((1, 2))).log()
    assert 0.15 < ratio.max() < 0.6
    assert -0.6 < ratio.min() < -0.15
