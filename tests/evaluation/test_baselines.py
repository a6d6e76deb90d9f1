"""What a user would store instead."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.evaluation.baselines import every, fair_stride, nearest_frames
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.sequence import SequenceMatcher

DISTANCES = {
    "l1": lambda a, b: (a - b).abs().sum(),
    "l2": lambda a, b: (a - b).square().sum().sqrt(),
    "cosine": lambda a, b: 1 - torch.nn.functional.cosine_similarity(a, b, dim=0),
}


def literal_nearest(reference, query, k, metric):
    """The first of the nearest stored frames, one pair at a time."""
    found = []
    for q in query:
        distances = [(DISTANCES[metric](q, reference[i]).item(), i) for i in range(0, len(reference), k)]
        best = min(distances)
        found.append((best[1], best[0]))
    return found


@pytest.fixture
def _parts(monkeypatch):
    """A few distances at a time."""
    monkeypatch.setattr("dejavu_torch.evaluation.baselines.BLOCK_DISTANCES", 20)


@pytest.mark.usefixtures("_parts")
@pytest.mark.parametrize("metric", ["l1", "l2", "cosine"])
def test_the_nearest_stored_frame(metric):
    torch.manual_seed(0)
    reference, query = torch.rand(23, 5, dtype=torch.float64), torch.rand(9, 5, dtype=torch.float64)
    for k in (1, 2, 7, 50):
        match = nearest_frames(reference, query, k, metric)
        expected = literal_nearest(reference, query, k, metric)
        assert match.index.tolist() == [index for index, _ in expected]
        assert match.score.tolist() == pytest.approx([score for _, score in expected], abs=1e-12)
        assert match.accepted.all()


@pytest.mark.usefixtures("_parts")
@pytest.mark.parametrize("k", [1, 4])
def test_frames_that_are_not_stored_are_driven_past_in_a_sequence(k):
    """Their distances are those of the nearest stored frame; a sequence tells where between them it is."""
    reference, query, matcher = torch.rand(30, 3), torch.rand(25, 3), SequenceMatcher(6)
    also = {1: SequenceMatcher(1), 6: SequenceMatcher(6)}
    found = nearest_frames(reference, query, k, matching=Matching(matcher, also))
    nearest = [min(range(0, 30, k), key=lambda stored: (abs(stored - frame), -stored)) for frame in range(30)]
    score, index = matcher(torch.cdist(query, reference[nearest], p=1)).min(1)
    for match in (found, found.sequences[6]):
        assert match.index.tolist() == index.tolist()
        assert torch.allclose(match.score, score)
    assert found.sequences[1].index.tolist() == nearest_frames(reference, query, k).index.tolist()


@given(
    st.integers(1, 60), st.integers(1, 4), st.sampled_from([1, 4]), st.integers(0, 1500), st.integers(0, 8)
)
def test_convention_8_the_fair_stride_stores_at_least_the_map(
    frames, dimension, itemsize, map_bytes, tolerance
):
    k = fair_stride(frames, dimension, itemsize, map_bytes, tolerance)
    fits = [
        j for j in range(1, 2 * tolerance + 1) if len(range(0, frames, j)) * dimension * itemsize >= map_bytes
    ]
    assert k == (max(fits) if fits else 1)


def test_convention_8_the_stride_is_at_most_twice_the_tolerance():
    """1000 frames of 10 numbers of 4 bytes, by the map's bytes and the tolerance."""
    strides = {(0, 5): 10, (4000, 5): 10, (4001, 5): 9, (20000, 5): 2, (40000, 5): 1, (40001, 5): 1}
    strides |= {(0, 1): 2, (0, 0): 1}
    assert {given: fair_stride(1000, 10, 4, *given) for given in strides} == strides


def test_strides_in_words():
    words = {1: "every", 2: "every 2nd", 3: "every 3rd", 11: "every 11th", 12: "every 12th", 22: "every 22nd"}
    assert {k: every(k, "frame") for k in words} == {k: f"{text} frame" for k, text in words.items()}
