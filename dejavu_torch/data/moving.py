"""Images of a camera that points too far to the right or left, moved sideways so that they look as before."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dejavu_torch.data.traverse import Part, chained, parts_of
from dejavu_torch.types import Traverse

MOST = 0.5  # of the width, beyond which more is reflected than seen


def sideways(columns: Tensor, at: Tensor, mirrored: Callable[[Tensor], Tensor] | None = None) -> Tensor:
    """Values (.., W) between their columns, linearly interpolated, at (n,): (.., n). Beyond the borders they
    are reflected; `mirrored` is what a mirror makes of a column."""
    width = columns.shape[-1]
    reflected = (columns if mirrored is None else mirrored(columns)).flip(-1)
    wide = torch.cat([reflected, columns, reflected], -1)
    at = (at + width).clamp(0, 3 * width - 1)
    low = at.floor()
    share = (at - low).to(columns)
    first = low.long()
    return torch.lerp(wide[..., first], wide[..., (first + 1).clamp(max=3 * width - 1)], share)


def moved(frames: Tensor, shifts: Sequence[float]) -> Tensor:
    """Copies of frames moved sideways, see `Moved`: (B,C,H,W) -> (B x V, C,H,W)."""
    width = frames.shape[-1]
    by = width * torch.tensor(shifts, device=frames.device)[:, None]
    copies = sideways(frames, (torch.arange(width, device=frames.device) - by).flatten())
    return copies.view(*frames.shape[:3], len(shifts), width).movedim(-2, 1).flatten(0, 1)


class Moved(Part):
    """Copies of frames moved sideways: each follows once for each of `shifts`.

    Args:
        shifts: by how much the camera is taken to point too far to the right, in shares of the width; the
            copies show what it would see without. Beyond its borders a frame is reflected.
    """

    def __init__(self, traverse: Traverse, shifts: Sequence[float]) -> None:
        super().__init__(traverse, torch.arange(len(traverse)).repeat_interleave(len(shifts)))
        self.shifts = tuple(shifts)

    def read(self, frames: range | list[int]) -> Tensor:
        seen, count = super().read(frames), len(self.shifts)
        copies = [moved(one[None], [self.shifts[i % count]]) for i, one in zip(frames, seen, strict=True)]
        return torch.cat(copies)


def unmoved(traverse: Traverse) -> Traverse:
    """The frames as they were, of which each has one moved copy."""
    return chained([one.traverse if hasattr(one, "shifts") else one for one in parts_of(traverse)])  # type: ignore[attr-defined]
