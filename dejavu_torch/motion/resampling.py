"""Footage resampled by distance, to even steps along the ground (section IV-B)."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.data.positions import NEAR, first_reached, shown_frames
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.types import GroundTruth, InputError, Traverse

log = logging.getLogger("dejavu_torch")

MOST = 20  # steps a frame, on average
DOUBTFUL = 0.2  # steps backwards for each one forward


class ResampledTraverse(Traverse):
    """The frames of another traverse, resampled by distance: at even steps along the ground.

    The other traverse is read through once to measure the distances, and again each time the frames are asked
    for.

    Args:
        traverse: frames, in order.
        odometry: measures the ground, and says the step and whether to blend.
        batch_size: frames in memory at a time while measuring.
        step: pixels of ground, in place of the odometry's; as for the queries of a map.
        progress: show a progress bar on a terminal.

    Shape: frames (M,C,H,W). positions: (F,) float32, how many steps each frame of the other traverse lies
        from the first. frame: (M,) int64, the frame of the other traverse nearest to each step. place: (M,)
        float64, the other traverse's place of what is shown (interpolated where frames are blended), None
        where it has none. step: pixels of ground.

    Convention: distances count from frame 0, in the direction in which the camera gets further from it. Each
        step is taken where it is first reached: standing, and going back and forth, add no frames.

    Raises:
        InputError: as `GroundOdometry.distances`, and footage that does not move, or less than a step, or
            over 20 steps a frame.
    """

    length: int

    def __init__(
        self,
        traverse: Traverse,
        odometry: GroundOdometry,
        batch_size: int = 64,
        step: float | None = None,
        progress: bool = False,
    ) -> None:
        self.traverse, self.odometry, self.name = traverse, odometry, traverse.name
        distance = odometry.distances(traverse, batch_size, progress).distance
        if -distance.min() > distance.max():  # a camera that looks back
            distance = -distance
        moved, frames = distance.diff(), len(distance)
        if not moved.any():
            raise InputError(f"{self.name} stands still in all of its {frames} frames; expected motion")
        step = odometry.step if step is None else step
        self.step = float(moved.abs()[moved != 0].median()) if step is None else float(step)
        _warn_doubtful(moved, self.name)
        self.positions = (distance / self.step).float()
        most = float(self.positions.max())
        if not 1 <= most + NEAR < MOST * frames:
            raise InputError(
                f"{self.name} moves by {float(distance.max()):.3g} pixels of ground in {frames} frames; "
                f"expected at least one step, {self.step:g}, and at most {MOST} a frame"
            )
        self.frame = shown_frames(self.positions)
        self.length = len(self.frame)
        if odometry.blend:
            self._low, self._high, self._share = first_reached(self.positions)
        else:
            self._low, self._high, self._share = self.frame, self.frame, torch.zeros(self.length).double()
        if traverse.place is not None:
            place = traverse.place.double()
            self.place = place[self._low].lerp(place[self._high], self._share)

    def frame_name(self, i: int) -> str:
        return self.traverse.frame_name(int(self.frame[i]))

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape

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
        """The steps [done, stop) of batches that begin with frame `seen` of the other traverse."""
        last: Tensor | None = None
        for batch in batches:
            frames = batch if last is None else torch.cat([last, batch])
            seen += len(batch)
            ready = min(stop, int(torch.searchsorted(self._high, seen)))
            for part in torch.arange(done, ready).split(size) if done < ready else ():
                low, high = (index[part] - (seen - len(frames)) for index in (self._low, self._high))
                share = self._share[part].to(frames)[:, None, None, None]
                yield frames[low].lerp(frames[high], share)
            done, last = ready, frames[-1:]
            if done == stop:
                return


def _warn_doubtful(moved: Tensor, name: str) -> None:
    """Warn of footage in which hardly any step goes forward, as where the corners show no ground."""
    forward, back = int((moved > 0).sum()), int((moved < 0).sum())
    if back > DOUBTFUL * forward:
        log.warning(
            "%s: %d of %d steps go forward and %d backwards: do the corners show ground that comes nearer?",
            *(name, forward, len(moved), back),
        )


def source_of(traverse: Traverse) -> Traverse:
    """The traverse whose frames a user counts: the inner one of a resampled traverse."""
    return traverse.traverse if isinstance(traverse, ResampledTraverse) else traverse


def ground_truth_of(
    truth: str | None,
    reference: Traverse,
    query: Traverse,
    places: int | None = None,
    queries: int | None = None,
    interpolate: bool = False,
) -> GroundTruth | None:
    """`find_ground_truth` of traverses that may be resampled, in frames of the reference's source.

    Args:
        places, queries: how many frames the traverses gave, needed where they do not know their lengths.
    """
    frames = source_of(reference).length if places is None else places
    if isinstance(reference, ResampledTraverse):
        frames = len(reference.positions)
    numbers = query.frame if isinstance(query, ResampledTraverse) else queries or query.length
    if numbers is None:
        raise InputError(f"{query.name} does not know how many frames it has; expected their number")
    sources = source_of(reference), source_of(query)
    return find_ground_truth(truth, *sources, frames, numbers, interpolate, reference is not sources[0])
