from __future__ import annotations

import base64
import io
import re
import sys
from xml.etree import ElementTree

import pytest
import torch
from footage import QUERY, REFERENCE, STEP, camera, everything
from footage import footage as ground
from helpers import Fixed, all_of, refused, template_model
from PIL import Image
from torch import nn

from dejavu_torch import DejaVu, SequenceMatcher, SpectrogramAnalysis, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.compare import compare
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.options import Learning, Reporting
from dejavu_torch.evaluation.pictures import draw_compared, draw_pictures
from dejavu_torch.evaluation.report import score_table, sequence_table
from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.types import FrequencyLayer, Training


def route(seed, frames=240):
    """Features that repeat with periods 12 and 20, and noise."""
    noise = torch.Generator().manual_seed(seed)
    profile = torch.Generator().manual_seed(7)
    i = torch.arange(frames)
    parts = [torch.randn(p, 30, generator=profile)[i % p] for p in (12, 20)]
    return torch.cat(parts, 1) + 0.3 * torch.randn(frames, 60, generator=noise)


def smooth(seed, frames=200):
    """Features that change slowly, and never return."""
    steps = torch.randn(frames + 9, 12, generator=torch.Generator().manual_seed(seed))
    return steps.unfold(0, 10, 1).mean(2)


@pytest.fixture
def model():
    return template_model(periods=SpectrogramAnalysis(window=240, min_period=4, strongest=1))


@pytest.fixture
def _drawn(monkeypatch):
    """Pictures, and the facts that they tell, for the tests that look at them."""
    for draw in (draw_pictures, draw_compared):
        monkeypatch.setattr(f"dejavu_torch.evaluation.compare.{draw.__name__}", draw)


@pytest.mark.usefixtures("_drawn")
def test_a_comparison_is_shown_in_a_few_lines_and_in_a_notebook_as_table_and_pictures(model):
    reference, query = ArrayTraverse(route(0), "<b>&one"), ArrayTraverse(route(1), "two")
    result = compare(reference, query, "0", model)
    scores = result.report.ours.scores
    assert scores is not None
    for told in (repr(result), repr(result.report)):
        assert len(told) < 1000
        assert told.count("\n") < 6
        assert [fact for fact in (f"AUC {scores.auc:.3f}", "240 queries", "null") if fact not in told] == []
    assert "two on <b>&one" in repr(result)
    root = ElementTree.fromstring(f"<body>{result._repr_html_()}</body>")
    rows, images = root.findall(".//tr"), root.findall(".//img")
    assert (len(rows), len(images)) == (1 + len(result.report.shown()), 2)
    assert rows[1][1].text == f"{scores.auc:.3f}"
    for image in images:
        png = base64.b64decode(image.get("src", "").removeprefix("data:image/png;base64,"))
        assert Image.open(io.BytesIO(png)).width > 300


# a map that is there already


@pytest.fixture
def trained(model):
    """The map of route(0), with templates that are no phase means, as training leaves it."""
    model.learn(route(0))
    model.map.trainable(weights=True, start=torch.linspace(0.5, 1.5, 60))
    with torch.no_grad():
        model.map.templates.mul_(0.9)
    model.map.freeze()
    model.map.temperature = 0.1
    model.trained = Training(steps=30, seed=3)
    return model


def test_the_null_of_a_trained_map_has_the_templates_of_shuffled_frames(trained):
    reference, query = route(0), route(1)
    result = compare(
        ArrayTraverse(reference), ArrayTraverse(query), "0", model=trained, learning=Learning(seed=5)
    )
    null = result.report.contenders["null"]
    assert null.name == "control: templates of shuffled frames"
    assert "null_same_plan" not in result.report.contenders
    expected = null_control(trained, reference, query, 5, same_plan=True)
    assert null.scores == evaluate(expected, torch.arange(240)[:, None], 5)


@pytest.mark.parametrize("frames", [239, 241])
def test_another_reference_than_the_map_s_is_refused(trained, frames):
    with refused(f"has {frames} places", "the map has 240", "expected the reference"):
        compare(route(0, frames), route(1), "0", model=trained)


