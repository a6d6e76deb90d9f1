"""Every reader of the package, on mutated input: a new one is a function with `@reader`.

A reader makes its input in `case.folder`, the current folder, from the files its makers made once, calls
`case.begin()`, and runs. It returns where the input is accepted and lets every exception pass.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
import shutil
import struct
import threading
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import NamedTuple

import h5py
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dejavu_torch import cli
from dejavu_torch.cli import live, train
from dejavu_torch.cli.names import function_of
from dejavu_torch.cli.parser import parse
from dejavu_torch.cli.presets import FOLDER
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.camera import Camera
from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation import compare, reproduce
from dejavu_torch.evaluation import evaluate as evaluating
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.matches import read_matches
from dejavu_torch.features.hog import HOG
from dejavu_torch.live.localizer import LiveLocalizer
from dejavu_torch.maps.codec import Stream, decode, encode
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import contents as contents_of
from dejavu_torch.model_file import read_place_map
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.training.checkpoint import read_checkpoint
from dejavu_torch.types import InputError, Match

from .inputs import (
    TRAIN,
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
    TAGS,
    TEXTS,
    mutate_bytes,
    mutate_json,
    mutate_text,
    mutate_words,
)


class Wrong(AssertionError):
    """What a reader finds itself: damage that nothing noticed, values out of range."""


class Case:
    """One case: what decides it, its folder with `in` and `out`, and where the makers' files are."""

    def __init__(self, random: Random, folder: Path, made: Path) -> None:
        self.random, self.folder, self._made = random, folder, made
        self.words = []  # of a command line
        self.begin = lambda: None  # the input is there: from here on files are watched

    def made(self, maker):
        """The folder of what a maker made."""
        return self._made / maker.__name__

    def command(self, words):
        """Run a command line, which may write where its words say."""
        self.words = list(words)
        self.begin()
        cli.main(words)


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


def pick_map(case):
    return case.random.choice(sorted(case.made(maps).glob("*.safetensors")))


def damaged(random, data):
    """A map file with other bytes, or with another table of its tensors."""
    if random.random() < 0.7:
        return mutate_bytes(random, data)
    size = int.from_bytes(data[:8], "little")
    table = json.loads(data[8 : 8 + size])
    text = json.dumps(mutate_json(random, table)).encode()
    length = random.choice((len(text), len(text), len(text), 2**62, 0, len(text) + 1)).to_bytes(8, "little")
    return length + text + data[8 + size :]


@reader("damaged map", maps, share=2)
def damaged_map(case):
    path, data = pick_map(case), Path("in/map.safetensors")
    data.write_bytes(damaged(case.random, path.read_bytes()))
    case.begin()
    model = DejaVu.load(data)
    if not same_model(model, DejaVu.load(path)):
        raise Wrong("a damaged map loads as another")


@reader("map of matches", maps, share=0.5)
def map_of_matches(case):
    data = Path("in/map.safetensors")
    data.write_bytes(damaged(case.random, pick_map(case).read_bytes()))
    Path("in/matches.csv").write_text(matches_text())
    case.begin()
    read_place_map(data)
    evaluating.evaluate_file(Path("in/matches.csv"), "0", map=data)


@reader("map commands", maps, share=1)
def map_commands(case):
    path, data = pick_map(case), Path("in/map.safetensors")
    data.write_bytes(damaged(case.random, path.read_bytes()))
    shutil.copy(path.with_suffix(".npy"), "in/query.npy")
    learn = ["learn", "in/query.npy", "--whitening", "in/map.safetensors", "--map", "out/m.safetensors"]
    find = ["localize", "in/map.safetensors", "in/query.npy", "--out", "out/matches.csv"]
    words = case.random.choice((["info", "in/map.safetensors"], learn, find, [*find, "--top", "2"]))
    case.command(words)


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


def rewritten(data, packing, change):
    """A whole archive whose files, by name, hold something else."""
    written = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(written, "w") as new:
        for name in old.namelist():
            new.writestr(zipfile.ZipInfo(name), change(name, old.read(name)), packing)
    return written.getvalue()


# checkpoints ----------------------------------------------------------------------------------------------


