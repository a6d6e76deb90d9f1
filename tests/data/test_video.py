"""Video files: pixels, times, streaming, and files that are broken."""

from __future__ import annotations

import logging
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from helpers import all_of, refused
from torch.nn.functional import avg_pool2d
from videos import H264, clip, numbers, pictures

from dejavu_torch.data import video as video_module
from dejavu_torch.data.names import clock_time
from dejavu_torch.data.video import Video

MJPEG = {"codec": "mjpeg", "pixels": "yuvj420p"}
MPEG4 = {"codec": "mpeg4", "pixels": "yuv420p", "bframes": 2}
FFV1 = {"codec": "ffv1", "pixels": "bgr0"}
KINDS = {
    "h264.mp4": H264,
    "h264.mkv": H264,
    "h264.mov": H264,
    "h264.ts": H264,
    "h264.avi": H264,  # a container without presentation times
    "mpeg4.avi": MPEG4,
    "mpeg4.mp4": MPEG4,
    "mjpeg.avi": MJPEG,
    "mjpeg.mjpeg": MJPEG,
    "ffv1.mkv": FFV1,
    "ffv1.avi": FFV1,
}
FRONT = {"movflags": "faststart"}  # the table of contents first, so that a cut leaves it whole


@pytest.mark.parametrize("name", ["a.mkv", "a.avi", "with space: 100%d?.MKV", "12:30.mkv"])
@pytest.mark.parametrize("kind", [str, Path])
def test_lossless_pixels(tmp_path: Path, name: str, kind: type) -> None:
    frames = pictures(5)
    found = all_of(Video(kind(clip(tmp_path / name, frames))))
    assert found.dtype == torch.float32
    assert torch.equal(found, torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255)


@pytest.mark.parametrize("name", KINDS)
def test_frames_and_their_times_are_in_order(tmp_path: Path, name: str) -> None:
    video = Video(clip(tmp_path / name, pictures(30), **KINDS[name]))
    if name.endswith((".mp4", ".mov")):
        assert video.length == 30  # the file lists its frames
    frames = all_of(video, 7)
    assert frames.shape == (30, 3, 32, 48)
    assert numbers(frames) == list(range(30))
    times = video.times
    assert times.dtype == torch.float64
    torch.testing.assert_close(times - times[0], torch.arange(30).double() / 25, atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ["h264.mp4", "h264.mkv", "mjpeg.avi"])
@pytest.mark.parametrize("batch", [1, 2, 5, 100])
def test_the_batch_size_changes_nothing(tmp_path: Path, name: str, batch: int) -> None:
    video = Video(clip(tmp_path / name, pictures(11), **KINDS[name]), width=20)
    assert {len(part) for part in list(video.batches(batch))[:-1]} <= {batch}
    assert torch.equal(all_of(video, batch), all_of(video))
    chosen = list(Video(video.path).select(range(1, 9, 2), batch))
    assert max(len(part) for part in chosen) <= batch
    assert numbers(torch.cat(chosen)) == [1, 3, 5, 7]
    assert numbers(torch.cat(list(Video(video.path).between(9, 20)))) == [9, 10]


@pytest.mark.parametrize("name", ["h264.mp4", "h264.mkv", "mjpeg.avi"])
def test_times_of_a_variable_frame_rate(tmp_path: Path, name: str) -> None:
    ticks = [0, 1, 2, 6, 7, 8, 15, 16, 40, 41, 43]
    path = clip(tmp_path / name, pictures(11), ticks=ticks, **KINDS[name])
    expected = torch.tensor(ticks, dtype=torch.float64) / 25
    torch.testing.assert_close(Video(path).times, expected, atol=0, rtol=0)
    video = Video(path)
    assert numbers(all_of(video)) == list(range(11))
    assert torch.equal(video.times, expected)


