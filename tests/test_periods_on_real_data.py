"""The aerial road: two flights over the same real dashes."""

from __future__ import annotations

from itertools import islice

import pytest
import torch

from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.extract import feature_batches
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis

FRAMES = 1024
TRUTH = torch.arange(FRAMES)[:, None]


@pytest.fixture(scope="module")
def flights(data_dir):
    """HOG of the first frames of both flights, cut as the data's README says."""
    both = []
    for name in ("pass1.png", "pass2.png"):
        strip = open_source(f"strip:{data_dir}/aerial_road/{name}?grey=1&halve=1&rows=32:128&width=96")
        assert len(strip) == 2697
        both.append(torch.cat(list(islice(feature_batches(strip, HOG(), 64), FRAMES // 64))))
    return both[0], both[1]


@pytest.fixture(scope="module")
def paper(flights):
    periods = SpectrogramAnalysis(peaks="bins", false_alarm=None, short="refuse")
    return DejaVu(mapper=TemplateMapper(periods, reduction="sum")).learn(flights[0])


def test_layers_are_learnt_and_the_dashes_stand_out(paper):
    """A dash and its gap are 97.5 frames: bins 10 and 11 of 1024, which read as 102 and 93."""
    features = {int(layer.period): len(layer.features) for layer in paper.map.plan}
    assert all(8 <= period <= 512 for period in features)
    assert max(features[93], features[102]) > 1.3 * max(features[85], features[114])


def test_the_paper_recognises_the_second_flight_and_its_null_is_clearly_worse(paper, flights):
    reference, query = flights
    ours = evaluate(paper.localize(query), TRUTH, 5)
    null = evaluate(null_control(paper, reference, query), TRUTH, 5)
    assert ours.auc > 0.8
    assert ours.auc > null.auc + 0.2
    assert ours.recall_at_1 > null.recall_at_1 + 0.1
    assert ours.recall_at_100_precision > 0.1 > 10 * null.recall_at_100_precision


def test_with_a_test_against_noise_the_shuffled_flight_has_no_layers(flights):
    reference, query = flights
    model = DejaVu(mapper=TemplateMapper()).learn(reference)
    assert evaluate(model.localize(query), TRUTH, 5).auc > 0.8
    assert evaluate(null_control(model, reference, query), TRUTH, 5) == (0.0,) * 8
