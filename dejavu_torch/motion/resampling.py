"""Footage resampled by distance: at even steps along the ground (section IV-B)."""

from __future__ import annotations

import logging

from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, Truth, find_ground_truth
from dejavu_torch.data.traverse import Part
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.places.positions import NEAR, shown_frames
from dejavu_torch.types import Traverse, expect

log = logging.getLogger("dejavu_torch")

MAX_STEPS_PER_FRAME = 20  # on average
MAX_BACKWARD = 0.2  # steps backwards for each one forward


class ResampledTraverse(Part):
    """A traverse resampled by distance, at even steps along the ground; it is read once to measure them.

    Args:
        odometry: measures the distances and sets the default step.
        batch_size, progress: as for `GroundOdometry.distances`.
        step: pixels of ground, overrides the odometry's, as for the queries of a map.

    Shape: positions: (F,) float32, the distance of each original frame from frame 0 in steps.
        frame: (M,) int64, the original frame nearest to each step. places: (M,) float64, or None.

    Convention: distances are measured from frame 0, positive in the main direction of travel. Each step uses
        the frames that first reach it: stops and reversals add no frames.

    Raises:
        InputError: footage that does not move, moves less than a step, or over 20 steps per frame.
    """

    frame: Tensor

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
        if -distance.min() > distance.max():  # a camera that looks backwards
            distance = -distance
        moved, frames = distance.diff(), len(distance)
        expect(moved.any(), "motion", f"{traverse.name} does not move in its {frames} frames")
        forward, back = int((moved > 0).sum()), int((moved < 0).sum())
        if back > MAX_BACKWARD * forward:
            log.warning(
                "%s: %d of %d steps go forward and %d backwards: do the corners show the ground ahead?",
                *(traverse.name, forward, len(moved), back),
            )
        step = odometry.step if step is None else step
        self.step = float(moved.abs()[moved != 0].median()) if step is None else float(step)
        self.positions = (distance / self.step).float()
        seen = f"{traverse.name} moves by {float(distance.max()):.3g} pixels of ground in {frames} frames"
        expected = f"at least one step of {self.step:g}, and at most {MAX_STEPS_PER_FRAME} per frame"
        expect(1 <= float(self.positions.max()) + NEAR < MAX_STEPS_PER_FRAME * frames, expected, seen)
        super().__init__(traverse, shown_frames(self.positions))


def resampled(
    traverse: Traverse,
    odometry: GroundOdometry | None,
    batch_size: int = 64,
    step: float | None = None,
    progress: bool = False,
) -> Traverse:
    """The traverse resampled by distance, unless there is no odometry or it is resampled already. With a
    `step`, that of a map for its queries, a single frame and features are returned unchanged too."""
    if odometry is None or isinstance(traverse, ResampledTraverse):
        return traverse
    traverse.layout.expect_route("a route, or no --velocity", f"{traverse.name} is an area")
    if step is not None and (len(traverse) == 1 or len(traverse.frame_shape) == 1):
        return traverse
    return ResampledTraverse(traverse, odometry, batch_size, step, progress)


def source_of(traverse: Traverse) -> Traverse:
    """The original traverse of a resampled one; any other unchanged. Users count its frames."""
    return traverse.traverse if isinstance(traverse, ResampledTraverse) else traverse


def ground_truth_of(
    truth: Truth | None,
    reference: Traverse,
    query: Traverse,
    interpolate: bool = False,
    counters: bool = True,
) -> GroundTruth | None:
    """`find_ground_truth` for traverses that may be resampled, in frames of the reference's source."""
    moved = isinstance(reference, ResampledTraverse)
    numbers = query.frame if isinstance(query, ResampledTraverse) else len(query)
    sources = source_of(reference), source_of(query)
    return find_ground_truth(truth, *sources, len(sources[0]), numbers, interpolate, moved, counters)
