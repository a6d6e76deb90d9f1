"""Scores over route bytes: the map, its null control, and keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from dejavu_torch.evaluation.baselines import INTERPOLATES, as_int8, interpolated, nearest_frames
from dejavu_torch.evaluation.contenders import evaluate_each
from dejavu_torch.evaluation.controls import shuffled, with_mapper
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.score_plots import Stored
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import from_lines, lines_of
from dejavu_torch.recognition.scorer import Reordered
from dejavu_torch.text import with_progress
from dejavu_torch.types import InputError, Match

BUDGETS = (1.0, 2.5, 5.0, 10.0, 20.0)  # route bytes per place


def coded_at_sizes(
    run: Localization, budgets: Sequence[float] = BUDGETS, seed: int = 0, progress: bool = False
) -> dict[str, list[Stored]]:
    """Code the run's descriptors at several budgets, and evaluate each with the run's queries.

    Args:
        budgets: route bytes per place. seed: for shuffling the null control.

    Returns:
        For `map`, `null` and `interpolated`, one entry for each budget that can be met, in their order.

    Raises:
        InputError: the map is not spectral, or there is no ground truth.
    """
    # without a filter for each size
    matching = run.matching._replace(also={}) if run.sequence is None else run.matching
    queries = run.query_features if run.sequence is None else run.causal_features
    run = run._replace(matching=matching, query_features=run.query_features if queries is None else queries)
    place_map = run.model.map
    if not isinstance(place_map, SpectralMap) or run.truth is None:
        truth = "no" if run.truth is None else "a"
        seen = f"a storage curve got a map of kind {place_map.kind!r} and {truth} ground truth"
        raise InputError(f"{seen}; expected a spectral map and a ground truth")
    features = run.reference_features
    order, mixed = shuffled(features, seed)
    kinds = {
        "map": partial(_coded, run, place_map, features, resolution=place_map.resolution),
        "null": partial(_coded, run, place_map, mixed, order=order),
        "interpolated": partial(_keyframes, run, place_map),
    }
    found: dict[str, list[Stored]] = {key: [] for key in kinds}
    if not INTERPOLATES[place_map.layout.dimensions]:
        del kinds["interpolated"]
    cases = [(key, budget) for key in kinds for budget in budgets]
    for key, budget in with_progress(cases, "storage", progress):
        for answers, size in kinds[key](budget):
            answers = answers.renumbered(place_map.table.scored)
            scores = evaluate(answers, run.truth, run.tolerance)
            sequences = evaluate_each(answers.sequences, run.truth, run.tolerance)
            found[key].append(Stored(size / place_map.places, scores.auc, scores.recall_at_1, sequences))
    return found


def noise_over_map(place_map: SpectralMap, features: Tensor, seed: int = 0) -> float:
    """Bytes of noise as smooth as the map's route or area, of one chunk, coded in its steps, divided by those
    of the map.

    The noise is Gaussian with the spectrum of each descriptor dimension, averaged over half octaves, so that
    nothing in it repeats. The difference is an upper bound of what the map saves by repetition: a trend, or a
    segment with less energy than others, saves bytes too. All other savings come from smoothness.
    """
    (_, columns), *_ = place_map.layout.sizes(place_map.chunk)
    lines = lines_of((features.float() - place_map.means[0].float()).T, columns, place_map.transform)
    band = (2 * torch.arange(1, lines.shape[1] + 1, device=lines.device).float().log2()).long()
    sums = lines.new_zeros(len(lines), int(band[-1]) + 1).index_add(1, band, lines.square())
    energy = (sums / band.bincount().clamp(min=1))[:, band]
    normal = torch.randn(lines.shape, dtype=torch.float32, generator=torch.Generator().manual_seed(seed))
    noise = from_lines(energy.sqrt() * normal.to(energy), columns, place_map.transform).T
    settings = place_map.chunk, place_map.transform, place_map.metric, place_map.resolution
    mapper = SpectralMapper(None, float(place_map.steps.mean()), *settings)
    coded = mapper(noise + place_map.means[0].float(), place_map.layout)
    packed = [one.packed() for one in (coded, place_map)]
    taken = [one["streams"].nbytes + one["means"].nbytes for one in packed]
    return taken[0] / taken[1]


def _coded(
    run: Localization,
    place_map: SpectralMap,
    features: Tensor,
    budget: float,
    order: Tensor | None = None,
    resolution: float = 0.0,
) -> Iterator[tuple[Match, int]]:
    """The matches on a map of about this budget, and its bytes; empty if no map can meet it."""
    mapper = SpectralMapper(budget, None, place_map.chunk, place_map.transform, place_map.metric, resolution)
    model = with_mapper(run.model, mapper)
    try:
        model.learn_features(features, layout=place_map.layout)
    except InputError:  # more than floats, or less than the mean
        return
    wrapped = None if order is None else partial(Reordered, order=order)
    found = model.localize_descriptors(run.query_features, run.matching, wrapped)
    packed = model.map.packed()  # of which no answer needs the digest
    yield found, sum(tensor.nbytes for name, tensor in packed.items() if name != "digest")


def _keyframes(run: Localization, place_map: SpectralMap, budget: float) -> Iterator[tuple[Match, int]]:
    """The matches among interpolated keyframes of at most this budget, and their bytes."""
    between, _, keys = interpolated(as_int8(run.reference_features), budget * place_map.places)
    size = keys * place_map.dimension
    if size <= budget * place_map.places:
        yield nearest_frames(between, run.query_features, 1, place_map.metric, matching=run.matching), size
