"""What a user would store instead."""

from __future__ import annotations

import weakref

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import DejaVu, SpectralMapper, compare
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.baselines import (
    Baseline,
    baselines_of,
    every,
    fair_stride,
    matched,
    nearest_frames,
    quantised_every_kth,
    stored_frames,
)
from dejavu_torch.evaluation.options import Learning
from dejavu_torch.evaluation.quantiser import product_quantised
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.scorer import OfStored
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
    monkeypatch.setattr(OfStored, "at_once", 20)


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


def literal_stride(rows, each, tolerance):
    """The stride whose quantised frames find most frames by the mean of their neighbours, one at a time."""
    found = {}
    for k in range(1, 2 * tolerance + 2):
        kept = torch.arange(0, len(rows), k)
        codes = max(1, int(1.02 * each * len(rows) / len(kept)))
        if codes * len(kept) <= 1.02 * each * len(rows):
            stored, right = product_quantised(rows[kept], min(codes, rows.shape[1]))[0], 0
            for i in range(1, len(rows) - 1):
                asked = (rows[i - 1] + rows[i + 1]) / 2
                place = int(kept[int(torch.cosine_similarity(asked[None], stored).argmax())])
                right += abs(place - i) <= tolerance
            found[k] = right
    return max(found, key=lambda k: (found[k], -k))


@pytest.mark.parametrize("each", [0.3, 1.0, 5.0])
def test_a_product_quantiser_of_every_kth_frame(each):
    """Chosen on the reference alone; of noise that changes slowly, fewer frames in more bytes are found."""
    rows = torch.randn(300, 12, generator=torch.Generator().manual_seed(0)).cumsum(0)
    rows = torch.nn.functional.normalize(rows - rows.mean(0))
    rows[100:160] = rows[100]  # it stands: most of these are not found, whatever the stride
    found = quantised_every_kth(rows, each, 3)
    assert found.k == literal_stride(rows, each, 3)
    stored = torch.arange(0, 300, found.k)
    codes = min(12, int(1.02 * each * 300 / len(stored)))
    assert found.bytes == codes * len(stored) <= 1.02 * each * 300
    decoded, books = product_quantised(rows[stored], codes)
    assert torch.equal(found.restored[stored], decoded)
    assert found.codebooks == books
    assert quantised_every_kth(rows, 5.0, 0).k == 1  # each frame is asked for
    few = quantised_every_kth(rows, each, 3, centroids=16)
    assert few.codebooks == 4 * 16 * 12
    assert few.bytes <= 1.02 * each * 300 + 1


@pytest.mark.parametrize("k", [1, 4, 7, 11])
def test_the_best_place_elsewhere_is_another_stored_frame(k):
    """Whatever the stride, the confidence of a single answer compares two stored frames."""
    reference, query = torch.rand(60, 4), torch.rand(30, 4)
    match = nearest_frames(reference, query, k)
    stored = torch.arange(0, 60, k)
    distances = torch.cdist(query, reference[stored], p=1)
    for q, row in enumerate(distances):
        best = int(row.argmin())
        elsewhere = row[(stored - stored[best]).abs() > 5].min()
        assert match.index[q] == stored[best]
        assert match.confidence[q] == pytest.approx(float(-row[best] / elsewhere**0.75), rel=1e-4)


def test_a_product_quantiser_of_an_area_skips_rows_and_columns():
    area = Layout(9, 12)
    rows = torch.randn(area.places, 16, generator=torch.Generator().manual_seed(0))
    found = quantised_every_kth(rows, 1.0, 1, area)
    stored = len(stored_frames(area.places, found.k, area)[0])
    assert stored == -(-9 // found.k) * -(-12 // found.k)
    assert found.bytes % stored == 0


def test_the_bytes_of_coded_frames_of_an_area_are_those_of_the_frames_that_are_asked():
    rows = torch.randn(30 * 29, 16, generator=torch.Generator().manual_seed(0))
    reference, query = ArrayTraverse(rows), ArrayTraverse(rows + 0.2)
    reference.layout = query.layout = Layout(30, 29)
    model = DejaVu(None, "none", mapper=SpectralMapper(0.5))
    run = compare(
        reference,
        query,
        "0",
        model,
        tolerance=2,
        querying=Querying(match="single"),
        learning=Learning(calibration="none"),
    ).run
    coded = dict(baselines_of(run))["product_quantiser"]
    assert coded.k == 3
    assert len(coded.scorer.stored) == 10 * 10
    assert coded.bytes - coded.fixed == 10 * 10 * 4  # of four codes


def test_one_baseline_at_a_time_is_in_memory():
    alive = weakref.WeakSet()

    def baselines():
        for key in "abc":
            assert not alive, "the one before is still there"
            scorer = OfStored(torch.randn(30, 4), torch.randn(9, 4))
            alive.add(scorer)
            yield key, Baseline(key, scorer)
            del scorer

    found = matched(baselines())
    assert {key: len(match.index) for key, (_, match) in found.items()} == dict.fromkeys("abc", 9)


def test_codebooks_of_another_route_are_learned_there():
    draw = torch.Generator().manual_seed(0)
    rows, other = torch.randn(80, 8, generator=draw), torch.randn(60, 8, generator=draw)
    decoded, _ = product_quantised(rows, 2, training=other)
    for part in (slice(0, 4), slice(4, 8)):  # of so few, each is a centroid
        nearest = torch.cdist(rows[:, part], other[:, part]).argmin(1)
        torch.testing.assert_close(decoded[:, part], other[nearest][:, part])


def test_strides_in_words():
    words = {1: "every", 2: "every 2nd", 3: "every 3rd", 11: "every 11th", 12: "every 12th", 22: "every 22nd"}
    assert {k: every(k, "frame") for k in words} == {k: f"{text} frame" for k, text in words.items()}
