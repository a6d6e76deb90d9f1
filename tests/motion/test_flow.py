"""Optical flow of OpenCV between patches of ground: known shifts, and what cannot be followed."""

from __future__ import annotations

import math
import sys

import pytest
import torch
from footage import REFERENCE, STEP, camera, everything, footage
from helpers import refused, template_model
from torch.nn.functional import conv2d

from dejavu_torch import DejaVu
from dejavu_torch.cli import main
from dejavu_torch.motion.flow import flow_shift
from dejavu_torch.motion.odometry import GroundOdometry

pytest.importorskip("cv2")


def texture(count, rows, columns=96):
    """(count,1,rows,columns) in about [0.3, 0.7], grains of three pixels."""
    noise = torch.randn(count, 1, rows + 2, columns + 2)
    return 0.5 + 0.2 * conv2d(noise, torch.full((1, 1, 3, 3), 1 / 3))


def moved(shift, count=4, height=96, columns=96):
    """Two patches of the same ground, the second further by so many whole rows."""
    world = texture(count, height + 2 * 48, columns)
    return world[:, :, 48 : 48 + height], world[:, :, 48 - shift : 48 - shift + height]


def test_a_known_shift():
    for shift in range(-39, 40, 3):
        found, confidence = flow_shift(*moved(shift))
        torch.testing.assert_close(found, torch.full((4,), float(shift)), rtol=0, atol=0.15)
        assert confidence.min() > 0.5


@pytest.mark.parametrize("shift", [-7.5, -0.5, 0.3, 4.8])
def test_a_part_of_a_pixel(shift):
    fine = conv2d(torch.randn(2, 1, 1200, 98), torch.hann_window(31, periodic=False).view(1, 1, -1, 1) / 60)
    fine = 0.5 + conv2d(fine, torch.full((1, 1, 1, 3), 1 / 3))
    start = 100 - round(10 * shift)
    first, second = fine[:, :, 100:1060:10], fine[:, :, start : start + 960 : 10]
    found, confidence = flow_shift(first, second)
    torch.testing.assert_close(found, torch.full((2,), shift), rtol=0, atol=0.1)
    assert confidence.min() > 0.8


def test_unrelated_ground_is_not_believed():
    for one, other in (texture(20, 96).split(10), torch.rand(20, 1, 96, 96).split(10)):
        assert flow_shift(one, other)[1].max() < 0.15


def test_what_shows_nothing_is_not_believed():
    ground = texture(1, 96)
    for empty in (torch.zeros(1, 1, 96, 96), torch.full((1, 1, 96, 96), math.nan), ground * 1e-4):
        for pair in ((ground, empty), (empty, ground), (empty, empty)):
            shift, confidence = flow_shift(*pair)
            assert (shift.item(), confidence.item()) == (0, 0)


def test_what_is_refused(monkeypatch):
    with refused("flow is 'dis'", "expected phase or lk"):
        GroundOdometry(flow="dis")
    monkeypatch.setitem(sys.modules, "cv2", None)
    with refused("OpenCV", "pip install 'dejavu_torch[flow]'"):
        DejaVu(velocity=GroundOdometry(flow="lk")).learn(torch.rand(20, 1, 240, 320))
    GroundOdometry()(torch.rand(2, 1, 240, 320))


def test_a_map_opens_without_opencv_until_it_has_to_measure(monkeypatch, tmp_path, capsys):
    made = template_model(periods=everything(101), velocity=camera(step=STEP)).learn(footage(REFERENCE))
    assert made.velocity is not None
    made.velocity.flow = "lk"
    made.save(tmp_path / "m.safetensors")
    monkeypatch.setitem(sys.modules, "cv2", None)
    main(["info", str(tmp_path / "m.safetensors")])
    assert "lk" in capsys.readouterr().out
    with refused("OpenCV", "pip install 'dejavu_torch[flow]'"):
        DejaVu.load(tmp_path / "m.safetensors").localize(footage(REFERENCE[:20]))
