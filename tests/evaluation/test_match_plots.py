"""Pictures of queries and the places reported for them, read back from the figures."""

from __future__ import annotations

import pytest
import torch
from drawn import matched, render, texts

from dejavu_torch import PlaceFilter, SequenceMatcher
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.evaluation.match_plots import (
    PosteriorImage,
    Row,
    diagonal,
    draw_coverage,
    example_matches,
    plot_posterior,
    plot_rows,
    plot_score_matrix,
    posterior_image,
    score_matrix,
)
from dejavu_torch.types import Match


def dots(axis: object) -> dict[str, list[tuple[float, float]]]:
    """The points of each group of a coverage plot by its label."""
    return {
        line.get_label(): list(zip(*(map(float, part) for part in line.get_data()), strict=True))
        for line in axis.lines  # type: ignore[attr-defined]
    }


def test_without_a_truth_coverage_shows_the_probabilities() -> None:
    sure = torch.tensor([0.9, 0.2, 0.0, 0.6], dtype=torch.float64)
    match = matched(4, 9, -1, 2)._replace(probability=sure)
    figure, axis = draw_coverage(match, None, 1, torch.arange(11), torch.arange(4), "frames")["coverage"].plot
    (points,) = axis.collections
    shown = dict(zip(points.get_array().tolist(), map(tuple, points.get_offsets().tolist()), strict=True))
    assert shown == {0.2: (1, 9), 0.6: (3, 2), 0.9: (0, 4)}
    assert points.get_clim() == (0, 1)
    assert dots(axis) == {"1 not reported": [(2, 0)]}
    assert "probability of being right" in texts(figure)
    render(figure)


def test_coverage_leaves_grey_what_is_not_scored() -> None:
    right, known = torch.arange(5)[:, None], torch.tensor([True, False, True, False, True])
    truth = GroundTruth(right, known, torch.tensor([[-1], [-1], [7], [-1], [-1]]))
    figure, axis = draw_coverage(
        matched(0, 1, 7, -1, 9), truth, 0, torch.arange(11), torch.tensor([10, 20, 30, 40, 50]), "frames"
    )["coverage"].plot
    assert dots(axis) == {
        "3 not scored": [(20, 1), (30, 7)],
        "1 wrong": [(50, 9)],
        "1 right": [(10, 0)],
    }
    assert axis.get_xlim() == (10, 50)
    assert {"3 not scored", "right within 0 frames"} <= set(texts(figure))


def found(index: list[int], score: list[float], below: float = 10.0) -> Match:
    scores = torch.tensor(score)
    return Match(torch.tensor(index), scores, scores < below)


def test_examples_are_the_surest_right_the_surest_wrong_and_the_least_sure() -> None:
    match = found([0, 9, 7, 3, 4, -1], [0.3, 0.2, 0.1, 0.25, 0.9, torch.inf])
    truth = torch.arange(6)[:, None]
    known = torch.tensor([True, True, False, True, True, True])  # query 2, the surest, is not judged
    examples = example_matches(match, GroundTruth(truth, known, truth[:, :0]), tolerance=0)
    assert [(one.query, one.place, one.right) for one in examples] == [(3, 3, 3), (1, 9, 1), (4, 4, 4)]
    assert [one.why.split(",")[0] for one in examples] == [
        "surest right answer",
        "surest wrong answer",
        "least sure answer",
    ]
    assert "score 0.25" in examples[0].why


def test_where_a_threshold_rejects_some_the_best_of_them_is_shown() -> None:
    match = found([0, 1, 2, 3], [0.1, 0.4, 0.3, 0.2], below=0.25)
    last = example_matches(match, None, 0)[-1]
    assert (last.query, last.right) == (2, -1)
    assert "surest not accepted" in last.why


def test_rows_show_frames_side_by_side_under_their_titles() -> None:
    frames = [torch.rand(3, 8, 12), torch.rand(1, 16, 16), torch.rand(1, 16, 16)]
    titles = ["query:\nframe 0", "reported:\nframe 9 of_a_long_name_0009.png", "right:\nframe 1"]
    missing = [*titles[:2], "right:\nnone is known"]
    figure, axes = plot_rows([Row("surest answer", titles, frames), Row("other", missing, frames[:2])])
    assert {"surest answer", "other", "query:\nframe 0", "right:\nnone is known"} <= {
        text.strip() for text in texts(figure)
    }
    for axis, frame in zip(axes[0], frames, strict=True):
        assert torch.equal(
            torch.as_tensor(axis.images[0].get_array()), frame.expand(3, -1, -1).permute(1, 2, 0)
        )
    assert not axes[1, 2].images
    assert len({axis.get_title(loc="left").count("\n") for axis in axes[0]}) == 1
    assert "".join(axes[0, 1].get_title(loc="left").split()) == "".join(titles[1].split())  # wrapped


