"""Frames of a camera, a network address or a pipe, read once as they arrive."""

from __future__ import annotations

import math
import os
import re
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import why
from dejavu_torch.data.turning import QUARTERS, TURNS
from dejavu_torch.data.video import FORMATS, check_same_size, pixels_of, seconds_of, stream_of
from dejavu_torch.resize import is_stretched
from dejavu_torch.text import printable
from dejavu_torch.types import Facts, InputError, Traverse, expect

PIPE = "-"  # standard input
TURN = "?turn="  # after a source; what comes before it is the camera's own
PROTOCOLS = "rtsp,rtsps,rtp,srtp,udp,tcp,tls,http,https,httpproxy,rtmp,rtmps,rtmpt,srt,crypto,data"
OPEN_TIMEOUT = 10.0  # seconds that an address may take to answer


class Frame(NamedTuple):
    """A frame of a stream."""

    number: int  # counted from 0
    seconds: float  # timestamp, NaN if there is none
    pixels: np.ndarray | Tensor  # (H,W,3) uint8, or (C,H,W) float in [0, 1]


def is_stream(source: str) -> bool:
    """Whether a source is a camera, an address or a pipe, not a file or folder."""
    source = source.partition(TURN)[0]
    named = source == PIPE or "://" in source or source.startswith("/dev/")
    return named or _mode_is(source, stat.S_ISCHR) or _mode_is(source, stat.S_ISFIFO)


def without_password(source: str) -> str:
    """A source as printed in messages: an address without user, password and query."""
    kind, mark, rest = source.partition("://")
    shown = re.split("[?#]", rest)[0].rpartition("@")[2]  # a password may contain anything but an @
    return printable(f"{kind}://{shown}" if mark else source)


class Camera:
    """The frames of a camera, an address or a pipe; they can be iterated once.

    Args:
        source: `/dev/video0`, an address such as `rtsp://host/path`, a named pipe, or "-", standard input;
            `?turn=90` after it turns its frames, by one of `TURNS`.
        size: (height, width) in pixels to resize frames to; None keeps the camera's size.

    Attributes:
        ends: whether the stream may end, as a pipe does.
        note: a warning that `size` stretches the frames, set after the first one; else "".

    Raises:
        InputError: another turn; on iterating: no camera or video, a damaged stream, a size change, or an
            unexpected end.
    """

    def __init__(self, source: str, size: tuple[int, int] | None = None) -> None:
        source, turns, turn = source.partition(TURN)
        expect(not turns or turn in TURNS, f"{', '.join(TURNS)}, clockwise", f"{source}: turn={turn}")
        self.source, self.turn, self.size, self.note = source, turn, size, ""
        self.name = "standard input" if source == PIPE else without_password(source)
        self.ends = source == PIPE or _mode_is(source, stat.S_ISFIFO)
        self.device = not self.ends and (source.startswith("/dev/") or _mode_is(source, stat.S_ISCHR))
        self._expected = "a camera such as /dev/video0" if self.device else "a video stream"

    def __iter__(self) -> Iterator[Frame]:
        number = 0
        first: tuple[int, int] | None = None
        exchanged = QUARTERS.get(self.turn, 0) % 180 > 0
        high, wide = (self.size or (0, 0))[:: -1 if exchanged else 1]
        try:
            with self._open() as container:
                stream = stream_of(container, self.name, self._expected, "SLICE")  # FRAME threads add delay
                for frame in container.decode(stream):
                    if first is None:
                        first = (frame.height, frame.width)
                        self.note = stretched(self.name, first, (high, wide) if self.size else None)
                    check_same_size(self.name, number, frame, first)
                    pixels = pixels_of(frame, Path(self.name), wide, high)
                    if self.turn:
                        upright = TURNS[self.turn](torch.from_numpy(pixels.copy()).movedim(-1, 0))
                        pixels = upright.movedim(0, -1).contiguous().numpy()
                    number += 1
                    yield Frame(number - 1, seconds_of(frame.pts, stream.time_base), pixels)
        except InputError:
            raise
        except Exception as error:  # FFmpeg raises many types
            seen = f"broke off after {number} frames" if number else "cannot be read"
            expected = "more frames" if number else self._expected
            raise InputError(f"{self.name} {seen}: {why(error)}; expected {expected}") from error
        expect(number, self._expected, f"{self.name} gave no frames")
        expect(self.ends, "more frames", f"{self.name} ended after {number} frames")

    def _open(self) -> Any:
        import av

        options = {"protocol_whitelist": "pipe", "format_whitelist": f"{FORMATS},nut,yuv4mpegpipe"}
        settings: Facts = {"metadata_errors": "replace"}
        address: object = self.source
        if self.device:
            expect(os.path.exists(self.source), self._expected, f"{self.name} is not there")
            settings["format"] = "v4l2"
            options = {}
        elif self.ends:  # unbuffered: a thread would hold the buffer's lock until the process ends
            pipe = self.source == PIPE
            address = open(0 if pipe else self.source, "rb", buffering=0, closefd=not pipe)  # noqa: SIM115
        else:
            options["protocol_whitelist"] = PROTOCOLS  # an answer may not name local files
            options["format_whitelist"] += ",rtsp,sdp,rtp,hls,dash,mpjpeg"
            options["rtsp_transport"] = "tcp"
            settings["timeout"] = (OPEN_TIMEOUT, None)
        return av.open(address, "r", container_options=options, **settings)


def _mode_is(path: str, test: Callable[[int], bool]) -> bool:
    try:
        return bool(test(os.stat(path).st_mode))
    except (OSError, ValueError):
        return False


def stretched(name: str, own: tuple[int, int], size: tuple[int, int] | None) -> str:
    """A warning that resizing from one (height, width) to another changes the aspect ratio; else ""."""
    note = f"{name}: frames of {own[0]} x {own[1]} pixels are stretched to the map's "
    return f"{note}{size[0]} x {size[1]}" if size is not None and is_stretched(own, size) else ""


def shots_of(traverse: Traverse) -> Iterator[Frame]:
    """The frames of a traverse one by one, with timestamps if it is a video."""
    times = traverse.times
    for i in range(len(traverse)):
        yield Frame(i, math.nan if times is None else float(times[i]), traverse[i])
