"""What several tests of pictures need."""

from __future__ import annotations

import io
from fractions import Fraction

import torch
from matplotlib.figure import Figure
from PIL import Image

from dejavu_torch.evaluation.plots import WIDTH
from dejavu_torch.types import FrequencyLayer, Match


def layer(period: Fraction | int, start: int, stop: int, features: int = 2) -> FrequencyLayer:
    return FrequencyLayer(Fraction(period), int(period), start, stop, tuple(range(features)))


def matched(*index: int) -> Match:
    place = torch.tensor(index)
    return Match(place, torch.zeros(len(place)), place >= 0)


def render(figure: Figure) -> Image.Image:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    assert buffer.tell() > 3000
    assert figure.get_figwidth() == WIDTH
    return Image.open(buffer).convert("RGB")


def texts(figure: Figure) -> list[str]:
    """Every text of a figure."""
    render(figure)
    return [text.get_text() for text in figure.findobj(match=lambda one: hasattr(one, "get_text"))]
