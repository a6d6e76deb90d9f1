"""`dejavu localize` and `dejavu live`: frames found on a map."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.cli import options
from dejavu_torch.cli.commands import (
    SUPPRESSION,
    check_cluster,
    print_next,
    print_steps,
    say,
    write_matches,
)
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.output import check_output_file
from dejavu_torch.data.source import check_not_read, open_source
from dejavu_torch.data.traverse import Whole
from dejavu_torch.evaluation.answers import describe_probable, next_steps, probable_counts
from dejavu_torch.evaluation.second_look import is_doubtful, second_look
from dejavu_torch.maps.digest import BYTES, digests_of
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.ground_plane import check_corners
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.recognition.calibration import TOLERANCE
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.select import PROBABLE, Acceptance, check_candidates
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.text import refuse_with
from dejavu_torch.types import InputError, Match, SequenceModel, Traverse, expect

NO_DRIVE = "the queries do not look like a drive on this map: each is matched by itself"


def run_localize(
    map: Path,
    source: str,
    *,
    out: Path,
    acceptance: options.Acceptance,
    route: str | None = None,
    pairs: Path | None = None,
    corners: list[list[float]] | None = None,
    querying: options.LocalQuerying,
    searching: options.Searching,
    cluster: str | None = None,
    skip_damaged: bool = False,
    loading: options.Loading,
) -> None:
    """Find the frames of a source on a map.

    Args:
        map: map file
        source: frames to find, as in `dejavu learn`
        out: csv of query,place,score,accepted[,probability],confidence[,heading][,shift[,shift_degrees]]
            [,rank][,route][,x,y],query_name,place_name
        route: find places of this route of a merged map alone
        pairs: also write lines `query_name place_name` for hloc and COLMAP, one per place
        corners: where this camera sees the patch of ground that the map's --velocity.corners describe
        cluster: divide the map among Ray workers, as in `dejavu learn`; for single queries only
        skip_damaged: go on if frames cannot be read; they find nothing
    """
    device_of(loading.device)
    _check_written(out, pairs, map, source, str(querying.moved or ""))
    querying.check_loops(cluster=cluster)
    matcher = querying.matcher(SUPPRESSION, acceptance.threshold)
    ordered = querying.order(matcher)
    acceptance.check(matcher)
    if cluster is not None:
        check_cluster(cluster, loading.device)
        refuse_with(f"--cluster {cluster}", match=matcher not in (None, "auto") and querying.way)
        matcher = None
    model = loading.model(map, route)
    searching.of(model)
    if corners is not None:
        why = "--as_is measures no ground" if loading.as_is else f"{map} was learned without --velocity"
        _set_corners(model, corners, why)
    acceptance.of(model)
    if querying.top is not None:
        check_candidates(querying.top, SUPPRESSION, model.map.places)
    damaged: dict[int, str] | None = {} if skip_damaged else None
    query = _open_query(model, source, map if pairs else None, damaged)
    ordered = source_of(query).ordered if ordered is None else ordered
    if matcher == "auto":
        matcher = querying.matcher(SUPPRESSION, acceptance.threshold, ordered)
    assert not isinstance(matcher, str)
    asked = replace(querying.by(matcher), ordered=ordered)
    digests = [torch.zeros(0, BYTES, dtype=torch.uint8)]
    matches, chosen = _found(model, query, asked, lambda rows: digests.append(digests_of(rows, follow=False)))
    counts, ways = Counter[str](), list[SequenceModel]()

    def counted() -> Iterator[Match]:
        for match in matches:
            counts.update(probable_counts(match))
            ways.extend([] if match.smoother is None else [match.smoother])
            yield match

    with ExitStack() as stack:
        if cluster is not None:
            from dejavu_torch.cluster import Cluster, ClusterSearch

            workers = stack.enter_context(Cluster(cluster))
            model.searcher = ClusterSearch(workers, model.map, searching.search, searching.bytes)
        total, accepted = write_matches(out, counted(), query, model, querying.top, pairs)
    if not model.map.summary().covered:
        print("the map has no layers, so no place can be reported")
    elif not chosen.given:
        print(chosen)
    if querying.loops is None and not all(way.is_drive for way in ways):
        print(NO_DRIVE)
    if damaged:
        one, many = min(damaged), len(damaged)
        print(f"{many} frame{'s' * (many > 1)} could not be read, such as {one}: {damaged[one]}")
    say(f"{total} queries, {accepted} accepted; written to {out}")
    itself = querying.loops is not None
    doubts = [] if itself else model.provenance.doubts(model.map, torch.cat(digests), query)
    told = bool(counts) and not itself and cluster is None
    if told and is_doubtful(counts[f"{PROBABLE:g}"], total, next(iter(ways), None)):
        doubts += second_look(model, query, bool(ordered))
    for doubt in doubts:
        say(str(doubt))
    if counts:
        steps = next_steps(matcher is not None and querying.loops is None, chosen.given)
        probable = f"{describe_probable(counts, total)}, of being within {TOLERANCE} places"
        say(probable + (f"; next: {'; '.join(steps)}" if steps else ""))
    _print_evaluate(out, model, map, source if query.coordinates is not None else "SOURCE")


def _found(
    model: DejaVu, query: Traverse, querying: Querying, heard: Callable[[Tensor], object]
) -> tuple[Iterator[Match], Acceptance]:
    """The matches of a query, of which candidates follow each other, and how they are accepted."""
    matcher, loops, top = querying.matcher(), querying.loops, querying.top
    assert not isinstance(matcher, str)
    smooths, acceptance = matcher is not None and matcher.whole, model.matching(matcher).acceptance
    if loops is not None:
        acceptance = model.loop_matching(loops, PlaceSmoother() if smooths else None).acceptance
    else:
        centre = smooths or matcher is None
        centre &= querying.centres(querying.ordered and model.centres(len(query)))
        querying = replace(querying, centre="mean" if centre else "none")
    matches = model.matches(query, querying, True, apart=SUPPRESSION, heard=heard)
    return matches if top is None else (part.map(Tensor.flatten) for part in matches), acceptance


def _print_evaluate(out: Path, model: DejaVu, map: Path, source: str) -> None:
    """Print the command that scores the matches; in an area, of a source with coordinates."""
    layout = model.map.layout
    truth = layout.truth(2 * layout.spacing)
    needed: tuple[str | Path, ...] = ("--map", map) if model.step is not None or truth else ()
    needed += ("--query", source) if truth else ()
    needed += ("--route", "ROUTE") if layout.count > 1 else ()
    print_next("evaluate", out, "--truth", truth or "TRUTH", *needed, "--out", "scores")


def _check_written(out: Path, pairs: Path | None, *read: str | Path) -> None:
    """Refuse files that cannot be written, are read, or are the same."""
    for written in filter(None, (out, pairs)):
        check_output_file(written)
        check_not_read(written, *read)
    expect(pairs is None or pairs.resolve() != out.resolve(), "another name", f"--pairs {pairs} is --out")


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
    print_steps(query)
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
    route: str | None = None,
    realtime: bool = False,
    timeout: float = 10.0,
    loading: options.Loading,
) -> None:
    """Localize frames as they arrive: print a line of JSON for each, and a summary on stderr at the end.

    Frames are resized to the size of the map's frames.

    Args:
        map: map file
        source: a camera (/dev/video0), an address (rtsp://host/path), a named pipe, - for standard input, or
            a source as in `dejavu learn`. Cameras, addresses and pipes always give their newest frame and
            drop those that arrived meanwhile; files drop none
        page: show frame, reference frame and posterior at http://127.0.0.1:PORT; 8765 if no port is given, 0
            for any free port. A file then plays in real time, and the page stays until Ctrl-C
        reference: the source that the map was learned from, for the pictures of the page
        route: find places of this route of a merged map alone
        realtime: play a video in real time, and drop frames that arrive too fast
        timeout: seconds without a frame after which a camera, address or pipe has stalled
    """
    from dejavu_torch.cli.live import follow
    from dejavu_torch.data.camera import without_password

    device_of(loading.device)
    expect(reference is None or page is not None, "both", f"--reference {reference} without --page")
    expect(0 < timeout <= threading.TIMEOUT_MAX, "seconds, above 0", f"--timeout {timeout:g}")
    matcher = sequences.matcher(SUPPRESSION, acceptance.threshold)
    assert not isinstance(matcher, str)  # the default is the filter
    acceptance.check(matcher)
    model = loading.model(map, route)
    searching.of(model)
    acceptance.of(model)
    model.matching(matcher)
    title, centre = f"{without_password(source)} on {map}", sequences.centre == "mean"
    settings = centre, sequences
    follow(model, matcher, source, title, page, reference, realtime, timeout, *settings)
