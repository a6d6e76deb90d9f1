"""Windows over a picture of the ground, in rows and columns: an area as a reference."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import pad

from dejavu_torch.data.picture import Pixels, read_picture
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.rectangles import Ground
from dejavu_torch.text import printable
from dejavu_torch.types import Coordinates, Traverse, expect

BYTES = 255
PIXELS = Ground()


class Grid(Traverse):
    """Square windows of a picture, in the order of the places of a `Layout`.

    Args:
        picture: (C,H,W) uint8. window: side of a window, pixels. stride: pixels from one to the next, in both
            directions. corner: (row, column) of the picture's first pixel in a larger one, whose pixels are
            counted for coordinates. name: for messages. ground: where the larger picture lies; by default
            coordinates are pixels from its upper left corner.

    Convention: coordinates are (x, y) of the middle of a window.

    Raises:
        InputError: not (C,H,W) uint8, or windows that do not fit.

    Example:
        >>> grid = Grid(torch.zeros(3, 80, 100, dtype=torch.uint8), window=64, stride=8)
        >>> len(grid), grid.frame_shape, grid.layout.rows, grid.layout.columns
        (15, (3, 64, 64), 3, 5)
    """

    sized = True

    def __init__(
        self,
        picture: Pixels,
        window: int,
        stride: int,
        corner: tuple[int, int] = (0, 0),
        name: str = "the picture",
        ground: Ground = PIXELS,
    ) -> None:
        seen = f"{name} is {tuple(picture.shape)} {picture.dtype}"
        expect(picture.ndim == 3 and picture.dtype == torch.uint8, "uint8 (C,H,W)", seen)
        height, width = picture.shape[1:]
        seen = f"{name} has {width} x {height} pixels, windows {window} and stride {stride}"
        expect(1 <= window <= min(height, width), f"windows of 1 to {min(height, width)} pixels", seen)
        expect(1 <= stride <= window, "a stride of 1 to the window's side, as others leave gaps", seen)
        self.name, self.picture, self.window, self.stride = name, picture, window, stride
        middle = torch.tensor([corner[1] + window / 2, corner[0] + window / 2], dtype=torch.float64)
        x, y = ground.at(middle).tolist()
        steps = ground.scaled(stride, stride)
        down, across = ((side - window) // stride + 1 for side in (height, width))
        self.layout = Layout(down, across, (x, y), steps.right, steps.down, ground.unit, ground.frame)
        every = self.layout.coordinates(torch.arange(self.layout.places))
        self.coordinates = Coordinates(every, frame=ground.frame)

    def __len__(self) -> int:
        return self._layout.places

    def around(self, first: tuple[int, int], shape: tuple[int, int], margin: int) -> Tensor:
        """The pixels of some rows and columns of windows from the first one on, and a margin around them,
        (1,C,H,W) float in [0, 1]. Beyond the picture its border is repeated."""
        inside, beyond = list[slice](), list[int]()
        for start, count, side in zip(first, shape, self.picture.shape[1:], strict=True):
            low = start * self.stride - margin
            high = low + (count - 1) * self.stride + self.window + 2 * margin
            inside.append(slice(max(0, low), min(side, high)))
            beyond = [max(0, -low), max(0, high - side), *beyond]
        pixels = self.picture[:, inside[0], inside[1]].float() / BYTES
        return pad(pixels[None], beyond, mode="replicate")

    def read(self, frames: range | list[int]) -> Tensor:
        corners = (self.layout.cells(torch.as_tensor(frames)) * self.stride).tolist()
        side = self.window
        return torch.stack([self.picture[:, y : y + side, x : x + side] for y, x in corners]).float() / BYTES


def read_grid(
    path: Path, window: int = 64, stride: int = 8, scale: float = 1.0, rows: str = "", columns: str = ""
) -> Grid:
    """Windows of an image file.

    Args:
        window, stride: pixels, after scaling. scale, rows, columns: see `read_picture`.
    """
    picture, corner, ground = read_picture(path, scale, rows, columns)
    options = {"window": window, "stride": stride, "scale": f"{scale:g}", "rows": rows, "columns": columns}
    told = "&".join(f"{key}={value}" for key, value in options.items() if value not in ("", "1"))
    name = f"{printable(path)}?{told}"  # of a run that resumes, too
    return Grid(picture, window, stride, corner, name, ground)
