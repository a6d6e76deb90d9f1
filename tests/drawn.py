"""What several tests of pictures need."""

from __future__ import annotations

import io
from fractions import Fraction
from types import SimpleNamespace

import torch
from PIL import Image

from dejavu_torch.evaluation.plots import WIDTH
from dejavu_torch.types import FrequencyLayer, Match


def layer(period, start, stop, features=2):
    return FrequencyLayer(Fraction(period), int(period), start, stop, tuple(range(features)))


def matched(*index):
    place = torch.tensor(index)
    return Match(place, torch.zeros(len(place)), place >= 0)


def run_of(scores, **parts):
    """What pictures take of a `Localization`: scores (Q,N) of single queries, and these parts of it."""
    queries, places = scores.shape
    known = {
        "scores": lambda numbers: scores[numbers],
        "borders": torch.arange(places + 1),
        "query_frames": torch.arange(queries),
        "match": matched(*[0] * queries),
        "unit": "frames",
        **dict.fromkeys(("truth", "sequence")),
    }
    known |= parts
    return SimpleNamespace(**known, scored=known["match"])


def render(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    assert buffer.tell() > 3000
    assert figure.get_figwidth() == WIDTH
    return Image.open(buffer).convert("RGB")


def texts(figure):
    """Every text of a figure."""
    render(figure)
    return [text.get_text() for text in figure.findobj(match=lambda one: hasattr(one, "get_text"))]
