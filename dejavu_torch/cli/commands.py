"""The commands: thin functions whose docstrings are their help.

Only what every command needs is imported here; the rest, such as matplotlib, is imported when a command runs.
"""

from __future__ import annotations

import builtins
import copy
import json
import shlex
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from dejavu_torch import growth
from dejavu_torch.cli import options
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.output import check_output_file, check_output_folder, whole_folder
from dejavu_torch.data.source import check_not_read, open_source
from dejavu_torch.data.traverse import Whole, chained
from dejavu_torch.evaluation.answers import describe_line, describe_probable, next_steps, probable_counts
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.views import SAMPLE as SHORT
from dejavu_torch.learning import Checkpoint, MapTasks
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import REGISTRY, recipe_of, with_parts
from dejavu_torch.motion.ground_plane import check_corners
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.recognition.calibration import Calibration
from dejavu_torch.recognition.coarse import plan
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.select import check_candidates
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Match, Traverse

if TYPE_CHECKING:
    from dejavu_torch.evaluation.compare import Comparison
    from dejavu_torch.evaluation.report import Report
    from dejavu_torch.teaching import Refinement
    from dejavu_torch.updating import Update

COMPARED = ("map.safetensors", "matches.csv")  # files next to the report of a comparison
NO_DRIVE = "the queries are no drive of this map, as far as they show: each is matched by itself"
SUPPRESSION = 5  # suppression radius in places: two candidates of a query are further apart


