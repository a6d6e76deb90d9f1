"""`benchmarks live`: how fast single frames of a video are found on a long map."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate
from torch.utils.benchmark import Timer
from tqdm import tqdm

from benchmarks.measure import Column, Row, table, write_bench
from benchmarks.plots import plot_ratios
from dejavu_torch.data.camera import shots_of
from dejavu_torch.data.video import Video
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.live.feed import FrameReader, in_real_time
from dejavu_torch.live.localizer import LiveLocalizer
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.filter import PlaceFilter

RATE = 30  # frames per second
CAMERA = (480, 640)
SIZES = ((480, 640), (120, 160))  # of the frames that maps are learned from
NUMBERS = 128  # of a descriptor
NEAR = 5  # places
NOISE = 0.1  # between two views of a place, in standard deviations of a feature
COLUMNS: dict[str, Column] = {
    "p50 ms": ("seconds", ".1f", 1e-3),
    "p99 ms": ("seconds_p99", ".1f", 1e-3),
    "frames/s": ("rate", ".0f"),
    "cpu ms": ("cpu_seconds", ".1f", 1e-3),
    "frames": ("frames", ".0f"),
    f"dropped at {RATE}/s": ("dropped", ".0f"),
    "found": ("recall_at_1", ".3f"),
}
WARM = 10  # frames before timing starts


def bench_live(
    places: int = 100_000,
    frames: int = 300,
    sizes: Sequence[tuple[int, int]] = SIZES,
    camera: tuple[int, int] = CAMERA,
    numbers: int = NUMBERS,
) -> list[Row]:
    """Localize the frames of a video one by one on a map of many places, with HOG and the filter.

    Convention: the route is the video once, and otherwise its descriptors rotated at random, block by block,
        so that they change as on a real route. Only the time matters: the queries are the learned frames.

    Returns:
        case: size of the camera's and the map's frames. seconds: from a decoded frame to its place, the
        median; seconds_p99: the 99th percentile. rate: frames per second from the file, decoding in parallel;
        cpu_seconds: of all cores per frame, which other programs change little. dropped: frames dropped at
        `RATE` per second. recall_at_1: share found. parts: median seconds of decoding, features, whitening,
        scores and filter, each by itself; "search" is a single query without a filter.
    """
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        path = Path(folder) / "drive.mkv"
        write_drive(path, frames, camera)
        shown = tqdm(sizes, desc="live", disable=None, leave=False)
        rows = []
        for height, width in shown:
            video = Video(path, width=width, height=height)
            model, first = long_model(video, places, numbers)
            rows.append(live_row(video, camera, model, first))
        return rows


def live_row(video: Video, camera: tuple[int, int], model: DejaVu, first: int) -> Row:
    localizer = LiveLocalizer(model)
    found, milliseconds = 0, []
    with FrameReader(shots_of(video)) as reader:
        for frame in reader:
            if frame.number == WARM:
                began, busy = time.perf_counter(), time.process_time()
            match = localizer(frame.pixels)
            milliseconds.append(match.milliseconds)
            found += abs(match.place - first - frame.number) <= NEAR
    frames = len(milliseconds)
    rate = (frames - WARM) / (time.perf_counter() - began)
    cpu = (time.process_time() - busy) / (frames - WARM)
    p50, p99 = (float(p) / 1e3 for p in np.percentile(milliseconds[WARM:], (50, 99)))
    localizer.reset()
    with FrameReader(in_real_time(shots_of(video), "drive"), newest=True) as reader:
        for frame in reader:
            localizer(frame.pixels)
    (height, width), places = video.frame_shape[1:], model.map.places
    return {
        "case": f"{camera[0]} x {camera[1]} on a map of {height} x {width}",
        "contender": "dejavu",
        "seconds": p50,
        "seconds_p99": p99,
        "rate": rate,
        "cpu_seconds": cpu,
        "frames": frames,
        "dropped": reader.dropped,
        "recall_at_1": found / frames,
        "places": places,
        "route_bytes_per_place": model.map.summary().route_bytes / places,
        "threads": torch.get_num_threads(),
        "parts": parts_of(model, video),
    }


def write_drive(path: Path, frames: int, size: tuple[int, int]) -> None:
    """Write a video of a camera that moves along a texture, `RATE` frames per second of (height, width)."""
    import av

    height, width = size
    step = max(2, width // 40)
    generator = torch.Generator().manual_seed(0)
    length = width + step * frames
    ground = torch.zeros(1, 3, height, length)
    for cell in (64, 24, 8):  # pixels
        coarse = torch.rand(1, 3, height // cell + 2, length // cell + 2, generator=generator)
        ground += interpolate(coarse, (height, length), mode="bicubic") / 3
    pixels = ground[0].clamp(0, 1).mul(255).byte().permute(1, 2, 0).numpy()
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=RATE)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        for i in range(frames):
            part = np.ascontiguousarray(pixels[:, step * i : step * i + width])
            frame = av.VideoFrame.from_ndarray(part, "rgb24")
            frame.pts, frame.time_base = i, Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def long_model(video: Video, places: int, numbers: int) -> tuple[DejaVu, int]:
    """A model whose map holds the frames of a video among many places, and the place of the first one."""
    model = DejaVu(HOG(), Whitening(numbers=numbers)).eval()
    assert model.whitening is not None
    features = torch.cat([model.descriptor.describe(batch) for batch in video.batches(16)])
    generator = torch.Generator().manual_seed(0)
    noise = NOISE * features.std(0) * torch.randn(features.shape, generator=generator)
    model.whitening.learn(features, [(features + noise, torch.arange(len(features)))])
    own = model.whitening(features)
    blocks = -(-places // len(own))
    middle = (blocks - 1) // 2
    route = []
    for block in range(blocks):
        turn = torch.linalg.qr(torch.randn(own.shape[1], own.shape[1], generator=generator)).Q
        route.append(own if block == middle else own @ turn)
    model.learn_features(torch.cat(route)[:places])
    model.frame_shape = video.frame_shape
    return model, middle * len(own)


def parts_of(model: DejaVu, video: Video) -> dict[str, float]:
    """Median seconds of each part of the processing of a frame."""
    whitening, filter = model.whitening, PlaceFilter()
    assert whitening is not None
    began = time.perf_counter()
    decoded = sum(1 for _ in video.batches(1))
    seconds = {"decoding": (time.perf_counter() - began) / decoded}
    frame = video[:1]
    features, unpacked = model.descriptor.describe(frame), whitening.all_unpacked()
    descriptor = whitening(features, unpacked)
    scores, state = model.map.scores(descriptor), filter.start(model.map.places)
    works: dict[str, Callable[[], object]] = {
        "features": lambda: model.descriptor.describe(frame),
        "whitening": lambda: whitening(features, unpacked),
        "search": lambda: model.localize_descriptors(descriptor),
        "scores": lambda: model.map.scores(descriptor),
        "filter": lambda: filter.step(scores, state),
    }
    for name, work in works.items():
        timer = Timer("work()", globals={"work": work}, num_threads=torch.get_num_threads())
        seconds[name] = timer.blocked_autorange().median
    return seconds


def run_live(*, out: Path) -> list[str]:
    """Time of single frames of a video on a map of 100000 places.

    Args:
        out: folder for bench.json and bench.png
    """
    rows = bench_live()
    drawn = {}
    for row in rows:  # all have the same camera
        name = row["case"].partition(" on ")[2]
        parts = {"dejavu": row["seconds"]} | row["parts"]
        drawn[name] = {part: 1e3 * seconds for part, seconds in parts.items()}
    picture = plot_ratios(drawn, "milliseconds per frame (p50), and of each part by itself")
    write_bench(out, rows, picture, rate=RATE)
    columns: dict[str, Column] = {name: (name, ".1f", 1e-3) for row in rows for name in row["parts"]}
    figures = table([dict.fromkeys(columns) | row | row["parts"] for row in rows], COLUMNS | columns)
    note = "100000 places; found: within 5; columns from decoding on: milliseconds of each part"
    return [figures, note]
