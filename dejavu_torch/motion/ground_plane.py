"""How far the ground in front of a camera moves from frame to frame (section IV-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from dejavu_torch.features.preprocess import select_channel
from dejavu_torch.types import InputError

Corners = Sequence[Sequence[float]]
TRAPEZIUM: Corners = ((0.32, 0.72), (0.68, 0.72), (0.95, 0.98), (0.05, 0.98))
REACH = 0.42  # of the patch: what is left in common beyond says too little
SIDEWAYS = 3  # pixels of sway to either side
PEAKS = 4  # looked at more closely
SURE = 0.4  # unrelated patches agree by 0.15 to 0.25, the same ground by 0.6 and more
BAND = 0.1  # cycles/pixel: the far rows are interpolated, and the finest of what they show stays where it is
FLOOR = (0.25 / 255) ** 2  # variance of a pixel: below it a patch is flat


def check_corners(corners: Corners) -> None:
    """Refuse what is no convex quadrilateral inside the frame, in clockwise order from far left."""
    if len(corners) != 4 or any(len(corner) != 2 for corner in corners):
        raise InputError(
            f"the ground has {len(corners)} corners; "
            "expected four of (x, y): far left, far right, near right, near left"
        )
    if not all(0 <= value <= 1 for corner in corners for value in corner):
        raise InputError(
            f"ground corners {_text(corners)} lie outside the frame; expected fractions of it, 0 to 1"
        )
    points = torch.tensor(corners, dtype=torch.float64)
    (ax, ay), (bx, by) = (points.roll(-1, 0) - points).T, (points.roll(-2, 0) - points.roll(-1, 0)).T
    if not (ax * by - ay * bx > 1e-6).all():
        raise InputError(
            f"ground corners {_text(corners)} are not convex; "
            "expected far left, far right, near right, near left"
        )


def check_size(size: tuple[int, int], least: int) -> None:
    """Refuse a patch too small to see motion in."""
    if len(size) != 2 or min(size) < least:
        raise InputError(
            f"a patch of {tuple(size)} pixels; expected (rows, columns) of at least {least} each"
        )


def length_seen(corners: Corners, height: int, width: int) -> float:
    """From the middle of the far edge to that of the near one, in pixels of a frame: mostly its rows."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    return math.hypot((cx + dx - ax - bx) / 2 * (width - 1), (cy + dy - ay - by) / 2 * (height - 1))


def _text(corners: Corners) -> str:
    return " ".join(f"({x:g}, {y:g})" for x, y in corners)