def test_the_score_matrix_holds_block_minima_of_scaled_scores() -> None:
    scores = torch.rand(30, 50)
    matrix = score_matrix(lambda rows: scores[rows[:, 0].long()], torch.arange(30.0)[:, None], cells=20)
    assert matrix is not None
    assert matrix.query.tolist() == list(range(0, 30, 2))
    assert (matrix.block, matrix.values.shape) == (3, (15, 17))
    least, median = scores.amin(1, keepdim=True), scores.median(1, keepdim=True).values
    scaled = ((scores - least) / (median - least)).clamp(max=1)[::2]
    for column, block in enumerate(scaled.split(3, 1)):
        assert torch.allclose(matrix.values[:, column], block.amin(1))


def test_few_queries_are_scored_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def scores(rows: torch.Tensor) -> torch.Tensor:
        asked.append(len(rows))
        return torch.rand(len(rows), 100)

    monkeypatch.setattr("dejavu_torch.evaluation.match_plots.SCORES_AT_ONCE", 1000)
    score_matrix(scores, torch.rand(35, 4))
    assert sum(asked) == 35
    assert max(asked) == 10


def test_convention_11_places_and_queries_are_drawn_at_their_frames() -> None:
    """Of ten places, the camera stands at the fourth from frame 6 to 29; the query moves twice as fast."""
    borders = torch.tensor([0, 2, 4, 6, 30, 31, 32, 33, 34, 35, 40])
    queries, match = torch.tensor([0, 4, 8, 12]), matched(0, 3, -1, 9)
    truth = as_ground_truth(torch.tensor([[0, -1], [4, -1], [2, -1], [9, 5]]))
    figure, axis = draw_coverage(match, truth, 1, borders, queries, "places")["coverage"].plot
    assert dots(axis) == {"3 right": [(0, 0), (4, 6), (12, 35)], "1 not reported": [(8, 0)]}
    assert (axis.get_xlim(), axis.get_ylim()[1]) == ((0, 12), 40)
    labels = {"query (frame)", "reported place (frame)", "right within 1 places"}
    assert labels <= set(texts(figure))
    scores = torch.rand(4, 10)
    for cells, shape in ((20, (10, 4)), (4, (4, 4))):
        matrix = score_matrix(lambda rows: scores[: len(rows)], torch.rand(4, 2), cells)
        assert matrix is not None
        figure, axis = plot_score_matrix(matrix, match, truth, borders, queries)
        assert axis.images[0].get_array().shape[:2] == shape
        assert (axis.get_xlim(), axis.get_ylim()) == ((-0.5, 12.5), (-0.5, 39.5))
        reported, first, second, _ = axis.lines
        assert list(zip(*reported.get_data(), strict=True)) == [(0, 0), (4, 6), (12, 35)]
        assert first.get_xdata().tolist() == [0, 4, 8, 12]
        assert first.get_ydata().tolist() == [0, 30, 4, 35]
        assert second.get_ydata()[3] == 31
        assert {"query (frame)", "place (frame)", "reported place", "right place"} <= set(texts(figure))
        assert "right place" not in texts(plot_score_matrix(matrix, match, None, borders, queries)[0])


