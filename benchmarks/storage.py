"""Accuracy over bytes: the map beside what else would keep the same descriptors."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.coded_video import CodedVideo
from benchmarks.measure import Contender, Row, new_row, peak_memory, with_ratios, write_bench
from benchmarks.plots import plot_frontiers
from benchmarks.quantisers import Kept, ProductQuantiser, every_kth, principal, signs, spectral
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.output import check_output_folder
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.baselines import as_int8, between_keyframes, every, nearest_frames
from dejavu_torch.evaluation.contenders import LENGTHS, evaluate_each, lengths_beside, sequences_as_json
from dejavu_torch.evaluation.reproduce import paper_model
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import ground_truth_of
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError, Match, Traverse

BUDGETS = (0.5, 1.0, 1.6, 2.5, 3.2, 5.0, 10.0, 16.0)  # route bytes per place of ours and of the null
SHOWN = (1.0, 1.6, 3.2, 5.0, 10.0)  # of the table
NEAR = 1.02  # a budget is met by what takes at most so much of it
SPACED = (1, 2, 3, 4, 5, 8, 10)  # k of every k-th frame as it is
BETWEEN = (8, 10, 16, 25, 40, 64, 100)  # and with straight lines between
COMPONENTS, COMPONENT_SPACED = (2, 4, 8, 16, 32), (1, 2, 5, 10)
CODE_BYTES, CODE_SPACED = (4, 8, 16, 32), (2, 3, 4, 5, 8)
BIT_SPACED = (1, 2, 3, 4, 5, 8, 10, 16)
QUALITIES, VIDEO_SPACED = (24, 32, 40, 51), (1, 4, 8)  # crf
BUILT_IN = {"aerial": (3072, 10_000), "outdoor": (0,), "underground": (0,)}  # frames, 0 the whole route
WHITENINGS: Mapping[str, Mapping[str, int]] = {  # other settings than the defaults
    "16 bits": {"bits": 16},
    "8 bits": {"bits": 8},
    "64 numbers": {"numbers": 64},
    "32 numbers": {"numbers": 32},
}
WHITENED = 5.0  # route bytes per place of the map behind each of them
LEVEL = 0.95  # an area that tells stores apart: near 1 it hangs on single queries
TOLERANCE = 5
KEYS = (
    *("family", "seconds", "peak_bytes", "bytes", "fixed_bytes", "route_bytes", "route_bytes_per_place"),
    *("recall_at_1", "auc", "sequences", "ratio_to_ours", "skipped"),
)
OURS, NULL, OTHERS = "dejavu", "null", "dejavu, other whitenings"


class Route(NamedTuple):
    """A route described: places (N,K) and queries (Q,K), whitened alike.

    reference: the frames of the places. fixed: bytes of the whitening, which every contender needs.
    """

    name: str
    model: DejaVu
    reference: Traverse
    query: Traverse
    places: Tensor
    queries: Tensor
    truth: GroundTruth
    fixed: int


class Answer(NamedTuple):
    """What a contender finds, and its bytes: those that grow with the route, and all others."""

    found: Match
    route: int
    fixed: int


def bench_storage(
    sources: Sequence[str] = (),
    places: Sequence[int] = (),
    codebooks: str | None = None,
    given: DejaVu | None = None,
    whitening: DejaVu | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Iterator[Row]:
    """Accuracy over bytes of all contenders on all routes, a row at a time.

    Args:
        sources: REFERENCE QUERY, any number of pairs; none are the built-in routes.
        places: frames of `sim:aerial`, in place of 3072 and 10000.
        codebooks: another route of frames of the same size, on which codebooks of product quantisers are
            trained that then count nothing. The built-in routes have seed 1 of the same simulator.
        given: a model with a map of the one pair's reference, set beside the others.
        whitening: a model whose whitening describes all routes; None learns one for each.
        seed: of the whitening and the null. progress: show progress bars on a terminal.

    Yields:
        family: of contenders that make one front. seconds: to store the route and match all queries; of what
        has descriptors of its own with describing all frames, and of the first of several rows that share a
        training with that. peak_bytes: most memory held meanwhile beyond what was held before.
        ratio_to_ours: seconds over those of our fastest. bytes: of all, with the whitening; those that do not
        grow with the route are `fixed_bytes`, the others `route_bytes`. sequences: by T, scores of T queries
        together. skipped: why there are no figures.

    Raises:
        InputError: sources that are no pairs or do not fit each other, and what the sources raise.
    """
    routes = _routes(sources, places, codebooks, given)
    for _, reference, query, _ in routes:
        for model in (_model(whitening), given):
            if model is not None:
                _check(model, reference, query)
    for name, reference, query, other in routes:
        route = described(name, reference, query, _model(whitening), seed, progress)
        contenders = list(contenders_of(route, other, given, seed))
        for contender in tqdm(contenders, name, disable=None if progress else True, leave=False):
            yield judged(route, contender)


def _routes(
    sources: Sequence[str], places: Sequence[int], codebooks: str | None, given: DejaVu | None
) -> list[tuple[str, Traverse, Traverse, Traverse | None]]:
    """Name, reference, query and the route of the free codebooks of each route; all refused early."""
    if len(sources) % 2:
        raise InputError(f"bench storage got {len(sources)} sources; expected pairs, REFERENCE QUERY ...")
    if given is not None and len(sources) != 2:
        raise InputError(f"a map is of one route, and there are {len(sources)} sources; expected one pair")
    if sources and places:
        raise InputError("--places are of the built-in sim:aerial; expected none beside sources")
    if places and min(places) < 2:
        raise InputError(f"--places {' '.join(map(str, places))}; expected at least 2 each")
    if sources:
        other = None if codebooks is None else open_source(codebooks)
        pairs = list(zip(sources[::2], sources[1::2], strict=True))
        twice = next((pair for i, pair in enumerate(pairs) if pair in pairs[:i]), None)
        if twice:
            raise InputError(f"the pair {_name(*twice)} is given twice; expected it once")
        return [(_name(a, b), open_source(a), open_source(b), other) for a, b in pairs]
    if codebooks is not None:
        raise InputError("--codebooks are of pairs of sources; the built-in routes have seed 1 of their own")
    found = []
    for kind, sizes in (BUILT_IN | ({"aerial": tuple(places)} if places else {})).items():
        for size in sizes:
            address = f"sim:{kind}?" + (f"frames={size}&" if size else "")
            own = [open_source(f"{address}seed={s}&traverse={t}") for s, t in ((0, 0), (0, 1), (1, 0))]
            found.append((f"sim:{kind}, {own[0].length} places", *own))
    return found  # type: ignore[return-value]  # mypy sees no triple


def _model(whitening: DejaVu | None) -> DejaVu:
    """One with the defaults, or with the whitening of another."""
    model = DejaVu()
    if whitening is not None:
        model.take_whitening(whitening)
    return model


def _check(model: DejaVu, reference: Traverse, query: Traverse) -> None:
    """Refuse, before the long work, a pair that does not fit the model or each other."""
    features, whitening = model.describer.check_sizes(reference, query), model.whitening
    if whitening is not None and whitening.learned and len(whitening.projection) != features:
        raise InputError(
            f"the whitening is of {len(whitening.projection)} features and {reference.name} gives {features} "
            "a frame; expected as many, as frames of one size give"
        )
    if reference.length is not None and query.length is not None:
        _truth(reference, query, reference.length, query.length)
    if model.map.places and reference.length is not None and model.map.places != reference.length:
        raise InputError(
            f"the map holds {model.map.places} places and {reference.name} {reference.length}; expected the "
            "reference that it was made of"
        )


def _truth(reference: Traverse, query: Traverse, frames: int, queries: int) -> GroundTruth:
    """What the sources say, or frame i is place i."""
    truth = ground_truth_of(None, reference, query, frames, queries, aligned=True)
    if truth is None:
        raise InputError(
            f"{reference.name} has {frames} frames and {query.name} {queries}; expected as many, frame i "
            "being place i"
        )
    return truth


def _name(reference: str, query: str) -> str:
    return f"{reference} and {query}"


def described(
    name: str,
    reference: Traverse,
    query: Traverse,
    model: DejaVu | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Route:
    """A route's whitened descriptors.

    Args:
        model: makes them; None is one with the defaults.
        seed: of a whitening that is learned here.

    Raises:
        InputError: frames that differ in size, or nothing that says which places are right.
    """
    model = DejaVu() if model is None else model
    assert model.whitening is not None  # of the defaults
    if not model.whitening.fixed:
        model.whitening.seed = seed
    places = model.describe_reference(reference, None, "describing" if progress else None)
    queries = model.extract_all(query, "describing the query" if progress else None)
    truth = _truth(reference, query, len(places), len(queries))
    fixed = sum(buffer.nbytes for buffer in model.whitening.buffers())
    return Route(name, model, reference, query, places.float(), queries.float(), truth, fixed)


def contenders_of(
    route: Route, other: Traverse | None, given: DejaVu | None = None, seed: int = 0
) -> Iterator[Contender]:
    """All that is set side by side on a route, ours first.

    Args:
        other: the route of the free codebooks and of a whitening that is shared; None leaves them out, and
            says so.
        given: see `bench_storage`.
    """
    for name, family, keep in _stores(route, other, seed):
        yield Contender(name, partial(partial, _among, route, keep), family=family)
    yield from _other_whitenings(route, other, seed)
    if given is not None:
        found = partial(partial, _by_map, route, given)
        yield Contender("dejavu, the map that was given", found, family="dejavu, given")
    yield Contender("the paper", partial(partial, _by_paper, route), family="the paper")


Store = tuple[str, str, Callable[[], Kept]]  # name, family, and what it gives back of the descriptors


def _stores(route: Route, other: Traverse | None, seed: int) -> Iterator[Store]:
    """Ways to keep the very same descriptors."""
    places, numbers = route.places, route.places.shape[1]
    for budget in BUDGETS:
        yield f"dejavu {budget:g}", OURS, partial(spectral, places, budget)
    for budget in BUDGETS:
        yield f"null {budget:g}", NULL, partial(spectral, places, budget, seed)
    for k in SPACED:
        name = "whole database" if k == 1 else every(k, "frame")
        yield f"{name}, float", "frames", partial(every_kth, places, k, 4 * numbers)
        yield f"{name}, int8", "frames", partial(every_kth, places, k, numbers, as_int8)
    for k in BETWEEN:
        keep = partial(every_kth, places, k, numbers, as_int8, between=True)
        yield f"{every(k, 'frame')}, int8, interpolated", "interpolated", keep
    for count in COMPONENTS:
        for k in COMPONENT_SPACED:
            name = f"PCA, {count} numbers of {every(k, 'frame')}, int8{', interpolated' * (k > 1)}"
            yield name, "PCA", partial(principal, places, count, k)
    for k in BIT_SPACED:
        for between in (False, True) if k > 1 else (False,):
            keep = partial(every_kth, places, k, -(-numbers // 8), signs, between)
            yield f"signs of {every(k, 'frame')}{', interpolated' * between}", "binary", keep
    yield from _product_quantisers(route, other)
    for codec in ("libx264", "libx265"):
        for crf in QUALITIES:
            for k in VIDEO_SPACED:
                name = f"{codec[3:]}, crf {crf}, {every(k, 'frame')}{', interpolated' * (k > 1)}"
                yield name, "video", partial(_video, route, codec, crf, k)


def _product_quantisers(route: Route, other: Traverse | None) -> Iterator[Store]:
    """PQ and OPQ, by codebooks of another route, which count nothing, and by the route's own, which do."""

    @cache
    def elsewhere() -> Tensor:
        if other is None:
            raise InputError("no other route to train codebooks on; expected --codebooks SOURCE")
        route.model.describer.check_sizes(route.reference, other)
        return route.model.extract_all(other).float()

    @cache  # one training for all strides
    def quantiser(m: int, rotated: bool, own: bool) -> ProductQuantiser:
        return ProductQuantiser(route.places if own else elsewhere(), m, rotated, int8=own)

    def keep(k: int, m: int, rotated: bool, own: bool, between: bool) -> Kept:
        code = quantiser(m, rotated, own)
        return every_kth(route.places, k, m, code, between, code.bytes if own else 0)

    for own, rotated, m in ((o, r, m) for o in (False, True) for r in (False, True) for m in CODE_BYTES):
        family = "PQ, own codebooks" if own else "PQ, codebooks of another route"
        for k, between in ((k, b) for k in CODE_SPACED for b in (False, True)):
            name = f"{'O' * rotated}PQ, {m} bytes of {every(k, 'frame')}"
            name += f"{', interpolated' * between}{', own codebooks' * own}"
            yield name, family, partial(keep, k, m, rotated, own, between)


