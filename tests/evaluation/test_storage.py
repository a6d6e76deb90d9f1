"""Areas over bytes, and what a comparison on a spectral map reports."""

from __future__ import annotations

import pytest
import torch
from helpers import refused, template_model

from dejavu_torch import DejaVu, SequenceMatcher
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.compare import compare
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.evaluation.storage import coded_at_sizes, noise_over_map
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.querying import Querying

PLACES, NUMBERS = 400, 16


def route(seed):
    """Smooth numbers, some of which repeat, and noise."""
    profile, noise = (torch.Generator().manual_seed(one) for one in (7, seed))
    walk = torch.randn(PLACES, NUMBERS // 2, generator=profile).cumsum(0) / 5
    waves = (torch.arange(PLACES)[:, None] * torch.rand(NUMBERS // 2, generator=profile)).sin()
    return torch.cat([walk, waves], 1) + 0.2 * torch.randn(PLACES, NUMBERS, generator=noise)


@pytest.fixture(scope="module")
def result():
    model = DejaVu(whitening="none", mapper=SpectralMapper(2.0))
    return compare(
        ArrayTraverse(route(0)),
        ArrayTraverse(route(1)),
        "0",
        model=model,
        tolerance=2,
        reporting=Reporting(storage_curve=True),
    )


@pytest.fixture(scope="module")
def report(result):
    return result.report.as_json()


def test_the_curve_is_in_the_report(report):
    storage = report["storage"]
    assert {"map", "null", "interpolated", "null_over_map"} == set(storage)
    sizes = [one["route_bytes_per_place"] for one in storage["map"]]
    assert sizes[:4] == pytest.approx([1, 2.5, 5, 10], rel=0.02)
    null = [one["route_bytes_per_place"] for one in storage["null"]]
    assert null[:4] == pytest.approx([1, 2.5, 5, 10], rel=0.02)
    assert max(sizes[4], null[4]) < 20  # no finer step changes a score
    for budget, one in zip((1, 2.5, 5, 10), storage["interpolated"], strict=False):
        assert one["route_bytes_per_place"] <= budget
    assert storage["map"][0]["auc"] > storage["null"][0]["auc"]
    assert "sequences" not in storage["map"][0]
    assert all(ratio >= 1 for ratio in storage["null_over_map"])
    assert storage["null_over_map"][0] > 1


def test_at_the_map_s_own_budget_the_curve_is_the_report(result, report):
    curve = coded_at_sizes(result.run, [2.0])
    (ours,), (null,), (between,) = curve["map"], curve["null"], curve["interpolated"]
    assert ours.auc == report["auc"]
    assert ours.route_bytes_per_place == report["route_bytes_per_place"]
    assert null.auc == pytest.approx(report["null"]["auc"], abs=0.05)  # coded to 2.0, not to the map's own
    assert between.route_bytes_per_place * PLACES == report["interpolated"]["route_bytes"]


def test_each_budget_is_evaluated_at_every_length():
    model = DejaVu(whitening="none", mapper=SpectralMapper(2.0))
    pair = ArrayTraverse(route(0)), ArrayTraverse(route(1))
    found = compare(
        *pair,
        "0",
        model=model,
        tolerance=2,
        querying=Querying(match=SequenceMatcher(5)),
        reporting=Reporting(storage_curve=True),
    )
    storage = found.report.as_json()["storage"]
    for key in ("map", "null", "interpolated"):
        for one in storage[key]:
            assert list(one["sequences"]) == ["1", "5", "11", "21"]
            assert one["sequences"]["5"] == {name: one[name] for name in ("auc", "recall_at_1")}
    (own,) = coded_at_sizes(found.run, [2.0])["map"]
    assert own.as_json()["sequences"] == found.report.as_json()["sequences"]
    assert "sequences" in found.pictures


def test_noise_as_smooth_as_the_route_costs_what_repetition_saves(report):
    assert report["noise_over_map"] > 1  # half of the numbers are waves, and noise has no lines
    order = torch.Generator().manual_seed(3)
    noise = torch.randn(PLACES, NUMBERS, generator=order).cumsum(0)
    waves = (torch.arange(PLACES)[:, None] * (0.2 + torch.arange(NUMBERS) / 9)).sin()
    kept = [noise_over_map(SpectralMapper(3.0)(series), series) for series in (noise, waves)]
    assert kept[0] == pytest.approx(1, abs=0.1)
    assert kept[1] > 1.4


def test_budgets_that_cannot_be_met_are_left_out(result):
    curve = coded_at_sizes(result.run, [0.01, 1000.0])
    assert curve["map"] == curve["null"] == []
    # two keyframes at least; all frames at most
    assert [one.route_bytes_per_place for one in curve["interpolated"]] == [NUMBERS]


def test_what_has_no_curve_is_refused(result):
    with refused("no ground truth", "spectral"):
        coded_at_sizes(result.run._replace(truth=None))
    with refused("'templates'", "spectral"):
        coded_at_sizes(result.run._replace(model=template_model().learn(route(0))))


def test_what_has_no_storage_curve_is_refused():
    pair = [ArrayTraverse(route(visit), f"visit {visit}") for visit in (0, 1)]
    with refused("none to judge a storage curve by", "a truth"):
        compare(*pair, reporting=Reporting(storage_curve=True))
    with refused("a storage curve of templates", "SpectralMapper"):
        compare(*pair, "0", model=template_model(), reporting=Reporting(storage_curve=True))


def test_noise_as_smooth_as_an_area_takes_as_many_bytes_as_noise_does():
    """Of smooth noise in rows and columns no repetition can be saved; read row by row it would be rougher."""
    draw = torch.Generator().manual_seed(0)
    plane = torch.nn.functional.avg_pool2d(torch.randn(12, 36, 44, generator=draw), 5, 1)
    layout, places = Layout(32, 40), plane.flatten(1).T
    place_map = SpectralMapper(6.0)(places, layout)
    assert len(place_map.chunks) == 1
    assert noise_over_map(place_map, places) == pytest.approx(1, abs=0.1)
