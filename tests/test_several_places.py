"""Several places for each query: in Python, in matches.csv and in the reports."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from command_line import frames, report_of, rows_of, run
from footage import QUERY, REFERENCE, camera, everything, footage
from helpers import Fixed, refused, template_model

from dejavu_torch import FrequencyLayer
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.matches import read_matches, write_matches
from dejavu_torch.motion.resampling import ResampledTraverse

# in Python


def waves():
    return torch.rand(90, 6, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def model():
    """A map whose last 10 places nothing covers, and of places that are alike."""
    model = template_model(periods=Fixed(FrequencyLayer(20, 20, 0, 80, (0, 1, 2, 3))))
    return model.learn(waves())


def test_the_first_candidate_is_what_localize_finds(monkeypatch, model):
    queries = torch.rand(40, 6, generator=torch.Generator().manual_seed(1))
    index, score, _ = model.candidates(queries, 5, apart=3)
    monkeypatch.setattr("dejavu_torch.recognition.scorer.Scorer.at_once", 200)
    match = model.localize(queries)
    found = model.candidates(ArrayTraverse(queries), 5, apart=3)
    assert torch.equal(found.index, index)
    assert torch.equal(found.score, score)
    assert torch.equal(index[:, 0], match.index)
    assert torch.equal(score[:, 0], match.score)
    assert torch.equal(model(queries).gather(1, index), score)
    with refused("91 candidates", "90 places"):
        model.candidates(waves(), 91)


# in matches.csv


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """A calibrated map, whose queries are another flight."""
    path = tmp_path_factory.mktemp("flights") / "map.safetensors"
    run("learn", "sim:aerial?frames=96", "--map", path)
    return path


AGAIN = "sim:aerial?frames=96&traverse=1"


@pytest.mark.parametrize("words", [("--precision", ".3"), (), ("--filter", "--precision", ".01")])
def test_the_first_of_several_places_has_the_probability(flights, tmp_path, words):
    best, top = tmp_path / "best.csv", tmp_path / "top.csv"
    run("localize", flights, AGAIN, *words, "--out", best)
    run("localize", flights, AGAIN, *words, "--top", "4", "--out", top)
    alone, rows = rows_of(best), rows_of(top)
    columns = ["query", "place", "score", "accepted", "probability", "confidence", "stale"]
    columns += ["speed"] * ("--filter" not in words)  # of whole drives
    assert list(rows[0]) == [*columns, "rank", "query_name", "place_name"]
    assert [int(row["rank"]) for row in rows] == [1, 2, 3, 4] * 96
    assert [{**row, "rank": "1"} for row in alone] == rows[::4]
    others = [row for row in rows if row["rank"] != "1"]
    assert len(others) == 3 * 96
    assert {(row["probability"], row["accepted"]) for row in others} == {("", "0")}
    reports = []
    for path in (best, top):
        run("evaluate", path, "--truth", "0", "--out", tmp_path / "scores")
        reports.append(report_of(tmp_path / "scores"))
    assert reports[0]["rejection"] == reports[1]["rejection"]
    assert reports[0]["accepted"] == reports[1]["accepted"] == sum(row["accepted"] == "1" for row in alone)


def test_compare_and_evaluate_agree(tmp_path):
    pair, route = (tmp_path / "first.npy", tmp_path / "second.npy"), tmp_path / "map.safetensors"
    for seed, path in enumerate(pair, 1):
        np.save(path, frames(96, seed))
    run("learn", pair[0], "--map", route)
    options = "--truth", "0", "--tolerance", "1", "--map", route
    run("compare", *pair, *options, "--top", "12", "--out", tmp_path / "c")
    rows = rows_of(tmp_path / "c" / "matches.csv")
    assert len(rows) == 96 * 12
    places = torch.tensor([int(row["place"]) for row in rows]).view(96, 12)
    near = (places[:, :, None] - places[:, None]).abs() <= 1
    assert not (near & (places >= 0)[:, None]).sum(2).gt(1).any()
    run("evaluate", tmp_path / "c" / "matches.csv", *options, "--out", tmp_path / "e")
    right = (places - torch.arange(96)[:, None]).abs() <= 1
    for first in (1, 5, 10):
        expected = right[:, :first].any(1).double().mean().item()
        for folder in ("c", "e"):
            assert report_of(tmp_path / folder)[f"recall_at_{first}"] == pytest.approx(expected)
    assert report_of(tmp_path / "c")["recall_at_1"] < report_of(tmp_path / "c")["recall_at_10"]


def test_convention_11_candidates_are_even_steps_apart_and_written_as_frames(tmp_path):
    model = template_model(periods=everything(101), velocity=camera()).learn(footage(REFERENCE))
    query = ArrayTraverse(footage(QUERY, noise=0.02))
    steps = model.resample(query, model.step)
    assert isinstance(steps, ResampledTraverse)
    candidates = model.candidates(query, 5, apart=6)
    assert torch.equal(candidates.index[:, 0], model.localize(query).index)
    assert (candidates.index[:, :, None] - candidates.index[:, None]).abs().add(99 * torch.eye(5)).min() > 6
    path = tmp_path / "m.csv"
    write_matches(path, [candidates.map(torch.Tensor.flatten)], steps.frame, model.map.table, ranks=5)
    read = read_matches(path)
    assert torch.equal(read.query, steps.frame)
    assert torch.equal(read.candidates, model.map.frame_of(candidates.index))