def _video(route: Route, codec: str, crf: int, k: int) -> Kept:
    """Every k-th frame coded and described again, straight lines between the descriptors."""
    coded = CodedVideo(route.reference, codec, crf, step=k)
    keys, count = route.model.extract_all(coded).float(), len(route.places)
    if k > 1 and (count - 1) % k:  # the last place is given back as the last one stored
        keys = torch.cat([keys, keys[-1:]])
    return Kept(between_keyframes(keys, count, k) if k > 1 else keys, coded.bytes)


def _other_whitenings(route: Route, other: Traverse | None, seed: int) -> Iterator[Contender]:
    """The map of the same frames by other whitenings, one of them another route's."""
    assert route.model.whitening is not None
    if route.model.whitening.fixed:  # given: there is none to change
        return

    def learned(settings: Mapping[str, int]) -> DejaVu:
        return DejaVu(whitening=Whitening(**settings))  # type: ignore[arg-type]  # all are whole numbers

    def shared() -> DejaVu:
        if other is None:
            raise InputError("no other route to learn a whitening on; expected --codebooks SOURCE")
        route.model.describer.check_sizes(route.reference, other)
        source, model = DejaVu(), DejaVu()
        assert source.whitening is not None
        source.whitening.seed = seed
        source.describe_reference(other)
        model.take_whitening(source)
        return model

    def answer(model: Callable[[], DejaVu], matching: Matching) -> Answer:
        again = described(route.name, route.reference, route.query, model(), seed)
        return _among(again, partial(spectral, again.places, WHITENED), matching)

    models: dict[str, Callable[[], DejaVu]]
    models = {name: partial(learned, settings) for name, settings in WHITENINGS.items()}
    for name, model in (models | {"of another route": shared}).items():
        whitened = partial(partial, answer, model)
        yield Contender(f"dejavu {WHITENED:g}, whitening {name}", whitened, family=OTHERS)


