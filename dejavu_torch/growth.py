"""Growing maps: append places, average further visits in, and merge the maps of several routes."""

from __future__ import annotations

import copy
import logging
from collections.abc import Container, Sequence
from itertools import accumulate, count

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch import learning
from dejavu_torch.data.ground_truth import find_ground_truth, names_agree
from dejavu_torch.data.maker import check_maker
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.data.traverse import chained
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.maps.file import checksums, digests
from dejavu_torch.maps.spectral import SpectralMapper, encode_chunk
from dejavu_torch.maps.spectral_map import LARGEST, Chunk, SpectralMap
from dejavu_torch.model import DejaVu, features_per_frame, require_map
from dejavu_torch.model_file import ModelState, Recipe, difference, recipe_of, run_key, weights_of
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.places.frame_table import FrameTable
from dejavu_torch.places.layout import agree
from dejavu_torch.places.positions import positions_behind
from dejavu_torch.recognition.calibration import strictest
from dejavu_torch.recognition.provenance import Provenance
from dejavu_torch.recognition.views import ALONE
from dejavu_torch.teaching import FEWEST, calibrate_by, place_drives
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

EXACT = 2**24  # maximum number of even steps, with exact positions in float32


@torch.no_grad()
def append(
    model: DejaVu,
    traverse: Source,
    progress: bool = False,
    checkpoint: learning.Checkpoint | None = None,
    map_tasks: learning.MapTasks = map,
    visits: LabelledFrames | None = None,
    route: str | None = None,
) -> DejaVu:
    """Append the places of a traverse to a model's map, whose own places stay unchanged.

    Args:
        model: with a spectral map.
        traverse: frames like the map's. If the map's places are even steps along the ground, the traverse is
            resampled likewise, and its first frame is the next place.
        progress, checkpoint, map_tasks: see `DejaVu.learn`.
        visits: frames of another traverse of the new places, averaged in before coding, see `learn_mean`.
        route: the one of a merged map that goes on; None is the only one. Its new places are the last of the
            map, so that no place gets another number.

    Returns:
        The model, in eval mode, without its calibration, which was for fewer places. An error leaves it
        unchanged.

    Convention: whitening, mean and step stay. If the number of the map's places is a multiple of `chunk`, the
        file is byte for byte that of all places learned together with these. One chunk of descriptors is in
        memory at a time.

    Raises:
        InputError: a map that cannot grow, or a traverse that does not fit it.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> wave = torch.sin(torch.arange(600.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> model = DejaVu(mapper=SpectralMapper(chunk=200)).learn(wave[:400])
        >>> append(model, wave[400:]).localize(wave[[50, 450]]).index
        tensor([ 50, 450])
    """
    place_map = spectral_map(model, "append to")
    layout = place_map.layout
    if route is None:
        layout.expect_one("one of them by its name, as --route NAME")
    number = 0 if route is None else layout.number(route)
    added = model.resample(as_traverse(traverse), model.step, progress, model.frame_shape)
    _check_compatible(model, added)
    places = len(added)
    positions = learning.positions_of(added).to(place_map.device)
    _check_count(place_map.places + places, model.step is not None)
    longer = place_map.table.counted.grown(added.layout, added.name, len(positions) or None, number)
    if len(added.frame_shape) == 3 and model.frame_shape not in (None, added.frame_shape):
        seen, own = (" x ".join(map(str, shape or ())) for shape in (added.frame_shape, model.frame_shape))
        expected = f"{own}, as the map's"
        added.layout.expect_route(expected, f"{added.name} has windows of {seen}")
    counts = None
    if visits is not None:
        _check_compatible(model, visits.traverse)
        counts = learning.observation_counts(visits, places)
    grown = copy.deepcopy(place_map)
    grown.laid_out(longer).positions = place_map.positions[:0]  # set when all places are appended
    if checkpoint is not None:
        base = digests(base=checksums(place_map.packed(), place_map.get_extra_state()))
        checkpoint.open(run_key(model, added, visits=visits) | base, grown, model.descriptor)
    settings = visits, progress, checkpoint, map_tasks
    grown.laid_out(longer)
    learning.append_places(grown, model.descriptor, added, place_map.places, *settings)
    if counts is not None:
        before = grown.visit_counts
        grown.count_visits(before + F.pad(counts.to(before), (place_map.places, 0)))
    if len(positions):
        if len(longer.runs) == len(layout.runs):  # those of a run are counted through it
            positions = positions_behind(positions, layout.runs[-1].places)
        grown.positions = torch.cat([place_map.positions, positions])
    grown.check()
    frames = len(positions) or places
    names = [model.frame_names, [*source_of(added).names]]
    model.frame_names = joined_names(names, [place_map.table.frames, frames])
    model.replace_map(grown)
    return model if visits is None else model.taught_by(*visits[:2])


