"""A folder of images as a traverse."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from decimal import Decimal
from fnmatch import fnmatch
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps, features
from torch import Tensor

from dejavu_torch.data.files import reading
from dejavu_torch.memory import check_room
from dejavu_torch.resize import MOST_PIXELS, is_stretched, resize_frames
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

NATURAL, LEXICOGRAPHIC = "natural", "lexicographic"  # orders of names
TIME = "time"  # order of photos by when they were taken
DRAWN, TIMELESS = 100, 3  # images whose times are compared with their names; first ones without that end it
EXIF, TAKEN, FRACTION = 0x8769, 36867, 37521  # the block of EXIF, DateTimeOriginal, SubSecTimeOriginal
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}
MAX_IMAGE_PIXELS = 2**28  # enough for a long strip; a small file can claim any number
ROUNDING = 1e-3  # by which a value may lie outside [0, 1]
FORMATS = "PNG", "JPEG", "BMP", "DIB", "TIFF", "WEBP", "PPM", "GIF", "AVIF", "HEIF"  # none starts a program
HEIF = {".heic", ".heif"}  # read by pillow-heif, if it is there
if features.check("avif"):
    IMAGE_SUFFIXES.add(".avif")
UNREAD = {".avif", *HEIF, ".gif", ".jp2", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw"}
BYTES_PER_PIXEL = 24  # peak while reading: decoded, as an array, and as floats


class ImageFolder(Traverse):
    """The images of a folder, sorted by name; numbers in names compare as numbers (9 before 10). If all names
    end in increasing numbers, such as frame_0001.png, the images are assumed to be in order along the route.

    Grey images have one channel, others three; all have those of the first, as where a camera turns to
    infrared at night. EXIF orientation is applied. A file's first image is read. A line tells of images that
    are left out: of formats that are not read, broken links, and those in folders inside.

    Args:
        width, height: pixels to resize to, antialiased; 0 for both keeps the size, for one the aspect ratio.
        order: "natural", as above, "lexicographic", by text (10 before 9), or "time", by when photos were
            taken, of EXIF; "" is natural with a warning if another differs.
        glob: only images whose names match it, such as "*.color.png"; "" is all.
        recursive: images in folders inside too, named by their path from here.

    Raises:
        InputError: width, height or order out of range; no such folder, or no images in it; while reading,
            an image that cannot be read or differs in size from the first.
    """

    def __init__(
        self,
        path: str | Path,
        width: int = 0,
        height: int = 0,
        order: str = "",
        glob: str = "",
        recursive: bool = False,
    ) -> None:
        folder = Path(path)
        check_size(folder, width, height)
        expect(folder.is_dir(), "a folder of images", f"{folder} is not there")
        inside = list(folder.rglob("*") if recursive else folder.iterdir())
        names = {file: file.relative_to(folder).as_posix() for file in inside}
        seen = [file for file in inside if "/." not in f"/{names[file]}"]
        suffixes = readable(file.suffix.lower() for file in seen)
        images = [file for file in seen if file.suffix.lower() in suffixes]
        images = [file for file in images if not glob or fnmatch(names[file], glob)]
        kept = [names[file] for file in images if file.is_file()]
        if order == TIME:
            self.names = _by_time(folder, sort_names(kept, NATURAL, printable(folder)))
        else:
            self.names = sort_names(kept, order, printable(folder))
        left = left_out([file for file in seen if not (recursive and file.is_dir())], suffixes)
        if not self.names:
            folders = sorted((file.name for file in inside if file.is_dir()), key=natural)
            inner = f" but folders such as {folders[0]}" if folders else f" but {left}" if left else ""
            inner = f" that match {glob}" if glob else inner
            raise InputError(f"{folder} contains no images{inner}; expected files such as .png or .jpg")
        if left:
            _warn_left_out(printable(folder), left)
        self.width, self.height, self.sized = width, height, bool(width or height)
        self.path, self.name = folder, printable(folder)
        self.ordered = order == TIME or numbers_increase(self.names)
        if not order:
            _warn_time(folder, self.names)
        self.same_aspect = False  # whether to refuse images of another aspect ratio, such as portraits
        self._first: tuple[str, str, tuple[int, int]] | None = None  # image read: name, shape, original size
        self._channels: int | None = None  # of the first image

    def __len__(self) -> int:
        return len(self.names)

    def read(self, frames: range | list[int]) -> Tensor:
        images = [self._image(self.path / self.names[i]) for i in frames]
        return images[0][None] if len(images) == 1 else torch.stack(images)

    def decoded_at(self, height: int, width: int) -> ImageFolder:
        """The images at a size in pixels that the user did not ask for."""
        return self.changed(height=height, width=width, sized=True, same_aspect=True, _first=None)

    def _image(self, file: Path) -> Tensor:
        image = read_image(file, max(self.width, self.height))
        if self._channels is None:
            self._channels = len(image)
            if file != self.path / self.names[0]:
                with suppress(InputError):  # it is told where it is asked for
                    self._channels = len(read_image(self.path / self.names[0], 1))
        if len(image) != self._channels:
            _warn_channels(self.name, len(image))
            image = image.expand(3, -1, -1) if self._channels == 3 else image.mean(0, keepdim=True)
        original = (image.shape[1], image.shape[2])
        size = fitted_size(file, *original, self.width, self.height)
        if size != image.shape[1:]:
            image = resize_frames(image[None], size)[0].clamp(0, 1)
        channels, height, width = image.shape
        shape = f"{height} x {width} pixels of {channels} channel{'s' * (channels > 1)}"
        self._first = self._first or (file.relative_to(self.path).as_posix(), shape, original)
        name, expected, first = self._first
        expect(shape == expected, f"{expected} like {name}", f"{file} is {shape}")
        if self.same_aspect and is_stretched(original, first):
            ratio = f"the aspect ratio of {name}, {first[0]} x {first[1]}"
            raise InputError(f"{file} is {original[0]} x {original[1]} pixels; expected {ratio}")
        return image

    @property
    def deep(self) -> bool:
        file = self.path / self.names[0]
        with (
            reading(file, "cannot be read as an image", "one"),
            Image.open(file, formats=formats()) as opened,
        ):
            return bool(opened.mode.startswith("I"))


def formats() -> list[str]:
    """Those of `FORMATS` that Pillow reads here."""
    Image.init()
    return [name for name in FORMATS if name in Image.OPEN]


def readable(suffixes: Iterable[str]) -> set[str]:
    """The suffixes of images that are read; of HEIF only if there are some, and pillow-heif is there."""
    return IMAGE_SUFFIXES | HEIF if not HEIF.isdisjoint(suffixes) and _has_heif() else IMAGE_SUFFIXES


@cache
def _has_heif() -> bool:
    try:
        import_module("pillow_heif").register_heif_opener()
    except ImportError:
        return False
    return True


def left_out(files: Iterable[Path], suffixes: set[str]) -> str:
    """The images that a folder of these files leaves out, in words; "" for none."""
    kinds: Counter[str] = Counter()
    for file in files:
        suffix = file.suffix.lower()
        if suffix in suffixes and file.is_symlink() and not file.exists():
            kinds["broken links"] += 1
        elif suffix in UNREAD - suffixes:
            kinds[suffix] += 1
        elif file.is_dir():
            with suppress(OSError):
                kinds["folders of images"] += any(one.suffix.lower() in suffixes for one in file.iterdir())
    one = {"broken links": "broken link", "folders of images": "folder of images"}
    found = [f"{n} {one.get(kind, kind) if n == 1 else kind}" for kind, n in sorted(kinds.items()) if n]
    return " and ".join([", ".join(found[:-1]), found[-1]] if len(found) > 1 else found)


@cache  # a command may open a source several times
def _warn_left_out(source: str, left: str) -> None:
    remedy = "; pip install 'dejavu_torch[heif]' reads .heic" * (".heic" in left)
    log.warning("%s: %s are left out%s", source, left, remedy)


@cache
def _warn_channels(source: str, channels: int) -> None:
    seen = "grey images are read as colour" if channels == 1 else "images in colour are read as grey"
    log.warning("%s: %s, as the first image is", source, seen)


def taken(file: Path) -> str:
    """When a photo was taken, as text that sorts by time; "" if its EXIF does not say."""
    with suppress(Exception), Image.open(file, formats=formats()) as opened:  # decoders raise anything
        block = opened.getexif().get_ifd(EXIF)
        if time := str(block.get(TAKEN, "")).strip(" \0"):
            return f"{time}.{block.get(FRACTION, '')}"
    return ""


def _by_time(folder: Path, names: list[str]) -> list[str]:
    times = {name: taken(folder / name) for name in names}
    timeless = [name for name in names if not times[name]]
    if timeless:
        seen = f"{printable(folder)}: {len(timeless)} of {len(names)} images, such as {timeless[0]}"
        raise InputError(f"{seen}, do not tell when they were taken; expected order=natural")
    return sorted(names, key=times.__getitem__)


def _warn_time(folder: Path, names: Sequence[str]) -> None:
    """Tell of photos whose names are in another order than they were taken, as after DSC_9999."""
    drawn = [names[i * (len(names) - 1) // max(1, DRAWN - 1)] for i in range(DRAWN)] if names else []
    known: list[tuple[str, str]] = []
    for seen, name in enumerate(dict.fromkeys(drawn)):
        if seen == TIMELESS and not known:
            return
        known += [(time, name)] if (time := taken(folder / name)) else []
    for (before, one), (after, two) in pairwise(known):
        if after < before:
            _warn_taken(printable(folder), f"{one} was taken after {two}")
            return


@cache
def _warn_taken(source: str, example: str) -> None:
    log.warning("%s is in the order of its names, but %s; ?order=%s follows the times", source, example, TIME)


def check_size(path: Path, width: int, height: int) -> None:
    """Refuse a size in pixels that is negative or too large; 0 keeps the frames' own."""
    if min(width, height) < 0 or max(width, height) > MOST_PIXELS:
        expected = f"width and height of at least 0 each, at most {MOST_PIXELS} pixels"
        raise InputError(f"{path}: width={width}, height={height}; expected {expected}")