def _among(route: Route, keep: Callable[[], Kept], matching: Matching) -> Answer:
    """Nearest of the descriptors that a store gives back, by cosine."""
    kept = keep()
    found = nearest_frames(kept.descriptors, route.queries, kept.apart, "cosine", matching=matching)
    return Answer(found, kept.route, kept.fixed + route.fixed)


def _by_map(route: Route, model: DejaVu, matching: Matching) -> Answer:
    """A map on descriptors of its own."""
    found = model.localize_descriptors(model.extract_all(route.query), matching).renumbered(
        model.map.table.scored
    )
    summary = model.summary()
    return Answer(found, summary.route_bytes, summary.fixed_bytes)


def _by_paper(route: Route, matching: Matching) -> Answer:
    """Template means of the features themselves at frequencies found in them, frame by frame."""
    return _by_map(route, paper_model().learn(route.reference), matching)


def judged(route: Route, contender: Contender) -> Row:
    """Store a route, match all queries, and score them."""
    row = new_row(route.name, contender.name, KEYS, family=contender.family)
    matching = _matching(len(route.places), len(route.queries))
    answers: list[Answer] = []
    began = time.perf_counter()
    try:
        answer_of = contender.prepare()
        peak = peak_memory(lambda: answers.append(answer_of(matching)))
    except InputError as error:
        return row | {"skipped": str(error)}
    except (ImportError, ValueError) as error:  # a program that is not installed, a codec that is not there
        return row | {"skipped": f"{type(error).__name__}: {one_line(error)}"[:200]}
    seconds, (answer,) = time.perf_counter() - began, answers
    scores = evaluate_each(answer.found.sequences, route.truth, TOLERANCE)
    return row | {
        "seconds": seconds,
        "peak_bytes": peak,
        "bytes": answer.route + answer.fixed,
        "fixed_bytes": answer.fixed,
        "route_bytes": answer.route,
        "route_bytes_per_place": answer.route / len(route.places),
        "recall_at_1": scores[1].recall_at_1,
        "auc": scores[1].auc,
        "sequences": sequences_as_json(scores),
    }