@reader("checkpoint", checkpoints, share=1)
def checkpoint(case):
    """Damage is seen; settings that a file names import nothing."""
    path, data = case.made(checkpoints) / "last.ckpt", Path("in/last.ckpt")
    data.write_bytes(mutate_bytes(case.random, path.read_bytes()))
    case.begin()
    read, whole = read_checkpoint(data)["state_dict"], read_checkpoint(path)["state_dict"]
    for name, value in whole.items():
        if not (same_tensor(value, read[name]) if isinstance(value, Tensor) else value == read[name]):
            raise Wrong(f"a damaged checkpoint loads as another: {name}")


@reader("train commands", inputs, share=0.15)
def train_commands(case):
    train.TRAINER |= {"max_steps": 2, "max_time": "00:00:00:08"}  # where a config does not say it
    shutil.copytree(case.made(inputs), "in", dirs_exist_ok=True)
    random, data = case.random, Path("in/last.ckpt")
    fit, resume = ["train", "fit", "--config", "in/train.yaml"], ["--ckpt_path", "in/last.ckpt"]
    others = (["train", one, *fit[2:], *resume] for one in ("validate", "export"))
    words = random.choice((fit, [*fit, *resume], *others))
    act = random.random()
    if act < 0.4:
        data.write_bytes(mutate_bytes(random, data.read_bytes()))
    elif act < 0.7:
        Path("in/train.yaml").write_bytes(mutated_yaml(random, TRAIN))
    else:
        words = ["train", *mutate_words(random, words[1:], TRAIN_OTHERS)]
    case.command(words)


# configs and command lines ---------------------------------------------------------------------------------


SETTINGS = ("0", "1", "2", "0.5", "null", "true", "l2", "mean", "[2,2]", "16", "1e-3", "linear", "none")


def mutated_yaml(random, text):
    if random.random() < 0.6:
        return mutate_text(random, text)
    lines = text.splitlines()
    at = random.randrange(len(lines))
    name = lines[at].partition(":")[0]
    lines[at] = f"{name}: {random.choice(random.choice((TAGS, NUMBERS, SETTINGS)))}"
    return "\n".join(lines).encode()


@reader("config", inputs, share=1.5)
def config(case):
    random = case.random
    text = (FOLDER / f"{random.choice(('default', 'local_maxima', 'paper'))}.yaml").read_text()
    lines = [line.partition("#")[0].rstrip() for line in text.splitlines()]
    Path("in/config.yaml").write_bytes(mutated_yaml(random, "\n".join(filter(str.strip, lines))))
    chosen = "in/config.yaml"
    if random.random() < 0.1:
        chosen = mutate_text(random, "local_maxima").decode(errors="surrogateescape").replace("\0", "")
    name, *words = random.choice((LINES[0], SLOW_LINES[0])).split()
    case.begin()
    parse(name, function_of(name), [*words, "--config", chosen])


