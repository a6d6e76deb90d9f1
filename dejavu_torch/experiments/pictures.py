"""Every picture of a report, drawn from what a comparison holds."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import counted
from dejavu_torch.database.distance import phase_distances
from dejavu_torch.evaluation.activation import activation_rates
from dejavu_torch.evaluation.curves import area, curve_of
from dejavu_torch.evaluation.feature_plots import plot_features, plot_spectrogram, plot_templates
from dejavu_torch.evaluation.plots import (
    Picture,
    plot_activations,
    plot_auc,
    plot_chunks,
    plot_coverage,
    plot_curves,
)
from dejavu_torch.experiments.others import Other
from dejavu_torch.features.extract import frame_shape
from dejavu_torch.features.hog import HOG
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer, GroundTruth, Match, Plan, Traverse

CANDIDATES = 16  # features of a layer that are looked at closely
DISTANCES_AT_ONCE = 2**22  # numbers of Q x P held at a time


def draw_pictures(
    model: DejaVu,
    reference: Traverse,
    stored: Tensor,
    seen: Tensor,
    match: Match,
    truth: GroundTruth | None,
    tolerance: int,
    others: Mapping[str, Other],
) -> dict[str, Picture]:
    """Every picture that can be drawn: what is not there, such as a truth or layers, leaves its own out.

    Args:
        model: with the map of the reference. stored: (N,D) its features; may lie in a file, only some
            rows and columns are read.
        seen: (Q,D) features of the queries. match: where they were found.
        truth: their right places, or None. tolerance: frames within which a place is right.
        others: other matches of the same queries, by key.

    Returns:
        Of pr, auc, coverage, chunks, spectrogram, templates, features, activations those that can be
        drawn, in this order.
    """
    pictures = {}
    plan, places = model.map.plan, model.map.places
    curves = {}
    if truth is not None:
        judged, strides = {"this map": match}, []
        for key, (name, other, size, stride) in others.items():
            # leave_out has other queries
            if key != "leave_out" and (stride is None or (stride, size) not in strides):
                judged[name] = other
                strides.append((stride, size))
        curves = {
            name: curve_of(one, truth, tolerance)
            for name, one in judged.items()
            if counted(one.index, truth, tolerance).any()
        }
    if curves:
        pictures["pr"] = Picture(
            plot_curves(curves, f"right within {tolerance} places"),
            "precision and recall",
            "How many of the reported places are right, against how many of the queries are answered right, "
            "as the threshold rises. The higher and the further to the right, the better.",
        )
        pictures["auc"] = Picture(
            plot_auc({name: area(curve) for name, curve in curves.items()}),
            "area under each curve",
            "The curves above in one number each: this map, baselines that store frames, and nulls, in which "
            "nothing repeats. A curve starts where the queries of the best score report; what lies to the "
            "left of it is no area.",
        )
    pictures["coverage"] = Picture(
        plot_coverage(match, truth, tolerance, places),
        "places reported",
        "Where along the route each query was put."
        + (" A query in its right place is green, in a wrong one red." if truth is not None else ""),
    )
    pictures["chunks"] = Picture(
        plot_chunks(plan, places),
        "the map's periods along the route",
        "Dotted lines cut the route into chunks. Each bar is a layer: the features that repeat with one "
        "period in one chunk; the wider, the more features.",
    )
    return (
        pictures
        | draw_features(model, reference, stored)
        | draw_activations(model, reference, seen, match, truth, tolerance)
    )


def leading_layers(plan: Plan) -> list[int]:
    """Positions of the two layers of one chunk that pictures show, the one of most features first.

    The chunk is the longest that has two layers, else the longest; of equals the first. A chunk of one
    layer gives one; a map without layers none.
    """
    chunks: dict[tuple[int, int], list[int]] = {}
    for j, layer in enumerate(plan):
        chunks.setdefault((layer.start, layer.stop), []).append(j)
    if not chunks:
        return []
    best = max(chunks, key=lambda chunk: (len(chunks[chunk]) > 1, chunk[1] - chunk[0], -chunk[0]))
    return sorted(chunks[best], key=lambda j: -len(plan[j].features))[:2]


def best_explained(stored: Tensor, layer: FrequencyLayer, templates: Tensor) -> int:
    """Position in a layer of the feature of which the templates tell most: the share of its variance.

    Only the 16 features whose templates vary most are looked at.

    Shape: stored (N,D), templates (P,F) -> 0..F-1.
    """
    candidates = templates.var(0, correction=0).argsort(descending=True, stable=True)[:CANDIDATES]
    columns = torch.tensor(layer.features)[candidates].to(stored.device)
    values = stored[layer.start : layer.stop].index_select(1, columns).cpu().double()
    rest = (values - templates[layer.place_phases][:, candidates]).square().sum(0)
    share = 1 - rest / (values - values.mean(0)).square().sum(0)
    return int(candidates[share.nan_to_num(-1, neginf=-1).argmax()])


def draw_features(model: DejaVu, reference: Traverse, stored: Tensor) -> dict[str, Picture]:
    """One feature through time and folded, and the HOG features of two layers on a frame."""
    plan = model.map.plan
    leading = leading_layers(plan)
    if not leading:
        return {}
    pictures = {}
    layer, templates = plan[leading[0]], model.map.blocks()[leading[0]].detach().cpu()
    if len(model.map.weights):  # in the units of the features
        templates = templates / model.map.weights.detach().cpu()[list(layer.features)].clamp(min=1e-6)
    chosen = best_explained(stored, layer, templates)
    feature = layer.features[chosen]
    values = stored[:, feature : feature + 1].cpu()
    if isinstance(model.periods, SpectrogramAnalysis):
        spectra = model.periods(values)
        kept = [
            [float(p.period) for p in plan if (p.start, p.stop) == (start, stop) and feature in p.features]
            for start, stop, _ in spectra
        ]
        pictures["spectrogram"] = Picture(
            plot_spectrogram(values[:, 0], spectra, kept, model.periods.min_period, feature),
            "a feature and its spectrogram",
            "One feature of each frame along the route, and how its power is spread over periods in each "
            "chunk. The map keeps the strongest periods, circled: they put the feature into a layer each.",
        )
    pictures["templates"] = Picture(
        plot_templates(
            layer,
            values[layer.start : layer.stop, 0],
            templates,
            chosen,
            "the trained template" if model.trained else "their mean",
        ),
        "frames of equal phase become templates",
        "Above, the same feature cut into cycles of one period and laid over each other, and "
        + ("the template that training made of it" if model.trained else "their mean, which the map stores")
        + ". Below, the templates of the layer's features, a row each.",
    )
    features = model.features
    if type(features) is HOG:
        number = (layer.start + layer.stop) // 2
        frame = next(reference.between(number, number + 1), None)
        if frame is not None and frame.ndim == 4:
            if features.resize is not None:
                frame = torch.nn.functional.interpolate(
                    frame.float(), features.resize, mode="bilinear", antialias=True
                )
            layout = features.orientations, features.cell, features.block
            pictures["features"] = Picture(
                plot_features(frame[0].float(), [plan[j] for j in leading], *layout),
                "where the features of a layer look",
                f"The HOG features that take part in each layer, drawn on frame {number} as the edges they "
                "respond to; the stronger a line, the more of the overlapping blocks have it in the layer.",
            )
    return pictures


def draw_activations(
    model: DejaVu, reference: Traverse, seen: Tensor, match: Match, truth: GroundTruth | None, tolerance: int
) -> dict[str, Picture]:
    """Two layers of one chunk answering one query, and their fusion; nothing where no chunk has two layers.

    The chunk and layers of `leading_layers`, and the query whose right place is nearest to the chunk's
    middle (without truth: the middle query).
    """
    plan = model.map.plan
    chosen = leading_layers(plan)
    if len(chosen) < 2:
        return {}
    layers = [plan[j] for j in chosen]
    start, stop = layers[0].start, layers[0].stop
    query, places = len(seen) // 2, []
    rates = None
    if truth is not None:
        right = torch.where(truth.judged[:, None], truth.positives, -1)
        apart = torch.where(right >= 0, (right - (start + stop) / 2).abs(), torch.inf).amin(1)
        query = int(apart.argmin())
        places = [place for place in right[query].tolist() if start <= place < stop]
        best = [best_phases(model, seen, j) for j in chosen]
        rates = activation_rates(layers, best, match.index, truth, tolerance, model.map.places)
    one = seen[query : query + 1]
    with torch.no_grad():
        scores = [layer_distances(model, one, j)[0, plan[j].place_phases].cpu() for j in chosen]
        fused = model.matcher(one.to(model.map.size.device), model.map)[0, start:stop].cpu()
    strip = slit_scan(reference, start, stop)
    covering = sum((layer.start, layer.stop) == (start, stop) for layer in plan)
    told = (
        f" Right: within {tolerance} places, for a layer in phase. Elsewhere: queries from other chunks, the "
        "layer's phase counted on; near chance where its period ends with the chunk. All layers fused choose "
        "from the whole route."
    )
    picture = Picture(
        plot_activations(layers, scores, fused, query, places, strip, rates),
        "two layers, and all layers fused",
        "How much one query differs from each place of a chunk: a layer alone fits one place a period, all "
        f"{covering} of the chunk together one." + (told if rates else ""),
        {} if rates is None else rates.as_json(),
    )
    return {"activations": picture}


def layer_distances(model: DejaVu, queries: Tensor, j: int) -> Tensor:
    """Eq. 3 for one layer of the map: (Q,D) -> (Q,P)."""
    block, features = model.map.blocks()[j], model.map.layer_features()[j]
    chosen = queries.index_select(1, features.to(queries.device)).to(block.device)
    if len(model.map.weights):
        chosen = chosen * model.map.weights[features]
    return phase_distances(chosen, block, model.matcher.metric)


def best_phases(model: DejaVu, queries: Tensor, j: int) -> Tensor:
    """The phase of one layer, among those its chunk has, nearest to each query: (Q,D) -> (Q,) int64."""
    layer = model.map.plan[j]
    present: Tensor = layer.place_phases.unique()
    parts = queries.split(max(1, DISTANCES_AT_ONCE // max(layer.phases, len(layer.features))))
    with torch.no_grad():
        nearest = [layer_distances(model, part, j).cpu()[:, present].argmin(1) for part in parts]
    return present[torch.cat(nearest)]


def slit_scan(traverse: Traverse, start: int, stop: int) -> Tensor | None:
    """The middle image column of each of the frames [start, stop), side by side: (C,H,stop - start).

    None where the traverse holds features.
    """
    if len(frame_shape(traverse)) == 1:
        return None
    columns = [  # a view would keep the whole frames
        batch[..., batch.shape[-1] // 2].clone() for batch in traverse.between(start, stop)
    ]
    return torch.cat(columns).permute(1, 2, 0).float() if columns else None
