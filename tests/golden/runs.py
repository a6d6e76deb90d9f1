"""Small runs of `dejavu compare`: report.json, matches.csv and the bytes of the map."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path
from unittest.mock import patch

import numpy as np

from dejavu_torch.cli import main

HERE = Path(__file__).parent
SMALL = "size=32"


def _visits(route):
    return f"sim:{route}", f"sim:{route}&traverse=1"


# A whitening multiplies what another processor rounds otherwise, and turns directions of nearly equal
# variance: runs of frames have none, that of descriptors few components of 16 bits.
PLAIN = ("--features", "[HOG,Distilled]", "--whitening", "none")
AREA = "demo:area?columns=0:700&rows=16:144"
FLIGHT = "demo:area?traverse=1&columns=0:700&rows=48:112&stride=8"
ABOVE = ("--features", "PatchPixels", "--features.size", "[16,16]", "--features.channel", "G")
ABOVE += ("--whitening", "none", "--truth", "pixels:12")
# of a flight whitening alone makes images independent enough
WHITE = ("--features", "HOG", "--features.cell", "16", "--whitening.numbers", "64", "--truth", "pixels:12")
SEEN, BOTH = f"sim:aerial?seed=5&frames=120&traverse=1&{SMALL}", "{made}/both.safetensors"


def compared(*words):
    return (("compare", *words, "--out", "{out}"),)


def _parts(frames):
    """Learn the maps of two routes."""
    for route in (0, 1):
        source = f"sim:aerial?seed={4 + route}&frames={frames}&{SMALL}"
        yield "learn", source, "--map", f"{{made}}/{route}.safetensors", *PLAIN


# {data} is DEJAVU_TEST_DATA, {made} a folder of `descriptors` and maps, {out} that of the report
RUNS = {
    "demo": compared(*_visits(f"aerial?seed=0&frames=300&{SMALL}"), *PLAIN),
    "descriptors": compared(
        *("{made}/0.npy", "{made}/1.npy", "--truth", "0", "--second", "{made}/2.npy", "--storage_curve"),
        *("--second_truth", "0", "--whitening.numbers", "8", "--whitening.bits", "16", "--ordered"),
    ),
    "paper": compared(
        *_visits(f"aerial?frames=200&{SMALL}"), "--config", "paper", "--mapper.periods.window", "100"
    ),
    "templates": compared(
        *_visits(f"aerial?seed=1&frames=256&{SMALL}"),
        *("--config", "local_maxima", "--mapper.periods.window", "128", "--leave_out", "5"),
    ),
    "corridor": compared(
        "{data}/corridor/ref?width=64&height=48",
        "{data}/corridor/query?width=64&height=48",
        *("--truth", "{data}/corridor/truth.csv", *PLAIN),
    ),
    "sequence": compared(
        *_visits(f"aerial?seed=3&frames=200&noise=0.05&{SMALL}"),
        *("--sequence", "5", "--speeds", "[0.8,1,1.25]", "--whitening", "none", "--mapper.chunk", "80"),
        *("--calibration", "none", "--top", "2"),
    ),
    "filter": compared(*_visits(f"aerial?seed=2&frames=200&{SMALL}"), "--filter", *PLAIN),
    "area": compared(f"{AREA}&stride=16", f"{AREA}&traverse=1&stride=24", *ABOVE),
    "flight": compared(f"{AREA}&stride=8", FLIGHT, *WHITE, "--match", "drive", "--calibration", "none"),
    "headings": compared(f"{AREA}&stride=16", FLIGHT, *ABOVE, "--headings", "4"),
    "loops": compared("{made}/twice.npy", "--loops", "50", "--truth", "{made}/twice.csv", "--ordered"),
    "grown": (
        *_parts(120),
        ("learn", f"sim:aerial?seed=5&frames=120&{SMALL}", "--append", "{made}/0.safetensors"),
        ("localize", "{made}/0.safetensors", SEEN, "--out", "{out}/matches.csv"),
        ("evaluate", "{out}/matches.csv", "--truth", "120", "--out", "{out}"),
    ),
    "merged": (
        *_parts(120),
        ("merge", "{made}/0.safetensors", "{made}/1.safetensors", "--map", BOTH),
        ("localize", BOTH, SEEN, "--match", "single", "--out", "{out}/matches.csv"),
        ("evaluate", "{out}/matches.csv", "--truth", "0", "--map", BOTH, "--route", "1", "--out", "{out}"),
    ),
}

# keys of report.json whose values are times, versions, or the place where the data lies
# or decide by rounding which of two clusters a point belongs to
UNTOLD = {"seconds_learn", "seconds_localize", "version", "torch", "l1_backend", "spectrogram_backend"}
UNTOLD |= {"peak_memory", "product_quantiser"}
PATHS = {"reference", "query", "truth", "matches"}
BYTES = {"map_bytes", "route_bytes", "fixed_bytes", "bytes_per_place", "route_bytes_per_place"}
MORE = 1.005  # times the bytes of the golden run: at most
RELATIVE = 2e-3  # of sizes of other methods, and of what is no share of the queries
# counts of queries; shares of them are within the same, divided by the queries
COUNTED = {"accepted", "accepted_right", "0.9", "0.5"}
EXACT = {
    *("queries", "frames", "judged", "with_answer", "tolerance", "sequence", "start", "stop", "k", "unknown")
}
LOOSE = {"lines": 0.02, "noise_over_map": 0.02, "null_over_map": 0.1, "threshold_of_full_precision": 0.3}
SCORE = 1e-4  # of scores and probabilities in matches.csv
SAME = 0.995  # of the places in it
ROUNDED = {"flight"}  # whitened: figures by a tenth, most places and no scores are those of another processor


def descriptors(visit):
    """(400,16) float32 of a visit to a smooth route; variances that no rounding puts in another order."""
    random = np.random.default_rng(7)
    i, waves = np.arange(400)[:, None], random.integers(1, 40, 16)
    route = sum(np.sin(2 * np.pi * (k * waves * i / 400 + random.random(16))) for k in (1, 2, 3))
    noise = np.random.default_rng(visit).normal(size=(400, 16)) * np.linspace(0.2, 0.8, 16)
    return ((route + noise) * 0.8 ** np.arange(16)).astype(np.float32)


def run(name, out, data):
    """Run one of them; its pictures are not written."""
    made = out.parent / f"{name}_made"
    made.mkdir(exist_ok=True)
    if name in ("descriptors", "loops"):
        for visit in range(3):
            np.save(made / f"{visit}.npy", descriptors(visit))
        np.save(made / "twice.npy", np.concatenate([descriptors(0)[:200], descriptors(1)[:200]]))
        lines = "".join(f"{i},{i % 200}\n" for i in range(400))
        (made / "twice.csv").write_text(f"query,place\n{lines}")
    out.mkdir(exist_ok=True)
    folders = {"{data}": data, "{made}": made, "{out}": out}
    with patch("dejavu_torch.evaluation.report.as_png", lambda picture: b""):
        for command in RUNS[name]:
            for mark, folder in folders.items():
                command = tuple(word.replace(mark, str(folder)) for word in command)
            main([*command])


def write(name, out, data):
    """Run it, and keep what it made."""
    run(name, out / "report", data)
    text = (out / "report" / "report.json").read_text().replace(str(data), "{data}").replace(str(out), "")
    (HERE / f"{name}.report.json").write_text(text)
    shutil.copyfile(out / "report" / "matches.csv", HERE / f"{name}.matches.csv")


def golden_report(name):
    report = json.loads((HERE / f"{name}.report.json").read_text())
    return report


def report_of(out):
    report = json.loads((out / "report.json").read_text())
    return report


def golden_matches(name):
    return read_matches(HERE / f"{name}.matches.csv")


def read_matches(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def keys(value, path=""):
    """Every key of a report, with those above it; the parts of a list by their numbers."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield f"{path}/{name}"
            yield from keys(part, f"{path}/{name}")
    elif isinstance(value, list) and not path.endswith("/null_over_map"):  # as many as the null reaches
        for number, part in enumerate(value):
            yield f"{path}/{number}"
            yield from keys(part, f"{path}/{number}")


