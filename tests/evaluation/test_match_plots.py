"""Pictures of queries and the places reported for them, read back from the figures."""

from __future__ import annotations

import numpy as np
import torch
from drawn import matched, run_of, texts
from matplotlib.colors import to_hex
from torch import nn

from dejavu_torch import DejaVu, PlaceFilter
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.match_plots import (
    draw_coverage,
    draw_examples,
    draw_posterior,
    draw_scores,
    example_queries,
)
from dejavu_torch.types import Match


def dots(axis):
    """The points of each group of a coverage plot by its label."""
    return {
        line.get_label(): list(zip(*(map(float, part) for part in line.get_data()), strict=True))
        for line in axis.lines  # type: ignore[attr-defined]
    }


def image(axis):
    """What an axis shows, a row a query."""
    return torch.as_tensor(axis.images[0].get_array().filled(torch.nan)).T  # type: ignore[attr-defined]


def test_examples_are_the_surest_right_the_surest_wrong_and_one_at_the_border():
    score = torch.tensor([0.3, 0.2, 0.1, 0.25, 0.9, torch.inf])
    match = Match(torch.tensor([0, 9, 7, 3, 4, -1]), score, score < 10)
    truth = torch.arange(6)[:, None]
    known = torch.tensor([True, True, False, True, True, True])  # query 2, the surest, is not judged
    judged = GroundTruth(truth, known, truth[:, :0])
    answers = {3: "surest right answer", 1: "surest wrong answer", 4: "least sure answer"}
    assert example_queries(match, judged, 0) == answers
    strict = Match(match.index, score, score < 0.25)
    assert example_queries(strict, judged, 0) == {
        3: "surest right answer, surest not accepted",
        1: answers[1],
    }
    assert example_queries(match, None, 0) == {2: "surest answer", 4: answers[4]}


def test_scores_are_scaled_and_the_best_of_each_block_is_shown():
    scores = torch.rand(30, 50)
    least, median = scores.amin(1, keepdim=True), scores.median(1, keepdim=True).values
    scaled = ((scores - least) / (median - least)).clamp(max=1)
    picture = draw_scores(run_of(scores), cells=20)["scores"]
    for column, block in enumerate(scaled[::2].split(3, 1)):
        assert torch.allclose(image(picture.plot[1])[:, column], block.amin(1))
    assert picture.caption.endswith("Shown: 15 of 30 queries; the best of every 3 neighbouring places.")


def test_convention_11_places_and_queries_are_drawn_at_their_frames():
    """Of ten places, the camera stands at the fourth from frame 6 to 29; the query moves twice as fast."""
    borders = torch.tensor([0, 2, 4, 6, 30, 31, 32, 33, 34, 35, 40])
    queries, match = torch.tensor([0, 4, 8, 12]), matched(0, 3, -1, 9)
    truth = as_ground_truth(torch.tensor([[0, -1], [4, -1], [2, -1], [9, 5]]))
    figure, axis = draw_coverage(match, truth, 1, borders, queries, "places")["coverage"].plot
    assert dots(axis) == {"3 right, accepted": [(0, 0), (4, 6), (12, 35)], "1 not reported": [(8, 0)]}
    assert (axis.get_xlim(), axis.get_ylim()[1]) == ((0, 12), 40)
    labels = {"query (frame)", "reported place (frame)", "right within 1 places"}
    assert labels <= set(texts(figure))
    run = run_of(torch.rand(4, 10), borders=borders, query_frames=queries, match=match, truth=truth)
    for cells, shape in ((20, (10, 4)), (4, (4, 4))):
        figure, axis = draw_scores(run, cells)["scores"].plot
        assert axis.images[0].get_array().shape[:2] == shape
        assert (axis.get_xlim(), axis.get_ylim()) == ((-0.5, 12.5), (-0.5, 39.5))
        reported, first, second, _ = axis.lines
        assert list(zip(*reported.get_data(), strict=True)) == [(0, 0), (4, 6), (12, 35)]
        assert first.get_xdata().tolist() == [0, 4, 8, 12]
        assert first.get_ydata().tolist() == [0, 30, 4, 35]
        assert second.get_ydata()[3] == 31
        assert {"query (frame)", "place (frame)", "reported place", "right place"} <= set(texts(figure))
    run.truth = None
    assert "right place" not in texts(draw_scores(run)["scores"].plot[0])


