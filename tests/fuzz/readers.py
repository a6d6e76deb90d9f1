"""Every reader of the package, on mutated input: a new one is a function with `@reader`.

A reader makes its input in `case.folder`, the current folder, from the files its makers made once, calls
`case.begin()`, and runs. It returns where the input is accepted and lets every exception pass.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import NamedTuple

import h5py
import numpy as np
import torch
from torch import Tensor

from dejavu_torch.cli.names import function_of
from dejavu_torch.cli.parser import parse
from dejavu_torch.cli.presets import FOLDER
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.camera import Camera
from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.matches import read_matches
from dejavu_torch.maps.codec import Stream, decode, encode
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import contents as contents_of
from dejavu_torch.training.checkpoint import read_checkpoint
from dejavu_torch.types import Match

from .inputs import (
    checkpoints,
    images,
    inputs,
    maps,
    matches_text,
    pictures,
    videos,
)
from .mutations import (
    NUMBERS,
    TEXTS,
    mutate_bytes,
    mutate_text,
)


class Wrong(AssertionError):
    """What a reader finds itself: damage that nothing noticed, values out of range."""


class Case:
    """One case: what decides it, its folder with `in` and `out`, and where the makers' files are."""

    def __init__(self, random: Random, folder: Path, made: Path) -> None:
        self.random, self.folder, self._made = random, folder, made
        self.begin = lambda: None  # the input is there: from here on files are watched

    def made(self, maker):
        """The folder of what a maker made."""
        return self._made / maker.__name__


Maker, Run = Callable[[Path], None], Callable[[Case], None]


class Reader(NamedTuple):
    """share: of all cases, relative to the others'."""

    name: str
    run: Run
    makers: tuple[Maker, ...]
    share: float


READERS = {}


def reader(name, *makers, share=1.0):
    """Register a reader."""

    def register(run):
        READERS[name] = Reader(name, run, makers, share)
        return run

    return register


# what is read ---------------------------------------------------------------------------------------------


def take(traverse, most=4):
    """Read the beginning of a traverse and check what comes."""
    traverse.frame_shape  # noqa: B018
    for i, batch in enumerate(traverse.batches(8)):
        if batch.ndim == 4 and not (batch.isfinite().all() and batch.min() >= 0 and batch.max() <= 1):
            raise Wrong("frames out of [0, 1]")
        if i == most:
            break
    assert len(traverse.names) in (0, len(traverse))


def same_model(first, second):
    """Whether two maps hold the same tensors and settings."""
    (tensors, header), (others, other) = contents_of(first), contents_of(second)
    settings = json.dumps(header, sort_keys=True) == json.dumps(other, sort_keys=True)
    alike = settings and tensors.keys() == others.keys()
    return alike and all(same_tensor(tensors[name], others[name]) for name in tensors)


def same_tensor(one, other):
    alike = one.dtype == other.dtype and one.shape == other.shape
    return alike and torch.equal(one.nan_to_num(), other.nan_to_num())


# maps -----------------------------------------------------------------------------------------------------


@reader("damaged map", maps, share=2)
def damaged_map(case):
    path, data = case.random.choice(sorted(case.made(maps).iterdir())), Path("in/map.safetensors")
    data.write_bytes(mutate_bytes(case.random, path.read_bytes()))
    case.begin()
    model = DejaVu.load(data)
    if not same_model(model, DejaVu.load(path)):
        raise Wrong("a damaged map loads as another")


@reader("codec", share=1)
def codec(case):
    random = case.random
    rows, columns = random.randint(1, 30), random.randint(1, 8)
    numbers = [int(random.gauss(0, 9)) for _ in range(rows * columns)]
    levels = torch.tensor(numbers).view(rows, columns).to(torch.int8)
    stream = encode(levels)
    data, checksum, sizes = bytes(stream.bytes.tolist()), stream.checksum, [rows, columns]
    act = random.random()
    if act < 0.5:
        data = mutate_bytes(random, data)
    elif act < 0.9:
        sizes[random.randrange(2)] = random.choice((0, -1, rows + 1, columns - 1, 1000, 10**6, 10**9, 2**62))
    else:
        checksum = random.choice((0, -1, checksum ^ 1, 2**62))
    case.begin()
    found = decode(Stream(torch.tensor(list(data), dtype=torch.uint8), checksum), *sizes)
    if sizes != [rows, columns] or not torch.equal(found, levels):
        raise Wrong("a damaged stream decodes to other levels")


