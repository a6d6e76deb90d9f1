"""SOURCE, as every command takes it: a text -> a Traverse."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from dejavu_torch.data.arrays import names_beside, read_array
from dejavu_torch.data.folder import SUFFIXES, ImageFolder, natural
from dejavu_torch.data.frame_range import FrameRange
from dejavu_torch.data.h5 import SUFFIXES as H5_SUFFIXES
from dejavu_torch.data.h5 import DescriptorFile
from dejavu_torch.data.simulate import SIMULATORS
from dejavu_torch.data.strip import read_strip
from dejavu_torch.data.video import SUFFIXES as VIDEO_SUFFIXES
from dejavu_torch.data.video import Video
from dejavu_torch.types import InputError, Traverse

KINDS = {int: "integer", float: "floating-point number"}  # what the values of options are
PART = {"start": 0, "stop": 0, "step": 1}  # options of every source, see `FrameRange`
EXPECTED = (
    "a folder of images or a video, such as clip.mp4?width=160, an .npy file of frames or features, an .h5 "
    "file of hloc's descriptors, "
    "sim:aerial?seed=0&traverse=0&frames=3072, sim:outdoor, sim:underground, or strip:IMAGE?width=96"
)


def open_source(source: str | Path, size: tuple[int, int] | None = None) -> Traverse:
    """Open what a command was given to read.

    Args:
        source: a folder of images (sorted by name, see `ImageFolder`), `photos`,
            `photos?width=160&height=90` or `photos?order=lexicographic`; a video file, `clip.mp4` or with
            the same width and height; an `.npy` file of frames (N,H,W) or (N,H,W,3) uint8, or of features
            (N,D) float, with the names of their images in an `.txt` file beside it; an `.h5` file of hloc's
            global descriptors, also with `order=`; `sim:NAME?seed=0&traverse=0&frames=3072`, NAME being
            aerial, outdoor or underground; or `strip:IMAGE?width=96&rows=32:128&halve=1&grey=1`, a window
            slid along one long image. Of all of them `start=`, `stop=` and `step=` take the frames
            [start, stop) only, every step-th of them.
        size: (height, width) in pixels that images of a folder and frames of a video are brought to where
            the source names neither.

    Raises:
        InputError: missing, empty, or nothing that can be read.

    Example:
        >>> open_source("sim:aerial?frames=40&traverse=1").length
        40
        >>> open_source("sim:aerial?frames=40&start=10&step=3").length
        10
    """
    text = str(source)
    address, query = _split(text)
    reader = _reader(text, address)
    arguments = _arguments(text, query, reader)
    part = {name: arguments.pop(name) for name in PART if name in arguments}
    resizes = getattr(reader, "func", None) in (ImageFolder, Video)
    if size is not None and resizes and not {"height", "width"} & arguments.keys():
        arguments["height"], arguments["width"] = size
    return FrameRange(reader(**arguments), **part) if part else reader(**arguments)


def routes_of(source: str | Path) -> list[str]:
    """The routes that a source holds: of a folder of nothing but folders each of these, else the source.

    They are sorted by name as images are; options behind a folder are those of each route.
    """
    address, query = _split(str(source))
    path = Path(address)
    inside: list[Path] = []
    with suppress(OSError, ValueError):  # none, or one that can be no path
        inside = [one for one in path.iterdir() if one.name[0] != "."] if address else []
    if not inside or not all(one.is_dir() for one in inside):
        return [str(source)]
    options = f"?{query}" if query else ""
    return [f"{one}{options}" for one in sorted(inside, key=lambda one: natural(one.name))]


def check_not_read(out: Path, *sources: str | Path | None) -> None:
    """Refuse an output that is what a command reads, be it an image of a folder or the names beside an array:
    it would be lost.

    `sources` are as of `open_source`, or any other text; a path counts, though nothing may be there yet.
    """
    for source in filter(None, sources):
        place = Path(_split(str(source))[0].removeprefix("strip:"))
        read = False
        with suppress(OSError, ValueError, RuntimeError):  # one is not there, no path, or links to itself
            names = [names_beside(place)] if place.suffix.lower() == ".npy" else []
            read = any(out.resolve() == one.resolve() for one in (place, *names)) or out.samefile(place)
            read = read or (out.suffix.lower() in SUFFIXES and out.parent.samefile(place))
        if read:
            raise InputError(f"{out} is what is read; expected another name")


def _split(text: str) -> tuple[str, str]:
    """The address of a source, and its options."""
    prefixed = text.startswith(("sim:", "strip:"))
    if "?" not in text or (not prefixed and os.path.exists(text)):  # False also of what can be no path
        return text, ""
    address, _, query = text.partition("?") if prefixed else text.rpartition("?")
    return address, query


def _reader(text: str, address: str) -> Callable[..., Traverse]:
    """What opens an address, its options left open."""
    kind, colon, name = address.partition(":")
    if kind + colon == "sim:":
        if name not in SIMULATORS:
            raise InputError(f"there is no simulator {name!r}; expected {', '.join(sorted(SIMULATORS))}")
        return SIMULATORS[name]
    if kind + colon == "strip:":
        return partial(read_strip, Path(name))
    path = Path(address)
    if not address or not os.path.exists(path):
        raise InputError(f"{text or 'a source without a name'} is not there; expected {EXPECTED}")
    if path.is_dir():
        return partial(ImageFolder, path)
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return partial(Video, path)
    if suffix == ".npy":
        return partial(read_array, path)
    if suffix in H5_SUFFIXES:
        return partial(DescriptorFile, path)
    seen = "a single image" if suffix in SUFFIXES else "none of the kinds that can be read"
    raise InputError(f"{path} is {seen}; expected {EXPECTED}")


def _arguments(text: str, query: str, reader: Callable[..., Traverse]) -> dict[str, Any]:
    """`a=1&b=2` as keyword arguments of the reader, and as the part to read, each of its default's type."""
    empty = inspect.Parameter.empty
    defaults = {name: option.default for name, option in inspect.signature(reader).parameters.items()} | PART
    given: dict[str, Any] = {}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in defaults or name in given:
            what = "a second" if name in given else "unknown"
            raise InputError(f"{text}: {what} {name!r}; expected {', '.join(defaults)}")
        default = defaults[name]
        kind = int if default is empty or isinstance(default, bool) else type(default)
        try:
            given[name] = kind(value)
        except ValueError as error:
            raise InputError(f"{text}: {name} is {value!r}; expected {KINDS[kind]}") from error
    for name, default in defaults.items():
        if default is empty and name not in given:
            raise InputError(f"{text}: {name} is missing; expected {name}=...")
    return given
