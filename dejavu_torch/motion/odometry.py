"""How fast a camera moves, measured on the ground in front of it (section IV-B)."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from dejavu_torch.motion.flow import TRACKS, check_method, flow_shift
from dejavu_torch.motion.ground_plane import (
    TRAPEZIUM,
    Corners,
    check_corners,
    check_size,
    ground_patch,
    region_length,
)
from dejavu_torch.motion.phase_correlation import SURE, shift_peaks, steady
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

NAMED = 6  # stretches without common ground that a warning names


class Odometry(NamedTuple):
    """Where a camera is at each frame of a traverse.

    distance: (N,) float64, pixels of ground (rows of the patch) from frame 0, negative behind it.
    confidence: (N-1,) of each step in [0, 1], as measured.
    """

    distance: Tensor
    confidence: Tensor


class GroundOdometry(nn.Module):
    """Measures how fast the ground in front of the camera moves.

    Args:
        corners: (x, y) of a region of ground in fractions of the frame: far left, far right, near right,
            near left; its sides parallel on the ground, such as the rails. See `ground_patch`.
        size: (rows, columns) of the patch it becomes, pixels, at least 32 x 32. The longest step that can be
            measured is about 0.42 of its rows.
        step: pixels of ground from one resampled frame to the next; None is the median step of the
            frames that move.
        least: confidence below which a step is interpolated, in [0, 1]. The default finds a cut in patches of
            96 x 96; in those of 32 x 32 unrelated ground can agree by 0.8.
        still: pixels of ground; a shorter step of either sign counts as 0, as of a camera that stands. Noise
            of a few grey levels moves ground of clear texture by less; ground that hardly stands out from
            the noise needs more, slow footage of many frames a second less.
        flow: how patches are compared: "phase" (`shift_between`), or optical flow of OpenCV, "lk" on corners
            or "dis" on all pixels (`flow_shift`, with its limits; `pip install 'dejavu_torch[flow]'`).

    Shape: (N,C,H,W) -> shift (N-1,) in pixels of ground, forward > 0; confidence (N-1,) in [0, 1]: both
        as measured, of consecutive frames.

    Convention: where periodic ground leaves several shifts, the ones that change least (`steady`); optical
        flow gives but one.

    Raises:
        InputError: corners that are no region of the frame; a size, step, least or still out of range; an
            unknown flow, or one of OpenCV where that is missing;
            forward: fewer than two frames, or not (N,C,H,W) float.

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
        least: float = SURE,
        still: float = 0.1,
        flow: str = "phase",
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
        if flow not in ("phase", *TRACKS):
            raise InputError(f"flow is {flow!r}; expected phase, {', '.join(TRACKS)}")
        if flow != "phase":
            check_method(flow)
        self.corners = tuple((float(x), float(y)) for x, y in corners)
        self.size = (int(size[0]), int(size[1]))
        self.step = None if step is None else float(step)
        self.least, self.still, self.flow = least, still, flow

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        patches = ground_patch(frames, self.corners, self.size)
        if len(patches) < 2:
            raise InputError(f"there are {len(patches)} frames; expected at least 2 to see motion")
        return self._steady(*self._shifts(patches[:-1], patches[1:]))

    def _shifts(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """What each shift may be. (n,1,h,w), (n,1,h,w) -> (n,K), (n,K)"""
        if self.flow == "phase":
            return shift_peaks(first, second)
        shift, sure = flow_shift(first, second, self.flow)
        return shift[:, None], sure[:, None]

    def _steady(self, shifts: Tensor, sure: Tensor) -> tuple[Tensor, Tensor]:
        path = steady(shifts, sure, self.size[0]).to(shifts.device)[:, None]
        return shifts.gather(1, path)[:, 0], sure.gather(1, path)[:, 0]

    def distances(self, traverse: Traverse, batch_size: int = 64, progress: bool = False) -> Odometry:
        """Where the camera is at each frame of a traverse, which is read once, batch by batch.

        Args:
            traverse: frames, in order.
            batch_size: frames in memory at a time; fewer where they are large.
            progress: show a progress bar on a terminal.

        Convention: a step of a confidence below `least` (a cut, a drop-out) is interpolated between those
            before and after it; a line of warning names the frames. A step shorter than `still` is 0. Another
            warning is given of frames too small for the patch.

        Raises:
            InputError: ready features, fewer than two frames, or no step of enough confidence.
        """
        patches: Tensor | None = None
        parts: list[tuple[Tensor, Tensor]] = []
        text, hidden = "measuring the ground", None if progress else True
        with tqdm(total=traverse.length, desc=text, unit="frame", disable=hidden, leave=False) as bar:
            for batch in traverse.batches(traverse.batch_size(batch_size)):
                if batch.ndim != 4:
                    raise InputError(
                        f"{traverse.name} gives batches {tuple(batch.shape)}; expected frames (B,C,H,W): "
                        "ready features show no ground"
                    )
                with torch.no_grad():
                    new = ground_patch(batch, self.corners, self.size)
                    if patches is None:
                        self._warn_coarse(batch, traverse.name)
                    patches = new if patches is None else torch.cat([patches[-1:], new])
                    parts.append(self._shifts(patches[:-1], patches[1:]))
                bar.update(len(batch))
        shifts, sure = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
        if not len(shifts):
            raise InputError(f"{traverse.name} has 1 frame; expected at least 2 to see motion")
        shift, confidence = self._steady(shifts, sure)
        shift = interpolated(shift.double(), confidence >= self.least, traverse.name)
        shift = torch.where(shift.abs() < self.still, 0.0, shift)
        return Odometry(torch.cat([shift.new_zeros(1), shift.cumsum(0)]), confidence)

    def _warn_coarse(self, batch: Tensor, name: str) -> None:
        """Warn of a patch finer than what the frames show: what is interpolated hardly moves."""
        shown, (rows, columns) = region_length(self.corners, *batch.shape[2:]), self.size
        if rows <= 2 * shown:
            return
        fits = f"size ({int(2 * shown)}, {columns})" if shown >= 16 else "larger frames, or a larger region,"
        log.warning(
            "%s: the patch has %d rows, its region only %.0f in frames of %d x %d pixels: slow motion is "
            "underestimated, %s would do",
            *(name, rows, shown, *batch.shape[2:], fits),
        )

    def extra_repr(self) -> str:
        return (
            f"corners={self.corners}, size={self.size}, step={self.step}, least={self.least}, "
            f"still={self.still}, flow={self.flow}"
        )


def interpolated(shift: Tensor, valid: Tensor, name: str) -> Tensor:
    """Steps with the others interpolated between those that are valid; a warning names their frames.

    Shape: (n,), (n,) bool -> (n,).

    Raises:
        InputError: none is valid.
    """
    bad, good = (~valid).nonzero()[:, 0], valid.nonzero()[:, 0]
    if not len(bad):
        return shift
    if not len(good):
        raise InputError(
            f"{name}: none of {len(shift)} steps shows the same ground twice; "
            "expected corners on the ground in front of the camera"
        )
    starts, stops = bad[bad.diff(prepend=bad[:1] - 2) > 1], bad[bad.diff(append=bad[-1:] + 2) > 1] + 1
    stretches = [f"{start} to {stop}" for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)]
    more = f" and {len(stretches) - NAMED} more" if len(stretches) > NAMED else ""
    log.warning(
        "%s: no common ground in frames %s%s (%d of %d steps): the velocity there is interpolated",
        *(name, ", ".join(stretches[:NAMED]), more, len(bad), len(shift)),
    )
    # ahead of the first and behind the last: that one's
    return torch.from_numpy(np.interp(np.arange(len(shift)), good.numpy(), shift[good].numpy())).to(shift)