# checkpoints ----------------------------------------------------------------------------------------------


@reader("checkpoint", checkpoints, share=1)
def checkpoint(case):
    """Damage is seen."""
    path, data = case.made(checkpoints) / "last.ckpt", Path("in/last.ckpt")
    data.write_bytes(mutate_bytes(case.random, path.read_bytes()))
    case.begin()
    read, whole = read_checkpoint(data)["state_dict"], read_checkpoint(path)["state_dict"]
    for name, value in whole.items():
        if not (same_tensor(value, read[name]) if isinstance(value, Tensor) else value == read[name]):
            raise Wrong(f"a damaged checkpoint loads as another: {name}")


# configs ---------------------------------------------------------------------------------------------------


@reader("config", share=1.5)
def config(case):
    random = case.random
    text = (FOLDER / f"{random.choice(('default', 'local_maxima', 'paper'))}.yaml").read_text()
    lines = [line.partition("#")[0].rstrip() for line in text.splitlines()]
    Path("in/config.yaml").write_bytes(mutate_text(random, "\n".join(filter(str.strip, lines))))
    case.begin()
    parse("learn", function_of("learn"), ["in/frames.npy", "--map", "out/m", "--config", "in/config.yaml"])


# sources of frames -----------------------------------------------------------------------------------------


@reader("npy", share=2)
def npy(case):
    random, path = case.random, Path("in/array.npy")
    noise = np.random.default_rng(random.randrange(2**32))
    features, frames = noise.normal(size=(9, 5)).astype(np.float32), noise.random((4, 1, 8, 8))
    array = random.choice((pictures(9, 8), features, frames))
    act = random.random()
    if act < 0.2:
        array = array.astype(np.float64)
        array.flat[random.randrange(array.size)] = random.choice((np.nan, np.inf, -1.0, 1e30, 2.0, 1e-40))
        with np.errstate(over="ignore"):
            array = array.astype(random.choice((np.float16, np.float32, np.float64)))
    elif act < 0.4:
        kinds = ("<i8", ">f4", "<c8", "O", "S3", "U4", "?", "<M8[s]", "<f2", "V8", "f4,i4", "<u2")
        array = np.zeros(random.choice((array.shape, (3, 4))), random.choice(kinds))
    written = io.BytesIO()
    np.save(written, array, allow_pickle=True)
    data = written.getvalue()
    if act > 0.7:
        data = mutate_bytes(random, data)
    elif act > 0.4:  # other sizes than are there
        shape = ", ".join(str(random.choice((*NUMBERS[:16], 3))) for _ in range(random.randint(0, 5)))
        kind = random.choice(("|u1", "<f4", "O", "<f8"))
        text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n".encode()
        data = b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + data[data.index(b"\n") + 1 :]
    path.write_bytes(data)
    case.begin()
    traverse = open_source(path)
    take(traverse)


@reader("h5", share=1)
def h5(case):
    random, written = case.random, io.BytesIO()
    noise = np.random.default_rng(random.randrange(2**32))
    with h5py.File(written, "w", libver=random.choice(("latest", "earliest"))) as file:
        for i in range(9):
            file[f"db/{i}.jpg/global_descriptor"] = noise.normal(size=5).astype(np.float16)
    Path("in/a.h5").write_bytes(mutate_bytes(random, written.getvalue()))
    case.begin()
    take(open_source(f"in/a.h5{random.choice(('', '?order=natural', '?order=lexicographic'))}"))


@reader("names", share=0.5)
def names_beside_features(case):
    random = case.random
    np.save("in/a.npy", np.random.default_rng(0).normal(size=(9, 5)))
    text = "".join(f"@{500_000 + i}@{4_000_000 + i}@.jpg\n" for i in range(9))
    Path("in/a.txt").write_bytes(mutate_text(random, text) if random.random() < 0.8 else text.encode())
    case.begin()
    traverse = open_source("in/a.npy")
    take(traverse)
    find_ground_truth("utm:2", traverse, traverse, 9, 9)


