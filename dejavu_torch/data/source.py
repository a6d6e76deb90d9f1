"""Opens the SOURCE argument of the commands as a Traverse."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeAlias
from urllib.parse import parse_qsl

import numpy as np
from torch import Tensor
from torch.utils.data import Dataset

from dejavu_torch.data.arrays import ArrayTraverse, read_array
from dejavu_torch.data.coordinates import read_coordinates
from dejavu_torch.data.demo import DEMOS
from dejavu_torch.data.files import as_number
from dejavu_torch.data.flight import read_flight
from dejavu_torch.data.folder import IMAGE_SUFFIXES, ImageFolder, natural, read_image
from dejavu_torch.data.grid import read_grid
from dejavu_torch.data.h5 import H5_SUFFIXES, DescriptorFile
from dejavu_torch.data.simulate import SIMULATED
from dejavu_torch.data.strip import read_strip
from dejavu_torch.data.traverse import Cropped, Frames, frame_range
from dejavu_torch.data.turning import Upright
from dejavu_torch.data.video import VIDEO_SUFFIXES, Video
from dejavu_torch.types import Facts, InputError, Traverse, expect

# of frames or features: see `as_traverse`
Source: TypeAlias = Traverse | Tensor | np.ndarray | str | Path | Sequence[object] | Dataset[object]
CONVERTED = {  # kinds of files that other programs turn into images
    ".gif": "an animation; expected it converted, as by `ffmpeg -i FILE FOLDER/%06d.png`",
    ".zip": "an archive; expected it unpacked, as by `unzip FILE -d FOLDER`",
    ".bag": "a ROS bag; expected its images exported, as by image_view's extract_images",
}
READERS: dict[str, Callable[..., Traverse]] = {".npy": read_array}  # by suffix
READERS |= dict.fromkeys(VIDEO_SUFFIXES, Video) | dict.fromkeys(H5_SUFFIXES, DescriptorFile)
PICTURES: dict[str, Callable[..., Traverse]] = {"strip:": read_strip, "grid:": read_grid}  # of one image
PICTURES["path:"] = read_flight
KINDS = {int: "integer", float: "floating-point number"}  # types of option values
PART = {"start": 0, "stop": 0, "step": 1}  # options of every source, see `frame_range`
EVERY = PART | {"coordinates": "", "turn": "", "crop": "", "mask": ""}
EXPECTED = (
    "a folder of images or a video, such as clip.mp4?width=160, an .npy file of frames or features, an .h5 "
    "file of hloc, demo:road?traverse=0, sim:aerial?seed=0&traverse=0&frames=3072, sim:outdoor, "
    "sim:underground, sim:terrain?metres=256, strip:IMAGE?width=96, grid:IMAGE?window=64, or "
    "path:IMAGE?points=track.csv"
)


def as_traverse(source: Source) -> Traverse:
    """A traverse unchanged; a tensor or array of frames or features, a list or dataset of frames (see
    `Frames`), or what `open_source` opens, as one."""
    if isinstance(source, Traverse):
        return source
    if isinstance(source, Tensor | np.ndarray):
        return ArrayTraverse(source)
    if isinstance(source, str | Path):
        return open_source(source)
    if hasattr(source, "__len__") and hasattr(source, "__getitem__") and not isinstance(source, Mapping):
        return Frames(source)
    seen = f"got a {type(source).__name__}"
    expected = "a tensor or array, a list or dataset of frames, or a path as of open_source"
    raise InputError(f"{seen}; expected a Traverse, {expected}")


def open_source(source: str | Path) -> Traverse:
    """Open a source of frames or features.

    Args:
        source: a folder of images, `photos`, `photos?width=160&height=90`, `photos?order=lexicographic` or
            `photos?glob=*.png&recursive=1` (see `ImageFolder`); a video file, `clip.mp4`, also with width and
            height; an `.npy` file of frames (N,H,W) or (N,H,W,3) uint8, or of features (N,D) float, with the
            names of their images in a `.txt` file next to it; an `.h5` file of hloc's global descriptors,
            also with `order=`; `demo:road?traverse=0` or 1, the flights of the demo, and `demo:area`;
            `sim:NAME?seed=0&traverse=0&frames=3072`, NAME being aerial, outdoor or underground;
            `sim:terrain?seed=0&traverse=0&metres=256&window=64&stride=4`, an area of simulated ground;
            `strip:IMAGE?width=96&rows=32:128&halve=1&grey=1`, a window sliding along one long image; or
            `grid:IMAGE?window=64&stride=8&scale=.5`, windows over a picture of an area, see `Grid`; or
            `path:IMAGE?points=track.csv&window=64&scale=.5`, windows along a path over it, see `read_flight`.
            For all sources but areas, `start=`, `stop=` and `step=` select every step-th of the frames
            [start, stop). `coordinates=FILE` tells where frames were taken, see `read_coordinates`.
            `turn=90`, 180 or 270 turns frames clockwise, in degrees, `turn=mirror` exchanges left and right;
            then `mask=IMAGE` makes what is black in an image black in all frames, then
            `crop=TOP,BOTTOM,LEFT,RIGHT` removes pixels.

    Raises:
        InputError: missing, empty, or unreadable.

    Example:
        >>> len(open_source("sim:aerial?frames=40&traverse=1"))
        40
        >>> len(open_source("sim:aerial?frames=40&start=10&step=3"))
        10
    """
    text = str(source)
    address, query = _split(text)
    reader = _reader(text, address)
    arguments = _arguments(text, query, reader)
    part = {name: arguments.pop(name) for name in PART if name in arguments}
    file, turn, crop, mask = (arguments.pop(name, "") for name in ("coordinates", "turn", "crop", "mask"))
    traverse = reader(**arguments)
    if file:
        traverse.coordinates, headings, traverse.odometer = read_coordinates(Path(file), traverse)
        traverse.headings = traverse.headings if headings is None else headings
    if turn:
        traverse = Upright(traverse, turn)
    if crop or mask:
        hidden = read_image(Path(mask)).mean(0, keepdim=True) if mask else None
        traverse = Cropped(traverse, _sides(text, crop), hidden)
    return frame_range(traverse, **part) if part else traverse


def _sides(text: str, crop: str) -> list[int]:
    """The pixels to remove at the top, bottom, left and right."""
    sides = [as_number(one) for one in crop.split(",")] if crop else [0, 0, 0, 0]
    whole = [int(side) for side in sides if side is not None and side >= 0 and side % 1 == 0]
    if len(sides) != 4 or len(whole) != 4:
        raise InputError(f"{text}: crop is {crop!r}; expected pixels as in crop=TOP,BOTTOM,LEFT,RIGHT")
    return whole


def routes_of(source: str | Path) -> list[str]:
    """The subfolders of a folder of folders only, in natural order with its options; else the source."""
    address, query = _split(str(source))
    inside: list[Path] = []
    with suppress(OSError, ValueError):  # not a folder, or not a valid path
        inside = [path for path in Path(address).iterdir() if path.name[0] != "."] if address else []
    if not inside or not all(path.is_dir() for path in inside):
        return [str(source)]
    options = f"?{query}" if query else ""
    return [f"{path}{options}" for path in sorted(inside, key=lambda path: natural(path.name))]


def check_not_read(out: Path, *sources: str | Path | None) -> None:
    """Refuse an output that would overwrite an input, such as an image of a folder or the names of an array;
    sources may be any text."""
    for source in filter(None, sources):
        address, query = _split(str(source))
        kind = next((kind for kind in PICTURES if address.startswith(kind)), "")
        path, read = Path(address.removeprefix(kind)), False
        beside = [Path(file) for name, file in parse_qsl(query) if name in ("coordinates", "mask", "points")]
        with suppress(OSError, ValueError, RuntimeError):  # missing, not a valid path, or a link to itself
            named = [path.with_suffix(suffix) for suffix in (".txt", ".json")]
            names = named if path.suffix.lower() == ".npy" else []
            read = any(out.resolve() == file.resolve() for file in (path, *names, *beside)) or out.samefile(
                path
            )
            read = read or (out.suffix.lower() in IMAGE_SUFFIXES and out.parent.samefile(path))
        expect(not read, "another name for the output", f"{out} is an input")


def _split(text: str) -> tuple[str, str]:
    """The address of a source, and its options."""
    prefixed = text.startswith(("sim:", "demo:", *PICTURES))
    if "?" not in text or (not prefixed and os.path.exists(text)):  # exists: False for invalid paths
        return text, ""
    address, _, query = text.partition("?") if prefixed else text.rpartition("?")
    return address, query


def _reader(text: str, address: str) -> Callable[..., Traverse]:
    """The function that opens an address with the options as arguments."""
    kind, colon, name = address.partition(":")
    if kind + colon == "sim:":
        expect(name in SIMULATED, ", ".join(sorted(SIMULATED)), f"there is no simulator {name!r}")
        return SIMULATED[name]
    if kind + colon == "demo:":
        expect(name in DEMOS, ", ".join(DEMOS), f"there is no demo {name!r}")
        return DEMOS[name]
    if kind + colon in PICTURES:
        return partial(PICTURES[kind + colon], Path(name))
    path = Path(address)
    expect(address and os.path.exists(path), EXPECTED, f"{text or 'a source without a name'} is not there")
    if path.is_dir():
        return partial(ImageFolder, path)
    suffix = path.suffix.lower()
    if suffix in READERS:
        return partial(READERS[suffix], path)
    seen = "a single image" if suffix in IMAGE_SUFFIXES else "of an unknown kind"
    if suffix in CONVERTED:
        raise InputError(f"{path} is {CONVERTED[suffix]}, into a folder of images")
    raise InputError(f"{path} is {seen}; expected {EXPECTED}")


def _arguments(text: str, query: str, reader: Callable[..., Traverse]) -> Facts:
    """`a=1&b=2` as arguments of the reader, and options in `EVERY`, each of the type of its default."""
    empty = inspect.Parameter.empty
    defaults = {name: option.default for name, option in inspect.signature(reader).parameters.items()} | EVERY
    arguments: Facts = {}
    for name, value in parse_qsl(query, keep_blank_values=True):
        what = "a second" if name in arguments else "unknown"
        expect(name in defaults and name not in arguments, ", ".join(defaults), f"{text}: {what} {name!r}")
        default = defaults[name]
        kind = int if default is empty or isinstance(default, bool) else type(default)
        try:
            arguments[name] = kind(value)
        except ValueError as error:
            raise InputError(f"{text}: {name} is {value!r}; expected {KINDS[kind]}") from error
    for name, default in defaults.items():
        expect(default is not empty or name in arguments, f"{name}=...", f"{text}: {name} is missing")
    return arguments
