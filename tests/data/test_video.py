"""Video files: pixels, times, streaming, and files that are broken."""

from __future__ import annotations

import pickle
from fractions import Fraction

import av
import numpy as np
import pytest
import torch
from helpers import all_of, refused
from torch.nn.functional import avg_pool2d
from videos import H264, clip, high_range, numbers, pictures

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
FRAGMENTS = {"movflags": "empty_moov", "frag_duration": "400000"}  # of 10 frames each


@pytest.mark.parametrize("name", ["a.mkv", "a.avi", "with space: 100%d?.MKV", "12:30.mkv"])
def test_lossless_pixels(tmp_path, name):
    frames = pictures(5)
    found = all_of(Video(clip(tmp_path / name, frames)))
    assert found.dtype == torch.float32
    assert torch.equal(found, torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255)


@pytest.mark.parametrize("name", KINDS)
def test_frames_their_times_and_names_are_in_order(tmp_path, name, caplog):
    video = Video(clip(tmp_path / name, pictures(30), **KINDS[name]))
    assert len(video) == 30
    for i, batch in enumerate(video.batches(7)):
        assert batch.shape[1:] == (3, 32, 48)
        assert numbers(batch) == list(range(7 * i, min(7 * i + 7, 30)))
    times = video.times
    assert times is not None
    torch.testing.assert_close(times - times[0], torch.arange(30).double() / 25, atol=1e-3, rtol=0)
    assert video.names == [clock_time(seconds) for seconds in times.tolist()]
    assert len(all_of(Video(clip(tmp_path / "one.mkv", pictures(1))))) == 1
    assert caplog.messages == []  # the rate is steady


@pytest.mark.parametrize("group", [8, None], ids=["short groups", "one group"])
@pytest.mark.parametrize("name", KINDS)
def test_any_frame_is_exact_in_any_order(tmp_path, name, group):
    path = clip(tmp_path / name, pictures(30), group=group, **KINDS[name])
    whole, video = all_of(Video(path)), Video(path)
    assert numbers(whole) == list(range(30))
    mixed = [29, 3, 3, 17, 8, 7, 9, 0, 28, 16, 24, 25, 1]
    for i in (*mixed, *range(29, -1, -1), -1, -30):
        assert torch.equal(video[i], whole[i])
    assert torch.equal(video[mixed], whole[mixed])
    assert torch.equal(Video(path)[20:26], whole[20:26])
    assert torch.equal(pickle.loads(pickle.dumps(video))[[12, 4]], whole[[12, 4]])


@pytest.mark.parametrize("kind", ["h264.mp4", "h264.mkv", "mjpeg.avi"])
def test_a_frame_rate_that_varies_is_told_once(tmp_path, kind, caplog):
    ticks = [0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 13, 14]
    path = clip(tmp_path / kind, pictures(12), ticks=ticks, **KINDS[kind])
    for _ in (1, 2):
        video = Video(path)
        assert numbers(all_of(video)) == list(range(12))
        assert torch.equal(video.times, torch.tensor(ticks, dtype=torch.float64) / 25)
    (message,) = caplog.messages
    seen = f"{video.path}: the frame rate varies, 40 to 120 ms per frame (median 40)"
    assert message.startswith(seen)
    assert "\n" not in message


@pytest.mark.parametrize(
    ("rate", "ticks"),
    [(Fraction(30000, 1001), 1000), (Fraction(30000, 1001), 90000), (Fraction(480), 1000)],
)
def test_rounded_timestamps_are_no_varying_rate(tmp_path, rate, ticks, caplog):
    base = Fraction(1, ticks)
    stamps = [round(i / rate / base) for i in range(40)]
    video = Video(clip(tmp_path / "a.mkv", pictures(40), ticks=stamps, base=base))
    assert video.times is not None
    assert len(set(video.times.diff().mul(1e6).round().tolist())) == 2  # they are rounded
    assert caplog.messages == []


@pytest.mark.parametrize("hidden", [4, 17])
def test_frames_that_an_edit_list_hides_are_left_out(tmp_path, hidden):
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
    assert len(video) == 30 - hidden
    assert numbers(all_of(video)) == list(range(hidden, 30))
    assert torch.equal(video.times, torch.arange(30 - hidden).double() / 25)
    assert numbers(video[[20 - hidden, 2]]) == [20, 2 + hidden]


