"""`dejavu live`: frames in, lines of JSON and a page out."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack, suppress

import numpy as np

from dejavu_torch.cli.process import interrupts_raise, output_problem
from dejavu_torch.data.camera import Camera, Frame, is_stream, shots_of, stretched
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import at_size
from dejavu_torch.data.turning import Turned, facing_north
from dejavu_torch.live.feed import FrameReader, in_real_time
from dejavu_torch.live.localizer import LiveLocalizer, LiveMatch
from dejavu_torch.live.page import Page, ReferencePictures, Snapshot, without_nan
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.querying import DRIVES, Drives
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Odometer, SequenceModel, expect

RECENT = 10_000  # answers whose times are kept
RATE = 10  # frames per second on the page, for a source without times

log = logging.getLogger("dejavu_torch")


def _pictures_of(model: DejaVu, reference: str) -> ReferencePictures:
    """The pictures of the map's reference, or an InputError."""
    layout = model.map.layout
    layout.expect_one("the map of one route, or no --reference", f"--reference {reference}: the map")
    traverse = open_source(reference)
    same = layout.same(traverse.layout)
    expect(same, "the area of the map", f"--reference {reference} is another one")
    return ReferencePictures(traverse, len(model.map.positions) or model.map.places)


def follow(
    model: DejaVu,
    sequence: SequenceModel | None,
    source: str,
    title: str,
    port: int | None = None,
    reference: str | None = None,
    realtime: bool = False,
    timeout: float = 10.0,
    centre: bool = False,
    asked: Drives = DRIVES,
) -> None:
    """Localize the frames of a source until it ends or Ctrl-C; see `run_live`.

    Convention: with a page, a file plays in real time, and the page stays until Ctrl-C. With a lag, frames
        that wait for their answers get them at the end of the source, but not after Ctrl-C.

    Raises:
        InputError: the source fails; the lines and the summary of earlier frames are printed first.
    """
    shown = port is not None
    frames, newest, name, turned, odometer = frames_from(source, model, realtime, shown, sequence, asked)
    localizer = LiveLocalizer(model, sequence, shown, centre, turned, asked)
    title += f"; answers come {localizer.lag} frames later and use these" if localizer.lag else ""
    recent: deque[float] = deque(maxlen=RECENT)  # milliseconds
    waiting: deque[Frame] = deque()  # for their answers
    count = 0
    with ExitStack() as stack:
        page = None
        if port is not None:
            pictures = None
            if reference is not None:
                pictures = stack.enter_context(_pictures_of(model, reference))
            page = stack.enter_context(Page(port, title, pictures))
            _log(f"the page is at {page.url}")
        reader = stack.enter_context(
            FrameReader(frames, newest, timeout if is_stream(source) else None, name)
        )

        def tell(matches: list[LiveMatch]) -> None:
            nonlocal count
            for match in matches:
                frame = waiting.popleft()
                recent.append(match.milliseconds)
                count += 1
                print(line_of(frame, match))
            if matches and page is not None and localizer.scores is not None:
                posterior = localizer.posterior
                drawn = localizer.scores if posterior is None else posterior
                stats = (count, reader.dropped, *percentiles(recent))
                page.show(Snapshot(frame, match, drawn, posterior is not None, *stats))

        try:
            with interrupts_raise(), suppress(KeyboardInterrupt):
                latest = -1
                try:
                    for frame in reader:
                        moved = None
                        if odometer is not None and latest >= 0:
                            moved = odometer.between(latest, frame.number)
                        matches = localizer.due(frame.pixels, frame.number - latest - 1, moved)
                        latest = frame.number
                        waiting.append(frame)
                        tell(matches)
                        if isinstance(output_problem(), BrokenPipeError):
                            return
                except InputError:
                    tell(localizer.finish())
                    raise
                tell(localizer.finish())
                if page is not None and not is_stream(source):
                    _stay(page.url)
        finally:
            if count:
                p50, p99 = percentiles(recent)
                times = f"milliseconds per frame: p50 {p50:.1f}, p99 {p99:.1f}"
                acceptance = model.acceptance(sequence)
                default = "" if acceptance.given else f"; {acceptance}"
                _log(f"{count} frames, {reader.dropped} dropped; {times}{default}")


def _stay(url: str) -> None:
    _log(f"that was the last frame; the page stays at {url} until Ctrl-C")
    while True:
        time.sleep(3600)


def frames_from(
    source: str, model: DejaVu, realtime: bool, shown: bool, sequence: SequenceModel | None, asked: Drives
) -> tuple[Iterable[Frame], bool, str, bool, Odometer | None]:
    """The frames of a source, whether older ones are dropped, its name, whether they are turned north, and
    what an odometer reads at them.

    Args:
        shown: on a page, for which a file is played in real time.
    """
    shape = model.frame_shape
    size = (shape[1], shape[2]) if shape is not None and len(shape) == 3 else None
    if is_stream(source):
        camera = Camera(source, size)
        expect(not realtime, "a video file with it", f"--realtime: {camera.name} is live already")
        told = "a file with it, or LiveLocalizer(...)(frame, moved=...) in Python"
        expect(asked.moved is None, told, f"--moved {asked.moved}: {camera.name} is live")
        return _with_warning(camera), True, camera.name, False, None
    traverse = open_source(source)
    own = traverse.frame_shape[1:]
    if size is not None and len(own) == 2 and own != size and not traverse.sized:
        if note := stretched(traverse.name, own, size):
            log.warning("%s", note)
        traverse = at_size(traverse, size)
    moved = model.moved(traverse, asked, sequence)
    traverse = facing_north(traverse, model.map.layout)
    frames = shots_of(traverse)
    if realtime or shown:
        frames = in_real_time(frames, traverse.name, None if realtime else RATE)
    return frames, realtime, traverse.name, isinstance(traverse, Turned), moved


def _with_warning(camera: Camera) -> Iterable[Frame]:
    for frame in camera:
        if camera.note and not frame.number:
            log.warning("%s", camera.note)
        yield frame


def line_of(image: Frame, match: LiveMatch) -> str:
    """An answer as a line of JSON."""
    answer = match._asdict() | {"milliseconds": round(match.milliseconds, 3)}
    names = ("place", "frame", "route", "x", "y", "shift", "shift_degrees", "stale")
    place, frame, route, x, y, shift, turn, stale = (answer.pop(name) for name in names)
    facts = {"frame": image.number, "time": image.seconds, "place": place, "reference_frame": frame, **answer}
    numbers = {"x": x, "y": y, "shift": round(shift, 4), "shift_degrees": round(turn, 2)}
    facts |= {name: number for name, number in numbers.items() if not math.isnan(number)}
    facts |= {"stale": stale} if stale else {}
    return json.dumps(without_nan(facts | ({"route": route} if route else {})))


def percentiles(milliseconds: Iterable[float]) -> tuple[float, float]:
    """The p50 and p99 of some times."""
    p50, p99 = np.percentile([*milliseconds], (50, 99))
    return float(p50), float(p99)


def _log(text: str) -> None:
    print(f"dejavu: {printable(text)}", file=sys.stderr, flush=True)
