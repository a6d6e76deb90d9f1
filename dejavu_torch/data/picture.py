"""Pictures of the ground, read and reduced in parts."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from PIL import Image, ImageOps
from torch import Tensor

from dejavu_torch.data.files import as_number, reading
from dejavu_torch.data.folder import as_bytes, formats
from dejavu_torch.data.geotiff import GeoTiff, has_rasterio
from dejavu_torch.memory import check_room, without_autocast
from dejavu_torch.places.rectangles import Ground
from dejavu_torch.text import printable
from dejavu_torch.types import Facts, InputError

log = logging.getLogger("dejavu_torch")

SIDE_READ = 512  # pixels of the file to a side that are read together
HELD = 2**27  # bytes of them that are kept
BYTES_PER_PIXEL = 8.0  # peak while a picture is decoded whole
TIFF, ORIENTATION, GEOREFERENCED = {".tif", ".tiff"}, 274, {33550, 34264}  # tags; size of a pixel, a matrix

Read: TypeAlias = Callable[[int, int, int, int], Tensor]


class PictureFile:
    """A picture that is read where it is indexed, `picture[:, 10:74, 20:84]`, as a tensor (C,H,W) uint8 is.

    Args:
        shape: (C,H,W) of the file. read: (top, bottom, left, right) -> its pixels (C,h,w) uint8. scale: of
            its sides, at most 1.

    Convention: reduced as by `resize_frames`, equally whichever part is read. About `SIDE_READ` pixels of the
        file to a side are read together; the last ones are kept.
    """

    ndim, dtype = 3, torch.uint8

    def __init__(self, shape: tuple[int, int, int], read: Read, scale: float = 1.0) -> None:
        self.size = shape[1:]
        self.full = [max(1, round(scale * side)) for side in self.size]
        self.factor = [one / other for one, other in zip(self.size, self.full, strict=True)]
        self.shape, self.corner = torch.Size((shape[0], *self.full)), (0, 0)
        self.side, self.read = max(8, round(SIDE_READ * scale)), read
        self._blocks: dict[tuple[int, int], Tensor] = {}

    def __getstate__(self) -> Facts:
        return self.__dict__ | {"_blocks": {}}

    def part(self, top: int, bottom: int, left: int, right: int) -> PictureFile:
        """The pixels of some rows and columns."""
        other = copy.copy(self)
        other.corner = self.corner[0] + top, self.corner[1] + left
        other.shape = torch.Size((self.shape[0], bottom - top, right - left))
        return other

    def __getitem__(self, index: tuple[slice, slice, slice]) -> Tensor:
        (top, bottom), (left, right) = (
            (first + one.start, first + one.stop) for first, one in zip(self.corner, index[1:], strict=True)
        )
        out = torch.empty(self.shape[0], bottom - top, right - left, dtype=torch.uint8)
        for y in range(top - top % self.side, bottom, self.side):
            for x in range(left - left % self.side, right, self.side):
                a, b, c, d = max(top, y), min(bottom, y + self.side), max(left, x), min(right, x + self.side)
                block = self._block(y, x)[:, a - y : b - y, c - x : d - x]
                out[:, a - top : b - top, c - left : d - left] = block
        return out

    def _block(self, y: int, x: int) -> Tensor:
        block = self._blocks.pop((y, x), None)
        if block is None:
            (rows, down), (columns, across) = (
                _means(first, min(first + self.side, full), factor, size)
                for first, full, factor, size in zip((y, x), self.full, self.factor, self.size, strict=True)
            )
            block = self.read(rows.start, rows.stop, columns.start, columns.stop)
            if self.factor != [1, 1]:
                block = _reduced(down, block, across)
            while len(self._blocks) * self.shape[0] * self.side**2 > HELD:
                del self._blocks[next(iter(self._blocks))]
        self._blocks[y, x] = block  # the last to go
        return block


def _means(first: int, stop: int, factor: float, size: int) -> tuple[range, Tensor]:
    """The pixels of a line of `size` whose means the reduced ones [first, stop) are, and their weights (n,m):
    a triangle over `factor` pixels to both sides."""
    centre = ((torch.arange(first, stop, dtype=torch.float64) + 0.5) * factor)[:, None]
    begin, end = int(centre[0] - factor + 0.5), math.ceil(centre[-1] + factor - 0.5)
    pixels = range(max(0, begin), min(size, end))
    weight = (1 - (torch.tensor(pixels) + 0.5 - centre).abs() / factor).clamp(min=0)
    return pixels, (weight / weight.sum(1, keepdim=True)).float()


@without_autocast
def _reduced(down: Tensor, pixels: Tensor, across: Tensor) -> Tensor:
    return (down @ pixels.float() @ across.T).round().byte()


Pixels: TypeAlias = Tensor | PictureFile  # (C,H,W) uint8


def read_picture(
    path: Path, scale: float = 1.0, rows: str = "", columns: str = ""
) -> tuple[Pixels, tuple[int, int], Ground]:
    """The pixels of an image file, the first one's row and column, and where the whole picture lies.

    A TIFF is read in parts if rasterio is installed, others at once. What is transparent is black. Rows on
    the ground are in the order that does not mirror it.

    Args:
        scale: of the sides. rows, columns: "first:stop" of the pixels to keep after scaling; "" keeps all.

    Raises:
        InputError: no image, one that does not fit in memory, or options out of range; values outside [0, 1],
            of parts when they are read.
    """
    name = printable(path)
    if not 0 < scale <= 1:
        raise InputError(f"{name}: scale is {scale:g}; expected a number above 0, and at most 1")
    orientation = _orientation(path) if path.suffix.lower() in TIFF and has_rasterio() else 0
    tiff = GeoTiff(path) if orientation else None
    in_parts = tiff if tiff and tiff.plain and (tiff.ground or orientation == 1) else None
    picture = PictureFile(in_parts.shape, in_parts, scale) if in_parts else _decoded(path, scale, tiff)
    ground = tiff.ground.scaled(*picture.factor[::-1]) if tiff and tiff.ground else Ground()
    (x, y), (a, b), (c, d), unit, _ = ground
    if unit == "m" and a * d > b * c:  # its first row is below
        high = picture.full[0]
        ground = ground._replace(first=(x + high * c, y + high * d), down=(-c, -d))
        picture.read = partial(_from_below, picture.read, picture.size[0])
    bounds = (
        _bounds(name, *one) for one in zip(("rows", "columns"), (rows, columns), picture.full, strict=True)
    )
    (top, bottom), (left, right) = bounds
    part = picture.part(top, bottom, left, right)
    pixels = part if in_parts else part[:, 0 : bottom - top, 0 : right - left]
    return pixels, (top, left), ground


def _from_below(read: Read, height: int, top: int, bottom: int, left: int, right: int) -> Tensor:
    return read(height - bottom, height - top, left, right).flip(1)


def _orientation(path: Path) -> int:
    """The tag of a TIFF, 1 if its pixels are stored upright; 0 of an image of another format."""
    with suppress(InputError), _opened(path) as image:
        return int(image.getexif().get(ORIENTATION, 1)) if image.format == "TIFF" else 0
    return 1  # rasterio reads what Pillow does not


def _decoded(path: Path, scale: float, tiff: GeoTiff | None) -> PictureFile:
    """An image file that Pillow decodes whole."""
    with _opened(path) as image:
        width, height = image.size
        check_room(BYTES_PER_PIXEL * width * height, f"{path} of {width} x {height} pixels")
        if tiff is None and not GEOREFERENCED.isdisjoint(getattr(image, "tag_v2", ())):
            _warn_pixels(printable(path))
        if tiff is None or tiff.ground is None:
            ImageOps.exif_transpose(image, in_place=True)
        image.load()
    wide, alpha = image.mode.startswith(("I", "F")), image.has_transparency_data
    plain = image.mode if wide else "L" if image.mode in ("1", "L", "LA") else "RGB"

    def read(top: int, bottom: int, left: int, right: int) -> Tensor:
        part = image.crop((left, top, right, bottom))
        pixels = np.atleast_3d(np.asarray(part if wide else part.convert(plain)))
        if alpha and not wide:
            pixels = pixels * (np.asarray(part.convert("RGBA"))[..., 3:] > 0)
        return as_bytes(path, pixels.transpose(2, 0, 1))

    return PictureFile((3 if plain == "RGB" else 1, image.height, image.width), read, scale)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image of any number of pixels: they are refused by their bytes."""
    unread, expected = "cannot be read as an image", "an image such as .png or .jpg"
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with reading(path, unread, expected), Image.open(path, formats=formats()) as image:
            yield image
    finally:
        Image.MAX_IMAGE_PIXELS = limit


@cache  # a command may open a source several times
def _warn_pixels(name: str) -> None:
    log.warning("%s: coordinates are in pixels; pip install 'dejavu_torch[geo]' reads its metres", name)


def _bounds(name: str, which: str, text: str, size: int) -> tuple[int, int]:
    """The first pixel to keep and the first behind it."""
    if not text:
        return 0, size
    first, stop = map(as_number, text.partition(":")[::2])
    if first is None or stop is None or first % 1 or stop % 1 or not 0 <= first < stop <= size:
        raise InputError(f"{name}: {which} {text}; expected first:stop inside 0:{size}")
    return int(first), int(stop)