def test_the_cells_that_a_sequence_adds_up_are_drawn_on_the_scores_around_them() -> None:
    scores, place = torch.rand(60, 50), 30
    for k in range(5):  # the query is 2 places further on with each
        scores[40 - k, place - 2 * k] = -1.0
    matcher = SequenceMatcher(5, speeds=(1, 2))
    example = diagonal(
        lambda rows: scores[rows[:, 0].long()], torch.arange(60.0)[:, None], matcher, 40, place
    )
    assert example.query.tolist() == [40, 39, 38, 37, 36]
    assert example.place.tolist() == [30, 28, 26, 24, 22]
    (top, left), (height, width) = example.first, example.values.shape
    assert (top, left, height, width) == (31, 17, 15, 19)
    least, median = scores.amin(1, keepdim=True), scores.median(1, keepdim=True).values
    scaled = ((scores - least) / (median - least)).clamp(max=1)
    assert torch.allclose(example.values, scaled[31:46, 17:36])

    matrix = score_matrix(lambda rows: scores[: len(rows)], torch.rand(60, 2))
    assert matrix is not None
    borders, queries = torch.arange(0, 102, 2), torch.arange(0, 180, 3)  # convention 11
    figure, (above, below) = plot_score_matrix(
        matrix, matched(*[place] * 60), None, borders, queries, example
    )
    (line,) = [line for line in below.lines if line.get_label() == "added up"]
    assert list(zip(*line.get_data(), strict=True)) == [
        (3 * query, 2 * place) for query, place in zip(example.query, example.place, strict=True)
    ]
    assert below.images[0].get_array().shape == (19, 15)
    assert (below.get_xlim(), below.get_ylim()) == ((92.5, 137.5), (33.5, 71.5))
    (frame,) = above.patches
    assert (frame.get_xy(), frame.get_width(), frame.get_height()) == ((93, 34), 45, 38)
    assert {"added up", "reported place", "query (frame)"} <= set(texts(figure))


def test_what_a_sequence_adds_up_may_reach_off_the_map_and_before_the_first_query() -> None:
    scores = torch.rand(4, 12)
    scores[:, 9:] = torch.inf  # nothing covers the last places
    matcher = SequenceMatcher(6, speeds=(1, -1))
    example = diagonal(lambda rows: scores[rows[:, 0].long()], torch.arange(4.0)[:, None], matcher, 2, 1)
    assert example.first == (0, 0)
    assert example.values.shape == (4, 12)
    assert example.values[:, 9:].isnan().all()
    mean = scores[example.query, example.place].mean()
    assert torch.isclose(mean, matcher(scores[:3])[-1, 1])


def test_a_posterior_is_pooled_as_it_comes(monkeypatch: pytest.MonkeyPatch, largest_tensor: type) -> None:
    scores, model = torch.rand(130, 75), PlaceFilter()
    with torch.no_grad():
        posterior = model.posterior(scores)
    monkeypatch.setattr("dejavu_torch.evaluation.match_plots.SCORES_AT_ONCE", 450)
    features = torch.arange(130.0)[:, None]
    with largest_tensor() as seen:
        image = posterior_image(lambda rows: scores[rows[:, 0].long()], features, model, cells=40)
    assert seen.numel <= 38 * 33  # queries by places of the image
    assert image.blocks == (4, 2)
    for row, queries in zip(image.values, posterior[:, :-1].split(4), strict=True):
        for value, places in zip(row, queries.split(2, 1), strict=True):
            assert value == places.max()
    assert torch.equal(image.off, posterior[:, -1])


def test_a_posterior_is_drawn_with_some_right_places_and_where_there_is_none() -> None:
    values = torch.tensor([[1.0, 0.0], [0.5, 0.25], [1e-9, 1e-3]])
    off = torch.tensor([0.0, 0.1, 0.25, 0.9, 0.9, 1.0])
    image = PosteriorImage(values, off, (2, 3))
    truth = as_ground_truth(torch.tensor([[0, -1], [2, 4], [3, -1], [4, -1], [-1, -1], [-1, -1]]))
    borders, queries = torch.arange(0, 12, 2), torch.arange(0, 18, 3)  # convention 11
    figure, (axis, below) = plot_posterior(image, truth, borders, queries)
    assert torch.equal(torch.as_tensor(axis.images[0].get_array()), values.T.clamp(min=1e-6))
    assert (axis.get_xlim(), axis.get_ylim()) == ((-0.5, 15.5), (-0.5, 9.5))
    marked = [(x, y) for line in axis.lines for x, y in zip(*line.get_data(), strict=True) if float(y) == y]
    assert marked == [(0, 0), (3, 4), (6, 6), (9, 8), (3, 8)]
    assert all(line.get_markerfacecolor() == "none" for line in axis.lines)  # what is below is seen
    (curve,) = below.lines
    assert curve.get_xdata().tolist() == queries.tolist()
    assert curve.get_ydata().tolist() == off.tolist()
    (nowhere,) = below.collections
    assert nowhere.get_datalim(below.transData).intervalx.tolist() == [12, 15]
    assert {"query (frame)", "place (frame)", "off the map", "right place"} <= set(texts(figure))
    plain, (axis, below) = plot_posterior(image, None, borders, queries)
    assert not axis.lines
    assert not below.collections
    render(plain)
