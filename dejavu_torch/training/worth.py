"""What a trained map is worth on frames that training has not seen, beside what needs no training."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping

from dejavu_torch.data.fitted import fitted
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.baselines import hog_baselines
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.localizer import SINGLE
from dejavu_torch.types import InputError, Match, Traverse

log = logging.getLogger("dejavu_torch")

TRAINED, HOG, UNTRAINED = "the trained map", "HOG of all frames", "the untrained map"


def beside_untrained(
    model: DejaVu, reference: Traverse, query: Traverse, truth: GroundTruth, tolerance: int
) -> dict[str, Scores]:
    """Scores of a trained map, of HOG of all frames, and of the spectral map of whitened HOG.

    The untrained map is that of `DejaVu()`, by the model's own mapper where this is not of templates: of as
    many route bytes. What cannot be made of these frames is left out, with a warning.

    Args:
        model: with its map, on any device. reference, query: resampled where the model is.
        truth: the places of the queries. tolerance: places within which one is right.

    Returns:
        By name, the trained map first; nothing where no query has a known place.
    """
    if len(query.frame_shape) == 3:
        query = fitted(query, reference.frame_shape)
    trained = fitted(query, model.frame_shape or ()) if len(query.frame_shape) == 3 else query
    found = {TRAINED: _match(model, trained)}
    hog = hog_baselines(reference, query, model.batch_size, tolerance)
    found |= {HOG: hog["hog"].found} if hog else {}
    mapper = None if isinstance(model.mapper, TemplateMapper) else copy.deepcopy(model.mapper)
    try:
        preprocess = Preprocess(size=model.preprocess.size)
        untrained = DejaVu(mapper=mapper, batch_size=model.batch_size, preprocess=preprocess)
        reference = untrained.fit(reference)
        untrained.learn(reference)
        if len(query.frame_shape) == 3:
            query = fitted(query, reference.frame_shape)
        found[UNTRAINED] = _match(untrained, query)
    except InputError as error:
        log.warning("no untrained map to compare with: %s", error)
    scores = {name: contend(name, match, truth, tolerance).scores for name, match in found.items()}
    return {name: one for name, one in scores.items() if one is not None}


def better(scores: Mapping[str, Scores]) -> list[str]:
    """Names of what has a larger AUC than the first of them.

    Example:
        >>> from types import SimpleNamespace as S
        >>> better({"the trained map": S(auc=0.5), "HOG": S(auc=0.7), "the untrained map": S(auc=0.4)})
        ['HOG']
    """
    (_, first), *others = scores.items()
    return [name for name, one in others if one.auc > first.auc]


def _match(model: DejaVu, query: Traverse) -> Match:
    return model.localize_descriptors(model.extract_all(query), SINGLE).renumbered(model.map.table.scored)
