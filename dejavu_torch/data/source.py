"""SOURCE, as every command takes it: text -> Traverse."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from dejavu_torch.data.arrays import read_array
from dejavu_torch.data.folder import SUFFIXES, ImageFolder
from dejavu_torch.data.simulate.aerial import AerialRoad
from dejavu_torch.data.simulate.railway import Outdoor, Underground
from dejavu_torch.data.strip import read_strip
from dejavu_torch.data.video import SUFFIXES as VIDEO_SUFFIXES
from dejavu_torch.data.video import Video
from dejavu_torch.types import InputError, Traverse

SIMULATORS: dict[str, Callable[..., Traverse]] = {
    "aerial": AerialRoad,
    "outdoor": Outdoor,
    "underground": Underground,
}
EXPECTED = (
    "a folder of images or a video, such as clip.mp4?width=160, an .npy file of frames or features, "
    "sim:aerial?seed=0&traverse=0&frames=3072, sim:outdoor, sim:underground, or strip:IMAGE?width=96"
)


def open_source(source: str | Path) -> Traverse:
    """Open what a command was given to read.

    Args:
        source: a folder of images (sorted by name), `photos` or `photos?width=160&height=90&step=2`; a
            video file, `clip.mp4` or with the same options; an `.npy` file of frames (N,H,W) or
            (N,H,W,3) uint8, or of features (N,D) float; `sim:NAME?seed=0&traverse=0&frames=3072`,
            NAME being aerial, outdoor or underground; or `strip:IMAGE?width=96&rows=32:128&halve=1&grey=1`,
            a window slid along one long image.

    Raises:
        InputError: missing, empty, or nothing that can be read.

    Example:
        >>> open_source("sim:aerial?frames=40&traverse=1").length
        40
    """
    text = str(source)
    if text.startswith("sim:"):
        name, _, query = text.removeprefix("sim:").partition("?")
        if name not in SIMULATORS:
            raise InputError(f"there is no simulator {name!r}; expected {', '.join(sorted(SIMULATORS))}")
        simulator = SIMULATORS[name]
        return simulator(**_arguments(text, query, simulator))
    if text.startswith("strip:"):
        name, _, query = text.removeprefix("strip:").partition("?")
        return read_strip(Path(name), **_arguments(text, query, read_strip))
    path, query = Path(text), ""
    if not path.exists() and "?" in text:
        name, _, query = text.rpartition("?")
        path = Path(name)
    if not path.exists():
        raise InputError(f"{text} is not there; expected {EXPECTED}")
    if path.is_dir():
        return ImageFolder(path, **_arguments(text, query, ImageFolder))
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return Video(path, **_arguments(text, query, Video))
    if suffix == ".npy":
        return read_array(path, **_arguments(text, query, read_array))
    if suffix in SUFFIXES:
        raise InputError(f"{path} is a single image; expected {EXPECTED}")
    raise InputError(f"{path} is none of the kinds that can be read; expected {EXPECTED}")


def _arguments(text: str, query: str, function: Callable[..., Any]) -> dict[str, Any]:
    """Turn `a=1&b=2` into the function's keyword arguments, each of its default's type."""
    parameters = {
        name: parameter
        for name, parameter in inspect.signature(function).parameters.items()
        if name != "path"
    }
    given: dict[str, Any] = {}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in parameters:
            raise InputError(f"{text}: unknown {name!r}; expected {', '.join(parameters) or 'no options'}")
        default = parameters[name].default
        kind = int if default is inspect.Parameter.empty or isinstance(default, bool) else type(default)
        try:
            given[name] = kind(value)
        except ValueError as error:
            raise InputError(f"{text}: {name} is {value!r}; expected {kind.__name__}") from error
    missing = [n for n, p in parameters.items() if p.default is inspect.Parameter.empty and n not in given]
    if missing:
        raise InputError(f"{text}: {', '.join(missing)} is missing; expected {missing[0]}=...")
    return given