def learn_mean(
    model: DejaVu,
    traverse: Source,
    visits: LabelledFrames,
    progress: bool = False,
    second: LabelledFrames | None = None,
    checkpoint: learning.Checkpoint | None = None,
    map_tasks: learning.MapTasks = map,
) -> DejaVu:
    """As `DejaVu.learn`, from the mean of several visits to each place, which cancels what changes.

    Args:
        visits: frames of another traverse and their places, see `associate`. A place with k of these frames
            becomes the mean of k + 1 descriptors, see `map.visit_counts`.
        traverse, progress, second, checkpoint, map_tasks: see `DejaVu.learn`. Whitening
            learns from these, not from `visits`.

    Raises:
        InputError: as `DejaVu.learn`, a mapper of templates, which are means already, or visits that do not
            fit.

    Example:
        >>> wave = torch.cos(torch.arange(200.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> again = LabelledFrames(as_traverse(wave[50:] + 0.1), torch.arange(50, 200))
        >>> learn_mean(DejaVu(whitening="none"), wave, again).map.visits
        tensor([[ 50,   1],
                [150,   2]], dtype=torch.int32)
    """
    if not isinstance(model.mapper, SpectralMapper):
        seen = f"{type(model.mapper).__name__} makes templates, which are means of many places already"
        raise InputError(f"{seen}; expected a SpectralMapper to average visits")
    return model.learn(traverse, progress, second, checkpoint, map_tasks, visits)


@torch.no_grad()
def average(model: DejaVu, visits: LabelledFrames, progress: bool = False) -> int:
    """Average another visit into a map: its chunks are decoded, averaged and coded again with the same step.

    A chunk that no frame shows stays unchanged. `learn_mean` of both traverses makes a better map, since it
    also averages what the coding discarded.

    Args:
        model: with a spectral map; its calibration is removed. visits: see `associate`.
        progress: show a progress bar on a terminal.

    Returns:
        The number of places with new visits.

    Raises:
        InputError: no spectral map of one route, or visits that do not fit.
    """
    place_map = one_route(model, "average visits into")
    _check_compatible(model, visits.traverse)
    counts, seen = place_map.visit_counts.cpu(), learning.observation_counts(visits, place_map.places)
    descriptors, places = learning.descriptors_of(model.descriptor, visits, progress)

    def averaged(g: int, chunk: Chunk) -> Chunk:
        start, stop = place_map.chunks[g]
        inside = ((places >= start) & (places < stop)).nonzero()[:, 0]
        if not len(inside):
            return chunk
        rows = descriptors[inside].to(place_map.device)
        means = learning.with_visits(place_map.decode(g), counts[start:stop], rows, places[inside] - start)
        settings = place_map.transform, place_map.resolution, chunk.columns
        return encode_chunk(means, place_map.means[0], chunk.step, *settings)._replace(digest=chunk.digest)

    mean = place_map.of_chunks(averaged(g, chunk) for g, chunk in enumerate(place_map.coded()))
    mean.laid_out(place_map.layout).positions = place_map.positions
    mean.count_visits((counts + seen).to(place_map.visits.device))
    mean.check()
    model.replace_map(mean).taught_by(*visits[:2])
    return int((seen > 0).sum())


