"""Maps that grow: places appended, further visits averaged in, and maps of several routes merged."""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from itertools import count

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.arrays import as_traverse
from dejavu_torch.data.frame_range import chained
from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.data.names import names_of
from dejavu_torch.data.positions import positions_behind
from dejavu_torch.features.views import Views
from dejavu_torch.learning import (
    Checkpoint,
    ChunkCoder,
    Code,
    append_places,
    observation_counts,
    positions_of,
    with_visits,
)
from dejavu_torch.maps.file import checksums, digests
from dejavu_torch.maps.frame_table import FrameTable
from dejavu_torch.maps.spectral import HALF, SpectralMapper, code_chunk
from dejavu_torch.maps.spectral_map import LARGEST, Chunk, SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import Recipe, difference, recipe_of, run_key, weights_of
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

EXACT = 2**24  # places whose positions float32 tells apart
FAR = 0.1  # from one share of a variance to another that is told


@torch.no_grad()
def append(
    model: DejaVu,
    traverse: Traverse | Tensor,
    progress: bool = False,
    checkpoint: Checkpoint | None = None,
    code: Code = ChunkCoder.chunks,
    visits: Views | None = None,
) -> DejaVu:
    """Add the places of a traverse after those of a model's map, which stay as they are.

    Args:
        model: its map is spectral, and of one route.
        traverse: frames like the map's. If the map's places are even steps along the ground it is resampled
            likewise, and its first frame is the next place.
        progress, checkpoint, code: see `DejaVu.learn`.
        visits: frames of another traverse of its places, averaged in before the coding, see `learn_mean`.

    Returns:
        The model, in eval mode, without a calibration, which was of fewer places. What is refused leaves it
        as it was.

    Convention: whitening, mean and step stay. If the map's places are a multiple of `chunk`, its file is,
        byte for byte, that of all places learned at once with these. One chunk of descriptors is in memory
        at a time.

    Raises:
        InputError: a map that cannot grow, or a traverse that does not fit it.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> wave = torch.sin(torch.arange(600.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> model = DejaVu(mapper=SpectralMapper(chunk=200)).learn(wave[:400])
        >>> append(model, wave[400:]).localize(wave[[50, 450]]).index
        tensor([ 50, 450])
    """
    route = one_route(model, "append to")
    added = model.resample(as_traverse(traverse), model.step, progress, model.frame_shape)
    _check_alike(model, added)
    places = added.count()
    positions = positions_of(added).to(route.positions.device)
    _check_count(route.places + places, model.step is not None)
    counts = None
    if visits is not None:
        _check_alike(model, visits.traverse)
        counts = observation_counts(visits, places)
    grown = copy.deepcopy(route)
    grown.positions = route.positions[:0]  # those of all places follow when all are there
    if checkpoint is not None:
        own = digests(base=checksums(route.packed(), route.get_extra_state()))
        checkpoint.open(run_key(model, added, visits=visits) | own, added, grown, model.whitening)
    text = "learning" if progress else None
    append_places(grown, model.describer, added, route.places, visits, text, checkpoint, code)
    if counts is not None:
        before = grown.visit_counts
        grown.count_visits(before + F.pad(counts.to(before), (route.places, 0)))
    if len(positions):
        grown.positions = torch.cat([route.positions, positions_behind(positions, route.places)])
    grown.check()
    _tell_held(route, grown, getattr(model.mapper, "hold", None))
    frames = len(positions) or places
    names = [model.frame_names, names_of(source_of(added), frames)]
    model.frame_names = _joined_names(names, [route.table.frames, frames])
    return model.replace_map(grown)


def _tell_held(before: SpectralMap, grown: SpectralMap, hold: float | None) -> None:
    """Say what share of their variance appended places hold in the map's step, if that is unlike before.

    Args:
        hold: of the mapper. A file does not tell what its places hold; without `hold` under half is told.
    """
    energy, error = grown.energy - before.energy, grown.error - before.error
    if energy <= 0:  # they are like the mean
        return
    held = 1 - error / energy
    usual = hold if before.held is None and not before.resolution else before.held
    far = held < HALF if usual is None else abs(held - usual) > FAR
    if far:
        log.warning(
            "the %d places behind hold %.2g of their variance in the map's step%s",
            *(grown.places - before.places, held, "" if usual is None else f", those before {usual:.2g}"),
        )


