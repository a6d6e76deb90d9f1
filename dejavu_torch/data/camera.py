"""Frames of a camera, an address or a pipe, which come once and in their own time."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from dejavu_torch.data.files import why
from dejavu_torch.data.video import FORMATS, check_alike, pixels_of, seconds_of, stream_of
from dejavu_torch.resize import is_stretched
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Traverse

PIPE = "-"  # standard input
PROTOCOLS = "rtsp,rtsps,rtp,srtp,udp,tcp,tls,http,https,httpproxy,rtmp,rtmps,rtmpt,srt,crypto,data"
OPENING = 10.0  # seconds that an address may take to answer


class Frame(NamedTuple):
    """A frame of a stream."""

    number: int  # from 0, of all frames that came
    seconds: float  # of its timestamp, NaN where it has none
    pixels: np.ndarray | Tensor  # (H,W,3) uint8, or (C,H,W) float in [0, 1]


def is_stream(source: str) -> bool:
    """Whether a source is a camera, an address or a pipe, and no file or folder."""
    if source == PIPE or "://" in source or source.startswith("/dev/"):
        return True
    return _mode_is(source, stat.S_ISCHR) or _mode_is(source, stat.S_ISFIFO)


def without_password(source: str) -> str:
    """A source as messages name it, printable: an address without what only its user is to know."""
    kind, mark, rest = source.partition("://")
    shown = re.split("[?#]", rest)[0].rpartition("@")[2]  # a password may hold anything but an @
    return printable(f"{kind}://{shown}" if mark else source)


class Camera:
    """The frames of a camera, an address or a pipe. Iterating reads them, once.

    Args:
        source: a camera, `/dev/video0`; an address such as `rtsp://host/path`; a named pipe; or "-", standard
            input.
        size: (height, width) in pixels that frames are brought to; None keeps the camera's.

    Attributes:
        ends: whether an end is expected, as of a pipe.
        note: what there is to say of the first frame: that `size` stretches it; "" for nothing.

    Raises:
        InputError: while iterating: no such camera, no video, a damaged stream, frames of another size than
            the first, or the end of what should go on.
    """

    def __init__(self, source: str, size: tuple[int, int] | None = None) -> None:
        self.source, self.size, self.name = source, size, without_password(source)
        self.ends = source == PIPE or _mode_is(source, stat.S_ISFIFO)
        self.device = not self.ends and (source.startswith("/dev/") or _mode_is(source, stat.S_ISCHR))
        self._expected = "a camera such as /dev/video0" if self.device else "a video stream"
        if source == PIPE:
            self.name = "standard input"
        self.note = ""

    def __iter__(self) -> Iterator[Frame]:
        number = 0
        first: tuple[int, int] | None = None
        high, wide = self.size or (0, 0)
        try:
            with self._open() as container:
                # threads by frames hold some of them back
                stream = stream_of(container, self.name, self._expected, "SLICE")
                for frame in container.decode(stream):
                    if first is None:
                        first = (frame.height, frame.width)
                        self.note = stretched(self.name, first, self.size)
                    check_alike(self.name, number, frame, first)
                    pixels = pixels_of(frame, Path(self.name), wide, high)
                    number += 1
                    yield Frame(number - 1, seconds_of(frame.pts, stream.time_base), pixels)
        except InputError:
            raise
        except Exception as error:  # FFmpeg's, of any type
            seen = f"broke off after {number} frames" if number else "cannot be read"
            expected = "it to go on" if number else self._expected
            raise InputError(f"{self.name} {seen}: {why(error)}; expected {expected}") from error
        if not number:
            raise InputError(f"{self.name} gave no frames; expected {self._expected}")
        if not self.ends:
            raise InputError(f"{self.name} ended after {number} frames; expected it to go on")

    def _open(self) -> Any:
        import av

        options = {"protocol_whitelist": "pipe", "format_whitelist": f"{FORMATS},nut,yuv4mpegpipe"}
        settings: dict[str, Any] = {"metadata_errors": "replace"}
        address: Any = self.source
        if self.device:
            if not os.path.exists(self.source):
                raise InputError(f"{self.name} is not there; expected {self._expected}")
            settings["format"] = "v4l2"
            options = {}
        elif self.ends:  # without a buffer, whose lock a thread would hold to the end of the process
            pipe = self.source == PIPE
            address = open(0 if pipe else self.source, "rb", buffering=0, closefd=not pipe)  # noqa: SIM115
        else:
            options["protocol_whitelist"] = PROTOCOLS  # and no file of this machine that an answer may name
            options["format_whitelist"] += ",rtsp,sdp,rtp,hls,dash,mpjpeg"
            options["rtsp_transport"] = "tcp"
            settings["timeout"] = (OPENING, None)
        return av.open(address, "r", container_options=options, **settings)


def _mode_is(path: str, test: Any) -> bool:
    try:
        return bool(test(os.stat(path).st_mode))
    except (OSError, ValueError):
        return False


def stretched(name: str, own: tuple[int, int], size: tuple[int, int] | None) -> str:
    """A line on frames of one size (height, width) that are brought to one of another shape; else ""."""
    if size is None or not is_stretched(own, size):
        return ""
    seen = f"frames of {own[0]} x {own[1]} pixels are brought to the map's {size[0]} x {size[1]}"
    return f"{name}: {seen}, which stretches them"


def shots_of(traverse: Traverse) -> Iterator[Frame]:
    """The frames of a traverse one by one, those of a video with their times."""
    for i, batch in enumerate(traverse.batches(1)):
        yield Frame(i, traverse.frame_time(i), batch[0])