def run_demo(
    *,
    out: Path = Path("dejavu_demo"),
    seed: int = 0,
    second: list[str] | str | None = None,
    model: DejaVu,
    command: str,
) -> None:
    """Learn the built-in route, localize a second traverse of it, and write a report.

    Args:
        out: folder for report and pictures
        seed: seed of the route, the whitening and the null control
        second: second traverse from which to learn what changes, or several, '[A,B]'
    """
    from dejavu_torch.evaluation.compare import compare
    from dejavu_torch.evaluation.reproduce import paper_model

    _check_report_folder(out, COMPARED, options.several(second))
    given = options.LearningOptions(seed, second)
    given.seed_whitening(model)
    learned, localized = f"sim:aerial?seed={seed}", f"sim:aerial?seed={seed}&traverse=1"
    reference, query = open_source(learned), open_source(localized)
    print(f"learning {reference.name}, then finding {query.name} on it")
    reference, views, _ = given.with_views(model, reference, query)
    paper = paper_model()
    same = recipe_of(model.mapper) == recipe_of(paper.mapper)
    others = {} if same else {"paper": ("the paper to the letter", paper)}
    settings: dict[str, Any] = {"seed": seed, "second": views, "others": others, "progress": True}
    result = compare(reference, query, model=model, storage_curve=True, **settings)
    _publish(result, out, "dejavu demo: the built-in route", command)
    _print_localize(out / "map.safetensors", model, command, localized, "or try")
    for pair in ((learned, localized, "--config", "local_maxima"), ("MORNING", "EVENING")):
        print_next("compare", *pair, "--out", "report", lead="or try")


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
            strip:IMAGE?width=96; several follow each other along one route
        map: map file to write (.safetensors)
        cluster: encode the chunks of a long route on Ray workers: auto starts one per processor, else the
            address of a cluster. They read the sources by the same paths
    """
    append = growing.append
    if not sources and not (append and growing.average):
        raise InputError("there is no source; expected one, or --append MAP with --average SOURCE")
    assert map is not None  # the parser checks it
    where = device_of(learning.device, learns=True)
    model = growing.model(model).to(where)
    if cluster is not None:
        _check_cluster(cluster, learning.device, model.mapper)
    _check_map_file(map, *sources, *learning.files, growing.average, growing.average_truth)
    learning.seed_whitening(model)
    growing.check(sources, learning.calibration)
    traverse: Traverse | None = None
    if sources:
        chain = chained([open_source(one) for one in sources])
        traverse = model.resample(chain, model.step, True, model.frame_shape)
        _print_steps(traverse)
    visits = None if growing.average is None else growing.visits(model, traverse)
    learning.check_calibrated(model, visits.traverse if traverse is None else traverse)  # type: ignore[union-attr]
    traverse, views, known = learning.with_views(model, traverse)
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
            growth.append(model, traverse, True, checkpoint, map_tasks, visits)
            places = torch.arange(start, model.map.places)
            known = known and known._replace(places=known.places + torch.where(known.places >= 0, start, 0))
            done = f"{len(places)} places appended to the {start} of {append}; written to {map}"
        elif visits is not None:
            growth.learn_mean(model, traverse, visits, True, views, checkpoint, map_tasks)
        else:
            model.learn(traverse, True, views, checkpoint, map_tasks)
    if cluster is not None and append is None and model.map.places <= SHORT:
        print(f"--cluster {cluster} is not used for {model.map.places} frames, only for more than {SHORT}")
    if learning.calibration != options.NO_CALIBRATION:
        growth.calibrate_if_possible(model, traverse, known, places, True)
    model.matching()
    model.save(map)
    checkpoint.remove()
    print_map(model)
    if done:
        _say(done)
    _print_localize(map, model, command)


def run_localize(
    map: Path,
    source: str,
    *,
    out: Path,
    acceptance: options.Acceptance,
    top: int | None = None,
    loops: int | None = None,
    pairs: Path | None = None,
    corners: list[list[float]] | None = None,
    sequences: options.Sequences,
    ordering: options.Ordering,
    searching: options.Searching,
    cluster: str | None = None,
    skip_damaged: bool = False,
    loading: options.Loading,
) -> None:
    """Find the frames of a source on a map.

    Args:
        map: map file
        source: frames to find, as in `dejavu learn`
        out: csv of query,place,score,accepted[,probability],confidence[,rank][,route],query_name,place_name
        top: write this many places per query, no two within 5 of each other, each in a row with its rank; a
            probability is that of the first
        loops: find where a drive comes back to places it has passed, if the map was learned from it: this
            many frames before each, and those after it, are no answers
        pairs: also write lines `query_name place_name` for hloc and COLMAP, one per place
        corners: where this camera sees the patch of ground that the map's --velocity.corners describe
        cluster: divide the map among Ray workers, as in `dejavu learn`; for single queries only
        skip_damaged: frames that cannot be read find nothing, and do not stop the others
    """
    device_of(loading.device)
    _check_written(out, pairs, map, source)
    matcher = sequences.matcher(SUPPRESSION, acceptance.threshold)
    ordered = ordering.of(matcher)
    acceptance.check(matcher)
    if cluster is not None:
        _check_cluster(cluster, loading.device)
        options.refuse_with(f"--cluster {cluster}", match=matcher not in (None, "auto") and sequences.way)
        matcher = None
    model = loading.model(map)
    searching.of(model)
    if corners is not None:
        why = "--as_is measures no ground" if loading.as_is else f"{map} was learned without --velocity"
        _set_corners(model, corners, why)
    acceptance.of(model)
    if top is not None:
        check_candidates(top, SUPPRESSION, model.map.places)
    damaged: dict[int, str] | None = {} if skip_damaged else None
    query = _open_query(model, source, map if pairs else None, damaged)
    ordered = source_of(query).ordered if ordered is None else ordered
    if isinstance(matcher, str):
        matcher = PlaceSmoother(within=SUPPRESSION, threshold=acceptance.threshold) if ordered else None
    chosen = model.matching(matcher).acceptance
    smooths = isinstance(matcher, PlaceSmoother)
    centre = (smooths or matcher is None) and ordering.centring(model, ordered, len(query))
    if loops is not None:
        together = sequences.way not in (None, "drive", "single") and sequences.way
        given = {"top": top, "cluster": cluster, "match": together, "centre": ordering.centre}
        options.refuse_with(f"--loops {loops}", **given)
        chosen = model.loop_matching(loops, PlaceSmoother() if smooths else None).acceptance
        matches = iter([model.loops(query, loops, smooths, True)])
        matcher = None
    else:
        matches = model.matches(query, True, matcher, None, top, SUPPRESSION, centre)
    if top is not None:
        matches = (part.map(Tensor.flatten) for part in matches)
    counts: Counter[str] = Counter()

    def counted() -> Iterator[Match]:
        for match in matches:
            counts.update(probable_counts(match))
            yield match

    with ExitStack() as stack:
        if cluster is not None:
            from dejavu_torch.cluster import Cluster, ClusterSearch

            workers = stack.enter_context(Cluster(cluster))
            model.searcher = ClusterSearch(workers, model.map, searching.search, searching.bytes)
        total, accepted = _write_matches(out, counted(), query, model, top, pairs)
    if not model.map.summary().covered:
        print("the map has no layers, so no place can be reported")
    elif not chosen.given:
        print(chosen)
    if isinstance(matcher, PlaceSmoother) and not matcher.is_drive:
        print(NO_DRIVE)
    if damaged:
        one, many = min(damaged), len(damaged)
        print(f"{many} frame{'s' * (many > 1)} could not be read, such as {one}: {damaged[one]}")
    _say(f"{total} queries, {accepted} accepted; written to {out}")
    if counts:
        steps = next_steps(matcher is not None, chosen.given)
        _say(describe_probable(counts, total) + (f"; next: {'; '.join(steps)}" if steps else ""))
    table: tuple[str | Path, ...] = () if model.step is None else ("--map", map)
    table += ("--route", "ROUTE") if model.map.routes else ()
    print_next("evaluate", out, "--truth", "TRUTH", *table, "--out", "scores")


def _check_written(out: Path, pairs: Path | None, *read: str | Path) -> None:
    """Refuse files that cannot be written, are read, or are the same."""
    for written in filter(None, (out, pairs)):
        check_output_file(written)
        check_not_read(written, *read)
    if pairs is not None and pairs.resolve() == out.resolve():
        raise InputError(f"--pairs {pairs} is --out as well; expected another name")


def _open_query(model: DejaVu, source: str, paired: Path | None, damaged: dict[int, str] | None) -> Traverse:
    """The queries as a model localizes them.

    Args:
        paired: the map's file, if its and their names have to fit a file of pairs. damaged: gets the frames
            that cannot be read; None refuses them.
    """
    from dejavu_torch.evaluation.matches import check_pair_names

    query = open_source(source)
    if paired is not None:
        check_pair_names(model.frame_names, f"the map {paired}")
        check_pair_names(query.names, query.name)
    query = query if damaged is None else Whole(query, damaged)
    query = model.at_map_size(query, model.frame_shape or ())
    if model.step is not None:
        query = model.resample(query, model.step, True, model.frame_shape)
    _print_steps(query)
    return query


def _set_corners(model: DejaVu, corners: list[list[float]], why: str) -> None:
    """Let a model measure another camera's ground; `why` it measures none is for the message."""
    if model.velocity is None or model.step is None:
        raise InputError(f"--corners {corners}: {why}; expected a map and frames at even steps")
    check_corners(corners)
    model.velocity.corners = tuple((float(x), float(y)) for x, y in corners)


