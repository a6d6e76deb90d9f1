"""Windows over a picture of the ground, in rows and columns: an area as a reference."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.area import Area
from dejavu_torch.data.files import as_number
from dejavu_torch.data.folder import read_image
from dejavu_torch.memory import check_room
from dejavu_torch.resize import resize_frames
from dejavu_torch.text import printable
from dejavu_torch.types import Coordinates, InputError, Traverse, expect

BYTES = 255


class Grid(Traverse):
    """Square windows of a picture, in the order of the places of an `Area`.

    Args:
        picture: (C,H,W) uint8. window: side of a window, pixels. stride: pixels from one to the next, in both
            directions. corner: (row, column) of the picture's first pixel in a larger one, whose pixels are
            counted for coordinates. name: for messages. scale, unit: the side of a pixel, as 0.25 and "m".

    Convention: coordinates are (x, y) of the middle of a window from the upper left corner, in pixels or the
        unit.

    Raises:
        InputError: not (C,H,W) uint8, or windows that do not fit.

    Example:
        >>> grid = Grid(torch.zeros(3, 80, 100, dtype=torch.uint8), window=64, stride=8)
        >>> len(grid), grid.frame_shape, grid.area.rows, grid.area.columns
        (15, (3, 64, 64), 3, 5)
    """

    sized = True
    area: Area

    def __init__(
        self,
        picture: Tensor,
        window: int,
        stride: int,
        corner: tuple[int, int] = (0, 0),
        name: str = "the picture",
        scale: float = 1.0,
        unit: str = "px",
    ) -> None:
        seen = f"{name} is {tuple(picture.shape)} {picture.dtype}"
        expect(picture.ndim == 3 and picture.dtype == torch.uint8, "uint8 (C,H,W)", seen)
        height, width = picture.shape[1:]
        seen = f"{name} has {width} x {height} pixels, windows {window} and stride {stride}"
        expect(1 <= window <= min(height, width), f"windows of 1 to {min(height, width)} pixels", seen)
        expect(1 <= stride <= window, "a stride of 1 to the window's side, as others leave gaps", seen)
        self.name = name
        # (C,rows,columns,window,window), a view
        self.windows = picture.unfold(1, window, stride).unfold(2, window, stride)
        x, y, step = (scale * at for at in (corner[1] + window / 2, corner[0] + window / 2, stride))
        down, across = self.windows.shape[1:3]
        self.area = Area(down, across, (x, y), (step, 0.0), (0.0, step), unit)
        self.coordinates = Coordinates(self.area.coordinates(torch.arange(self.area.places)))

    def __len__(self) -> int:
        return self.area.places

    def read(self, frames: range | list[int]) -> Tensor:
        row, column = self.area.cells(torch.as_tensor(frames)).unbind(1)
        return self.windows[:, row, column].transpose(0, 1).float() / BYTES


def read_grid(
    path: Path, window: int = 64, stride: int = 8, scale: float = 1.0, rows: str = "", columns: str = ""
) -> Grid:
    """Windows of an image file.

    Args:
        window, stride: pixels, after scaling. scale: of the picture's sides, 0.5 halves them.
        rows, columns: "first:stop" of the pixels to keep after scaling; "" keeps all.
    """
    name = printable(path)
    picture = read_image(path)
    if not 0 < scale <= 1:
        raise InputError(f"{name}: scale is {scale:g}; expected a number above 0, and at most 1")
    if scale < 1:
        size = tuple(max(1, round(scale * side)) for side in picture.shape[1:])
        check_room(4 * picture.numel(), f"{name} in {size[1]} x {size[0]} pixels")
        picture = resize_frames(picture[None], (size[0], size[1]))[0].clamp(0, 1)
    bounds = [
        _bounds(name, which, text, picture.shape[axis])
        for axis, (which, text) in enumerate((("rows", rows), ("columns", columns)), 1)
    ]
    (top, bottom), (left, right) = bounds
    kept = (picture[:, top:bottom, left:right] * BYTES).round().byte()
    options = {"window": window, "stride": stride, "scale": f"{scale:g}", "rows": rows, "columns": columns}
    told = "&".join(f"{key}={value}" for key, value in options.items() if value not in ("", "1"))
    return Grid(kept, window, stride, (top, left), f"{name}?{told}")  # of a run that resumes, too


def _bounds(name: str, which: str, text: str, size: int) -> tuple[int, int]:
    """The first pixel to keep and the first behind it."""
    if not text:
        return 0, size
    first, stop = map(as_number, text.partition(":")[::2])
    if first is None or stop is None or first % 1 or stop % 1 or not 0 <= first < stop <= size:
        raise InputError(f"{name}: {which} {text}; expected first:stop inside 0:{size}")
    return int(first), int(stop)
