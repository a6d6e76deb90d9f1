"""Visual odometry: the speed of a camera, measured on the ground in front of it (section IV-B)."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from dejavu_torch.data.traverse import runs
from dejavu_torch.motion.flow import flow_shift
from dejavu_torch.motion.ground_plane import TRAPEZIUM, Corners, check_corners, ground_patch
from dejavu_torch.motion.phase_correlation import MIN_CONFIDENCE, phase_shifts, viterbi_path
from dejavu_torch.text import progress_of, settings_of
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

MAX_LISTED = 6  # segments without common ground in a warning
MAX_SIZE = 1024  # pixels: more than frames show of the ground, and the cost is quadratic


class Odometry(NamedTuple):
    """distance: (N,) float64, pixels of ground (rows of the patch) from frame 0, negative if backwards.
    confidence: (N-1,) of each step as measured, in [0, 1]."""

    distance: Tensor
    confidence: Tensor


class GroundOdometry(nn.Module):
    """Measures how fast the ground in front of the camera moves.

    Args:
        corners: (x, y) of a region of ground in fractions of the frame: far left, far right, near right,
            near left. Its sides should be parallel on the ground, like two rails.
        size: (rows, columns) of its bird's-eye view, the patch, 32 to 1024 pixels each. Steps can be measured
            up to about 0.42 of the rows.
        step: pixels of ground between resampled frames; None is the median of the nonzero steps.
        least: minimum confidence in [0, 1]; steps below it are interpolated. The default detects a cut in
            patches of 96 x 96; in patches of 32 x 32, unrelated ground can reach 0.8.
        still: dead band in pixels of ground: a shorter step of either sign is set to 0. Low contrast needs
            more, slow footage at a high frame rate less.
        flow: how patches are compared: "phase" (`phase_shifts`), or "lk", OpenCV's optical flow of corners
            (`flow_shift`, with its limits; `pip install 'dejavu_torch[flow]'`).

    Shape: (N,C,H,W) -> shift (N-1,) in pixels of ground, forward > 0; confidence (N-1,) in [0, 1].

    Convention: if periodic ground allows several shifts, the smoothest path is chosen (`viterbi_path`).

    Raises:
        InputError: an argument out of range; forward: OpenCV missing, not (N,C,H,W) float, or N of 1.

    Example:
        >>> shift, confidence = GroundOdometry()(torch.rand(1, 3, 120, 160).expand(5, 3, 120, 160))
        >>> shift.abs().max().item() < 0.01, confidence.min().item() > 0.99
        (True, True)
    """

    def __init__(
        self,
        corners: Corners = TRAPEZIUM,
        size: tuple[int, int] = (96, 96),
        step: float | None = None,
        least: float = MIN_CONFIDENCE,
        still: float = 0.1,
        flow: str = "phase",
    ) -> None:
        super().__init__()
        check_corners(corners)
        if len(size) != 2 or min(size) < 32 or max(size) > MAX_SIZE:
            raise InputError(f"size is {tuple(size)}; expected (rows, columns) of 32 to {MAX_SIZE} each")
        expect(step is None or 0 < step < math.inf, "pixels of ground above 0, or None", step=step)
        expect(0 <= least <= 1, "a confidence from 0 to 1", least=least)
        expect(0 <= still < math.inf, "pixels of ground, at least 0", still=still)
        expect(flow in ("phase", "lk"), "phase or lk", flow=flow)
        self.corners = tuple((float(x), float(y)) for x, y in corners)
        self.size = (int(size[0]), int(size[1]))
        self.step = None if step is None else float(step)
        self.least, self.still, self.flow = least, still, flow

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        return self._path(self._shifts(ground_patch(frames, self.corners, self.size)), "the input")

    def _shifts(self, patches: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Possible shifts (n-1,K) between consecutive patches (n,1,h,w), and their confidence; [] of one."""
        if len(patches) < 2:
            return []
        if self.flow == "phase":
            return [phase_shifts(patches[:-1], patches[1:])]
        shift, confidence = flow_shift(patches[:-1], patches[1:])
        return [(shift[:, None], confidence[:, None])]

    def _path(self, parts: list[tuple[Tensor, Tensor]], name: str) -> tuple[Tensor, Tensor]:
        """The shifts (n,) chosen by `viterbi_path` from all parts, and their confidences (n,)."""
        expect(parts, "at least 2 to measure motion", f"{name} has 1 frame")
        shifts, confidences = (torch.cat(part) for part in zip(*parts, strict=True))
        path = viterbi_path(shifts, confidences, self.size[0]).to(shifts.device)[:, None]
        return shifts.gather(1, path)[:, 0], confidences.gather(1, path)[:, 0]

    @torch.no_grad()
    def distances(self, traverse: Traverse, batch_size: int = 64, progress: bool = False) -> Odometry:
        """The position of the camera at each frame of a traverse, which is read once, batch by batch.

        Args:
            batch_size: frames in memory at a time, or fewer if they are large. progress: show a bar.

        Convention: a step with confidence below `least` (a cut, a drop-out) is interpolated between its
            neighbours, with a warning that names the frames. A step shorter than `still` is 0.

        Raises:
            InputError: features instead of frames, fewer than two frames, or no confident step.
        """
        last: list[Tensor] = []  # the last patch of the previous batch
        parts: list[tuple[Tensor, Tensor]] = []
        with progress_of("measuring the ground", len(traverse), progress) as update:
            for batch in traverse.batches(batch_size):
                patches = torch.cat([*last, ground_patch(batch, self.corners, self.size)])
                if not last:
                    self._warn_coarse(batch, traverse.name)
                parts += self._shifts(patches)
                last = [patches[-1:]]
                update(len(batch))
        shift, confidence = (part.cpu() for part in self._path(parts, traverse.name))
        shift = interpolated(shift.double(), confidence >= self.least, traverse.name)
        shift = torch.where(shift.abs() < self.still, 0.0, shift)
        return Odometry(torch.cat([shift.new_zeros(1), shift.cumsum(0)]), confidence)

    def _warn_coarse(self, batch: Tensor, name: str) -> None:
        """Warn of a patch with more rows than the frames resolve: motion is underestimated."""
        (height, width), (rows, columns) = batch.shape[2:], self.size
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = self.corners
        # pixels between the midpoints of the region's far and near edge
        shown = math.hypot((cx + dx - ax - bx) / 2 * (width - 1), (cy + dy - ay - by) / 2 * (height - 1))
        if rows > 2 * shown:
            remedy = f"size ({int(2 * shown)}, {columns})" if shown >= 16 else "larger frames or regions"
            log.warning(
                "%s: the patch has %d rows, its region only %.0f in frames of %d x %d pixels, which "
                "underestimates slow motion: use %s",
                *(name, rows, shown, height, width, remedy),
            )

    extra_repr = settings_of


def interpolated(shift: Tensor, valid: Tensor, name: str) -> Tensor:
    """Steps (n,) with the invalid ones interpolated, constant before the first and after the last valid one,
    and a warning that names their frames."""
    bad, good = (~valid).nonzero()[:, 0], valid.nonzero()[:, 0]
    if not len(bad):
        return shift
    seen = f"{name}: none of {len(shift)} steps shows the same ground twice"
    expect(len(good), "corners on the ground in front of the camera", seen)
    segments = [f"{run.start} to {run.stop}" for run in runs(bad)]
    more = f" and {len(segments) - MAX_LISTED} more" if len(segments) > MAX_LISTED else ""
    log.warning(
        "%s: no common ground in frames %s%s (%d of %d steps): the velocity there is interpolated",
        *(name, ", ".join(segments[:MAX_LISTED]), more, len(bad), len(shift)),
    )
    return torch.from_numpy(np.interp(np.arange(len(shift)), good.numpy(), shift[good].numpy())).to(shift)
