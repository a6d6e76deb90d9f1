"""Checksums of simulated frames, which rounding of the last bits does not change."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import torch

from dejavu_torch import open_source

FILE = Path(__file__).parent / "frames.json"
LEVELS = 16  # of a channel
NEAR = 1e-4  # of the edge between two levels: values as near as that are left out
AT = (0, 17, 101)
ROUTES = tuple(
    f"sim:{route}&traverse={traverse}"
    for route in (
        *("aerial?frames=128", "aerial?seed=3&frames=128&size=32", "aerial?frames=128&ground=repeat"),
        *("outdoor?frames=128&height=32&width=64", "underground?frames=128&height=32&width=64"),
    )
    for traverse in (0, 1)
)


def drawn(route):
    """Some frames of a route, float in [0,1]. Shape: (3,C,H,W)."""
    source = open_source(route)
    return torch.cat([source.read(range(at, at + 1)) for at in AT]).numpy()


def unsure(frames):
    """The places in the flat array of values so near to the edge of a level that rounding may decide."""
    level = frames.ravel().astype(np.float64) * LEVELS
    return [int(at) for at in np.flatnonzero(np.abs(level - np.floor(level) - 0.5) < NEAR * LEVELS)]


def checksum(frames, left_out):
    """sha256 of the levels of all values but those left out."""
    levels = np.rint(frames.ravel().astype(np.float64) * LEVELS).astype(np.uint8)
    return hashlib.sha256(np.delete(levels, left_out).tobytes()).hexdigest()


def golden():
    found = json.loads(FILE.read_text())
    return found


def write():
    made = {}
    for route in ROUTES:
        frames = drawn(route)
        left_out = unsure(frames)
        gaps = np.diff(left_out, prepend=0).tolist()
        made[route] = {"shape": list(frames.shape), "sha256": checksum(frames, left_out), "left_out": gaps}
    lines = [f" {json.dumps(route)}: {json.dumps(one)}" for route, one in made.items()]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def differs(route, known):
    """How frames differ from those of the golden checksum; empty where they do not."""
    frames = drawn(route)
    if list(frames.shape) != known["shape"]:
        return f"{route}: shape {frames.shape}"
    if checksum(frames, np.cumsum(known["left_out"]).astype(int).tolist()) != known["sha256"]:
        return f"{route}: another checksum"
    return ""