LINES = """
learn in/frames.npy --map out/m.safetensors
learn in/features.npy --map out/m.safetensors --threshold 0.5 --batch_size 16
learn in/photos?width=12 --map out/m.safetensors --features.cell 4 --whitening none
learn in/frames.npy --map out/m.safetensors --config local_maxima --mapper.periods.window 16
learn in/frames.npy --map out/m.safetensors --mapper.chunk=16 --whitening.numbers=8 --mapper.resolution 2
learn in/frames.npy --map out/m.safetensors --second in/photos?stop=30 --second_truth 0 --seed 3
learn in/frames.npy --map out/m.safetensors --whitening in/spectral.safetensors
learn in/clip.mp4?width=24 --map out/m.safetensors --preprocess.contrast patch --preprocess.channel R-B
learn strip:in/strip.png?width=16 --map out/m.safetensors --features PatchPixels
localize in/spectral.safetensors in/query.npy --out out/matches.csv
localize in/templates.safetensors in/query.npy --out out/m.csv --top 3 --threshold .4
localize in/named.safetensors in/query.npy --out out/m.csv --sequence=3 --speeds [.8,1]
localize in/learned.safetensors in/query.npy --out m.csv --match filter
localize in/plain.safetensors in/features.npy --out out/m.csv --as_is
localize in/spectral.safetensors in/query.npy --out out/m.csv --precision .5 --device cpu
learn in/frames.npy --map out/m.safetensors --calibration in/query.npy --calibration_truth 0 --precision .9
live in/spectral.safetensors in/frames.npy --timeout .2 --precision .5
live in/spectral.safetensors in/clip.mp4?stop=5 --realtime --page 0 --reference in/frames.npy --timeout .2
live in/named.safetensors in/fifo.mp4 --timeout .2 --sequence 2 --threshold 3
live in/resampled.safetensors in/frames.npy --as_is --match filter --timeout .2
export in/spectral.safetensors --onnx out/m.onnx --filter
export in/learned.safetensors --onnx out/m.onnx --sequence 3 --speeds [1] --threshold .4
info in/chunked.safetensors
info in/resampled.safetensors
evaluate in/matches.csv --truth in/truth.csv --out out/scores --interpolate
evaluate in/matches.csv --truth in/truth.npz --out out/s --map in/spectral.safetensors
evaluate in/matches.csv --truth 2 --tolerance 3 --out out/s --reference in/frames.npy
demo --out out/demo --seed 2
reproduce aerial --out out/paper --tolerance 4
--help
--version
learn --help
learn in/frames.npy --map out/m.safetensors --print_config
""".strip().splitlines()
SLOW_LINES = """
compare in/frames.npy in/query.npy --out out/report --truth 0 --tolerance 2
compare in/frames.npy in/query.npy --out out/r --map in/spectral.safetensors --top 2
compare in/features.npy in/features.npy --out out/r --config local_maxima --leave_out 3
compare in/frames.npy in/query.npy --out out/r --truth 0 --distractors in/photos --precision .9 --filter
""".strip().splitlines()


def groups(line):
    """The words of a line, each option with its value."""
    return [group.split() for group in re.findall(r"--[^\s=]+\s+(?!--)\S+|\S+", line)]


ODD_WORDS = """
in/empty in/a_file in out missing utm:25 in/last.ckpt in/fifo.csv in/fifo.npy in/loop.npy null [] {}
--velocity --velocity.step 2 --velocity=GroundOdometry --corners [[0,0],[1,0],[1,1],[0,1]] --mapper null
--mapper=TemplateMapper --mapper.help --mapper.route_bytes_per_place 1e-9 --features=HOG --features.cell 1000
--features.help Whitening --whitening.seed -1 --whitening.views=2 --whitening in/fifo.safetensors --config
--preprocess.grid=[2,2] --threshold=nan --query in/query.npy --config paper --config in/config.yaml
--truth utm --config in/fifo.yaml --tolerance 9223372036854775808
--precision 1 --precision nan --calibration in/fifo.npy --calibration none --distractors [in/empty,in/a_file]
--device cuda:99 --device meta --timeout 0 --page 70000 --page 0 --reference in/photos
--onnx in/spectral.safetensors
/dev/video99 /dev/null rtsp://127.0.0.1:1/x in/fifo.mp4
--seed -1 --seed 1180591620717411303424 --batch_size 0
--top 999 --sequence 999 --sequence=3 --filter --speeds [nan] --match drive --out in/a_file --out out/no/m.csv
--map in/spectral.safetensors --map in/fifo.safetensors --truth in/fifo.npz --out in/empty
--out in/query.npy --out in/spectral.safetensors --out in/truth.csv --out in
"""
OTHERS = [
    *(group for line in (*LINES, *SLOW_LINES, ODD_WORDS) for group in groups(line)),
    *(["x" * 300 + ".safetensors"], ["\udcff.npy"], [""], ["--out", "\udcff.csv"], ["--out", "a\nb.csv"]),
]
TRAIN_WORDS = """
fit validate test export in/a_file -c null --help
--data.source in/query.npy --data.batch_size=0 --data.validation=in/query.npy --data.tolerance -1
--trainer.max_steps=1 --trainer.max_epochs 1 --trainer.precision=16 --trainer.max_steps=-1 --optimizer x
--trainer.default_root_dir=in/a_file --trainer.accelerator=gpu --seed_everything -1
--ckpt_path in/spectral.safetensors --config in/config.yaml --model.backbone.dimension=4
--model.learning_rate nan --trainer null --data 3 --model []
"""
TRAIN_OTHERS = groups(TRAIN_WORDS)


