"""A window slid along one long image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import all_of, refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dejavu_torch.data.source import open_source
from dejavu_torch.data.strip import SlidingWindow, read_strip

ROWS = [":5", "a:b", "3:3", "-3:5", "19:21", "1:2:3", "0.5:3", "nan:3"]


@pytest.fixture
def image(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (20, 40, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "road.png")
    return tmp_path / "road.png"


def pixels_of(path):
    return torch.tensor(np.asarray(Image.open(path))).permute(2, 0, 1).double() / 255


@given(st.integers(1, 9), st.integers(1, 12), st.integers(1, 20))
def test_frame_i_begins_at_column_i_times_step(width, step, batch):
    strip = torch.rand(2, 5, 9)
    traverse = SlidingWindow(strip, width, step)
    starts = range(0, 9 - width + 1, step)
    assert len(traverse) == len(starts)
    assert torch.equal(all_of(traverse, batch), torch.stack([strip[:, :, i : i + width] for i in starts]))


def test_a_file_is_cut_as_asked(image):
    grey = (pixels_of(image) * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0, keepdim=True)
    halved = (grey[:, ::2, ::2] + grey[:, 1::2, ::2] + grey[:, ::2, 1::2] + grey[:, 1::2, 1::2]) / 4
    expected = torch.stack([halved[:, 2:8, i : i + 7] for i in range(14)])
    for traverse in (
        read_strip(image, width=7, rows="2:8", halve=1, grey=True),
        open_source(f"strip:{image}?grey=1&halve=1&rows=2:8&width=7"),
    ):
        torch.testing.assert_close(all_of(traverse), expected.float(), atol=1e-6, rtol=0)
        assert len(traverse) == 14


@pytest.mark.parametrize(
    "strip", [torch.rand(5, 9), torch.rand(1, 1, 5, 9), torch.zeros(1, 5, 9, dtype=torch.uint8)]
)
def test_what_is_no_strip_is_refused(strip):
    with refused(str(tuple(strip.shape)), "expected float (C,H,W)"):
        SlidingWindow(strip, 3)
    with refused("40 pixels", "step 0"):
        SlidingWindow(torch.rand(1, 5, 40), 8, step=0)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((f"road.png?width=8&rows={rows}", (rows, "expected first:stop inside 0:20")) for rows in ROWS),
        ("road.png?width=0", ("40 pixels", "window 0", "expected")),
        ("road.png?width=41", ("40 pixels", "window 41", "expected")),
        ("road.png?width=1&halve=6", ("halve",)),
        ("missing.png?width=3", ("is not there",)),
        ("text.png?width=3", ("cannot be read",)),
    ],
)
def test_a_file_that_cannot_be_cut_so_is_refused(image, name, words):
    (image.parent / "text.png").write_text("text")
    with refused(name.partition("?")[0], *words):
        open_source(f"strip:{image.parent}/{name}")
