"""Pictures of queries and the places reported for them, read back from the figures."""

from __future__ import annotations

import pytest
import torch
from drawn import matched, render, texts

from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.evaluation.match_plots import (
    Row,
    example_matches,
    plot_coverage,
    plot_rows,
    plot_score_matrix,
    score_matrix,
)
from dejavu_torch.types import GroundTruth, Match


def dots(axis: object) -> dict[str, list[tuple[float, float]]]:
    """The points of each group of a coverage plot by its label."""
    return {
        line.get_label(): list(zip(*(map(float, part) for part in line.get_data()), strict=True))
        for line in axis.lines  # type: ignore[attr-defined]
    }


def test_coverage_tells_right_from_wrong_from_not_reported() -> None:
    figure, axis = plot_coverage(
        matched(0, 9, -1, 4), torch.arange(4)[:, None], 1, torch.arange(11), torch.arange(4), "frames"
    )
    assert dots(axis) == {
        "1 wrong": [(1, 9)],
        "2 right": [(0, 0), (3, 4)],
        "1 not reported": [(2, 0)],
    }
    render(figure)


def test_coverage_leaves_grey_what_is_not_scored() -> None:
    right, known = torch.arange(5)[:, None], torch.tensor([True, False, True, False, True])
    truth = GroundTruth(right, known, torch.tensor([[-1], [-1], [7], [-1], [-1]]))
    figure, axis = plot_coverage(
        matched(0, 1, 7, -1, 9), truth, 0, torch.arange(11), torch.tensor([10, 20, 30, 40, 50]), "frames"
    )
    assert dots(axis) == {
        "3 not scored": [(20, 1), (30, 7)],
        "1 wrong": [(50, 9)],
        "1 right": [(10, 0)],
    }
    assert axis.get_xlim() == (10, 50)
    assert {"3 not scored", "right within 0 frames"} <= set(texts(figure))


def test_coverage_without_truth_or_of_one_query() -> None:
    figure, axis = plot_coverage(matched(3), None, 5, torch.arange(11), torch.arange(1), "frames")
    assert dots(axis) == {"1 reported": [(0, 3)]}
    render(figure)


@pytest.mark.parametrize(("channels", "height", "width"), [(1, 32, 32), (3, 32, 64), (3, 20, 100)])
def test_frames_of_any_shape(channels: int, height: int, width: int) -> None:
    frames = torch.rand(2, channels, height, width)
    titles = ["reference, frame 1", "second, frame 2"]
    figure, axes = plot_rows([Row("", titles, list(frames))] * 3)
    assert axes.shape == (3, 2)
    assert set(titles) <= set(texts(figure))
    image = render(figure)
    shown = image.width * 3 * height / (2 * width)
    assert shown < image.height < 1.2 * shown + 300  # little room that is empty


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
    assert "first above the threshold" in last.why


def test_an_example_is_shown_once_and_only_if_there_is_one() -> None:
    (one,) = example_matches(found([4], [0.1]), None, 0)
    assert one.why == "surest answer, least sure answer, score 0.1"
    right = example_matches(found([0, 1], [0.1, 0.2]), as_ground_truth(torch.arange(2)[:, None]), 0)
    assert [one.why.split(",")[0] for one in right] == ["surest right answer", "least sure answer"]
    assert example_matches(found([-1], [torch.inf]), None, 0) == []


def test_the_right_place_shown_is_the_nearest_to_the_one_reported() -> None:
    truth = as_ground_truth(torch.tensor([[3, 90, -1]]))
    (example,) = example_matches(found([80], [0.1]), truth, 0)
    assert example.right == 90


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


def test_places_that_nothing_covers_stay_empty() -> None:
    scores = torch.rand(4, 10)
    scores[:, 6:] = torch.inf
    matrix = score_matrix(lambda rows: scores[: len(rows)], torch.rand(1, 2))
    assert matrix is not None
    assert matrix.values.isnan().tolist() == [[False] * 6 + [True] * 4]
    assert score_matrix(lambda rows: torch.full((len(rows), 5), torch.inf), torch.rand(3, 2)) is None


def test_the_score_matrix_is_drawn_with_reported_and_right_places() -> None:
    match, truth = matched(0, 7, -1, 3), as_ground_truth(torch.tensor([[0, 5], [1, -1], [2, -1], [3, -1]]))
    matrix = score_matrix(lambda rows: torch.rand(len(rows), 10), torch.rand(4, 2))
    assert matrix is not None
    figure, axis = plot_score_matrix(matrix, match, truth, torch.arange(11), torch.arange(4))
    reported, first, second, _ = axis.lines
    assert list(zip(*reported.get_data(), strict=True)) == [(0, 0), (1, 7), (3, 3)]
    assert first.get_ydata().tolist() == [0, 1, 2, 3]
    assert second.get_ydata()[0] == 5
    assert axis.images[0].get_array().shape == (10, 4)
    assert {"reported place", "right place"} <= set(texts(figure))
    assert "right place" not in texts(
        plot_score_matrix(matrix, match, None, torch.arange(11), torch.arange(4))[0]
    )


def test_convention_11_places_and_queries_are_drawn_at_their_frames() -> None:
    """Of ten places, the camera stands at the fourth from frame 6 to 29; the query moves twice as fast."""
    borders = torch.tensor([0, 2, 4, 6, 30, 31, 32, 33, 34, 35, 40])
    queries, match = torch.tensor([0, 4, 8, 12]), matched(0, 3, -1, 9)
    truth = as_ground_truth(torch.tensor([[0, -1], [4, -1], [2, -1], [9, 5]]))
    figure, axis = plot_coverage(match, truth, 1, borders, queries, "places")
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
        assert {"query (frame)", "place (frame)"} <= set(texts(figure))
