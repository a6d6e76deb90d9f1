"""Velocity from the ground: drives over a known ground are the oracle, seen by a camera of our own."""

from __future__ import annotations

import logging
import math
from functools import cache

import pytest
import torch
from footage import shift_between
from helpers import all_of, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.transform import get_perspective_transform
from torch.nn.functional import avg_pool2d, conv2d, grid_sample

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.motion.ground_plane import TRAPEZIUM, ground_patch
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse

PATCH, AHEAD = 96, 200  # pixels of ground: the patch, and where the drive begins
SLEEPER = 24


@cache
def ground(texture, sleepers, length=2400, width=160):
    """Ground around zero, (1,1,length,width): texture that never repeats, stripes that always do."""
    noise = torch.randn(1, 1, length + 2, width + 2, generator=torch.Generator().manual_seed(3))
    stripes = ((torch.arange(length) % SLEEPER) < 8).float().view(1, 1, -1, 1) - 1 / 3
    return texture * conv2d(noise, torch.full((1, 1, 3, 3), 1 / 3)) + sleepers * stripes


def drive(position, texture=0.12, sleepers=0.1, blur=0.0, noise=0.03, exposure=True):
    """Frames (N,1,240,320) of a camera at each position, pixels of ground; sky above.

    Args:
        blur: share of the time from frame to frame during which the shutter is open.
    """
    height, width, over = 240, 320, 2
    world = ground(texture, sleepers)
    x = (torch.arange(width * over) - (over - 1) / 2) / over
    y = ((torch.arange(height * over) - (over - 1) / 2) / over)[:, None]
    seen = torch.tensor(TRAPEZIUM) * torch.tensor([width - 1, height - 1])
    last = PATCH - 1.0
    above = torch.tensor([[0.0, 0.0], [last, 0.0], [last, last], [0.0, last]])
    view = get_perspective_transform(seen[None], above[None])[0]
    point = torch.stack(torch.broadcast_tensors(x, y, torch.ones(())))[:, 144 * over :].flatten(1)
    right, row, depth = view @ point
    right, row = right / depth, row / depth
    speed = position.diff(prepend=2 * position[:1] - position[1:2])
    generator = torch.Generator().manual_seed(5)
    frames = torch.full((len(position), 1, height, width), 0.8)
    path = world.cumsum(2)  # its differences are the ground, smeared along the way

    def seen_at(position, world):
        rows = (AHEAD + position - row) / (world.shape[2] - 1)
        columns = (right + (world.shape[3] - PATCH) / 2) / (world.shape[3] - 1)
        grid = torch.stack([2 * columns - 1, 2 * rows - 1], -1).view(1, -1, width * over, 2)
        return grid_sample(world, grid, align_corners=True)

    for frame, here, smear in zip(frames, position.tolist(), (blur * speed).abs().tolist(), strict=True):
        if smear > 1:
            now = (seen_at(here, path) - seen_at(here - smear, path)) / smear
        else:
            now = seen_at(here, world)
        frame[:, 144:] = avg_pool2d(now + 0.45, over)[0]
    gain = 0.7 + 0.6 * torch.rand(len(frames), 1, 1, 1, generator=generator) if exposure else 1.0
    return (frames * gain + noise * torch.randn(frames.shape, generator=generator)).clamp(0, 1)


def travelled(*speeds):
    """Positions of a drive whose speed goes from one value to another in so many steps, each."""
    steps = torch.cat([torch.linspace(a, b, n, dtype=torch.float64) for a, b, n in speeds])
    return torch.cat([torch.zeros(1, dtype=torch.float64), steps.cumsum(0)])


JOURNEY = travelled(
    (2, 12, 12),
    (12, 6, 6),
    (0, 0, 6),
    (1, 16, 12),
    (16, 2, 8),
    (0, 0, 4),
    (-2, -9, 8),
    (-9, -2, 4),
    (3, 14, 20),
)


