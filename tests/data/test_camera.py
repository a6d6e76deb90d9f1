"""Streams: pipes and addresses as a camera gives them, and how each of them fails."""

from __future__ import annotations

import os
import re
import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch
from helpers import refused
from videos import H264, clip, numbers, pictures, piped

from dejavu_torch.data.camera import Camera, is_stream, stretched
from dejavu_torch.data.turning import QUARTERS, TURNS, Upright
from dejavu_torch.data.video import Video
from dejavu_torch.types import InputError

FRAMES = pictures(12)


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    """A stream of MPEG, which can begin and end anywhere."""
    return clip(tmp_path_factory.mktemp("stream") / "clip.ts", FRAMES, **H264).read_bytes()  # type: ignore[arg-type]


@contextmanager
def served(folder):
    """The address of a folder."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_a_pipe_gives_the_frames_of_the_file(tmp_path, stream):
    with piped(tmp_path, stream) as pipe:
        assert is_stream(pipe)
        shots = list(Camera(pipe))
    assert [shot.number for shot in shots] == [*range(12)]
    assert np.diff([shot.seconds for shot in shots]) == pytest.approx(1 / 25, abs=1e-3)
    pixels = torch.from_numpy(np.stack([shot.pixels for shot in shots])).permute(0, 3, 1, 2) / 255
    assert numbers(pixels) == [*range(12)]


def test_frames_are_brought_to_a_size_as_those_of_a_file(tmp_path, stream):
    (tmp_path / "clip.ts").write_bytes(stream)
    expected = Video(tmp_path / "clip.ts", width=24, height=16)[0]
    with piped(tmp_path, stream) as pipe:
        camera = Camera(pipe, (16, 24))
        first = next(iter(camera))
    assert camera.note == ""
    assert stretched("pipe", (32, 48), (16, 16)) == (
        "pipe: frames of 32 x 48 pixels are stretched to the map's 16 x 16"
    )
    assert torch.equal(torch.from_numpy(first.pixels.copy()).permute(2, 0, 1) / 255, expected)


@pytest.mark.parametrize("turn", TURNS)
def test_frames_are_turned_as_those_of_a_file(tmp_path, stream, turn):
    """And brought to the size that a map has of turned ones."""
    (tmp_path / "clip.ts").write_bytes(stream)
    size = (24, 16) if QUARTERS[turn] % 180 else (16, 24)
    expected = Upright(Video(tmp_path / "clip.ts", width=24, height=16), turn)[0]
    with piped(tmp_path, stream) as pipe:
        assert is_stream(f"{pipe}?turn={turn}")
        camera = Camera(f"{pipe}?turn={turn}", size)
        first = next(iter(camera))
    assert camera.note == ""
    assert torch.equal(torch.from_numpy(first.pixels).permute(2, 0, 1) / 255, expected)


def test_a_turn_that_is_none_is_refused():
    with refused("/dev/video0: turn=45", "expected 90, 180, 270"):
        Camera("/dev/video0?turn=45")


def test_the_end_of_an_address_is_told(tmp_path, stream):
    (tmp_path / "clip.ts").write_bytes(stream)
    with served(tmp_path) as address, refused("clip.ts ended after 12 frames", "expected more frames"):
        list(Camera(f"{address}/clip.ts"))


def test_an_open_pipe_is_one_by_whatever_name(stream):
    reading, writing = os.pipe()
    thread = threading.Thread(target=lambda: (os.write(writing, stream), os.close(writing)))
    thread.start()
    assert len(list(Camera(f"/dev/fd/{reading}"))) == 12
    thread.join()
    os.close(reading)


@pytest.mark.parametrize(
    "address",
    [
        "rtsp://me:secret@127.0.0.1:1/cam?token=hidden",
        "rtsp://me:sec/ret@127.0.0.1:1/cam#hidden",
        "srt://127.0.0.1:1?passphrase=hidden",
    ],
)
def test_messages_keep_what_only_the_user_of_an_address_is_to_know(address):
    with pytest.raises(InputError) as error:
        list(Camera(address))
    assert "://127.0.0.1:1" in str(error.value)
    assert not {"me", "secret", "sec", "hidden"} & set(re.findall(r"\w+", str(error.value)))


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("/dev/video99", ("/dev/video99 is not there", "a camera")),
        ("/dev/null", ("/dev/null", "a camera")),
        ("nothing://here", ("nothing://here", "a video stream")),
    ],
)
def test_what_is_no_stream_is_one_line(source, words):
    assert is_stream(source)
    with refused(*words):
        list(Camera(source))
