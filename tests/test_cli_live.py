"""`dejavu live`: its lines, its summary, its page, and every way in which a source ends."""

from __future__ import annotations

import csv
import json
import re
import signal
import subprocess
import threading
import time
from contextlib import contextmanager
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from command_line import fails, run
from footage import REFERENCE, camera, footage
from processes import PACKAGE, Forked
from videos import H264, clip, piped

from dejavu_torch import DejaVu, LiveLocalizer, PlaceFilter, SpectralMapper, Whitening, open_source
from dejavu_torch.data.traverse import at_size
from dejavu_torch.live.page import Page
from dejavu_torch.recognition.querying import DRIVES

KEYS = ["frame", "time", "place", "reference_frame", "name", "score", "posterior", "probability", "accepted"]
KEYS += ["milliseconds"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A map of a drive, another drive as a video and as a stream, and one of other pixels."""
    folder = tmp_path_factory.mktemp("live")
    first, second = (
        torch.cat(list(open_source(f"sim:aerial?frames=64&traverse={i}").batches(64))) for i in (0, 1)
    )
    clip(folder / "first.mkv", _pixels(first))
    DejaVu(whitening=Whitening(views=1), mapper=SpectralMapper(20.0)).learn(
        open_source(folder / "first.mkv")
    ).save(folder / "map.safetensors")
    clip(folder / "second.mkv", _pixels(second))
    large = torch.nn.functional.interpolate(second[:40], scale_factor=2)
    clip(folder / "second.ts", _pixels(large), **H264)  # type: ignore[arg-type]
    clip(folder / "other.ts", _pixels(second[:4]), **H264)  # type: ignore[arg-type]
    return folder


def _pixels(frames):
    return (frames * 255).round().byte().permute(0, 2, 3, 1).contiguous().numpy()


def lines_of(text):
    return [json.loads(line) for line in text.splitlines()]


def test_a_line_a_frame_as_localize_finds_them(folder, tmp_path, capsys):
    run("live", folder / "map.safetensors", folder / "second.mkv")
    out, err = capsys.readouterr()
    found = lines_of(out)
    assert list(found[0]) == KEYS
    assert [line["frame"] for line in found] == [*range(64)]
    assert [line["time"] for line in found] == pytest.approx([i / 25 for i in range(64)])
    assert found[30]["name"] in ("0:00:01.160", "0:00:01.200", "0:00:01.240")
    times = r"milliseconds per frame: p50 [\d.]+, p99 [\d.]+"
    assert re.fullmatch(f"dejavu: 64 frames, 0 dropped; {times}; [^\n]*filter[^\n]* 0.5\n", err)
    assert [one["accepted"] for one in found] == [one["posterior"] > 0.5 for one in found]
    run(
        "localize", folder / "map.safetensors", folder / "second.mkv", "--filter", "--out", tmp_path / "m.csv"
    )
    rows = list(csv.DictReader((tmp_path / "m.csv").open()))
    assert [line["reference_frame"] for line in found] == [int(row["place"]) for row in rows]
    assert [line["accepted"] for line in found] == [row["accepted"] in ("1", "True") for row in rows]
    assert sum(abs(line["place"] - line["frame"]) <= 5 for line in found) > 50


@pytest.mark.parametrize("lag", [10, 100])
def test_with_a_lag_each_frame_has_its_line_later(lag, folder, capsys, monkeypatch):
    titles = []

    def interrupted(seconds):
        if seconds > 60:
            raise KeyboardInterrupt

    monkeypatch.setattr(
        Page, "show", lambda page, snapshot: titles.append((page.title, snapshot.frame.number))
    )
    monkeypatch.setattr("dejavu_torch.cli.live.time.sleep", interrupted)
    run("live", folder / "map.safetensors", folder / "second.mkv", "--lag", lag, "--page", 0)
    out, err = capsys.readouterr()
    found = lines_of(out)
    assert [line["frame"] for line in found] == [*range(64)]
    assert [line["time"] for line in found] == pytest.approx([i / 25 for i in range(64)])
    model = DejaVu.load(folder / "map.safetensors")
    localizer = LiveLocalizer(model, PlaceFilter(lag=lag))
    frames = at_size(open_source(folder / "second.mkv"), model.frame_shape[1:])  # type: ignore[index,arg-type]
    expected = [match for frame in frames for match in localizer.due(frame)] + localizer.finish()
    assert [line["place"] for line in found] == [one.place for one in expected]
    assert [line["posterior"] for line in found] == pytest.approx(
        [one.posterior for one in expected], abs=1e-3
    )
    assert titles[-1][1] == 63
    assert f"answers come {lag} frames later" in titles[-1][0]
    assert "64 frames, 0 dropped" in err


@pytest.mark.parametrize(
    ("after", "words"), [("other.ts", ("64 x 64", "128 x 128")), (None, ("stalled", "0.4"))]
)
def test_what_was_found_is_kept_where_a_stream_fails(after, words, folder, tmp_path, capsys):
    data = b"".join((folder / name).read_bytes() for name in ("second.ts", after) if name)
    with piped(tmp_path, data, open_for=0 if after else 20) as pipe, pytest.raises(SystemExit) as stop:
        run("live", folder / "map.safetensors", pipe, "--timeout", "0.4")
    out, err = capsys.readouterr()
    assert stop.value.code == 2
    summary, problem = err.splitlines()
    assert all(word in problem for word in words)
    assert len(lines_of(out)) == int(summary.split()[1]) > 0


def test_frames_are_dropped_in_real_time_only(folder, capsys, monkeypatch):
    due = LiveLocalizer.due
    left_out = []

    def slow(self, frame, dropped=0, moved=None):
        left_out.append(dropped)
        time.sleep(0.1)
        return due(self, frame, dropped, moved)

    monkeypatch.setattr(LiveLocalizer, "due", slow)
    run("live", folder / "map.safetensors", folder / "second.mkv", "--realtime")
    out, err = capsys.readouterr()
    found = lines_of(out)
    assert len(found) < 40
    assert f"{len(found)} frames, {64 - len(found)} dropped" in err
    assert sum(left_out) + len(found) == 64
    run("live", folder / "map.safetensors", f"{folder / 'second.mkv'}?stop=8")
    assert "8 frames, 0 dropped" in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("--sequence", "1")], ids=" ".join)
@pytest.mark.parametrize("reference", ["sim:aerial?frames=64", "first.mkv"])
def test_the_page_shows_frame_reference_and_answer(options, reference, folder, capsys, monkeypatch):
    states, pages = [], []
    show = Page.show

    def shown(self, snapshot):
        show(self, snapshot)
        pages[:] = [self]
        if snapshot.frame.number in (2, 30, 39):
            with urlopen(f"{self.url}state") as answer:
                states.append(json.load(answer))

    def interrupted(seconds):
        if seconds > 60:
            end = time.monotonic() + 20
            while (state := pages[0].state())["shown"] != state["frame"]:
                assert time.monotonic() < end
            raise KeyboardInterrupt

    monkeypatch.setattr(Page, "show", shown)
    monkeypatch.setattr("dejavu_torch.cli.live.time.sleep", interrupted)
    monkeypatch.chdir(folder)
    run("live", "map.safetensors", "second.mkv?stop=40", "--page", "0", "--reference", reference, *options)
    assert "dejavu pictures" not in [thread.name for thread in threading.enumerate()]
    out, err = capsys.readouterr()
    where, stays, summary = err.splitlines()
    assert re.fullmatch(r"dejavu: the page is at http://127\.0\.0\.1:\d+/", where)
    assert "Ctrl-C" in stays
    assert summary.startswith("dejavu: 40 frames, 0 dropped")
    assert [state["number"] for state in states] == [2, 30, 39]
    assert [state["place"] for state in states] == [lines_of(out)[i]["place"] for i in (2, 30, 39)]
    assert all(state["reference"].startswith("data:image/jpeg") for state in states)
    for state in states:
        if "--sequence" in options:
            assert (max(state["curve"]), state["off"]) == (1, None)
        else:
            assert sum(state["curve"]) + state["off"] == pytest.approx(1, abs=1e-3)


def test_a_map_of_even_steps_is_refused_but_as_it_is(tmp_path, capsys):
    model = DejaVu(velocity=camera(), mapper=SpectralMapper(20.0), whitening="none").learn(footage(REFERENCE))
    model.save(tmp_path / "map.safetensors")
    np.save(tmp_path / "frames.npy", _pixels(footage(REFERENCE[:9]))[..., 0])
    words = ("live", tmp_path / "map.safetensors", tmp_path / "frames.npy")
    assert "--as_is" in fails(capsys, *words)
    run(*words, "--as_is")
    found = lines_of(capsys.readouterr().out)
    assert len(found) == 9
    assert any(line["place"] != line["reference_frame"] for line in found)


@contextmanager
def process(*words):
    """`dejavu live` of its own; its lines can be read as they come."""
    code = "from dejavu_torch.cli import main; main()"
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Forked(code, "live", *words, imports=PACKAGE, text=True, **pipes) as started:
        yield started


@pytest.mark.parametrize("how", ["interrupt", "head"])
def test_a_process_that_nobody_needs_any_more_ends(how, folder, tmp_path):
    """Ctrl-C is how a camera is ended; and who reads the lines may leave."""
    stream = piped(tmp_path, (folder / "second.ts").read_bytes() * 2, open_for=60)
    with stream as pipe, process(folder / "map.safetensors", pipe) as live:
        json.loads(live.stdout.readline())
        if how == "interrupt":
            live.send_signal(signal.SIGINT)
        else:
            live.stdout.close()
        assert live.wait(20) == 0
        assert re.fullmatch(r"dejavu: \d+ frames, \d+ dropped; .*\n", live.stderr.read())


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("/dev/video99 --realtime", "is live already"),
        ("sim:aerial?frames=20 --reference sim:aerial", "--page"),
        ("sim:aerial?frames=20 --page 0 --reference sim:aerial?frames=20", "20 frames"),
        ("/dev/video99 --timeout 0", "--timeout 0; expected seconds, above 0"),
        ("/dev/video99 --moved drive.csv", "is live; expected a file with it, or LiveLocalizer"),
        ("sim:aerial?frames=20 --moved lost.csv", "lost.csv"),
        ("sim:aerial?frames=20 --metres_per_place 2", "2 metres a place, and no moves"),
        (
            "sim:aerial?frames=20 --lag 5 --match single",
            "--lag 5 with --match single; expected --match filter",
        ),
        ("sim:aerial?frames=20 --lag 5 --sequence 3", "--lag 5 with --match sequence:3"),
        ("sim:aerial?frames=20 --learns --match single", "--learns with --match single"),
    ],
)
def test_mistakes_are_one_line(words, told, folder, capsys):
    assert told in fails(capsys, "live", folder / "map.safetensors", *words.split())


@pytest.mark.parametrize("dropped", [False, True])
def test_a_file_with_odometry(dropped, folder, tmp_path, capsys, monkeypatch):
    """The way that frames have gone adds up over those that are dropped."""
    import dejavu_torch.cli.live as command

    model, video = DejaVu.load(folder / "map.safetensors"), open_source(folder / "second.mkv")
    moved = [0.5 + i % 3 for i in range(len(video))]
    (tmp_path / "moved.csv").write_text(
        "\n".join(["moved_m,moved_spread", *(f"{2 * one},{0.1 * one}" for one in moved)])
    )
    some = [*range(0, 20, 3 if dropped else 1)]
    original = command.shots_of
    monkeypatch.setattr(
        command, "shots_of", lambda traverse: (one for one in original(traverse) if one.number in some)
    )
    options = "--moved", tmp_path / "moved.csv", "--metres_per_place", 2
    run("live", folder / "map.safetensors", folder / "second.mkv", *options)
    found = [line["place"] for line in lines_of(capsys.readouterr().out)]
    localizer, expected, before = LiveLocalizer(model, PlaceFilter()), [], None
    for i in some:
        passed = range(i + 1) if before is None else range(before + 1, i + 1)
        way = sum(moved[j] for j in passed), sum((0.05 * moved[j]) ** 2 for j in passed) ** 0.5
        expected.append(localizer(video[i], moved=None if before is None else way).place)
        before = i
    assert found == expected


def test_a_file_is_opened_once(folder, monkeypatch):
    import dejavu_torch.cli.live as command

    opened = []
    monkeypatch.setattr(command, "open_source", lambda source: opened.append(source) or open_source(source))
    frames, *_ = command.frames_from(
        str(folder / "second.mkv"), DejaVu.load(folder / "map.safetensors"), False, False, None, DRIVES
    )
    assert next(iter(frames)).pixels.shape[-2:] == DejaVu.load(folder / "map.safetensors").frame_shape[1:]
    assert len(opened) == 1