def shown(frames, place=None):
    """Frames with known places."""
    traverse = ArrayTraverse(frames, "the drive")
    traverse.places = place
    return traverse


@cache
def journey():
    return shown(drive(JOURNEY), JOURNEY)


@cache
def measured():
    return GroundOdometry().distances(journey(), 100)


def distance(frames, **settings):
    return GroundOdometry(**settings).distances(shown(frames)).distance


@cache
def short():
    """Twelve frames at 5 pixels of ground a frame."""
    position = travelled((5, 5, 11))
    return shown(drive(position), position)


# --- the patch


def test_a_region_of_ground_becomes_even():
    """Of a frame that shows how far ahead each pixel of ground is, the patch is a straight ramp."""
    fractions = torch.tensor([[x * 319, y * 239] for x, y in TRAPEZIUM])
    unit = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    view = get_perspective_transform(fractions[None], unit[None])[0]
    y, x = torch.meshgrid(torch.arange(240.0), torch.arange(320.0), indexing="ij")
    right, row, depth = torch.einsum("ij,jhw->ihw", view, torch.stack([x, y, torch.ones_like(x)]))
    for ramp, axis in ((row / depth, 0), (right / depth, 1)):
        patch = ground_patch(ramp.clamp(-1, 2)[None, None], size=(64, 48))[0, 0]
        even = torch.linspace(0, 1, patch.shape[axis]).unsqueeze(1 - axis).expand(64, 48)
        torch.testing.assert_close(patch[1:-1, 1:-1], even[1:-1, 1:-1], rtol=0, atol=0.003)


# --- the shift between two patches


@settings(max_examples=15)
@given(
    shift=st.floats(-38, 38),
    sway=st.integers(-3, 3),
    gain=st.floats(0.7, 1.3),
    offset=st.floats(-0.2, 0.2),
    seed=st.integers(0, 99),
)
def test_a_known_shift(shift, sway, gain, offset, seed):
    """Ground moved by a whole number of tenths of a pixel, with noise."""
    fine = torch.randn(1, 1, 1900, 102, generator=torch.Generator().manual_seed(seed))
    fine = conv2d(fine, torch.hann_window(31, periodic=False).view(1, 1, -1, 1)) / 31**0.5
    tenths = round(10 * shift)
    first, second = (fine[:, :, start : start + 960 : 10] for start in (450, 450 - tenths))
    first, second = first[..., 3:99], second[..., 3 + sway : 99 + sway]
    noisy = (patch + 0.1 * patch.std() * torch.randn_like(patch) for patch in (first, gain * second + offset))
    found, confidence = shift_between(*noisy)
    assert found.item() == pytest.approx(tenths / 10, abs=0.1)
    assert confidence.item() > 0.6


def test_confidence_tells_the_same_ground_from_another():
    patches = ground_patch(journey().values, size=(96, 96))
    _, same = shift_between(patches[:-1], patches[1:])
    unrelated = torch.rand(40, 2, 1, 96, 96)
    _, other = shift_between(unrelated[:, 0], unrelated[:, 1])
    assert same.min() > 0.6
    assert other.max() < 0.4
    for flat in (torch.zeros(1, 1, 96, 96), torch.full((1, 1, 96, 96), 0.7)):
        for pair in ((patches[:1], flat), (flat, patches[:1]), (flat, 0.5 * flat)):
            assert shift_between(*pair)[1].item() < 0.01


def test_of_equal_peaks_the_steady_ones():
    """Sleepers with texture below the noise look the same a whole period further on."""
    position = travelled((0, 16, 16), (16, 16, 20))
    frames = drive(position, texture=0.02, sleepers=0.3)
    patches = ground_patch(frames)
    alone, _ = shift_between(patches[:-1], patches[1:])
    followed, _ = GroundOdometry()(frames)
    wrong = (alone - position.diff()).abs()
    assert (wrong > 1).sum() >= 5
    whole = wrong[wrong > 1] / SLEEPER  # periods
    torch.testing.assert_close(whole, whole.round(), rtol=0, atol=0.02)
    torch.testing.assert_close(followed.double(), position.diff(), rtol=0, atol=0.3)


