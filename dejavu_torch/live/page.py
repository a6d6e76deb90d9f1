"""A live page, served to this machine alone by the standard library."""

from __future__ import annotations

import base64
import io
import json
import logging
import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import chain
from pathlib import Path
from typing import NamedTuple, TypeAlias
from urllib.parse import parse_qs, urlsplit

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dejavu_torch.data.camera import Frame
from dejavu_torch.data.traverse import Part, at_size
from dejavu_torch.data.video import Video
from dejavu_torch.live.localizer import LiveMatch
from dejavu_torch.types import Facts, InputError, Traverse, expect

HOST = "127.0.0.1"
PORT = 8765  # default
COLUMNS = 512  # of the curve
WIDTH = 640  # maximum, of pictures in pixels
SMALL, MOST = 320, 2**25  # pixels and characters, of the pictures of a video
BEFORE = 32  # frames before the one that is asked for, decoded with it
PAGE = Path(__file__).with_name("page.html")

Shown: TypeAlias = tuple[int, str | None]  # the number of a frame of the reference, and its picture
log = logging.getLogger("dejavu_torch")


class Snapshot(NamedTuple):
    """What the page shows of one frame."""

    frame: Frame
    match: LiveMatch
    scores: Tensor  # (N,), or (N+1,) if it is a posterior
    posterior: bool
    frames: int
    dropped: int
    p50: float  # milliseconds
    p99: float


class Page:
    """A context manager that serves the page at http://127.0.0.1:PORT/ from its own threads.

    Args:
        port: 0 is any free one, see `url`. A port in use is refused.
        title: a line below the heading.
        reference: gives the frame of the reference nearest to this one that can be shown, and its picture.

    Convention: only requests for 127.0.0.1 and localhost are answered, so that other sites cannot read the
        page through a host name that resolves to this machine.
    """

    def __init__(
        self, port: int = PORT, title: str = "", reference: Callable[[int], Shown] | None = None
    ) -> None:
        expect(0 <= port < 2**16, "one from 0 to 65535, 0 for any free one", f"port {port}")
        self.title, self.reference = title, reference
        self.snapshot: Snapshot | None = None
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                page.answer(self)

            def log_message(self, *_: object) -> None:
                pass

        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except OSError as error:
            seen = f"port {port} of {HOST} cannot be opened: {error.strerror}"
            raise InputError(f"{seen}; expected a free one, or 0 to find one") from error
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"

    def __enter__(self) -> Page:
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, snapshot: Snapshot) -> None:
        """Show this frame from the next request on."""
        self.snapshot = snapshot

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request for the page or its state."""
        host = request.headers.get("Host", "").partition(":")[0]
        address = urlsplit(request.path)
        body, kind, status = b"", "text/plain", HTTPStatus.OK
        if host not in (HOST, "localhost"):
            status = HTTPStatus.FORBIDDEN
        elif address.path == "/":
            body, kind = PAGE.read_bytes(), "text/html; charset=utf-8"
        elif address.path == "/state":
            seen = parse_qs(address.query).get("seen", [""])[0]
            body, kind = json.dumps(self.state(seen)).encode(), "application/json"
        else:
            status = HTTPStatus.NOT_FOUND
        with suppress(OSError):  # the browser has disconnected
            request.send_response(status)
            request.send_header("Content-Type", kind)
            request.send_header("Content-Length", str(len(body)))
            request.send_header("Cache-Control", "no-store")
            request.end_headers()
            request.wfile.write(body)

    def state(self, seen: str = "") -> Facts:
        """What the page polls. Of a frame that it has `seen`, "NUMBER,SHOWN", only the number, and the
        reference's picture if that of a nearer frame is known by now."""
        if self.snapshot is None:
            return {"title": self.title, "number": -1}
        frame, match, scores, posterior, *counts = self.snapshot
        facts: Facts = {"title": self.title, "number": frame.number}
        if seen == f"{frame.number},{match.frame}":
            return facts
        shown, picture = self.reference(match.frame) if self.reference and match.frame >= 0 else (-1, None)
        if seen == f"{frame.number},{shown}":
            return facts
        facts |= {"shown": shown, "reference": picture}
        if seen.partition(",")[0] == str(frame.number):
            return facts
        facts |= match._asdict() | {"time": frame.seconds}
        facts |= zip(("frames", "dropped", "p50", "p99"), counts, strict=True)
        return without_nan(facts) | {
            "places": len(scores) - posterior,
            "off": round(float(scores[-1]), 6) if posterior else None,
            "kind": "Posterior along the route" if posterior else "Relative match along the route (best = 1)",
            "curve": curve(scores, posterior),
            "query": as_picture(frame.pixels),
        }


