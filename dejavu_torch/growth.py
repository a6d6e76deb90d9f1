"""Maps that grow: places appended behind those that there are, and maps of several routes merged."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.data.arrays import as_traverse
from dejavu_torch.data.names import names_of
from dejavu_torch.data.positions import positions_behind
from dejavu_torch.database.mapfile import digests
from dejavu_torch.database.merged import MergedMap, MergedMapper
from dejavu_torch.database.recipe import difference, recipe_of
from dejavu_torch.database.spectral import CodedChunk, SpectralMap
from dejavu_torch.features.extract import feature_batches
from dejavu_torch.model import REGISTRY, DejaVu
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.streaming.coder import Made, code_here
from dejavu_torch.streaming.work import WorkFolder, all_chunks
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

MOST = 2**31 - 1  # places of a map, whose lines are numbered in 32 bits
EXACT = 2**24  # places whose positions float32 tells apart


@torch.no_grad()
def append(
    model: DejaVu,
    traverse: Traverse | Tensor,
    progress: bool = False,
    work: Path | None = None,
    make: Callable[..., Made] = code_here,
) -> DejaVu:
    """Add the places of a traverse behind those of a model's map, which stay as they are.

    Whitening, mean and step of the lines stay; the new places are coded in chunks of their own. Nothing is
    forgotten but the calibration, which is of fewer places: see `DejaVu.calibrate` and its `start`.

    Args:
        model: its map is spectral, learned with a `chunk` of so many places.
        traverse: as of `DejaVu.learn`, of frames like the map's. Where the map's places are even steps along
            the ground it is resampled likewise, and its first frame is the next place.
        progress: show a progress bar on a terminal.
        work, make: as of `DejaVu.learn`.

    Returns:
        The model. What is refused leaves it as it was.

    Convention: where the map's places are a multiple of `chunk`, its file is, byte for byte, that of all
        places learned at once with this whitening, mean and step. Else its last chunk stays short. One chunk
        of descriptors is in memory at a time.

    Raises:
        InputError: a map that cannot grow, or a traverse that does not fit it.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> wave = torch.sin(torch.arange(600.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> model = DejaVu(mapper=SpectralMapper(chunk=200)).learn(wave[:400])
        >>> append(model, wave[400:]).localize(wave[[50, 450]]).index
        tensor([ 50, 450])
    """
    route = growing(model)
    added = model.resample(as_traverse(traverse), model.step, progress)
    _check_alike(model, added)
    before = route.coded()
    places = added.count()
    frames = len(added.positions) if isinstance(added, ResampledTraverse) else places
    _check_count(route.places + places, model.step is not None)
    coder = model.chunk_coder(places, route, route.mean, before[-1].step)
    folder = None
    if work is not None:
        sums = [part.stream.checksum for part in before]
        folder = WorkFolder(work, model.run_key(added, places) | digests(map=sums))
    chunks = all_chunks(coder, added, folder, make, "learning" if progress else None)
    grown = with_chunks(route, [*before, *chunks])
    if isinstance(added, ResampledTraverse):
        behind = positions_behind(added.positions, route.places).to(route.positions.device)
        grown.positions = torch.cat([route.positions, behind])
        grown.check()
    names = joined_names(
        [model.frame_names, names_of(source_of(added), frames)],
        [len(route.positions) or route.places, frames],
    )
    model.map, model.frame_names, model.calibration = grown, names, None
    return model


def growing(model: DejaVu) -> SpectralMap:
    """The map of a model, which can grow.

    Raises:
        InputError: no map, one of another kind, or one whose chunk is the route.
    """
    route = model.map
    if not route.places:
        raise InputError("there is no map to append to; expected learn(...) or load(...) first")
    if route.routes:
        names = ", ".join(one.name for one in route.routes)
        seen = f"the map is merged of the routes {names}, and places behind the last would be on none"
        raise InputError(f"{seen}; expected to append to the map of a route, and to merge it")
    if not isinstance(route, SpectralMap):
        seen = f"a map of kind {route.kind!r} cannot be appended to"
        raise InputError(f"{seen}; expected one of kind {SpectralMap.kind!r}, or to learn the route anew")
    if route.chunk == "route":
        seen = "the map's chunk is the whole route, which cannot be appended to"
        raise InputError(
            f"{seen}; expected a map learned with a chunk of so many places: --mapper.chunk 1024"
        )
    return route


def merge(models: Sequence[DejaVu], names: Sequence[str]) -> DejaVu:
    """Join the maps of several routes that describe frames alike: the places of all, one behind the other.

    Args:
        models: with spectral maps, or merged ones, whose routes count one by one. They stay as they are; the
            modules that make descriptors are the first's.
        names: of the maps' routes; those of merged maps have their own. One that is there already gets a
            number: "route", "route-2".

    Returns:
        A model whose `map.routes` are the routes. Scores of a route's places are, to the bit, those of its
        own map. A threshold is kept where all have it. Calibration and precision are of single routes and
        are not kept; a line says so.

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
    first = models[0]
    parts: list[SpectralMap] = []
    told: list[str] = []
    for name, model in zip(names, models, strict=True):
        own = _routes_of(model, name)
        problem = "" if model is first else _unlike(first, model)
        if problem:
            raise InputError(f"{names[0]} and {name} cannot be merged: {problem}")
        for wanted, part in own:
            told.append(_another(wanted, told))
            parts.append(part)
    _check_count(sum(part.places for part in parts), first.step is not None)
    thresholds = {model.threshold for model in models}
    merged = DejaVu(
        **first.settings()
        | {"mapper": MergedMapper(), "weight_bits": 32, "precision": None}
        | {"threshold": first.threshold if len(thresholds) == 1 else None}
    )
    merged.weight_bits = first.weight_bits
    merged.map = MergedMap(parts, told)
    for name in ("frame_shape", "step"):
        setattr(merged, name, getattr(first, name))
    merged.trained = first.trained if all(model.trained == first.trained for model in models) else None
    counts = [len(model.map.positions) or model.map.places for model in models]
    merged.frame_names = joined_names([model.frame_names for model in models], counts)
    merged.train(first.training)
    lost = [
        *["thresholds"] * (len(thresholds) > 1),
        *["calibration"] * any(model.calibration is not None for model in models),
        *["precision"] * any(model.precision is not None for model in models),
    ]
    if lost:
        log.warning("the merged map has no %s: those of its parts are of single routes", " or ".join(lost))
    return merged


def _routes_of(model: DejaVu, name: str) -> list[tuple[str, SpectralMap]]:
    """Name and map of each route of a model's map; `name` where it is one."""
    route = model.map
    if isinstance(route, MergedMap):
        return [(one, route.part(one)) for one in route.names]
    if not isinstance(route, SpectralMap) or not route.places:
        seen = f"a map of kind {route.kind!r}" if route.places else "no map"
        raise InputError(f"{name} is {seen}; expected one of kind {SpectralMap.kind!r} to merge")
    return [(name, route)]


def _another(name: str, taken: Sequence[str]) -> str:
    """A name that is not taken: itself, or with the first number behind it that is free."""
    if name not in taken:
        return name
    return next(one for one in (f"{name}-{i}" for i in count(2)) if one not in taken)


def _unlike(first: DejaVu, other: DejaVu) -> str:
    """What of two models makes other descriptors, or scores otherwise, in words; empty where nothing does."""
    for what in ("preprocess", "features", "whitening", "velocity"):
        one, two = getattr(first, what), getattr(other, what)
        if (one is None) != (two is None):
            has = [f"has {'no ' if part is None else ''}{what}" for part in (one, two)]
            return f"the one {has[0]}, the other {has[1]}; expected the same"
        if one is None:
            continue
        stored, given = recipe_of(one, REGISTRY), recipe_of(two, REGISTRY)
        if stored != given:
            return f"their {what} differ: {difference(stored, given)}"
        if not _same_tensors(one, two):
            way = "--whitening" if what == "whitening" else "--descriptor"
            learned = f"as `dejavu learn ROUTE {way} MAP` takes it from another map"
            return f"their {what} were learned apart, with other numbers; expected the same, {learned}"
    own, theirs = (_routes_of(model, "")[0][1] for model in (first, other))
    for what, mine, yours in (
        ("metric", own.metric, theirs.metric),
        ("numbers of a descriptor", own.dimension, theirs.dimension),
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


def _same_tensors(one: torch.nn.Module, two: torch.nn.Module) -> bool:
    """Whether what two modules hold is alike."""
    states = one.state_dict(), two.state_dict()
    return states[0].keys() == states[1].keys() and all(
        torch.equal(value, states[1][name]) if isinstance(value, Tensor) else value == states[1][name]
        for name, value in states[0].items()
    )


def with_chunks(route: SpectralMap, chunks: list[CodedChunk]) -> SpectralMap:
    """A map of these chunks, with the mean and settings of another."""
    made = SpectralMap.of_chunks(chunks, route.mean, **route.settings())
    return made.to(route.positions.device).train(route.training)


def joined_names(parts: list[list[str]], frames: list[int]) -> list[str]:
    """Names of the frames of several parts, one behind the other; "" where a part has none."""
    if not any(parts):
        return []
    return [name for part, count in zip(parts, frames, strict=True) for name in part or [""] * count]


def _check_count(places: int, resampled: bool) -> None:
    most = EXACT if resampled else MOST
    if places > most:
        steps = " at even steps" if resampled else ""
        raise InputError(f"{places} places{steps} in one map; expected at most {most}: several maps")


def _check_alike(model: DejaVu, added: Traverse) -> None:
    """Refuse frames that are not like those that the map was learned from."""
    shape, own = added.frame_shape, model.frame_shape
    if model.step is not None and not isinstance(added, ResampledTraverse):
        seen = (
            f"{added.name} has ready features or a single frame, whose steps along the ground nothing tells"
        )
        raise InputError(f"{seen}; expected frames, as the map's places are at even steps")
    own = shape if own is None else own  # of a map that was learned from descriptors
    if len(own) != len(shape):
        kinds = {1: "ready features", 3: "frames"}
        seen = f"{added.name} holds {kinds[len(shape)]}, the map was learned from {kinds[len(own)]}"
        raise InputError(f"{seen}; expected the same")
    if not _alike(model, own, shape):
        seen, known = (" x ".join(map(str, one)) for one in (shape, own))
        raise InputError(f"{added.name} has frames of {seen}; expected {known}, as the map was learned from")
    numbers = next(feature_batches(added, model.pipeline, 1, model.map.positions.device)).shape[1]
    expected = model.map.dimension
    if model.whitening is not None and model.whitening.learned:
        expected = len(model.whitening.projection)
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