def run_live(
    map: Path,
    source: str,
    *,
    sequences: options.LiveSequences,
    searching: options.Searching,
    acceptance: options.Acceptance,
    page: int | None = None,
    reference: str | None = None,
    realtime: bool = False,
    timeout: float = 10.0,
    loading: options.Loading,
) -> None:
    """Find frames as they arrive: a line of JSON for each on stdout, a summary on stderr at the end.

    Frames are resized to the size of the map's frames.

    Args:
        map: map file
        source: a camera (/dev/video0), an address (rtsp://host/path), a named pipe, - for standard input, or
            a source as in `dejavu learn`. Cameras, addresses and pipes always give their newest frame and
            drop those that arrived meanwhile; files drop none
        page: show frame, reference frame and posterior at http://127.0.0.1:PORT; 8765 if no port is given, 0
            for any free port. A file then plays in real time, and the page stays until Ctrl-C
        reference: what the map was learned from, a source as in `dejavu learn`, for the pictures of the page
        realtime: play a video in real time, and drop frames that arrive too fast
        timeout: seconds without a frame after which a camera, address or pipe has stalled
    """
    from dejavu_torch.cli.live import follow
    from dejavu_torch.data.camera import without_password

    device_of(loading.device)
    if reference is not None and page is None:
        raise InputError(f"--reference {reference} without --page; expected both")
    if not 0 < timeout <= threading.TIMEOUT_MAX:
        raise InputError(f"--timeout {timeout:g}; expected seconds, above 0")
    matcher = sequences.matcher(SUPPRESSION, acceptance.threshold)
    assert not isinstance(matcher, str)  # the default is the filter
    acceptance.check(matcher)
    model = loading.model(map)
    searching.of(model)
    acceptance.of(model)
    model.matching(matcher)
    title, centre = f"{without_password(source)} on {map}", sequences.centre == "mean"
    follow(model, matcher, source, title, page, reference, realtime, timeout, centre)


