"""`benchmarks storage`: accuracy over bytes of the map and of other stores of the same descriptors."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.coded_video import CodedVideo
from benchmarks.measure import (
    Contender,
    Row,
    failure,
    new_row,
    peak_memory,
    truth_of,
    with_ratios,
    write_bench,
)
from benchmarks.plots import plot_frontiers
from benchmarks.quantisers import Kept, Quantiser, every_kth, principal, signs, spectral
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.baselines import as_int8, between_keyframes, every, nearest_frames
from dejavu_torch.evaluation.compare import check_places
from dejavu_torch.evaluation.contenders import LENGTHS, evaluate_each, models_beside, sequences_as_json
from dejavu_torch.evaluation.plots import Plot
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.evaluation.reproduce import paper_model
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Match, Traverse

# route bytes per place of ours and of the null
BUDGETS = (0.25, 0.5, 1.0, 1.6, 2.0, 2.5, 3.2, 5.0, 10.0, 16.0)
SHOWN = (1.0, 1.6, 3.2, 5.0, 10.0)  # of the table
NEAR = 1.02  # a budget is met by at most this share of it
SPACED = (1, 2, 3, 4, 5, 8, 10)  # k of every k-th frame, repeated
BETWEEN = (8, 10, 16, 25, 40, 64, 100)  # and interpolated
COMPONENTS, COMPONENT_SPACED = (2, 4, 8, 16, 32), (1, 2, 5, 10)
CODE_SPACED = (1, 2, 3, 4, 5, 8)
BIT_SPACED = (1, 2, 3, 4, 5, 8, 10, 16)
QUALITIES, VIDEO_SPACED = (24, 32, 40, 51), (1, 4, 8)  # crf
CODES = {  # keys of faiss's factory, divisor that K must have, and numbers in the codebooks per dimension
    "PQ": [(f"PQ{m}x8np", m, 256) for m in (4, 8, 16, 32)],
    "OPQ": [(f"OPQ{m},PQ{m}x8np", m, 256) for m in (4, 8, 16, 32)],
    "RQ": [(f"RQ{m}x8", 1, 256 * m) for m in (4, 8, 16)],
    "LSQ": [(f"LSQ{m}x8", 1, 256 * m) for m in (4, 8)],
    "PRQ": [(f"PRQ2x{m // 2}x8", 2, 128 * m) for m in (8, 16)],
}
MOST = 32  # most route bytes per place of codebooks; larger ones are a row without figures
ROTATED = {  # keys of codes without codebooks, axes to count, bytes of a code that decoding does not need
    "TurboQuant": [(f"PCAR{n},SQtqmse1", n, 0) for n in (32, 64, 128)],
    "RaBitQ": [("PCAR64,RaBitQ", 64, 4), ("RR{},RaBitQ", 0, 4)],
    "EDEN": [("PCAR64,EDEN", 64, 4), ("RR{},EDEN", 0, 4)],
}
BUILT_IN = {"aerial": (3072, 10_000), "outdoor": (0,), "underground": (0,)}  # frames; 0 is the whole route
WHITENINGS: dict[str, dict[str, Any]] = {  # settings other than the defaults
    "16 bits": {"bits": 16},
    "8 bits": {"bits": 8},
    "64 numbers": {"numbers": 64},
    "32 numbers": {"numbers": 32},
}
WHITENED = 5.0  # route bytes per place of the map with each of them
# others must reach our AUC at this many bytes, but at most this one: near 1 single queries decide
AT, LEVEL = 1.6, 0.95
TOLERANCE = 5
KEYS = (
    *("family", "answer", "seconds", "peak_bytes", "bytes", "fixed_bytes", "route_bytes"),
    *("route_bytes_per_place", "recall_at_1", "auc", "sequences", "ratio_to_ours", "skipped"),
)
OURS, NULL, OTHERS, GIVEN = "dejavu", "null", "dejavu, other whitenings", "dejavu, given maps"
PAPER = "the paper"
LEAST_MISSED = 0.002  # 1 - AUC of a store that counts as perfect: below it single queries decide

Answer = tuple[Match, int, int]  # the matches of a contender, its route bytes and its fixed bytes
Points = Sequence[tuple[float, float]]  # bytes per place and area


class Route(NamedTuple):
    """The descriptors of a route: places (N,K) and queries (Q,K), with the same whitening.

    reference: the frames of the places. other: the route to train free codebooks and a shared whitening on;
    None skips these.
    """

    name: str
    model: DejaVu
    reference: Traverse
    query: Traverse
    places: Tensor
    queries: Tensor
    truth: GroundTruth
    other: Traverse | None
    tolerance: int = TOLERANCE

    @property
    def fixed(self) -> int:
        """Bytes of the whitening, which every contender needs."""
        assert self.model.whitening is not None
        return sum(buffer.nbytes for buffer in self.model.whitening.buffers())

    @property
    def matching(self) -> Matching:
        """Single queries, and sequences of each T that fits the route."""
        sequence = SequenceMatcher(max(length for length in LENGTHS if length <= len(self.places)))
        return Matching(sequence, models_beside(sequence, False, len(self.queries), len(self.places)))

    def another(self, what: str) -> Traverse:
        """The other route, to learn something on."""
        if self.other is None:
            raise InputError(f"no other route to {what}; expected --codebooks SOURCE")
        self.model.descriptor.check_sizes(self.reference, self.other)
        return self.other


def run_storage(
    sources: Sequence[str] = (),
    *,
    out: Path,
    map: Sequence[Path] = (),
    codebooks: str | None = None,
    whitening: Path | None = None,
    places: Sequence[int] = (),
    truth: str | None = None,
    tolerance: int = TOLERANCE,
    drives: Path | None = None,
) -> list[str]:
    """Accuracy over bytes of ways to store the descriptors of a route.

    Args:
        sources: pairs REFERENCE QUERY; the built-in routes if not given
        out: folder for bench.json and bench.png
        map: maps of the REFERENCE to compare with, each with its own descriptors
        codebooks: another route, for codebooks and a whitening whose bytes are not counted
        whitening: map whose whitening is used for all routes; each learns its own if not given
        places: numbers of frames of the built-in sim:aerial; 3072 and 10000 if not given
        truth: places of the queries, as in `dejavu compare`; by default frame i is place i
        tolerance: answers this many places off are still right
        drives: instead, few bytes on the routes of this folder of footage, by one image and the whole drive
    """
    if drives is not None:
        if sources or map or codebooks or whitening or places or truth:
            raise InputError("--drives has routes of its own; expected no other option but --out")
        from benchmarks.storage_drives import run_storage_drives  # imports this module

        return run_storage_drives(drives, out)
    if tolerance < 0:
        raise InputError(f"--tolerance {tolerance}; expected at least 0")
    if truth is not None and len(sources) != 2:
        raise InputError(f"--truth is for one pair, and there are {len(sources)} sources; expected 2")
    given = {path.stem: DejaVu.load(path) for path in map}
    if len(given) < len(map):
        raise InputError(f"--map {' '.join(str(path) for path in map)}; expected files of different names")
    shared = None if whitening is None else DejaVu.load(whitening)
    rows: list[Row] = []
    for row in bench_storage(sources, places, codebooks, given, shared, truth, tolerance):
        rows = with_ratios([*rows, row])  # written as soon as it is finished
        write_bench(out, rows, equal_auc=equal_areas(rows), tolerance=tolerance)
    facts = {"equal_auc": equal_areas(rows), "missed_over_best": missed(rows), "tolerance": tolerance}
    write_bench(out, rows, pictured(rows), **facts)
    note = "the best of each family, with sequences of T queries"
    return [*storage_tables(rows), *skipped_lines(rows), note]


def bench_storage(
    sources: Sequence[str] = (),
    places: Sequence[int] = (),
    codebooks: str | None = None,
    given: Mapping[str, DejaVu] | None = None,
    whitening: DejaVu | None = None,
    truth: str | None = None,
    tolerance: int = TOLERANCE,
) -> Iterator[Row]:
    """Accuracy over bytes of all contenders on all routes, a row at a time; see `run_storage`.

    Yields:
        family: of contenders that form one front. seconds: to store the route and match all queries; includes
        describing all frames for contenders with their own descriptors, and training in the first of several
        rows that share one. peak_bytes: most memory meanwhile, minus that before. ratio_to_ours: seconds over
        those of our fastest. bytes: all, with the whitening: `route_bytes`, which grow with the route, and
        `fixed_bytes`. sequences: by T, scores of sequences of T. skipped: why there are no figures.
    """
    given = {} if given is None else given
    routes = routes_of(sources, places, codebooks, bool(given))
    for _, reference, query, _ in routes:
        for model in (model_by(whitening), *given.values()):
            check(model, reference, query, truth)
    for name, reference, query, other in routes:
        route = described(name, reference, query, model_by(whitening), other, truth, tolerance)
        for contender in tqdm(list(contenders_of(route, given)), name, disable=None, leave=False):
            yield judged(route, contender)


def routes_of(
    sources: Sequence[str], places: Sequence[int], codebooks: str | None, given: bool
) -> list[tuple[str, Traverse, Traverse, Traverse | None]]:
    """Name, reference, query and other route of each route; refuses early what does not fit."""
    pairs = list(zip(sources[::2], sources[1::2], strict=False))
    twice = [f"{a} and {b}" for i, (a, b) in enumerate(pairs) if (a, b) in pairs[:i]]
    if len(sources) % 2:
        raise InputError(f"bench storage got {len(sources)} sources; expected pairs, REFERENCE QUERY ...")
    if given and len(pairs) != 1:
        raise InputError(f"--map is for one pair, and there are {len(sources)} sources; expected one pair")
    if sources and places:
        raise InputError("--places is for the built-in sim:aerial; expected it without sources")
    if places and min(places) < 2:
        raise InputError(f"--places {' '.join(map(str, places))}; expected at least 2 each")
    if twice:
        raise InputError(f"the pair {twice[0]} is given twice; expected it once")
    if sources:
        other = None if codebooks is None else open_source(codebooks)
        return [(f"{a} and {b}", open_source(a), open_source(b), other) for a, b in pairs]
    if codebooks is not None:
        raise InputError("--codebooks is for pairs of sources; the built-in routes use their seed 1")
    found: list[tuple[str, Traverse, Traverse, Traverse | None]] = []
    for kind, sizes in (BUILT_IN | ({"aerial": tuple(places)} if places else {})).items():
        for size in sizes:
            address = f"sim:{kind}?" + (f"frames={size}&" if size else "")
            seen = ("seed=0&traverse=0", "seed=0&traverse=1", "seed=1&traverse=0")
            reference, query, other = (open_source(address + one) for one in seen)
            found.append((f"sim:{kind}, {len(reference)} places", reference, query, other))
    return found


def model_by(whitening: DejaVu | None) -> DejaVu:
    """A default model, with the whitening of another if given."""
    model = DejaVu()
    if whitening is not None:
        model.descriptor.take(whitening.descriptor, whitening=True)
    return model


def check(model: DejaVu, reference: Traverse, query: Traverse, truth: str | None = None) -> None:
    """Refuse early a pair that does not fit the model or each other."""
    features, whitening = model.descriptor.check_sizes(reference, query), model.whitening
    if whitening is not None and whitening.learned and sum(whitening.sizes) != features:
        raise InputError(
            f"the whitening is of {sum(whitening.sizes)} features and {reference.name} gives {features} "
            "per frame; expected as many, so frames of the same size"
        )
    truth_of(reference, query, truth)
    if model.map.places:
        check_places(model, len(reference), reference.name)


def described(
    name: str,
    reference: Traverse,
    query: Traverse,
    model: DejaVu | None = None,
    other: Traverse | None = None,
    truth: str | None = None,
    tolerance: int = TOLERANCE,
) -> Route:
    """A route described by a model, which learns its whitening if it has none; None is the default model."""
    model = DejaVu() if model is None else model
    places, queries = both(model, reference, query)
    right = truth_of(reference, query, truth)
    return Route(name, model, reference, query, places, queries, right, other, tolerance)


def both(model: DejaVu, reference: Traverse, query: Traverse) -> tuple[Tensor, Tensor]:
    """Descriptors of the reference, from which a missing whitening is learned, and of the query."""
    places = model.descriptor.learn(reference, None, True)
    return places.float(), model.descriptor.all_of(query, True).float()


def contenders_of(route: Route, given: Mapping[str, DejaVu] | None = None) -> Iterator[Contender]:
    """All contenders on a route, ours first; given: the maps of `run_storage`."""
    yield from stores_of(route)
    assert route.model.whitening is not None
    if not route.model.whitening.fixed:  # a given one is not varied
        for name in (*WHITENINGS, "of another route"):
            answer = partial(by_other_whitening, route, name)
            yield ready(f"dejavu {WHITENED:g}, whitening {name}", OTHERS, answer)
    for name, model in (given or {}).items():
        yield ready(f"dejavu, {name}", GIVEN, partial(by_map, route, partial(lambda one: one, model)))
    # template means of the features at the periods found in them
    paper = partial(by_map, route, lambda: paper_model().learn(route.reference))
    yield ready(PAPER, PAPER, paper)


def ready(name: str, family: str, answer: Callable[[], Answer]) -> Contender:
    """A contender that needs no preparation."""
    return Contender(name, lambda: answer, family=family)


def stores_of(route: Route) -> Iterator[Contender]:
    """Ways to store the same descriptors."""
    places, numbers = route.places, route.places.shape[1]

    def store(family: str, name: str, keep: Callable[..., Kept], *given: Any, **settings: Any) -> Contender:
        return ready(name, family, partial(among, route, partial(keep, *given, **settings)))

    for budget in BUDGETS:
        yield store(OURS, f"dejavu {budget:g}", spectral, places, budget)
    for budget in BUDGETS:
        yield store(NULL, f"null {budget:g}", spectral, places, budget, seed=0)
    for k in SPACED:
        name = "whole database" if k == 1 else every(k, "frame")
        yield store("frames", f"{name}, float", every_kth, places, k, 4 * numbers)
        yield store("frames", f"{name}, int8", every_kth, places, k, numbers, as_int8)
    for k in BETWEEN:
        name = f"{every(k, 'frame')}, int8, interpolated"
        yield store("interpolated", name, every_kth, places, k, numbers, as_int8, between=True)
    for count, k in product(COMPONENTS, COMPONENT_SPACED):
        name = f"PCA, {count} numbers of {every(k, 'frame')}, int8{', interpolated' * (k > 1)}"
        yield store("PCA", name, principal, places, count, k)
    for k in BIT_SPACED:
        for between in (False, True) if k > 1 else (False,):
            name = f"signs of {every(k, 'frame')}{', interpolated' * between}"
            yield store("binary", name, every_kth, places, k, -(-numbers // 8), signs, between)

    @cache
    def elsewhere() -> Tensor:
        return route.model.descriptor.all_of(route.another("train codebooks on")).float()

    @cache  # one training for all strides
    def quantiser(key: str, multiple: int, own: bool) -> Quantiser:
        return Quantiser(places if own else elsewhere(), key, multiple)

    def coded(
        key: str, multiple: int, k: int, own: bool, book: int = 0, fixed: int = 0, unread: int = 0
    ) -> Kept:
        if book > MOST * len(places):
            each = f"{book / len(places):.0f} bytes a place"
            raise InputError(f"codebooks of the route take {each}; tried up to {MOST}")
        code = quantiser(key, multiple, own)
        return every_kth(places, k, code.each - unread, code, k > 1, book)._replace(fixed=fixed)

    for own, (family, keys) in product((False, True), CODES.items()):
        of = family + ", own codebooks" * own  # those of another route count nothing
        for (key, multiple, learned), k in product(keys, CODE_SPACED):
            width = -(-numbers // multiple) * multiple
            book = own * width * (learned + (width if family == "OPQ" else 0))
            yield store(of, named(key, k) + ", own codebooks" * own, coded, key, multiple, k, own, book)
    for family, keyed in ROTATED.items():
        for (key, axes, unread), k in product(keyed, CODE_SPACED):
            key, fixed = key.format(numbers), numbers * (axes + 4)
            yield store(family, named(key, k), coded, key, 1, k, True, fixed=fixed, unread=unread)
    for codec, crf, k in product(("libx264", "libx265"), QUALITIES, VIDEO_SPACED):
        name = f"{codec[3:]}, crf {crf}, {every(k, 'frame')}{', interpolated' * (k > 1)}"
        yield store("video", name, video, route, codec, crf, k)


def named(code: str, k: int) -> str:
    """The name of a code of every k-th place, interpolated."""
    return f"{code} of {every(k, 'frame')}{', interpolated' * (k > 1)}"


def video(route: Route, codec: str, crf: int, k: int) -> Kept:
    """Every k-th frame, coded, decoded and described, with interpolated descriptors."""
    coded = CodedVideo(route.reference, codec, crf, step=k)
    keys, count = route.model.descriptor.all_of(coded).float(), len(route.places)
    if k > 1 and (count - 1) % k:  # the last place is decoded as the last one stored
        keys = torch.cat([keys, keys[-1:]])
    return Kept(between_keyframes(keys, count, k) if k > 1 else keys, coded.bytes)


def by_other_whitening(route: Route, name: str) -> Answer:
    """A map of the same frames with another whitening."""
    model = DejaVu(whitening=Whitening(**WHITENINGS.get(name, {})))
    if name not in WHITENINGS:
        source = DejaVu()
        source.descriptor.learn(route.another("learn a whitening on"))
        model.descriptor.take(source.descriptor, whitening=True)
    places, queries = both(model, route.reference, route.query)
    again = route._replace(model=model, places=places, queries=queries)
    return among(again, partial(spectral, places, WHITENED))


def among(route: Route, keep: Callable[[], Kept]) -> Answer:
    """The nearest decoded descriptors of a store, by cosine."""
    kept = keep()
    found = nearest_frames(kept.descriptors, route.queries, kept.apart, "cosine", matching=route.matching)
    return found, kept.route, kept.fixed + route.fixed


def by_map(route: Route, made: Callable[[], DejaVu]) -> Answer:
    """A map with its own descriptors."""
    model = made()
    found = model.localize_descriptors(model.descriptor.all_of(route.query), route.matching)
    summary = model.summary()
    return found.renumbered(model.map.table.scored), summary.route_bytes, summary.fixed_bytes


def judged(route: Route, contender: Contender) -> Row:
    """Store a route, match all queries, and score them: single ones, and sequences of each T that fits."""
    row = new_row(route.name, contender.name, KEYS, family=contender.family, answer="one")
    answers: list[Answer] = []
    began = time.perf_counter()
    try:
        peak = peak_memory(lambda: answers.append(contender.prepare()()))
    except InputError as error:
        return row | {"skipped": str(error)}
    except (ImportError, ValueError) as error:  # a program or codec that is not installed
        return row | {"skipped": failure(error)}
    seconds, ((found, size, fixed),) = time.perf_counter() - began, answers
    scores = evaluate_each(found.sequences, route.truth, route.tolerance)
    return row | {
        "seconds": seconds,
        "peak_bytes": peak,
        "bytes": size + fixed,
        "fixed_bytes": fixed,
        "route_bytes": size,
        "route_bytes_per_place": size / len(route.places),
        "recall_at_1": scores[1].recall_at_1,
        "auc": scores[1].auc,
        "sequences": sequences_as_json(scores),
    }


def front(rows: Sequence[Row], length: int = 1) -> list[tuple[float, float]]:
    """The front: AUCs of sequences of T that no other row reaches with fewer bytes, by ascending bytes."""
    points = [(row["route_bytes_per_place"], area(row, length) or 0.0) for row in rows]
    best: list[tuple[float, float]] = []
    for size, auc in sorted(points, key=lambda point: (point[0], -point[1])):
        if not best or auc > best[-1][1]:
            best.append((size, auc))
    return best


def area(row: Row, length: int) -> float | None:
    """The AUC of sequences of T; None if they do not fit the route."""
    auc: float | None = row["sequences"].get(str(length), {}).get("auc")
    return auc


def bytes_for(auc: float, points: Points) -> float | None:
    """Bytes per place at which a front reaches an AUC, linear over the logarithm of bytes.

    None if it never does; the smallest point's bytes, an upper bound, if that does already.
    """
    i = next((i for i, point in enumerate(points) if point[1] >= auc), None)
    if i is None:
        return None
    after, reached = points[i]
    if i == 0 or after <= 0:
        return after
    before, missed = points[i - 1]
    share = (auc - missed) / (reached - missed)
    return math.exp((1 - share) * math.log(before) + share * math.log(after))


def by(key: str, rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows with figures, by case or family, in order."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if row.get("skipped") is None:  # kept rows are without what is None
            found.setdefault(row[key], []).append(row)
    return found


def families(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each family except `OTHERS`, which differs in fixed bytes."""
    return {name: some for name, some in by("family", rows).items() if name != OTHERS}


