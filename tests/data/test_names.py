"""Names of frames: given back exactly, in a few bytes where they count or tell the time."""

from __future__ import annotations

import base64
import json
import zlib

import pytest
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.data.names import MAX_NAME_LENGTH, clock_time, decode_names, encode_names


def packed(names):
    """The code, once it was read back."""
    code = encode_names(names)
    assert decode_names(json.loads(json.dumps(code))) == names
    return code


NEARLY = st.text("019-.:_a", max_size=5)  # as counters have them
PLAIN = st.text(st.characters(blacklist_categories=[]), max_size=8)
COUNTER = st.builds(
    lambda prefix, suffix, width, first, stride, frames: [
        f"{prefix}{first + stride * i:0{width}}{suffix}" for i in range(frames)
    ],
    *(PLAIN, PLAIN, st.integers(1, 12), st.integers(0, 10**10), st.integers(-3, 50), st.integers(0, 30)),
)
TIMES = st.builds(
    lambda start, rate, frames: [clock_time(start + i / rate) for i in range(frames)],
    *(st.floats(-5, 10**4), st.sampled_from([0.3, 24000 / 1001, 25, 60, 7000]), st.integers(0, 400)),
)


@given(st.lists(COUNTER | TIMES | st.lists(PLAIN, max_size=12) | st.lists(NEARLY, max_size=15), max_size=4))
def test_any_names_are_given_back(series):
    packed([name for names in series for name in names])


@pytest.mark.parametrize("frames", [2, 30_000])
@pytest.mark.parametrize("form", ["{:06}.png", "image-1-{:03}_cam0.png", "frame{:04}.2.tif", "{}"])
def test_a_counter_takes_hardly_a_byte_for_a_hundred_frames(form, frames):
    assert len(packed([form.format(5 + 3 * i) for i in range(frames)])) < 150 + frames / 100


def test_times_of_a_video_take_less_than_a_tenth_of_a_byte_a_frame():
    for rate in (25.0, 24000 / 1001):
        assert len(packed([clock_time(i / rate) for i in range(30_000)])) < 3000


def test_other_names_are_compressed():
    names = [f"@{500_000 + (i * i) % 97}@{4_000_000 + 7 * i}@.jpg" for i in range(1000)]
    assert len(packed(names)) < len(json.dumps(names)) / 3


def test_a_name_beyond_reason_is_refused():
    packed(["\U0001f600" * MAX_NAME_LENGTH])
    with refused("4097 characters", "at most 4096"):
        packed(["x" * (MAX_NAME_LENGTH + 1)])


def coded(value):
    return base64.b64encode(zlib.compress(json.dumps(value).encode())).decode()


def test_numbers_wider_than_any_are_refused():
    with refused("too wide", "at most 18 digits"):
        decode_names(coded({"texts": ["a", "b"], "columns": [[10**9, 0, 1]]}))


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0:00:00.000"), (59.999, "0:00:59.999"), (3600.001, "1:00:00.001"), (-0.04, "-0:00:00.040")],
)
def test_clock_times(seconds, text):
    assert clock_time(seconds) == text
