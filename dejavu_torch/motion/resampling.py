"""Footage resampled to even steps along the ground (section IV-B)."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import torch
from torch import Tensor

from dejavu_torch.data.positions import NEAR, first_reached, nearest_places
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

MOST = 20  # steps a frame, on average
DOUBTFUL = 0.2  # steps backwards for each one forward


class ResampledTraverse(Traverse):
    """The frames of another traverse at even steps along the ground.

    It is read through once to measure the distances, and again each time the frames are asked for.

    Args:
        traverse: frames, in order.
        normalizer: measures the ground, and says the step and whether to blend.
        batch_size: frames in memory at a time while measuring.
        step: pixels of ground, in place of the normalizer's; as for the query of a map.
        progress: show a progress bar on a terminal.

    Shape: frames (M,C,H,W). frame: (M,) int64, the nearest frame of the inner traverse. way: (N,) float64,
        how many steps each frame of the inner traverse is from the first. place_of: (N,) int64, the place
        nearest to each, -1 behind the first. place: (M,) float64, the inner traverse's place of what is shown
        (interpolated where frames are blended), None where it has none. step: pixels of ground.

    Convention: distances count from frame 0, in the direction in which the camera gets further from it. Each
        distance is taken where it is first reached: standing, and going back and forth, add no frames.

    Raises:
        InputError: as `GroundOdometry.distances`, and footage that does not move, or less than a step, or
            over 20 steps a frame.
    """

    length: int

    def __init__(
        self,
        traverse: Traverse,
        normalizer: GroundOdometry,
        batch_size: int = 64,
        step: float | None = None,
        progress: bool = False,
    ) -> None:
        self.traverse, self.normalizer, self.name = traverse, normalizer, traverse.name
        way = normalizer.distances(traverse, batch_size, progress).distance
        if -way.min() > way.max():  # a camera that looks back
            way = -way
        moved = way.diff()
        if not moved.any():
            wanted = "motion to space evenly" + ("" if step is None else ", or --as_is")
            raise InputError(f"{self.name} stands still in all of its {len(way)} frames; expected {wanted}")
        step = normalizer.step if step is None else step
        self.step = float(moved.abs()[moved != 0].median()) if step is None else float(step)
        _tell_doubtful(moved, self.name)
        self.positions = (way / self.step).float().double()  # as a map keeps it
        most = float(self.positions.max())
        if not 1 <= most + NEAR < MOST * len(way):
            raise InputError(
                f"{self.name} moves by {float(way.max()):.3g} pixels of ground in {len(way)} frames; "
                f"expected at least one step, {self.step:g}, and at most {MOST} a frame"
            )
        low, high, share = first_reached(self.positions)
        self.length = len(low)
        self.frame = torch.where(share < 0.5, low, high)
        self.place_of = nearest_places(self.positions)
        self._low, self._high, self._share = low, high, share
        if not normalizer.blend:
            self._low, self._high, self._share = self.frame, self.frame, torch.zeros_like(share)
        if traverse.place is not None:
            place = traverse.place.double()
            self.place = place[self._low].lerp(place[self._high], self._share)

    def batches(self, size: int) -> Iterator[Tensor]:
        yield from self._shown(self.traverse.batches(size), 0, 0, self.length, size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        stop = min(stop, self.length)
        if start < stop:
            first, last = int(self._low[start]), int(self._high[stop - 1])
            yield from self._shown(self.traverse.between(first, last + 1), first, start, stop, 64)

    def _shown(
        self, batches: Iterator[Tensor], seen: int, done: int, stop: int, size: int
    ) -> Iterator[Tensor]:
        """The places [done, stop) of batches that begin with frame `seen` of the inner traverse."""
        last: Tensor | None = None
        for batch in batches:
            frames = batch if last is None else torch.cat([last, batch])
            seen += len(batch)
            ready = min(stop, int(torch.searchsorted(self._high, seen)))
            for part in torch.arange(done, ready).split(size):
                low, high = (index[part] - (seen - len(frames)) for index in (self._low, self._high))
                share = self._share[part].to(frames)[:, None, None, None]
                yield frames[low].lerp(frames[high], share)
            done, last = ready, frames[-1:]
            if done == stop:
                return


def _tell_doubtful(moved: Tensor, name: str) -> None:
    """Tell of footage in which hardly any step goes forward, as where the corners show no ground."""
    forward, back = int((moved > 0).sum()), int((moved < 0).sum())
    if back > DOUBTFUL * forward:
        log.warning(
            "%s: %d of %d steps go forward and %d backwards: do the corners show ground that comes nearer?",
            *(name, forward, len(moved), back),
        )
