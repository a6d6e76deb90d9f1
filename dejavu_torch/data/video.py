"""A video file as a traverse."""

from __future__ import annotations

import gc
import logging
import math
import os
from bisect import bisect_right
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from threading import get_ident
from time import monotonic
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import check_regular, reading, why
from dejavu_torch.data.folder import check_pixels, check_size, fitted_size
from dejavu_torch.data.names import clock_time
from dejavu_torch.resize import MOST_PIXELS
from dejavu_torch.text import printable
from dejavu_torch.types import Facts, InputError, Traverse, expect

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.filter import Graph
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
LONG = 3.0  # seconds of reading the times that are told
VP8_SHOWN = 16  # the bit of a packet's first byte that says whether its frame is shown
UNEVEN_RATIO = 1.5  # of the longest to the median interval; rounding to half a frame stays below it

Index = tuple[list[Any], list[int], Fraction | None]  # time stamps, key frames, seconds of a stamp
# SWS_FULL_CHR_H_INT and _INP, which only new versions of av name; else colours are averaged over two columns
FULL_CHROMA = 0x6000
HDR = 16, 18  # transfer functions, as FFmpeg numbers them: SMPTE ST 2084 (PQ) and HLG
UNKNOWN, BT2020 = 2, 9  # primaries, likewise
EXACT = "gbrp16le"  # pixels until their brightness is changed
_FORKED: list[object] = []  # decoders of parent processes


