"""Pictures of a template map: its periods, the features of its layers, and its answer to a query."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm
from torch import Tensor
from torch.nn.functional import max_pool1d

from dejavu_torch.data.traverse import Part
from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.activation import activation_rates, layer_distances
from dejavu_torch.evaluation.localization import Localization, frame_at
from dejavu_torch.evaluation.map_plots import BLUE, plot_answers
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import Facts, FrequencyLayer, Plan, Traverse

CANDIDATES = 16  # features of a layer from which one is chosen to be shown
SHOWN = 12  # layers of a chunk, at most
DOTS = 2000  # along a picture, at least; a longer line is drawn as a band from its minimum to its maximum
ROWS, CYCLES, MARKED = 64, 100, 12  # templates, cycles and multiples of a period drawn, at most


def draw_template_map(run: Localization, place_map: TemplateMap) -> plots.Pictures:
    """All pictures of a template map; without layers only the first."""
    plan, pictures = place_map.plan, draw_chunks(place_map.plan, run.borders, run.unit)
    shown = shown_chunk(plan)
    if not shown:
        return pictures
    layers, templates = [plan[j] for j in shown[:2]], feature_templates(place_map, shown[0])
    chosen = best_explained(run.reference_features, layers[0], templates)
    pictures |= draw_spectrogram(run, plan, layers[0].features[chosen])
    pictures |= draw_templates(run, layers[0], templates, chosen)
    return pictures | draw_features(run, layers) | draw_activations(run, place_map, shown)


def draw_paper(run: Localization, place_map: TemplateMap) -> plots.Pictures:
    """The autocorrelogram of a feature, and the layers of its chunk; empty for a map without layers."""
    shown = shown_chunk(place_map.plan)
    if not shown:
        return {}
    layer, templates = place_map.plan[shown[0]], feature_templates(place_map, shown[0])
    feature = layer.features[best_explained(run.reference_features, layer, templates)]
    values = run.reference_features[layer.start : layer.stop, feature].cpu()
    layers = [place_map.plan[j] for j in sorted(shown)]
    periods = [float(one.period) for one in layers if feature in one.features]
    pictures = draw_autocorrelogram(values, periods, feature, run.unit)
    return pictures | draw_layers(layers, run.borders, run.unit)


def layers_by_chunk(plan: Plan) -> dict[tuple[int, int], list[int]]:
    """Indices of the layers of each chunk, those with the most features first."""
    chunks = defaultdict(list)
    for j in sorted(range(len(plan)), key=lambda j: -len(plan[j].features)):
        chunks[plan[j].start, plan[j].stop].append(j)
    return chunks


def shown_chunk(plan: Plan) -> list[int]:
    """Indices of the layers of the first longest chunk with two layers, else of the first longest chunk."""
    chunks = layers_by_chunk(plan)
    order = sorted(chunks, key=lambda edges: (len(chunks[edges]) > 1, edges[1] - edges[0], -edges[0]))
    return chunks[order[-1]] if order else []


def feature_templates(place_map: TemplateMap, j: int) -> Tensor:
    """Templates of one layer in the units of the features, (P,F), without trained weights."""
    templates: Tensor = place_map.blocks()[j].detach().cpu()
    if not len(place_map.weights):
        return templates
    return templates / place_map.weights.detach().cpu()[list(place_map.plan[j].features)].clamp(min=1e-6)


def best_explained(values: Tensor, layer: FrequencyLayer, templates: Tensor) -> int:
    """Index in a layer of the feature whose variance the templates explain best: (N,D), (P,F) -> 0..F-1.

    Only the 16 features whose templates vary most are considered.
    """
    candidates = templates.var(0, correction=0).argsort(descending=True, stable=True)[:CANDIDATES]
    columns = torch.tensor(layer.features)[candidates].to(values.device)
    chosen = values[layer.start : layer.stop].index_select(1, columns).cpu().double()
    rest = (chosen - templates[layer.place_phases][:, candidates]).square().sum(0)
    share = 1 - rest / (chosen - chosen.mean(0)).square().sum(0)
    return int(candidates[share.nan_to_num(-1, neginf=-1).argmax()])


def draw_chunks(plan: Plan, borders: Tensor, unit: str) -> plots.Pictures:
    """The chunks of the route and the periods found in each; the wider a bar, the more features."""
    figure, axis = plots.canvas(3.6)
    axis.set(xlim=(0, int(borders[-1])), xlabel=plots.PLACE, ylabel=f"period ({unit})")
    if not plan:
        axis.set(yticks=[])
        axis.text(0.5, 0.5, "no layers: nothing repeats", ha="center", transform=axis.transAxes)
        return plots.picture("chunks", (figure, axis))
    most = max(len(layer.features) for layer in plan)
    chunks = layers_by_chunk(plan)
    for chunk, members in chunks.items():
        first, last = (int(borders[edge]) for edge in chunk)
        for j in members:
            share = len(plan[j].features) / most
            style = {"linewidth": 0.6 + 7 * share, "alpha": 0.35 + 0.65 * share}
            axis.hlines(float(plan[j].period), first, last, color=BLUE, **style)
        for j, along in zip(members if len(chunks) <= plots.LABELLED else (), (0.3, 0.7), strict=False):
            where = first + along * (last - first), float(plan[j].period)
            text = axis.text(*where, f"{where[1]:.4g}", fontsize=9, ha="center", bbox=plots.BOX)
            text.set_va("center_baseline")
    for edge in {edge for chunk in chunks for edge in chunk}:
        axis.axvline(int(borders[edge]), color=plots.GREY, linewidth=0.8, linestyle=":")
    periods = [float(layer.period) for layer in plan]
    plots.period_axis(axis, min(periods) / 1.2, max(periods) * 1.2, unit)
    plots.set_title(axis, f"widest bar: {most} features")
    return plots.picture("chunks", (figure, axis))


def draw_layers(layers: Sequence[FrequencyLayer], borders: Tensor, unit: str) -> plots.Pictures:
    """Layers of one chunk, at most those with the most features, and their phases (figure 2 of the paper)."""
    shown = sorted(sorted(layers, key=lambda layer: -len(layer.features))[:SHOWN], key=lambda p: p.period)
    start, stop = shown[0].start, shown[0].stop
    figure, axis = plots.canvas(0.24 * len(shown) + 1.5)
    phases = torch.stack([layer.place_phases / layer.phases for layer in shown])
    x, y = borders[start : stop + 1] - 0.5, torch.arange(len(shown) + 1) - 0.5
    image = axis.pcolorfast(x.numpy(), y.numpy(), phases.numpy(), cmap="twilight", vmin=0, vmax=1)
    axis.invert_yaxis()
    axis.set_yticks(range(len(shown)), [f"{float(layer.period):.4g}" for layer in shown])
    axis.set(xlabel=plots.PLACE, ylabel=f"period ({unit})")
    plots.set_title(axis, f"phase in {len(shown)} of {len(layers)} layers")
    plots.colour_bar(figure, image, axis, "phase / period")
    return plots.picture("layers", (figure, axis))


def draw_autocorrelogram(values: Tensor, periods: Sequence[float], feature: int, unit: str) -> plots.Pictures:
    """The biased autocorrelation of a feature (N,) minus its mean (figure 1 (c) of the paper)."""
    figure, axis = plots.canvas(3)
    spectrum = torch.fft.rfft(values.double() - values.double().mean(), n=2 * len(values)).abs().square()
    correlation = torch.fft.irfft(spectrum)[: len(values)]
    axis.plot(correlation / correlation[0].clamp(min=1e-30), color=plots.DARK, linewidth=1)
    for period, colour in zip(periods, plots.LAYERS, strict=False):
        lags = [k * period for k in range(1, MARKED) if k * period < len(values)]
        axis.vlines(lags, -1, 1, color=colour, linewidth=0.9, linestyle=":", label=f"multiples of {period:g}")
    axis.set(xlim=(0, len(values)), ylim=(-1, 1.02), xlabel=f"lag ({unit})", ylabel="autocorrelation")
    plots.set_title(axis, f"feature {feature}")
    if periods:
        plots.legend(axis, ncols=2, loc="upper right")
    return plots.picture("autocorrelogram", (figure, axis))


def draw_spectrogram(run: Localization, plan: Plan, feature: int) -> plots.Pictures:
    """One feature along the route and its spectrogram, a column per chunk (figure 3 of the paper).

    Empty for other period finders. If chunks overlap, each column ends at the start of the next.
    """
    analysis, borders = getattr(run.model.mapper, "periods", None), run.borders
    if not isinstance(analysis, SpectrogramAnalysis):
        return {}
    values = run.reference_features[:, feature : feature + 1].cpu()
    spectra = analysis(values)
    figure, axes = plots.canvas(4.4, 2, sharex=True, height_ratios=(1, 1.7))
    above, below = axes
    step = max(1, len(values) // DOTS)
    low, high = (sign * max_pool1d(sign * values.T, step, ceil_mode=True)[0] for sign in (-1, 1))
    above.fill_between(borders[:-1:step], low, high, color=plots.DARK, linewidth=0.4)
    plots.set_title(above, f"feature {feature} along the route")
    above.set(ylabel="value")
    shares = [(power[2:] / power[1:].sum()).nan_to_num() for _, _, power in spectra]
    norm = PowerNorm(0.5, 0, 100 * max(1e-6, *(float(share.max()) for share in shares)))
    ends = [*(spectrum.start for spectrum in spectra[1:]), spectra[-1].stop]
    mesh: Any = None
    for (start, stop, _), share, end in zip(spectra, shares, ends, strict=True):
        left, right = int(borders[start]), int(borders[min(stop, end)])
        between = (stop - start) / (torch.arange(len(share) + 1) + 1.5)  # two bins
        mesh = below.pcolormesh([left, right], between.numpy(), share.numpy() * 100, norm=norm, cmap="Blues")
        for axis in axes:
            axis.axvline(left, color=plots.GREY, linewidth=0.8, linestyle=":")
        for layer in plan:
            if (layer.start, layer.stop) != (start, stop) or feature not in layer.features:
                continue
            at = (left + right) / 2, float(layer.period)
            size = 11 if len(spectra) <= plots.LABELLED else 3
            below.plot(*at, "o", color=plots.LAYERS[0], markersize=size, markerfacecolor="none")
            if len(spectra) <= plots.LABELLED:
                style = {"textcoords": "offset points", "va": "center", "fontsize": 9, "bbox": plots.BOX}
                below.annotate(f"{at[1]:.4g}", at, (10, 0), **style)
    plots.colour_bar(figure, mesh, below, "% of the feature's power")
    longest = max((stop - start) / 1.5 for start, stop, _ in spectra)
    plots.period_axis(below, analysis.min_period, longest, run.unit)
    below.set(xlim=(0, int(borders[-1])), xlabel=plots.PLACE)
    plots.set_title(below, "power at each period; circles: kept")
    return plots.picture("spectrogram", (figure, axes))


def draw_templates(
    run: Localization, layer: FrequencyLayer, templates: Tensor, chosen: int
) -> plots.Pictures:
    """Places of equal phase, averaged into the templates (P,F) of a layer (figure 4 of the paper).

    Convention: of more than 100 cycles every k-th is drawn; of more than 64 features, those that vary most
        from phase to phase. Rows are sorted by the phase of their maximum, and each is scaled from its
        minimum (white) to its maximum (dark).
    """
    figure, (above, below) = plots.canvas(4.8, 2, sharex=True, height_ratios=(1, 1.4))
    period, feature = float(layer.period), layer.features[chosen]
    values = run.reference_features[layer.start : layer.stop, feature].cpu()
    places = torch.arange(layer.start, layer.stop)
    cycle = places * layer.period.denominator // layer.period.numerator
    within = places - cycle.double() * period
    cycles = cycle.unique()
    for one in cycles[:: -(-len(cycles) // CYCLES)]:
        above.plot(within[cycle == one], values[cycle == one], color=plots.GREY, linewidth=0.6, alpha=0.6)
    # phase k covers the places from k to k + 1 phases into their cycle
    phase = (torch.arange(layer.phases) + 0.5) * period / layer.phases - 0.5
    above.plot(phase, templates[:, chosen], color=BLUE, linewidth=2.2)
    thick = "the trained template" if run.model.trained else "their mean"
    plots.set_title(above, f"feature {feature}, {len(cycles)} cycles; thick: {thick}")
    above.set(ylabel="value")
    rows = templates.var(0, correction=0).argsort(descending=True, stable=True)[:ROWS]
    wave = torch.fft.fft(templates[:, rows].double(), dim=0)[1 % layer.phases]
    rows = rows[wave.angle().neg().remainder(2 * math.pi).argsort(stable=True)]
    image = templates[:, rows].T
    low, high = image.amin(1, keepdim=True), image.amax(1, keepdim=True)
    image = (image - low) / (high - low).clamp(min=torch.finfo(image.dtype).tiny)
    extent = (-0.5, period - 0.5, len(rows) - 0.5, -0.5)
    below.imshow(image.numpy(), aspect="auto", extent=extent, cmap="Blues", interpolation="nearest")
    shown = f"{len(rows)} of " * (len(rows) < len(layer.features)) + f"{len(layer.features)} features"
    plots.set_title(below, f"templates of {shown}; dark: highest")
    mark = (rows == chosen).nonzero().flatten().tolist()
    below.set_yticks(mark, [str(feature)] * len(mark))
    below.set(xlabel=f"phase, of a period of {period:.4g} ({run.unit})", ylabel="feature")
    below.set_xlim(-0.5, period - 0.5)
    return plots.picture("templates", (figure, (above, below)), trained=run.model.trained)


def draw_features(run: Localization, layers: Sequence[FrequencyLayer]) -> plots.Pictures:
    """The HOG features of a layer, on a frame of the route (figures 15 and 16); empty for other features.

    Each is drawn as the edge it responds to. The stronger the line, the more of the overlapping blocks have
    this cell and orientation in the layer.
    """
    model, hog = run.model, run.model.features
    if type(hog) is not HOG or hog.cell is None or len(run.reference.frame_shape) != 3:
        return {}
    middle = (layers[0].start + layers[0].stop) // 2
    grey = as_hog_sees(model, frame_at(run.reference, middle)).mean(0)
    if grey.min() < 0 or grey.max() > 1:
        grey = (grey - grey.min()) / (grey.max() - grey.min())
    height, width = grey.shape
    side_by_side = width <= min(1.6 * height, 12 * hog.cell)
    rows, columns = (1, len(layers)) if side_by_side else (len(layers), 1)
    wide = 0.97 * plots.WIDTH / columns
    tall = min(2 * plots.WIDTH, wide * height / width) + 2 * plots.LINE
    figure, axes = plots.canvas(tall * rows, rows, columns, squeeze=False)
    points = 72 * wide * hog.cell / width  # a cell's side
    for axis, layer, colour in zip(axes.flat, layers, plots.LAYERS, strict=False):
        axis.imshow((0.35 + 0.65 * grey).numpy(), cmap="gray", vmin=0, vmax=1)  # pale, below the lines
        layout = hog.orientations, hog.cell, hog.block
        edges, count = edges_seen(torch.tensor(layer.features), (height, width), *layout)
        strength = count / count.max()
        lines = LineCollection(list(edges.numpy()), colors=colour, alpha=(0.3 + 0.7 * strength).tolist())
        lines.set_linewidth((points * (0.02 + 0.07 * strength)).tolist())
        axis.add_collection(lines)
        axis.set_axis_off()
        plots.set_title(axis, f"period {float(layer.period):.4g},\n{len(layer.features)} features")
    return plots.picture("features", (figure, axes), frame=int(run.borders[middle]))


def as_hog_sees(model: DejaVu, frame: Tensor) -> Tensor:
    """A frame (C,H,W) after the model's preprocessing and HOG's own antialiased resize."""
    with torch.no_grad():
        seen: Tensor = model.preprocess(frame[None])
    return resize_frames(seen, getattr(model.features, "resize", None))[0]


def edges_seen(
    features: Tensor, size: tuple[int, int], orientations: int = 9, cell: int = 8, block: int = 2
) -> tuple[Tensor, Tensor]:
    """The edges that HOG features respond to, as line segments, and how many of the features share each.

    Shape: (F,) int64 -> (E,2,2) end points (x, y) in pixels, with (0, 0) in the middle of the first pixel;
        (E,) int64, the number of (overlapping) blocks in which the features have this cell and orientation.

    Convention: an edge is perpendicular to its gradient, through the middle of its cell. Bin o holds
        gradients of about (o + 1/2) * 180 / orientations degrees.
    """
    rows, columns = (max(0, pixels // cell - block + 1) for pixels in size)
    shape = (rows, columns, block, block, orientations)
    row, column, down, right, orientation = torch.unravel_index(features, shape)
    cells = torch.stack([row + down, column + right, orientation], 1)
    distinct, count = cells.unique(dim=0, return_counts=True)
    middle = (distinct[:, :2].flip(1) + 0.5) * cell - 0.5
    angle = (distinct[:, 2] + 0.5) * math.pi / orientations  # of the gradient, from x towards y
    along = torch.stack([-angle.sin(), angle.cos()], 1) * (0.45 * cell)
    return torch.stack([middle - along, middle + along], 1), count


def draw_activations(run: Localization, place_map: TemplateMap, chunk: list[int]) -> plots.Pictures:
    """Scores of one query over a chunk, by two of its layers and by all fused (figure 17 of the paper)."""
    if len(chunk) < 2:
        return {}
    plan, chosen = place_map.plan, chunk[:2]
    layers = [plan[j] for j in chosen]
    start, stop = layers[0].start, layers[0].stop
    query, places = run.example_query(start, stop)
    one = run.query_features[query : query + 1]
    scores = [layer_distances(place_map, one, j)[0, plan[j].place_phases] for j in chosen]
    scores.append(run.scores(torch.tensor([query]))[0, start:stop])
    titles = [f"period {float(layer.period):.4g}, {len(layer.features)} features" for layer in layers]
    titles.append("all layers fused")
    numbers: Facts = {}
    if run.truth is not None:
        found = run.query_features, run.scored.index
        rates = activation_rates(place_map, chosen, *found, run.truth, run.tolerance)
        titles = [f"{title}:\n{rate.describe()}" for title, rate in zip(titles, rates, strict=True)]
        *alone, fused = (rate._asdict() for rate in rates)
        numbers = {"start": start, "stop": stop, "layers": alone, "fused": fused}
    curves = list(zip(titles, scores, (*plots.LAYERS, BLUE), strict=True))
    strip = slit_scan(source_of(run.reference), int(run.borders[start]), int(run.borders[stop]))
    plot = plot_answers(run, query, (start, stop), places, curves, strip)
    facts = {"layers": len(chunk), "within": f"{run.tolerance} {run.unit}", "rates": numbers}
    return plots.picture("activations", plot, numbers, **facts)


def slit_scan(traverse: Traverse, start: int, stop: int) -> Tensor | None:
    """The middle column of each of the frames [start, stop): (C,H,stop - start); None for ready features."""
    if len(traverse.frame_shape) == 1:
        return None
    # clones, as a view would keep the whole frames
    part = Part(traverse, range(start, stop))
    columns = [batch[..., batch.shape[-1] // 2].clone() for batch in part.batches()]
    return torch.cat(columns).permute(1, 2, 0).float() if columns else None
