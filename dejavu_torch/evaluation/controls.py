"""Controls: does the figure come from what repeats, or from something else?"""

from __future__ import annotations

import torch
from torch import Tensor

from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.distance import Metric, phase_distances
from dejavu_torch.database.scores import combine_layers, log_posterior
from dejavu_torch.features.memory import concatenate
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import FrequencyLayer, InputError, Match


def same_settings(model: DejaVu) -> DejaVu:
    """A model with the settings of another and no map."""
    matcher = model.matcher
    return DejaVu(
        model.features,
        model.periods,
        matcher.metric,
        matcher.reduction,
        model.threshold,
        model.batch_size,
        model.preprocess,
        model.velocity,
        matcher.temperature,
    )


def null_control(
    model: DejaVu,
    reference: Tensor,
    query: Tensor,
    seed: int = 0,
    same_plan: bool = False,
    progress: bool = False,
) -> Match:
    """Matches of a map learnt from the reference in shuffled order.

    Nothing repeats in time any more, so what such a map still recognises does not come from periods
    but from templates that hold few frames each, as any store of frames does.

    Args:
        reference: (N,D) features. query: (Q,D) features.
        same_plan: keep the layers of the model and learn only the templates anew. Otherwise the periods
            are sought anew too; the default preset then finds none, since shuffled frames are noise
            in time, and reports nothing.
        progress: show a progress bar on a terminal.

    Returns:
        Match of (Q,) whose index is the reference frame *stored* at the reported place; -1 where
        the map reports nothing.
    """
    order = torch.randperm(len(reference), generator=torch.Generator().manual_seed(seed))
    parts = order.to(reference.device).split(256)
    shuffled, null = concatenate(reference[part] for part in parts), same_settings(model)
    if same_plan:
        plan, weights = model.map.plan, model.map.weights if len(model.map.weights) else None
        templates = null.templates(model.map.weighted(shuffled), plan)
        null.map = CompressedMap(plan, templates, len(order), shuffled.shape[1], weights=weights)
        null.map.to(shuffled.device)
    else:
        null.learn_features(shuffled)
    match = null.localize(query, progress)
    return match._replace(index=torch.where(match.index >= 0, order[match.index], -1))


def leave_out_match(model: DejaVu, reference: Tensor, width: int = 0) -> Match:
    """The reference localised on its own map, all frames within `width` of the query taken out of every mean.

    A diagnostic, never instead of a second traverse: a query that is its own reference stands in its
    template's mean. On sliding footage width = 0 cures nothing, the neighbours carry the answer.

    Args:
        reference: (N,D), the features the map was learnt from.
        width: w, frames to each side.

    Returns:
        Match of (N,). A phase left without frames scores +inf at its places.
    """
    if width < 0 or tuple(reference.shape) != (model.map.places, model.map.dimension):
        raise InputError(
            f"leave-out got width {width} and features {tuple(reference.shape)}; "
            f"expected width >= 0 and ({model.map.places}, {model.map.dimension})"
        )
    if model.trained is not None:
        raise InputError("leave-out got trained templates, no means; expected a map that was learnt")
    plan, blocks, matcher = model.map.plan, model.map.blocks(), model.matcher
    if not plan:
        return model.localize(reference)
    matches, reference = [], model.map.weighted(reference)
    with torch.no_grad():
        for frames in torch.arange(len(reference), device=reference.device).split(256):
            distances = [
                _distances_without(reference[:, index], layer, block, frames, width, matcher.metric)
                for layer, block, index in zip(plan, blocks, model.map.layer_features(), strict=True)
            ]
            scores = combine_layers(distances, plan, len(reference), matcher.metric, matcher.reduction)
            if matcher.temperature is not None:
                scores = log_posterior(scores, matcher.temperature)
            match = best_match(scores, model.threshold)
            matches.append(Match(*(column.cpu() for column in match)))
    return Match(*(torch.cat(column) for column in zip(*matches, strict=True)))


def _distances_without(
    values: Tensor, layer: FrequencyLayer, block: Tensor, frames: Tensor, width: int, metric: Metric
) -> Tensor:
    """Phase distances of the queries `frames`, each without the frames within `width` of it: (B,P)."""
    near = frames[:, None] + torch.arange(-width, width + 1, device=frames.device)  # (B,K)
    inside = (near >= layer.start) & (near < layer.stop)
    near = near.clamp(0, len(values) - 1)
    phase = layer.phase(near)
    # frames of the window that share a phase leave its mean together
    together = (phase[:, :, None] == phase[:, None, :]) & inside[:, None, :]
    taken = together.to(values.dtype) @ values[near]  # (B,K,F)
    count = torch.bincount(layer.place_phases, minlength=layer.phases).to(frames.device)[phase]
    left = count - together.sum(2)
    mean = (block[phase] * count[..., None] - taken) / left.clamp(min=1)[..., None]
    rows = zip(values[frames].split(1), mean, strict=True)
    distance = torch.cat([phase_distances(query, means, metric) for query, means in rows])
    distance = torch.where(left > 0, distance, torch.inf)
    table = phase_distances(values[frames], block, metric)
    row = torch.arange(len(frames), device=frames.device)[:, None].expand_as(phase)
    table[row[inside], phase[inside]] = distance[inside]
    return table
