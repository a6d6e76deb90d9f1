"""A video file as a traverse."""

from __future__ import annotations

import logging
import math
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import check_regular, reading, state_of, why
from dejavu_torch.data.folder import check_pixels, check_size, fitted_size
from dejavu_torch.data.names import clock_time
from dejavu_torch.resize import MOST_PIXELS
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Traverse

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

log = logging.getLogger("dejavu_torch")

VIDEO_SUFFIXES = {
    *(".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts"),
    *(".wmv", ".flv", ".ogv", ".mjpeg"),
}
# the formats of these files only: FFmpeg also knows lists of other files and addresses
FORMATS = "mov,mp4,matroska,webm,avi,mpeg,mpegts,mpegvideo,m4v,h264,hevc,asf,flv,live_flv,ogg,mjpeg"
EBML, SEGMENT, CLUSTER = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75"  # of Matroska
BOXES = {b"ftyp", b"free", b"skip", b"wide", b"moov", b"moof", b"mdat", b"mfra", b"sidx", b"styp", b"uuid"}
UNEVEN_RATIO = 1.5  # of the longest to the median interval; rounding to half a frame stays below it


class Video(Traverse):
    """The frames of a video file, decoded and resized as they are read.

    Args:
        path: a video file of any container and codec that FFmpeg reads.
        width, height: pixels to resize to by areas; 0 for both keeps the size, for one the aspect ratio.

    Shape: frames (B,3,H,W), always RGB, rotated upright as the file says.

    Convention: a frame's name is its time, as 0:01:23.480. Reading to the end warns of a variable frame rate.

    Raises:
        InputError: width or height out of range; not a video, or a truncated one; while reading, a damaged
            frame, missing frames, or frames of different sizes. Truncation may go unnoticed if the file does
            not store its length (.ts, .mts, .mpg, .wmv, .flv, .ogv, .mjpeg, live recordings), and between
            parts that store their own (of a fragmented .mp4, or an .avi of more than 1 GB).
    """

    ordered = True

    def __init__(self, path: str | Path, width: int = 0, height: int = 0) -> None:
        self.path, self.name = Path(path), printable(path)
        check_size(self.path, width, height)
        self.width, self.height, self.sized = width, height, bool(width or height)
        check_regular(self.path, "a video file")
        self._seconds: list[float] = []  # of the frames read so far
        self._complete = False  # whether all frames have been read
        with self._open() as (container, stream):
            whole = _is_whole(self.path)
            # only this family lists every frame, and which ones an edit list hides
            if container.format.name.startswith("mov") and stream.frames:
                entries = stream.index_entries
                self.length = sum(not entry.is_discard for entry in entries)
                whole = whole and all(entry.pos + entry.size <= container.size for entry in entries)
        if not whole:
            raise InputError(f"{path} is cut off or damaged; expected a complete video file")

    def batches(self, size: int) -> Iterator[Tensor]:
        yield from self.select(range(2**62), size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        yield from self.select(range(start, stop), self.batch_size())

    def select(self, frames: range, size: int) -> Iterator[Tensor]:
        first: tuple[int, int] | None = None
        batch: list[np.ndarray] = []
        with closing(self._frames()) as decoded:
            for i, frame in enumerate(decoded):
                first = first or (frame.height, frame.width)
                check_same_size(self.name, i, frame, first)
                if i in frames:
                    with reading(self.path, "cannot be resized", "a smaller size"):
                        batch.append(pixels_of(frame, self.path, self.width, self.height))
                if len(batch) == size:
                    yield _as_tensor(batch)
                    batch = []
                if i + 1 >= frames.stop:
                    break
        if batch:
            yield _as_tensor(batch)

    def identity(self) -> str:
        return f"{self.name} {self.width} x {self.height}"

    def state(self, start: int, stop: int) -> str:
        return state_of(self.path)

    def frame_name(self, i: int) -> str:
        seconds = self.frame_time(i)
        return clock_time(seconds) if math.isfinite(seconds) else ""

    def frame_time(self, i: int) -> float:
        if not self._complete and i >= len(self._seconds):
            self._read_times()
        return self._seconds[i]

    def count(self) -> int:
        if self.length is None and not self._complete:
            self._read_times()
        return len(self._seconds) if self.length is None else self.length

    def _read_times(self) -> None:
        for _ in self._frames(decode=self.length is None):
            pass

    def _frames(self, decode: bool = True) -> Generator[VideoFrame, None, None]:
        """Every frame, or none without `decode`, which reads only times; missing frames raise at the end."""
        seconds: list[float] = []
        packets = 0
        try:
            with self._open() as (container, stream):
                base = stream.time_base
                avi = container.format.name == "avi"
                # packets are in decoding order; .avi stores no other, so its frames get wrong times
                in_order = decode and not avi
                if in_order and not self._complete:
                    self._seconds = seconds
                for packet in container.demux(stream):
                    packets += packet.size > 0
                    if packet.is_corrupt:
                        raise self._broken(len(seconds), "the data are incomplete")
                    if not decode:
                        if packet.size and not packet.is_discard:
                            seconds.append(seconds_of(packet.pts, base))
                        continue
                    for frame in packet.decode():
                        if frame.is_corrupt:
                            raise self._broken(len(seconds), "the picture is damaged")
                        seconds.append(seconds_of(frame.pts, base))
                        yield frame
                if (avi and packets < len(stream.index_entries)) or len(seconds) < (self.length or 0):
                    raise self._broken(len(seconds), "frames are missing")
                if not seconds:
                    raise InputError(f"{self.name} has no frames; expected a video")
        except InputError:
            raise
        except Exception as error:  # FFmpeg raises many types
            raise self._broken(len(seconds), why(error)) from error
        if not self._complete:
            self._seconds = seconds if in_order else sorted(seconds)
            self._complete = True
            self._warn_uneven()

    def _warn_uneven(self) -> None:
        intervals = 1e3 * torch.tensor(self._seconds, dtype=torch.float64).diff()
        if not len(intervals) or not (intervals >= 0).all():
            return
        shortest, middle, longest = map(float, (intervals.min(), intervals.median(), intervals.max()))
        if longest > UNEVEN_RATIO * middle + 1e-3:
            log.warning(
                "%s: the frame rate varies, %.0f to %.0f ms per frame (median %.0f): periods in frames are "
                "meaningless unless the footage is resampled by distance",
                *(self.name, shortest, longest, middle),
            )

    @contextmanager
    def _open(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        import av

        options = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
        kind = "mjpeg" if self.path.suffix.lower() == ".mjpeg" else None  # often detected as another
        with reading(self.path, "cannot be read as a video", "a video file"):
            name = f"file:{self.path}"  # may contain a colon
            container = av.open(name, "r", kind, container_options=options, metadata_errors="replace")
        with container:
            yield container, stream_of(container, self.name, "a video", "AUTO")

    def _broken(self, frame: int, why: str) -> InputError:
        return InputError(f"{self.name} is broken near frame {frame}: {why}; expected a complete video file")


def stream_of(container: InputContainer, name: str, expected: str, threads: str) -> Any:
    """The video stream of a container opened by FFmpeg; `name` and `expected` are for messages."""
    from av.stream import Disposition

    stream: Any = container.streams.best("video")
    # an attached picture is a song's cover
    if stream is None or stream.disposition & Disposition.attached_pic or stream.codec_context is None:
        raise InputError(f"{name} has no video stream that can be decoded; expected {expected}")
    check_pixels(Path(name), stream.codec_context.height, stream.codec_context.width, MOST_PIXELS)
    stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}  # frames may be larger than the stream
    stream.thread_type = threads
    return stream


def check_same_size(name: str, number: int, frame: VideoFrame, first: tuple[int, int]) -> None:
    """Refuse a frame of another size than the first, (height, width)."""
    if (frame.height, frame.width) != first:
        seen = f"frame {number} of {name} is {frame.height} x {frame.width} pixels"
        raise InputError(f"{seen}; expected {first[0]} x {first[1]} as in frame 0")


def pixels_of(frame: VideoFrame, path: Path, width: int = 0, height: int = 0) -> np.ndarray:
    """A decoded frame, upright and resized as by `fitted_size`: (H,W,3) uint8; `path` is for messages."""
    from av.video.reformatter import Interpolation as How

    # without full chroma, colours are averaged over pairs of columns
    how = int(How.AREA | How.FULL_CHR_H_INT | How.FULL_CHR_H_INP)
    turns = round(frame.rotation / 90) % 4  # quarter turns, counterclockwise
    w, h = (frame.height, frame.width) if turns % 2 else (frame.width, frame.height)
    height, width = fitted_size(path, h, w, width, height)
    if turns % 2:
        width, height = height, width
    check_pixels(path, height, width, MOST_PIXELS)
    return np.rot90(frame.reformat(width, height, "rgb24", interpolation=how).to_ndarray(), turns)


def seconds_of(stamp: int | None, base: Fraction | None) -> float:
    """A timestamp in seconds; NaN if there is none."""
    return math.nan if stamp is None or base is None else float(stamp * base)


def _as_tensor(frames: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2).float().div_(255)


def _is_whole(path: Path) -> bool:
    """Whether the top-level parts of an MP4, AVI or Matroska file end within it, which FFmpeg ignores."""
    with path.open("rb") as file:
        start, stop = 0, file.seek(0, 2)
        while start < stop:
            file.seek(start)
            head = file.read(16)
            if head[:4] == EBML:
                return _elements_fit(file, start, stop)
            if head[:4] == b"RIFF":
                length = 8 + int.from_bytes(head[4:8], "little")
            elif head[4:8] in BOXES:
                length = int.from_bytes(head[:4])
                length = int.from_bytes(head[8:]) if length == 1 else length
            else:
                return True  # other data follow
            if length in (0, 7 + 2**32):  # to the end of the file, or a live recording: no length to check
                return True
            start += max(8, length)
        return start == stop


def _elements_fit(file: BinaryIO, start: int, stop: int) -> bool:
    """Whether the consecutive Matroska elements from `start` end exactly at `stop`."""
    while start < stop:
        file.seek(start)
        head = file.read(12)
        i = 9 - head[0].bit_length()  # leading zero bits give the sizes of an identifier and a length
        j = i + 9 - head[i].bit_length() if i <= 4 and i < len(head) else 13
        if j > len(head):
            return False
        unknown = (1 << 7 * (j - i)) - 1
        length = int.from_bytes(head[i:j]) & unknown
        if length == unknown:  # a live recording: no length to check
            return head[:i] in (SEGMENT, CLUSTER)
        end = start + j + length
        if end > stop:
            return False
        if head[:i] in (SEGMENT, CLUSTER) and not _elements_fit(file, start + j, end):
            return False
        if head[:i] == SEGMENT:
            return True  # other data follow
        start = end
    return True
