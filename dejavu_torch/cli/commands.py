"""The commands that make and show maps, and what all commands print: docstrings of functions are their help.

Only what every command needs is imported here; the rest, such as matplotlib, is imported when a command runs.
"""

from __future__ import annotations

import builtins
import copy
import json
import shlex
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor, nn

from dejavu_torch import growth
from dejavu_torch.cli import options
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.output import check_output_file
from dejavu_torch.data.source import check_not_read, open_source
from dejavu_torch.data.traverse import chained, kept
from dejavu_torch.evaluation.options import NO_CALIBRATION
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.views import SAMPLE as SHORT
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.learning import Checkpoint, MapTasks
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import REGISTRY, recipe_of, with_parts
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.recognition.calibration import Calibration
from dejavu_torch.recognition.coarse import plan
from dejavu_torch.recognition.querying import Sequences
from dejavu_torch.text import printable, refuse_with
from dejavu_torch.types import InputError, Match, Traverse, expect

if TYPE_CHECKING:
    from dejavu_torch.teaching import Refinement
    from dejavu_torch.updating import Update

SUPPRESSION = 5  # suppression radius in places: two candidates of a query are further apart


def run_learn(
    sources: Sequence[str] = (),
    *,
    map: Path | None = None,
    growing: options.GrowthOptions,
    learning: options.LearningOptions,
    cluster: str | None = None,
    model: DejaVu,
    command: str,
) -> None:
    """Learn a map, and print what it holds and its bytes per place.

    Args:
        sources: folder of images (9 before 10, or photos?order=lexicographic), video (clip.mp4?width=160),
            .npy of frames or features, .h5 of hloc's global descriptors, sim:NAME?seed=0&traverse=0, or
            strip:IMAGE?width=96; several follow each other along one route. Of an area, grid:IMAGE?window=64
        map: map file to write (.safetensors)
        cluster: encode the chunks of a long route on Ray workers: auto starts one per processor, else the
            address of a cluster. They read the sources at the same paths
    """
    append = growing.append
    expect(sources or (append and growing.average), "one, or --append and --average", "there is no source")
    assert map is not None  # the parser checks it
    where = device_of(learning.device, learns=True)
    model = growing.model(model).to(where)
    if cluster is not None:
        check_cluster(cluster, learning.device, model.mapper)
    _check_map_file(map, *sources, *learning.files, growing.average, growing.average_truth)
    learning.seed_whitening(model)
    growing.check(sources, learning.calibration)
    traverse = _along(model, sources) if sources else None
    visits = None if growing.average is None else growing.visits(model, traverse)
    learning.check_calibrated(model, visits.traverse if traverse is None else traverse)  # type: ignore[union-attr]
    traverse, beside = learning.with_views(model, traverse)
    views, known = beside.views, beside.visit
    if traverse is not None and not isinstance(traverse, ResampledTraverse):
        traverse = kept(traverse)
    places: Tensor | None = None  # that the traverse shows; None: all, from the first on
    done, start, checkpoint = "", model.map.places, Checkpoint(map)
    map_tasks: MapTasks = builtins.map
    with ExitStack() as stack:
        if cluster is not None:
            from dejavu_torch.cluster import Cluster

            # started only when there are chunks: that takes seconds
            map_tasks = lambda *work: stack.enter_context(Cluster(cluster)).map(*work)  # noqa: E731
        if traverse is None:
            assert visits is not None
            checkpoint.check_unused()
            count = growth.average(model, visits, progress=True)
            traverse, places = visits.traverse, visits.places
            done = f"{count} of the {start} places of {append}: averaged and coded again at the same step"
        elif append is not None:
            growth.append(model, traverse, True, checkpoint, map_tasks, visits, growing.route)
            places = torch.arange(start, model.map.places)
            if isinstance(known, LabelledFrames):
                known = known._replace(places=known.places + torch.where(known.places >= 0, start, 0))
            done = f"{len(places)} places appended to the {start} of {append}; written to {map}"
        elif visits is not None:
            growth.learn_mean(model, traverse, visits, True, views, checkpoint, map_tasks)
        else:
            model.learn(traverse, True, views, checkpoint, map_tasks)
    if cluster is not None and append is None and model.map.places <= SHORT:
        print(f"--cluster {cluster} is not used for {model.map.places} frames, only for more than {SHORT}")
    if learning.calibration != NO_CALIBRATION:
        growth.calibrate_if_possible(model, traverse, known, places, True)
    model.matching()
    model.save(map)
    checkpoint.remove()
    print_map(model)
    if done:
        say(done)
    print_localize(map, model, command)