def associate(
    model: DejaVu,
    reference: Traverse | None,
    second: Traverse,
    truth: str | None = None,
    progress: bool = False,
    option: str = "--average_truth",
) -> LabelledFrames:
    """The place of each frame of another traverse, on a reference or on a map; resampled like it.

    Args:
        reference: the result of `DejaVu.resample`; None is the model's map, of one route.
        truth: the reference frames of each frame, see `find_ground_truth`; None is the nearest window in an
            area, if the traverse has coordinates, else place i for frame i where both `are_aligned` by more
            than a counter, else where a smoother places it on a map of the reference, or the model's. The
            first counts if there are several; frames without one get -1.
        option: of the truth, for messages.

    Raises:
        InputError: it shows no place, or nothing says which, and a smoother cannot place it: fewer than 60
            frames, or too few sure ones, as of frames in no order.
    """
    second, places = _known_places(model, reference, second, truth, option)
    if places is not None:
        return LabelledFrames(second, places)
    if reference is None:
        _check_compatible(model, second)
    else:
        model.descriptor.check_sizes(reference, second)
    views = place_drives(model, reference, [(second, None)], progress, most=1)
    _check_placed(second, views.places, option)
    return views


def visit_to_calibrate(
    model: DejaVu, reference: Traverse | None, visit: Traverse, truth: str | None = None
) -> LabelledFrames | Traverse:
    """As `associate`, but where a smoother has to place the visit, that is left to the map it calibrates."""
    option = "--calibration_truth"
    visit, places = _known_places(model, reference, visit, truth, option)
    if places is not None:
        return LabelledFrames(visit, places)
    layout = model.map.layout if reference is None else reference.layout
    layout.expect_route(_placeable(option), f"{visit.name} shows an area, not a route")
    return visit


def _placeable(option: str) -> str:
    return f"at least {FEWEST} frames in order along the route, or {option}, such as 0 if frame i is place i"


def _check_placed(drive: Traverse, places: Tensor, option: str) -> None:
    seen = f"of {drive.name}, fewer than {FEWEST} frames, or a tenth, can be placed surely"
    expect((places >= 0).any(), _placeable(option), seen)


def _known_places(
    model: DejaVu, reference: Traverse | None, second: Traverse, truth: str | None, option: str
) -> tuple[Traverse, Tensor | None]:
    """As `associate`: the traverse at the map's steps and its places; None where nothing says them, and a
    smoother has to."""
    if reference is None:
        place_map, shape, step = one_route(model, "average visits into"), model.frame_shape, model.step
        table, name, source = place_map.table, "the map", None
    else:
        table = FrameTable(reference.layout, learning.positions_of(reference))
        shape = model.at_map_size(reference, model.frame_shape if model.map.places else None).frame_shape
        step, name, source = getattr(reference, "step", None), reference.name, source_of(reference)
    layout = table.layout
    second = model.resample(second, step, shape=shape)
    frames = len(second)
    numbers = second.frame if isinstance(second, ResampledTraverse) else frames
    ground_truth = find_ground_truth(
        truth, source, source_of(second), table.frames, numbers, resampled=step is not None, counters=False
    )
    shown = source_of(second).coordinates
    if truth is None and layout.frame and shown is not None and not shown.degrees:
        seen = f"coordinates of {second.name} in {shown.frame} and of {name} in {layout.frame}"
        expect(agree(shown.frame, layout.frame), "one system", seen)
        places = layout.place_near(shown.values[:, :2])
    elif ground_truth is not None:
        places = table.place_of(ground_truth.positives[:, 0])
    elif reference is None and step is None and names_agree(model.frame_names, second, counters=False):
        places = torch.arange(frames)
    else:
        seen = f"nothing says which places of {name} the {frames} frames of {second.name} show"
        expect(frames >= FEWEST, _placeable(option), seen)
        return second, None
    expect((places >= 0).any(), "some", f"no frame of {second.name} shows a place of {name}")
    return second, places