def copy_inputs(case):
    """All that command lines name, and what is no regular file."""
    shutil.copytree(case.made(inputs), "in", dirs_exist_ok=True)
    for suffix in ("npy", "mp4", "csv", "safetensors", "png", "yaml", "npz"):
        os.mkfifo(f"in/fifo.{suffix}")
    Path("in/loop.npy").symlink_to("loop.npy")


def run_words(case, lines):
    """A mutated command line; what takes minutes is not begun."""
    copy_inputs(case)
    line = case.random.choice(lines).split()
    own = [group for other in lines if other.split()[0] == line[0] for group in groups(other)[1:]] or OTHERS
    words = [line[0], *mutate_words(case.random, line[1:], case.random.choice((own, OTHERS)))]
    if case.random.random() < 0.05:
        words = mutate_words(case.random, line, OTHERS)

    def too_long(*_, **__):
        raise InputError("this would take too long here")

    reproduce.reproduce = too_long  # type: ignore[assignment]
    live._stay = lambda url: None  # type: ignore[assignment]  # a page is there until Ctrl-C
    if words[:1] == ["demo"]:
        compare.compare = too_long  # type: ignore[assignment]
    case.command(words)


@reader("commands", inputs, share=1)
def command_lines(case):
    run_words(case, LINES)


@reader("slow commands", inputs, share=0.15)
def slow_command_lines(case):
    run_words(case, SLOW_LINES)


# sources of frames -----------------------------------------------------------------------------------------


@reader("npy", maps, share=2)
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
    if random.random() < 0.1:
        DejaVu(HOG(cell=2), mapper=TemplateMapper(ImposedPeriods([3]))).learn(traverse)


@reader("h5", share=1)
def h5(case):
    random, written = case.random, io.BytesIO()
    noise = np.random.default_rng(random.randrange(2**32))
    odd = (noise.random((2, 3)), 0.5, "text", np.zeros(0), np.array([np.nan] * 5), np.arange(5), np.zeros(4))
    texts = [text for text in TEXTS if text.strip("/.") and not {*"\0\udcff"} & {*text}]
    with h5py.File(written, "w", libver=random.choice(("latest", "earliest"))) as file:
        for i in range(9):
            row = noise.normal(size=5).astype(np.float16)
            changed = random.random() < 0.05
            name = f"{random.choice(texts)}/{i}" if random.random() < 0.05 else f"db/{i}.jpg"
            file.create_dataset(f"{name}/global_descriptor", data=random.choice(odd) if changed else row)
    data = written.getvalue()
    Path("in/a.h5").write_bytes(mutate_bytes(random, data) if random.random() < 0.7 else data)
    case.begin()
    take(open_source(f"in/a.h5{random.choice(('', '?order=natural', '?order=lexicographic'))}"))


@reader("names", share=0.5)
def names_beside_features(case):
    random = case.random
    np.save("in/a.npy", np.random.default_rng(0).normal(size=(9, 5)))
    text = "".join(f"@{i}@{i + 1}@.jpg\n" for i in range(9))
    Path("in/a.txt").write_bytes(mutate_text(random, text) if random.random() < 0.8 else text.encode())
    case.begin()
    traverse = open_source("in/a.npy")
    take(traverse)
    find_ground_truth("utm:2", traverse, traverse, 9, 9)


def mutated_image(random, folder):
    """An image's suffix and its bytes."""
    path = random.choice(sorted(folder.iterdir()))
    act = random.random()
    if act < 0.1:
        values = np.random.default_rng(0).random((24, 24)).astype(np.float32)
        values[3, 4] = random.choice((np.nan, np.inf, -1.0, 2.0, 255.0, 1e30))
        written = io.BytesIO()
        Image.fromarray(values).save(written, "tiff")
        return ".tif", written.getvalue()
    if act < 0.2:
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


