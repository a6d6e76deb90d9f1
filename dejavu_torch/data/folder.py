"""A folder of images as a traverse."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from dejavu_torch.types import InputError, Traverse

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


class ImageFolder(Traverse):
    """The images of a folder, sorted by name; numbers in names count as numbers (9 before 10).

    Grey images give one channel, all others three.

    Raises:
        InputError: no such folder, or no images in it; while reading, an image that cannot be read or
            that has another size than the first.
    """

    def __init__(self, path: str | Path) -> None:
        folder = Path(path)
        if not folder.is_dir():
            raise InputError(f"{folder} is not there; expected a folder of images")
        files = [
            file
            for file in folder.iterdir()
            if file.suffix.lower() in SUFFIXES and file.is_file() and file.name[0] != "."
        ]
        if not files:
            raise InputError(f"{folder} holds no images; expected files such as .png or .jpg")
        self.files = sorted(files, key=lambda file: _natural(file.name))
        self.name = str(folder)
        self.length = len(self.files)

    def batches(self, size: int) -> Iterator[Tensor]:
        first: Tensor | None = None
        for start in range(0, len(self.files), size):
            frames = []
            for file in self.files[start : start + size]:
                frame = read_image(file)
                first = frame if first is None else first
                if frame.shape != first.shape:
                    raise InputError(
                        f"{file} is {_shape(frame)}; expected {_shape(first)} as {self.files[0].name}"
                    )
                frames.append(frame)
            yield torch.stack(frames)


def read_image(path: Path) -> Tensor:
    """One image file as (C,H,W) float32 in [0, 1]; C is 1 for grey images, else 3.

    Raises:
        InputError: the file cannot be read as an image.
    """
    try:
        with Image.open(path) as image:
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
