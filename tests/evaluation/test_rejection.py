"""What accepting by probability keeps and lets in, and the picture of it."""

from __future__ import annotations

import pytest
import torch
from helpers import refused

from dejavu_torch.data.ground_truth import all_judged, as_ground_truth, near_truth
from dejavu_torch.data.source import as_traverse
from dejavu_torch.data.traverse import Fitted
from dejavu_torch.evaluation.rejection import (
    draw_reliability,
    reach_of,
    rejection_facts,
    rejection_table,
)
from dejavu_torch.types import Match

TRUTH = as_ground_truth(torch.tensor([[0], [1], [2], [3], [-1]]))
MATCH = Match(
    torch.tensor([0, 1, 9, 3, 4]),
    torch.tensor([0.3, 0.2, 0.1, 0.4, 0.5]),  # the wrong one has the best score
    torch.ones(5, dtype=torch.bool),
    torch.tensor([0.99, 0.995, 0.3, 0.9, 0.2], dtype=torch.float64),
)


def test_the_figures_of_a_rejection():
    facts = rejection_facts(MATCH, TRUTH, 0, {"sea": torch.tensor([0.1, 0.6, 0.995, 0.2])})["rejection"]
    assert facts["recall_at_100_precision"] == 0.75  # in the order of probability: all but the wrong one
    assert facts["auc"] == 0.5  # from the recall of the first answer on
    at = {one["asked"]: one for one in facts["precision"]}
    assert at[0.5] == {"asked": 0.5, "precision": 1.0, "kept": 1.0}
    assert at[0.99] == {"asked": 0.99, "precision": 1.0, "kept": 2 / 3}
    told = abs(0.99 + 0.995 + 0.9 - 3) + 0.3 + 0.2
    assert facts["expected_calibration_error"] == pytest.approx(told / 5)
    assert facts["off_map"] == {
        "sea": {"frames": 4, "accepted": {"0.5": 0.5, "0.8": 0.25, "0.9": 0.25, "0.95": 0.25, "0.99": 0.25}}
    }
    head, reached, kept, sea = rejection_table(facts)
    assert head == ["--precision", "0.5", "0.8", "0.9", "0.95", "0.99"]
    assert (reached[-1], kept[-1], sea) == (
        "1.0000",
        "0.667",
        ["accepted of 4 frames of sea", "0.5000", "0.2500", "0.2500", "0.2500", "0.2500"],
    )


def test_convention_13_the_reach_is_the_tolerance_else_what_the_truth_shows():
    metres = torch.arange(100.0)[:, None]
    near = all_judged(near_truth(metres, metres[::3] + 0.2, radius=4))  # 8 places
    for tolerance in (1, 5, 40):
        assert reach_of(tolerance, near, near=True) == reach_of(tolerance, None) == tolerance
    assert reach_of(0, near, near=True) == reach_of(0, near) == 4
    twice = torch.cat([metres, metres])  # a second lap is another stretch
    assert reach_of(0, all_judged(near_truth(twice, metres + 0.2, radius=4))) == 4
    sparse = all_judged(near_truth(10 * metres, 10 * metres, radius=4))
    assert reach_of(0, sparse, near=True) == 1
    assert reach_of(0, sparse) == reach_of(0, TRUTH) == reach_of(0, None) == 5
    listed = as_ground_truth([[7, 8, 6, 8, 30], [], [2, 1, 3], [0, 1]])  # in any order, one named twice
    assert reach_of(0, listed) == 1
    assert reach_of(0, as_ground_truth([[], []])) == reach_of(0, all_judged(torch.zeros(0, 0).long())) == 5


def test_without_probabilities_or_truth_there_is_less_to_tell():
    plain = Match(*MATCH)
    assert rejection_facts(plain, TRUTH, 0, {}) == draw_reliability(plain, TRUTH, 0) == {}
    assert rejection_facts(MATCH, None, 0, {}) == {"rejection": {"off_map": {}}}
    assert draw_reliability(MATCH, None, 0) == {}
    assert rejection_table({"off_map": {}}) == rejection_table({}) == []


@pytest.mark.parametrize("shape", [(1, 8, 6), (3, 20, 30)])
def test_frames_of_another_route_are_brought_to_the_map_s(shape):
    for channels in (1, 3):
        fitted = Fitted(as_traverse(torch.rand(5, channels, 10, 12)), shape)
        assert [batch.shape for batch in fitted.batches(3)] == [(3, *shape), (2, *shape)]
        assert len(fitted) == 5
    with refused("expected frames, not features"):
        Fitted(as_traverse(torch.rand(5, 4)), shape)