def check_pixels(path: Path, rows: int, columns: int, most: int) -> None:
    """Refuse more pixels than `most` or than fit in memory, before allocating them."""
    seen = f"{path} has {rows} x {columns} pixels"
    expect(rows * columns <= most, f"at most {most}", seen)
    check_room(BYTES_PER_PIXEL * rows * columns, f"{seen}, which")


def fitted_size(path: Path, rows: int, columns: int, width: int, height: int) -> tuple[int, int]:
    """(rows, columns) after resizing to width and height; 0 for both keeps the size, for one the aspect."""
    wide = width or (max(1, round(columns * height / rows)) if height else columns)
    high = height or (max(1, round(rows * width / columns)) if width else rows)
    if (high, wide) != (rows, columns) and high * wide > MOST_PIXELS:
        raise InputError(f"{path} resized has {high} x {wide} pixels; expected at most {MOST_PIXELS}")
    return high, wide


def read_image(path: Path, least: int = 0) -> Tensor:
    """One image file as (C,H,W) float32 in [0, 1]; C is 1 for grey images, else 3.

    Args:
        least: minimum pixels of each side: a JPEG is decoded at 1/2, 1/4 or 1/8 of its size if that has as
            many, as the image is reduced afterwards. 0 decodes at full size.

    Raises:
        InputError: not an image, over 2^28 pixels, more than fit in memory, or values outside [0, 1].
    """
    unread, expected = "cannot be read as an image", "an image such as .png or .jpg"
    with reading(path, unread, expected), Image.open(path, formats=formats()) as opened:
        if least:
            opened.draft(None, (least, least))
        check_pixels(path, opened.height, opened.width, MAX_IMAGE_PIXELS)
        ImageOps.exif_transpose(opened, in_place=True)
        mode = opened.mode
        wide = mode.startswith(("I", "F"))  # 16-bit grey, or floats already in [0, 1]
        plain = mode if wide else "L" if mode in ("1", "L", "LA") else "RGB"
        pixels = np.asarray(opened if mode == plain else opened.convert(plain))
    if wide:
        return _levels(path, pixels)[None]
    # transposing bytes, not floats, keeps the peak of memory low
    channels = np.array(pixels.reshape(*pixels.shape[:2], -1).transpose(2, 0, 1), order="C")
    return torch.from_numpy(channels).float().div_(255)


