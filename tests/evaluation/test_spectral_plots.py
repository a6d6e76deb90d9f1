"""Pictures of a spectral map, read back from the figures."""

from __future__ import annotations

import pytest
import torch
from drawn import texts
from torch import Tensor

from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth, offset_truth
from dejavu_torch.evaluation.contenders import COLOURS, Contender, contend
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.evaluation.pictures import (
    Localization,
    draw_components,
    draw_pictures,
    draw_spectrum,
)
from dejavu_torch.evaluation.report import PICTURES
from dejavu_torch.evaluation.score_plots import Stored, draw_sequences, draw_storage
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import period_of

PLACES = 240


def route(seed: int) -> Tensor:
    noise = torch.randn(PLACES, 6, generator=torch.Generator().manual_seed(seed))
    angle = 2 * torch.pi * torch.arange(PLACES)[:, None] / torch.tensor([60.0, 24, 16, 12, 8, 5])
    return (angle + 0.7).sin() * torch.tensor([3.5, 2, 3, 4, 5, 0.1]) + 0.1 * noise


def localized(chunk: int = 10_000, scored: bool = True) -> Localization:
    model = DejaVu(whitening="none", mapper=SpectralMapper(None, 1.0, chunk)).learn(route(0))  # type: ignore[arg-type]
    truth = as_ground_truth(offset_truth(PLACES, PLACES)) if scored else None
    match = model.localize(route(1))
    traverses = ArrayTraverse(route(0)), ArrayTraverse(route(1))
    return Localization(model, *traverses, route(0), route(1), match, truth, 2)


def map_of(run: Localization) -> SpectralMap:
    assert isinstance(run.model.map, SpectralMap)
    return run.model.map


@pytest.mark.parametrize("chunk", [10_000, 150])
def test_the_lines_that_are_marked_are_those_of_the_map(chunk: int | str) -> None:
    run = localized(chunk)
    held = map_of(run)
    picture = draw_spectrum(run, held)["spectrum"]
    figure, axes = picture.plot
    start, stop = held.chunks[0]
    every = held.lines(0)
    assert [axis.get_title(loc="left").split(":")[0] for axis in axes] == [f"feature {j}" for j in (4, 3, 0)]
    for axis, feature in zip(axes, (4, 3, 0), strict=True):
        lines = every.line[every.feature == feature]
        expected = sorted(float(period_of(line, stop - start)) for line in lines.tolist() if line)
        zero, kept = (sorted(one.get_xdata().tolist()) for one in axis.lines[:2])
        assert kept == pytest.approx(expected)
        assert len(kept) + len(zero) == stop - start - 1
        assert f"{len(kept)} of {stop - start - 1} lines" in axis.get_title(loc="left")
        assert min(axis.lines[1].get_ydata()) >= 0.65  # a dead zone of 1.3 steps around 0
        assert axis.lines[2].get_ydata() == [1, 1]
        assert axis.lines[1].get_color() == COLOURS["map"]
    assert {"period (frames)", "size of a line (steps)", "kept", "coded as 0", "step"} <= set(texts(figure))
    assert ("of the chunk of frames 0 to 150" in picture.caption) == (chunk == 150)


def test_a_map_without_lines_has_no_such_pictures() -> None:
    run = localized()
    held = SpectralMapper(None, 1e6)(route(0))
    assert draw_spectrum(run, held) == draw_components(run, held) == {}


def test_the_components_end_with_the_map_s_own_scores() -> None:
    run = localized()
    picture = draw_components(run, map_of(run))["components"]
    figure, axes = picture.plot
    assert axes[-1].lines[0].get_ydata().tolist() == pytest.approx(
        run.model.map.scores(route(1)[120:121])[0].tolist(), abs=1e-5
    )
    assert axes[-1].lines[0].get_color() == COLOURS["map"]
    found = texts(figure)
    assert {"true place", "place (frame)", "difference of query 120 (lower is better)"} <= set(found)
    titles = [axis.get_title(loc="left") for axis in axes]
    assert titles[0].startswith("strongest period, 8 frames: ")
    assert titles[1].startswith("4 strongest periods: ")
    better = picture.numbers["places_that_fit_better"]
    assert [int(title.split(": ")[1].split()[0]) for title in titles] == better
    assert better[-1] == 0 < better[0]
    assert len({axis.get_ylim() for axis in axes}) == 1
    unscored = draw_components(localized(scored=False), map_of(run))["components"]
    assert unscored.numbers == {}
    assert "fit better" not in " ".join(texts(unscored.plot[0]))