def test_a_reference_of_other_features_than_the_map_s_is_refused(trained):
    with refused("the array gives 6 features", "expects 60"):
        compare(torch.rand(240, 6), torch.rand(240, 6), "0", model=trained)


@pytest.mark.parametrize(("again", "own"), [(route(0), 1), (route(0)[40:], 1), (route(1), 0)])
def test_a_traverse_matched_with_itself_is_told_once(model, again, own, caplog):
    """Of tensors without names, and by a map of templates, which has no digest; of a part of it, too."""
    found = compare(route(0), again, str(240 - len(again)), model=model)
    told = [doubt["text"] for doubt in found.report.facts["doubts"] if doubt["kind"] == "provenance"]
    assert ["frames of the map itself" in one for one in told] == [True] * own
    assert "itself" not in caplog.text


def test_a_map_of_another_route_is_warned_of(caplog):
    def warnings(reference, tolerance=2):
        caplog.clear()
        pair = ArrayTraverse(reference, "one"), ArrayTraverse(route(1), "two")
        compare(*pair, "0", model=model, tolerance=tolerance)
        return [one.getMessage() for one in caplog.records]

    model = template_model(periods=Fixed(FrequencyLayer(240, 240, 0, 240, tuple(range(60))))).learn(route(0))
    assert warnings(route(0)) == []
    assert warnings(route(0), tolerance=0) == []
    (message,) = warnings(torch.randn(240, 60))
    assert re.fullmatch(r"the map finds \d+ of 240 frames of one; expected the reference .*", message)


def test_a_map_of_even_steps_is_compared_at_its_own_step():
    """Not at the one that its reference would get of itself."""
    reference, query = ArrayTraverse(ground(REFERENCE)), ArrayTraverse(ground(QUERY))
    model = template_model(periods=everything(101), velocity=camera()).learn(reference)
    model.velocity = camera(step=None)
    result = compare(reference, query, "0", model)
    assert len(result.run.reference_features) == len(result.run.query_features) == 101
    report = result.report.as_json()
    assert (report["resampling"]["step"], report["unit"]) == (STEP, "places at even steps")


# HOG beside other features


def pictures(seed):
    """64 frames that repeat after 8, with noise."""
    noise, texture = torch.Generator().manual_seed(seed), torch.Generator().manual_seed(7)
    frames = torch.rand(8, 1, 24, 24, generator=texture)[torch.arange(64) % 8]
    return ArrayTraverse((frames + 0.1 * torch.randn(frames.shape, generator=noise)).clamp(0, 1))