def _along(model: DejaVu, sources: Sequence[str]) -> Traverse:
    """The sources as one traverse, which follow each other, at the model's steps."""
    opened = [open_source(one) for one in sources]
    for one in opened if len(opened) > 1 else ():
        expected = "one area alone, of which --append adds more to its map"
        one.layout.expect_route(expected, f"{one.name} is an area, one of {len(opened)} sources")
    traverse = model.resample(chained(opened), model.step, True, model.frame_shape)
    print_steps(traverse)
    return traverse


def run_export(
    map: Path,
    *,
    onnx: Path,
    sequences: Sequences,
    centre: Literal["mean", "none"] = "none",
    threshold: float | None = None,
    features: nn.Module | None = None,
) -> None:
    """Write a map and its features as an ONNX file (opset 18): frames in, scores of all places out.

    With a sequence or a filter, the file also takes a state and returns the next one.

    Args:
        map: map file
        onnx: file to write (.onnx)
        centre: mean removes the mean of the frames so far from each, as in live
        threshold: threshold to store in the file; the map's own if not given
        features: class of the map's features, if it is not part of dejavu_torch
    """
    from dejavu_torch.export import OPSET, export_onnx

    expect(onnx.suffix == ".onnx", "one such as route.onnx", f"--onnx {onnx} is no name of an ONNX file")
    check_output_file(onnx)
    check_not_read(onnx, map)
    matcher = sequences.matcher(SUPPRESSION, threshold)
    matcher = None if isinstance(matcher, str) else matcher
    model = options.load_map(map, features)
    options.Acceptance(threshold).of(model)
    seen = f"the map's precision, {model.precision}, only holds for single frames in an ONNX file"
    expect(matcher is None or model.precision is None, "--threshold with a sequence or a filter", seen)
    written = export_onnx(model, onnx, matcher, centre == "mean", sequences.shifts)
    for kind in ("inputs", "outputs"):
        shapes = (f"{name} {tuple(shape)}" for name, shape in written.facts[kind].items())
        print(f"{kind}: {', '.join(shapes)}".replace("'", ""))
    size = f"{written.bytes / 1e6:.1f} MB, opset {OPSET}"
    say(f"{size}; {written.difference:.1g} from torch at most, on noise; written to {onnx}")


def run_refine(
    map: Path,
    drives: Sequence[str],
    *,
    out: Path | None = None,
    loading: options.Loading,
    command: str,
) -> None:
    """Learn from drives without ground truth what changes along a map; its places stay as they are.

    Args:
        map: map file, which is overwritten unless --out names another one
        drives: frames in order, as in `dejavu learn`, at least 30 in each; one after the other
        out: map file to write instead (.safetensors)
    """
    from dejavu_torch.teaching import refine

    _teach(refine, map, drives, out, loading, command)


def run_update(
    map: Path,
    drives: Sequence[str],
    *,
    out: Path | None = None,
    loading: options.Loading,
    command: str,
) -> None:
    """Refine a map with drives, as `dejavu refine` does, and append new ground as separate routes.

    Args:
        map: map file, which is overwritten unless --out names another one
        drives: frames in order, as in `dejavu learn`, at least 30 in each; one after the other
        out: map file to write instead (.safetensors)
    """
    from dejavu_torch.updating import update

    _teach(partial(update, own=map.stem), map, drives, out, loading, command)


def _teach(
    learn: Callable[..., Refinement | Update],
    map: Path,
    drives: Sequence[str],
    out: Path | None,
    loading: options.Loading,
    command: str,
) -> None:
    """Let drives teach a map, one after the other, and write it if it is another one."""
    out = map if out is None else out
    _check_map_file(out, *drives, option="--out")
    device_of(loading.device)
    model, changed = loading.model(map), out != map
    for drive in [open_source(one) for one in drives]:  # all are there before one is read
        found = learn(model, drive, progress=True)
        say(f"{drive.name}: {found}")
        changed |= found.changed
    if changed:
        model.save(out)
        print_map(model)
        print_localize(out, model, command)


