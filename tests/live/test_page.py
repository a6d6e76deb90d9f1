"""The page: what it answers, and what a browser makes of it."""

from __future__ import annotations

import http.client
import json
import math
import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from helpers import refused
from PIL import Image
from videos import H264, clip, pictures

from dejavu_torch import open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.camera import Frame
from dejavu_torch.data.video import Video
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
    with by_index, ThreadPoolExecutor(4) as requests:
        shown = requests.map(by_index, [4, 0, 3, 3, 1, 2, 4])
    assert [*shown] == [(i, as_picture(frames[i])) for i in (4, 0, 3, 3, 1, 2, 4)]
    for i in (0, 1):
        Image.fromarray(frames[i]).save(tmp_path / f"{i}.png")
    images = ReferencePictures(open_source(f"{tmp_path}?glob=*.png"), 2)
    (tmp_path / "1.png").unlink()
    assert images(0) == (0, as_picture(frames[0]))
    assert images(1) == (1, None)
    with refused("5 frames", "7"):
        ReferencePictures(open_source(tmp_path / "frames.npy"), 7)
    with refused("the array holds features", "frames to show"):
        ReferencePictures(ArrayTraverse(torch.rand(5, 8)), 5)
    assert as_picture(torch.rand(6)) is None  # ready features


def until(fits, seconds=10.0):
    """Wait until this holds."""
    end = time.monotonic() + seconds
    while not fits():
        assert time.monotonic() < end
        time.sleep(0.005)


def decoded_by(monkeypatch, seconds=0.0):
    """The frames of videos that are decoded by name of the thread, in order, each in so many seconds."""
    decoded, picture = {}, Video._picture

    def slow(self, i):
        decoded.setdefault(threading.current_thread().name, []).append(i)
        time.sleep(seconds)
        return picture(self, i)

    monkeypatch.setattr(Video, "_picture", slow)
    return decoded


@pytest.mark.parametrize("options", ["", "?start=10", "?crop=0,0,0,4"])
def test_the_pictures_of_a_video_are_made_before_they_are_asked_for(options, tmp_path):
    source = open_source(f"{clip(tmp_path / 'clip.mkv', pictures(40))}{options}")
    frames = source[:]
    with ReferencePictures(source, len(source)) as video:
        until(lambda: video(17) == (17, as_picture(frames[17])))
        video._thread.join(10)
        (tmp_path / "clip.mkv").unlink()
        assert [video(i) for i in (29, 0, 23)] == [(i, as_picture(frames[i])) for i in (29, 0, 23)]


def test_the_frame_that_is_asked_for_goes_first(tmp_path, monkeypatch):
    source = open_source(clip(tmp_path / "clip.mp4", pictures(200), group=50, **H264))
    decoded = decoded_by(monkeypatch, 0.004)
    with ReferencePictures(source, 200) as video:
        until(lambda: video(0)[0] == 0)
        near, picture = video(150)
        assert near < 50  # nothing nearer is known yet, and nobody waits
        assert picture is not None
        until(lambda: video(150)[0] == 150)
        until(lambda: video(149)[0] == 149)
    made = decoded["dejavu pictures"]
    assert not {*range(60, 110)} & {*made}
    assert len(made) == len({*made})  # none is decoded twice
    assert not video._thread.is_alive()


def test_of_a_long_video_every_nth_frame_is_kept(tmp_path):
    source = open_source(clip(tmp_path / "clip.mkv", pictures(64)))
    size = len(as_picture(source[0]) or "")
    with ReferencePictures(source, 64, most=20 * size) as video:
        video._thread.join(10)
        shown = [video(i)[0] for i in range(64)]
    step = min({*shown} - {0})
    assert step in (4, 8)
    assert {*shown} == {*range(0, 64, step)}
    assert all(abs(one - i) <= max(step / 2, i + step - 64) for i, one in enumerate(shown))
    assert sum(len(video(i)[1] or "") for i in {*shown}) <= 20 * size


def test_a_video_that_breaks_off_is_one_line(tmp_path, caplog):
    source = open_source(clip(tmp_path / "clip.mkv", pictures(40)))
    video = ReferencePictures(source, 40)
    (tmp_path / "clip.mkv").unlink()
    with video:
        video._thread.join(10)
        assert video(7) == (-1, None)
    assert [record.message.count("\n") for record in caplog.records] == [0]
    assert "clip.mkv" in caplog.text


def test_a_nearer_picture_of_the_same_frame_is_sent_when_it_is_known():
    known = [(3, "data:far")]
    with Page(0, reference=lambda frame: known[-1]) as page:
        page.show(moment())
        first = state_of(page)
        assert (first["shown"], first["reference"], first["frame"]) == (3, "data:far", 1204)
        assert state_of(page, seen="7,3").keys() == {"title", "number"}
        known.append((1204, "data:near"))
        later = state_of(page, seen="7,3")
        assert later == {"title": "", "number": 7, "shown": 1204, "reference": "data:near"}
        assert "reference" not in state_of(page, seen="7,1204")
        page.show(moment(8))
        assert state_of(page, seen="7,1204")["reference"] == "data:near"
