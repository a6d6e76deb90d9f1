"""The paper's experiments, on a shorter route."""

from __future__ import annotations

import json
import re
from unittest.mock import create_autospec

import pytest
import torch
from helpers import refused
from torch import nn

from dejavu_torch.cli import main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.compare import compare
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.paper_tables import (
    PUBLISHED,
    boundary_lines,
    route_lines,
)
from dejavu_torch.evaluation.report import Report
from dejavu_torch.evaluation.reproduce import (
    BoundaryEffect,
    GivenChunks,
    boundary_effect,
    known_boundaries,
    paper_model,
    reproduce,
    structure_cuts,
)
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import Match

PAPER = {"min_period": 8, "peaks": "bins", "false_alarm": None, "short": "refuse"}
FRAMES = 512


def shorter(dataset, window):
    """The paper's settings with shorter chunks."""
    paper = paper_model(open_source(f"sim:{dataset}?frames=1"))
    paper.mapper = TemplateMapper(SpectrogramAnalysis(window, **PAPER), reduction="sum")
    return paper


@pytest.fixture(scope="module")
def aerial():
    """The first 512 frames, one chunk."""
    return reproduce("aerial", shorter("aerial", 512), frames=FRAMES)


def test_the_paper_s_settings_are_the_default(monkeypatch):
    class Asked(Exception):
        pass

    asked = create_autospec(compare, side_effect=Asked)
    monkeypatch.setattr("dejavu_torch.evaluation.reproduce.compare", asked)
    for dataset in PUBLISHED:
        with pytest.raises(Asked):
            reproduce(dataset)
        model, expected = asked.call_args.kwargs["model"], paper_model(open_source(f"sim:{dataset}?frames=1"))
        assert nn.Module.__repr__(model) == nn.Module.__repr__(expected)
        assert (model.velocity is None) == (dataset == "aerial")
        assert [reference.name for reference in asked.call_args.args] == [
            open_source(f"sim:{dataset}?seed=0{traverse}").name for traverse in ("", "&traverse=1")
        ]


@pytest.mark.slow
def test_the_database_itself_is_found_and_leaving_out_undoes_it(aerial):
    report = aerial.report.as_json()
    assert report["ideal"]["recall_at_1"] > 0.99 > report["recall_at_1"]
    assert report["ideal_leave_out"]["recall_at_1"] < 0.1
    assert report["published"] == PUBLISHED["aerial"]._asdict()


def test_other_datasets_are_refused():
    with refused("'moon'", "expected aerial, outdoor, underground"):
        reproduce("moon")


@pytest.mark.slow
def test_the_command_writes_an_index_over_the_reports(aerial, tmp_path, monkeypatch, capsys):
    short = create_autospec(reproduce, return_value=aerial)
    monkeypatch.setattr("dejavu_torch.evaluation.reproduce.reproduce", short)
    main(["reproduce", "aerial", "--out", str(tmp_path / "out")])
    assert short.call_args.args == ("aerial",)
    assert "aerial: the paper, its own footage" in capsys.readouterr().out
    page = (tmp_path / "out" / "index.html").read_text()
    links = re.findall(r'href="([^"]+)"', page)
    assert links == ["aerial/index.html"]
    assert (tmp_path / "out" / links[0]).exists()
    assert "<pre>dejavu reproduce aerial --out" in page
    assert "0.9813" in page
    assert f"aerial: {FRAMES} places, {FRAMES} queries; " in page
    report = json.loads((tmp_path / "out" / "aerial" / "report.json").read_text())
    assert {"ideal", "ideal_leave_out", "published", "auc", "null"} <= set(report)


@pytest.fixture(scope="module")
def outdoor():
    """The first 310 frames, from the start of the train on, in chunks of 64."""
    return reproduce("outdoor", shorter("outdoor", 64), frames=310)


def metres_of(result, traverse, frames):
    distance = open_source(f"sim:outdoor?frames=310&traverse={traverse}").distance[frames]
    return distance


@pytest.mark.slow
def test_train_footage_is_resampled_to_even_steps(outdoor):
    facts, route = outdoor.report.facts, outdoor.run.model.map
    assert facts["unit"] != "frames"
    assert facts["resampling"]["reference_frames"] == facts["resampling"]["query_frames"] == 310
    assert facts["frames"] == len(outdoor.run.reference_features) == route.places

    def bend(metres):
        return float((metres - torch.linspace(0, 1, len(metres)) * metres[-1]).abs().max())

    assert bend(metres_of(outdoor, 0, torch.arange(310))) > 15  # the train speeds up all the time
    assert bend(metres_of(outdoor, 0, route.frame_of(torch.arange(route.places)))) < 2.5
    measured = facts["measured_distance"]
    assert list(measured.values()) == pytest.approx([1, 1], abs=0.05)
    (line,) = route_lines({"outdoor": outdoor.report})
    assert f"is {measured['reference']:.3f} and {measured['query']:.3f} of the true one" in line

    assert outdoor.run.truth is not None
    right = outdoor.run.truth.positives[:, 0]
    known = right >= 0
    assert known.float().mean() > 0.7
    places = metres_of(outdoor, 0, route.frame_of(right[known]))
    seen = metres_of(outdoor, 1, outdoor.run.query.frame[known])  # type: ignore[attr-defined]
    assert (places - seen).abs().max() < 0.8  # metres; a step is about 0.4


