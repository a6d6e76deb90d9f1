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
    transfer=None,
):
    """Write frames at 25 per second, or at the given multiples of the time base, `group` from one key frame
    to the next; with a transfer function those of `high_range`."""
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
        tags = (
            {}
            if transfer is None
            else {"color_primaries": 9, "color_trc": transfer, "colorspace": 9, "color_range": 1}
        )
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for i, pixel in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixel, "rgb24" if transfer is None else "rgb48le")
            if transfer is not None:
                frame = frame.reformat(format=pixels, dst_colorspace=9, dst_color_range=1)
            for name, value in tags.items():
                setattr(frame, name, value)
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


def high_range(pictures, transfer):
    """(n,H,W,3) uint8 as a display of high dynamic range shows them with white at 203 cd/m2, (n,H,W,3) uint16
    with primaries of BT.2020 by SMPTE ST 2084 (16) or HLG (18), as FFmpeg numbers them."""
    light = (pictures / 255) ** 2.4  # of BT.1886
    light = light @ [[0.6274, 0.0691, 0.0164], [0.3293, 0.9195, 0.0880], [0.0433, 0.0114, 0.8956]]
    if transfer == 16:
        power = (0.0203 * light) ** 0.1593017578125
        values = ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    else:
        luminance = (0.203 * light @ [0.2627, 0.6780, 0.0593])[..., None].clip(1e-9)
        scene = 0.203 * light * luminance ** (1 / 1.2 - 1)
        bright = 0.17883277 * np.log((12 * scene - 0.28466892).clip(1e-9)) + 0.55991073
        values = np.where(scene <= 1 / 12, np.sqrt(3 * scene), bright)
    return (values * 65535).round().astype(np.uint16)