def run_compare(
    reference: str,
    query: str | None = None,
    *,
    out: Path,
    loops: int | None = None,
    judging: options.EvaluationOptions,
    learning: options.LearningOptions,
    map: Path | None = None,
    sequences: options.Sequences,
    ordering: options.Ordering,
    searching: options.Searching,
    model: DejaVu,
    command: str,
) -> None:
    """Learn one traverse, localize another on it, and evaluate, with baselines and a null control.

    Args:
        reference: traverse to learn, a source as in `dejavu learn`
        query: traverse to localize, likewise; none with --loops
        loops: find where the reference comes back to its own places, as in localize
        out: folder for report, pictures, matches.csv and map.safetensors
        map: evaluate this map of the reference instead of learning one
    """
    from dejavu_torch.evaluation.compare import compare

    _check_loops(loops, query, sequences, ordering, judging)
    where = device_of(learning.device, learns=map is None)
    acceptance = options.Acceptance(model.threshold, model.precision)
    matcher = sequences.matcher(max(0, judging.tolerance), acceptance.threshold)
    ordered = ordering.of(matcher)
    acceptance.check(matcher, judging.distractors)
    if map is not None:
        model = options.load_map(map, options.named_features(model))
        if model.map.routes:
            names = ", ".join(route.name for route in model.map.routes)
            raise InputError(f"--map {map} has the routes {names}; expected a map of {reference} alone")
        acceptance.of(model)
    searching.of(model.to(where))
    first = open_source(reference)
    queries = first if query is None else open_source(query)
    if isinstance(matcher, str):
        in_order, within = queries.ordered if ordered is None else ordered, max(0, judging.tolerance)
        matcher = PlaceSmoother(within=within, threshold=acceptance.threshold) if in_order else None
    if isinstance(matcher, PlaceFilter | PlaceSmoother) and acceptance.threshold is not None and query:
        model.threshold = None  # it is for a probability, so the map must not keep it
    seconds = options.several(learning.second)
    _check_report_folder(
        out, COMPARED, [reference, *filter(None, [query]), *seconds], [judging.truth, *learning.files]
    )
    others = [open_source(one) for one in (*seconds, learning.calibration) if one not in options.UNREAD]
    distractors = judging.off_map([first, queries, *others])
    if not isinstance(matcher, PlaceSmoother):  # which has probabilities of its own
        learning.check_calibrated(model, first, map, judging.distractors)
    learning.seed_whitening(model)
    first, views, known = learning.with_views(model, first, queries)
    result = compare(
        first,
        None if query is None else queries,
        judging.truth,
        model,
        tolerance=judging.tolerance,
        leave_out=judging.leave_out,
        seed=learning.seed,
        interpolate=judging.interpolate,
        second=views,
        sequence=matcher,
        top=1 if judging.top is None else judging.top,
        calibration="none" if learning.calibration == options.NO_CALIBRATION else known,
        distractors=distractors,
        storage_curve=judging.storage_curve,
        ordered=ordered,
        centre=None if ordering.centre is None else ordering.centre == "mean",
        loops=loops,
        progress=True,
    )
    title = f"loops within {reference}" if query is None else f"{query} found on {reference}"
    _publish(result, out, title, command, map, judging.top)