class Video(Traverse):
    """The frames of a video file, decoded and resized as they are read.

    Args:
        path: a video file of any container and codec that FFmpeg reads.
        width, height: in pixels, resized by areas; 0 for both keeps the size, 0 for one the aspect ratio.

    Shape: frames (n,3,H,W), always RGB, rotated upright as the file says; PQ and HLG become BT.709.

    Convention: a frame's name is its time, as 0:01:23.480. Opening reads the times of all frames, without
        decoding them where the file lists them (.mp4, .mov, .mkv, .webm, most .avi); a variable frame rate
        logs a warning. Any frame can be read: decoding starts at the key frame before it, or goes on from
        the last one read. Files without usable times, as an .avi with B-frames, are read from the beginning.

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
        with self._open() as (container, stream):
            whole, kind = _is_whole(self.path), container.format.name
            self.pixels = stream.sample_aspect_ratio or Fraction(1)  # width over height
            # only this family lists every frame, and which ones an edit list hides
            if kind.startswith("mov") and stream.frames:
                entries = stream.index_entries
                whole = whole and all(entry.pos + entry.size <= container.size for entry in entries)
            self._sought = kind != "avi" or not stream.codec_context.has_b_frames
            listed = kind.startswith(("mov", "matroska", "avi")) and self._sought
        expect(whole, "a complete video file", f"{path} is cut off or damaged")
        began = monotonic()
        self._stamps, self._keys, base = self._listed() if listed else self._decoded()
        if (took := monotonic() - began) > LONG:
            log.warning("%s: reading the times of its %d frames took %.0f s", self.name, len(self), took)
        self.times = torch.tensor([seconds_of(stamp, base) for stamp in self._stamps], dtype=torch.float64)
        self.names = [clock_time(time) if math.isfinite(time) else "" for time in self.times.tolist()]
        self._warn_uneven()
        self._decoder: Generator[VideoFrame, None, None] | None = None  # of the process `_owner`
        self._owner, self._next = 0, 0  # the frame that the decoder gives next

    def __len__(self) -> int:
        return len(self._stamps)

    def __getstate__(self) -> Facts:
        return self.__dict__ | {"_decoder": None}

    def decoded_at(self, height: int, width: int) -> Video:
        """The frames at another size in pixels."""
        return self.changed(height=height, width=width, sized=True, _decoder=None)

    def read(self, frames: range | list[int]) -> Tensor:
        pictures = {i: self._picture(i) for i in sorted({*frames})}
        return _as_tensor([pictures[i] for i in frames])

    def _picture(self, i: int) -> np.ndarray:
        """Frame i in the size of all frames, (H,W,3) uint8."""
        key = self._keys[bisect_right(self._keys, i) - 1]
        if self._owner != os.getpid():
            _FORKED.append(self._decoder)  # closing it would wait for threads that are not in this process
            self._decoder = None
        if self._decoder is None or not key <= self._next <= i:
            self._owner, self._next = os.getpid(), key
            # of a copy: not in a circle, the file is closed as soon as this object is gone
            self._decoder = self.changed(_decoder=None)._frames(key)
        decoder, self._decoder = self._decoder, None  # after an error or the last frame
        for frame in decoder:
            self._next += 1
            if self._next > i:
                with reading(self.path, "cannot be resized", "a smaller size"):
                    picture = pixels_of(frame, self.path, self.width, self.height)
                if self._next < len(self):
                    self._decoder = decoder
                else:
                    decoder.close()
                return picture
        raise self._broken(self._next, "frames are missing")

    def _frames(self, first: int) -> Generator[VideoFrame, None, None]:
        """The frames from a key frame on."""
        i, size = first, None
        with self._decoding() as (container, stream):
            if first:
                container.seek(self._stamps[first], stream=stream)
            for frame in _decode(container, stream):
                if i == first > 0 and frame.pts < self._stamps[first]:
                    continue  # frames that precede the key frame
                if i == first > 0 and frame.pts > self._stamps[first]:
                    break
                if frame.is_corrupt:
                    raise self._broken(i, "the picture is damaged")
                if i >= len(self) or (self._sought and frame.pts != self._stamps[i]):
                    raise self._broken(i, "frames are missing")
                size = size or (frame.height, frame.width)
                check_same_size(self.name, i, frame, size)
                i = self._next = i + 1
                yield frame
        if i == first > 0:  # the container cannot seek exactly
            yield from islice(self._frames(0), first, None)

    def _listed(self) -> Index:
        """The frames that the file lists, without decoding them."""
        with self._decoding() as (container, stream):
            packets = (packet for packet in container.demux(stream) if packet.size and not packet.is_discard)
            if stream.codec_context.name == "vp8":
                packets = (packet for packet in packets if bytes(packet)[0] & VP8_SHOWN)
            # not the packets themselves, which hold the whole file
            frames = sorted((packet.pts is None, packet.pts or 0, packet.is_keyframe) for packet in packets)
            if container.format.name == "avi" and len(frames) < len(stream.index_entries):
                raise self._broken(len(frames), "frames are missing")
            stamps = [None if unknown else stamp for unknown, stamp, _ in frames]
            return self._index(stamps, [key for *_, key in frames], stream)

    def _decoded(self) -> Index:
        """All frames, by decoding them once."""
        with self._decoding() as (container, stream):
            size, stamps, keys = None, list[Any](), list[bool]()
            for i, frame in enumerate(_decode(container, stream)):
                size = size or (frame.height, frame.width)
                check_same_size(self.name, i, frame, size)
                if frame.is_corrupt:
                    raise self._broken(i, "the picture is damaged")
                stamps.append(frame.pts)
                keys.append(bool(frame.key_frame))
            if container.format.name == "avi" and len(stamps) < len(stream.index_entries):
                raise self._broken(len(stamps), "frames are missing")
            return self._index(stamps, keys, stream)

    def _index(self, stamps: list[Any], keys: list[bool], stream: VideoStream) -> Index:
        expect(stamps, "a video", f"{self.name} has no frames")
        known = None not in stamps
        self._sought = self._sought and known and stamps == sorted({*stamps})
        starts = [i for i, key in enumerate(keys) if key and i and self._sought]
        # .avi stores no times of presentation
        return sorted(stamps) if known else stamps, [0, *starts], stream.time_base

    @contextmanager
    def _decoding(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        """The opened file; errors of FFmpeg, which are of many types, become an InputError."""
        try:
            with self._open() as opened:
                yield opened
        except InputError:
            raise
        except Exception as error:
            raise self._broken(getattr(self, "_next", 0), why(error)) from error

    def _warn_uneven(self) -> None:
        assert self.times is not None
        intervals = 1e3 * self.times.diff()
        if not len(intervals) or not (intervals >= 0).all():
            return
        shortest, middle, longest = map(float, (intervals.min(), intervals.median(), intervals.max()))
        if longest > UNEVEN_RATIO * middle + 1e-3:
            seen = f"{shortest:.0f} to {longest:.0f} ms per frame (median {middle:.0f})"
            hint = "periods in frames are meaningless unless the footage is resampled by distance"
            _warn_once(f"{self.name}: the frame rate varies, {seen}: {hint}")

    @contextmanager
    def _open(self) -> Iterator[tuple[InputContainer, VideoStream]]:
        import av

        if int(av.__version__.split(".")[0]) < 18 and hasattr(os, "register_at_fork"):
            _collect_before_forks()
        options = {"format_whitelist": FORMATS, "protocol_whitelist": "file"}
        kind = "mjpeg" if self.path.suffix.lower() == ".mjpeg" else None  # often detected as another
        with reading(self.path, "cannot be read as a video", "a video file"):
            name = f"file:{self.path}"  # may contain a colon
            container = av.open(name, "r", kind, container_options=options, metadata_errors="replace")
        with container:
            yield container, stream_of(container, self.name, "a video", "AUTO")

    def _broken(self, frame: int, why: str) -> InputError:
        return InputError(f"{self.name} is broken near frame {frame}: {why}; expected a complete video file")


def _decode(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    for packet in container.demux(stream):
        if packet.is_corrupt:
            raise ValueError("the data are incomplete")
        yield from packet.decode()


@cache
def _collect_before_forks() -> None:
    """PyAV before 18 leaves decoders to the garbage collector, which in a forked process would wait for their
    threads, and these are not there."""
    os.register_at_fork(before=gc.collect)


@cache  # a command may open a video several times
def _warn_once(text: str) -> None:
    log.warning("%s", text)


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
    seen = f"frame {number} of {name} is {frame.height} x {frame.width} pixels"
    expect((frame.height, frame.width) == first, f"{first[0]} x {first[1]} as in frame 0", seen)


def pixels_of(frame: VideoFrame, path: Path, width: int = 0, height: int = 0) -> np.ndarray:
    """A decoded frame, upright and resized as by `fitted_size`: (H,W,3) uint8; `path` is for messages."""
    from av.video.reformatter import Interpolation as How

    how = How.AREA | FULL_CHROMA
    turns = round(frame.rotation / 90) % 4  # quarter turns, counterclockwise
    w, h = (frame.height, frame.width) if turns % 2 else (frame.width, frame.height)
    height, width = fitted_size(path, h, w, width, height)
    if turns % 2:
        width, height = height, width
    check_pixels(path, height, width, MOST_PIXELS)
    kind = EXACT if frame.color_trc in HDR else "rgb24"
    # threads of its own cost each frame more than they save, and would be waited for in a forked process
    picture = frame.reformat(width, height, kind, interpolation=how, threads=1)
    if kind == EXACT:
        picture = _mapped(picture, frame.color_trc, frame.color_primaries)
    return np.rot90(picture.to_ndarray(), turns)


def _mapped(picture: VideoFrame, transfer: int, primaries: int) -> VideoFrame:
    """A picture of high dynamic range as "rgb24" of the usual one: white, 203 cd/m2, becomes 255, and what is
    brighter is cut off."""
    primaries = BT2020 if primaries == UNKNOWN else primaries
    picture.color_trc, picture.color_primaries = transfer, primaries
    graph = _graph((os.getpid(), get_ident(), transfer, primaries), picture.width, picture.height)
    graph.vpush(picture)
    return graph.vpull()


@lru_cache(16)  # as the first picture of each takes seconds
def _graph(of: tuple[int, int, int, int], width: int, height: int) -> Graph:
    from av import VideoFormat
    from av.filter import Graph

    graph = Graph()
    graph.threads = 1
    source = graph.add_buffer(
        width=width, height=height, format=VideoFormat(EXACT), time_base=Fraction(1, 1000)
    )
    graph.link_nodes(
        source,
        graph.add("scale", "out_transfer=bt709:out_primaries=bt709"),
        graph.add("format", "rgb24"),
        graph.add("buffersink"),
    )
    graph.configure()
    return graph


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
                length = int.from_bytes(head[:4], "big")
                length = int.from_bytes(head[8:], "big") if length == 1 else length
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
        length = int.from_bytes(head[i:j], "big") & unknown
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