def ground_patch(frames: Tensor, corners: Corners = TRAPEZIUM, size: tuple[int, int] = (96, 96)) -> Tensor:
    """The ground in front of the camera as seen from above, grey.

    Args:
        frames: RGB or grey.
        corners: (x, y) of a region of ground in fractions of the frame's width and height, (0, 0) its top
            left pixel and (1, 1) its bottom right one: far left, far right, near right, near left. Its
            two sides should be parallel on the ground, such as the two rails: only then is a row of the
            patch everywhere the same length of ground.
        size: (rows, columns) of the patch in pixels.

    Shape: (B,C,H,W) -> (B,1,rows,columns); row 0 is the far end.

    Convention: rows of the frame are smoothed by (1, 2, 1) / 4, since the far rows are sampled coarsely.
        Where the patch has over twice the rows that the region has in the frame, slow motion is
        underestimated: a smaller patch then measures better.

    Raises:
        InputError: not (B,C,H,W) float, neither 1 nor 3 channels, a patch without pixels, or corners that
            are not four, not inside the frame, not convex or in another order.

    Example:
        >>> ground_patch(torch.rand(2, 3, 120, 160), size=(96, 64)).shape
        torch.Size([2, 1, 96, 64])
    """
    check_corners(corners)
    check_size(size, 2)
    height, width = size
    grey = select_channel(frames, "grey")
    if min(grey.shape[-2:]) < 2:
        raise InputError(f"frames of {grey.shape[-2]} x {grey.shape[-1]} pixels; expected at least 2 x 2")
    grey = conv2d(pad(grey, (0, 0, 1, 1), mode="replicate"), grey.new_tensor([1, 2, 1]).view(1, 1, 3, 1) / 4)
    scale = grey.new_tensor([grey.shape[-1] - 1, grey.shape[-2] - 1])
    seen = torch.tensor(corners).to(grey) * scale
    right, bottom = width - 1.0, height - 1.0
    above = grey.new_tensor([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    # the other way round it fails where the frame's first pixel lies on the patch's horizon
    from kornia.geometry.transform import get_perspective_transform, warp_perspective

    matrix = torch.linalg.inv(get_perspective_transform(above[None], seen[None]))
    patch: Tensor = warp_perspective(grey, matrix.expand(len(grey), 3, 3), (height, width))
    return patch


def shift_between(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """How far the ground moved along the rows from one patch to another, each pair by itself.

    Correlation of phases, each frequency weighted by its coherence over the columns: noise, and what motion
    blurs away, weighs little. Coarse to fine: every peak at half the resolution is refined by windows that
    move with the ground, and the one that agrees best wins.

    Args:
        first, second: patches of ground, of any gain and offset of brightness.

    Shape: (B,1,h,w), (B,1,h,w) -> shift (B,) in pixels, rows of the patch; confidence (B,) in [0, 1].

    Convention: shift > 0 is forward: the ground comes nearer, what is in row r of the first is in row
        r + shift of the second. |shift| is at most about 0.42 h, sway at most 3 columns. The confidence is
        the mean coherence of the two, each frequency counted by its coherence: 1 for the same picture, mostly
        0.6 to 1 for the same ground, 0.15 to 0.25 for unrelated ground (patches of 96 x 96), 0 for flat ones
        and those that are not finite.

    Raises:
        InputError: patches that are not two equal (B,1,h,w), or smaller than 32 x 32.

    Example:
        >>> ground = torch.rand(1, 1, 80, 64)
        >>> shift, confidence = shift_between(ground[..., 10:74, :], ground[..., 3:67, :])
        >>> round(shift.item(), 1), confidence.item() > 0.9
        (7.0, True)
    """
    shifts, sure = shift_peaks(first, second)
    best = sure.argmax(1, keepdim=True)
    return shifts.gather(1, best)[:, 0], sure.gather(1, best)[:, 0]


def steady(shifts: Tensor, sure: Tensor, height: int) -> Tensor:
    """Which peak of each pair, where the pairs follow one another in time.

    Sleepers look the same a whole period further on. Of all paths through the peaks that of the highest sum
    of confidences is taken, less the changes of the shift in patch heights. Texture then tells: a little in
    each pair adds up. Where it is far below the noise the path may still be off by whole periods.

    Args:
        shifts: pixels. sure: confidences. height: rows of the patch, pixels.

    Shape: (n,K), (n,K) -> (n,) int64, on the CPU.

    Example:
        >>> steady(torch.tensor([[9.0, 33.0]] * 3), torch.tensor([[0.9, 0.8], [0.8, 0.85], [0.9, 0.8]]), 96)
        tensor([0, 0, 0])
    """
    shifts, sure = shifts.double().cpu(), sure.double().cpu()
    change = (shifts[1:, :, None] - shifts[:-1, None]).abs() / height
    best, came = sure[:1].sum(0), []
    for cost, gain in zip(change, sure[1:], strict=True):
        total, origin = (best - cost).max(1)
        best = total + gain
        came.append(origin)
    path = [best.argmax()]
    for origin in reversed(came):
        path.append(origin[path[-1]])
    return torch.stack(path[::-1])


def shift_peaks(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """The shifts that may be, as `shift_between`.

    Shape: (B,1,h,w), (B,1,h,w) -> shift (B,K) in pixels, confidence (B,K) in [0, 1].
    """
    if first.shape != second.shape or first.ndim != 4 or first.shape[1] != 1:
        raise InputError(
            f"patches {tuple(first.shape)} and {tuple(second.shape)}; expected two of the same (B,1,h,w)"
        )
    count, _, height, width = first.shape
    check_size((height, width), 32)
    if not count:
        return first.new_zeros(0, PEAKS), first.new_zeros(0, PEAKS)
    # coarse: every whole lag at half the resolution
    reach = int(REACH * (height // 2))
    lags = torch.arange(-reach, reach + 1.0).to(first)
    one, other = (avg_pool2d(patch, 2)[:, 0] for patch in (first, second))
    score = _agreement(one, other, first.new_zeros(count), lags, SIDEWAYS // 2 + 1, 2 * BAND)
    around = pad(score, (1, 1), value=-1)
    peak = (score >= around[:, :-2]) & (score > around[:, 2:])
    shift = 2 * lags[score.masked_fill(~peak, -1).topk(PEAKS).indices].flatten()
    # fine: the neighbourhood of each peak
    one, other = (patch[:, 0].repeat_interleave(PEAKS, 0) for patch in (first, second))
    for span, step in ((4.0, 0.5), (1.0, 0.25)):
        near = torch.arange(-span, span + step / 2, step).to(first)
        score = _agreement(one, other, shift, near, SIDEWAYS, BAND)
        best, at = score.max(1)
        shift = shift + near[at] + step * _vertex(score, at)
    return shift.view(count, PEAKS), best.view(count, PEAKS).nan_to_num(0).clamp(0, 1)


def _agreement(first: Tensor, second: Tensor, guess: Tensor, lags: Tensor, sway: int, band: float) -> Tensor:
    """How well the frequencies agree on a shift of guess + lag, the best of any sway within +-sway columns.

    Args:
        band: standard deviation of a Gaussian over the frequencies, cycles/pixel.

    Shape: (B,h,w), (B,h,w), (B,), (T,) -> (B,T).
    """
    height, width = first.shape[1:]
    row = torch.arange(height).to(first)
    common = (height - guess.abs())[:, None]  # rows of ground that both show
    start = (-guess).clamp(min=0)[:, None]
    spectra = []
    for patch, moved in ((first, 0.0), (second, guess[:, None])):  # the window moves with the ground
        at = (row - start - moved + 0.5) / common
        window = torch.where((at > 0) & (at < 1), (math.pi * at).sin(), 0.0)[..., None]
        mean = (patch * window).sum(1, keepdim=True) / window.sum(1, keepdim=True)
        spectra.append(torch.fft.rfft((patch - mean) * window, dim=1)[:, 1:])  # rails have no place
    frequency = torch.arange(1, height // 2 + 1).to(first) / height
    low = (-0.5 * (frequency / band) ** 2).exp()
    back, wave = (_turn(frequency[:, None] * by) for by in (guess, lags))
    columns = width - 2 * sway
    floor = FLOOR * common * columns
    middle = spectra[0][..., sway : sway + columns]
    power = middle.abs().square().sum(2) + floor
    scores = []
    for side in range(2 * sway + 1):
        other = spectra[1][..., side : side + columns]
        both = (power * (other.abs().square().sum(2) + floor)).sqrt()
        coherence = (middle.conj() * other).sum(2) / both * back.T
        weight = coherence.abs() * low
        scores.append(((coherence * weight) @ wave).real / weight.sum(1, keepdim=True).clamp(min=1e-9))
    return torch.stack(scores).amax(0)


def _turn(cycles: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles)


def _vertex(score: Tensor, at: Tensor) -> Tensor:
    """Where between the samples a parabola through the best one and its neighbours has its top, in steps."""
    inside = at.clamp(1, score.shape[1] - 2)
    left, mid, right = (score.gather(1, (inside + k)[:, None])[:, 0] for k in (-1, 0, 1))
    curve = (2 * mid - left - right).clamp(min=1e-9)
    offset = (0.5 * (right - left) / curve).clamp(-1, 1)
    return torch.where(inside == at, offset, 0.0)
