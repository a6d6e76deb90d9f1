"""Names of frames: given back exactly, in a few bytes where they count or tell the time."""

from __future__ import annotations

import base64
import json
import math
import zlib
from pathlib import Path

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.folder import ImageFolder
from dejavu_torch.data.frame_range import FrameRange
from dejavu_torch.data.names import LONGEST, FrameNames, clock_time
from dejavu_torch.types import Traverse


class Named(Traverse):
    def __init__(self, names: list[str]) -> None:
        self.names, self.length = names, len(names)

    def batches(self, size: int):  # type: ignore[no-untyped-def]
        yield from torch.zeros(len(self.names), 1).split(size)

    def frame_name(self, i: int) -> str:
        return self.names[i]


def packed(names: list[str]) -> str:
    """The code as text, once it was read back."""
    code = json.dumps(FrameNames(len(names), names.__getitem__).encode())
    again = FrameNames.decode(json.loads(code), len(names))
    assert [again[i] for i in range(len(again))] == names
    return code


PLAIN = st.text(st.characters(blacklist_categories=[]), max_size=8)
COUNTER = st.builds(
    lambda prefix, suffix, width, first, stride, frames: [
        f"{prefix}{first + stride * i:0{width}}{suffix}" for i in range(frames)
    ],
    *(PLAIN, PLAIN, st.integers(1, 12), st.integers(0, 10**10), st.integers(-3, 50), st.integers(0, 30)),
)
TIMES = st.builds(
    lambda start, rate, frames: [
        clock_time(math.floor(start + 1000 * i / rate + 0.5)) for i in range(frames)
    ],
    *(
        st.integers(-5000, 10**7),
        st.sampled_from([0.3, 9.99, 24000 / 1001, 25, 29.97, 60, 480, 7000]),
        st.integers(0, 400),
    ),
)


@given(st.lists(PLAIN, max_size=12))
def test_any_names_are_given_back(names: list[str]) -> None:
    packed(names)


@given(st.lists(COUNTER | TIMES | st.lists(PLAIN, max_size=3), max_size=4))
def test_series_of_names_are_given_back(series: list[list[str]]) -> None:
    packed([name for names in series for name in names])


@given(st.lists(st.text("019-.:_a", max_size=5), max_size=15))
def test_names_that_nearly_count_are_given_back(names: list[str]) -> None:
    packed(names)


@given(TIMES)
def test_even_times_take_a_few_dozen_bytes(names: list[str]) -> None:
    assert len(packed(names)) < 70


@pytest.mark.parametrize("frames", [2, 1000, 30_000])
@pytest.mark.parametrize(
    "form", ["{:06}.png", "left_{}.jpg", "image-1-{:03}_cam0.png", "frame{:04}.2.tif", "{}"]
)
def test_a_counter_takes_a_few_dozen_bytes_for_any_number_of_frames(form: str, frames: int) -> None:
    assert len(packed([form.format(i) for i in range(frames)])) < 70
    assert len(packed([form.format(5 + 3 * i) for i in range(frames)])) < 70


@pytest.mark.parametrize("rate", [25.0, 30000 / 1001, 24000 / 1001, 10.0, 50.0, 59.94, 480.0])
@pytest.mark.parametrize("frames", [3, 500, 30_000])
def test_times_of_a_video_take_a_few_dozen_bytes(rate: float, frames: int) -> None:
    assert len(packed([clock_time(math.floor(1000 * i / rate + 33.9)) for i in range(frames)])) < 70


def test_several_series_take_a_run_each() -> None:
    names = [f"{kind}_{i:04}.png" for kind in "abc" for i in range(700)] + ["last.png"]
    assert len(packed(names)) < 200


def test_other_names_are_compressed() -> None:
    names = [f"@{500_000 + (i * i) % 97}@{4_000_000 + 7 * i}@.jpg" for i in range(1000)]
    assert len(packed(names)) < len(json.dumps(names)) / 3


def test_the_names_of_a_traverse(tmp_path: Path) -> None:
    for i in range(8, 12):
        Image.new("L", (2, 2)).save(tmp_path / f"{i}.png")
    folder = ImageFolder(tmp_path)
    for traverse, expected in (
        (folder, ["8.png", "9.png", "10.png", "11.png"]),
        (FrameRange(folder, start=1, step=2), ["9.png", "11.png"]),
        (Named(["", "x", ""]), ["", "x", ""]),
    ):
        names = FrameNames.of(traverse)
        assert names is not None
        assert [names[i] for i in range(len(names))] == expected
    assert FrameNames.of(ArrayTraverse(torch.rand(5, 2))) is None
    endless = Named(["a", "b", "c"])
    endless.length = None
    assert FrameNames.of(endless) is None
    some = FrameNames.of(endless, frames=2)
    assert some is not None
    assert (len(some), some[1]) == (2, "b")


def test_only_the_frames_have_names() -> None:
    names = FrameNames.decode({"runs": [[3, "a", "", 1, 0, 1]]}, 3)
    for i in (-1, 3):
        with pytest.raises(IndexError, match=f"frame {i}"):
            names[i]


def test_a_name_beyond_reason_is_refused() -> None:
    packed(["\U0001f600" * LONGEST])
    with refused("4097 characters", "at most 4096"):
        packed(["x" * (LONGEST + 1)])


def text_code(value: object) -> dict[str, str]:
    return {"text": base64.b64encode(zlib.compress(json.dumps(value).encode())).decode()}


@pytest.mark.parametrize(
    "code",
    [
        None,
        [],
        {},
        "runs",
        {"runs": [], "text": ""},
        {"eval": "1"},
        {"runs": None},
        {"runs": 3},
        {"runs": []},
        {"runs": [[2, "a", "", 1, 0]]},
        {"runs": [[2, "a", "", 1, 0, 1, 1]]},
        {"runs": [[3, "a", "", 1, 0, 1]]},
        {"runs": [[3, "a", "", 1, 0, 1], [-1, "a", "", 1, 0, 1]]},
        {"runs": [[2, "a", "", 1, 0, -1]]},
        {"runs": [[2, "a", "", 10**9, 0, 1]]},
        {"runs": [[2, "a", "", 1, 10**300, 1]]},
        {"runs": [[2, "a", "", 1, 0.5, 1]]},
        {"runs": [[2, 7, "", 1, 0, 1]]},
        {"runs": [["2", "a", "", 1, 0, 1]]},
        {"times": None},
        {"times": [1.0]},
        {"times": [0.0, float("nan")]},
        {"times": [float("inf"), 1.0]},
        {"times": [0.0, 1e300]},
        {"times": ["x", "y"]},
        {"text": 7},
        {"text": "%%%"},
        {"text": base64.b64encode(b"no zlib").decode()},
        {"text": base64.b64encode(zlib.compress(b"no json")).decode()},
        {"text": base64.b64encode(zlib.compress(b"[" * 10**6)).decode()},
        {"text": base64.b64encode(zlib.compress(b" " * 10**7)).decode()},
        text_code(["one"]),
        text_code(["one", 2]),
        text_code({"0": "one", "1": "two"}),
        text_code("ab"),
    ],
    ids=lambda code: str(code)[:40],
)
def test_a_code_that_is_none_is_refused(code: object) -> None:
    with refused("names of 2 frames"):
        FrameNames.decode(code, 2)


@pytest.mark.parametrize(
    ("milliseconds", "text"),
    [(0, "0:00:00.000"), (59_999, "0:00:59.999"), (3_600_001, "1:00:00.001"), (-40, "-0:00:00.040")],
)
def test_clock_times(milliseconds: int, text: str) -> None:
    assert clock_time(milliseconds) == text
