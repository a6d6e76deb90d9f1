"""Real footage that comes with the package: two flights over one road, `demo:road` and `demo:area`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from dejavu_torch.data.grid import Grid, read_grid
from dejavu_torch.data.strip import SlidingWindow, read_strip
from dejavu_torch.types import Traverse, expect

FOLDER = Path(__file__).parent / "road"
FLIGHTS = 2
ROWS, WIDTH = "32:128", 96  # of a frame, pixels


def open_road(traverse: int = 0) -> SlidingWindow:
    """A window of 96 x 96 pixels that slides along the road, 2697 frames (3,96,96), 12.5 cm apart.

    Args:
        traverse: the flight, 0 or 1; frame i of both shows place i to within three pixels.
    """
    expect(traverse in range(FLIGHTS), f"0 to {FLIGHTS - 1}", f"demo:road has traverse={traverse}")
    road = read_strip(FOLDER / f"flight_{traverse}.jpg", WIDTH, ROWS)
    road.name = f"demo:road?traverse={traverse}"
    road.places = torch.arange(len(road)).double()
    return road


def open_area(
    traverse: int = 0, window: int = 64, stride: int = 8, rows: str = "", columns: str = ""
) -> Grid:
    """The same road as an area: windows in rows and columns over a flight's picture of 160 x 2792 pixels.

    Args:
        traverse: the flight, 0 or 1; a pixel of both shows the same ground to within three pixels.
        window, stride: see `Grid`; pixels of 12.5 cm. rows, columns: see `read_picture`.
    """
    expect(traverse in range(FLIGHTS), f"0 to {FLIGHTS - 1}", f"demo:area has traverse={traverse}")
    area = read_grid(FOLDER / f"flight_{traverse}.jpg", window, stride, 1, rows, columns)
    area.name = f"demo:area?traverse={traverse}&{area.name.rpartition('?')[2]}"
    return area


DEMOS: dict[str, Callable[..., Traverse]] = {"area": open_area, "road": open_road}
