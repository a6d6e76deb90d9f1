from __future__ import annotations

import pytest
import torch

from dejavu_torch import ArrayTraverse, DejaVu, InputError, SpectrogramAnalysis
from dejavu_torch.experiments.compare import compare


def route(seed: int, frames: int = 240) -> torch.Tensor:
    """Features that repeat with periods 12 and 20, and noise."""
    noise = torch.Generator().manual_seed(seed)
    profile = torch.Generator().manual_seed(7)
    i = torch.arange(frames)
    parts = [torch.randn(p, 30, generator=profile)[i % p] for p in (12, 20)]
    return torch.cat(parts, 1) + 0.3 * torch.randn(frames, 60, generator=noise)


@pytest.fixture
def model() -> DejaVu:
    return DejaVu(periods=SpectrogramAnalysis(window=240, min_period=4, strongest=1))


def test_scores_of_a_route_that_repeats(model: DejaVu) -> None:
    result = compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=model)
    report = result.report.as_json()
    assert report["queries"] == 240
    # lcm(12, 20) = 60: of four places that look alike the first is reported
    assert report["recall_at_1"] == pytest.approx(60 / 240, abs=0.15)
    assert report["uncompressed"]["bytes"] == 240 * 60 * 4
    pictures = {"pr", "auc", "coverage", "chunks", "spectrogram", "templates", "activations"}
    assert set(result.pictures) == pictures
    assert 0 <= report["activations"]["fused"]["inside"] <= 1


def test_leave_out_is_printed_beside_never_instead(model: DejaVu) -> None:
    reference, query = ArrayTraverse(route(0)), ArrayTraverse(route(1))
    without = compare(reference, query, model=model).report.as_json()
    having = compare(reference, query, model=model, leave_out=2).report.as_json()
    assert "leave_out" not in without
    assert having["recall_at_1"] == without["recall_at_1"]
    assert 0 <= having["leave_out"]["recall_at_1"] <= 1


def test_the_seed_shuffles_the_null_only() -> None:
    model = DejaVu(periods=SpectrogramAnalysis(window=240, false_alarm=None))
    pair = ArrayTraverse(route(0)), ArrayTraverse(route(1))
    first, second = (compare(*pair, model=model, seed=seed).report.as_json() for seed in (0, 1))
    assert first["auc"] == second["auc"]
    assert first["null"] != second["null"]


def test_refuses_a_negative_tolerance(model: DejaVu) -> None:
    with pytest.raises(InputError, match="tolerance is -1"):
        compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=model, tolerance=-1)


def test_a_callable_metric() -> None:
    model = DejaVu(periods=SpectrogramAnalysis(window=240), metric=torch.cdist)
    result = compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=model)
    assert result.report.as_json()["recall_at_1"] > 0


def test_a_truth_without_any_right_answer_is_refused(model: DejaVu) -> None:
    with pytest.raises(InputError, match="no query has a right answer"):
        compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), "1000", model)
