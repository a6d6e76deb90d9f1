"""The page: what it answers, and what a browser makes of it."""

from __future__ import annotations

import http.client
import json
import math
import re
from concurrent.futures import ThreadPoolExecutor
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from helpers import refused
from videos import clip, pictures

from dejavu_torch import open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.camera import Frame
from dejavu_torch.live.localizer import LiveMatch
from dejavu_torch.live.page import PAGE, Page, ReferencePictures, Snapshot, as_picture, curve


def moment(number=7, name="left<b>.png", accepted=True, time=0.28):
    pixels = np.zeros((24, 32, 3), np.uint8)
    pixels[:, :16] = (200, 40, 40)
    scores = torch.full((3001,), 1e-5)
    scores[1200:1204] = torch.tensor([0.1, 0.3, 0.3, 0.2])
    scores[-1] = 1 - scores[:-1].sum()
    match = LiveMatch(1204, 1204, name, 0.1, math.exp(-0.1), 0.99, accepted, 12.5)
    return Snapshot(Frame(number, time, pixels), match, scores, True, 8, 2, 11.0, 19.0)


@pytest.fixture
def page():
    with Page(0, "drive.mp4 on map.safetensors") as page:
        yield page


def state_of(page, seen=""):
    with urlopen(f"{page.url}state?seen={seen}") as answer:
        state = json.load(answer)
        return state


def test_the_state_is_that_of_the_latest_frame(page):
    assert state_of(page)["number"] == -1
    page.show(moment())
    state = state_of(page)
    known = {"number": 7, "place": 1204, "accepted": True, "frames": 8, "dropped": 2, "places": 3000}
    assert known.items() <= state.items()
    assert str(state["query"]).startswith("data:image/jpeg;base64,")
    assert state["reference"] is None
    assert sum(state["curve"]) + state["off"] == pytest.approx(1, abs=1e-3)  # type: ignore[call-overload]
    assert 0.5 < max(state["curve"]) < 0.91  # type: ignore[type-var]
    assert "curve" not in state_of(page, seen="7")
    page.show(moment(8, time=math.nan))
    assert (state_of(page, seen="7")["number"], state_of(page)["time"]) == (8, None)


def test_it_asks_for_nothing_elsewhere(page):
    with urlopen(page.url) as answer:
        text = answer.read().decode()
    assert text == PAGE.read_text()
    assert not re.findall(r"(?:https?:)?//[a-z]", text.replace("// ", ""))


@pytest.mark.parametrize(
    ("path", "host", "status"),
    [
        ("/", "127.0.0.1", 200),
        ("/", "localhost", 200),
        ("/", "evil.example", 403),
        ("/etc", "127.0.0.1", 404),
    ],
)
def test_only_this_machine_is_answered(path, host, status, page):
    port = int(page.url.rpartition(":")[2].strip("/"))
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", path, headers={"Host": f"{host}:{port}"})
    assert connection.getresponse().status == status
    connection.close()


def test_a_port_that_cannot_be_had_is_one_line(page):
    port = page.url.rpartition(":")[2].strip("/")
    with refused(port, "in use"):
        Page(int(port))
    with refused("70000", "65535"):
        Page(70000)


def test_curve_keeps_the_highest_of_many_places():
    scores = torch.full((100_000,), 12.0)
    scores[70_001] = 0.0
    heights = curve(scores, posterior=False)
    assert (len(heights), max(heights), heights.index(max(heights))) == (512, 1.0, 512 * 70_001 // 100_000)
    assert curve(torch.full((4,), math.inf), posterior=False) == [0.0] * 4
    assert curve(torch.tensor([3.0, 1.0, 2.0, math.inf]), posterior=False) == [0.0, 1.0, 0.5, 0.0]


def test_reference_pictures_of_any_source(tmp_path):
    frames = pictures(5)
    np.save(tmp_path / "frames.npy", frames)
    by_index = ReferencePictures(open_source(tmp_path / "frames.npy"), 5)
    assert by_index(3) == as_picture(frames[3])
    video = ReferencePictures(open_source(clip(tmp_path / "clip.mkv", frames)), 5)
    with ThreadPoolExecutor(4) as requests:
        shown = requests.map(video, [4, 0, 3, 3, 1, 2, 4])
    assert [*shown] == [as_picture(frames[i]) for i in (4, 0, 3, 3, 1, 2, 4)]
    (tmp_path / "clip.mkv").unlink()
    assert video(2) is None  # as of an image that was removed
    with refused("5 frames", "7"):
        ReferencePictures(open_source(tmp_path / "frames.npy"), 7)
    with refused("the array holds features", "frames to show"):
        ReferencePictures(ArrayTraverse(torch.rand(5, 8)), 5)
    assert as_picture(torch.rand(6)) is None  # ready features
