"""Every picture of a report, drawn from one localization run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.positions import unit_of
from dejavu_torch.evaluation.activation import activation_rates, best_phases, layer_distances
from dejavu_torch.evaluation.components import components
from dejavu_torch.evaluation.contenders import COLOURS, Contender, distinct
from dejavu_torch.evaluation.controls import template_map_of
from dejavu_torch.evaluation.map_plots import (
    Lines,
    plot_activations,
    plot_answers,
    plot_autocorrelogram,
    plot_chunks,
    plot_features,
    plot_layers,
    plot_spectrogram,
    plot_spectrum,
    plot_templates,
    plot_velocity,
)
from dejavu_torch.evaluation.match_plots import (
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
from dejavu_torch.evaluation.plots import DARK, LAYERS, LETTERS, WIDTH, Picture, canvas, label, show_frame
from dejavu_torch.evaluation.score_plots import Stored, draw_sequences, draw_storage, plot_auc, plot_curves
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import period_of, spectrum
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.ground_plane import ground_patch
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import SINGLE, Matching
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import FrequencyLayer, Match, Plan, SequenceModel, Traverse

CANDIDATES = 16  # features of a layer from which the one to show is chosen
EXAMPLES = 4  # places of which the frames of both traverses are shown
STRONGEST = 3  # numbers of the descriptor whose spectrum is shown


class Localization(NamedTuple):
    """A map, the traverses it was made of and queried with, and what was found.

    reference_features (N,D) and query_features (Q,D) may lie in a file. truth: None where there is none.
    tolerance: distance from a right place, in places, up to which a reported one is right.
    matching: how the map and all that it is set beside are matched.

    Convention 11: match and truth count places and queries, pictures show frames of the sources.
    """

    model: DejaVu
    reference: Traverse
    query: Traverse
    reference_features: Tensor
    query_features: Tensor
    match: Match
    truth: GroundTruth | None
    tolerance: int
    matching: Matching = SINGLE

    def __repr__(self) -> str:
        return f"{self.query.name} on {self.reference.name}"

    @property
    def sequence(self) -> SequenceModel | None:
        """What scores consecutive queries together."""
        return self.matching.sequence

    @property
    def scored(self) -> Match:
        """The matches as the scores count them."""
        return self.match._replace(index=self.model.map.table.scored(self.match.index))

    @property
    def borders(self) -> Tensor:
        """(N+1,) the reference frame with which each place begins, and the number of frames."""
        return self.model.map.table.borders.cpu()

    @property
    def query_frames(self) -> Tensor:
        """(Q,) the frame of its source that each query shows."""
        if isinstance(self.query, ResampledTraverse):
            return self.query.frame
        return torch.arange(len(self.query_features))

    @property
    def unit(self) -> str:
        """What periods and the tolerance count."""
        return unit_of(self.model.map.positions)


def draw_pictures(
    run: Localization,
    contenders: Mapping[str, Contender],
    storage: Mapping[str, Sequence[Stored]] | None = None,
) -> dict[str, Picture]:
    """Every picture that can be drawn: one that needs ground truth, frames or layers is left out without."""
    pictures = draw_pairs(run)
    pictures |= draw_coverage(run.scored, run.truth, run.tolerance, run.borders, run.query_frames, run.unit)
    pictures |= draw_scores(run) | draw_posterior(run)
    pictures |= draw_curves(contenders, f"{run.tolerance} {run.unit}")
    pictures |= draw_storage(contenders, storage or {}, f"{run.tolerance} {run.unit}")
    coded = (storage or {}).get("map", ())
    pictures |= draw_sequences(contenders, coded, run.model.map.places, f"{run.tolerance} {run.unit}")
    pictures |= draw_motion(run)
    if isinstance(run.model.map, SpectralMap):
        pictures |= draw_spectrum(run, run.model.map) | draw_components(run, run.model.map)
    if isinstance(run.model.map, TemplateMap):
        pictures["chunks"] = Picture(
            plot_chunks(run.model.map.plan, run.borders, run.unit),
            "the map's periods along the route",
            "Dotted lines cut the route into chunks. Each bar is a layer: the features that repeat with one "
            "period in one chunk; the wider, the more features.",
        )
        pictures |= draw_features(run, run.model.map) | draw_activations(run, run.model.map)
    return pictures


def draw_pairs(run: Localization) -> dict[str, Picture]:
    """Some queries beside the frames found for them; nothing for ready features, or where none is found."""
    if not has_frames(run):
        return {}
    examples = example_matches(run.scored, run.truth, run.tolerance)
    if not examples:
        return {}
    rows = []
    for one in examples:
        titles = [f"query:\n{_name(run.query, run.query_frames[one.query])}"]
        titles.append(f"reported:\n{_name(run.reference, run.borders[one.place])}")
        frames = [frame_at(run.query, one.query), frame_at(run.reference, one.place)]
        if one.right >= 0:
            titles.append(f"right:\n{_name(run.reference, run.borders[one.right])}")
            frames.append(frame_at(run.reference, one.right))
        elif run.truth is not None:
            titles.append("right:\nnone is known")
        rows.append(Row(one.why, titles, frames))
    known = "" if run.truth is None else ", and at the right what it should have been"
    last = (
        "Surest not accepted: the best match of those that are rejected."
        if any("not accepted" in one.why for one in examples)
        else "All are accepted; the least sure answer has the worst score."
    )
    return {
        "pairs": Picture(
            plot_rows(rows),
            "queries and what was found",
            f"A query, beside it the reference frame of the place reported{known}. The lower the score, the "
            f"surer the match. {last}",
        )
    }


def _name(traverse: Traverse, frame: Tensor) -> str:
    """A query or a place by what matches.csv calls it: the frame of its source, and the frame's name."""
    return label(f"frame {frame} {source_of(traverse).frame_name(int(frame))}".strip())