# --- a drive


def path_error(distance, position):
    """Error of the length of the path, as a share of it."""
    true = position.diff().abs().sum()
    return float((distance.diff().abs().sum() - true).abs() / true)


def test_a_drive_with_stops_and_a_reversal():
    distance = measured().distance
    assert distance.dtype == torch.float64
    assert path_error(distance, JOURNEY) < 0.01
    assert (distance - JOURNEY).abs().max() < 0.01 * JOURNEY.diff().abs().sum()
    stands = JOURNEY.diff() == 0
    assert (distance.diff()[stands] == 0).all()
    assert measured().confidence.min() > 0.6


@pytest.mark.parametrize("sleepers", [0.0, 0.1])
def test_motion_blur(sleepers):
    """The shutter stays open all the time: each frame is smeared by as much as the ground moves."""
    position = travelled((20, 20, 30))
    frames = drive(position, texture=0.05, sleepers=sleepers, blur=1.0)
    assert path_error(distance(frames), position) < 0.02


@settings(max_examples=3)
@given(size=st.integers(1, 90))
def test_batches_do_not_matter(size):
    parts = GroundOdometry().distances(journey(), size)
    torch.testing.assert_close(parts.distance, measured().distance, rtol=0, atol=1e-3)
    torch.testing.assert_close(parts.confidence, measured().confidence, rtol=0, atol=1e-4)


def test_a_drop_out_gets_its_neighbours_velocity(caplog):
    position = travelled((4, 12, 20))
    frames = drive(position)
    frames[9], frames[15] = 0, math.nan  # two steps each see nothing
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        measured = GroundOdometry().distances(shown(frames))
    (message,) = caplog.messages
    assert "the drive: no common ground in frames 8 to 10, 14 to 16 (4 of 20 steps)" in message
    assert (measured.confidence < 0.4).nonzero()[:, 0].tolist() == [8, 9, 14, 15]
    assert path_error(measured.distance, position) < 0.01


SIDEWAYS = ((0.1, 0.9), (0.1, 0.2), (0.9, 0.2), (0.9, 0.9))  # its rows run along the frame


@pytest.mark.parametrize(
    ("shape", "settings", "told"),
    [
        (
            (64, 128),
            {},
            "96 rows, its region only 16 in frames of 64 x 128 pixels, which underestimates slow motion",
        ),
        ((120, 160), {"size": (96, 48)}, "use size (61, 48)"),
        ((60, 80), {}, "use larger frames or regions"),
        ((240, 51), {"corners": SIDEWAYS}, "its region only 40 in frames of 240 x 51"),
        ((120, 160), {"size": (61, 96)}, ""),
        ((240, 320), {}, ""),
    ],
)
def test_a_patch_finer_than_the_frames_is_told(shape, settings, told, caplog):
    frames = torch.rand(1, 1, *shape).expand(4, -1, -1, -1)
    distance(frames, **settings)
    assert len(caplog.messages) == bool(told)
    assert told in caplog.text


def test_a_drive_by_optical_flow():
    pytest.importorskip("cv2")
    measured = GroundOdometry(flow="lk").distances(journey())
    assert path_error(measured.distance, JOURNEY) < 0.002
    assert measured.confidence.min() > 0.6
    assert (measured.distance.diff()[JOURNEY.diff() == 0] == 0).all()
    position = travelled((20, 20, 12))
    smeared = drive(position, texture=0.05, blur=1.0)
    assert path_error(distance(smeared, flow="lk"), position) < 0.01


# --- even spacing