def second_traverse(
    model: DejaVu,
    reference: Source,
    second: Source | Sequence[Traverse],
    truth: str | Sequence[str | None] | None = None,
    progress: bool = False,
) -> LabelledFrames:
    """As `associate`, for one or more traverses that whitening learns from, with one truth or one for each;
    several are a list of `Traverse`. A smoother places them twice, see `teaching.place_drives`; nothing is
    learned from one that it cannot place, unless that is as long as the reference: it may be aligned.

    Raises:
        InputError: no whitening that learns, another number of truths, other frame sizes, or as `associate`.
    """
    several = isinstance(second, list | tuple) and all(isinstance(one, Traverse) for one in second)
    reference, visits = as_traverse(reference), [*second] if several else [as_traverse(second)]  # type: ignore[misc]
    model.descriptor.require_learning(" + ".join(traverse.name for traverse in visits))
    truths = [truth] if isinstance(truth, str | None) else [*truth]
    truths *= len(visits) if len(truths) == 1 else 1
    seen = f"{len(visits)} further traverses and {len(truths)} truths"
    expect(len(truths) == len(visits), "one for each, or one for all", seen)
    option, pairs = "--second_truth", zip(visits, truths, strict=True)
    drives = [_known_places(model, reference, *pair, option) for pair in pairs]
    known = [places for _, places in drives if places is not None]
    if len(known) == len(drives):
        return LabelledFrames(chained([drive for drive, _ in drives]), torch.cat(known))
    model.descriptor.check_sizes(reference, *(drive for drive, _ in drives))
    views = place_drives(model, reference, drives, progress)
    for (drive, places), found in zip(
        drives, views.places.split([len(one) for one, _ in drives]), strict=True
    ):
        if places is None and len(drive) == len(reference):
            _check_placed(drive, found, option)
    return views


def calibrate_if_possible(
    model: DejaVu,
    reference: Traverse,
    views: LabelledFrames | Traverse | None = None,
    places: Tensor | None = None,
    progress: bool = False,
    reach: int = 5,
) -> None:
    """As `DejaVu.calibrate`, also by a visit whose places nobody told; without views, only a map that is not
    calibrated and can be."""
    if isinstance(views, Traverse):
        found = calibrate_by(model, views, progress)
        _check_placed(views, found.places, "--calibration_truth")
        log.warning(*found.placed_lines("the other {} calibrate, too"))
    elif views is not None:
        model.calibrate(reference, views, progress=progress, reach=reach)
    elif model.calibration is None and len(reference.frame_shape) == 3 and model.map.summary().covered:
        try:
            model.calibrate(reference, None, places, progress, reach)
        except InputError as error:
            log.warning("the map is not calibrated: %s", error)


def one_route(model: DejaVu, verb: str) -> SpectralMap:
    """The spectral map of a model; InputError if it has none, another kind, or one of several routes."""
    place_map = spectral_map(model, verb)
    place_map.layout.expect_one(f"to {verb} the map of a route, then merge")
    return place_map


def spectral_map(model: DejaVu, verb: str) -> SpectralMap:
    """The spectral map of a model; InputError if it has none, or another kind."""
    require_map(model, f" to {verb}")
    place_map = model.map
    if not isinstance(place_map, SpectralMap):
        seen = (
            f"there is a map of kind {place_map.kind!r}; expected one of kind {SpectralMap.kind!r} to {verb}"
        )
        raise InputError(f"{seen}, or learn the route anew")
    return place_map