@pytest.mark.parametrize("name", KINDS)
def test_frames_are_called_by_their_times(tmp_path: Path, name: str) -> None:
    path = clip(tmp_path / name, pictures(30), **KINDS[name])
    times = Video(path).times
    fresh, reading = Video(path), Video(path)
    named = [fresh.frame_name(i) for i in range(30)]
    assert named[0] == clock_time(float(times[0]))
    for seconds, text in zip(times.tolist(), named, strict=True):
        hours, minutes, rest = text.split(":")
        assert (hours, minutes, len(rest)) == ("0", "00", 6)
        assert float(rest) == pytest.approx(seconds, abs=6e-4)
    batches = reading.batches(4)
    for start in range(0, 30, 4):  # the same while the video is being read
        next(batches)
        assert [reading.frame_name(i) for i in range(start, min(start + 4, 30))] == named[start : start + 4]


def test_a_name_costs_no_second_reading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = Video(clip(tmp_path / "a.mkv", pictures(30)))
    batches = video.batches(4)
    next(batches)
    monkeypatch.setattr(video, "_open", lambda: pytest.fail("it is read again"))
    assert video.frame_name(3) == "0:00:00.120"
    assert sum(len(part) for part in batches) == 26
    assert video.frame_name(29) == "0:00:01.160"


@pytest.mark.parametrize("kind", ["h264.mp4", "h264.mkv", "ffv1.mkv", "mpeg4.mp4", "h264.ts"])
@pytest.mark.parametrize("first", ["frames", "times"])
def test_a_frame_rate_that_varies_is_told_once(
    tmp_path: Path, kind: str, first: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = clip(tmp_path / kind, pictures(12), ticks=[0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 13, 14], **KINDS[kind])
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        video = Video(path)
        for _ in (1, 2):
            if first == "frames":
                all_of(video)
            assert len(video.times) == 12
    (message,) = caplog.messages
    assert message.startswith(f"{path}: the frame rate varies, 40 to 120 ms from frame to frame (median 40)")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("rate", "ticks"),
    [
        (Fraction(30000, 1001), 1000),
        (Fraction(30000, 1001), 90000),
        (Fraction(60000, 1001), 1000),
        (Fraction(24000, 1001), 1000),
        (Fraction(240), 1000),
        (Fraction(480), 1000),
    ],
)
def test_rounded_timestamps_are_no_varying_rate(
    tmp_path: Path, rate: Fraction, ticks: int, caplog: pytest.LogCaptureFixture
) -> None:
    base = Fraction(1, ticks)
    stamps = [round(i / rate / base) for i in range(40)]
    video = Video(clip(tmp_path / "a.mkv", pictures(40), ticks=stamps, base=base))
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        all_of(video)
    assert len(set(video.times.diff().mul(1e6).round().tolist())) == 2  # they are rounded
    assert caplog.messages == []


