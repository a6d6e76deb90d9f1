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

SUFFIXES = {
    *(".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts"),
    *(".wmv", ".flv", ".ogv", ".mjpeg"),
}
# what these files are, and nothing else that FFmpeg knows, such as a list of other files or addresses
FORMATS = "mov,mp4,matroska,webm,avi,mpeg,mpegts,mpegvideo,m4v,h264,hevc,asf,flv,live_flv,ogg,mjpeg"
EBML, SEGMENT, CLUSTER = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75"  # of Matroska
BOXES = {b"ftyp", b"free", b"skip", b"wide", b"moov", b"moof", b"mdat", b"mfra", b"sidx", b"styp", b"uuid"}
UNEVEN = 1.5  # longest interval over the median one; rounded to ticks of half a frame or less it is less


class Video(Traverse):
    """The frames of a video file, decoded and resized as they are read.

    Args:
        path: a video file of any container and codec that FFmpeg reads.
        width, height: pixels of the frames, averaged over areas; 0 keeps the video's own, or its
            aspect ratio where only the other is given.

    Shape: frames (B,3,H,W), RGB also where the video is grey, upright where the file says how the
        camera was turned.

    Convention: a frame's name is its time, such as 0:01:23.480. A frame rate that varies is warned of once
        the file was read to its end.

    Raises:
        InputError: width or height out of range; no video, or one that is cut off; while reading, a damaged
            frame, frames that are missing, or frames of different size. A cut may go unnoticed where the file
            does not say how long it is (.ts, .mts, .mpg, .wmv, .flv, .ogv, .mjpeg, live recordings), and
            between parts that each say it (of a fragmented .mp4, or an .avi of more than 1 GB).
    """

    ordered = True

    def __init__(self, path: str | Path, width: int = 0, height: int = 0) -> None:
        self.path, self.name = Path(path), printable(path)
        check_size(self.path, width, height)
        self.width, self.height, self.sized = width, height, bool(width or height)
        check_regular(self.path, "a video file")
        self._seconds: list[float] = []  # of the frames that were read so far
        self._complete = False  # whether these are all frames
        with self._open() as (container, stream):
            whole = _is_whole(self.path)
            # only this family lists every frame, and which of them an edit list hides
            if container.format.name.startswith("mov") and stream.frames:
                entries = stream.index_entries
                self.length = sum(not entry.is_discard for entry in entries)
                whole = whole and all(entry.pos + entry.size <= container.size for entry in entries)
        if not whole:
            raise InputError(f"{path} is cut off or damaged; expected a whole video file")

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
                check_alike(self.name, i, frame, first)
                if i in frames:
                    with reading(self.path, "cannot be resized", "less"):
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
        """Every frame, or none if only the timestamps are to be read; at the end, whether all were there."""
        seconds: list[float] = []
        packets = 0
        try:
            with self._open() as (container, stream):
                base = stream.time_base
                avi = container.format.name == "avi"
                # packets are in decoding order; .avi stores no other: its decoded frames carry a wrong one
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
                    raise InputError(f"{self.name} holds no frames; expected a video")
        except InputError:
            raise
        except Exception as error:  # of any type
            raise self._broken(len(seconds), why(error)) from error
        if not self._complete:
            self._seconds = seconds if in_order else sorted(seconds)
            self._complete = True
            self._warn_uneven()

    def _warn_uneven(self) -> None:
        """Warn of times from frame to frame that vary by more than the rounding of timestamps."""
        intervals = 1e3 * torch.tensor(self._seconds, dtype=torch.float64).diff()
        if not len(intervals) or not (intervals >= 0).all():
            return
        shortest, middle, longest = map(float, (intervals.min(), intervals.median(), intervals.max()))
        if longest > UNEVEN * middle + 1e-3:
            log.warning(
                "%s: the frame rate varies, %.0f to %.0f ms from frame to frame (median %.0f): periods in "
                "frames mean nothing here unless the footage is resampled by distance",
                *(self.name, shortest, longest, middle),
            )

    @contextmanager
    def _open(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        import av

        options: dict[str, Any] = {"metadata_errors": "replace"}
        options["container_options"] = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
        if self.path.suffix.lower() == ".mjpeg":
            options["format"] = "mjpeg"  # bare pictures in a row, often mistaken for something else
        with reading(self.path, "cannot be read as a video", "a video file"):
            # "file:" so that a colon in the name is not taken for a protocol
            container = av.open(f"file:{self.path}", "r", **options)
        with container:
            yield container, stream_of(container, self.name, "a video", "AUTO")

    def _broken(self, frame: int, why: str) -> InputError:
        return InputError(f"{self.name} is broken near frame {frame}: {why}; expected a whole video file")


def stream_of(container: InputContainer, name: str, expected: str, threads: str) -> Any:
    """The video stream of what FFmpeg opened; `name` and `expected` are for messages."""
    from av.stream import Disposition

    stream: Any = container.streams.best("video")
    # the cover of a song is no video
    if stream is None or stream.disposition & Disposition.attached_pic or stream.codec_context is None:
        raise InputError(f"{name} has no video stream that can be decoded; expected {expected}")
    check_pixels(Path(name), stream.codec_context.height, stream.codec_context.width, MOST_PIXELS)
    # a frame may be of another size than the stream
    stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
    stream.thread_type = threads
    return stream


def check_alike(name: str, number: int, frame: VideoFrame, first: tuple[int, int]) -> None:
    """Refuse a frame of another size than the first, (height, width)."""
    if (frame.height, frame.width) != first:
        seen = f"frame {number} of {name} is {frame.height} x {frame.width} pixels"
        raise InputError(f"{seen}; expected {first[0]} x {first[1]} as frame 0")


def pixels_of(frame: VideoFrame, path: Path, width: int = 0, height: int = 0) -> np.ndarray:
    """A decoded frame, upright and resized as by `fitted_size`: (H,W,3) uint8; `path` is for messages."""
    from av.video.reformatter import Interpolation as How

    # full chroma, or colours are averaged over pairs of columns of the result as well
    how = int(How.AREA | How.FULL_CHR_H_INT | How.FULL_CHR_H_INP)
    turns = round(frame.rotation / 90) % 4  # quarters, counterclockwise
    w, h = (frame.height, frame.width) if turns % 2 else (frame.width, frame.height)
    height, width = fitted_size(path, h, w, width, height)
    if turns % 2:
        width, height = height, width
    check_pixels(path, height, width, MOST_PIXELS)
    return np.rot90(frame.reformat(width, height, "rgb24", interpolation=how).to_ndarray(), turns)


def seconds_of(stamp: int | None, base: Fraction | None) -> float:
    """The seconds of a timestamp; NaN where there is none."""
    return math.nan if stamp is None or base is None else float(stamp * base)


def _as_tensor(frames: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2).float().div_(255)


def _is_whole(path: Path) -> bool:
    """Whether the outer parts of an MP4, AVI or Matroska file end inside it; FFmpeg says no word if not."""
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
                return True  # what follows is not ours
            if length in (0, 7 + 2**32):  # up to the end, or recorded live: nothing to check against
                return True
            start += max(8, length)
        return start == stop


def _elements_fit(file: BinaryIO, start: int, stop: int) -> bool:
    """Whether the Matroska elements from `start` on, one after another, end exactly at `stop`."""
    while start < stop:
        file.seek(start)
        head = file.read(12)
        # an identifier and a length; the zero bits they start with tell how long they are
        i = 9 - head[0].bit_length()
        j = i + 9 - head[i].bit_length() if i <= 4 and i < len(head) else 13
        if j > len(head):
            return False
        unknown = (1 << 7 * (j - i)) - 1
        length = int.from_bytes(head[i:j]) & unknown
        if length == unknown:  # recorded live: nothing to check against
            return head[:i] in (SEGMENT, CLUSTER)
        end = start + j + length
        if end > stop:
            return False
        if head[:i] in (SEGMENT, CLUSTER) and not _elements_fit(file, start + j, end):
            return False
        if head[:i] == SEGMENT:
            return True  # what follows is not ours
        start = end
    return True