def merge(models: Sequence[DejaVu], names: Sequence[str]) -> DejaVu:
    """Join the maps of several routes with equal descriptors: all places, route after route.

    Args:
        models: with spectral maps, which may be merged ones. They stay unchanged; the result has the
            descriptor modules of the first.
        names: of the maps' routes; merged maps have names for theirs. A name in use gets a number: "route",
            "route-2".

    Returns:
        A model whose `map.routes` are the routes, each with the scores of its own map. A threshold is kept if
        all have the same, a precision likewise. If all are calibrated, the scalings are kept that give lower
        probabilities, since on each route an answer has to be as sure as on the least plain one. What is
        dropped is told in a warning.

    Raises:
        InputError: fewer than two models, one without a spectral map, or models that differ in what makes
            their descriptors, in metric or in the steps of resampled places.

    Example:
        >>> waves = torch.sin(torch.arange(400.0)[:, None] * torch.tensor([0.1, 0.23, 0.37])).split(200)
        >>> models = [DejaVu(whitening="none").learn(wave) for wave in waves]
        >>> merge(models, ["out", "back"]).map.routes
        (Route(name='out', places=200, frames=200), Route(name='back', places=200, frames=200))
    """
    seen = f"{len(models)} maps and {len(names)} names to merge"
    expect(len(models) >= 2 and len(names) == len(models), "at least two maps, and a name for each", seen)
    first, maps, routes, taken = models[0], list[SpectralMap](), list[list[str]](), set[str]()
    for name, model in zip(names, models, strict=True):
        place_map = model.map
        if not isinstance(place_map, SpectralMap) or not place_map.places:
            seen = f"a map of kind {place_map.kind!r}" if place_map.places else "no map"
            raise InputError(f"{name} is {seen}; expected one of kind {SpectralMap.kind!r} to merge")
        layout, own = place_map.layout, first.map.layout
        seen = f"{name} is the map of {layout.kind}, {names[0]} of {own.kind}"
        expect(layout.kind == own.kind, "all of routes or of areas", seen)
        if problem := _difference(first, model):
            raise InputError(f"{names[0]} and {name} cannot be merged: {problem}")
        maps.append(place_map)
        routes.append([])
        for wanted in layout.names(name):
            routes[-1].append(free_name(wanted, taken))
            taken.add(routes[-1][-1])
    _check_count(sum(one.places for one in maps), first.step is not None)
    thresholds, precisions = ({getattr(one, name) for one in models} for name in ("threshold", "precision"))
    calibration = strictest([model.calibration for model in models])
    precision = first.precision if calibration is not None and len(precisions) == 1 else None
    merged = DejaVu(
        **first.settings()
        | {"weight_bits": 32, "precision": precision}
        | {"threshold": first.threshold if len(thresholds) == 1 else None}
    )
    merged.weight_bits = first.weight_bits
    frames = [model.map.table.frames for model in models]
    trained = first.trained if all(model.trained == first.trained for model in models) else None
    names = joined_names([model.frame_names for model in models], frames)
    looks = {one.views for one in models}
    views = ALONE if ALONE in looks else first.views if len(looks) == 1 else None
    provenance = Provenance.merged([model.provenance for model in models])
    merged.state = ModelState(first.frame_shape, first.step, trained, names, None, views, provenance)
    dropped = [
        *["thresholds"] * (len(thresholds) > 1),
        *["calibration"] * (calibration is None and any(model.calibration for model in models)),
        *["precision"] * (precision is None and any(model.precision is not None for model in models)),
    ]
    if dropped:
        log.warning(
            "the merged map has no %s: the routes differ in that, or one has none", ", ".join(dropped)
        )
    joined = SpectralMap.merged(maps, routes)
    starts = accumulate(model.map.places for model in models)
    links = [
        (one + start, two + start, share)
        for place_map, start in zip(maps, [0, *starts], strict=False)
        for one, two, share in place_map.known_links
    ]
    merged.replace_map(joined.linked(links) if links else joined)
    merged.calibration = calibration
    return merged


def only_route(model: DejaVu, name: str) -> DejaVu:
    """Let a model know one route of its merged map alone, so that all answers are places of it; returns it.

    Raises:
        InputError: no merged map, or no route of this name.
    """
    model.map.layout.expect_several("one of `dejavu merge`", f"route {name!r} of a map of one route")
    place_map, calibration, names = spectral_map(model, "find"), model.calibration, model.frame_names
    shown = place_map.table.frames_in(place_map.layout.number(name)).tolist()
    model.replace_map(place_map.part(name))
    model.calibration = calibration
    model.state.frame_names = [names[frame] for frame in shown] if names else []
    return model


def free_name(name: str, taken: Container[str]) -> str:
    """The name itself, or with the first free number after it."""
    return name if name not in taken else next(f"{name}-{i}" for i in count(2) if f"{name}-{i}" not in taken)


