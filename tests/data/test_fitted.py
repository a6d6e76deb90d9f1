"""Frames of any reader brought to another size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import all_of, refused
from PIL import Image
from videos import clip, numbers, pictures

from dejavu_torch.data.traverse import at_size
from dejavu_torch.data.source import open_source
from dejavu_torch.resize import is_stretched, reduced_size, resize_frames


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same 6 smooth frames of 64 x 96 pixels as images, as a video and as an array."""
    folder, frames = tmp_path_factory.mktemp("frames"), pictures(6, 64, 96)
    frames[:, :, 48:] = 100 + np.arange(48, dtype=np.uint8)[:, None]
    (folder / "images").mkdir()
    for i, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / "images" / f"{i}.png")
    clip(folder / "clip.mkv", frames)
    np.save(folder / "frames.npy", frames)
    return folder


@pytest.mark.parametrize(
    "source", ["images", "clip.mkv", "frames.npy", "images?start=1&stop=6&step=2", "clip.mkv?stop=4"]
)
def test_frames_are_resized_and_all_else_stays(source: str, folder: Path) -> None:
    own = open_source(f"{folder}/{source}")
    own.place = torch.arange(own.count(), dtype=torch.float64)
    small = at_size(own, (32, 48))
    assert small.frame_shape == (3, 32, 48)
    assert (small.count(), small.seeks, small.sized) == (own.count(), own.seeks, True)
    assert [small.frame_name(i) for i in range(3)] == [own.frame_name(i) for i in range(3)]
    assert small.identity() != own.identity()
    assert small.place is own.place
    assert (own.frame_shape, own.sized) == ((3, 64, 96), False)
    frames = all_of(small, batch=4)
    assert numbers(frames) == numbers(all_of(own))
    torch.testing.assert_close(frames, resize_frames(all_of(own), (32, 48)), atol=0.15, rtol=0)  # at the edge
    torch.testing.assert_close(torch.cat(list(small.between(1, 3))), frames[1:3])


def test_a_large_jpeg_is_decoded_small(tmp_path: Path) -> None:
    across = torch.linspace(0, 255, 800).byte().expand(3, 600, 800)
    Image.fromarray(across.permute(1, 2, 0).numpy()).save(tmp_path / "photo.jpg", quality=95)
    small, whole = (all_of(open_source(f"{tmp_path}{size}")) for size in ("?width=80", ""))
    assert small.shape == (1, 3, 60, 80)
    torch.testing.assert_close(small, resize_frames(whole, (60, 80)), atol=0.02, rtol=0)


def test_a_portrait_among_landscapes_is_refused(tmp_path: Path) -> None:
    for i, size in enumerate(((400, 300), (404, 300), (300, 400))):
        Image.new("L", size, 90).save(tmp_path / f"{i}.png")
    with refused("2.png", "300 x 400", "aspect ratio", "0.png"):
        all_of(at_size(open_source(tmp_path), (120, 160)))
    assert all_of(open_source(f"{tmp_path}?width=160&height=120")).shape == (3, 1, 120, 160)  # as asked for


def test_sizes() -> None:
    assert reduced_size((4000, 1), 160) == (160, 1)
    assert reduced_size((96, 96), 160) == (96, 96)
    assert reduced_size((3000, 4000), None) == (3000, 4000)
    assert reduced_size((480, 640), 160, least=(224, 224)) == (224, 299)
    assert not is_stretched((480, 640), (90, 120))
    assert is_stretched((480, 640), (120, 120))
