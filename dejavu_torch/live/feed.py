"""Frames read by a thread while others are localised; those that come too fast may be dropped."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable, Iterator

from dejavu_torch.data.camera import Shot
from dejavu_torch.types import InputError

WAITING = 2  # frames that are read ahead where none is dropped


class Feed:
    """Iterates frames that a thread of its own reads.

    Args:
        shots: read by the thread.
        newest: only the newest frame waits: earlier ones are dropped, and counted. Else the reading waits.
        timeout: seconds without a frame after which the source has stalled; None waits forever.
        name: of the source, for messages.

    Attributes:
        dropped: frames so far.

    Convention: a context manager; after it the thread ends with the frame that it reads. One that is stuck in
        a read does not keep the process.

    Raises:
        InputError: iterating: the source stalled, or what reading it raises, after the frames before.

    Example:
        >>> with Feed(Shot(i, i / 30, None) for i in range(3)) as feed:
        ...     [shot.number for shot in feed]
        [0, 1, 2]
    """

    def __init__(
        self,
        shots: Iterable[Shot],
        newest: bool = False,
        timeout: float | None = None,
        name: str = "the source",
    ) -> None:
        self.shots, self.newest, self.timeout, self.name = shots, newest, timeout, name
        self.dropped = 0
        self._waiting: list[Shot] = []
        self._changed = threading.Condition()
        self._over = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._read, name="dejavu feed", daemon=True)

    def __enter__(self) -> Feed:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._over = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join(0.5)

    def __iter__(self) -> Iterator[Shot]:
        while True:
            with self._changed:
                if not self._changed.wait_for(lambda: self._waiting or self._over, self.timeout):
                    raise InputError(
                        f"{self.name} stalled: no frame in {self.timeout:g} seconds; expected it to go on"
                    )
                if not self._waiting:
                    if self._error is not None:
                        raise self._error
                    return
                shot = self._waiting.pop(0)
                self._changed.notify_all()
            yield shot

    def _read(self) -> None:
        try:
            for shot in self.shots:
                with self._changed:
                    if self.newest:
                        self.dropped += len(self._waiting)
                        self._waiting.clear()
                    self._changed.wait_for(lambda: len(self._waiting) < WAITING or self._over)
                    if self._over:
                        return
                    self._waiting.append(shot)
                    self._changed.notify_all()
        except BaseException as error:
            self._error = error
        finally:
            with self._changed:
                self._over = True
                self._changed.notify_all()


def in_real_time(shots: Iterable[Shot], name: str, rate: float | None = None) -> Iterator[Shot]:
    """Each frame no earlier than its timestamp says, counted from the first.

    Args:
        rate: frames a second of a source without times.

    Raises:
        InputError: frames without times, and no rate.
    """
    began: float | None = None
    for shot in shots:
        seconds = shot.number / rate if rate and math.isnan(shot.seconds) else shot.seconds
        if math.isnan(seconds):
            raise InputError(f"{name} has no times; expected a video for --realtime")
        began = time.monotonic() - seconds if began is None else began
        time.sleep(max(0.0, began + seconds - time.monotonic()))
        yield shot