def test_a_posterior_is_pooled_as_it_comes_and_shows_some_right_places(monkeypatch, largest_tensor):
    monkeypatch.setattr("dejavu_torch.evaluation.match_plots.BLOCK_SCORES", 450)
    scores, model = torch.rand(130, 75), PlaceFilter()
    with torch.no_grad():
        posterior = model.posterior(scores)
    right = torch.arange(130).masked_fill(torch.arange(130) >= 70, -1)
    borders, queries = torch.arange(0, 152, 2), torch.arange(0, 390, 3)  # convention 11
    parts = {"borders": borders, "query_frames": queries, "truth": as_ground_truth(right[:, None])}
    run = run_of(scores, sequence=model, **parts)
    with largest_tensor() as seen:
        picture = draw_posterior(run, cells=40)["posterior"]
    assert seen.numel <= 38 * 33  # queries by places of the image
    assert "the highest probability among 4 queries and 2 places" in picture.caption
    figure, (axis, below) = picture.plot
    for row, some in zip(image(axis), posterior[:, :-1].split(4), strict=True):
        for value, places in zip(row, some.split(2, 1), strict=True):
            assert value == places.max().clamp(min=1e-6)
    assert (axis.get_xlim(), axis.get_ylim()) == ((-0.5, 387.5), (-0.5, 149.5))
    (marks,) = axis.lines
    assert marks.get_xdata().tolist() == [3 * query for query in range(0, 130, 6)]
    assert marks.get_ydata()[:12].tolist() == [2 * query for query in range(0, 70, 6)]
    assert marks.get_markerfacecolor() == "none"  # what is below is seen
    assert np.array_equal(below.lines[0].get_data(), [queries, posterior[:, -1]])
    (nowhere,) = below.collections
    assert nowhere.get_datalim(below.transData).intervalx.tolist() == [210, 387]
    assert {"query (frame)", "place (frame)", "off the map", "right place"} <= set(texts(figure))
    run.truth = None
    axis, below = draw_posterior(run)["posterior"].plot[1]
    assert not axis.lines
    assert not below.collections


def test_examples_along_a_drive_have_borders_that_tell_what_they_are():
    """Right, wrong, not accepted, and nothing reported."""
    frames = torch.rand(4, 1, 8, 8)
    model = DejaVu(features=nn.Flatten(), whitening="none").learn(frames)
    match = Match(
        torch.tensor([0, 3, 2, -1]),
        torch.tensor([0.1, 0.2, 0.3, torch.inf]),
        torch.tensor([True, True, False, False]),
        torch.tensor([0.9, 0.8, 0.3, 0.0]).double(),
    )
    traverse = ArrayTraverse(frames)
    rows = frames.flatten(1)
    truth = as_ground_truth(torch.arange(4)[:, None])
    run = Localization(model, traverse, traverse, rows, rows, match, truth, 0)
    _, axes = draw_examples(run)["examples"].plot
    colours = [to_hex(axis.spines["left"].get_edgecolor()) for axis in axes[1]]
    assert colours == [plots.RIGHT, plots.WRONG, plots.GREY, plots.GREY]
    assert [axis.get_title(loc="left") for axis in axes[1]] == ["0, 0.90", "3, 0.80", "2, 0.30", "none"]
    untold = draw_examples(run._replace(truth=None))["examples"].plot[1]
    assert to_hex(untold[1][1].spines["left"].get_edgecolor()) == COLOURS["map"]
    one = run._replace(match=match[:1], query_features=rows[:1], query=ArrayTraverse(frames[:1]), truth=None)
    assert draw_examples(one)["examples"].heading.startswith("1 evenly spaced query")
    unjudged = truth._replace(judged=torch.zeros(4, dtype=torch.bool))
    shown = draw_examples(run._replace(truth=unjudged))["examples"].plot[1]
    assert to_hex(shown[1][0].spines["left"].get_edgecolor()) == COLOURS["map"]