def mutated_image(random, folder):
    """An image's suffix and its bytes."""
    path = random.choice(sorted(folder.iterdir()))
    if random.random() < 0.1:
        sides = (*NUMBERS, 24, 5000, 9000, 13_000, 20_000)
        head = f"P{random.choice('123456789')}\n{random.choice(sides)} {random.choice(sides)}\n255\n"
        return random.choice((".pgm", ".ppm")), head.encode() + bytes(10**6)
    suffix = random.choice((path.suffix, path.suffix, path.suffix, ".png", ".tif", ".webp", ".pgm"))
    return suffix, mutate_bytes(random, path.read_bytes())


@reader("image", images, share=1.5)
def image_folder(case):
    random, folder = case.random, Path("in/photos")
    folder.mkdir()
    for i in range(2):
        shutil.copy(case.made(images) / "colour.png", folder / f"{i}.png")
    for _ in range(random.choice((1, 1, 3))):
        suffix, data = mutated_image(random, case.made(images))
        odd_names = ("a\nb", "é", "\udcff", "\x1b[31m", "٣", "1" * 200, "9" * 249, "-", " ")
        name = random.choice(("5", "5", "5", *odd_names))
        (folder / f"{name}{suffix}").write_bytes(data)
    if random.random() < 0.2:
        (folder / "folder.png").mkdir()
        (folder / "7.png").symlink_to("missing.png")
    case.begin()
    take(open_source(f"{folder}{random.choice(('', '', '', '?width=8', '?height=5&width=9'))}"))


@reader("strip", images, share=0.5)
def strip(case):
    suffix, data = mutated_image(case.random, case.made(images))
    path = Path(f"in/strip{suffix}")
    path.write_bytes(data)
    case.begin()
    take(open_source(f"strip:{path}?width=8" + case.random.choice(("", "&rows=1:8", "&halve=1", "&grey=1"))))


@reader("video", videos, share=1)
def video(case):
    random = case.random
    path = random.choice(sorted(case.made(videos).iterdir()))
    suffix = random.choice((path.suffix, path.suffix, path.suffix, ".mp4", ".avi", ".webm", ".wmv"))
    clip = Path(f"in/clip{suffix}")
    clip.write_bytes(mutate_bytes(random, path.read_bytes()))
    case.begin()
    take(open_source(f"{clip}{random.choice(('', '', '?width=8', '?start=3&stop=9&step=2'))}"))


@reader("stream", videos, share=1)
def stream(case):
    """A pipe of bytes that may break off or go on as another video."""
    random = case.random
    first, second = (random.choice(sorted(case.made(videos).iterdir())).read_bytes() for _ in range(2))
    broken = first[: random.randrange(len(first))] + second
    data = mutate_bytes(random, first) if random.random() < 0.7 else broken
    size = random.choice((None, None, (16, 16), (32, 48), (1, 1)))
    reading, writing = os.pipe()
    threading.Thread(target=_send, args=(writing, data), daemon=True).start()
    case.begin()
    with open(reading, "rb", buffering=0):
        for shot in Camera(f"/dev/fd/{reading}", size):
            high, wide = size or shot.pixels.shape[:2]
            if shot.pixels.dtype != np.uint8 or shot.pixels.shape != (high, wide, 3):
                raise Wrong(f"frames {shot.pixels.shape} {shot.pixels.dtype}")


def _send(pipe, data):
    with suppress(OSError), open(pipe, "wb") as file:
        file.write(data)


PLAUSIBLE = ("0", "1", "2", "3", "5", "8", "20", "25", "1:2", "3:9", "true", "-1", "100")
SOURCES = """
in/frames.npy?start=1&stop=9&step=2 in/features.npy in/photos?width=8&height=6 in/photos?start=2
in/clip.mp4?width=8&stop=5 strip:in/strip.png?width=8&rows=2:12&halve=1&grey=1 in/a_file in/empty in/strip.png
sim:aerial?seed=1&traverse=1&frames=40 sim:outdoor?frames=20&seed=2 sim:underground?frames=20&step=2
sim:railway?frames=20&traverse=1 sim:aerial?frames=30&start=3&stop=20
sim:terrain?metres=32&stride=16&traverse=1
"""


