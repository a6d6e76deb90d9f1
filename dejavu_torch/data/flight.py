"""Windows along a path over a picture of the ground: a flight as queries."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from dejavu_torch.data.grid import BYTES, PIXELS
from dejavu_torch.data.picture import Pixels, read_picture
from dejavu_torch.data.tables import read_table
from dejavu_torch.places.rectangles import Ground
from dejavu_torch.text import printable
from dejavu_torch.types import Coordinates, InputError, Traverse, expect

EXPECTED = "a csv with the columns x,y and, if windows are turned, heading"
SLACK = 1e-3  # pixels by which windows may leave a picture, of rounding


class Flight(Traverse):
    """Square windows of a picture around points, in their order, as a camera that looks down sees them.

    Args:
        picture: (C,H,W) uint8. points: (N,2) float64, the middles (x, y), in coordinates of `ground`.
        headings: (N,) float64, degrees clockwise from north that are up in a window; None leaves the windows
            upright in the picture. North is up where y grows downwards, as in
            pixels. window: side, pixels. name: for messages. ground: where the picture lies. rows: of the
            points in a file, for messages.

    Convention: between pixels values are interpolated, bilinear.

    Raises:
        InputError: a window that leaves the picture.

    Example:
        >>> flight = Flight(torch.zeros(3, 80, 100, dtype=torch.uint8), torch.tensor([[40.0, 33.0]]))
        >>> flight[0].shape
        torch.Size([3, 64, 64])
    """

    ordered = sized = True

    def __init__(
        self,
        picture: Pixels,
        points: Tensor,
        headings: Tensor | None = None,
        window: int = 64,
        name: str = "the picture",
        ground: Ground = PIXELS,
        rows: Sequence[str] = (),
    ) -> None:
        expect(window >= 1, "at least 1", f"{name}: window={window}")
        self.name, self.picture, points = name, picture, points.double()
        self.coordinates, self.headings = Coordinates(points, frame=ground.frame), headings
        steps = points.new_tensor([ground.right, ground.down])
        pixel = steps.inverse()
        self.middle = (points - points.new_tensor(ground.first)) @ pixel - 0.5  # column and row
        up = points.new_tensor([[0.0, -1.0]]).expand(len(points), 2)
        if headings is not None:
            angle, north = headings.double().deg2rad(), -steps.det().sign()  # y grows downwards in pixels
            up = normalize(torch.stack([angle.sin(), north * angle.cos()], 1) @ pixel)
        self.axes = torch.stack([-up[:, 1], up[:, 0], -up[:, 0], -up[:, 1]], 1).view(-1, 2, 2)  # right, down
        line = torch.arange(window, dtype=torch.float64) - (window - 1) / 2
        self.offsets = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1)  # (window,window,2)
        ends = self.offsets[[0, 0, -1, -1], [0, -1, 0, -1]] @ self.axes + self.middle[:, None]
        self.last = torch.tensor(picture.shape[:0:-1]) - 1
        for i in ((ends < -SLACK) | (ends > self.last + SLACK)).any(2).any(1).nonzero()[:1, 0].tolist():
            where, (x, y) = rows[i] if rows else f"point {i} of {name}", points[i].tolist()
            seen = f"{where}: the window of {window} pixels around x={x:.9g}, y={y:.9g} leaves the picture"
            raise InputError(f"{seen}; expected it inside {picture.shape[2]} x {picture.shape[1]} pixels")

    def __len__(self) -> int:
        return len(self.middle)

    def read(self, frames: range | list[int]) -> Tensor:
        return torch.stack([self._window(i) for i in frames])

    def _window(self, i: int) -> Tensor:
        at = self.offsets @ self.axes[i] + self.middle[i]
        first = at.amin((0, 1)).floor().long().clamp(min=0)
        stop = at.amax((0, 1)).ceil().long().minimum(self.last) + 1
        (left, top), (right, bottom) = first.tolist(), stop.tolist()
        part = self.picture[:, top:bottom, left:right].float() / BYTES
        at = (2 * (at - first) + 1) / (stop - first) - 1
        return grid_sample(part[None], at[None].float(), padding_mode="border", align_corners=False)[0]


def read_flight(path: Path, points: str = "", window: int = 64, scale: float = 1.0) -> Flight:
    """Windows of an image file along a path.

    Args:
        points: a csv with the columns x and y, in pixels after scaling, or metres of a GeoTIFF, and maybe
            `heading`, see `Flight`. window: pixels, after scaling. scale: see `read_picture`.

    Raises:
        InputError: as `read_picture`; no such file, a row without numbers, or one whose window leaves the
            picture.
    """
    name = printable(path)
    expect(points, "points=FILE", f"{name}: points is missing")
    table = read_table(Path(points), EXPECTED)
    expect("x" in table and "y" in table and table.rows, EXPECTED, str(table))
    columns = [table.numbers(one) for one in ("x", "y", "heading") if one in table]
    values, lines = torch.from_numpy(np.stack(columns, 1)), [table.where(row) for row in range(len(table))]
    for row in values.isnan().any(1).nonzero()[:1, 0].tolist():
        raise InputError(f"{lines[row]}: {', '.join(table.rows[row][1])}; expected numbers")
    picture, _, ground = read_picture(path, scale)
    told = f"{name}?points={points}&window={window}" + (f"&scale={scale:g}" if scale < 1 else "")
    headings = values[:, 2] if len(columns) == 3 else None
    return Flight(picture, values[:, :2], headings, window, told, ground, lines)