@pytest.mark.parametrize(
    ("given", "shape"),
    [({"height": 8}, (8, 12)), ({"width": 6, "height": 16}, (16, 6)), ({"width": 1}, (1, 1))],
)
def test_frames_are_averaged_over_areas(tmp_path, given, shape):
    path = clip(tmp_path / "a.mkv", pictures(3))
    found = all_of(Video(path, **given))
    assert found.shape == (3, 3, *shape)
    expected = avg_pool2d(all_of(Video(path)), (32 // shape[0], 48 // shape[1]))
    torch.testing.assert_close(found, expected, atol=2 / 255, rtol=0)


@pytest.mark.parametrize(("turn", "quarters"), [(90, 1), (-90, 3), (180, 2)])
@pytest.mark.parametrize("given", [{}, {"width": 16}])
def test_frames_are_upright(tmp_path, turn, quarters, given):
    frames = pictures(2)
    upright = np.ascontiguousarray(np.rot90(frames, quarters, (1, 2)))  # counterclockwise
    found = all_of(Video(clip(tmp_path / "a.mkv", frames, turn=turn), **given))
    expected = all_of(Video(clip(tmp_path / "b.mkv", upright), **given))
    torch.testing.assert_close(found, expected, atol=2 / 255, rtol=0)


def test_frames_are_streamed(tmp_path, largest_tensor):
    video = Video(clip(tmp_path / "a.mkv", pictures(30)), width=24)
    with largest_tensor() as seen:
        assert sum(len(batch) for batch in video.batches(4)) == 30
    assert seen.numel == 4 * 3 * 16 * 24


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.mjpeg", "a.ts"])
def test_a_file_that_is_no_video_is_refused(tmp_path, name):
    for content in (b"", b"no video\n" * 99, bytes(5000), b"\x1a\x45\xdf\xa3", b"RIFF"):
        (tmp_path / name).write_bytes(content)
        with refused(name):
            all_of(Video(tmp_path / name))


def test_sizes_that_no_frame_has_are_refused(tmp_path):
    path = clip(tmp_path / "a.mkv", pictures(2))
    with refused(str(path), "width=-1", "expected width and height of at least 0"):
        Video(path, width=-1)
    with refused(str(path), "resized has 1000000 x 1500000 pixels"):
        all_of(Video(path, height=1_000_000))


def test_sound_alone_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.float32), "fltp", "mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    with refused("a.mp4", "no video stream"):
        Video(tmp_path / "a.mp4")


@pytest.mark.parametrize("kind", ["mjpeg.mjpeg", "h264.ts"])
def test_frames_of_another_size_are_refused(tmp_path, kind):
    small = clip(tmp_path / f"small.{kind}", pictures(4, 32, 48), **KINDS[kind])
    large = clip(tmp_path / f"large.{kind}", pictures(4, 64, 80), **KINDS[kind])
    both = tmp_path / f"both.{kind}"
    both.write_bytes(small.read_bytes() + large.read_bytes())
    words = ["frame 4", "64 x 80 pixels", "expected 32 x 48"] if kind == "mjpeg.mjpeg" else []
    with refused(str(both), *words):
        all_of(Video(both))


@pytest.mark.parametrize("kept", [1, 15, 29])
@pytest.mark.parametrize("more", [0, 1, 20], ids=lambda more: f"{more} more bytes")
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("h264.mp4", FRONT),
        ("h264.mp4", FRAGMENTS),
        ("mpeg4.mp4", FRONT),
        ("h264.mov", FRONT),
        ("h264.mkv", {}),
        ("ffv1.mkv", {}),
        ("h264.avi", {}),
        ("mpeg4.avi", {}),
        ("mjpeg.avi", {}),
    ],
)
def test_a_cut_behind_a_frame_is_refused(tmp_path, name, options, more, kept):
    path = clip(tmp_path / name, pictures(30), options=options, **KINDS[name])
    assert numbers(all_of(Video(path))) == list(range(30))
    with av.open(str(path)) as container:
        ends = [packet.pos + packet.size for packet in container.demux(video=0) if packet.size]
    path.write_bytes(path.read_bytes()[: ends[kept - 1] + more])
    with refused(str(path), "cut off", "expected a complete video file"):
        Video(path)


@pytest.mark.parametrize("name", ["h264.mp4", "h264.mkv", "mjpeg.avi", "mpeg4.mp4", "h264.ts"])
def test_a_hole_in_the_middle_is_refused_in_one_line(tmp_path, name, capfd):
    path = clip(tmp_path / name, pictures(30), **KINDS[name])
    whole = path.read_bytes()
    at, width = len(whole) // 2, 2000
    capfd.readouterr()
    for filling in (b"\0", b"\x5a", b"\xff"):
        path.write_bytes(whole[:at] + width * filling + whole[at + width :])
        with refused(str(path), "expected a complete video file"):
            all_of(Video(path))
    assert capfd.readouterr() == ("", "")


def test_a_video_recorded_live_is_read(tmp_path):
    path = clip(tmp_path / "a.mkv", pictures(5), options={"live": "1"})
    assert numbers(all_of(Video(path))) == [0, 1, 2, 3, 4]
    path = clip(tmp_path / "a.avi", pictures(5))
    whole = path.read_bytes()
    for length in (bytes(4), b"\xff" * 4):  # as where it could not be filled in
        path.write_bytes(whole[:4] + length + whole[8:])
        assert numbers(all_of(Video(path))) == [0, 1, 2, 3, 4]


def test_a_stream_that_claims_too_many_pixels_is_refused(tmp_path, monkeypatch):
    path = clip(tmp_path / "a.mkv", pictures(3))
    monkeypatch.setattr(video_module, "MOST_PIXELS", 1000)
    with refused("a.mkv has 32 x 48 pixels", "at most 1000"):
        Video(path)


@pytest.mark.parametrize("transfer", [16, 18])
def test_high_dynamic_range_becomes_the_usual_one(tmp_path, transfer):
    line = np.linspace(16, 235, 64).round().astype(np.uint8)[None].repeat(48, 0)
    shown = np.stack([line, line // 2, 200 - line // 2], -1)
    frames = np.stack([shown, shown[:, ::-1]])
    path = clip(tmp_path / "a.mkv", high_range(frames, transfer), pixels="yuv420p10le", transfer=transfer)
    wanted = torch.from_numpy(frames).permute(0, 3, 1, 2) / 255
    assert float((all_of(Video(path)) - wanted).abs().mean()) < 0.01
    assert float((all_of(Video(path, width=32)) - avg_pool2d(wanted, 2)).abs().mean()) < 0.01