def learn_mean(
    model: DejaVu,
    traverse: Traverse | Tensor,
    visits: Views,
    progress: bool = False,
    second: Views | None = None,
    checkpoint: Checkpoint | None = None,
    code: Code = ChunkCoder.chunks,
) -> DejaVu:
    """As `DejaVu.learn`, of the mean of several visits to each place: what changes between them cancels out.

    Args:
        visits: frames of another traverse and the places that they show, as `associate` finds them. A place
            that k of them show is the mean of k + 1 descriptors, as `map.visit_counts` tells.
        traverse, progress, second, checkpoint, code: see `DejaVu.learn`. Whitening learns from these, not
            from `visits`.

    Raises:
        InputError: as `DejaVu.learn`, a mapper of templates, which are means already, or visits that do not
            fit.

    Example:
        >>> wave = torch.sin(torch.arange(200.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> again = Views(as_traverse(wave[50:] + 0.1), torch.arange(50, 200))
        >>> learn_mean(DejaVu(whitening="none"), wave, again).map.visits
        tensor([[ 50,   1],
                [150,   2]], dtype=torch.int32)
    """
    if not isinstance(model.mapper, SpectralMapper):
        seen = f"{type(model.mapper).__name__} makes templates, which are means of many places already"
        raise InputError(f"{seen}; expected a SpectralMapper to average visits for")
    return model.learn(traverse, progress, second, checkpoint, code, visits)


@torch.no_grad()
def average(model: DejaVu, visits: Views, progress: bool = False) -> int:
    """Average another visit into a map: decoded, averaged and coded again at the same step.

    A chunk that no frame shows stays as it is. `learn_mean` of the traverses makes a better map, as it
    averages what the coding left out, too.

    Args:
        model: its map is spectral; the calibration, which is of the map before, is removed. visits: as
            `associate` finds them. progress: show a progress bar on a terminal.

    Returns:
        How many places are the mean of more visits than before.

    Raises:
        InputError: no spectral map of one route, or visits that do not fit.
    """
    route = one_route(model, "average visits into")
    _check_alike(model, visits.traverse)
    counts, seen = route.visit_counts.cpu(), observation_counts(visits, route.places)
    described, shown = model.describer.visits(visits, "averaging" if progress else None)

    def averaged(g: int, chunk: Chunk) -> Chunk:
        start, stop = route.chunks[g]
        inside = ((shown >= start) & (shown < stop)).nonzero()[:, 0]
        if not len(inside):
            return chunk
        rows = described[inside].to(route.means.device)
        means = with_visits(route.decode(g), counts[start:stop], rows, shown[inside] - start)
        return code_chunk(means, route.means[0], chunk.step, route.transform, route.resolution)

    made = route.of_chunks(averaged(g, chunk) for g, chunk in enumerate(route.coded()))
    made.positions = route.positions
    made.count_visits((counts + seen).to(route.visits.device))
    made.check()
    model.replace_map(made)
    return int((seen > 0).sum())


def associate(model: DejaVu, reference: Traverse | None, second: Traverse, truth: str | None = None) -> Views:
    """Which places of a reference, or of a map, another traverse shows; resampled as these are.

    Args:
        reference: as `DejaVu.resample` gives it; None is the model's map, of one route.
        truth: which frames of the reference it shows, see `find_ground_truth`; None, of one that is as
            long: frame i is place i. Of several for one frame the first counts; frames that show none are
            left out.

    Raises:
        InputError: nothing says which places it shows, or it shows none.
    """
    if reference is None:
        table, shape, step = one_route(model, "average visits into").table, model.frame_shape, model.step
    else:
        table = FrameTable(reference.count(), positions_of(reference))
        shape = model.fit(reference, model.frame_shape if model.map.places else None).frame_shape
        step = getattr(reference, "step", None)
    name = "the map" if reference is None else reference.name
    second = model.resample(second, step, shape=shape)
    shown, source = second.count(), None if reference is None else source_of(reference)
    numbers = second.frame if isinstance(second, ResampledTraverse) else shown
    found = find_ground_truth(
        truth, source, source_of(second), table.frames, numbers, resampled=step is not None, aligned=True
    )
    if found is not None:
        places = table.place_of(found.positives[:, 0])
    elif reference is None and step is None and table.frames == shown:
        places = torch.arange(shown)
    else:
        steps = " at even steps" if step is not None else ""
        raise InputError(
            f"{second.name} has {shown} frames and {name} {table.frames}{steps}; expected as many, frame i "
            "being place i, or a truth that says which places it shows"
        )
    if not (places >= 0).any():
        raise InputError(f"no frame of {second.name} shows a place of {name}; expected some")
    return Views(second, places)


