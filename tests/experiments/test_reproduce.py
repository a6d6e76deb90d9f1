"""The paper's experiments, on a shorter route."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import refused

from dejavu_torch.cli import commands, main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.data.truth import places_of_frames
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.report import Report
from dejavu_torch.experiments.boundaries import BoundaryEffect
from dejavu_torch.experiments.compare import Comparison, compare
from dejavu_torch.experiments.reproduce import paper_model, reproduce, structure_cuts, structure_places
from dejavu_torch.experiments.section_five import (
    PUBLISHED,
    Published,
    boundary_lines,
    route_lines,
    section_five,
)
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis

FRAMES, LENGTHS = 1024, (512, 1024, 2048)


@pytest.fixture(scope="module")
def aerial() -> Comparison:
    return reproduce("aerial", frames=FRAMES, lengths=LENGTHS)


def test_the_second_traverse_stands_at_top_level(aerial: Comparison) -> None:
    pair = [open_source(f"sim:aerial?frames={FRAMES}&traverse={traverse}") for traverse in (0, 1)]
    alone = compare(pair[0], pair[1], model=paper_model()).report.as_json()
    report = aerial.report.as_json()
    for key in ("auc", "recall_at_1", "map_bytes", "periods", "null", "uncompressed", "stride"):
        assert report[key] == alone[key], key


def test_the_database_itself_is_found_and_leaving_out_undoes_it(aerial: Comparison) -> None:
    report = aerial.report.as_json()
    assert report["ideal"]["recall_at_1"] > 0.99 > report["recall_at_1"]
    assert report["ideal_leave_out"]["recall_at_1"] < 0.1
    assert report["published"] == PUBLISHED["aerial"]._asdict()


def test_chunks_of_other_lengths_are_maps_of_their_own(aerial: Comparison) -> None:
    rows = aerial.report.facts["chunk_lengths"]
    assert [row["window"] for row in rows] == [512, 1024]  # 2048 is longer than the route
    assert (rows[1]["auc"], rows[1]["map_bytes"]) == (
        aerial.report.as_json()["auc"],
        aerial.report.facts["map_bytes"],
    )
    periods = SpectrogramAnalysis(512, min_period=8, peaks="bins", false_alarm=None, short="refuse")
    other = DejaVu(periods=periods, reduction="sum").learn_features(aerial.stored)
    scores = evaluate(other.localize(aerial.seen), aerial.truth, 5)
    assert (rows[0]["auc"], rows[0]["recall_at_1"]) == (scores.auc, scores.recall_at_1)
    assert rows[0]["bytes_per_place"] == rows[0]["map_bytes"] / FRAMES
    other.matcher.reduction = "mean"
    again = evaluate(other.localize(aerial.seen), aerial.truth, 5)
    assert rows[0]["recall_at_1_comparable"] == again.recall_at_1


def test_section_five_sets_the_papers_numbers_beside_ours(aerial: Comparison) -> None:
    head, paper, ideal, leave_out, own, *others = section_five({"aerial": aerial.report})
    assert paper[1:4] == ["0.2064", "0.9590", "0.9813"]
    assert "paper" in paper[0]
    report = aerial.report.as_json()
    for row, entry in ((ideal, report["ideal"]), (leave_out, report["ideal_leave_out"]), (own, report)):
        keys = (
            "recall_at_100_precision_reported",
            "precision_at_100_recall",
            "auc_reported",
            "auc",
            "recall_at_1",
        )
        assert row[1:6] == [f"{entry[key]:.4f}" for key in keys]
    assert own[0] == "aerial: a second traverse"
    assert len(others) == 5
    assert {len(row) for row in (head, paper, ideal, own, *others)} == {len(head)}


def test_every_picture_of_the_paper_is_there(aerial: Comparison) -> None:
    assert {"frames", "autocorrelogram", "layers", "pr", "auc", "coverage", "chunks"} < set(aerial.pictures)
    assert {"spectrogram", "templates", "features", "activations"} < set(aerial.pictures)


def test_each_dataset_tells_what_its_map_holds(aerial: Comparison) -> None:
    facts = aerial.report.facts
    (line,) = route_lines({"aerial": aerial.report})
    assert "way" not in line
    assert f"{len(facts['periods'])} periods from {facts['periods'][0]} to {facts['periods'][-1]}" in line
    nothing = aerial.report._replace(facts={**facts, "periods": [], "chunks": []})
    assert "no periods in 0 chunks" in route_lines({"aerial": nothing})[0]


def test_a_number_the_paper_does_not_tell_is_left_empty(aerial: Comparison) -> None:
    report = aerial.report._replace(
        facts={**aerial.report.facts, "published": Published(0.0032, None, 0.6998)._asdict()}
    )
    assert section_five({"x": report})[1][1:4] == ["0.0032", "", "0.6998"]


def test_other_datasets_are_refused() -> None:
    with refused("'moon'", "expected aerial, outdoor, underground"):
        reproduce("moon")


def test_the_command_writes_an_index_over_the_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(commands, "reproduce", partial(reproduce, frames=FRAMES, lengths=(1024,)))
    main(["reproduce", "aerial", "--out", str(tmp_path / "out")])
    assert "aerial: the paper, its own footage" in capsys.readouterr().out
    page = (tmp_path / "out" / "index.html").read_text()
    links = re.findall(r'href="([^"]+)"', page)
    assert links == ["aerial/index.html"]
    assert (tmp_path / "out" / links[0]).exists()
    assert "<pre>dejavu reproduce aerial --out" in page
    assert "0.9813" in page
    assert f"aerial: {FRAMES} places, {FRAMES} queries; " in page
    report = json.loads((tmp_path / "out" / "aerial" / "report.json").read_text())
    assert {"ideal", "ideal_leave_out", "chunk_lengths", "published", "auc", "null"} <= set(report)


@pytest.fixture(scope="module")
def outdoor() -> Comparison:
    """The first 420 frames, from the start of the train on, in chunks of 64."""
    paper = paper_model(open_source("sim:outdoor?frames=1"))
    paper.periods = SpectrogramAnalysis(64, min_period=8, peaks="bins", false_alarm=None, short="refuse")
    return reproduce("outdoor", paper, frames=420, lengths=(32, 64))


def test_train_footage_is_spaced_evenly(outdoor: Comparison) -> None:
    facts, shown = outdoor.report.facts, outdoor.shown
    assert facts["unit"] == "evenly spaced places"
    assert facts["spacing"]["reference_frames"] == facts["spacing"]["query_frames"] == 420
    assert facts["frames"] == len(outdoor.stored) == len(outdoor.model.map.frame)
    assert shown is not None
    assert shown.place is not None
    came = open_source("sim:outdoor?frames=420").distance

    def bend(metres: torch.Tensor) -> float:
        return float((metres - torch.linspace(0, 1, len(metres)) * metres[-1]).abs().max())

    assert bend(came) > 15  # the train speeds up all the way
    assert bend(came[shown.place]) < 2.5


def test_the_way_that_was_measured_is_told(outdoor: Comparison) -> None:
    way = outdoor.report.facts["way_measured"]
    assert list(way.values()) == pytest.approx([1, 1], abs=0.05)
    (line,) = route_lines({"outdoor": outdoor.report})
    assert line.endswith(
        f"; the way measured is {way['reference']:.3f} and {way['query']:.3f} of the true one"
    )


def test_the_truth_of_even_steps_is_where_the_train_was(outdoor: Comparison) -> None:
    assert outdoor.truth is not None
    assert outdoor.shown is not None
    assert outdoor.shown.place is not None
    reference, query = (open_source(f"sim:outdoor?frames=420&traverse={k}") for k in (0, 1))
    right = outdoor.truth.positives[:, 0]
    known = right >= 0
    assert known.float().mean() > 0.7
    apart = reference.distance[outdoor.shown.place[right[known]]] - query.distance[outdoor.shown.query[known]]
    assert apart.abs().max() < 0.8  # metres; a step is about 0.4


def test_structures_cut_the_even_steps(outdoor: Comparison) -> None:
    cuts = structure_cuts(open_source("sim:outdoor?frames=420"))
    assert cuts
    told = outdoor.report.facts["boundaries"]
    places = places_of_frames(torch.tensor(cuts), outdoor.shown).unique()
    assert (told["cuts"], structure_places(outdoor, cuts)) == (len(places), places.tolist())
    metres = open_source("sim:outdoor?frames=420").distance
    assert (metres[outdoor.model.map.frame[places]] - metres[cuts]).abs().max() < 0.8
    for name in ("comparable", "known_boundaries"):
        assert told[name]["queries_near"] + told[name]["queries_far"] == outdoor.report.facts["with_answer"]
    assert outdoor.report.as_json()["known_boundaries"]["bytes"] > 0
    assert {"velocity", "frames", "layers", "autocorrelogram"} < set(outdoor.pictures)


def test_comparable_scores_are_means_on_the_same_map(outdoor: Comparison) -> None:
    model = DejaVu(reduction="mean")
    model.map = outdoor.model.map
    comparable = evaluate(model.localize(outdoor.seen), outdoor.truth, 5)
    assert outdoor.report.contenders["comparable"].scores == comparable
    assert outdoor.report.ours.scores != comparable


def test_other_lengths_store_the_frames_of_the_places_too(outdoor: Comparison) -> None:
    row = outdoor.report.facts["chunk_lengths"][1]
    assert (row["window"], row["map_bytes"]) == (64, outdoor.report.facts["map_bytes"])


class Rails(ArrayTraverse):
    """A traverse that tells where structures start and stop, at half a metre a frame."""

    structures = (("lamps", 5.0, 0.0, 20.0), ("panels", 3.0, 12.2, 900.0))
    distance = torch.arange(64, dtype=torch.float64) / 2


def test_cuts_are_the_frames_at_which_a_structure_starts_or_stops() -> None:
    assert structure_cuts(Rails(torch.rand(64, 3))) == [25, 40]  # 0 and 900 m are no cuts inside
    assert structure_cuts(ArrayTraverse(torch.rand(64, 3))) == []


def test_the_effect_of_boundaries_is_told(aerial: Comparison) -> None:
    assert boundary_lines({"aerial": aerial.report}) == []
    told = {"cuts": 7, "known_boundaries": BoundaryEffect(32, 10, 20, 0.25, None)._asdict()}
    others = {"comparable": aerial.report.contenders["null"], "known_boundaries": aerial.report.ours}
    report = Report(aerial.report.ours, others, {**aerial.report.facts, "boundaries": told})
    (line,) = boundary_lines({"underground": report})
    printed, shuffled = (c.scores.recall_at_1 for c in (report.ours, others["comparable"]) if c.scores)
    assert line.startswith("underground: 7 times something that repeats starts or stops.")
    assert f"{printed:.4f} as printed, {shuffled:.4f} with" in line
    assert "0.2500 within 32 places of such an end (10 queries), unknown elsewhere (20)" in line