def _levels(path: Path, pixels: np.ndarray) -> Tensor:
    """Pixels of 16 bits, or floats already in [0, 1], as float32 in [0, 1]."""
    floats = pixels.dtype.kind == "f"
    image = torch.from_numpy(pixels.astype(np.float32)).div_(1 if floats else 65535)
    low, high = image.aminmax()
    slack = ROUNDING if floats else 0
    if not (low >= -slack and high <= 1 + slack):  # also True for NaN
        raise InputError(f"{path} has values from {low:.4g} to {high:.4g} (1 is white); expected 0 to 1")
    return image.clamp_(0, 1)


def as_bytes(path: Path, pixels: np.ndarray) -> Tensor:
    """Pixels of 8 or 16 bits, or floats in [0, 1], as uint8 of the same shape; InputError for others."""
    known = pixels.dtype.kind in "uif" and pixels.dtype != np.int8
    expect(known, "uint8, 16 bits, or floats", f"{path} has pixels of {pixels.dtype}")
    if pixels.dtype == np.uint8:
        return torch.from_numpy(np.array(pixels, order="C"))
    return (_levels(path, pixels) * 255).round().byte()


def natural(name: str) -> tuple[list[str | int], str]:
    """A sort key that compares numbers in names as numbers."""
    parts = re.split(r"(\d+)", name)  # digits at odd positions: numbers are compared only with numbers
    return [int(part) if j % 2 else part for j, part in enumerate(parts)], name


def sort_names(names: Iterable[str], order: str, source: str) -> list[str]:
    """The names of images sorted by the `order` of `ImageFolder`; `source` is for messages."""
    if order not in ("", NATURAL, LEXICOGRAPHIC):
        raise InputError(f"{source}: order is {order!r}; expected {NATURAL} or {LEXICOGRAPHIC}")
    by_number = sorted(names, key=natural)
    by_text = sorted(by_number)
    differing = [f"{a} before {b}" for a, b in zip(by_number, by_text, strict=True) if a != b]
    if differing and not order:
        _warn_order(source, differing[0])
    return by_text if order == LEXICOGRAPHIC else by_number


@cache  # a command may open a source several times
def _warn_order(source: str, example: str) -> None:
    remedies = f"?order={LEXICOGRAPHIC} sorts by text, ?order={NATURAL} hides this warning"
    log.warning("%s is in natural order, %s; %s", source, example, remedies)


def numbers_increase(names: Sequence[str]) -> bool:
    """Whether all names, without their suffixes, end in increasing numbers, such as 0012 or times with
    decimals."""
    found = [re.search(r"\d{1,99}(\.\d{1,99})?$", Path(name).stem) for name in names]
    numbers = [Decimal(number[0]) for number in found if number]  # exact: floats lose digits of times
    return len(numbers) == len(names) and all(a < b for a, b in pairwise(numbers))
