"""A live page, served to this machine alone by the standard library."""

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
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dejavu_torch.data.camera import Frame
from dejavu_torch.live.localizer import LiveMatch
from dejavu_torch.types import Facts, InputError, Traverse, expect

HOST = "127.0.0.1"
PORT = 8765  # default
COLUMNS = 512  # of the curve
WIDTH = 640  # maximum, of pictures in pixels
PAGE = Path(__file__).with_name("page.html")


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
        reference: gives pictures of the reference's frames.

    Convention: only requests for 127.0.0.1 and localhost are answered, so that other sites cannot read the
        page through a host name that resolves to this machine.
    """

    def __init__(
        self, port: int = PORT, title: str = "", reference: Callable[[int], str | None] | None = None
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
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
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
        """What the page polls; only the number of the frame if the page has `seen` it."""
        if self.snapshot is None:
            return {"title": self.title, "number": -1}
        frame, match, scores, posterior, *counts = self.snapshot
        facts: Facts = {"title": self.title, "number": frame.number}
        if seen == str(frame.number):
            return facts
        facts |= match._asdict() | {"time": frame.seconds}
        facts |= zip(("frames", "dropped", "p50", "p99"), counts, strict=True)
        return without_nan(facts) | {
            "places": len(scores) - posterior,
            "off": round(float(scores[-1]), 6) if posterior else None,
            "kind": "Posterior along the route" if posterior else "Relative match along the route (best = 1)",
            "curve": curve(scores, posterior),
            "query": as_picture(frame.pixels),
            "reference": self.reference(match.frame) if self.reference and match.frame >= 0 else None,
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
    """Pictures of the frames of the map's reference, for `Page`, read as they are asked for."""

    def __init__(self, reference: Traverse, frames: int) -> None:
        seen = f"{reference.name} has {len(reference)} frames"
        expect(len(reference) == frames, f"{frames}, as the map's reference", seen)
        expect(len(reference.frame_shape) == 3, "frames to show", f"{reference.name} holds features")
        self.reference, self._one_at_a_time = reference, threading.Lock()  # requests come in threads

    def __call__(self, frame: int) -> str | None:
        with suppress(InputError), self._one_at_a_time:  # the image was removed
            return as_picture(self.reference[frame])
        return None