def _check_loops(
    loops: int | None,
    query: str | None,
    sequences: options.Sequences,
    ordering: options.Ordering,
    judging: options.EvaluationOptions,
) -> None:
    """Refuse a comparison without a query, and loops with what needs one."""
    if loops is None:
        if query is None:
            raise InputError("compare without QUERY; expected a second traverse, or --loops within the first")
        return
    if query is not None:
        raise InputError(f"--loops {loops} and the query {query}; expected the reference alone")
    together = sequences.way not in (None, "drive", "single") and sequences.way
    alone = {"match": together, "centre": ordering.centre, "top": judging.top}
    of_routes = {"distractors": judging.distractors, "storage_curve": judging.storage_curve}
    options.refuse_with(f"--loops {loops}", **alone, **of_routes, leave_out=judging.leave_out)


def run_evaluate(
    matches: Path,
    *,
    truth: str,
    out: Path,
    tolerance: int = 5,
    interpolate: bool = False,
    reference: str | None = None,
    query: str | None = None,
    map: Path | None = None,
    route: str | None = None,
    recall_values: Sequence[int] = (),
    higher_is_better: bool = False,
    loops: int | None = None,
    command: str,
) -> None:
    """Evaluate the matches of any method from a csv: scores, curve, coverage.

    Args:
        matches: csv of query,place,score[,accepted][,probability][,rank][,route]
        truth: right places, as in `dejavu compare`
        out: folder for report and pictures
        tolerance: answers up to this many places off are right
        interpolate: interpolate a --truth that lists only some queries
        reference: source of the places, for their number and coordinates in names; as in `dejavu learn`
        query: source of the queries, likewise
        map: map of the matches, for its number of frames and, if they are resampled, their places
        route: route of a merged map that --truth, --reference and the queries belong to; answers on other
            routes are wrong
        recall_values: also print the share of queries with a right answer among their first N ranks, for each
            N, such as 1 5 10 20; with --tolerance 0 these are the figures of VPR-methods-evaluation
        higher_is_better: the scores are similarities, not distances
        loops: as in localize: only places over this many frames before a query are right
    """
    from dejavu_torch.evaluation.evaluate import evaluate_file
    from dejavu_torch.evaluation.report import report_folder, write_report

    first, second = (None if source is None else open_source(source) for source in (reference, query))
    _check_report_folder(out, (), [reference, query], [matches, truth, map])
    given = first, second, map, route, recall_values, higher_is_better, loops
    result = evaluate_file(matches, truth, tolerance, interpolate, *given)
    with report_folder(out) as folder:
        title = f"{matches} evaluated by {truth}"
        write_report(folder, result.report, result.pictures, title, command)
    _print_contradiction(result.report)
    if recall_values:
        recalls = result.report.facts["recall_values"]
        print(", ".join(f"R@{first}: {100 * recall:.1f}" for first, recall in recalls.items()))
        if tolerance:
            off = f"{tolerance} {result.report.facts['unit']}"
            print(f"answers may be {off} off here; in VPR-methods-evaluation they may not")
    _print_scores(result.report, out)


def run_reproduce(
    dataset: str = "all", *, out: Path, seed: int = 0, tolerance: int = 5, command: str
) -> None:
    """Repeat the paper's experiments on simulated routes, and compare with its published numbers.

    Args:
        dataset: aerial, outdoor, underground or all
        out: folder for the reports
        seed: seed of the routes
        tolerance: answers up to this many places off are right
    """
    from dejavu_torch.evaluation import paper_tables as tables
    from dejavu_torch.evaluation.report import report_folder, text_table, write_index, write_report
    from dejavu_torch.evaluation.reproduce import lengths_picture, reproduce

    names = list(tables.PUBLISHED) if dataset == "all" else [dataset]
    if not {*names} <= {*tables.PUBLISHED}:
        raise InputError(f"there is no dataset {dataset!r}; expected {', '.join(tables.PUBLISHED)} or all")
    check_output_folder(out)
    reports: dict[str, Report] = {}
    for name in names:
        print(f"{name}: a second traverse, the reference itself, other chunk lengths", flush=True)
        result = reproduce(name, tolerance=tolerance, seed=seed, progress=True)
        run, title = result.run, f"dejavu reproduce: {name}"
        plan = str(run.model.summary())
        with report_folder(out / name) as folder:
            write_report(folder, result.report, result.pictures, title, command, plan)
            _write_matches(folder / "matches.csv", [run.match], run.query, run.model)
        reports[name] = result.report
    rows = tables.section_five(reports)
    notes = [*tables.route_lines(reports), *tables.boundary_lines(reports), tables.FOOTAGE]
    pages = {name: f"{name}/index.html" for name in names}
    with whole_folder(out) as folder:
        write_index(folder, rows, notes, lengths_picture(reports), pages, "the paper's experiments", command)
    print("\n".join([text_table(rows), *notes]))
    _say(f"right within {tolerance} places; next: open {out / 'index.html'}")


