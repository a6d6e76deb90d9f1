"""Footage resampled to even steps along the ground (section IV-B)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from dejavu_torch.features.velocity import VelocityNormalizer
from dejavu_torch.types import InputError, Traverse


class EvenlySpaced(Traverse):
    """The frames of another traverse at even steps along the ground.

    It is read through once to measure the distances, and again each time the frames are asked for.

    Args:
        traverse: frames, in order.
        normalizer: measures the ground, and says the step and whether to blend.
        batch_size: frames in memory at a time while measuring.
        step: pixels of ground, in place of the normalizer's; as for the query of a map.
        progress: show a progress bar on a terminal.

    Shape: frames (M,C,H,W). frame: (M,) int64, the nearest frame of the inner traverse. distance: (M,)
        float64, pixels of ground. place: (M,) float64, the inner traverse's place of what is shown
        (interpolated where frames are blended), None where it has none. way: (N,) float64, pixels of
        ground at each frame of the inner traverse.

    Convention: distances count from frame 0, in the direction in which the camera gets further from it. Each
        distance is taken where it is first reached: standing, and going back and forth, add no frames.

    Raises:
        InputError: as `VelocityNormalizer.distances`, and footage that does not move, or less than a step.
    """

    length: int

    def __init__(
        self,
        traverse: Traverse,
        normalizer: VelocityNormalizer,
        batch_size: int = 64,
        step: float | None = None,
        progress: bool = False,
    ) -> None:
        self.traverse, self.name = traverse, traverse.name
        way = normalizer.distances(traverse, batch_size, progress).distance
        if -way.min() > way.max():  # a camera that looks back
            way = -way
        moved = way.diff().abs()
        if not moved.any():
            raise InputError(
                f"{self.name} stands still in all of its {len(way)} frames; expected motion to space evenly"
            )
        step = normalizer.step if step is None else step
        if step is None:
            step = float(moved[moved > 0].median())
        furthest = way.cummax(0).values
        count = int(furthest[-1] / step + 1e-9) + 1
        if count < 2:
            raise InputError(
                f"{self.name} moves by {float(furthest[-1]):.3g} pixels of ground; "
                f"expected at least one step, {step:g}"
            )
        self.length, self.step, self.way = count, step, way
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


def frames_of(traverse: Traverse) -> Tensor:
    """The frame, as the camera gave them, that each frame of a traverse shows: (M,) int64."""
    return traverse.frame if isinstance(traverse, EvenlySpaced) else torch.arange(traverse.length or 0)
