from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from helpers import refused
from torch import Tensor, nn

from dejavu_torch import HOG, ArrayTraverse, DejaVu, InputError, SpectrogramAnalysis
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.evaluation.curves import judge
from dejavu_torch.experiments.compare import compare
from dejavu_torch.types import Training, Traverse


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


# a map that is there already


class Unknown(Traverse):
    """Frames of which nobody knows how many there are until they have been read."""

    def __init__(self, values: Tensor) -> None:
        self.values, self.length = values, None

    def batches(self, size: int) -> Iterator[Tensor]:
        yield from self.values.split(size)


@pytest.fixture
def trained(model: DejaVu) -> DejaVu:
    """The map of route(0), with templates that are no phase means, as training leaves it."""
    model.learn(route(0))
    model.map.trainable(weights=True, start=torch.linspace(0.5, 1.5, 60))
    with torch.no_grad():
        model.map.templates.mul_(0.9)
    model.map.settle()
    model.matcher.temperature = 0.1
    model.trained = Training(steps=30, seconds=1000.0, seed=3)
    return model


def test_a_map_that_is_there_is_judged_as_it_is(trained: DejaVu) -> None:
    before, expected = trained.map, trained.localize(route(1))
    templates = before.templates.clone()
    result = compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=trained, learn=False)
    assert result.model.map is before
    assert torch.equal(before.templates, templates)
    for one, other in zip(result.match, expected, strict=True):
        assert torch.equal(one, other)
    report = result.report.as_json()
    assert report["trained"] == {"steps": 30, "seconds": 1000.0, "seed": 3}
    assert 1000 < report["seconds_learn"] < 1100
    assert report["map_bytes"] == trained.map_bytes
    # the area tells them apart: this map's is not the learnt map's
    anew = compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=trained).report.as_json()
    assert anew["trained"] is None
    assert anew["seconds_learn"] < 100
    assert anew["auc"] != report["auc"]


def test_the_null_of_a_trained_map_has_the_templates_of_shuffled_frames(trained: DejaVu) -> None:
    reference, query = route(0), route(1)
    result = compare(ArrayTraverse(reference), ArrayTraverse(query), model=trained, learn=False, seed=5)
    null = result.report.contenders["null"]
    assert null.name == "null: templates of shuffled frames"
    assert "null_same_plan" not in result.report.contenders
    expected = null_control(trained, reference, query, 5, same_plan=True)
    assert null.scores == judge(expected, torch.arange(240)[:, None], 5)


def test_a_learnt_map_that_is_there_keeps_its_nulls(model: DejaVu) -> None:
    pair = ArrayTraverse(route(0)), ArrayTraverse(route(1))
    learnt = compare(*pair, model=model).report.as_json()
    there = compare(*pair, model=model, learn=False).report.as_json()
    for key in ("auc", "recall_at_1", "null", "null_same_plan", "stride", "trained", "periods"):
        assert there[key] == learnt[key], key


@pytest.mark.parametrize("kind", [ArrayTraverse, Unknown])
@pytest.mark.parametrize("frames", [239, 241])
def test_another_reference_than_the_map_s_is_refused(trained: DejaVu, frames: int, kind: Any) -> None:
    with refused(f"gives {frames} places", "holds 240", "expected the reference that it was made of"):
        compare(kind(route(0, frames)), kind(route(1)), "0", model=trained, learn=False)


def test_a_model_without_a_map_has_nothing_to_judge(model: DejaVu) -> None:
    with refused("240 places", "holds 0"):
        compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=model, learn=False)


def test_features_of_another_dimension_than_the_map_s_are_refused(trained: DejaVu) -> None:
    pair = ArrayTraverse(route(0)[:, :59]), ArrayTraverse(route(1)[:, :59])
    with refused("59", "60"):
        compare(*pair, model=trained, learn=False)


def test_leaving_out_of_a_trained_map_is_refused(trained: DejaVu) -> None:
    with refused("leave-out", "trained templates"):
        compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=trained, leave_out=2, learn=False)


# HOG beside other features


def pictures(seed: int, size: int = 24) -> ArrayTraverse:
    """64 frames that repeat after 8, with noise."""
    noise, texture = torch.Generator().manual_seed(seed), torch.Generator().manual_seed(7)
    frames = torch.rand(8, 1, size, size, generator=texture)[torch.arange(64) % 8]
    return ArrayTraverse((frames + 0.1 * torch.randn(frames.shape, generator=noise)).clamp(0, 1))


def contenders(features: nn.Module | None, size: int = 24, tolerance: int = 3) -> dict[str, Any]:
    periods = SpectrogramAnalysis(window=64, min_period=4, strongest=1)
    model = DejaVu(features, periods)
    return dict(
        compare(pictures(1, size), pictures(2, size), "0", model, tolerance).report.contenders.items()
    )


def test_hog_stands_beside_other_features() -> None:
    found = contenders(nn.Sequential(nn.AvgPool2d(4), nn.Flatten()))
    dimension = HOG()(torch.rand(1, 1, 24, 24)).shape[1]
    for key, k, name in (("hog", 1, "HOG, every frame"), ("hog_stride_coarsest", 6, "HOG, every 6th frame")):
        assert (found[key].name, found[key].k) == (name, k)
        assert found[key].bytes == -(-64 // k) * dimension * 4
        assert found[key].scores is not None
    # of the eight that look alike the noise decides: all are frames, none is the map
    assert 0 < found["hog"].scores.recall_at_1 < 0.9


def test_hog_does_not_stand_beside_itself_nor_where_there_are_no_frames(model: DejaVu) -> None:
    assert not {"hog", "hog_stride_coarsest"} & contenders(None).keys()
    features = compare(ArrayTraverse(route(0)), ArrayTraverse(route(1)), model=model).report.contenders
    assert not {"hog", "hog_stride_coarsest"} & features.keys()


def test_frames_too_small_for_hog_are_compared_without() -> None:
    found = contenders(nn.Flatten(), size=8)
    assert "uncompressed" in found
    assert not {"hog", "hog_stride_coarsest"} & found.keys()
