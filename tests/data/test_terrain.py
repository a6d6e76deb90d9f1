"""The painted ground: an area in metres, and what its flights share."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from command_line import run
from helpers import refused

from dejavu_torch import open_source
from dejavu_torch.data.grid import Grid


def test_windows_are_places_in_metres():
    ground = open_source("sim:terrain?metres=40&window=32&stride=16")
    assert isinstance(ground, Grid)
    assert ground.name == "sim:terrain?seed=0&traverse=0&metres=40&window=32&stride=16"
    area = ground.area
    assert (area.rows, area.columns, area.unit) == (9, 9, "m")
    assert (area.first, area.right, area.down) == ((4.0, 4.0), (4.0, 0.0), (0.0, 4.0))
    assert ground.frame_shape == (3, 32, 32)
    assert ground.coordinates.values[-1].tolist() == [36.0, 36.0]


def test_the_picture_depends_on_the_options_alone():
    first = open_source("sim:terrain?seed=2&traverse=1&metres=48")
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        again = open_source("sim:terrain?seed=2&traverse=1&metres=48")
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(first.picture, again.picture)
    assert torch.equal(torch.get_rng_state(), before)
    for other in ("seed=2&traverse=2", "seed=3&traverse=1"):
        assert not torch.equal(first.picture, open_source(f"sim:terrain?{other}&metres=48").picture)


def test_flights_show_the_same_ground():
    """Similar at the same place, more than elsewhere, and in other light."""
    one, two = (open_source(f"sim:terrain?seed=1&metres=64&traverse={k}&stride=16")[:] for k in (0, 1))
    assert (one - two).abs().mean() > 0.04
    looks = [F.avg_pool2d(frames.mean(1, keepdim=True), 4).flatten(1) for frames in (one, two)]
    first, second = (F.normalize(look - look.mean(1, keepdim=True)) for look in looks)
    alike = first @ second.T
    same = alike.diagonal().mean()
    assert same > (alike.sum() - alike.trace()) / (alike.numel() - len(alike)) + 0.3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("metres=31", ["metres=31", "expected 32 <= metres <= 2048"]),
        ("metres=4000", ["metres=4000", "2048"]),
        ("metres=40&window=161", ["window=161", "expected 1 <= stride <= window <= 160 pixels"]),
        ("stride=0", ["stride=0", "1 <= stride"]),
        ("stride=65", ["stride=65", "stride <= window"]),
        ("traverse=-1", ["traverse=-1", "expected seed >= 0 and traverse >= 0"]),
        ("seed=-1", ["seed=-1"]),
        ("frames=4", ["unknown 'frames'", "expected seed, traverse, metres, window, stride"]),
    ],
)
def test_bad_options_are_refused(options, words):
    with refused(*words):
        open_source(f"sim:terrain?{options}")


def test_a_ground_that_does_not_fit_in_memory_is_refused(monkeypatch):
    monkeypatch.setattr("dejavu_torch.memory.free_memory", lambda: 8e7)
    assert len(open_source("sim:terrain?metres=40&stride=64")) == 4
    with refused("metres=256", "takes 91.9 MB", "at most the 80 MB free"):
        open_source("sim:terrain?metres=256")


def test_flights_are_compared_in_metres(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("dejavu_torch.evaluation.compare.draw_pictures", lambda *_: {})
    pair = ("sim:terrain?metres=40&stride=16", "sim:terrain?metres=40&traverse=1&stride=19")
    run("compare", *pair, "--tolerance", "5", "--features", "HOG", "--out", tmp_path / "report")
    assert "within 5 metres" in capsys.readouterr().out
    said = (tmp_path / "report" / "report.json").read_text()
    assert '"error_metres"' in said