def test_places_are_evenly_spaced():
    """What is shown lies within half a frame's motion of even steps along the true way."""
    even = ResampledTraverse(journey(), GroundOdometry(step=8.0))
    true = JOURNEY[even.frame]
    furthest = JOURNEY.max()
    assert len(even) == len(even.frame) == len(all_of(even))
    assert even.positions.dtype == torch.float32
    assert len(even.positions) == len(JOURNEY)
    assert abs(len(even) - (int(furthest / 8) + 1)) <= 1
    assert (true - 8 * torch.arange(len(even))).abs().max() < 16 / 2 + 0.01 * furthest
    assert (even.frame.diff() >= 0).all()
    assert torch.equal(even.places, true)
    assert torch.equal(all_of(even), journey().values[even.frame])


def test_the_median_step_of_moving_frames_is_the_default():
    position = travelled((5, 5, 11), (0, 0, 30))
    even = ResampledTraverse(shown(drive(position)), GroundOdometry())
    assert abs(len(even) - 12) <= 1
    assert even.step == pytest.approx(5, abs=0.05)
    assert even.places is None


def test_a_camera_that_looks_back():
    even = ResampledTraverse(shown(short().values.flip(0)), GroundOdometry(step=5.0))
    assert abs(len(even) - 12) <= 1
    assert even.frame[0] == 0


# --- what is refused


def corners(*last):
    """With another near left corner."""
    return GroundOdometry((*TRAPEZIUM[:3], *last))


BOW_TIE = ((0.2, 0.5), (0.8, 0.9), (0.8, 0.5), (0.2, 0.9))


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: corners(), ("3 corners", "four")),
        (lambda: corners((0.1, "far")), ("4 corners", "far", "(x, y)")),
        (lambda: corners((0.1, 0.2, 0.3)), ("4 corners", "(x, y)")),
        (lambda: corners((-0.05, 0.98)), ("(-0.05, 0.98)", "outside the frame", "0 to 1")),
        (lambda: corners((math.nan, 0.98)), ("nan", "outside the frame")),
        (lambda: corners((0.9, 0.8)), ("not convex", "far left, far right, near right, near left")),
        (lambda: GroundOdometry(TRAPEZIUM[::-1]), ("not convex",)),
        (lambda: GroundOdometry(BOW_TIE), ("not convex",)),
        (lambda: GroundOdometry(size=(31, 96)), ("(31, 96)", "32 to 1024")),
        (lambda: GroundOdometry(size=(96, 1025)), ("(96, 1025)", "32 to 1024")),  # it would never end
        (lambda: GroundOdometry(step=0.0), ("step is 0.0", "above 0")),
        (lambda: GroundOdometry(step=math.inf), ("step is inf",)),
        (lambda: GroundOdometry(least=1.5), ("least is 1.5", "0 to 1")),
        (lambda: GroundOdometry(still=-0.1), ("still is -0.1", "at least 0")),
        (lambda: ground_patch(torch.rand(2, 1, 9, 9), size=(10**6, 10**6)), ("2 x 1000000 x", "GB free")),
        (lambda: ground_patch(torch.rand(1, 1, 1, 80)), ("1 x 80 pixels", "at least 2 x 2")),
        (lambda: GroundOdometry()(short().values[:1]), ("the input has 1 frame;", "at least 2")),
        (lambda: distance(short().values[:1]), ("the drive has 1 frame;", "at least 2")),
        (lambda: distance(torch.zeros(5, 1, 60, 80)), ("none of 4 steps", "expected corners on the ground")),
        (lambda: distance(torch.rand(5, 7)), ("features", "(5, 7)", "expected (B,C,H,W)")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


# --- real footage


def test_a_car_on_a_motorway(data_dir):
    """Nearly constant speed over the nine seconds, every step believed."""
    car = open_source(f"{data_dir}/highway/solidWhiteRight.mp4?width=320")
    measured = GroundOdometry().distances(car)
    speed = measured.distance.diff()
    assert (measured.confidence > 0.6).all()
    assert speed.std() < 0.1 * speed.mean()
    over_a_second = speed.unfold(0, 25, 1).mean(1)
    assert over_a_second.max() < 1.1 * over_a_second.min()