def test_whatever_stores_features_needs_the_backbone_as_well():
    net = nn.Sequential(nn.AvgPool2d(4), nn.Flatten(), nn.Linear(36, 40), nn.BatchNorm1d(40)).eval()
    weights = sum(tensor.nbytes for tensor in net.state_dict().values())
    model = template_model(net, SpectrogramAnalysis(window=64, min_period=4, strongest=1))
    report = compare(pictures(1), pictures(2), "0", model, tolerance=3).report.as_json()
    assert report["backbone_bytes"] == weights > 0
    assert report["map_bytes"] == model.summary().map_bytes > weights
    for key in ("uncompressed", "stride", "stride_coarsest"):
        kept = -(-64 // report[key]["k"])
        assert report[key]["bytes"] == kept * 160 + weights, key
    # the stride's frames take at least what the map takes beside the backbone, one more would be fewer
    k, own = report["stride"]["k"], report["map_bytes"] - weights
    assert -(-64 // k) * 160 >= own > -(-64 // (k + 1)) * 160
    assert k > 1


# sequences


def passing(seed, places=64, changes=1.5):
    """Features of single places that a visit changes too much to be told apart."""
    noise, profile = (torch.Generator().manual_seed(one) for one in (seed, 7))
    return torch.randn(places, 12, generator=profile) + changes * torch.randn(places, 12, generator=noise)


@pytest.mark.parametrize("kind", ["templates", "spectral"])
def test_sequences_of_every_contender(kind):
    model = DejaVu(whitening="none")
    if kind == "templates":
        model = template_model(periods=Fixed(FrequencyLayer(64, 64, 0, 64, tuple(range(12)))))
    pair = ArrayTraverse(passing(1)), ArrayTraverse(passing(2))

    def report(sequence):
        return compare(
            *pair, "0", model=model, tolerance=1, querying=Querying(match=sequence or "single")
        ).report.as_json()

    single, seven, filtered = report(None), report(SequenceMatcher(7)), report(PlaceFilter(within=1))
    keys = {key for key, entry in single.items() if isinstance(entry, dict) and "auc" in entry}
    assert {"uncompressed", "stride", "null"} <= keys
    for key in (None, *keys):
        one, many, by_filter = (all_ if key is None else all_[key] for all_ in (single, seven, filtered))
        assert "sequences" not in one
        assert list(many["sequences"]) == ["1", "5", "7", "11", "21"]
        for name in ("auc", "recall_at_1"):
            assert many["sequences"]["1"][name] == one[name]
            assert many["sequences"]["7"][name] == many[name]
        # of the very same scores
        assert by_filter["sequences"] == {
            **{T: many["sequences"][T] for T in ("1", "5", "11", "21")},
            "filter": {name: by_filter[name] for name in ("auc", "recall_at_1")},
        }
    assert seven["sequences"]["1"]["auc"] < 0.7 < 0.9 < seven["sequences"]["21"]["auc"]
    # 20 queries have no sequence of 21
    short = compare(
        pair[0], ArrayTraverse(passing(2)[:20]), "0", model, querying=Querying(match=SequenceMatcher(3))
    )
    assert list(short.report.as_json()["null"]["sequences"]) == ["1", "3", "5", "11"]


@pytest.mark.usefixtures("_drawn")
def test_a_filter_stands_beside_single_queries_in_order_and_changes_nothing_else():
    pair, model = (
        (ArrayTraverse(passing(1, changes=0.7)), ArrayTraverse(passing(2, changes=0.7))),
        DejaVu(whitening="none"),
    )

    def report(ordered, storage=False, drives="all"):
        order = {"ordered": ordered is True, "unordered": ordered is False}
        querying = Querying(match="single", centre="none", **order)
        reporting = Reporting(storage_curve=storage, drives=drives)
        result = compare(*pair, "0", model, 1, querying=querying, reporting=reporting).report
        ways = ["AUC, one image", "as it drives", "whole drive"]
        assert (score_table(result)[0][1:4] == ways) == bool(ordered)
        assert sequence_table(result) == []
        assert result.facts["answers"] == "single"
        return result.as_json()

    single, ordered = report(False), report(True, storage=True)
    assert "sequences" not in report(None)  # an array does not tell
    assert not compare(
        *pair, None, model, querying=Querying(ordered=True)
    ).run.matching.also  # nothing would show it
    filtered = compare(
        *pair, "0", model, tolerance=1, querying=Querying(match=PlaceFilter(within=1))
    ).report.as_json()
    for key in (None, *(key for key, entry in single.items() if isinstance(entry, dict) and "auc" in entry)):
        one, other, by_filter = (all_ if key is None else all_[key] for all_ in (single, ordered, filtered))
        assert list(other["sequences"]) == ["filter", "smoother"]
        assert other["sequences"]["filter"]["auc"] == by_filter["auc"]
        assert {name: other[name] for name in one if name.startswith(("auc", "recall"))} == {
            name: one[name] for name in one if name.startswith(("auc", "recall"))
        }
    few = report(True, drives="few")
    driven = {
        key
        for key, entry in few.items()
        if isinstance(entry, dict) and "smoother" in entry.get("sequences", ())
    }
    assert driven == {"uncompressed", "null"}
    assert "smoother" in few["sequences"]
    areas = [single["auc"], *(ordered["sequences"][way]["auc"] for way in ("filter", "smoother"))]
    assert areas[0] + 0.1 < areas[1] <= areas[2]
    assert all("sequences" not in size for size in ordered["storage"]["map"])


def test_single_images_beside_a_drive_have_probabilities():
    run = compare("sim:aerial?frames=100", "sim:aerial?frames=100&traverse=1").run
    assert run.answers == "drive"
    single = run.model.localize_descriptors(run.query_features)
    torch.testing.assert_close(run.by_one.probability, single.probability)
    assert run.by_one.probability.min() < 1
    assert run.by_one.accepted.all()


def test_seqslam_s_pixels_stand_beside_a_sequence_of_frames():
    """In frames of noise that repeat after 8, its sequences find what single frames do not."""
    model = template_model(nn.Flatten(), SpectrogramAnalysis(window=64, min_period=4, strongest=1))
    found = compare(
        pictures(1), pictures(2), "0", model, tolerance=3, querying=Querying(match=SequenceMatcher(5))
    ).report
    one = found.contenders["seqslam"]
    assert one.bytes == one.route_bytes == 64 * 24 * 24 * 4
    assert one.k == 1
    assert list(one.sequences) == [1, 5, 11, 21]
    pixels = [PatchPixels()(all_of(pictures(seed))) for seed in (1, 2)]
    expected = SequenceMatcher(5)(torch.cdist(pixels[1], pixels[0], p=1)).argmin(1)
    right = (expected - torch.arange(64)).abs() <= 3
    assert one.scores is not None
    assert one.scores.recall_at_1 == float(right.double().mean())


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("terminal", [True, False])
def test_each_long_step_has_a_bar_on_a_terminal(terminal, monkeypatch):
    stream = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    pair = [open_source(f"sim:aerial?frames=80&traverse={one}") for one in (0, 1)]
    compare(*pair, reporting=Reporting(distractors=[open_source("sim:outdoor?frames=10")], progress=True))
    steps = "learning", "calibrating", f"describing {pair[1].name}", "localizing"
    steps += "describing sim:outdoor", "baselines"
    assert [step for step in steps if step in stream.getvalue()] == ([*steps] if terminal else [])


def test_routes_off_the_map_are_prepared_as_queries_are(monkeypatch):
    """Ready features are accepted for ready features, and frames are resampled at the map's step."""
    monkeypatch.setattr("dejavu_torch.evaluation.compare.draw_pictures", lambda *_: {})
    features = [ArrayTraverse(smooth(seed), str(seed)) for seed in (0, 0, 3)]
    views = LabelledFrames(ArrayTraverse(smooth(0) + 0.1), torch.arange(200))
    found = compare(
        *features[:2],
        "0",
        learning=Learning(calibration=views),
        reporting=Reporting(distractors=features[2:]),
    ).report.facts
    assert found["rejection"]["off_map"]["3"]["frames"] == 200
    drives = [ArrayTraverse(ground(at), name) for at, name in ((REFERENCE, "a"), (QUERY, "b"), (QUERY, "c"))]
    model = DejaVu(velocity=camera(step=STEP))
    found = compare(*drives[:2], model=model, reporting=Reporting(distractors=drives[2:])).report.facts
    assert found["queries"] == found["rejection"]["off_map"]["c"]["frames"]


@pytest.mark.parametrize(
    ("reference", "other", "facts"),
    [
        ((20, 1, 32, 32), (5, 7), ("7 features", "1 x 32 x 32", "same number")),
        ((20, 8), (5, 7), ("8 features", "7 features", "same number")),
        ((20, 8), (5, 1, 32, 32), ("frames", "expected ready features", "route")),
    ],
)
def test_routes_of_another_kind_are_refused_before_learning(reference, other, facts, monkeypatch):
    monkeypatch.setattr(Descriptor, "learn", None)
    pair = ArrayTraverse(torch.rand(reference), "route"), ArrayTraverse(torch.rand(reference), "again")
    with refused("route", "elsewhere", *facts):
        compare(*pair, reporting=Reporting(distractors=[ArrayTraverse(torch.rand(other), "elsewhere")]))
