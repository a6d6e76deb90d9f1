"""Controls: do the scores come from repetition along the route, or from something else?"""

from __future__ import annotations

import copy
import logging
from functools import partial

import torch
from torch import Tensor

from dejavu_torch.maps.distance import Metric, phase_distances
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.template_map import TemplateMap, log_posterior
from dejavu_torch.maps.templates import PhaseTemplates
from dejavu_torch.memory import concatenate
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.scorer import Reordered
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import FrequencyLayer, InputError, Match, SequenceModel


def with_mapper(model: DejaVu, mapper: Mapper) -> DejaVu:
    """A model without a map for descriptors that are already whitened: the other's settings, this mapper."""
    return DejaVu(**model.settings() | {"mapper": mapper, "whitening": "none"})


def template_map_of(model: DejaVu, what: str) -> TemplateMap:
    """The model's map; an InputError if it is not a template map."""
    if not isinstance(model.map, TemplateMap):
        raise InputError(f"{what} needs a template map; got a map of kind {model.map.kind!r}")
    return model.map


def null_control(
    model: DejaVu,
    reference: Tensor,
    query: Tensor,
    seed: int = 0,
    same_plan: bool = False,
    sequence: Matching | SequenceModel | None = None,
    progress: bool = False,
) -> Match:
    """Matches of a map learned from the reference in shuffled order, see `null_map`.

    Args:
        reference: (N,D) features. query: (Q,D) features.
        sequence: as in `DejaVu.localize`. progress: show progress on stderr.

    Returns:
        Match of (Q,) whose index is the reference frame *stored* at the reported place, or -1.
    """
    null, order = null_map(model, reference, seed, same_plan)
    return null.localize_descriptors(query, sequence, partial(Reordered, order=order), progress)


def null_map(
    model: DejaVu, reference: Tensor, seed: int = 0, same_plan: bool = False
) -> tuple[DejaVu, Tensor]:
    """A model with a map of the reference (N,D) in shuffled order, and this order (N,).

    Nothing repeats in time, so its right answers do not come from periods, but from templates that hold
    few frames each, as in any store of frames.

    Args:
        same_plan: keep the layers of the model's template map and learn only the templates. Otherwise
            the periods are searched again too; a finder that tests them finds none in noise.
    """
    order, mixed = shuffled(reference, seed)
    mapper = model.mapper
    if isinstance(model.map, SpectralMap):  # as many bytes as the map
        mapper = SpectralMapper.of_equal_size(model.map)
    null = with_mapper(model, mapper)
    if same_plan:
        null.map = _same_layers(template_map_of(model, "the null of the same layers"), mixed)
    else:
        log, level = logging.getLogger("dejavu_torch"), logging.getLogger("dejavu_torch").level
        log.setLevel(logging.ERROR)  # warnings about the null would confuse the user
        try:
            null.learn_features(mixed, layout=model.map.layout)
        finally:
            log.setLevel(level)
    return null, order


def shuffled(reference: Tensor, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A random order (N,), and the descriptors (N,D) in it."""
    order = torch.randperm(len(reference), generator=torch.Generator().manual_seed(seed))
    rows = (reference[part] for part in order.to(reference.device).split(256))
    return order, concatenate(rows, len(order))


def _same_layers(place_map: TemplateMap, features: Tensor) -> TemplateMap:
    """A map with the same layers and settings, and the phase means of other features."""
    null = copy.deepcopy(place_map)
    null.freeze()
    null.positions = null.positions[:0]
    templates = PhaseTemplates()(null.weighted(features), null.plan)
    if templates:
        null.templates = torch.cat([block.flatten() for block in templates])
    return null


def leave_out_match(model: DejaVu, reference: Tensor, width: int = 0) -> Match:
    """The reference localized on its own map, without the frames within `width` of the query in any mean.

    This is a diagnostic and does not replace a second traverse. A query that is its own reference is part of
    its template's mean; on sliding footage width = 0 is not enough, since the neighbours carry the answer.

    Args:
        reference: (N,D), the features the map was learned from.
        width: w, frames to each side.

    Returns:
        Match of (N,). A phase without remaining frames scores +inf at its places.

    Raises:
        InputError: a width below 0, features of another shape than the map's, or a map whose templates are
            not their means (another kind, or trained).
    """
    place_map = template_map_of(model, "leave_out")
    if width < 0 or tuple(reference.shape) != (place_map.places, place_map.dimension):
        raise InputError(
            f"leave-out got width {width} and features {tuple(reference.shape)}; "
            f"expected width >= 0 and ({place_map.places}, {place_map.dimension})"
        )
    width = min(width, place_map.places)  # all frames
    if model.trained is not None:
        raise InputError("leave-out got trained templates, which are not means; expected an untrained map")
    if not place_map.plan:
        return model.localize(reference)
    matches, reference = [], place_map.weighted(reference)
    layers = list(zip(place_map.plan, place_map.blocks(), place_map.layer_features(), strict=True))
    with torch.no_grad():
        for frames in torch.arange(len(reference), device=reference.device).split(256):
            first = max(0, int(frames[0]) - width)
            rows = reference[first : int(frames[-1]) + width + 1]  # of the queries and windows
            distances = [
                _distances_without(
                    rows.index_select(1, i), first, layer, block, frames, width, place_map.metric
                )
                for layer, block, i in layers
            ]
            scores = place_map.combine(distances)
            if place_map.temperature is not None:
                scores = log_posterior(scores, place_map.temperature)
            matches.append(best_match(scores, model.threshold).map(Tensor.cpu))
    return Match.joined(matches)


def _distances_without(
    rows: Tensor, first: int, layer: FrequencyLayer, block: Tensor, frames: Tensor, width: int, metric: Metric
) -> Tensor:
    """Phase distances (B,P) of the queries `frames`, without the frames within `width` of each in the means.

    Shape: rows (n,F), of the frames from `first` on.
    """
    near = frames[:, None] + torch.arange(-width, width + 1, device=frames.device)  # (B,K)
    inside = (near >= layer.start) & (near < layer.stop)
    near = near.clamp(first, first + len(rows) - 1)
    phase = layer.phase(near)
    # frames of the window with the same phase are removed from its mean together
    same = (phase[:, :, None] == phase[:, None, :]) & inside[:, None, :]
    removed = same.to(rows.dtype) @ rows[near - first]  # (B,K,F)
    count = torch.bincount(layer.place_phases, minlength=layer.phases).to(frames.device)[phase]
    left = count - same.sum(2)
    mean = (block[phase] * count[..., None] - removed) / left.clamp(min=1)[..., None]
    queries = rows[frames - first]
    pairs = zip(queries.split(1), mean, strict=True)
    distance = torch.cat([phase_distances(query, means, metric) for query, means in pairs])
    distance = torch.where(left > 0, distance, torch.inf)
    table = phase_distances(queries, block, metric)
    row = torch.arange(len(frames), device=frames.device)[:, None].expand_as(phase)
    table[row[inside], phase[inside]] = distance[inside]
    return table
