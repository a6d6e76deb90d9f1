"""How often the expensive things are done: rows of scores, moves of a belief, and frames described.

A change may do them less often, and then writes here how often.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

from dejavu_torch import (
    HOG,
    DejaVu,
    PlaceFilter,
    PlaceSmoother,
    SpectralMapper,
    Whitening,
    compare,
    open_source,
)
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.plane import PlaneMotion
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.samples import RowSearch

SLACK = 0.1  # rounds of learning how a camera moves end a little earlier or later on another processor
ROUTE = [f"sim:aerial?seed=1&traverse={visit}&frames=150&size=32" for visit in (0, 1)]
AREA = (
    "demo:area?rows=16:96&stride=16&columns=0:512",
    "demo:area?traverse=1&rows=16:96&stride=16&columns=0:512",
)


@pytest.fixture
def counts(monkeypatch):
    """Counts rows of scores, rows that move, and frames described."""
    found = {"searched": 0, "scored": 0, "moved": 0, "described": 0}

    def counting(owner, method, what, of):
        plain = getattr(owner, method)

        def counted(self, *given, **named):
            found[what] += of(*given)
            return plain(self, *given, **named)

        monkeypatch.setattr(owner, method, counted)

    counting(SpectralMap, "products", "scored", lambda queries, _: len(queries))
    counting(RowSearch, "__call__", "searched", lambda queries, _: len(queries))
    counting(AlongRoute, "moved", "moved", lambda belief: belief[..., 0].numel())
    counting(PlaneMotion, "moved", "moved", lambda belief: belief[..., 0].numel())
    counting(HOG, "forward", "described", len)
    return found


def model():
    return DejaVu(HOG(), Whitening(48, views=1), mapper=SpectralMapper(24.0))


def localized(sequence):
    def run():
        model().learn(ROUTE[0]).localize(ROUTE[1], sequence=sequence())

    return run


def compared(reference, query, truth):
    return lambda: compare(
        open_source(reference),
        open_source(query),
        truth,
        model(),
        querying=Querying(ordered=True),
        reporting=Reporting(drives="all"),
    )


# views of the first 100 queries, and of 50 places when they are learned, are searched and scored
RUNS = {  # searched, scored, moved, described
    "single": (localized(lambda: None), (1450, 100, 0, 451)),
    "filter": (localized(PlaceFilter), (1300, 250, 150, 451)),
    "drive": (localized(PlaceSmoother), (1300, 1152, 1341, 451)),
    "compare": (compared(*ROUTE, "0"), (1450, 3104, 14019, 903)),
    "compare of an area": (compared(*AREA, None), (58, 1400, 9608, 765)),
}


@pytest.mark.parametrize("name", RUNS)
def test_nothing_is_done_more_often(name, counts):
    run, known = RUNS[name]
    torch.manual_seed(0)
    run()
    for (what, count), before in zip(counts.items(), known, strict=True):
        assert before * (1 - SLACK) <= count <= before * (1 + SLACK), what


def test_scores_are_a_few_calls_from_localize(monkeypatch):
    """`python -m pytest tests/test_counts.py -k few_calls`; what is between is told if it grows."""
    between, plain = [], SpectralMap.scores

    def scores(self, queries):
        frame, calls = sys._getframe(1), []
        while frame is not None and frame.f_code is not DejaVu.localize.__code__:
            if "dejavu_torch" in frame.f_code.co_filename:
                calls.append(f"{Path(frame.f_code.co_filename).name}: {frame.f_code.co_name}")
            frame = frame.f_back
        between[:] = max(between, calls, key=len)
        return plain(self, queries)

    learned, asked = model().learn(ROUTE[0]), open_source(ROUTE[1])[:]
    monkeypatch.setattr(SpectralMap, "scores", scores)
    for way, most in ((PlaceFilter(), 4), (PlaceSmoother(), 13)):
        between.clear()
        learned.localize(asked, sequence=way)
        assert 0 < len(between) <= most, between[::-1]
