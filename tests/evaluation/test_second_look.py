"""Queries that a camera or a program has altered: the cause is told, and only where there is one."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import run
from helpers import refused
from torch import nn

from dejavu_torch import HOG, DejaVu, Preprocess, SpectralMapper, Whitening, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.traverse import Frames, Part
from dejavu_torch.data.turning import TURNS, Upright
from dejavu_torch.evaluation import second_look as looking
from dejavu_torch.evaluation.second_look import CROP, LOOKS, _warped, is_doubtful, second_look
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.taken import Singly
from dejavu_torch.types import InputError

ROUTE = "sim:outdoor?frames=200&width=96&height=48"
BACK = {"90": "270", "270": "90"}
DATA = Path(os.environ.get("DEJAVU_TEST_DATA", ""))


@pytest.fixture(autouse=True)
def time_enough(monkeypatch):
    monkeypatch.setattr(looking, "SECONDS", 600.0)


@pytest.fixture(scope="module")
def model():
    reference = open_source(ROUTE)
    return DejaVu(HOG(), Whitening(48, views=2), SpectralMapper(48.0)).learn(reference).calibrate(reference)


@pytest.fixture(scope="module")
def drive():
    return open_source(f"{ROUTE}&traverse=1")[:]


def found_by(model, frames):
    """Of how many a drive has a probability, and whether that is doubtful."""
    match = model.localize(frames, sequence=PlaceSmoother())
    found = int((match.probability >= 0.5).sum())
    return found, is_doubtful(found, len(match), match.smoother)


@pytest.mark.parametrize("turn", TURNS)
def test_turned_queries_are_told_with_the_option_that_turns_them_back(turn, model, drive):
    altered = Frames(TURNS[turn](drive).contiguous())
    assert found_by(model, altered) == (0, True)
    (doubt,) = second_look(model, altered, ordered=True)
    back = BACK.get(turn, turn)
    assert (doubt.kind, doubt.option) == ("look", f"?turn={back}")
    assert "32 of 32 frames are found if they are" in str(doubt)
    assert "(0 as they are)" in str(doubt)
    found, doubtful = found_by(model, Frames(TURNS[back](altered[:]).contiguous()))
    assert found > 150
    assert not doubtful


@pytest.mark.parametrize(
    ("taken", "turn", "option", "words"),
    [
        ("180", "90", "?turn=180", "turned by 90 degrees"),
        ("", "270", "", "turned by 90 degrees (0 as they are); remove its ?turn=270"),
        ("transpose", "90", "?turn=transpose", "mirrored"),
    ],
)
def test_a_source_that_is_turned_already_is_told_the_turn_that_it_should_have(
    taken, turn, option, words, model, drive
):
    """Its frames as the camera took them, and what they are turned by."""
    camera = Frames(TURNS[taken](drive).contiguous() if taken else drive)
    (doubt,) = second_look(model, Upright(camera, turn), ordered=True)
    assert words in doubt.text
    assert doubt.option == option
    if option:
        assert found_by(model, Upright(camera, option.removeprefix("?turn=")))[0] > 150


@pytest.mark.parametrize(
    ("by", "words"),
    [
        ((1 / 1.5,), "enlarged by 1.5"),
        ((1, 0, 0.15), "moved up by 15 %"),
        ((1, 0, -0.15), "moved down by 15 %"),
    ],
)
def test_another_lens_or_crop_is_told(by, words, model, drive):
    (doubt,) = second_look(model, Frames(_warped(*by)(drive)), ordered=True)
    assert words in doubt.text
    assert doubt.text.endswith(CROP)
    assert not doubt.option


@pytest.mark.parametrize(
    ("preprocess", "alter", "words"),
    [
        (Preprocess(channel="R-B"), lambda frames: frames.flip(1), "red and blue are exchanged"),
        (None, lambda frames: 1 - frames, "they are inverted"),
    ],
)
def test_colours_are_told_where_features_see_them(preprocess, alter, words, drive):
    """Gradients without a sign, as of the default, find such frames as they are."""
    reference = open_source(ROUTE)
    settings = Whitening(48, views=2), SpectralMapper(48.0)
    model = DejaVu(PatchPixels(), *settings, preprocess=preprocess).learn(reference).calibrate(reference)
    (doubt,) = second_look(model, Frames(alter(drive)), ordered=True)
    assert words in doubt.text


def test_queries_that_are_found_or_of_another_route_get_no_line(model, drive):
    assert found_by(model, Frames(drive)) == (200, False)
    for ordered in (True, False):
        assert second_look(model, Frames(drive), ordered) == []
    for other in (
        "sim:outdoor?frames=120&width=96&height=48&seed=5",
        "sim:underground?frames=120&width=96&height=48",
    ):
        foreign = open_source(other)
        assert found_by(model, foreign)[1]
        for ordered in (True, False):
            assert second_look(model, foreign, ordered) == []


def test_single_images_are_looked_at_by_themselves(drive):
    reference = open_source("sim:aerial?frames=160")
    model = DejaVu(HOG(), Whitening(48, views=2), SpectralMapper(48.0)).learn(reference).calibrate(reference)
    flown = Part(open_source("sim:aerial?frames=160&traverse=1"), torch.randperm(160))
    (doubt,) = second_look(model, Frames(flown[:].flip(-1)), ordered=False)
    assert doubt.option == "?turn=mirror"


def test_what_has_no_looks_gets_no_line(model, drive, monkeypatch):
    ready = DejaVu().learn(torch.rand(60, 8).cumsum(0))
    assert second_look(ready, ArrayTraverse(torch.rand(60, 8)), True) == []
    turned = Frames(TURNS["180"](drive))
    monkeypatch.setattr(looking, "SECONDS", -1.0)  # no time at all
    assert second_look(model, turned, True) == []


def test_a_look_is_taken_where_answers_are_few_or_single_images_deny_a_drive():
    def fitted(shown, nats, is_drive=True):
        return PlaceSmoother().changed(is_drive=is_drive, singly=Singly(shown, -1.0, 32, nats))

    assert not is_doubtful(50, 100, None)
    assert is_doubtful(49, 100, None)
    assert not is_doubtful(100, 100, fitted(-0.5, 4.0))
    assert is_doubtful(100, 100, fitted(-0.85, 4.0))  # taken by its motion alone
    assert is_doubtful(100, 100, fitted(-0.5, 4.0, is_drive=False))


def test_commands_and_reports_tell_it(tmp_path, capsys, drive):
    pixels = (255 * drive.permute(0, 2, 3, 1)).round().byte().numpy()
    np.save(tmp_path / "turned.npy", pixels[:, ::-1, ::-1])
    settings = "--features", "HOG", "--whitening.views", "2"
    run("compare", ROUTE, tmp_path / "turned.npy", "--ordered", "--out", tmp_path / "out", *settings)
    line = "frames are found if they are turned by 180 degrees"
    assert line in capsys.readouterr().out
    (doubt,) = json.loads((tmp_path / "out" / "report.json").read_text())["doubts"]
    assert doubt["option"] == "?turn=180"
    assert line in (tmp_path / "out" / "index.html").read_text()
    place_map = tmp_path / "out" / "map.safetensors"
    for source, told in ((tmp_path / "turned.npy", True), (f"{tmp_path / 'turned.npy'}?turn=180", False)):
        run("localize", place_map, source, "--ordered", "--out", tmp_path / "matches.csv")
        assert (line in capsys.readouterr().out) == told


@pytest.mark.slow
@pytest.mark.skipif(not DATA.name, reason="no real footage")
@pytest.mark.parametrize(
    ("reference", "query"),
    [
        ("nordland/summer?start=900", "nordland/winter?start=900"),
        ("robotcar/t1/reference.npy", "robotcar/t1/query.npy"),
        ("corridor/ref", "corridor/query"),
    ],
)
def test_real_drives_are_told_if_they_are_turned_and_only_then(reference, query):
    route = open_source(f"{DATA}/{reference}")
    route = Part(route, range(min(400, len(route))))
    model = DejaVu().learn(route).calibrate(route)
    shown = open_source(f"{DATA}/{query}")
    shown = Part(shown, range(100, 240) if len(shown) > 240 else range(len(shown)))
    assert second_look(model, shown, True) == []
    for turn in ("180", "transpose"):
        (doubt,) = second_look(model, Frames(TURNS[turn](shown[:]).contiguous()), True)
        assert doubt.option == f"?turn={turn}"


def test_turns_that_are_none_together_have_words():
    half = next(look for look in LOOKS if look.remedy == "180")
    assert half.doubt(3, 4, 0, "mirror").text.endswith("; alter the pictures themselves, beside ?turn=mirror")


def test_every_look_changes_a_picture_and_has_words_and_a_remedy():
    picture = torch.rand(1, 3, 20, 30)
    assert len({look.words for look in LOOKS}) == len(LOOKS) == 15
    for look in LOOKS:
        assert look.remedy
        altered = look.alter(picture)
        assert altered.shape[-2:] in ((20, 30), (30, 20))
        assert altered.shape != picture.shape or not torch.equal(altered, picture)


def test_a_refusal_of_frames_whose_sides_are_exchanged_names_turns():
    model = DejaVu(HOG(), "none").learn(torch.rand(40, 1, 32, 64))
    with refused("frames of 1 x 256 x 128", "?turn=90 or 270"):
        model.localize(torch.rand(2, 1, 256, 128))
    with pytest.raises(InputError) as square:
        model.localize(torch.rand(2, 1, 256, 256))
    assert "turn" not in str(square.value)


class Slow(nn.Module):
    """Features whose clock goes on by so many seconds a frame."""

    seconds, now = 0.0, 0.0

    def forward(self, frames):
        self.now += self.seconds * len(frames)
        return nn.functional.adaptive_avg_pool2d(frames, 8).flatten(1)


@pytest.mark.parametrize("seconds", [0.02, 0.1, 1.0])
def test_slow_features_do_not_make_a_look_long(seconds, monkeypatch):
    reference, query = (open_source(f"sim:aerial?frames=100&traverse={traverse}") for traverse in (0, 1))
    features = Slow()
    model = DejaVu(features).learn(reference).calibrate(reference)
    monkeypatch.setattr(looking, "SECONDS", 4.5)
    monkeypatch.setattr(looking, "monotonic", lambda: features.now)
    features.seconds, features.now = seconds, 0.0
    second_look(model, Frames(query[:].flip(-1)), ordered=True)
    assert features.now < 7