def points(*pairs: tuple[float, float]) -> list[Stored]:
    return [Stored(size, area, area) for size, area in pairs]


def test_the_storage_picture_shows_the_points_and_what_the_null_takes() -> None:
    storage = {"map": points((1, 0.5), (2, 0.8)), "null": points((4, 0.5), (16, 0.6)), "interpolated": []}
    whole = Contender("all of them", Scores(0.9, 0.9, 0.1, 0.1, 0.9, 0.9), 100, 1)
    picture = draw_storage({"uncompressed": whole}, storage, "2 frames")["storage"]
    figure, axis = picture.plot
    lines = {line.get_label(): line for line in axis.lines}
    assert lines["this map"].get_xdata().tolist() == [1, 2]
    assert lines["this map"].get_ydata().tolist() == [0.5, 0.8]
    assert lines["this map"].get_color() == COLOURS["map"]
    assert lines["all of them"].get_ydata() == [0.9, 0.9]
    assert axis.get_xscale() == "log"
    assert {"route bytes per place", "right within 2 frames"} <= set(texts(figure))
    assert "null takes 4 times the bytes" in picture.caption
    assert picture.numbers["null_over_map"] == [4.0]
    assert picture.numbers["map"][0] == {"route_bytes_per_place": 1, "auc": 0.5, "recall_at_1": 0.5}
    assert picture.numbers["interpolated"] == []
    assert draw_storage({}, {}, "2 frames") == draw_storage({}, {"map": []}, "2 frames") == {}


def at(*areas: float) -> dict[int, Scores]:
    return {T: Scores(area, area, 0, 0, area, area) for T, area in zip((1, 5, 11), areas, strict=True)}


def test_the_areas_of_sequences_of_all_contenders_and_of_the_map_at_other_sizes() -> None:
    """Sizes that the map has, and those that no budget has, are not drawn twice."""
    contenders = {
        "map": Contender("this map", None, 1000, fixed=500, sequences=at(0.5, 0.7, 0.9)),
        "hog": Contender("HOG, every frame", None, sequences=at(0.4, 0.6, 0.8)),
        "leave_out": Contender("without", None),
    }
    coded = [
        Stored(size, 0, 0, at(0.3, 0.4, area)) for size, area in ((0.97, 0.6), (4.9, 0.9), (5.1, 0.9), (9, 1))
    ]
    pictures = draw_sequences(contenders, coded, 100, "2 frames")
    figure, axis = pictures["sequences"].plot
    lines = {line.get_label(): line for line in axis.lines}
    # 5 route bytes per place are its own; 2.5 are nearest to 0.97, which are there already
    names = ["this map, 5 route bytes per place", "the same in 0.97 bytes", "HOG, every frame"]
    assert list(lines) == names
    assert [list(line.get_xdata()) for line in axis.lines] == [[1, 5, 11]] * 3
    assert list(lines[names[0]].get_ydata()) == [0.5, 0.7, 0.9]
    assert list(lines[names[1]].get_ydata()) == [0.3, 0.4, 0.6]
    assert [line.get_color() for line in axis.lines] == [COLOURS[key] for key in ("map", "map", "hog")]
    assert {"1", "5", "11", "right within 2 frames"} <= set(texts(figure))
    single = {"map": Contender("this map", None)}
    assert draw_sequences(single, [], 100, "2 frames") == {}


def test_every_picture_of_a_spectral_map() -> None:
    run = localized()
    contenders = {key: contend(key, run.match, run.truth, 2) for key in ("map", "null")}
    pictures = draw_pictures(run, contenders, {"map": points((1, 0.5))})
    assert list(pictures) == ["coverage", "scores", "pr", "auc", "storage", "spectrum", "components"]
    assert pictures.keys() <= set(PICTURES)
    for picture in pictures.values():
        texts(picture.plot[0])
        assert picture.caption.endswith(".")