def without_nan(facts: Facts) -> Facts:
    """The facts with None for NaN and infinity, which JSON does not have."""
    missing = [key for key, value in facts.items() if isinstance(value, float) and not math.isfinite(value)]
    return facts | dict.fromkeys(missing)


def curve(scores: Tensor, posterior: bool) -> list[float]:
    """At most `COLUMNS` heights in [0, 1] along the map. For scores (N,): the best place of a column, scaled
    from 0 for the worst to 1 for the best of all. For a posterior (N+1,): the sum of a column."""
    scores = scores.detach().float().cpu()
    places = len(scores) - posterior
    columns = min(COLUMNS, places)
    if posterior:
        heights = torch.zeros(columns).index_add_(0, torch.arange(places) * columns // places, scores[:-1])
    else:
        valid = scores.isfinite()
        worst, best = scores[valid].amax() if valid.any() else 0, scores.amin()
        heights = torch.where(valid, (worst - scores) / (worst - best).clamp(min=1e-12), 0).clamp(0, 1)
        heights = torch.nn.functional.adaptive_max_pool1d(heights[None], columns)[0]
    return [round(value, 6) for value in heights.tolist()]


def as_picture(pixels: np.ndarray | Tensor, width: int = WIDTH) -> str | None:
    """A frame, (H,W,3) uint8 or (C,H,W) float, as the data URL of a JPEG; None for ready features."""
    if isinstance(pixels, Tensor):
        if pixels.ndim != 3:
            return None
        pixels = (pixels.permute(1, 2, 0).clamp(0, 1) * 255).round().byte().cpu().numpy()
    image = Image.fromarray(np.ascontiguousarray(pixels if pixels.shape[2] == 3 else pixels[..., 0]))
    image.thumbnail((width, image.height))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"


class ReferencePictures:
    """A context manager that gives pictures of the frames of the map's reference, for `Page`.

    Args:
        most: characters of all pictures that are kept of a video.

    Convention: most sources are read as they are asked for. A video has to be decoded in order: a thread
        makes small pictures of its frames, from the first on, or on from shortly before the frame that is
        asked for; if they exceed `most`, it drops every second one. After each it rests as long as it worked,
        four times as long if the frame that is asked for is known.
    """

    def __init__(self, reference: Traverse, frames: int, most: int = MOST) -> None:
        seen = f"{reference.name} has {len(reference)} frames"
        expect(len(reference) == frames, f"{frames}, as the map's reference", seen)
        expect(len(reference.frame_shape) == 3, "frames to show", f"{reference.name} holds features")
        self.reference, self.most, self._one_at_a_time = reference, most, threading.Lock()
        self._known: dict[int, str] = {}  # of a video, by frame
        self._asked, self._closed, source = 0, threading.Event(), reference
        while isinstance(source, Part):
            source = source.traverse
        self._video = isinstance(source, Video)
        if self._video:
            height, width = reference.frame_shape[1:]
            size = (max(1, round(height * SMALL / width)), SMALL) if width > SMALL else (height, width)
            self.reference = at_size(reference, size)
            self._thread = threading.Thread(target=self._make, name="dejavu pictures", daemon=True)

    def __enter__(self) -> ReferencePictures:
        if self._video:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        if self._video:  # a thread that computes must not outlive the interpreter
            self._thread.join(10)

    def __call__(self, frame: int) -> Shown:
        if self._video:
            self._asked, known = frame, self._known
            nearest = min([*known], key=lambda one: abs(one - frame), default=-1)
            return nearest, known.get(nearest)
        with suppress(InputError), self._one_at_a_time:  # requests come in threads, and images may be gone
            return frame, as_picture(self.reference[frame])
        return frame, None

    def _make(self) -> None:
        at, step, size = 0, 1, 0
        try:
            while not self._closed.is_set():
                start, known = time.monotonic(), self._known
                asked = self._asked - self._asked % step
                rest = 4 if asked in known else 1
                if rest == 1 and not at <= asked <= at + BEFORE:
                    at = max(0, asked - BEFORE // step * step)
                order = chain(range(at, len(self.reference), step), range(0, at, step))
                if (at := next((i for i in order if i not in known), -1)) < 0:
                    return
                known[at] = as_picture(self.reference[at]) or ""
                size += len(known[at])
                if size > self.most:
                    step *= 2
                    self._known = known = {i: picture for i, picture in known.items() if i % step == 0}
                    size = sum(map(len, known.values()))
                at += step - at % step
                self._closed.wait(rest * (time.monotonic() - start))
        except InputError as error:
            log.warning("%s", error)