def _matching(places: int, queries: int) -> Matching:
    """Single queries, and beside them sequences of each T that there is room for."""
    longest = max(length for length in LENGTHS if length <= places)
    sequence = SequenceMatcher(longest)
    return Matching(sequence, lengths_beside(sequence, queries, places))


def area(row: Row, length: int) -> float | None:
    """The AUC of sequences of T queries."""
    auc: float | None = (row["sequences"] or {}).get(str(length), {}).get("auc")
    return auc


class Point(NamedTuple):
    """An area that is reached with so many route bytes per place."""

    size: float
    auc: float


def front(rows: Sequence[Row], length: int = 1) -> list[Point]:
    """What no other row reaches with fewer bytes, by ascending bytes; of sequences of T queries.

    Example:
        >>> sizes = {2.0: 0.7, 1.0: 0.5, 4.0: 0.6}
        >>> rows = [new_row("", "", KEYS, route_bytes_per_place=size, sequences={"1": {"auc": auc}})
        ...         for size, auc in sizes.items()]
        >>> [tuple(point) for point in front(rows)]
        [(1.0, 0.5), (2.0, 0.7)]
    """
    best: list[Point] = []
    points = (Point(row["route_bytes_per_place"] or 0, area(row, length) or 0) for row in rows if _ran(row))
    for point in sorted(points, key=lambda point: (point.size, -point.auc)):
        if not best or point.auc > best[-1].auc:
            best.append(point)
    return best