def run_merge(maps: Sequence[Path], *, map: Path, features: nn.Module | None = None, command: str) -> None:
    """Merge the maps of several routes with the same descriptors: an answer is then a route and its frame.

    For the same descriptors, learn all maps but the first with --whitening FIRST.safetensors.

    Args:
        maps: at least two map files; a route is named after its file, those of a merged map keep their names
        map: map file to write (.safetensors)
        features: class of the maps' features, if it is not part of dejavu_torch
    """
    _check_map_file(map, *maps)
    for one, other in combinations(maps, 2):
        if one.exists() and other.exists() and one.samefile(other):
            raise InputError(f"{other} and {one} are the same file; expected each map once")
    expect(len(maps) >= 2, "at least two maps to merge", f"{maps[0]} alone")
    models = [options.load_map(path, copy.deepcopy(features)) for path in maps]
    model = growth.merge(models, [path.stem for path in maps])
    model.save(map)
    print_map(model)
    print_localize(map, model, command)


def run_info(map: Path, *, features: nn.Module | None = None, command: str) -> None:
    """Show what a map holds and how it was made.

    Args:
        map: map file
        features: class of the map's features, if it is not part of dejavu_torch
    """
    from dejavu_torch.maps.distance import l1_backend
    from dejavu_torch.maps.file import FORMAT
    from dejavu_torch.periods.spectrogram import BACKEND

    model = DejaVu.load(map, features)
    print_map(model)
    with suppress(InputError):  # a chunk that does not fit into memory
        print(f"single queries: {plan(model.map) or 'all places are scored'}")
    if model.frame_shape is not None:
        kind = "frames of " if len(model.frame_shape) == 3 else "features, "
        print(f"learned from {kind}{' x '.join(str(n) for n in model.frame_shape)}")
    made_by = [*model.features.members] if isinstance(model.features, Joined) else [model.features]
    parts = [model.preprocess, *made_by, model.mapper, *model.mapper.children()]
    if model.step is not None and model.velocity is not None:
        print(f"places are {model.step:.4g} pixels of ground apart")
        parts.append(model.velocity)
    if len(model.frame_shape or ()) == 1:
        made = model.provenance.maker or 'unknown; {"maker": ...} in the .json beside an .npy would tell'
        say(f"these descriptors were made by: {made}")
    if taught := model.provenance.taught:
        say(f"taught by: {', '.join(dict(taught))}")
    for part in parts:
        if part in parts[: 2 + len(made_by)] or part.extra_repr():
            print(f"{type(part).__name__}: {part.extra_repr()}")
    if model.trained is not None:
        steps, seed = model.trained
        print(f"trained for {steps} steps, seed {seed}")
    if model.weight_bits < 32:
        print(f"weights of {model.weight_bits} bits, a scale for each output channel")
    print(f"map format {FORMAT}, checksums agree")
    calibration = (model.calibration or Calibration())._asdict()
    known = [name for name, platt in calibration.items() if platt is not None]
    print(f"calibrated for: {', '.join(known) or 'nothing'}; precision: {model.precision}")
    print(f"single queries: {model.acceptance()}")
    print(f"L1 by {l1_backend()}, spectrogram by {BACKEND}, on this machine")
    if model.map.places:
        print_localize(map, model, command)
    else:
        words = features_words(model, command)
        print_next("learn", "ROUTE", "--descriptor", map, *words, "--map", "route.safetensors")


def check_cluster(cluster: str, device: str, mapper: Mapper | None = None) -> None:
    """Refuse early what no cluster does, or not with this mapper."""
    from dejavu_torch.cluster import check_installed

    refuse_with(f"--cluster {cluster}", device=device != "cpu" and device)
    check_installed()
    seen = f"--cluster {cluster} encodes chunks, and {type(mapper).__name__} has none"
    expect(isinstance(mapper, SpectralMapper | None), "a spectral map", seen)


def _check_map_file(path: Path, *read: str | Path | None, option: str = "--map") -> None:
    """Refuse early a map file that cannot be written or is also read."""
    expected = path.with_suffix(".safetensors") if path.name else "such as route.safetensors"
    expect(path.suffix == ".safetensors", expected, f"{option} {path} is not the name of a map")
    check_output_file(path)
    check_not_read(path, *read)


