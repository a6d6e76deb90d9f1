"""Footage resampled to even steps along the ground (section IV-B)."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.features.extract import BATCH_NUMBERS, frame_shape
from dejavu_torch.features.ground import (
    SURE,
    TRAPEZIUM,
    Corners,
    check_corners,
    check_size,
    ground_patch,
    shift_peaks,
    steady,
)
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")


class Ground(NamedTuple):
    """How far a traverse has come at each frame.

    distance: (N,) float64, pixels of ground (rows of the patch) from frame 0, negative behind it.
    confidence: (N-1,) of each step in [0, 1], as measured.
    """

    distance: Tensor
    confidence: Tensor


class VelocityNormalizer(nn.Module):
    """Measures how fast the ground in front of the camera moves.

    Args:
        corners: (x, y) of a region of ground in fractions of the frame: far left, far right, near right,
            near left; its sides parallel on the ground, such as the rails. See `ground_patch`.
        size: (rows, columns) of the patch it becomes, pixels, at least 32 x 32. The fastest step that can be
            seen is about 0.42 of its rows.
        step: pixels of ground from one frame of `EvenlySpaced` to the next; None is the median step of the
            frames that move.
        least: confidence below which a step is not believed, in [0, 1].
        still: pixels of ground; a shorter step of either sign counts as 0, as of a camera that stands. Noise
            of a few grey levels moves ground of clear texture by less; ground that hardly stands out from
            the noise needs more, slow footage of many frames a second less.
        blend: `EvenlySpaced` shows a blend of the two frames next to each place instead of the nearest.

    Shape: (N,C,H,W) -> shift (N-1,) in pixels of ground, forward > 0; confidence (N-1,) in [0, 1]: both
        as measured, of consecutive frames.

    Convention: where periodic ground leaves several shifts, the ones that change least (`steady`).

    Raises:
        InputError: corners that are no region of the frame; a size, step, least or still out of range;
            forward: fewer than two frames, or not (N,C,H,W) float.

    Example:
        >>> shift, confidence = VelocityNormalizer()(torch.rand(1, 3, 120, 160).expand(5, 3, 120, 160))
        >>> shift.abs().max().item() < 0.01, confidence.min().item() > 0.99
        (True, True)
    """

    def __init__(
        self,
        corners: Corners = TRAPEZIUM,
        size: tuple[int, int] = (96, 96),
        step: float | None = None,
        least: float = SURE,
        still: float = 0.1,
        blend: bool = False,
    ) -> None:
        super().__init__()
        check_corners(corners)
        check_size(size, 32)
        if step is not None and not 0 < step < math.inf:
            raise InputError(f"step is {step}; expected pixels of ground above 0, or None")
        if not 0 <= least <= 1:
            raise InputError(f"least is {least}; expected a confidence from 0 to 1")
        if not 0 <= still < math.inf:
            raise InputError(f"still is {still}; expected pixels of ground, at least 0")
        self.corners = tuple((float(x), float(y)) for x, y in corners)
        self.size = (int(size[0]), int(size[1]))
        self.step, self.least, self.still, self.blend = step, least, still, blend

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        patches = ground_patch(frames, self.corners, self.size)
        if len(patches) < 2:
            raise InputError(f"there are {len(patches)} frames; expected at least 2 to see motion")
        return self._steady(*shift_peaks(patches[:-1], patches[1:]))

    def _steady(self, shifts: Tensor, sure: Tensor) -> tuple[Tensor, Tensor]:
        path = steady(shifts, sure, self.size[0]).to(shifts.device)[:, None]
        return shifts.gather(1, path)[:, 0], sure.gather(1, path)[:, 0]

    def distances(self, traverse: Traverse, batch_size: int = 64) -> Ground:
        """How far the camera has come at each frame of a traverse, which is read once, batch by batch.

        Args:
            traverse: frames, in order.
            batch_size: frames in memory at a time; fewer where they are large.

        Convention: a step that is not believed (a cut, a drop-out) gets the velocity interpolated between the
            believed ones before and after it; one line of warning tells how many. Shorter than `still` is 0.

        Raises:
            InputError: ready features, fewer than two frames, or no step that is believed.
        """
        patches: Tensor | None = None
        parts: list[tuple[Tensor, Tensor]] = []
        room = BATCH_NUMBERS // max(1, math.prod(frame_shape(traverse)))
        for batch in traverse.batches(max(1, min(batch_size, room))):
            if batch.ndim != 4:
                raise InputError(
                    f"{traverse.name} gives batches {tuple(batch.shape)}; expected frames (B,C,H,W): "
                    "ready features show no ground"
                )
            with torch.no_grad():
                new = ground_patch(batch, self.corners, self.size)
                patches = new if patches is None else torch.cat([patches[-1:], new])
                parts.append(shift_peaks(patches[:-1], patches[1:]))
        shifts, sure = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
        if not len(shifts):
            raise InputError(f"{traverse.name} has 1 frame; expected at least 2 to see motion")
        shift, confidence = self._steady(shifts, sure)
        shift = _mended(shift.double(), confidence >= self.least, traverse.name)
        shift = torch.where(shift.abs() < self.still, 0.0, shift)
        return Ground(torch.cat([shift.new_zeros(1), shift.cumsum(0)]), confidence)

    def extra_repr(self) -> str:
        return (
            f"corners={self.corners}, size={self.size}, step={self.step}, least={self.least}, "
            f"still={self.still}, blend={self.blend}"
        )


def _mended(shift: Tensor, believed: Tensor, name: str) -> Tensor:
    """Steps that are not believed, interpolated between those that are, and told. (n,), (n,) -> (n,)"""
    bad = (~believed).nonzero()[:, 0]
    if not len(bad):
        return shift
    good = believed.nonzero()[:, 0]
    first, steps = int(bad[0]), len(shift)
    if not len(good):
        raise InputError(
            f"{name}: none of {steps} steps shows the same ground twice; "
            "expected corners on the ground in front of the camera"
        )
    if len(bad) == 1:
        log.warning(
            "%s: a cut between frames %d and %d: the velocity there is interpolated", name, first, first + 1
        )
    else:
        log.warning(
            "%s: %d of %d steps show no common ground (the first: frames %d and %d): "
            "the velocity there is interpolated",
            *(name, len(bad), steps, first, first + 1),
        )
    after = torch.searchsorted(good, bad)
    left, right = good[(after - 1).clamp(min=0)], good[after.clamp(max=len(good) - 1)]
    share = (bad - left).double() / (right - left).clamp(min=1)
    share = share.clamp(0, 1)  # ahead of the first and behind the last: that one's
    return shift.index_copy(0, bad, shift[left].lerp(shift[right], share))


class EvenlySpaced(Traverse):
    """The frames of another traverse at even steps along the ground.

    It is read through once to measure the distances, and again each time the frames are asked for.

    Args:
        traverse: frames, in order.
        normalizer: measures the ground, and says the step and whether to blend.
        batch_size: frames in memory at a time while measuring.

    Shape: frames (M,C,H,W). frame: (M,) int64, the nearest frame of the inner traverse. distance: (M,)
        float64, pixels of ground. place: (M,) float64, the inner traverse's place of what is shown
        (interpolated where frames are blended), None where it has none.

    Convention: distances count from frame 0, in the direction in which the camera gets further from it. Each
        distance is taken where it is first reached: standing, and going back and forth, add no frames.

    Raises:
        InputError: as `VelocityNormalizer.distances`, and footage that does not move, or less than a step.
    """

    def __init__(self, traverse: Traverse, normalizer: VelocityNormalizer, batch_size: int = 64) -> None:
        self.traverse, self.name = traverse, traverse.name
        way = normalizer.distances(traverse, batch_size).distance
        if -way.min() > way.max():  # a camera that looks back
            way = -way
        moved = way.diff().abs()
        if not moved.any():
            raise InputError(
                f"{self.name} stands still in all of its {len(way)} frames; expected motion to space evenly"
            )
        step = float(moved[moved > 0].median()) if normalizer.step is None else normalizer.step
        furthest = way.cummax(0).values
        count = int(furthest[-1] / step + 1e-9) + 1
        if count < 2:
            raise InputError(
                f"{self.name} moves by {float(furthest[-1]):.3g} pixels of ground; "
                f"expected at least one step, {step:g}"
            )
        self.length = count
        self.distance = torch.arange(count, dtype=torch.float64) * step
        high = torch.searchsorted(furthest, self.distance).clamp(max=len(way) - 1)
        low = (high - 1).clamp(min=0)
        # also after a reversal the frame before the first to reach a distance lies short of it
        share = ((self.distance - way[low]) / (way[high] - way[low]).clamp(min=1e-12)).clamp(0, 1)
        self.frame = torch.where(share < 0.5, low, high)
        self._low, self._high, self._share = low, high, share
        if not normalizer.blend:
            self._low, self._high, self._share = self.frame, self.frame, torch.zeros_like(share)
        if traverse.place is not None:
            place = traverse.place.double()
            self.place = place[self._low].lerp(place[self._high], self._share)

    def batches(self, size: int) -> Iterator[Tensor]:
        seen = done = 0
        last: Tensor | None = None
        for batch in self.traverse.batches(size):
            frames = batch if last is None else torch.cat([last, batch])
            seen += len(batch)
            ready = int(torch.searchsorted(self._high, seen))
            for part in torch.arange(done, ready).split(size):
                low, high = (index[part] - (seen - len(frames)) for index in (self._low, self._high))
                share = self._share[part].to(frames)[:, None, None, None]
                yield frames[low].lerp(frames[high], share)
            done, last = ready, frames[-1:]
            if done == self.length:
                return