def run_export(
    map: Path,
    *,
    onnx: Path,
    sequences: options.Sequences,
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

    if onnx.suffix != ".onnx":
        raise InputError(f"--onnx {onnx} is no name of an ONNX file; expected one such as route.onnx")
    check_output_file(onnx)
    check_not_read(onnx, map)
    matcher = sequences.matcher(SUPPRESSION, threshold)
    matcher = None if isinstance(matcher, str) else matcher
    model = options.load_map(map, features)
    options.Acceptance(threshold).of(model)
    if matcher is not None and model.precision is not None:
        seen = f"the map's precision, {model.precision}, only holds for single frames in an ONNX file"
        raise InputError(f"{seen}; expected --threshold with a sequence or a filter")
    written = export_onnx(model, onnx, matcher, centre == "mean")
    for kind in ("inputs", "outputs"):
        shapes = (f"{name} {tuple(shape)}" for name, shape in written.facts[kind].items())
        print(f"{kind}: {', '.join(shapes)}".replace("'", ""))
    size = f"{written.bytes / 1e6:.1f} MB, opset {OPSET}"
    _say(f"{size}; {written.difference:.1g} from torch at most, on noise; written to {onnx}")


def run_refine(
    map: Path,
    drives: Sequence[str],
    *,
    out: Path | None = None,
    loading: options.Loading,
    command: str,
) -> None:
    """Learn from drives, whose places nobody tells, what changes along a map; its places stay as they are.

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
    """Refine a map by drives, as `dejavu refine`, and append ground that it lacks as routes of their own.

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
        _say(f"{drive.name}: {found}")
        changed |= found.changed
    if changed:
        model.save(out)
        print_map(model)
        _print_localize(out, model, command)


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
    if len(maps) < 2:
        raise InputError(f"{maps[0]} alone; expected at least two maps to merge")
    models = [options.load_map(path, copy.deepcopy(features)) for path in maps]
    model = growth.merge(models, [path.stem for path in maps])
    model.save(map)
    print_map(model)
    _print_localize(map, model, command)


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
        _print_localize(map, model, command)
    else:
        words = features_words(model, command)
        print_next("learn", "ROUTE", "--descriptor", map, *words, "--map", "route.safetensors")


def _check_cluster(cluster: str, device: str, mapper: Mapper | None = None) -> None:
    """Refuse early what no cluster does, or not with this mapper."""
    from dejavu_torch.cluster import check_installed

    options.refuse_with(f"--cluster {cluster}", device=device != "cpu" and device)
    check_installed()
    if not isinstance(mapper, SpectralMapper | None):
        seen = f"--cluster {cluster} encodes chunks, and {type(mapper).__name__} has none"
        raise InputError(f"{seen}; expected a spectral map")


def _check_map_file(path: Path, *read: str | Path | None, option: str = "--map") -> None:
    """Refuse early a map file that cannot be written or is also read."""
    if path.suffix != ".safetensors":
        expected = path.with_suffix(".safetensors") if path.name else "such as route.safetensors"
        raise InputError(f"{option} {path} is not the name of a map; expected {expected}")
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


def _check_report_folder(
    out: Path, others: Sequence[str], sources: Sequence[str | None], files: Sequence[str | Path | None] = ()
) -> None:
    """Refuse early a folder that cannot be written, or in which files that are read would be lost.

    Args:
        others: files written there besides the report. sources, files: that are read.
    """
    check_not_read(out, *sources)
    check_output_folder(out)
    if out.is_dir():
        from dejavu_torch.evaluation.report import PICTURES

        for name in ("index.html", "report.json", *others, *(f"{name}.png" for name in PICTURES)):
            check_output_file(out / name)
            check_not_read(out / name, *sources, *files)


def _print_steps(traverse: Traverse) -> None:
    if isinstance(traverse, ResampledTraverse):
        steps = f"{len(traverse)} even steps of {traverse.step:.4g} pixels of ground"
        print(f"{len(traverse.positions)} frames resampled to {steps}")


def print_map(model: DejaVu) -> None:
    """Print what a map holds, and the bytes that would hold enough if that is little."""
    summary, start = model.summary(), 0
    if summary.places and not summary.covered:
        print("this route does not repeat")
    print(summary)
    for route in model.map.routes:
        assert isinstance(model.map, SpectralMap)  # only these can be merged
        size, stop = model.map.part(route.name).summary().route_bytes, start + route.places
        frames = f" of {route.frames} frames" * (route.frames != route.places)
        text = f"route {route.name}: places {start}-{stop - 1}{frames}, {size} bytes"
        _say(f"{text}, {size / route.places:.2f} per place")
        start = stop
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


def _print_localize(map: Path, model: DejaVu, command: str, query: str = "QUERY", lead: str = "next") -> None:
    if not model.map.summary().covered:
        print(f"{lead}: try more frames, another --preprocess.contrast, or `dejavu train fit`")
        return
    words = features_words(model, command)
    print_next("localize", map, query, *words, "--out", "matches.csv", lead=lead)


def print_next(*words: object, lead: str = "next") -> None:
    """Print the command to run next."""
    _say(f"{lead}: {shlex.join(['dejavu', *(str(word) for word in words)])}")


def _say(text: str) -> None:
    """Print a line that may hold names of files."""
    print(printable(text))


def _publish(
    result: Comparison, out: Path, title: str, command: str, given: Path | None = None, top: int | None = None
) -> None:
    """Write map, matches and report of a comparison, and print its scores.

    Args:
        given: file of the map, unless it was learned.
        top: candidates of each query to write; None writes the matches.
    """
    from dejavu_torch.evaluation.report import report_folder, write_report

    run, kept = result.run, out / "map.safetensors"
    acceptance = run.model.acceptance(run.smoother or run.sequence)
    _print_contradiction(result.report)
    print_map(run.model)
    if run.truth is None:
        print("no ground truth (see --truth): matches and pictures, but no scores")
    if not acceptance.given:
        print(acceptance)
    match = run.match
    if top is not None:
        match = result.candidates.map(lambda column: column[:, :top].flatten())
    with report_folder(out) as folder:
        if given is None or given.resolve() != kept.resolve():
            run.model.save(folder / kept.name)
        _write_matches(folder / "matches.csv", [match], run.query, run.model, top)
        write_report(folder, result.report, result.pictures, title, command, str(run.model.summary()))
    _print_scores(result.report, out)


def _write_matches(
    path: Path,
    matches: Iterable[Match],
    query: Traverse,
    model: DejaVu,
    ranks: int | None = None,
    pairs: Path | None = None,
) -> tuple[int, int]:
    """Write the matches of a query; returns the numbers of queries and of accepted answers."""
    from dejavu_torch.evaluation.matches import write_matches

    frames, source = None, query
    if isinstance(query, ResampledTraverse):
        frames, source = query.frame, query.traverse
    names = source.names, model.frame_names
    return write_matches(path, matches, frames, model.map.frame_of, *names, ranks, model.map.routes, pairs)


def _print_contradiction(report: Report) -> None:
    """Say first if the answers contradict the ground truth."""
    if report.ours.scores is not None and "line" in report.facts:
        _say(describe_line(report.facts, True))


def _print_scores(report: Report, out: Path) -> None:
    from dejavu_torch.evaluation import report as page
    from dejavu_torch.evaluation.rejection import rejection_table

    rejection = rejection_table(report.facts.get("rejection", {}))
    for rows in (page.score_table(report), page.sequence_table(report), rejection):
        if rows:
            print(page.text_table(rows))
    _say(page.summary(report))
    if report.ours.scores is not None:
        _say(page.verdict(report))
    else:
        if line := describe_line(report.facts, False):
            _say(line)
        if steps := page.steps_after(report.facts):
            _say(f"next: {steps}")
    _say(f"next: open {out / 'index.html'}")
