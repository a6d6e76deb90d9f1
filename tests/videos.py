"""Video files and streams that tests write, and which of their frames is which."""

from __future__ import annotations

import os
import threading
from contextlib import contextmanager, suppress
from fractions import Fraction

import av
import numpy as np

H264 = {"codec": "libx264", "pixels": "yuv420p"}


def pictures(n, height=32, width=48):
    """(n,H,W,3): frame i has grey level 8 * i on its left half, noise of its own on the right one."""
    frames = np.random.default_rng(0).integers(0, 256, (n, height, width, 3), np.uint8)
    frames[:, :, : width // 2] = 8 * np.arange(n, dtype=np.uint8)[:, None, None, None]
    return frames


def clip(
    path,
    frames,
    codec="ffv1",
    pixels="bgr0",
    ticks=None,
    bframes=None,
    group=None,
    turn=None,
    options=None,
    base=Fraction(1, 25),
    aspect=None,
):
    """Write frames at 25 per second, or at the given multiples of the time base, `group` from one key frame
    to the next."""
    with av.open(str(path), "w", options=options or {}) as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt, stream.bit_rate = pixels, 4_000_000
        stream.codec_context.time_base = base
        if aspect is not None:  # of a pixel
            stream.codec_context.sample_aspect_ratio = aspect
        if bframes is not None:
            stream.codec_context.max_b_frames = bframes
        if group is not None:
            stream.codec_context.gop_size = group
        if turn is not None:
            stream.set_display_rotation(turn)
        for i, pixel in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixel, "rgb24")
            frame.pts, frame.time_base = i if ticks is None else ticks[i], base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def numbers(frames):
    """Which of `pictures` each frame is."""
    return (frames[:, :, 4:-4, 4:16].mean((1, 2, 3)) * 255 / 8).round().int().tolist()


@contextmanager
def piped(folder, data, open_for=0):
    """A named pipe that gives these bytes, once, and stays open for so many seconds."""
    path, done = folder / "pipe", threading.Event()
    os.mkfifo(path)

    def write():
        with suppress(BrokenPipeError), path.open("wb") as pipe:
            pipe.write(data)
            pipe.flush()
            done.wait(open_for)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    try:
        yield str(path)
    finally:
        done.set()
        writer.join(5)
