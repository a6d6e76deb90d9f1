"""Frames read by a thread while others are localized."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress

from dejavu_torch.data.camera import Frame
from dejavu_torch.types import InputError, expect

WAITING = 2  # frames read ahead, if none is dropped


class FrameReader:
    """A context manager that iterates frames read by a thread; an error of the reading is raised last.

    Args:
        newest: only the newest frame waits; earlier ones are dropped, and counted in `dropped`.
        timeout: seconds without a frame that raise an InputError; None waits forever.
        name: of the source, for messages.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        newest: bool = False,
        timeout: float | None = None,
        name: str = "the source",
    ) -> None:
        self.frames, self.newest, self.timeout, self.name = frames, newest, timeout, name
        self.dropped, self._closed = 0, False
        # frames, then None or the error of the reading
        self._waiting: queue.Queue[Frame | BaseException | None] = queue.Queue(WAITING)
        # a daemon, since a blocked read must not keep the process alive
        self._thread = threading.Thread(target=self._read, name="dejavu reader", daemon=True)

    def __enter__(self) -> FrameReader:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._drop()
        self._thread.join(0.5)

    def __iter__(self) -> Iterator[Frame]:
        while True:
            try:
                frame = self._waiting.get(timeout=self.timeout)
            except queue.Empty:
                seen = f"{self.name} stalled: no frame for {self.timeout:g} seconds"
                raise InputError(f"{seen}; expected further frames") from None
            if frame is None or isinstance(frame, BaseException):
                self._waiting.put(frame)  # for the next iteration
                if frame is None:
                    return
                raise frame
            yield frame

    def _read(self) -> None:
        end: BaseException | None = None
        try:
            for frame in self.frames:
                if self.newest:
                    self.dropped += self._drop()
                self._waiting.put(frame)
                if self._closed:
                    break
        except BaseException as error:
            end = error
        self._waiting.put(end)

    def _drop(self) -> int:
        """Drop the waiting frames, and count them."""
        count = 0
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
                count += 1
        return count


def in_real_time(frames: Iterable[Frame], name: str, rate: float | None = None) -> Iterator[Frame]:
    """Frames at the pace of their timestamps, or at `rate` per second if they have none."""
    start: float | None = None
    for frame in frames:
        seconds = frame.number / rate if rate and math.isnan(frame.seconds) else frame.seconds
        expect(not math.isnan(seconds), "a video for --realtime", f"{name} has no timestamps")
        start = time.monotonic() - seconds if start is None else start
        time.sleep(max(0.0, start + seconds - time.monotonic()))
        yield frame
