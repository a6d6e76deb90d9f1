"""A folder of images as a traverse."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from dejavu_torch.data.frame_range import IndexedTraverse
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import InputError

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


class ImageFolder(IndexedTraverse):
    """The images of a folder, sorted by name; numbers in names count as numbers (9 before 10).

    Grey images give one channel, all others three; an image that says how the camera was turned is upright.

    Args:
        path: the folder.
        width, height: pixels to resize each image to as it is read, antialiased; 0 keeps the image's
            own, or its aspect ratio where only the other is given.

    Raises:
        InputError: width or height out of range; no such folder, or no images in it; while reading, an image
            that cannot be read or that has another size than the first.
    """

    def __init__(self, path: str | Path, width: int = 0, height: int = 0) -> None:
        folder = Path(path)
        check_size(folder, width, height)
        if not folder.is_dir():
            raise InputError(f"{folder} is not there; expected a folder of images")
        files = [
            file
            for file in folder.iterdir()
            if file.suffix.lower() in SUFFIXES and file.is_file() and file.name[0] != "."
        ]
        if not files:
            inner = next(
                (f"; it has folders such as {file.name}" for file in folder.iterdir() if file.is_dir()), ""
            )
            raise InputError(f"{folder} holds no images{inner}; expected files such as .png or .jpg")
        self.files = sorted(files, key=lambda file: _natural(file.name))
        self.width, self.height = width, height
        self.name = str(folder)
        self.length = len(self.files)
        self._first: tuple[str, str] | None = None  # name and shape of the first image that was read

    def read(self, frames: range) -> Tensor:
        return torch.stack([self._image(self.files[i]) for i in frames])

    def frame_name(self, i: int) -> str:
        return self.files[i].name

    def _image(self, file: Path) -> Tensor:
        image = read_image(file)
        size = fitted_size(image.shape[1], image.shape[2], self.width, self.height)
        if size != image.shape[1:]:
            image = resize_frames(image[None], size)[0].clamp(0, 1)
        channels, height, width = image.shape
        shape = f"{height} x {width} pixels of {channels} channel{'s' * (channels > 1)}"
        self._first = self._first or (file.name, shape)
        if shape != self._first[1]:
            raise InputError(f"{file} is {shape}; expected {self._first[1]} as {self._first[0]}")
        return image


def check_size(path: Path, width: int, height: int) -> None:
    """Refuse a size in pixels below 0, which stands for the frames' own."""
    if width < 0 or height < 0:
        raise InputError(f"{path}: width={width}, height={height}; expected width and height of at least 0")


def fitted_size(rows: int, columns: int, width: int, height: int) -> tuple[int, int]:
    """(rows, columns) of frames resized to width and height; 0 is their own, or what keeps their aspect.

    Example:
        >>> fitted_size(40, 60, width=30, height=0)
        (20, 30)
    """
    wide = width or (max(1, round(columns * height / rows)) if height else columns)
    high = height or (max(1, round(rows * width / columns)) if width else rows)
    return high, wide


def read_image(path: Path) -> Tensor:
    """One image file as (C,H,W) float32 in [0, 1]; C is 1 for grey images, else 3.

    Raises:
        InputError: the file cannot be read as an image.
    """
    try:
        with Image.open(path) as opened:
            image = ImageOps.exif_transpose(opened)
            if image.mode.startswith(("I", "F")):  # 16-bit grey, or floats that are in [0, 1] already
                scale = 65535 if image.mode.startswith("I") else 1
                pixels = np.asarray(image, dtype=np.float32)[..., None] / scale
            else:
                pixels = np.asarray(image.convert("L" if image.mode in ("1", "L", "LA") else "RGB"))
                pixels = pixels.reshape(*pixels.shape[:2], -1).astype(np.float32) / 255
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read as an image: {' '.join(str(error).split())}") from error
    return torch.from_numpy(pixels).permute(2, 0, 1)


def _natural(name: str) -> tuple[list[str | int], str]:
    # odd positions are the digit runs, so that numbers only ever meet numbers
    parts = re.split(r"(\d+)", name)
    return [int(part) if j % 2 else part for j, part in enumerate(parts)], name