def second_traverse(
    model: DejaVu,
    reference: Traverse,
    second: Traverse | Sequence[Traverse],
    truth: str | Sequence[str | None] | None = None,
) -> Views:
    """As `associate`, for the whitening to learn from; of several, with a truth for each or one for all.

    Raises:
        InputError: no whitening that could learn from it, truths of another number, traverses with frames of
            other sizes, or as `associate`.
    """
    visits = [second] if isinstance(second, Traverse) else [*second]
    model.describer.require_learning(" + ".join(one.name for one in visits))
    truths = [truth] if isinstance(truth, str | None) else [*truth]
    truths *= len(visits) if len(truths) == 1 else 1
    if len(truths) != len(visits):
        seen = f"{len(visits)} further traverses and {len(truths)} truths"
        raise InputError(f"{seen}; expected one for each, or one for all")
    views = [associate(model, reference, *pair) for pair in zip(visits, truths, strict=True)]
    return Views(chained([one.traverse for one in views]), torch.cat([one.places for one in views]))


def calibrate_if_possible(
    model: DejaVu,
    reference: Traverse,
    views: Views | None = None,
    places: Tensor | None = None,
    progress: bool = False,
) -> None:
    """As `DejaVu.calibrate`; without views a map is left as it is if it is calibrated, or cannot be by its
    reference."""
    if views is not None:
        model.calibrate(reference, views, progress=progress)
    elif model.calibration is None and len(reference.frame_shape) == 3 and model.map.summary().covered:
        try:
            model.calibrate(reference, None, places, progress)
        except InputError as error:
            log.warning("the map is not calibrated: %s", error)


def one_route(model: DejaVu, verb: str) -> SpectralMap:
    """The map of a model, which can change.

    Raises:
        InputError: no map, one of another kind, or one of several routes.
    """
    model.require_map(f" to {verb}")
    route = model.map
    if route.routes:
        names = ", ".join(one.name for one in route.routes)
        seen = f"the map is merged of the routes {names}"
        raise InputError(f"{seen}; expected to {verb} the map of a route, and to merge it")
    if not isinstance(route, SpectralMap):
        seen = f"there is a map of kind {route.kind!r}; expected one of kind {SpectralMap.kind!r} to {verb}"
        raise InputError(f"{seen}, or to learn the route anew")
    return route


def merge(models: Sequence[DejaVu], names: Sequence[str]) -> DejaVu:
    """Join the maps of several routes that describe frames alike: the places of all, route after route.

    Args:
        models: with spectral maps, or merged ones, whose routes count one by one. They stay as they are; the
            modules that make descriptors are the first's.
        names: of the maps' routes; those of merged maps have their own. One that is there already gets a
            number: "route", "route-2".

    Returns:
        A model whose `map.routes` are the routes, each with the scores of its own map. A threshold is kept if
        all have it. Calibration and precision, which hold for one route, are not; a warning says so.

    Raises:
        InputError: fewer than two models, one without a map or of another kind, or models that differ in what
            makes their descriptors, in metric or in the steps of resampled places, naming it.

    Example:
        >>> waves = torch.sin(torch.arange(400.0)[:, None] * torch.tensor([0.1, 0.23, 0.37])).split(200)
        >>> models = [DejaVu(whitening="none").learn(wave) for wave in waves]
        >>> merge(models, ["out", "back"]).map.routes
        (Route(name='out', places=200, frames=200), Route(name='back', places=200, frames=200))
    """
    if len(models) < 2 or len(names) != len(models):
        seen = f"{len(models)} maps and {len(names)} names to merge"
        raise InputError(f"{seen}; expected at least two maps, and a name for each")
    first, parts = models[0], dict[str, SpectralMap]()
    for name, model in zip(names, models, strict=True):
        route = model.map
        if not isinstance(route, SpectralMap) or not route.places:
            seen = f"a map of kind {route.kind!r}" if route.places else "no map"
            raise InputError(f"{name} is {seen}; expected one of kind {SpectralMap.kind!r} to merge")
        if problem := _unlike(first, model):
            raise InputError(f"{names[0]} and {name} cannot be merged: {problem}")
        own = [(one.name, route.part(one.name)) for one in route.routes] or [(name, route)]
        for wanted, part in own:
            parts[_another(wanted, parts)] = part
    _check_count(sum(part.places for part in parts.values()), first.step is not None)
    thresholds = {model.threshold for model in models}
    merged = DejaVu(
        **first.settings()
        | {"weight_bits": 32, "precision": None}
        | {"threshold": first.threshold if len(thresholds) == 1 else None}
    )
    merged.weight_bits = first.weight_bits
    merged.frame_shape, merged.step = first.frame_shape, first.step
    merged.trained = first.trained if all(model.trained == first.trained for model in models) else None
    frames = [model.map.table.frames for model in models]
    merged.frame_names = _joined_names([model.frame_names for model in models], frames)
    lost = [
        *["thresholds"] * (len(thresholds) > 1),
        *["calibration"] * any(model.calibration is not None for model in models),
        *["precision"] * any(model.precision is not None for model in models),
    ]
    if lost:
        log.warning(
            "the merged map has no %s: each holds only for the route it was made for", ", ".join(lost)
        )
    return merged.replace_map(SpectralMap.merged([*parts.values()], [*parts]))