def equal_areas(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For each of our rows and T, the bytes per place that each family needs for the same AUC.

    Returns:
        Entries of bench.json: case, T, auc and route_bytes_per_place of ours, `bytes_per_place` by family,
        None if it never reaches that, and `null_over_ours`.
    """
    found = []
    for case, own in by("case", rows).items():
        for length in LENGTHS:
            fronts = {name: front(some, length) for name, some in families(own).items() if name != OURS}
            for row in families(own).get(OURS, ()):
                auc, size = area(row, length), row["route_bytes_per_place"]
                if auc is None:
                    continue
                needed = {name: bytes_for(auc, points) for name, points in fronts.items()}
                null = needed.get(NULL)
                entry = {"case": case, "T": length, "auc": auc, "route_bytes_per_place": size}
                entry |= {"bytes_per_place": needed, "null_over_ours": null and null / size}
                found.append(entry)
    return found


def missed(rows: Sequence[Row]) -> dict[str, float]:
    """1 - AUC of ours over that of the best rival with as many bytes, for each case: the geometric mean over
    1 to 5 route bytes per place. Rivals are the stores of the same descriptors, except the null."""
    found = {}
    for case, own in by("case", rows).items():
        known = families(own)
        rivals = [
            row for name, some in known.items() if name not in (OURS, NULL, GIVEN, PAPER) for row in some
        ]
        pair = (known.get(OURS, []), rivals)
        sizes = [size for size in SHOWN if size <= WHITENED]
        left = [[max(LEAST_MISSED, 1 - (best(some, size) or 0.0)) for size in sizes] for some in pair]
        found[case] = math.prod(a / b for a, b in zip(*left, strict=True)) ** (1 / len(sizes))
    return found


def best(rows: Sequence[Row], size: float) -> float | None:
    """The largest AUC in this many route bytes per place, if any."""
    return max((auc for taken, auc in front(rows) if taken <= NEAR * size), default=None)


def whitenings(rows: Sequence[Row]) -> dict[str, list[tuple[str, int, float]]]:
    """Name, fixed bytes and AUC of our map with each whitening, for each route with several."""
    found = {}
    for case, own in by("case", rows).items():
        ours = [("the default", row) for row in own if row["contender"] == f"{OURS} {WHITENED:g}"]
        others = [row for row in own if row["family"] == OTHERS]
        if others and ours:
            named = ours + [(row["contender"].rpartition("whitening ")[2], row) for row in others]
            found[case] = [(name, row["fixed_bytes"], row["auc"]) for name, row in named]
    return found


def pictured(rows: Sequence[Row]) -> Plot:
    """The front of each family on each route."""
    cases = {
        case: {name: front(some) for name, some in families(own).items()}
        for case, own in by("case", rows).items()
    }
    return plot_frontiers(cases, whitenings(rows))


def storage_tables(rows: Sequence[Row], at: float = AT) -> Iterator[str]:
    """For each route, as aligned text, the best AUC of each family by bytes per place.

    A second table has the bytes per place that each family needs, by T, for our AUC at `at` bytes, or for
    `LEVEL` if that is less; a third the AUC with other whitenings.
    """
    others = whitenings(rows)
    for case, own in by("case", rows).items():
        table = [["route bytes per place:", *(f"{budget:g}" for budget in SHOWN)]]
        for name, some in families(own).items():
            areas = (best(some, size) for size in SHOWN)
            table.append([name, *("" if area is None else f"{area:.3f}" for area in areas)])
        rest = f"(1 - AUC) of dejavu / (1 - AUC) of the best rival, at 1 to 5 bytes: {missed(own)[case]:.2f}"
        yield f"{printable(case)}: AUC\n{text_table(table)}\n{rest}\n"
        ours = {T: front(families(own).get(OURS, ()), T) for T in LENGTHS}
        near = {T: [auc for size, auc in points if size <= NEAR * at] for T, points in ours.items()}
        levels = {T: min(max(areas), LEVEL) for T, areas in near.items() if areas}
        if levels:
            table = [["queries together:", *(f"T = {T}" for T in levels)]]
            table.append(["AUC", *(f"{level:.3f}" for level in levels.values())])
            for name, some in families(own).items():
                table.append([name, *(needed(auc, front(some, T)) for T, auc in levels.items())])
            yield f"route bytes per place for an AUC\n{text_table(table)}\n"
        if case in others:
            table = [["whitening:", "fixed kB", "AUC"]]
            table += [[name, f"{size / 1000:.0f}", f"{auc:.3f}"] for name, size, auc in others[case]]
            yield f"AUC of dejavu at {WHITENED:g} bytes per place\n{text_table(table)}\n"


def needed(auc: float, points: Points) -> str:
    size = bytes_for(auc, points)
    return "never" if size is None else f"{'<' * (points[0][1] > auc)}{size:.2f}"


def skipped_lines(rows: Sequence[Row]) -> list[str]:
    """Why rows were skipped: a line for each reason, with the first row."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["skipped"]:
            reasons.setdefault((row["case"], row["skipped"]), []).append(row["contender"])
    lines = []
    for (case, reason), (first, *others) in reasons.items():
        more = f" and {len(others)} more" if others else ""
        lines.append(printable(f"{case}: skipped {first}{more}: {reason}"))
    return lines
