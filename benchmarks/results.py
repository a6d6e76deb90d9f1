"""The figures of the documentation: `benchmarks results` runs the commands and keeps what they said."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.trainings import ROAD, drive
from dejavu_torch.types import InputError

SEEDS = (0, 3, 4)  # of the simulated routes; settings were chosen on others


class Footage(NamedTuple):
    """Two traverses, and words of `dejavu compare` that go with them; {data} is the folder of the footage.

    strange: footage of other places, whose answers are all wrong.
    """

    reference: str
    query: str
    words: str = ""
    strange: str = ""


def road(part: str = "", strange: str = "sim:outdoor?stop=2000") -> Footage:
    return Footage(ROAD.format(1, part), ROAD.format(2, part), strange=strange)


def railway(part: str, strange: str) -> Footage:
    summer, winter = (f"{{data}}/nordland/{one}?" for one in ("summer", "winter"))
    return Footage(summer + part, winter + part, "--truth 0 --tolerance 1", winter + strange)


def filmed(name: str, tolerance: int) -> Footage:
    one = drive(name, tolerance)
    return Footage(one.reference, one.query, f"--truth {one.truth} --tolerance {tolerance}")


def simulated(kind: str, seed: int, strange: str) -> Footage:
    one = f"sim:{kind}?seed={seed}"
    return Footage(one, f"{one}&traverse=1", "", f"sim:{strange}?stop=2000")


FOOTAGE = {
    "city 1": filmed("robotcar/t1", 2),
    "city 2": filmed("robotcar/t2", 2),
    "city 3": filmed("robotcar/t5", 2),
    "laps": filmed("donkey_lap", 10),
    "corridor": Footage(
        "{data}/corridor/ref", "{data}/corridor/query", "--truth {data}/corridor/truth.csv --tolerance 0"
    ),
    "railway, first half": railway("stop=900", "start=900"),
    "railway, second half": railway("start=900", "stop=900"),
    "road, first half": road("&stop=1348", ROAD.format(2, "&start=1348")),
    "road, second half": road("&start=1348", ROAD.format(2, "&stop=1348")),
    "road": road(),
    **{
        f"sim:{kind}, seed {seed}": simulated(kind, seed, strange)
        for kind, strange in (("aerial", "outdoor"), ("outdoor", "underground"), ("underground", "outdoor"))
        for seed in SEEDS
    },
}
IN_ORDER = [name for name in FOOTAGE if name not in ("corridor", "road", "road, first half") and name[-1] not in "34"]
WAYS = {  # of `dejavu compare`; {map} is the map of the default
    "default": "--storage_curve",
    "HOG": "--features HOG --calibration none",
    "filter": "--map {map} --filter",
    "sequence": "--map {map} --sequence 21",
}


class Run(NamedTuple):
    """A command line and where its report goes."""

    footage: str
    way: str
    words: list[str]


def runs(ways: Sequence[str]) -> Iterator[Run]:
    """Every way on every footage that it is for, the default first."""
    for way in ways:
        for name, one in FOOTAGE.items():
            if way == "sequence" and name not in IN_ORDER:
                continue
            if way == "filter" and not one.strange:
                continue
            words = ["compare", one.reference, one.query, *shlex.split(one.words), *shlex.split(WAYS[way])]
            if way in ("default", "filter") and one.strange:
                words += ["--distractors", one.strange]
            yield Run(name, way, words)
