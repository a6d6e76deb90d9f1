from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers import refused

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.experiments.boundaries import GivenChunks, boundary_effect, known_boundaries
from dejavu_torch.experiments.compare import compare
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import Match


def test_chunks_end_at_the_cuts() -> None:
    assert GivenChunks([40, 100], {"min_period": 8}).chunks(160) == [(0, 40), (40, 100), (100, 160)]
    # pieces under two of the shortest periods join what lies before
    assert GivenChunks([5, 40, 50, 150], {"min_period": 8}).chunks(160) == [(0, 40), (40, 160)]
    with refused("10 frames", "at least 16"):
        GivenChunks([5], {"min_period": 8}).chunks(10)


def test_recall_near_and_far_by_hand() -> None:
    truth = as_ground_truth(torch.tensor([[0], [90], [100], [110], [111], [-1]]))
    index = torch.tensor([0, 90, 5, 110, 6, 7])  # right, right, wrong, right, wrong, no answer
    match = Match(index, torch.ones(6), torch.ones(6, dtype=torch.bool))
    effect = boundary_effect(match, truth, cuts=[100], tolerance=0, near=10)
    assert effect == (10, 3, 2, pytest.approx(2 / 3), 0.5)
    assert boundary_effect(match, truth, [100], 0, near=500)[2:] == (0, pytest.approx(3 / 5), None)
    with refused("no cuts"):
        boundary_effect(match, truth, [], 0)


def test_a_map_with_known_boundaries_is_learnt_and_judged_as_any_other(tmp_path: Path) -> None:
    """Period 10 up to frame 90, period 14 from there on; windows of 128 see both at once."""
    random = torch.Generator().manual_seed(0)

    def traverse() -> ArrayTraverse:
        parts = []
        for period, start, stop in ((10, 0, 90), (14, 90, 256)):
            profile = torch.randn(period, 12, generator=torch.Generator().manual_seed(period))
            parts.append(profile[torch.arange(start, stop) % period])
        values = torch.cat(parts)
        return ArrayTraverse(values + 0.3 * torch.randn(values.shape, generator=random), "a route")

    model = DejaVu(periods=SpectrogramAnalysis(128, false_alarm=None, strongest=1))
    reference, query = traverse(), traverse()
    query.name = "again"
    result = compare(reference, query, model=model, tolerance=0)
    fixed = [(chunk["start"], chunk["stop"]) for chunk in result.report.facts["chunks"]]
    assert fixed == [(0, 128), (128, 256)]
    known = known_boundaries(result, [90], tolerance=0)
    again = DejaVu(periods=GivenChunks([90], {"false_alarm": None, "strongest": 1})).learn(reference)
    assert {(layer.start, layer.stop) for layer in again.map.plan} == {(0, 90), (90, 256)}
    truth = torch.arange(256)
    match = again.localize(query)
    period = torch.where(truth < 90, 10, 14)
    assert ((match.index - truth) % period == 0).double().mean() > 0.9  # known up to the period that is there
    assert known.judged.scores == evaluate(match, truth[:, None], 0)
    assert known.known_effect == boundary_effect(match, as_ground_truth(truth[:, None]), [90], 0)
    fixed = evaluate(result.match, truth[:, None], 0)  # the default's scores are comparable already
    assert known.fixed.scores == fixed
    assert known.judged.scores.recall_at_1 > fixed.recall_at_1
    again.save(tmp_path / "map.safetensors")
    assert DejaVu.load(tmp_path / "map.safetensors").periods.chunks(256) == [(0, 90), (90, 256)]


def test_known_boundaries_need_a_truth() -> None:
    features = torch.randn(64, 4)
    result = compare(ArrayTraverse(features, "a"), ArrayTraverse(features[:60], "b"))
    with refused("need a truth"):
        known_boundaries(result, [30], 5)