@reader("live frame", maps, share=1)
def live_frame(case):
    """A frame of any type, shape and values, in between two that fit."""
    random, path = case.random, case.random.choice(sorted(case.made(maps).glob("*.safetensors")))
    good = np.load(path.with_suffix(".npy"))
    noise = np.random.default_rng(random.randrange(2**32))
    fits = good.shape[1:]
    any_shape = tuple(random.choice((0, 1, 3, 16, 40)) for _ in range(3))
    odd = noise.random(random.choice((fits, fits, (*fits, 3), (3, *fits), (1,), (0, 0), any_shape)))
    odd *= random.choice((1, 1, 1, 1, 1, 255, -1, 1e30, np.nan, np.inf))
    kind = random.choice(("u1", "u1", "f4", "f4", "f8", ">f4", "f2", "i8", "?", "c8", "O", "U3"))
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        odd = odd.astype(kind)
    if random.random() < 0.3 and odd.ndim > 1:
        odd = odd[::-1].T
    if random.random() < 0.3 and kind in ("u1", "f4", "f8", "i8", "?"):
        odd = torch.from_numpy(odd.copy())
    odd = random.choice((odd, odd, odd, odd, None, [[1.0]], "frame"))
    case.begin()
    model = DejaVu.load(path)
    model.velocity = None
    sequence = random.choice((None, SequenceMatcher(2), PlaceFilter()))
    localizer, undisturbed = LiveLocalizer(model, sequence), LiveLocalizer(model, sequence)
    frames = [frame if frame.ndim > 1 else frame.astype(np.float32) for frame in good]
    expected = [undisturbed(frame).place for frame in frames[:2]]
    found = [localizer(frames[0]).place]
    try:
        match = localizer(odd, random.choice((0, 0, 3, 10**9)))
    except InputError:
        if [*found, localizer(frames[1]).place] != expected:
            raise Wrong("a frame that is refused changes the next answer") from None
        raise
    if not -1 <= match.place < model.map.places or math.isnan(match.score):
        raise Wrong(f"{match}")


PLAUSIBLE = ("0", "1", "2", "3", "5", "8", "20", "25", "1:2", "3:9", "true", "-1", "100")
SOURCES = """
in/frames.npy?start=1&stop=9&step=2 in/features.npy in/photos?width=8&height=6 in/photos?start=2
in/clip.mp4?width=8&stop=5 strip:in/strip.png?width=8&rows=2:12&halve=1&grey=1 in/a_file in/empty in/strip.png
sim:aerial?seed=1&traverse=1&frames=40 sim:outdoor?frames=20&seed=2 sim:underground?frames=20&step=2
sim:railway?frames=20&traverse=1 sim:aerial?frames=30&start=3&stop=20
in/fifo.npy in/fifo.mp4 in/loop.npy strip:in/fifo.png?width=8
"""


@reader("source", inputs, share=2)
def source(case):
    random = case.random
    copy_inputs(case)
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
    text = json.dumps(mutate_json(random, held)).encode()
    Path("in/truth.json").write_bytes(random.choice((text, mutate_text(random, json.dumps(held)))))
    judge(case, "in/truth.json")


def changed_array(random, held):
    """A .npy of (30,12) with other bytes, with another shape, or as it is."""
    if random.random() < 0.5:
        return mutate_bytes(random, held)
    if random.random() < 0.5:
        return held
    shape = f"({random.choice((30, 10**5, 10**6, 10**12))}, {random.choice((12, 10**6, -1))})"
    return held.replace(b"(30, 12), }" + b" " * len(shape), shape.encode() + b", }" + b" " * 8)


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
    if act > 0.7:
        data = mutate_bytes(random, data)
    elif act > 0.4:
        data = rewritten(data, zipfile.ZIP_DEFLATED, lambda _, held: changed_array(random, held))
    path.write_bytes(data)
    judge(case, str(path))


@reader("truth text", share=1)
def truth_text(case):
    random = case.random
    plain = random.choice(("0", "-1", "12", "utm", "utm:25", "in/truth.csv"))
    text = mutate_text(random, plain).decode(errors="surrogateescape")
    names = [f"@{i}@{2 * i}@.png" for i in range(12)]
    if random.random() < 0.6:
        at = random.randrange(12)
        names[at] = mutate_text(random, names[at]).decode(errors="replace")
        text = random.choice(("utm", "utm:25", "utm:1e300", "utm:0"))
    traverse = ArrayTraverse(pictures(12))
    traverse.frame_name = names.__getitem__  # type: ignore[method-assign]
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
    if random.random() < 0.3:  # its pictures take long
        evaluating.evaluate_file(Path("in/matches.csv"), "0", random.choice((0, 5, 2**62)))
