"""Pictures of scores, read back from the figures, and the colours that all pictures share."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from drawn import texts

from dejavu_torch.evaluation.contenders import COLOURS, Contender
from dejavu_torch.evaluation.curves import PRCurve, Scores
from dejavu_torch.evaluation.plots import DARK, GREY, LAYERS, PALE_RIGHT, PALE_WRONG, RIGHT, WRONG
from dejavu_torch.evaluation.score_plots import (
    Stored,
    draw_curves,
    draw_storage,
)


def contender(name, auc, points=4):
    curve = PRCurve(*torch.rand(3, points, dtype=torch.float64))
    return Contender(name, Scores(auc, *torch.rand(7).tolist()), curve=curve)


def rgb(colour):
    return tuple(int(colour[j : j + 2], 16) / 255 for j in (1, 3, 5))


def test_curves_have_the_colour_of_the_key_whatever_else_is_drawn():
    everything = {
        key: contender(f"the {key}", 0.1 * i) for i, key in enumerate(COLOURS) if key != "leave_out"
    }
    for keys in (list(everything), ["map", "hog", "null"], ["null_same_plan", "stride"]):
        pictures = draw_curves({key: everything[key] for key in keys}, "2 frames")
        by_name = {line.get_label(): line for line in pictures["pr"].plot[1].lines}
        for key in keys:
            line = by_name[f"the {key}"]
            assert line.get_color() == COLOURS[key]
            assert line.get_xdata().tolist() == everything[key].curve.recall.tolist()
        assert "right within 2 frames" in texts(pictures["pr"].plot[0])


def points(*pairs):
    return [Stored(size, area, area) for size, area in pairs]


def test_the_storage_picture_shows_the_points_and_what_the_null_takes():
    storage = {"map": points((1, 0.5), (2, 0.8)), "null": points((4, 0.5), (16, 0.6)), "interpolated": []}
    whole = Contender("all of them", Scores(0.9, 0.9, 0.1, 0.1, 0.9, 0.9, 0.9, 0.9), 100, 1)
    picture = draw_storage({"uncompressed": whole}, storage, "2 frames")["storage"]
    figure, axis = picture.plot
    lines = {line.get_label(): line for line in axis.lines}
    assert np.stack(lines["this map"].get_data(), 1).tolist() == [[1, 0.5], [2, 0.8]]
    assert lines["this map"].get_color() == COLOURS["map"]
    assert lines["all of them"].get_ydata() == [0.9, 0.9]
    assert axis.get_xscale() == "log"
    assert {"route bytes per place", "right within 2 frames"} <= set(texts(figure))
    assert "null control needs 4 times the bytes" in picture.caption
    assert picture.numbers["null_over_map"] == [4.0]
    assert picture.numbers["map"][0] == {"route_bytes_per_place": 1, "auc": 0.5, "recall_at_1": 0.5}
    assert draw_storage({}, {}, "2 frames") == draw_storage({}, {"map": []}, "2 frames") == {}


# Machado, Oliveira and Fernandes 2009: how linear RGB looks without one kind of cone
SIGHT = {
    "normal": torch.eye(3),
    "no red": torch.tensor(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no green": torch.tensor(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no blue": torch.tensor(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def oklab(colour, sight):
    """Coordinates in which equal steps look equal; black and white are 1 apart."""
    value = torch.tensor(rgb(colour))
    linear = torch.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    cones = torch.tensor(
        [[0.41222, 0.53633, 0.05145], [0.21190, 0.68070, 0.10740], [0.08830, 0.28172, 0.62998]]
    )
    lab = torch.tensor(
        [[0.21045, 0.79362, -0.00407], [1.97800, -2.42859, 0.45059], [0.02590, 0.78277, -0.80868]]
    )
    return lab @ (cones @ (sight @ linear).clamp(0, 1)) ** (1 / 3)


@pytest.mark.parametrize("sight", SIGHT)
@pytest.mark.parametrize(
    "together",
    [
        list(COLOURS.values())[:10],
        [RIGHT, WRONG, DARK],
        [RIGHT, WRONG, PALE_RIGHT, PALE_WRONG, GREY],
        [*LAYERS, COLOURS["map"]],
    ],
)
def test_colours_that_share_a_picture_differ_for_the_colour_blind(together, sight):
    for one, other in combinations(together, 2):
        apart = (oklab(one, SIGHT[sight]) - oklab(other, SIGHT[sight])).norm()
        assert apart > 0.05, (one, other)


def test_a_colour_means_one_contender():
    assert len({*COLOURS.values(), RIGHT, WRONG, GREY, DARK, *LAYERS}) == len(COLOURS) + 6