def draw_scores(run: Localization) -> dict[str, Picture]:
    """The score matrix, and on it what a sequence adds up; nothing where the map has no layers."""
    scores, features, found = scores_of(run), run.query_features, (run.match.index >= 0).nonzero()[:, 0]
    matrix = score_matrix(scores, features)
    if matrix is None:
        return {}
    example, text = None, ""
    if run.sequence is not None:
        text = " Of single queries; the matches are of sequences."
    if isinstance(run.sequence, SequenceMatcher) and len(found):
        query = int(found[(found - len(features) // 2).abs().argmin()])
        example = diagonal(scores, features, run.sequence, query, int(run.match.index[query]))
        text += (
            f" Below, enlarged, an example: for the query of frame {run.query_frames[query]} and the place "
            f"reported for it, the {len(example.query)} cells of which the sequence takes the mean."
        )
    shares = []
    if len(matrix.query) < len(features):
        shares.append(f"{len(matrix.query)} of the queries")
    if matrix.block > 1:
        shares.append(f"of {matrix.block} neighbouring places the one that fits best")
    return {
        "scores": Picture(
            plot_score_matrix(matrix, run.scored, run.truth, run.borders, run.query_frames, example),
            "how well each place fits each query",
            "Dark: the place fits the query about as well as its best one does. What repeats shows as lines "
            "beside the right places."
            + text
            + (f" Drawn{' above' * (example is not None)}: {'; '.join(shares)}." if shares else ""),
        )
    }


def scores_of(run: Localization) -> Callable[[Tensor], Tensor]:
    """Scores of single queries by the map, of features that may lie elsewhere."""
    route = run.model.map
    return lambda queries: route.scores(queries.to(route.positions.device))


def draw_posterior(run: Localization) -> dict[str, Picture]:
    """What a filter believes behind each query; nothing without one."""
    if not isinstance(run.sequence, PlaceFilter):
        return {}
    image = posterior_image(scores_of(run), run.query_features, run.sequence)
    known = "" if run.truth is None else " Circles are around some of the right places; grey: none is right."
    queries, places = image.blocks
    share = f" A pixel shows the most probable of {queries} queries and {places} places."
    return {
        "posterior": Picture(
            plot_posterior(image, run.truth, run.borders, run.query_frames),
            "where the filter takes the camera to be",
            "The probability of each place, from a query and all before it. Below, that of being off the map."
            + known
            + share * (max(image.blocks) > 1),
        )
    }


def draw_curves(contenders: Mapping[str, Contender], tolerance: str) -> dict[str, Picture]:
    """Precision-recall curves, and their areas side by side; nothing where no contender has a curve."""
    # leave_out has other queries
    curves = {key: one for key, one in distinct(contenders).items() if one.curve and key != "leave_out"}
    pictures = {}
    if curves:
        pictures["pr"] = Picture(
            plot_curves(curves, f"right within {tolerance}"),
            "precision and recall",
            "How many of the reported places are right, against how many of the queries are answered right, "
            "as the threshold rises. The higher and the further to the right, the better.",
        )
    if len(curves) > 1:
        pictures["auc"] = Picture(
            plot_auc(curves),
            "area under each curve",
            "The curves above in one number each: this map, baselines that store features as they are, and "
            "nulls, in which nothing repeats. A curve starts at the queries of the best score; nothing "
            "counts to its left.",
        )
    return pictures


def draw_spectrum(run: Localization, route: SpectralMap) -> dict[str, Picture]:
    """The spectra of those numbers of the descriptor of which the longest chunk keeps most energy."""
    chunk = longest_chunk(route)
    start, stop = route.chunks[chunk]
    lines = route.lines(chunk)
    if stop - start < 2 or not len(lines.value):
        return {}
    energy = lines.value.new_zeros(route.dimension).index_add(0, lines.feature, lines.value.square())
    chosen = energy.argsort(descending=True, stable=True)[:STRONGEST].cpu()
    values = (
        run.reference_features[start:stop].cpu()[:, chosen].float() - route.means[0].cpu()[chosen].float()
    )
    amplitudes = spectrum(values.T, route.transform).abs()[:, 1:]
    kept = torch.zeros(stop - start, route.dimension, dtype=torch.bool)
    kept[lines.line.cpu(), lines.feature.cpu()] = True
    kept = kept[1:, chosen].T
    periods = torch.tensor(
        [float(period_of(j, stop - start, route.transform)) for j in range(1, stop - start)]
    )
    features = {int(number): Lines(*lines) for number, *lines in zip(chosen, amplitudes, kept, strict=True)}
    where = f" of the chunk of frames {run.borders[start]} to {run.borders[stop]}" * (len(route.chunks) > 1)
    return {
        "spectrum": Picture(
            plot_spectrum(features, periods, float(route.steps[chunk]), run.unit),
            "what the map keeps",
            f"The spectrum{where} of the numbers of the descriptor that the map keeps most of. A dot is a "
            "line, the sine or the cosine of one period. Kept is what is larger than about two thirds of the "
            "step, in whole steps; all numbers of the descriptor share the step.",
        )
    }


def draw_components(run: Localization, route: SpectralMap) -> dict[str, Picture]:
    """One query's scores with its strongest periods only, and with all; nothing where no period is kept."""
    chunk, queries = longest_chunk(route), run.query_features
    start, stop = route.chunks[chunk]
    query, places = example_query(run, start, stop)
    sums = components(route, queries[query], chunk)
    if not sums[-1].periods:
        return {}
    curves, better = [], []
    for number, (periods, scores) in enumerate(sums):
        title = f"{len(periods)} strongest periods"
        if number == len(sums) - 1:
            title = f"all {len(periods)} periods"
        elif len(periods) == 1:
            title = f"strongest period, {float(periods[0]):.4g} {run.unit}"
        if places:
            better.append(better_places(scores, [place - start for place in places], run.tolerance))
            title += f": {better[-1]} places fit better"
        curves.append((fill(title, LETTERS), scores, COLOURS["map"] if number == len(sums) - 1 else DARK))
    picture = Picture(
        plot_answers(curves, int(run.query_frames[query]), run.borders, start, stop, places, sharey=True),
        "a query's score as a sum of periods",
        "How much one query differs from each place, if only the periods that answer it most strongly are "
        "added up, and all of them: each is a wave along the route, and at the right place they agree."
        + (" Written above: how many wrong places fit better than the right one." if places else ""),
        {"places_that_fit_better": better} if better else {},
    )
    return {"components": picture}


def better_places(scores: Tensor, right: Sequence[int], tolerance: int) -> int:
    """How many places score lower than the best of those within the tolerance of a right one."""
    distance = (torch.arange(len(scores))[:, None] - torch.tensor(right)).abs().amin(1)
    inside = distance <= tolerance
    return int((scores[~inside] < scores[inside].min()).sum())


def longest_chunk(route: SpectralMap) -> int:
    """Its number; the first of equals."""
    return max(range(len(route.chunks)), key=lambda j: route.chunks[j][1] - route.chunks[j][0])


def draw_motion(run: Localization) -> dict[str, Picture]:
    """The ground and its motion; nothing where the reference is not resampled."""
    reference = run.reference
    if not isinstance(reference, ResampledTraverse):
        return {}
    frame, odometry = frame_at(reference, reference.length // 2), reference.odometry
    pair = (("reference", reference), ("query", run.query))
    distances = {
        label(f"{role}: {one.name}"): one.positions * one.step
        for role, one in pair
        if isinstance(one, ResampledTraverse)
    }
    corners, (height, width) = odometry.corners, frame.shape[-2:]
    figure, (left, right) = canvas(0.65 * WIDTH * height / width + 0.4, 1, 2, width_ratios=(2, 1))
    show_frame(left, frame, "the ground in a frame")
    show_frame(right, ground_patch(frame[None], corners, odometry.size)[0], "from above")
    x, y = (torch.tensor([*edge, edge[0]]) for edge in zip(*corners, strict=True))
    left.plot(x * (width - 1), y * (height - 1), color=LAYERS[0], linewidth=1.5)
    return {
        "ground": Picture(
            (figure, (left, right)),
            "the ground that is measured",
            "The corners are right if what lies straight ahead runs straight down the view from above, and "
            "what repeats along the route repeats at even distances there.",
        ),
        "velocity": Picture(
            plot_velocity(distances, reference.step),
            "how fast the ground moves",
            "The motion of the ground from frame to frame, forward above the grey line. Places are even "
            "steps along it: a camera that stands, or goes back and forth, adds none. A vehicle's speed "
            "changes smoothly: a curve that jumps, or falls below the line, is a sign of corners that show "
            "no clear ground.",
        ),
    }


def draw_features(run: Localization, route: TemplateMap) -> dict[str, Picture]:
    """One feature through time and folded, and the HOG features of two layers on a frame."""
    model, plan = run.model, route.plan
    leading = leading_layers(plan)
    if not leading:
        return {}
    pictures, periods = {}, getattr(model.mapper, "periods", None)
    layer, templates = plan[leading[0]], feature_templates(route, leading[0])
    chosen = best_explained(run.reference_features, layer, templates)
    feature = layer.features[chosen]
    values = run.reference_features[:, feature : feature + 1].cpu()
    if isinstance(periods, SpectrogramAnalysis):
        spectra = periods(values)
        kept = [
            [float(p.period) for p in plan if (p.start, p.stop) == (start, stop) and feature in p.features]
            for start, stop, _ in spectra
        ]
        pictures["spectrogram"] = Picture(
            plot_spectrogram(values[:, 0], spectra, kept, periods.min_period, feature, run.borders, run.unit),
            "a feature and its spectrogram",
            "One feature along the route, and how its power is spread over periods in each "
            "chunk. The map keeps the strongest periods, circled: they put the feature into a layer each.",
        )
    made = "the trained template" if model.trained else "their mean"
    pictures["templates"] = Picture(
        plot_templates(layer, values[layer.start : layer.stop, 0], templates, chosen, run.unit, made),
        "places of equal phase become templates",
        "Above, the same feature cut into cycles of one period and laid over each other, and "
        + ("the template that training made of it" if model.trained else "their mean, which the map stores")
        + ". Below, the templates of the layer's features, a row each.",
    )
    middle = (layer.start + layer.stop) // 2
    if type(model.features) is HOG and len(run.reference.frame_shape) == 3:
        frame = as_hog_sees(model, frame_at(run.reference, middle))
        layout = model.features.orientations, model.features.cell, model.features.block
        pictures["features"] = Picture(
            plot_features(frame, [plan[j] for j in leading], *layout),
            "where the features of a layer look",
            "The HOG features that take part in each layer, drawn on frame "
            f"{run.borders[middle]} as the edges they respond to; the stronger a line, the more "
            "of the overlapping blocks have it in the layer.",
        )
    return pictures


def draw_activations(run: Localization, route: TemplateMap) -> dict[str, Picture]:
    """Two layers of one chunk answering one query, and all fused; nothing where no chunk has two layers."""
    plan, truth, queries = route.plan, run.truth, run.query_features
    chosen = leading_layers(plan)
    if len(chosen) < 2:
        return {}
    layers = [plan[j] for j in chosen]
    start, stop = layers[0].start, layers[0].stop
    (query, places), rates = example_query(run, start, stop), None
    if truth is not None:
        best = [best_phases(route, queries, j) for j in chosen]
        rates = activation_rates(layers, best, run.scored.index, truth, run.tolerance, route.places)
    one = queries[query : query + 1]
    scores = [layer_distances(route, one, j)[0, plan[j].place_phases] for j in chosen]
    with torch.no_grad():
        fused = route.scores(one.to(route.templates.device))[0, start:stop].cpu()
    borders = run.borders
    strip = slit_scan(source_of(run.reference), int(borders[start]), int(borders[stop]))
    number = int(run.query_frames[query])
    covering = sum((layer.start, layer.stop) == (start, stop) for layer in plan)
    elsewhere = (
        " Elsewhere: queries from other chunks, the layer's phase counted on; near chance where its period "
        "ends with the chunk."
        if rates is not None and rates.fused.outside is not None
        else ""
    )
    explained = (
        f" Right: within {run.tolerance} {run.unit}, for a layer in phase.{elsewhere} All layers fused "
        "choose from the whole route."
    )
    picture = Picture(
        plot_activations(layers, scores, fused, number, borders, places, strip, rates),
        "two layers, and all layers fused",
        "How much one query differs from each place of a chunk: a layer alone fits one place a period, all "
        f"{covering} of the chunk together one." + (explained if rates else ""),
        {} if rates is None else rates.as_json(),
    )
    return {"activations": picture}


def paper_pictures(run: Localization) -> dict[str, Picture]:
    """Frames, autocorrelogram and layers, which `reproduce` adds (figures 1, 2 and 5 to 7 of the paper)."""
    pictures: dict[str, Picture] = {}
    if run.truth is not None and (run.truth.positives >= 0).any() and has_frames(run):
        middles = [len(run.reference_features) * (k + 0.5) / EXAMPLES for k in range(EXAMPLES)]
        queries = [nearest_query(run.truth, middle) for middle in middles]
        places = run.truth.positives[queries].amax(1)
        rows = []
        for place, query in zip(places.tolist(), queries, strict=True):
            numbers = run.borders[place], run.query_frames[query]
            titles = [f"{name}, frame {n}" for name, n in zip(("reference", "second"), numbers, strict=True)]
            rows.append(Row("", titles, [frame_at(run.reference, place), frame_at(run.query, query)]))
        pictures["frames"] = Picture(
            plot_rows(rows),
            "the route",
            "The same places on the reference and on the second traverse.",
        )
    route = template_map_of(run.model, "the picture of layers")
    plan = route.plan
    for j in leading_layers(plan)[:1]:
        layer = plan[j]
        feature = layer.features[best_explained(run.reference_features, layer, feature_templates(route, j))]
        chunk = [p for p in plan if (p.start, p.stop) == (layer.start, layer.stop)]
        kept = [float(p.period) for p in chunk if feature in p.features]
        values = run.reference_features[layer.start : layer.stop, feature].cpu()
        pictures["autocorrelogram"] = Picture(
            plot_autocorrelogram(values, kept, feature, run.unit),
            "a feature against itself",
            "How alike a feature is to itself so many places later: where it repeats, it is high at every "
            "multiple of its period.",
        )
        pictures["layers"] = Picture(
            plot_layers(chunk, run.borders, run.unit),
            "layers and their phases",
            "One chunk of the map: a row a layer, the colour its phase. A column of phases names a place; "
            "the next place where all are the same is the least common multiple of the periods away.",
        )
    return pictures


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


def feature_templates(route: TemplateMap, j: int) -> Tensor:
    """Templates of one layer in the units of the features, (P,F): trained weights divided out."""
    templates: Tensor = route.blocks()[j].detach().cpu()
    if not len(route.weights):
        return templates
    return templates / route.weights.detach().cpu()[list(route.plan[j].features)].clamp(min=1e-6)


def best_explained(values: Tensor, layer: FrequencyLayer, templates: Tensor) -> int:
    """Position in a layer of the feature of which the templates explain the largest share of the variance.

    Only the 16 features whose templates vary most are candidates.

    Shape: values (N,D), templates (P,F) -> 0..F-1.
    """
    candidates = templates.var(0, correction=0).argsort(descending=True, stable=True)[:CANDIDATES]
    columns = torch.tensor(layer.features)[candidates].to(values.device)
    chosen = values[layer.start : layer.stop].index_select(1, columns).cpu().double()
    rest = (chosen - templates[layer.place_phases][:, candidates]).square().sum(0)
    share = 1 - rest / (chosen - chosen.mean(0)).square().sum(0)
    return int(candidates[share.nan_to_num(-1, neginf=-1).argmax()])


def nearest_query(truth: GroundTruth, place: float) -> int:
    """The query one of whose right places is nearest to a place; the first where none has any."""
    right = torch.where(truth.judged[:, None] & (truth.positives >= 0), truth.positives, torch.inf)
    return int((right - place).abs().amin(1).argmin())


def example_query(run: Localization, start: int, stop: int) -> tuple[int, list[int]]:
    """The query nearest to the middle of a chunk and its right places there; without truth the middle one."""
    if run.truth is None:
        return len(run.query_features) // 2, []
    query = nearest_query(run.truth, (start + stop) / 2)
    right = run.truth.positives[query].tolist() if run.truth.judged[query] else []
    return query, [place for place in right if start <= place < stop]


def has_frames(run: Localization) -> bool:
    """Whether both traverses hold frames, not ready features."""
    return len(run.reference.frame_shape) == len(run.query.frame_shape) == 3


def frame_at(traverse: Traverse, number: int) -> Tensor:
    """One frame of a traverse, (C,H,W)."""
    return next(traverse.between(number, number + 1))[0].float().cpu()


def as_hog_sees(model: DejaVu, frame: Tensor) -> Tensor:
    """A frame (C,H,W) after the model's preprocessing and HOG's own antialiased resize."""
    with torch.no_grad():
        seen: Tensor = model.preprocess(frame[None])
    return resize_frames(seen, getattr(model.features, "resize", None))[0]


def slit_scan(traverse: Traverse, start: int, stop: int) -> Tensor | None:
    """The middle image column of each of the frames [start, stop), side by side: (C,H,stop - start).

    None where the traverse holds features.
    """
    if len(traverse.frame_shape) == 1:
        return None
    columns = [  # a view would keep the whole frames
        batch[..., batch.shape[-1] // 2].clone() for batch in traverse.between(start, stop)
    ]
    return torch.cat(columns).permute(1, 2, 0).float() if columns else None
