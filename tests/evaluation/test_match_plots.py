"""Pictures of queries and the places reported for them, read back from the figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from drawn import matched, run_of, texts
from matplotlib.colors import to_hex
from torch import nn

from dejavu_torch import DejaVu, PlaceFilter, PlaceSmoother
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization, faults
from dejavu_torch.evaluation.match_plots import (
    draw_coverage,
    draw_examples,
    draw_pairs,
    draw_posterior,
    draw_scores,
    worst_answers,
)
from dejavu_torch.evaluation.pictures import draw_pictures
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


def answered(index, sure):
    """A match with probabilities, a truth in which query i shows place i, and a run of both."""
    index, sure = torch.tensor(index), torch.tensor(sure).double()
    match = Match(index, 1 - sure.float(), sure >= 0.5, sure)
    right = torch.arange(len(index))[:, None]
    return match, GroundTruth(right, torch.ones(len(index)).bool(), right[:, :0])


def run_on_frames(match, truth, **more):
    frames = torch.rand(len(match), 1, 8, 8)
    model = DejaVu(features=nn.Flatten(), whitening="none").learn(frames)
    traverse, rows = ArrayTraverse(frames), frames.flatten(1)
    return Localization(model, traverse, traverse, rows, rows, match, truth, 0, **more)


def spines(row):
    return [to_hex(axis.spines["left"].get_edgecolor()) for axis in row if axis.axison]


def worst(match, truth, apart=0):
    return worst_answers(match, *faults(match, truth, 0), apart)


def test_the_worst_answers_are_the_surest_wrong_ones_and_then_the_least_sure():
    index = [9, 1, 0, 3, 4, 5, 0, 7, -1]  # query 0, 2 and 6 are wrong, 8 has no answer
    match, truth = answered(index, [0.2, 0.6, 0.8, 0.3, 0.4, 0.9, 0.7, 0.5, 0.0])
    assert worst(match, truth) == [2, 6, 0, 3, 4, 7]
    unknown = truth._replace(judged=torch.arange(9) != 2)
    assert worst(match, unknown) == [6, 0, 3, 4, 7, 1]
    assert worst(match, None) == [0, 3, 4, 7, 1, 6]
    plain = replace(match, probability=None)
    assert worst(plain, truth) == [2, 6, 0, 3, 4, 7]  # by rising score, then by falling
    assert worst(replace(plain, confidence=match.score), truth)[:3] == [0, 6, 2]
    assert worst(match[8:], None) == []


def test_neighbours_of_a_mistake_are_shown_only_where_there_are_no_others():
    match, truth = answered([99] * 10 + [*range(10, 70)], [*torch.linspace(0.9, 0.5, 70).tolist()])
    assert worst(match, truth, 5) == [0, 6, 69, 63, 57, 51]
    few = GroundTruth(*(part[:14] for part in truth))
    assert worst(match[:14], few, 5) == [0, 1, 2, 3, 6, 13]


def test_pairs_have_red_frames_where_one_image_is_wrong():
    match, truth = answered([0, 5, 0, 3, 4, 5, 6], [0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3])
    run = run_on_frames(match, truth)
    picture = draw_pairs(run)["pairs"]
    figure, axes = picture.plot
    assert [spines(row) for row in axes] == [[plots.WRONG] * 2] * 2 + [[plots.RIGHT] * 2] * 4
    titles = [axis.get_title(loc="left") for axis in axes[0]]
    assert titles == ["query 1", "reported 5", "right 1"]
    assert "wrong, probability 0.80" in texts(figure)
    assert "Of 7 answers by one image 2 are wrong, 2 of them accepted." in picture.caption
    assert "green: the least sure" in picture.caption
    untold = draw_pairs(run._replace(truth=None))["pairs"]
    assert [spines(row) for row in untold.plot[1]] == [[plots.GREY] * 2] * 6
    assert untold.plot[1][0][1].get_title(loc="left") == "reported 6"
    nowhere = truth._replace(positives=truth.positives.clone().index_fill_(0, torch.tensor(1), -1))
    shown = draw_pairs(run._replace(truth=nowhere))["pairs"].plot[1][0]
    assert shown[2].get_title(loc="left") == "right: none"


def test_where_a_drive_answers_its_wrong_single_images_are_shown():
    single, truth = answered([0, 5, 2, 3, 0, 5], [0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    drive = replace(single, index=torch.arange(6), smoother=PlaceSmoother())
    run = run_on_frames(drive, truth, judged=single)
    picture = draw_pairs(run)["pairs"]
    assert [spines(row)[0] for row in picture.plot[1]] == [plots.WRONG] * 2 + [plots.RIGHT] * 4
    assert "Of 6 answers by one image 2 are wrong. Red" in picture.caption
    (crosses,) = crosses_of(run)
    assert list(zip(*crosses.get_data(), strict=True)) == [(1, 5), (4, 0)]
    assert crosses.get_label() == "2 wrong by one image"
    assert to_hex(crosses.get_color()) == plots.WRONG
    assert not crosses_of(run._replace(match=replace(drive, smoother=None)))


def drawn_coverage(run):
    return draw_pictures(run, {})["coverage"].plot[1]


def crosses_of(run):
    return [line for line in drawn_coverage(run).lines if line.get_marker() == "x"]


def test_wrong_answers_are_drawn_last_and_larger():
    match, truth = answered([0, 5, 2, 3, 0, 5], [0.9, 0.8, 0.2, 0.6, 0.3, 0.4])
    lines = drawn_coverage(run_on_frames(match, truth)).lines
    assert [line.get_label() for line in lines] == [
        *("2 right, not accepted", "2 right, accepted", "1 wrong, not accepted", "1 wrong, accepted")
    ]
    assert [to_hex(line.get_color()) for line in lines[2:]] == [plots.PALE_WRONG, plots.WRONG]
    assert lines[2].get_markersize() > lines[1].get_markersize()


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
    # queries by places of the image, or moves by states of the filter
    assert seen.numel <= max(38 * 33, 5 * len(model.start(75).belief))
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