def features_words(model: DejaVu, command: str, option: str = "--features") -> list[str]:
    """The options `--features ..` that a later command needs if the map file cannot restore its features.

    Args:
        command: as it was typed; its words with `option` name the features.
    """
    parts = with_parts(recipe_of(model.features))
    foreign = [one.class_path for one in parts if one.class_path not in REGISTRY]
    if not foreign:
        return []
    found, values, named = [], False, False
    for word in shlex.split(command):
        own = f"{word.partition('=')[0]}.".startswith(f"{option}.")
        if own or values:
            found.append(f"--features{word.removeprefix(option)}" if own else word)
        named |= word.partition("=")[0] == option
        values = own and "=" not in word
    if named:
        return found
    several = isinstance(model.features, Joined) and len(foreign) > 1
    name = json.dumps(recipe_of(model.features).init_args["members"]) if several else foreign[0]
    return ["--features", name, *found]  # a config file named them


def print_steps(traverse: Traverse) -> None:
    """Print to how many even steps frames were resampled, if they were."""
    if isinstance(traverse, ResampledTraverse):
        steps = f"{len(traverse)} even steps of {traverse.step:.4g} pixels of ground"
        print(f"{len(traverse.positions)} frames resampled to {steps}")


def print_map(model: DejaVu) -> None:
    """Print what a map holds, and the bytes that would hold enough if that is little."""
    summary = model.summary()
    if summary.places and not summary.covered:
        print("this route does not repeat")
    print(summary)
    for route in model.map.routes:
        assert isinstance(model.map, SpectralMap)  # only these can be merged
        size, layout = model.map.part(route.name).summary().route_bytes, model.map.layout
        frames = f" of {route.frames} frames" * (route.frames != route.places)
        where = " and ".join(f"{run[0]}-{run[-1]}" for run in layout.ranges(layout.number(route.name)))
        say(f"route {route.name}: places {where}{frames}, {size} bytes, {size / route.places:.2f} per place")
    if len(model.map.visits):
        counts = model.map.visit_counts.double()
        if counts.min() == 0:
            print(f"{int((counts == 0).sum())} places are never reported: their frames are covered or black")
        if counts.max() > 1:
            print(
                f"each place is the mean of {counts.mean():.3g} visits ({counts.min():g} to {counts.max():g})"
            )
    if isinstance(model.map, SpectralMap) and len(model.map.drives):
        drives, verb = int(model.map.drives), "refined" if len(model.map.stage) else "taught"
        print(f"{verb} by {drives} drive{'s' * (drives > 1)}")
    whitening = model.whitening
    if whitening is not None:
        sizes = " + ".join(map(str, whitening.sizes))
        numbers = len(whitening.scale)
        if whitening.views == 0:
            print(f"descriptors of {sizes} dimensions are reduced to {numbers} by principal components")
        else:
            print(f"Whitening, {sizes} to {numbers} dimensions: {whitening.extra_repr()}")


def print_localize(map: Path, model: DejaVu, command: str, query: str = "QUERY", lead: str = "next") -> None:
    """Print the command that finds frames on a map."""
    if not model.map.summary().covered:
        print(f"{lead}: try more frames, another --preprocess.contrast, or `dejavu train fit`")
        return
    words = features_words(model, command)
    print_next("localize", map, query, *words, "--out", "matches.csv", lead=lead)


def print_next(*words: object, lead: str = "next") -> None:
    """Print the command to run next."""
    say(f"{lead}: {shlex.join(['dejavu', *(str(word) for word in words)])}")


def say(text: str) -> None:
    """Print a line that may hold names of files."""
    print(printable(text))


def write_matches(
    path: Path,
    matches: Iterable[Match],
    query: Traverse,
    model: DejaVu,
    ranks: int | None = None,
    pairs: Path | None = None,
) -> tuple[int, int]:
    """Write the matches of a query; returns the numbers of queries and of accepted answers."""
    from dejavu_torch.evaluation import matches as files

    frames, source = None, query
    if isinstance(query, ResampledTraverse):
        frames, source = query.frame, query.traverse
    names = source.names, model.frame_names
    return files.write_matches(path, matches, frames, model.map.table, *names, ranks, pairs)
