"""Frames read by a thread while others are localised; those that come too fast may be dropped."""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress

from dejavu_torch.data.camera import Frame
from dejavu_torch.types import InputError

WAITING = 2  # frames read ahead, if none is dropped


class FrameReader:
    """Iterates frames that a thread of its own reads, as a context manager; what reading raises comes last.

    Args:
        newest: only the newest frame waits; earlier ones are dropped, and counted in `dropped`.
        timeout: seconds without a frame after which the source has stalled, an InputError; None waits.
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
        # frames, and at the end None or what reading them raised
        self._waiting: queue.Queue[Frame | BaseException | None] = queue.Queue(WAITING)
        # a thread that is stuck in a read does not keep the process
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
                seen = f"{self.name} stalled: no frame in {self.timeout:g} seconds"
                raise InputError(f"{seen}; expected it to go on") from None
            if frame is None or isinstance(frame, BaseException):
                self._waiting.put(frame)  # for whoever iterates again
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
        """Drop the frames that wait; how many they were."""
        count = 0
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
                count += 1
        return count


def in_real_time(frames: Iterable[Frame], name: str, rate: float | None = None) -> Iterator[Frame]:
    """Each frame no earlier than its timestamp says, from the first on, or `rate` frames a second."""
    began: float | None = None
    for frame in frames:
        seconds = frame.number / rate if rate and math.isnan(frame.seconds) else frame.seconds
        if math.isnan(seconds):
            raise InputError(f"{name} has no times; expected a video for --realtime")
        began = time.monotonic() - seconds if began is None else began
        time.sleep(max(0.0, began + seconds - time.monotonic()))
        yield frame