@reader("source", inputs, share=2)
def source(case):
    random = case.random
    shutil.copytree(case.made(inputs), "in", dirs_exist_ok=True)
    text = random.choice(SOURCES.split())
    if random.random() < 0.6 and "?" in text:
        address, _, query = text.partition("?")
        options = query.split("&")
        at = random.randrange(len(options))
        value = random.choice(random.choice((PLAUSIBLE, NUMBERS, TEXTS)))
        options[at] = f"{options[at].partition('=')[0]}={value}"
        text = f"{address}?{'&'.join(options)}"
    else:
        text = mutate_text(random, text).decode(errors="surrogateescape")
    case.begin()
    take(open_source(text), 1)


# truths and matches ----------------------------------------------------------------------------------------


@reader("truth table", share=1.5)
def truth_table(case):
    random = case.random
    header = random.choice(("query,place\n", "query,place,place\n", "", "query;place\n"))
    rows = "".join(f"{i},{(i + random.randint(-1, 1)) % 30}\n" for i in range(12))
    Path("in/truth.csv").write_bytes(mutate_text(random, header + rows))
    judge(case, "in/truth.csv")


@reader("truth lists", share=0.5)
def truth_lists(case):
    random = case.random
    held = [[i, (i + random.randint(0, 2)) % 30] for i in range(12)]
    Path("in/truth.json").write_bytes(mutate_text(random, json.dumps(held)))
    judge(case, "in/truth.json")


@reader("truth matrices", share=1)
def truth_matrices(case):
    random, path = case.random, Path("in/truth.npz")
    kinds = (bool, np.uint8, np.float32, "O", "U3", "<c8", "V4", "<M8[s]")
    matrix = np.eye(30, 12)
    arrays = {"GThard": matrix.astype(bool), "GTsoft": matrix[::-1].astype(bool)}
    act = random.random()
    if act < 0.3:
        name = random.choice(sorted(arrays))
        kind = random.choice(kinds)
        arrays[name] = np.zeros((30, 12), kind) if kind in kinds[3:] else matrix.astype(kind)
        arrays[name] = random.choice((arrays[name], arrays[name].T, arrays[name][:5], arrays[name][None]))
    elif act < 0.4:
        arrays["GThard"] = np.where(matrix > 0, random.choice((np.nan, np.inf, -1, 0)), 0)
    np.savez_compressed(path, **arrays)
    data = path.read_bytes()
    path.write_bytes(mutate_bytes(random, data) if act > 0.4 else data)
    judge(case, str(path))


@reader("truth text", share=1)
def truth_text(case):
    random = case.random
    plain = random.choice(("0", "-1", "12", "utm", "utm:25", "in/truth.csv"))
    text = mutate_text(random, plain).decode(errors="surrogateescape")
    names = [f"@{500_000 + i}@{4_000_000 + i}@.png" for i in range(12)]
    if random.random() < 0.6:
        at = random.randrange(12)
        names[at] = mutate_text(random, names[at]).decode(errors="replace")
        text = random.choice(("utm", "utm:25", "utm:1e300", "utm:0"))
    traverse = ArrayTraverse(pictures(12))
    traverse.names = names
    judge(case, text, traverse)


def judge(case, truth, traverse=None):
    """Twelve matches by a truth."""
    random = case.random
    resampled, interpolate = random.random() < 0.2, random.random() < 0.3
    case.begin()
    known = find_ground_truth(truth, traverse, traverse, 30, 12, interpolate, resampled)
    if known is None:
        raise Wrong("a truth that is given is none")
    if len(known.positives) != 12 or int(known.positives.max()) >= 30 or int(known.positives.min()) < -1:
        raise Wrong(f"right places {known.positives.tolist()}")
    found = Match(torch.arange(12), torch.arange(12) / 12, torch.ones(12, dtype=torch.bool))
    scores = evaluate(found, known, random.choice((0, 2, 100, 2**31, 2**62)))
    if not all(math.isfinite(value) for value in scores if isinstance(value, float)):
        raise Wrong(f"scores {scores}")


@reader("matches", share=1.5)
def matches(case):
    random = case.random
    text = matches_text()
    if random.random() < 0.3:
        rows = [f"{i // 2},{i},{i / 10},1,{1 + i % 2}\n" for i in range(12)]
        text = "query,place,score,accepted,rank\n" + "".join(rows)
    Path("in/matches.csv").write_bytes(mutate_text(random, text))
    case.begin()
    read_matches(Path("in/matches.csv"))