def _another(name: str, known: dict[str, SpectralMap]) -> str:
    """The name itself, or with the first free number after it."""
    return name if name not in known else next(f"{name}-{i}" for i in count(2) if f"{name}-{i}" not in known)


def _unlike(first: DejaVu, other: DejaVu) -> str:
    """What of two models makes other descriptors, or other scores, in words; "" if nothing does."""
    for what in ("preprocess", "features", "whitening", "velocity"):
        parts = (getattr(model, what) for model in (first, other))
        stored, given = (Recipe(f"no {what}", {}) if part is None else recipe_of(part) for part in parts)
        if stored != given:
            return f"their {what} differ: {difference(stored, given)}"
        if checksums(weights_of(first, what), None) != checksums(weights_of(other, what), None):
            way = "--whitening" if what == "whitening" else "--descriptor"
            learned = f"as `dejavu learn ROUTE {way} MAP` takes it from another map"
            return f"their {what} were learned apart, with other numbers; expected the same, {learned}"
    own, theirs = first.map.settings(), other.map.settings()
    for what, mine, yours in (
        ("metric", own["metric"], theirs["metric"]),
        ("transform", own["transform"], theirs["transform"]),
        ("dimensions of a descriptor", first.map.dimension, other.map.dimension),
        ("steps between places, in pixels of ground,", first.step, other.step),
    ):
        if mine != yours:
            way = f", as --velocity.step {mine:g} makes" if isinstance(mine, float) else ""
            return f"their {what} differ: {mine} and {yours}; expected the same{way}"
    shapes = first.frame_shape, other.frame_shape
    if None not in shapes and not _alike(first, *shapes):  # type: ignore[arg-type]
        known, seen = (" x ".join(map(str, shape or ())) for shape in shapes)
        return f"they were learned from frames of {known} and of {seen}; expected the same size"
    return ""


def _joined_names(parts: list[list[str]], frames: list[int]) -> list[str]:
    """Names of the frames of several parts; "" for those of a part without names."""
    if not any(parts):
        return []
    return [name for part, count in zip(parts, frames, strict=True) for name in part or [""] * count]


def _check_count(places: int, resampled: bool) -> None:
    most = EXACT if resampled else LARGEST
    if places > most:
        steps = " at even steps" if resampled else ""
        raise InputError(f"{places} places{steps} in one map; expected at most {most}: several maps")


def _check_alike(model: DejaVu, added: Traverse) -> None:
    """Refuse frames that are not like those that the map was learned from."""
    if model.step is not None and not isinstance(added, ResampledTraverse):
        seen = f"{added.name} has ready features or a single frame, whose steps nothing tells"
        raise InputError(f"{seen}; expected frames, as the map's places are at even steps along the ground")
    shape = added.frame_shape
    own = model.frame_shape or shape  # of a map that was learned from descriptors
    if not _alike(model, own, shape):
        seen, known = (
            "ready features" if len(one) == 1 else f"frames of {' x '.join(map(str, one))}"
            for one in (shape, own)
        )
        raise InputError(f"{added.name} holds {seen}, the map was learned from {known}; expected the same")
    numbers, expected = model.describer.count_features(added), model.features_per_frame
    if numbers != expected:
        seen = f"{added.name} gives {numbers} features a frame"
        raise InputError(f"{seen}; expected {expected}, as the map was learned from")


def _alike(model: DejaVu, own: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether a model describes frames of two shapes (C,H,W) alike; ready features (D,) are alike."""
    if len(own) != len(shape) or len(own) == 1:
        return len(own) == len(shape)
    resized = getattr(model.features, "resize", None) is not None
    one_channel = model.preprocess.channel is not None
    return (own[0] == shape[0] or one_channel) and (own[1:] == shape[1:] or resized)