def bytes_for(auc: float, points: Sequence[Point]) -> float | None:
    """Bytes per place at which a front reaches an area, on straight lines over the logarithm of bytes.

    None where it never does. Where its smallest point does, that point's, which it may need less than.

    Example:
        >>> bytes_for(0.6, [Point(1.0, 0.5), Point(4.0, 0.7)])
        2.0
    """
    for i, after in enumerate(points):
        if after.auc >= auc:
            if i == 0 or after.size <= 0:
                return after.size
            before = points[i - 1]
            share = (auc - before.auc) / (after.auc - before.auc)
            return math.exp((1 - share) * math.log(before.size) + share * math.log(after.size))
    return None


def _ran(row: Row) -> bool:
    return row["skipped"] is None


def _families(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each family but `OTHERS`, which differ in what does not grow with the route."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if _ran(row) and row["family"] != OTHERS:
            found.setdefault(row["family"], []).append(row)
    return found


def _cases(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["case"], []).append(row)
    return found


def equal_areas(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For each of our rows and T, the bytes per place that each family needs for the same area.

    Returns:
        Entries of bench.json: case, T, auc and route_bytes_per_place of ours, `bytes_per_place` by family,
        None where it never gets there, and `null_over_ours`.
    """
    found = []
    for case, own in _cases(rows).items():
        families = _families(own)
        for length in LENGTHS:
            fronts = {name: front(some, length) for name, some in families.items() if name != OURS}
            for row in families.get(OURS, ()):
                auc, size = area(row, length), row["route_bytes_per_place"]
                if auc is None or size is None:
                    continue
                needed = {name: bytes_for(auc, points) for name, points in fronts.items()}
                null = needed.get(NULL)
                found.append(
                    {
                        "case": case,
                        "T": length,
                        "auc": auc,
                        "route_bytes_per_place": size,
                        "bytes_per_place": needed,
                        "null_over_ours": None if null is None else null / size,
                    }
                )
    return found


class Whitened(NamedTuple):
    """The area of our map by one whitening, and the bytes that this takes once."""

    name: str
    fixed_bytes: int
    auc: float


def whitenings(rows: Sequence[Row]) -> dict[str, list[Whitened]]:
    """For each route with other whitenings than its own: that one, the first, and the others."""
    found: dict[str, list[Whitened]] = {}
    for case, own in _cases(rows).items():
        others = [row for row in own if _ran(row) and row["family"] == OTHERS]
        ours = [row for row in own if _ran(row) and row["contender"] == f"{OURS} {WHITENED:g}"]
        if others and ours:
            names = ["the default", *(row["contender"].rpartition("whitening ")[2] for row in others)]
            found[case] = [
                Whitened(name, row["fixed_bytes"] or 0, row["auc"] or 0)
                for name, row in zip(names, ours + others, strict=True)
            ]
    return found


def run_storage(
    out: Path,
    sources: Sequence[str] = (),
    places: Sequence[int] = (),
    codebooks: str | None = None,
    given: DejaVu | None = None,
    whitening: DejaVu | None = None,
    progress: bool = False,
) -> list[Row]:
    """`bench_storage`, written into a folder as rows are finished: bench.json, and bench.png at the end.

    Raises:
        InputError: as `bench_storage`, or a folder that cannot be made or written in.
    """
    check_output_folder(out)
    rows: list[Row] = []
    for row in bench_storage(sources, places, codebooks, given, whitening, progress=progress):
        rows = with_ratios([*rows, row], lambda row: row["family"] == OURS)
        write_bench(out, rows, equal_auc=equal_areas(rows), tolerance=TOLERANCE)
    picture = plot_frontiers(pictured(rows), whitenings(rows))
    write_bench(out, rows, picture, equal_auc=equal_areas(rows), tolerance=TOLERANCE)
    return rows


def pictured(rows: Sequence[Row]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """The front of each family on each route, as `plot_frontiers` takes them."""
    return {
        case: {name: [(p.size, p.auc) for p in front(some)] for name, some in _families(own).items()}
        for case, own in _cases(rows).items()
    }


def storage_tables(rows: Sequence[Row], at: float = 1.6) -> Iterator[tuple[str, list[list[str]]]]:
    """For each route: a heading and rows of text, the best area of each family in so many bytes per place.

    A second table has the bytes per place that each family needs, by T, for our area at `at` bytes or, where
    that is larger, for `LEVEL`; a third the areas by other whitenings.
    """
    others = whitenings(rows)
    for case, own in _cases(rows).items():
        families = _families(own)
        table = [["route bytes per place:", *(f"{budget:g}" for budget in SHOWN)]]
        for name, some in families.items():
            sizes = [(row["route_bytes_per_place"] or 0, row["auc"] or 0) for row in some]
            fits = ([auc for size, auc in sizes if size <= NEAR * budget] for budget in SHOWN)
            table.append([name, *(f"{max(areas):.3f}" if areas else "" for areas in fits)])
        yield f"{case}: AUC", table
        levels = {}
        for length in LENGTHS:
            ours = [point.auc for point in front(families.get(OURS, ()), length) if point.size <= NEAR * at]
            if ours:
                levels[length] = min(max(ours), LEVEL)
        if levels:
            table = [["queries together:", *(f"T = {length}" for length in levels)]]
            table.append(["AUC", *(f"{level:.3f}" for level in levels.values())])
            for name, some in families.items():
                needed = (_needed(level, front(some, length)) for length, level in levels.items())
                table.append([name, *needed])
            yield "route bytes per place for an AUC", table
        if case in others:
            table = [["whitening:", "fixed kB", "AUC"]]
            table += [[one.name, f"{one.fixed_bytes / 1000:.0f}", f"{one.auc:.3f}"] for one in others[case]]
            yield f"AUC of dejavu at {WHITENED:g} bytes per place", table


def _needed(auc: float, points: Sequence[Point]) -> str:
    size = bytes_for(auc, points)
    if size is None:
        return "never"
    return f"{'<' * (points[0].auc > auc)}{size:.2f}"


def skipped_lines(rows: Sequence[Row]) -> list[str]:
    """Why rows were skipped, one line for each reason, with the first of them."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["skipped"]:
            reasons.setdefault((row["case"], row["skipped"]), []).append(row["contender"])
    return [
        f"{case}: skipped {names[0]}{f' and {len(names) - 1} more' * (len(names) > 1)}: {reason}"
        for (case, reason), names in reasons.items()
    ]