def _difference(first: DejaVu, other: DejaVu) -> str:
    """Why two models give different descriptors or scores; "" if they do not."""
    for what in ("preprocess", "features", "whitening", "velocity"):
        parts = (getattr(model, what) for model in (first, other))
        stored, given = (Recipe(f"no {what}", {}) if part is None else recipe_of(part) for part in parts)
        if stored != given:
            return f"their {what} differ: {difference(stored, given)}"
        if checksums(weights_of(first, what), None) != checksums(weights_of(other, what), None):
            option = "--whitening" if what == "whitening" else "--descriptor"
            expected = f"the same, see `dejavu learn ROUTE {option} MAP`"
            return f"their {what} were learned separately and differ in weights; expected {expected}"
    own, theirs = first.map.settings(), other.map.settings()
    for what, mine, yours in (
        ("metric", own["metric"], theirs["metric"]),
        ("transform", own["transform"], theirs["transform"]),
        ("dimensions of a descriptor", first.map.dimension, other.map.dimension),
        ("steps between places, in pixels of ground,", first.step, other.step),
    ):
        if mine != yours:
            option = f", see --velocity.step {mine:g}" if isinstance(mine, float) else ""
            return f"their {what} differ: {mine} and {yours}; expected the same{option}"
    stages = [(one.map.stage, one.map.stage_scale) for one in (first, other)]
    if not all(map(torch.equal, *stages)):
        return (
            "different drives have refined them; expected maps that no drive refined, or that share a stage"
        )
    if seen := first.map.layout.unlike(other.map.layout):
        return f"{seen}; expected the same"
    makers = first.provenance.maker, other.provenance.maker
    if all(makers) and len({*makers}) > 1:
        return (
            f"{makers[0]!r} made the descriptors of one, {makers[1]!r} those of the other; expected the same"
        )
    shapes = first.frame_shape, other.frame_shape
    if None not in shapes and not _compatible(first, *shapes):  # type: ignore[arg-type]
        sizes = " and ".join(" x ".join(map(str, shape or ())) for shape in shapes)
        return f"they were learned from frames of {sizes}; expected the same size"
    return ""


def joined_names(parts: list[list[str]], frames: list[int]) -> list[str]:
    """The frame names of several parts; "" for frames of a part without names."""
    if not any(parts):
        return []
    return [name for part, count in zip(parts, frames, strict=True) for name in part or [""] * count]


def _check_count(places: int, resampled: bool) -> None:
    limit = EXACT if resampled else LARGEST
    steps = " at even steps" if resampled else ""
    expect(places <= limit, f"at most {limit}, or several maps", f"{places} places{steps} in one map")


def _check_compatible(model: DejaVu, added: Traverse) -> None:
    """Refuse frames unlike those that the map was learned from."""
    if model.step is not None and not isinstance(added, ResampledTraverse):
        seen = f"{added.name} has ready features or a single frame, without measurable steps"
        raise InputError(f"{seen}; expected frames, as the map's places are even steps along the ground")
    check_maker(model.provenance.maker, "the map", added)
    shape = added.frame_shape
    stored = model.frame_shape or shape  # None for a map learned from descriptors
    if not _compatible(model, stored, shape):
        seen, learned = (
            "ready features" if len(size) == 1 else f"frames of {' x '.join(map(str, size))}"
            for size in (shape, stored)
        )
        raise InputError(f"{added.name} has {seen}, the map was learned from {learned}; expected the same")
    count, expected = model.descriptor.count_features(added), features_per_frame(model)
    expect(count == expected, f"{expected}, as in the map", f"{added.name} gives {count} features per frame")
    told = 'or {"maker": ...} in the .json beside both, if one network made them'
    expect(not (seen := model.provenance.unlike(added)), f"the map's, {told}", seen)


def _compatible(model: DejaVu, stored: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether a model gives the same descriptors for frames of two shapes, (C,H,W) or (D,)."""
    if len(stored) != len(shape) or len(stored) == 1:
        return len(stored) == len(shape)
    resized = getattr(model.features, "resize", None) is not None
    one_channel = model.preprocess.channel is not None
    return (stored[0] == shape[0] or one_channel) and (stored[1:] == shape[1:] or resized)