def differences(seen, golden, queries, path="", rounded=False):
    """Where a report differs from the golden one by more than rounding, a line each.

    Args:
        queries: of the run; figures may differ by two of them.
        rounded: whether they may by a tenth.
    """
    name = next((part for part in reversed(path.split("/")) if not part.isdigit()), "")
    if isinstance(golden, dict) and isinstance(seen, dict):
        for key in golden:
            if key in seen and not (path == "" and key in UNTOLD | PATHS):
                yield from differences(seen[key], golden[key], queries, f"{path}/{key}", rounded)
    elif isinstance(golden, list) and isinstance(seen, list):
        for number, (one, other) in enumerate(zip(seen, golden, strict=False)):
            yield from differences(one, other, queries, f"{path}/{number}", rounded)
    elif not (rounded and _about(seen, golden, name)) and not _close(seen, golden, name, path, queries):
        yield f"{path} is {seen}; golden {golden}"


def _about(seen, golden, name):
    """Within a tenth, or decided by one query."""
    numbers = all(isinstance(one, float) for one in (seen, golden))
    return numbers and (math.isclose(seen, golden, rel_tol=0.1, abs_tol=0.1) or "recall_at_" in name)


def _close(seen, golden, name, path, queries):
    numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in (seen, golden))
    if not numbers or name in EXACT:
        return bool(seen == golden)
    if path.startswith("/storage") and name == "route_bytes_per_place":
        return math.isclose(seen, golden, rel_tol=0.02)
    if name in BYTES:
        return bool(seen <= golden * MORE)
    if name == "null_over_map" and max(seen, golden) <= 1:  # the null is level: a step of bytes decides
        return True
    if name in COUNTED:
        return abs(seen - golden) <= 2
    if name in LOOSE:
        return math.isclose(seen, golden, rel_tol=LOOSE[name], abs_tol=SCORE)
    if 0 <= golden <= 1:
        return abs(seen - golden) <= 2 / queries
    return math.isclose(seen, golden, rel_tol=RELATIVE)
