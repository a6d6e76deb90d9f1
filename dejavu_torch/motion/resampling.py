"""Footage resampled by distance, to even steps along the ground (section IV-B)."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from hashlib import blake2b

from torch import Tensor

from dejavu_torch.data.frame_range import Selection, picked
from dejavu_torch.data.ground_truth import GroundTruth, find_ground_truth
from dejavu_torch.data.positions import NEAR, shown_frames
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

MOST = 20  # steps a frame, on average
DOUBTFUL = 0.2  # steps backwards for each one forward


class ResampledTraverse(Selection):
    """The frames of another traverse, resampled by distance: at even steps along the ground. It is read once
    to measure the distances, and again each time the frames are asked for.

    Args:
        odometry: measures the ground, and has the default of the step.
        batch_size: frames in memory at a time while measuring.
        step: pixels of ground, in place of the odometry's; as for the queries of a map.
        progress: show a progress bar on a terminal.

    Shape: positions: (F,) float32, how many steps each frame of the other traverse lies from the first.
        frame: (M,) int64, the one nearest to each step, which is shown. place: (M,) float64, or None.

    Convention: distances count from frame 0, in the direction in which the camera gets further from it. Each
        step is taken where it is first reached: standing, and going back and forth, add no frames.

    Raises:
        InputError: footage that does not move, or less than a step, or over 20 steps a frame.
    """

    length: int
    frame: Tensor
    skips = False  # gaps are short

    def __init__(
        self,
        traverse: Traverse,
        odometry: GroundOdometry,
        batch_size: int = 64,
        step: float | None = None,
        progress: bool = False,
    ) -> None:
        self.odometry = odometry
        distance = odometry.distances(traverse, batch_size, progress).distance
        if -distance.min() > distance.max():  # a camera that looks back
            distance = -distance
        moved, frames = distance.diff(), len(distance)
        if not moved.any():
            raise InputError(f"{traverse.name} stands still in all of its {frames} frames; expected motion")
        forward, back = int((moved > 0).sum()), int((moved < 0).sum())
        if back > DOUBTFUL * forward:
            log.warning(
                "%s: %d of %d steps go forward and %d backwards: do the corners show ground that comes "
                "nearer?",
                *(traverse.name, forward, len(moved), back),
            )
        step = odometry.step if step is None else step
        self.step = float(moved.abs()[moved != 0].median()) if step is None else float(step)
        self.positions = (distance / self.step).float()
        if not 1 <= float(self.positions.max()) + NEAR < MOST * frames:
            raise InputError(
                f"{traverse.name} moves by {float(distance.max()):.3g} pixels of ground in {frames} frames; "
                f"expected at least one step, {self.step:g}, and at most {MOST} a frame"
            )
        super().__init__(traverse, shown_frames(self.positions))
        self.place = None if self.place is None else self.place.double()

    def identity(self) -> str:
        digest = blake2b(self.positions.numpy().tobytes(), digest_size=8).hexdigest()
        return f"{self.traverse.identity()} at steps {digest}"

    def batches(self, size: int) -> Iterator[Tensor]:
        return picked(self.traverse.batches(size), range(len(self.positions)), self.frame, size)


def resampled(
    traverse: Traverse,
    odometry: GroundOdometry | None,
    batch_size: int = 64,
    step: float | None = None,
    progress: bool = False,
) -> Traverse:
    """A `ResampledTraverse`; the traverse itself without odometry, or if it is resampled already. Queries
    have the `step` of the map: a single frame, and ready features, then stay as they are."""
    if odometry is None or isinstance(traverse, ResampledTraverse):
        return traverse
    if step is not None and (traverse.length == 1 or len(traverse.frame_shape) == 1):
        return traverse
    return ResampledTraverse(traverse, odometry, batch_size, step, progress)


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
    aligned: bool = False,
) -> GroundTruth | None:
    """`find_ground_truth` of traverses that may be resampled, in frames of the reference's source; places,
    queries: how many frames the traverses gave, needed if they do not know their lengths."""
    frames, moved = reference.length if places is None else places, isinstance(reference, ResampledTraverse)
    if isinstance(reference, ResampledTraverse):
        frames = len(reference.positions)
    numbers = query.frame if isinstance(query, ResampledTraverse) else queries or query.length
    if numbers is None:
        raise InputError(f"{query.name} does not know how many frames it has; expected their number")
    sources = source_of(reference), source_of(query)
    return find_ground_truth(truth, *sources, frames, numbers, interpolate, moved, aligned)
