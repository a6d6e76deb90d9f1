"""Colours of the pages: text differs enough from what is behind it, in light and in dark."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import dejavu_torch

PACKAGE = Path(dejavu_torch.__file__).parent
LEAST = 4.5  # WCAG 2, level AA
BEHIND = ("page", "panel", "ours")
TEXTS = ("text", "soft", "link")


def luminance(colour):
    """Relative luminance of #rgb or #rrggbb, as WCAG defines it."""
    digits = colour if len(colour) == 6 else "".join(2 * digit for digit in colour)
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    red, green, blue = (x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one, other):
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_black_on_white_is_21_to_1():
    assert contrast("000", "ffffff") == pytest.approx(21)
    assert contrast("767676", "fff") == pytest.approx(4.54, abs=0.01)  # the lightest grey that is readable


@pytest.mark.parametrize("name", ["evaluation/report.html.j2", "live/page.html"])
def test_text_can_be_read_in_light_and_in_dark(name):
    style = (PACKAGE / name).read_text().partition("</style>")[0]
    schemes = [dict(re.findall(r"--(\w+):#(\w+)", rule)) for rule in re.findall(r":root\{([^}]*)\}", style)]
    assert len(schemes) == 2
    for colours in schemes:
        texts = [one for one in (*TEXTS, "yes") if one in colours]
        behind = [one for one in BEHIND if one in colours]
        assert len(texts) >= 3
        assert len(behind) >= 2
        pairs = {(a, b): contrast(colours[a], colours[b]) for a in texts for b in behind}
        assert {pair: ratio for pair, ratio in pairs.items() if ratio < LEAST} == {}
    named = re.findall(r"(?<![-\w])(?:color|fill):(?!var\()([^;}]+)", style)
    assert named == []  # every text has a colour of the scheme