@pytest.mark.parametrize("name", KINDS)
def test_a_steady_rate_is_not_remarked_on(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = clip(tmp_path / name, pictures(30), **KINDS[name])
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        all_of(Video(path))
        assert len(Video(path).times) == 30
        assert len(all_of(Video(clip(tmp_path / "one.mkv", pictures(1))))) == 1
    assert caplog.messages == []


@pytest.mark.parametrize("hidden", [4, 17])
def test_frames_that_an_edit_list_hides_are_left_out(tmp_path: Path, hidden: int) -> None:
    whole = clip(tmp_path / "whole.mp4", pictures(30), **H264)
    with av.open(str(whole)) as source, av.open(str(tmp_path / "cut.mp4"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.pts -= hidden * 512
                packet.dts -= hidden * 512
                packet.stream = stream
                target.mux(packet)
    video = Video(tmp_path / "cut.mp4")
    before = video.times
    assert video.length == 30 - hidden
    assert numbers(all_of(video)) == list(range(hidden, 30))
    assert torch.equal(before, torch.arange(30 - hidden).double() / 25)
    assert torch.equal(video.times, before)


@pytest.mark.parametrize(
    ("given", "shape"),
    [
        ({"width": 12}, (8, 12)),
        ({"height": 8}, (8, 12)),
        ({"width": 6, "height": 16}, (16, 6)),
        ({"width": 16, "height": 16}, (16, 16)),
        ({"width": 1}, (1, 1)),
    ],
)
def test_frames_are_averaged_over_areas(tmp_path: Path, given: dict, shape: tuple[int, int]) -> None:
    path = clip(tmp_path / "a.mkv", pictures(3))
    found = all_of(Video(path, **given))
    assert found.shape == (3, 3, *shape)
    expected = avg_pool2d(all_of(Video(path)), (32 // shape[0], 48 // shape[1]))
    torch.testing.assert_close(found, expected, atol=2 / 255, rtol=0)


@pytest.mark.parametrize(("turn", "quarters"), [(90, 1), (-90, 3), (180, 2), (0, 0)])
@pytest.mark.parametrize("given", [{}, {"width": 16}, {"width": 16, "height": 16}])
def test_frames_are_upright(tmp_path: Path, turn: int, quarters: int, given: dict) -> None:
    frames = pictures(2)
    upright = np.ascontiguousarray(np.rot90(frames, quarters, (1, 2)))  # counterclockwise
    found = all_of(Video(clip(tmp_path / "a.mkv", frames, turn=turn), **given))
    expected = all_of(Video(clip(tmp_path / "b.mkv", upright), **given))
    torch.testing.assert_close(found, expected, atol=2 / 255, rtol=0)


def test_frames_are_streamed(tmp_path: Path, largest_tensor: type) -> None:
    video = Video(clip(tmp_path / "a.mkv", pictures(30)), width=24)
    with largest_tensor() as seen:
        assert sum(len(batch) for batch in video.batches(4)) == 30
    assert seen.numel == 4 * 3 * 16 * 24


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
def test_the_file_is_closed(tmp_path: Path) -> None:
    video = Video(clip(tmp_path / "a.mkv", pictures(5)))

    def is_open() -> bool:
        return str(video.path) in [str(link.resolve()) for link in Path("/proc/self/fd").iterdir()]

    assert not is_open()
    batches = video.batches(2)
    next(batches)
    assert is_open()
    batches.close()
    assert not is_open()
    batches = video.batches(2)
    next(batches)
    del batches
    assert not is_open()
    assert video.times.shape == (5,)
    assert not is_open()


@pytest.mark.parametrize("content", [b"", b"no video\n" * 99, bytes(5000), b"\x1a\x45\xdf\xa3", b"RIFF"])
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.mjpeg", "a.ts"])
def test_a_file_that_is_no_video_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with refused(name):
        all_of(Video(tmp_path / name))


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("a.mkv", {"width": -1}, ("width=-1", "expected width and height of at least 0")),
        ("a.mkv", {"height": 1_000_000}, ("cannot be resized to 1000000 x 1500000 pixels",)),
        ("", {}, ("expected a video file",)),
        ("missing.mp4", {}, ("expected a video file",)),
    ],
)
def test_what_is_no_file_and_sizes_that_no_frame_has(
    tmp_path: Path, name: str, given: dict, words: tuple[str, ...]
) -> None:
    clip(tmp_path / "a.mkv", pictures(2))
    with refused(str(tmp_path / name), *words):
        all_of(Video(tmp_path / name, **given))


def test_sound_alone_is_refused(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.float32), "fltp", "mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    with refused("a.mp4", "no video stream"):
        Video(tmp_path / "a.mp4")


def test_a_video_without_frames_is_refused(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.height, stream.width, stream.pix_fmt = 32, 48, "yuvj420p"
        container.start_encoding()
    with refused("a.avi", "no frames"):
        all_of(Video(tmp_path / "a.avi"))


@pytest.mark.parametrize("kind", ["mjpeg.mjpeg", "h264.ts"])
def test_frames_of_another_size_are_refused(tmp_path: Path, kind: str) -> None:
    small = clip(tmp_path / f"small.{kind}", pictures(4, 32, 48), **KINDS[kind])
    large = clip(tmp_path / f"large.{kind}", pictures(4, 64, 80), **KINDS[kind])
    both = tmp_path / f"both.{kind}"
    both.write_bytes(small.read_bytes() + large.read_bytes())
    words = ["frame 4", "64 x 80 pixels", "expected 32 x 48"] if kind == "mjpeg.mjpeg" else []
    with refused(str(both), *words):
        all_of(Video(both))


@pytest.mark.parametrize("name", [name for name in KINDS if name.endswith((".mp4", ".mkv", ".avi", ".mov"))])
@pytest.mark.parametrize("part", [0.3, 0.5, 0.9, 0.999])
def test_a_truncated_video_is_refused(tmp_path: Path, name: str, part: float) -> None:
    options = FRONT if name.endswith((".mp4", ".mov")) else {}
    path = clip(tmp_path / name, pictures(30), options=options, **KINDS[name])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with refused(str(path), "cut off", "expected a whole video file"):
        Video(path)


@pytest.mark.parametrize("name", ["h264.mp4", "h264.mkv", "mjpeg.avi", "mpeg4.mp4", "h264.ts"])
@pytest.mark.parametrize("filling", [b"\0", b"\x5a", b"\xff"])
def test_a_hole_in_the_middle_is_refused(tmp_path: Path, name: str, filling: bytes) -> None:
    path = clip(tmp_path / name, pictures(30), **KINDS[name])
    whole = path.read_bytes()
    at, width = len(whole) // 2, 2000
    path.write_bytes(whole[:at] + width * filling + whole[at + width :])
    with refused(str(path), "expected a whole video file"):
        all_of(Video(path))


def test_any_cut_of_a_small_video_is_refused(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.mkv", pictures(3, 4, 6))
    whole = path.read_bytes()
    for stop in range(8, len(whole), 5):
        path.write_bytes(whole[:stop])
        with refused(str(path)):
            Video(path)


def test_a_video_recorded_live_is_read(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.mkv", pictures(5), options={"live": "1"})
    assert numbers(all_of(Video(path))) == [0, 1, 2, 3, 4]


def test_nothing_is_printed_on_a_broken_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = clip(tmp_path / "a.mp4", pictures(30), **H264)
    whole = path.read_bytes()
    at = len(whole) // 2
    path.write_bytes(whole[:at] + bytes(2000) + whole[at + 2000 :])
    capfd.readouterr()
    with refused("a.mp4"):
        all_of(Video(path))
    assert capfd.readouterr() == ("", "")


def test_a_drive(data_dir: Path) -> None:
    video = Video(data_dir / "highway" / "solidWhiteRight.mp4", width=160)
    before = video.times
    assert video.length == 221
    assert torch.equal(before, torch.arange(221).double() / 25)
    frames = all_of(video)
    assert frames.shape == (221, 3, 90, 160)
    assert torch.equal(video.times, before)
    assert next(Video(video.path).batches(1)).shape == (1, 3, 540, 960)


def test_a_list_of_other_files_is_no_video(tmp_path: Path) -> None:
    clip(tmp_path / "a.mkv", pictures(3))
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile a.mkv\n")
    with refused("list.mp4", "cannot be read as a video"):
        Video(tmp_path / "list.mp4")


def test_a_stream_that_claims_too_many_pixels_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = clip(tmp_path / "a.mkv", pictures(3))
    monkeypatch.setattr(video_module, "MOST_PIXELS", 1000)
    with refused("a.mkv has 32 x 48 pixels", "at most 1000"):
        Video(path)


@pytest.mark.parametrize("problem", [OverflowError("big"), MemoryError(), UnicodeError("x\ny"), KeyError(1)])
def test_whatever_the_decoder_raises_is_one_line(
    tmp_path: Path, problem: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = clip(tmp_path / "a.mkv", pictures(3))
    video = Video(path)

    def fail(*_: object) -> None:
        raise problem

    monkeypatch.setattr(Video, "_open", fail)
    with refused("a.mkv is broken near frame 0"):
        all_of(video)
    monkeypatch.undo()
    monkeypatch.setattr(av, "open", lambda *_, **__: fail())
    with refused("a.mkv cannot be read as a video"):
        Video(path)