class Rails(ArrayTraverse):
    """A traverse that tells where structures start and stop, at half a metre a frame."""

    structures = (("lamps", 5.0, 0.0, 20.0), ("panels", 3.0, 12.2, 900.0))
    distance = torch.arange(64, dtype=torch.float64) / 2


def test_cuts_are_the_frames_at_which_a_structure_starts_or_stops():
    assert structure_cuts(Rails(torch.rand(64, 3))) == [25, 40]  # 0 and 900 m are no cuts inside
    assert structure_cuts(ArrayTraverse(torch.rand(64, 3))) == []


@pytest.mark.slow
def test_the_effect_of_boundaries_is_a_line(aerial):
    assert boundary_lines({"aerial": aerial.report}) == []
    effects = {"cuts": 7, "known_boundaries": BoundaryEffect(32, 10, 20, 0.25, None)._asdict()}
    others = {"comparable": aerial.report.contenders["null"], "known_boundaries": aerial.report.ours}
    report = Report(aerial.report.ours, others, {**aerial.report.facts, "boundaries": effects})
    (line,) = boundary_lines({"underground": report})
    printed, shuffled = (c.scores.recall_at_1 for c in (report.ours, others["comparable"]) if c.scores)
    for fact in ("underground:", "7 places", f"{printed:.4f} as printed", f"{shuffled:.4f} with"):
        assert fact in line
    for fact in ("0.2500 within 32 places", "(10 queries)", "unknown elsewhere (20)"):
        assert fact in line


def test_given_chunks_end_at_the_cuts():
    assert GivenChunks([40, 100], min_period=8).chunks(160) == [(0, 40), (40, 100), (100, 160)]
    # pieces under two of the shortest periods join the piece before
    assert GivenChunks([5, 40, 50, 150], min_period=8).chunks(160) == [(0, 40), (40, 160)]
    with refused("10 places", "at least 16"):
        GivenChunks([5], min_period=8).chunks(10)


def test_recall_near_and_far_by_hand():
    truth = as_ground_truth(torch.tensor([[0], [90], [100], [110], [111], [-1]]))
    index = torch.tensor([0, 90, 5, 110, 6, 7])  # right, right, wrong, right, wrong, no answer
    match = Match(index, torch.ones(6), torch.ones(6, dtype=torch.bool))
    effect = boundary_effect(match, truth, cuts=[100], tolerance=0, near=10)
    assert effect == (10, 3, 2, pytest.approx(2 / 3), 0.5)
    assert boundary_effect(match, truth, [100], 0, near=500)[2:] == (0, pytest.approx(3 / 5), None)
    with refused("no cuts"):
        boundary_effect(match, truth, [], 0)


def two_periods(name, random):
    """Period 10 up to frame 90, period 14 from there on; windows of 128 see both at once."""
    parts = []
    for period, start, stop in ((10, 0, 90), (14, 90, 256)):
        profile = torch.randn(period, 12, generator=torch.Generator().manual_seed(period))
        parts.append(profile[torch.arange(start, stop) % period])
    values = torch.cat(parts)
    return ArrayTraverse(values + 0.3 * torch.randn(values.shape, generator=random), name)


def test_a_map_with_known_boundaries_is_learned_and_scored_as_any_other():
    random = torch.Generator().manual_seed(0)
    reference, query = two_periods("a route", random), two_periods("again", random)
    settings = {"false_alarm": None, "strongest": 1}
    model = DejaVu(mapper=TemplateMapper(SpectrogramAnalysis(128, **settings)))
    result = compare(reference, query, "0", model=model, tolerance=0)
    chunks = [(chunk["start"], chunk["stop"]) for chunk in result.report.facts["chunks"]]
    assert chunks == [(0, 128), (128, 256)]
    maps = known_boundaries(result, [90])
    again = DejaVu(mapper=TemplateMapper(GivenChunks([90], **settings))).learn(reference)
    assert {(chunk.start, chunk.stop) for chunk in again.summary().chunks} == {(0, 90), (90, 256)}
    truth = torch.arange(256)
    match = again.localize(query)
    period = torch.where(truth < 90, 10, 14)
    assert ((match.index - truth) % period == 0).double().mean() > 0.9  # known up to the period
    known, effect = maps["known_boundaries"]
    assert known.scores == evaluate(match, truth[:, None], 0)
    assert effect == boundary_effect(match, as_ground_truth(truth[:, None]), [90], 0)
    fixed = evaluate(result.run.match, truth[:, None], 0)  # the default's scores are comparable already
    assert maps["comparable"][0].scores == fixed
    assert known.scores is not None
    assert known.scores.recall_at_1 > fixed.recall_at_1
