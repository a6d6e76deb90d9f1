"""A folder of images as a traverse."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor
from torch.nn.functional import interpolate

from dejavu_torch.types import InputError, Traverse

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


class ImageFolder(Traverse):
    """The images of a folder, sorted by name; numbers in names count as numbers (9 before 10).

    Grey images give one channel, all others three; a camera held upright is turned as its image says.

    Args:
        path: the folder.
        width, height: pixels to resize each image to as it is read, antialiased; 0 keeps the image's
            own, or its aspect ratio where only the other is given.
        step: every step-th image, from the first.
        start, stop: the images [start, stop) only, counted from 0; a stop of 0 is the end.

    Raises:
        InputError: width, height, step, start or stop out of range; no such folder, or no images in it; while
            reading, an image that cannot be read or that has another size than the first.
    """

    def __init__(
        self, path: str | Path, width: int = 0, height: int = 0, step: int = 1, start: int = 0, stop: int = 0
    ) -> None:
        folder = Path(path)
        if width < 0 or height < 0 or step < 1:
            raise InputError(
                f"{path}: width={width}, height={height}, step={step}; "
                "expected width and height of at least 0, and step of at least 1"
            )
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
        stop = stop or len(files)
        if not 0 <= start < stop <= len(files):
            raise InputError(
                f"{path}: start={start}, stop={stop}; expected start < stop within its {len(files)} images"
            )
        self.files = sorted(files, key=lambda file: _natural(file.name))[start:stop:step]
        self.width, self.height = width, height
        self.name = str(folder) if stop - start == len(files) else f"{folder}?start={start}&stop={stop}"
        self.length = len(self.files)

    def batches(self, size: int) -> Iterator[Tensor]:
        first: Tensor | None = None
        for start in range(0, len(self.files), size):
            frames = []
            for file in self.files[start : start + size]:
                frame = self._resized(read_image(file))
                first = frame if first is None else first
                if frame.shape != first.shape:
                    raise InputError(
                        f"{file} is {_shape(frame)}; expected {_shape(first)} as {self.files[0].name}"
                    )
                frames.append(frame)
            yield torch.stack(frames)

    def _resized(self, frame: Tensor) -> Tensor:
        h, w = frame.shape[1:]
        width = self.width or (max(1, round(w * self.height / h)) if self.height else w)
        height = self.height or (max(1, round(h * self.width / w)) if self.width else h)
        if (height, width) == (h, w):
            return frame
        small = interpolate(frame[None], (height, width), mode="bilinear", antialias=True)[0]
        return small.clamp(0, 1)


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


def _shape(frame: Tensor) -> str:
    channels, height, width = frame.shape
    return f"{height} x {width} pixels of {channels} channel{'s' * (channels > 1)}"
