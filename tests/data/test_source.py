"""SOURCE, as every command takes it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from helpers import all_of, refused

from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Chain


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nowhere", ["nowhere", "not there", "folder of images", ".npy", "sim:aerial", "clip.mp4?width=160"]),
        ("nowhere.png?width=3", ["nowhere.png?width=3 is not there", "expected a folder", "or a video"]),
        ("sim:moon?seed=1", ["'moon'", "expected aerial"]),
        ("sim:aerial?speed=3", ["unknown 'speed'", "expected seed, traverse, frames"]),
        ("sim:aerial?frames=3.5", ["frames is '3.5'", "expected int"]),
        ("sim:aerial?frames=", ["frames is ''", "expected int"]),
        ("sim:aerial?noise=loud", ["noise is 'loud'", "expected float"]),
        ("sim:aerial?frames=3&frames=4", ["a second 'frames'"]),
        ("strip:road.png", ["width is missing", "expected width="]),
        ("strip:road.png?path=3&width=3", ["unknown 'path'", "expected width, rows"]),
        ("{}/clip.mkv?width=", ["width is ''", "expected int"]),
        ("{}/clip.mkv?path=3", ["unknown 'path'", "expected width, height, start"]),
        ("{}/images?wide=30", ["unknown 'wide'", "expected width, height, order, glob, recursive, start"]),
        ("{}/images?order=size", ["images: order is 'size'", "expected natural or lexicographic"]),
        ("{}/frames.npy?width=4", ["unknown 'width'", "expected start, stop, step"]),
        ("{}/long.png", ["long.png is a single image", "expected a folder of images"]),
        (__file__, ["of an unknown kind", "expected a folder of images"]),
        *((path, ["is not there"]) for path in ("", "?width=3", "a" * 5000, "a\0b", "\udcff", "b/" * 3000)),
    ],
)
def test_what_cannot_be_opened_is_refused(sources, source, words):
    with refused(*words):
        open_source(source.replace("{}", str(Path(sources["images"]).parent)))


@pytest.mark.parametrize(
    ("name", "words"),
    [("a.gif", ("an animation", "ffmpeg")), ("a.ZIP", ("an archive", "unzip")), ("a.bag", ("a ROS bag",))],
)
def test_how_to_convert_what_is_no_source(tmp_path, name, words):
    (tmp_path / name).touch()
    with refused(name, "into a folder of images", *words):
        open_source(tmp_path / name)


# part of a source


def part_of(address, part):
    return open_source(f"{address}{'&' if '?' in address else '?'}{part}")


KINDS = ["images", "frames.npy", "features.npy", "clip.mkv", "clip.mp4", "strip", "aerial", "outdoor"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_of_every_source_means_the_same(sources, kind):
    whole, some = open_source(sources[kind]), part_of(sources[kind], "start=3&stop=9&step=2")
    frames, chosen = all_of(whole), slice(3, 9, 2)
    assert len(frames) == 12
    for size in (2, 64):
        torch.testing.assert_close(all_of(some, size), frames[chosen], atol=1e-6, rtol=0)
    torch.testing.assert_close(some[1:3], frames[5:8:2], atol=1e-6, rtol=0)
    assert len(some) == 3
    assert some.frame_shape == whole.frame_shape
    assert some.ordered == whole.ordered == Chain([whole, some]).ordered == (not kind.endswith("npy"))
    assert [*some.names] == [*whole.names[chosen]]
    if whole.places is not None:
        assert some.places is not None
        assert torch.equal(some.places, whole.places[chosen])


HUGE = "1" + "0" * 30


@pytest.mark.parametrize("kind", ["frames.npy", "clip.mkv", "aerial"])
@pytest.mark.parametrize(
    ("part", "words"),
    [
        *((part, "a part of its") for part in ("start=5&stop=5", "start=-1", "stop=-1", f"start={HUGE}")),
        *((part, "expected a") for part in (f"stop={2**62}", f"start={2**63}")),
        *((part, "step of at least 1") for part in ("step=0", "step=-2")),
        *((part, "12") for part in ("start=12", "stop=13")),
    ],
)
def test_a_part_that_is_not_there_is_refused(sources, kind, part, words):
    with refused(words):
        part_of(sources[kind], part)


@pytest.mark.parametrize("name", ["a.npy", "a.mp4", "a.png"])
def test_a_fifo_is_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    for source in (f"{tmp_path / name}", f"strip:{tmp_path / name}?width=3"):
        with refused(name):
            open_source(source)
