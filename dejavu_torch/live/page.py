"""A page of what happens live, served on this machine alone by the standard library."""

from __future__ import annotations

import base64
import io
import json
import math
import threading
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dejavu_torch.data.camera import Frame
from dejavu_torch.data.frame_range import IndexedTraverse
from dejavu_torch.live.localizer import LiveMatch
from dejavu_torch.types import InputError, Traverse

HOST = "127.0.0.1"
PORT = 8765  # by default
COLUMNS = 512  # of the curve
WIDTH = 640  # of pictures, pixels at most
KEPT, SMALL = 20_000, 160  # pictures of a reference that is only read in order, and their width
PAGE = Path(__file__).with_name("page.html")


class Snapshot(NamedTuple):
    """What the page shows of one frame: `scores` (N,), or a `posterior` (N+1,); p50, p99 in milliseconds."""

    frame: Frame
    match: LiveMatch
    scores: Tensor
    posterior: bool
    frames: int
    dropped: int
    p50: float
    p99: float


class Page:
    """Serves the page at http://127.0.0.1:PORT/ from threads of its own, as a context manager.

    Args:
        port: 0 is any that is free; `url` says which. One in use is refused.
        title: a line below the heading.
        reference: gives pictures of the reference's frames.

    Convention: only requests for 127.0.0.1 and localhost are answered, so that no other site can ask for it
        by a name of its own.
    """

    def __init__(
        self, port: int = PORT, title: str = "", reference: Callable[[int], str | None] | None = None
    ) -> None:
        if not 0 <= port < 2**16:
            raise InputError(f"port {port}; expected one from 0 to 65535, 0 being any that is free")
        self.title, self.reference = title, reference
        self.snapshot: Snapshot | None = None
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                page.answer(self)

            def log_message(self, *_: Any) -> None:
                pass

        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except OSError as error:
            seen = f"port {port} of {HOST} cannot be had: {error.strerror}"
            raise InputError(f"{seen}; expected a free one, such as 0 finds") from error
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"

    def __enter__(self) -> Page:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, snapshot: Snapshot) -> None:
        """Show this frame from the next request on."""
        self.snapshot = snapshot

    def answer(self, request: BaseHTTPRequestHandler) -> None:
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
        with suppress(OSError):  # who asked has left
            request.send_response(status)
            request.send_header("Content-Type", kind)
            request.send_header("Content-Length", str(len(body)))
            request.send_header("Cache-Control", "no-store")
            request.end_headers()
            request.wfile.write(body)

    def state(self, seen: str = "") -> dict[str, Any]:
        """What the page asks for again and again; little of a frame whose number it has `seen`."""
        if self.snapshot is None:
            return {"title": self.title, "number": -1}
        frame, match, scores, posterior, *counts = self.snapshot
        facts: dict[str, Any] = {"title": self.title, "number": frame.number}
        if seen == str(frame.number):
            return facts
        facts |= match._asdict() | {"time": frame.seconds}
        facts |= zip(("frames", "dropped", "p50", "p99"), counts, strict=True)
        return without_nan(facts) | {
            "places": len(scores) - posterior,
            "off": round(float(scores[-1]), 6) if posterior else None,
            "kind": "Posterior over the route" if posterior else "Match over the route, the best place 1",
            "curve": curve(scores, posterior),
            "query": as_picture(frame.pixels),
            "reference": self.reference(match.frame) if self.reference and match.frame >= 0 else None,
        }


def without_nan(facts: dict[str, Any]) -> dict[str, Any]:
    """The facts for JSON, which has no NaN and no infinity."""
    lost = [key for key, value in facts.items() if isinstance(value, float) and not math.isfinite(value)]
    return facts | dict.fromkeys(lost)


def curve(scores: Tensor, posterior: bool) -> list[float]:
    """What the page draws of all places, as at most `COLUMNS` heights in [0, 1]: of scores (N,) that of the
    best place in a column, 1 for the best of all and 0 for the worst; of a posterior (N+1,) the sum."""
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
    """A frame, (H,W,3) uint8 or (C,H,W) float, as the address of a JPEG in itself; None of ready features."""
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
    """Pictures of the frames of the map's reference, which has so many, for `Page`.

    Of a traverse that can only be read in order, as a video, a thread makes small pictures of at most `KEPT`
    frames, of which the nearest is shown.
    """

    def __init__(self, reference: Traverse, frames: int) -> None:
        if reference.length not in (None, frames):
            seen = f"{reference.name} has {reference.length} frames"
            raise InputError(f"{seen}; the map's reference has {frames}")
        if len(reference.frame_shape) != 3:
            raise InputError(f"{reference.name} holds features; expected frames to show")
        self.reference, self.step = reference, max(1, math.ceil(frames / KEPT))
        self._small: list[str | None] = []
        if not isinstance(reference, IndexedTraverse):
            threading.Thread(target=self._read, daemon=True).start()

    def __call__(self, frame: int) -> str | None:
        if isinstance(self.reference, IndexedTraverse):
            try:
                return as_picture(next(self.reference.between(frame, frame + 1))[0])
            except InputError:  # an image that is not there any more
                return None
        near = round(frame / self.step)
        return self._small[near] if near < len(self._small) else None

    def _read(self) -> None:
        with suppress(InputError):  # the pictures so far stay
            for i, batch in enumerate(self.reference.batches(1)):
                if i % self.step == 0:
                    self._small.append(as_picture(batch[0], SMALL))
