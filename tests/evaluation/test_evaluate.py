"""Matches in a file, evaluated: the same figures as in memory, for every kind of ground truth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from footage import QUERY, REFERENCE, camera, everything, footage
from helpers import Fixed, refused, template_model

from dejavu_torch import FrequencyLayer
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import RECALL_DEFINITION, evaluate
from dejavu_torch.evaluation.evaluate import Asked, evaluate_file
from dejavu_torch.evaluation.matches import write_matches
from dejavu_torch.types import Match

HEADER = "query,place,score,accepted\n"
# right, right but far, wrong, silent, accepted though wrong
MATCHES = HEADER + "0,0,0.1,1\n1,4,0.2,1\n2,50,0.3,0\n3,-1,inf,0\n4,30,0.4,1\n"


def written(folder, text, name="matches.csv"):
    (folder / name).write_text(text)
    return folder / name


def scores_of(result):
    assert result.report.ours.scores is not None
    return result.report.ours.scores._asdict()


def found(path):
    """What a small map makes of noisy queries, some of which nothing covers."""
    features = torch.rand(96, 8)
    model = template_model(periods=Fixed(FrequencyLayer(24, 24, 0, 60, (0, 1, 2, 3))))
    match = model.learn(ArrayTraverse(features)).localize(ArrayTraverse(features + 0.1 * torch.rand(96, 8)))
    silent = torch.arange(96) % 7 == 0
    match = Match(
        torch.where(silent, -1, match.index),
        torch.where(silent, torch.inf, match.score),
        match.accepted & ~silent & (match.score < match.score.median()),
    )
    write_matches(path, [match])
    return match


def test_the_file_gives_the_scores_of_the_matches_in_memory(tmp_path):
    match = found(tmp_path / "m.csv")
    right = torch.arange(96)[:, None]
    result = evaluate_file(tmp_path / "m.csv", "0", tolerance=3)
    assert result.report.ours.scores == evaluate(match, right, 3)
    assert 0 < scores_of(result)["recall_at_1"] < 1
    assert 0 < scores_of(result)["auc"] < 1
    # and so does a table of the same places, and a matrix
    table = written(tmp_path, "".join(f"{i},{i}\n" for i in range(96)), "truth.csv")
    np.savez(tmp_path / "truth.npz", GThard=np.eye(96, dtype=bool))
    for truth in (table, tmp_path / "truth.npz"):
        assert evaluate_file(tmp_path / "m.csv", str(truth), tolerance=3).report.ours.scores == evaluate(
            match, right, 3
        )


def test_facts_by_hand(tmp_path):
    path = written(tmp_path, MATCHES)
    facts = evaluate_file(path, "0", tolerance=3).report.facts
    expected = {"queries": 5, "judged": 5, "unknown": 0, "ignored": 0, "with_answer": 5, "accepted": 3}
    assert {name: facts[name] for name in expected} == expected
    assert (facts["accepted_right"], facts["accepted_precision"]) == (2, pytest.approx(2 / 3))
    assert (facts["tolerance"], facts["recall_definition"]) == (3, RECALL_DEFINITION)
    assert (facts["matches"], facts["truth"]) == (str(path), "place = query")
    assert {"version", "torch"} <= facts.keys()
    # the tolerance is inclusive, and decides over query 1
    assert evaluate_file(path, "0", tolerance=2).report.facts["accepted_right"] == 1
    assert evaluate_file(path, "0", tolerance=0).report.facts["accepted_right"] == 1


def test_queries_the_truth_does_not_know_are_left_out(tmp_path):
    path, truth = written(tmp_path, MATCHES), written(tmp_path, "1,4\n2,2\n9,9\n", "truth.csv")
    result = evaluate_file(path, str(truth), tolerance=0)
    facts = result.report.facts
    expected = {"queries": 5, "judged": 2, "unknown": 3, "accepted": 1, "accepted_right": 1}
    assert {name: facts[name] for name in expected} == expected
    assert scores_of(result)["recall_at_1"] == 0.5
    between = evaluate_file(path, str(truth), tolerance=0, interpolate=True).report.facts
    assert [between[k] for k in ("judged", "unknown")] == [4, 1]


def test_numbered_queries_in_any_order(tmp_path):
    path = written(tmp_path, HEADER + "40,41,0.5,1\n10,11,0.1,1\n20,7,0.9,1\n")
    result = evaluate_file(path, "1", tolerance=0)
    assert result.queries.tolist() == [40, 10, 20]
    assert result.truth.positives[:, 0].tolist() == [41, 11, 21]
    assert scores_of(result)["recall_at_1"] == pytest.approx(2 / 3)
    assert scores_of(result)["recall_at_100_precision"] == pytest.approx(2 / 3)


def test_truth_that_lies_in_the_traverses(tmp_path):
    path = written(tmp_path, MATCHES)
    stored, seen = ArrayTraverse(torch.rand(60, 2)), ArrayTraverse(torch.rand(5, 2))
    with refused("no ground truth"):
        evaluate_file(path, None, asked=Asked(stored, seen))
    stored.places, seen.places = torch.arange(60.0), torch.tensor([0.0, 4.2, 2.0, 3.0, 30.0])
    assert evaluate_file(path, None, 0, Asked(stored, seen)).report.facts["accepted_right"] == 3


def test_recall_values_by_hand(tmp_path):
    rows = [
        (0, (5, 0, 9)),
        (1, (1, 8, 7)),
        (2, (9, 8, 3)),
        (3, (0, 0, 0)),
        (4, (4, 5, 6)),
    ]  # 3: no right answer
    text = "".join(f"{q},{p},0.1,{r}\n" for q, places in rows for r, p in enumerate(places, 1))
    path = written(tmp_path, "query,place,score,rank\n" + text)
    every = written(tmp_path, "[[0, 1], [1], [2], [], [9]]", "truth.json")
    some = written(tmp_path, "0,0,1\n1,1\n2,2\n3\n", "truth.csv")  # nothing on query 4
    for truth, tolerance, expected in (
        (every, 0, {"3": 2 / 5, "1": 1 / 5}),
        (every, 1, {"3": 3 / 5, "1": 1 / 5}),
        (some, 0, {"3": 2 / 4, "1": 1 / 4}),
    ):
        facts = evaluate_file(path, str(truth), tolerance, recall_values=[3, 1]).report.facts
        assert facts["recall_values"] == expected
    assert "recall_values" not in evaluate_file(path, "0").report.facts
    for first, words in ((0, "1 to 3"), (4, "--top 4"), (-1, "1 to 3")):
        with refused(f"first {first} of 3 ranks", words):
            evaluate_file(path, "0", recall_values=[1, first])


def test_what_does_not_fit_is_refused(tmp_path):
    path = written(tmp_path, MATCHES)
    with refused("tolerance is -1"):
        evaluate_file(path, "0", tolerance=-1)
    with refused("'maybe'"):
        evaluate_file(tmp_path / "none.csv", "maybe")  # the text first: it costs nothing
    with refused("no ground truth"):
        evaluate_file(path, None)
    with refused("place 50", "below 20"):
        evaluate_file(path, "0", asked=Asked(ArrayTraverse(torch.rand(20, 2))))
    np.savez(tmp_path / "gt.npz", GThard=np.eye(60, 4, dtype=bool))
    with refused("GThard is (60, 4)", "(reference frames, 5)"):
        evaluate_file(path, str(tmp_path / "gt.npz"))
    only = written(tmp_path, HEADER + "0,7,0.5,1\n", "one.csv")
    soft = np.ones((9, 1), dtype=bool)
    np.savez(tmp_path / "gt.npz", GThard=np.eye(9, 1, dtype=bool), GTsoft=soft)
    with refused("none can be judged"):
        evaluate_file(only, str(tmp_path / "gt.npz"))


# a map of resampled places


@pytest.fixture(scope="module")
def resampled(tmp_path_factory):
    """A map, its matches in a file, and the queries and matches themselves."""
    folder = tmp_path_factory.mktemp("resampled")
    model = template_model(periods=everything(101), velocity=camera()).learn(footage(REFERENCE))
    model.save(folder / "m.safetensors")
    query = model.resample(ArrayTraverse(footage(QUERY, noise=0.02)), model.step)
    match = model.localize(query)
    write_matches(folder / "matches.csv", [match], query.frame, model.map.table)
    nearest = (REFERENCE - QUERY[:, None]).abs().argmin(1).tolist()
    (folder / "truth.csv").write_text("".join(f"{q},{p}\n" for q, p in enumerate(nearest)))
    files = {"map": folder / "m.safetensors", "matches": folder / "matches.csv"}
    return SimpleNamespace(**files, query=query, match=match)


def test_convention_11_the_map_turns_frames_into_places(resampled):
    truth = str(resampled.map.parent / "truth.csv")
    by_places = evaluate_file(resampled.matches, truth, tolerance=1, asked=Asked(map=resampled.map))
    facts = by_places.report.facts
    assert (facts["unit"], facts["places"], facts["judged"]) == ("places at even steps", 101, 101)
    assert (by_places.match.index - resampled.match.index).abs().max() <= 1  # places that show one frame
    assert torch.equal(by_places.queries, resampled.query.frame)
    found = by_places.truth.positives[:, 0] - torch.arange(101)
    assert found.abs().max() <= 1
    assert scores_of(by_places)["recall_at_1"] > 0.9
    with refused("is there twice", "--map MAP of a map at even steps"):
        evaluate_file(resampled.matches, truth, tolerance=1)
    (resampled.map.parent / "beyond.csv").write_text("query,place\n0,99999\n")
    with refused("place 99999", f"0 to {len(REFERENCE) - 1}"):
        evaluate_file(
            resampled.matches, str(resampled.map.parent / "beyond.csv"), asked=Asked(map=resampled.map)
        )


def test_convention_11_all_frames_of_one_place_are_right(resampled, tmp_path):
    """It stands from frame 60 to 85: in places any of these is right, in frames only those near by."""
    path = written(tmp_path, HEADER + "0,85,0.1,1\n")
    truth = str(written(tmp_path, "0,60\n", "truth.csv"))
    assert scores_of(evaluate_file(path, truth, 0, asked=Asked(map=resampled.map)))["recall_at_1"] == 1
    assert scores_of(evaluate_file(path, truth, 24))["recall_at_1"] == 0


def test_similarities_are_noticed_and_read(tmp_path, caplog):
    rows = [(q, q if q % 3 else q + 40, 0.9 - 0.001 * q if q % 3 else 0.3) for q in range(60)]
    path = written(tmp_path, "query,place,score\n" + "".join(f"{q},{p},{s}\n" for q, p, s in rows))
    wrong = evaluate_file(path, "0", 2)
    assert "for similarities: --higher_is_better" in caplog.text
    caplog.clear()
    right = evaluate_file(path, "0", 2, higher_is_better=True)
    assert "similarities" not in caplog.text
    assert scores_of(right)["auc"] > scores_of(wrong)["auc"] + 0.2
    assert scores_of(right)["recall_at_1"] == scores_of(wrong)["recall_at_1"]
    other = written(tmp_path, "query,place,score\n" + "".join(f"{q},{p},{-s}\n" for q, p, s in rows), "b.csv")
    caplog.clear()
    assert scores_of(evaluate_file(other, "0", 2)) == scores_of(right)
    assert "similarities" not in caplog.text
