"""All pictures of a report, drawn from one localization run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dejavu_torch.evaluation.area_plots import draw_area, draw_heat
from dejavu_torch.evaluation.contenders import Contender
from dejavu_torch.evaluation.controls import template_map_of
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.map_plots import draw_motion
from dejavu_torch.evaluation.match_plots import (
    draw_coverage,
    draw_examples,
    draw_frames,
    draw_pairs,
    draw_posterior,
    draw_scores,
)
from dejavu_torch.evaluation.plots import Pictures
from dejavu_torch.evaluation.score_plots import Stored, draw_curves, draw_sequences, draw_storage
from dejavu_torch.evaluation.template_plots import draw_paper, draw_template_map
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.memory import in_float32


@in_float32()  # as the numbers that are drawn
def draw_pictures(run: Localization, contenders: Mapping[str, Contender]) -> Pictures:
    """All pictures that can be drawn; some need ground truth, frames or layers."""
    place_map = run.model.map
    pictures = draw_examples(run) | draw_pairs(run)
    pictures |= {1: _along_route, 2: _over_area}[place_map.layout.dimensions](run)
    pictures |= draw_compared(run, contenders) | draw_motion(run)
    if isinstance(place_map, TemplateMap):
        pictures |= draw_template_map(run, place_map)
    return pictures


def _along_route(run: Localization) -> Pictures:
    seen = run.borders, run.query_frames, run.unit
    by_one = run.by_one if run.answers == "drive" else None
    coverage = draw_coverage(run.scored, run.truth, run.tolerance, *seen, by_one)
    return coverage | draw_scores(run) | draw_posterior(run)


def _over_area(run: Localization) -> Pictures:
    return draw_area(run) | draw_heat(run)


@in_float32()
def draw_compared(
    run: Localization,
    contenders: Mapping[str, Contender],
    storage: Mapping[str, Sequence[Stored]] | None = None,
) -> Pictures:
    """The pictures of all contenders together."""
    places, storage = run.model.map.places, storage or {}
    pictures = draw_curves(contenders, run.within) | draw_storage(contenders, storage, run.within)
    return pictures | draw_sequences(contenders, storage.get("map", ()), places, run.within)


def paper_pictures(run: Localization) -> Pictures:
    """The pictures that `reproduce` adds: frames, autocorrelogram and layers (figures 1, 2 and 5 to 7)."""
    return draw_frames(run) | draw_paper(run, template_map_of(run.model, "the picture of layers"))
