"""The ground truth: the correct reference frames of each query."""

from __future__ import annotations

import logging
import operator
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from decimal import Decimal
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeGuard

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from dejavu_torch.data.coordinates import FORMS as COORDINATES
from dejavu_torch.data.coordinates import OF_MAPS, Near, coordinates_of
from dejavu_torch.data.files import LARGEST, as_number, check_regular
from dejavu_torch.data.truth_files import places_of_queries, read_json, read_listed, read_matrices
from dejavu_torch.memory import check_room
from dejavu_torch.places.layout import Layout
from dejavu_torch.text import one_line, rounded
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

PAIRS_PER_BLOCK = 2**20
OFTEN, FEW = 0.2, 20  # share of right pairs from which a warning is given, and places below which it is not
ASSUMED = "assumed: frame i shows place i, as the names or cuts of both visits agree"
EXPECTED = (
    "an integer offset such as 0, a .csv of query,place, a .json with a list of places for each query, an "
    ".npz with GThard, metres:25 for sources with coordinates, or utm:25, degrees:25 or metres:25 for those "
    "in image names"
)
FORMS = "integer places (Q,) or (Q,R), or a boolean matrix (Q,N)"
NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")  # in a name
BYTES_PER_PLACE = 32  # of a table of right places, including temporaries


class GroundTruth(NamedTuple):
    """The correct places of each query, and the queries and places to leave out of scores.

    positives: (Q,R) int64, every correct place of each query, -1 as padding; a row of -1 has none.
    judged: (Q,) bool, False for queries that the ground truth does not mention: no score includes them.
    ignored: (Q,S) int64, places that are neither correct nor wrong, -1 as padding; S may be 0.
    """

    positives: Tensor
    judged: Tensor
    ignored: Tensor


class Nowhere(InputError):
    """No query has a right place by its coordinates. truth: which has none, for those who ask why."""

    def __init__(self, message: str, truth: GroundTruth) -> None:
        super().__init__(message)
        self.truth = truth


Truth: TypeAlias = str | Path | Tensor | np.ndarray | Sequence[int] | Sequence[Sequence[int]] | GroundTruth


def as_ground_truth(truth: Truth, queries: int | None = None) -> GroundTruth:
    """The correct places in any form as a GroundTruth; all but those that a file does not list are judged.

    Args:
        truth: integers (Q,), the place of each query, -1 for none, or (Q,R), all its places, -1 as padding; a
            boolean matrix (Q,N), True for the correct places; arrays and lists likewise, also lists of
            different lengths; text as in `find_ground_truth`, for which their number has to be known.
        queries: their number, to be checked.

    Raises:
        InputError: another form or number of rows; a matrix of 0 and 1 that is not boolean.

    Example:
        >>> as_ground_truth([[3, 4], [], [0]]).positives.tolist()
        [[3, 4], [-1, -1], [0, -1]]
    """
    expect(truth is not None, FORMS, "there is no truth")
    if not is_given(truth):
        if queries is None:
            raise InputError(f"the truth is {truth} for an unknown number of queries; expected the number")
        ground_truth = find_ground_truth(truth, None, None, None, queries)
        assert ground_truth is not None
        return ground_truth
    if not isinstance(truth, GroundTruth):
        truth = all_judged(_table_of(truth))
    shapes = [tuple(part.shape) for part in truth]
    rows = len(truth.judged) if queries is None else queries
    fits = shapes[1] == (rows,) and all(len(shape) == 2 and shape[0] == rows for shape in shapes[::2])
    seen = f"the truth is {shapes[0]}, with judged {shapes[1]} and ignored {shapes[2]}"
    expect(fits, f"({rows}, R), ({rows},) and ({rows}, S), one row per query", seen)
    return truth


def all_judged(places: Tensor) -> GroundTruth:
    """The places (Q,R) of queries that are all judged."""
    judged = torch.ones(len(places), dtype=torch.bool, device=places.device)
    return GroundTruth(places, judged, places.new_zeros(len(places), 0))


def _table_of(truth: Iterable[object]) -> Tensor:
    """Places in any form as a table (Q,R) int64, -1 as padding."""
    if isinstance(truth, Tensor) and truth.dtype in (torch.int32, torch.int64) and truth.ndim == 2:
        return refuse_zero_one_matrix(truth.long())
    try:
        rows = _rows(truth)
    except (TypeError, ValueError, RuntimeError) as error:
        seen = f"the truth is a {type(truth).__name__} ({one_line(error)})"
        raise InputError(f"{seen}; expected {FORMS}") from error
    odd = [row for row in rows if row.ndim != 1 or row.is_floating_point() or row.is_complex()]
    kinds = {row.dtype == torch.bool for row in rows}
    seen = f"{tuple(odd[0].shape)} {odd[0].dtype}" if odd else "truth values and places"
    expect(not odd and len(kinds) <= 1, FORMS, f"a query of the truth has {seen}")
    if kinds == {True}:
        return padded(row.nonzero()[:, 0] for row in rows)
    return refuse_zero_one_matrix(padded(row.long() for row in rows))


def refuse_zero_one_matrix(table: Tensor) -> Tensor:
    """Refuse what is a matrix of queries and places rather than a table of places."""
    matrix = len(table) > 1 and table.shape[1] > 3
    if matrix and bool(((table == 0) | (table == 1)).all()):
        seen = f"the truth is {tuple(table.shape)} of 0 and 1, in which places repeat"
        raise InputError(f"{seen}; expected truth.bool() if it is a matrix of queries and places")
    return table


def _rows(truth: Iterable[object]) -> list[Tensor]:
    """What a truth says of each query, (R,)."""
    if isinstance(truth, Sequence) and any(isinstance(row, Sequence | Tensor | np.ndarray) for row in truth):
        rows = [torch.as_tensor(row) for row in truth]
        return [row if row.numel() else row.long().view(-1) for row in rows]
    values = torch.as_tensor(np.ascontiguousarray(truth) if isinstance(truth, np.ndarray) else truth)
    if values.ndim == 1 and values.dtype == torch.bool:
        raise TypeError("one truth value for each query")
    return list(values[:, None] if values.ndim == 1 else values)


def padded(rows: Iterable[Tensor]) -> Tensor:
    """Places (n,) int64 of each query as a table (Q,R), -1 as padding; refuses one too large for memory."""
    rows = list(rows)
    check_table(len(rows), max(map(len, rows), default=0))
    return pad_sequence(rows, batch_first=True, padding_value=-1)


def check_table(queries: int, places: int) -> None:
    """Refuse a ground truth that does not fit in memory, before it is allocated."""
    needed = BYTES_PER_PLACE * queries * places
    check_room(needed, f"a ground truth of up to {places} places for each of {queries} queries")


def offset_truth(queries: int | Tensor, frames: int | None, offset: int = 0) -> Tensor:
    """Place = query + offset, (Q,1) int64; -1, no right answer, if there is no such frame.

    Args:
        queries: their number, or (Q,) int64 the index of each. frames: of the reference, None if unknown.
    """
    frame = (torch.arange(queries) if isinstance(queries, int) else queries) + offset
    exists = frame >= 0 if frames is None else (frame >= 0) & (frame < frames)
    return torch.where(exists, frame, -1)[:, None]


def position_truth(reference: Tensor, query: Tensor) -> Tensor:
    """The reference frame nearest to each query by position along the route.

    Shape: positions reference (N,), query (Q,) in one unit -> (Q,1) int64, -1 if the nearest frame is farther
        than the longest step of the reference.
    """
    ordered, order = reference.double().sort()
    slot = torch.searchsorted(ordered, query.double()).clamp(1, max(1, len(ordered) - 1))
    pair = torch.stack([slot - 1, slot.clamp(max=len(ordered) - 1)])
    gap, nearest = (ordered[pair] - query.double()).abs().min(0, keepdim=True)
    longest = float(ordered.diff().max()) if len(ordered) > 1 else 0.0
    return torch.where(gap <= longest, order[pair.gather(0, nearest)], -1).T


def near_truth(reference: Tensor, query: Tensor, radius: float) -> Tensor:
    """Every reference frame within a radius, inclusive, of each query.

    Shape: coordinates reference (N,K), query (Q,K), in the unit of the radius -> (Q,R) int64, -1 as padding.
    """
    rows: list[Tensor] = []
    for part in query.double().split(max(1, PAIRS_PER_BLOCK // max(1, len(reference)))):
        # matrix products would lose the metres of large coordinates
        distance = torch.cdist(part, reference.double(), compute_mode="donot_use_mm_for_euclid_dist")
        near = distance <= radius
        check_table(len(query), int(near.sum(1).max()))
        rows += [row.nonzero()[:, 0] for row in near]
    return padded(rows)


def check_unit(near: Near, layout: Layout) -> None:
    """Refuse a distance in pixels for an area in metres, and the reverse."""
    layout.expect_unit(near.unit, f"truth {near.kind}:{near.radius:g}")


def widened(truth: GroundTruth, layout: Layout, radius: int) -> GroundTruth:
    """A ground truth of which all places up to a radius from a right one are right."""
    known = truth.positives.clamp(min=0).flatten()
    near = layout.around(known, radius).view(*truth.positives.shape, -1)
    return truth._replace(positives=near.masked_fill((truth.positives < 0)[..., None], -1).flatten(1))


def of_loops(truth: GroundTruth, queries: Tensor, apart: int, passed: Tensor | None = None) -> GroundTruth:
    """A ground truth (Q,R) of which only places over `apart` frames before the query (Q,) are right.

    Args:
        passed: how many frames have moved, up to each place and query (N,); None is all of them.
    """
    count = 1 + int(max(queries.max(), truth.positives.max()))
    passed = torch.arange(count) if passed is None or len(passed) < count else passed
    before = passed[truth.positives.clamp(min=0)] < passed[queries, None] - apart
    positives = torch.where(before, truth.positives, -1)
    expect((positives >= 0).any(), "loops", f"no query comes back to a place over {apart} frames before")
    return truth._replace(positives=positives)


def is_right(index: Tensor, truth: Tensor, tolerance: int) -> Tensor:
    """Whether each reported place is within the tolerance of any of its correct places.

    Shape: index (Q,) int64, truth (Q,R) int64 -> (Q,) bool.

    Convention: the tolerance is inclusive, |index - truth| <= tolerance; -1 is not a place.

    Example:
        >>> is_right(torch.tensor([5, 6, -1]), torch.tensor([[0], [0], [0]]), tolerance=5).tolist()
        [True, False, False]
    """
    tolerance = min(tolerance, LARGEST)  # int64 cannot hold every int
    near = (index[:, None] - truth).abs() <= tolerance
    return (near & (truth >= 0) & (index >= 0)[:, None]).any(1)


def counted(index: Tensor, truth: GroundTruth, tolerance: int) -> Tensor:
    """Which queries are scored: judged ones that do not report an ignored place. (Q,) -> (Q,) bool."""
    return scored_and_right(index, truth, tolerance)[0]


def scored_and_right(index: Tensor, truth: GroundTruth, tolerance: int) -> tuple[Tensor, Tensor]:
    """Which queries are `counted`, and which of these are right. (Q,) -> two (Q,) bool."""
    right = truth.judged & is_right(index, truth.positives, tolerance)
    return right | truth.judged & ~is_right(index, truth.ignored, 0), right


def ground_truth_in_places(truth: GroundTruth, place_of: Callable[[Tensor], Tensor]) -> GroundTruth:
    """A ground truth in reference frames converted to places by `PlaceMap.place_of`."""
    return truth._replace(positives=place_of(truth.positives), ignored=place_of(truth.ignored))


def is_given(truth: Truth | None) -> TypeGuard[Tensor | np.ndarray | Sequence[Any] | GroundTruth]:
    """Whether a ground truth is places themselves, not words or a file that tell of them."""
    return truth is not None and not isinstance(truth, str | Path | Real)


def check_ground_truth(truth: Truth, interpolate: bool = False) -> int | Near | Path | GroundTruth:
    """Parse a ground truth as an offset, a radius in metres, or an existing file, before long work starts."""
    if is_given(truth):
        expect(not interpolate, "a .csv of query,place to interpolate", "the truth is given, not listed")
        return as_ground_truth(truth)
    truth = str(truth)  # YAML gives an offset as a number
    path = Path(truth)
    suffix = path.suffix.lower()
    expect(not interpolate or suffix == ".csv", "a .csv of query,place to be interpolated", truth=truth)
    if suffix in (".csv", ".json", ".npz"):
        check_regular(path, EXPECTED)
        return path
    if (offset := offset_of(truth)) is not None:
        return offset
    name, colon, radius = truth.partition(":")
    metres = as_number(radius) if colon else 25.0
    if name not in COORDINATES or metres is None or metres < 0:
        raise InputError(f"truth {truth!r} is not known; expected {EXPECTED}")
    return Near(name, metres)


def find_ground_truth(
    truth: Truth | None,
    reference: Traverse | None,
    query: Traverse | None,
    frames: int | None,
    queries: int | Tensor,
    interpolate: bool = False,
    resampled: bool = False,
    counters: bool = True,
) -> GroundTruth | None:
    """Read a ground truth, or derive it from the sources, in frames of the reference.

    Args:
        truth: one of

            - an integer offset: place = query + offset;
            - a `.csv` of `query,place[,place...]`, optionally with this header: all listed places are right.
              A query without places, or with -1, has no right answer; unlisted queries are not scored;
            - a `.json` with a list of right places for each query in order; an empty list means none;
            - an `.npz` with the boolean matrices (reference frames, query frames) `GThard` and/or `GTsoft`,
              as in the visual place recognition tutorial of Schubert et al. Places in GThard are right (in
              GTsoft, if that is the only one); places in GTsoft only are ignored;
            - `utm:25`: every reference frame within 25 metres (inclusive; `utm` alone means 25) by the UTM
              coordinates in the names of both traverses' images, `@easting@northing@...@.jpg`; `degrees:25`
              and `metres:25` likewise, or for the latter those that the traverses carry, see
              `coordinates_of`;
            - the places themselves, a row for each frame of the query, see `as_ground_truth`;
            - None: the positions that both traverses carry; else frame i is place i if they are of equal
              length, not resampled and aligned (see `are_aligned`); else there is no ground truth.
        reference, query: the sources, not resampled, or None.
        frames: the number of reference frames, None if unknown.
        queries: their number, or (Q,) int64 the frame of each query in its source.
        interpolate: interpolate the place of a query between two listed in the .csv, rounded.
        resampled: whether queries and places are resampled by distance. A listed frame that is not a query
            then applies to the nearest query, unless that is listed too.
        counters: see `are_aligned`; a warning tells if nothing else says so.

    Convention 11: a ground truth counts frames of the sources; see `ground_truth_in_places`. The tolerance
        of the scores, inclusive, is added to it.

    Raises:
        InputError: a ground truth that cannot be read, does not fit, or gives no query a right answer.

    Example:
        >>> find_ground_truth("-1", None, None, frames=3, queries=3).positives.tolist()
        [[-1], [0], [1]]
    """
    numbers, all_frames = (torch.arange(queries), True) if isinstance(queries, int) else (queries, False)
    if truth is None:
        if reference is None or query is None:
            return None
        if reference.places is not None and query.places is not None:
            return all_judged(position_truth(reference.places, _rows_of(query.places, numbers)))
        same_length = not resampled and len(query) == frames
        if not same_length or not are_aligned(reference, query, counters):
            return None
        if not are_aligned(reference, query, counters=False):
            pair = reference.name, query.name
            log.warning("%s and %s count their frames alike: frame i is taken to show place i", *pair)
        return all_judged(offset_truth(numbers, frames))
    parsed = check_ground_truth(truth, interpolate)
    if isinstance(parsed, GroundTruth):
        count = len(numbers) if all_frames else None if query is None else len(query)
        rows = (_rows_of(part, numbers) for part in as_ground_truth(parsed, count))
        ground_truth = GroundTruth(*rows)
    elif isinstance(parsed, int):
        ground_truth = all_judged(offset_truth(numbers, frames, parsed))
    elif isinstance(parsed, Near):
        if reference is None or query is None:
            seen = f"truth {truth} compares coordinates, which the sources carry or names of images tell"
            raise InputError(f"{seen}; expected reference and query")
        stored, asked = coordinates_of([reference, query], parsed.kind)
        asked = _rows_of(asked, numbers)
        ground_truth = all_judged(near_truth(stored, asked, parsed.radius))
        ground_truth = ground_truth._replace(judged=~asked.isnan().any(1))
        known = stored.isfinite().all(1).any() and ground_truth.judged.any()
        if known and not (ground_truth.positives >= 0).any():
            raise Nowhere(describe_distant(stored, asked, parsed, reference), ground_truth)
    elif parsed.suffix.lower() == ".npz":
        hard, *soft = read_matrices(parsed, numbers, frames, all_frames)
        ground_truth = all_judged(padded(row.nonzero()[:, 0] for row in hard))
        if soft:
            ignored = padded(row.nonzero()[:, 0] for row in soft[0] & ~hard)
            ground_truth = ground_truth._replace(ignored=ignored)
    else:
        length = len(query) if query is not None else None
        if parsed.suffix.lower() == ".csv":
            listed = read_listed(parsed, query, reference, frames, interpolate)
        else:
            count = len(numbers) if all_frames else length
            listed = read_json(parsed, frames, count, int(numbers.max()) + 1)
        places, judged = places_of_queries(parsed, listed, numbers, length, interpolate, resampled)
        ground_truth = all_judged(padded(places))._replace(judged=judged)
    if (ground_truth.positives >= 0).any():
        _warn_of_many(ground_truth, frames)
        return ground_truth
    if not isinstance(parsed, int):
        raise InputError(f"no query has a right answer: {describe_ground_truth(truth)}")
    last = "" if frames is None else f" to {frames - 1 - int(numbers.min())}"
    expected = f"an offset from {-int(numbers.max())}{last}"
    raise InputError(f"no query has a right answer with truth {parsed}; expected {expected}")


def describe_distant(stored: Tensor, asked: Tensor, near: Near, reference: Traverse) -> str:
    """How far coordinates (N,K) and (Q,K) lie apart, none of which are near each other, in words."""
    one, other = (table[~table.isnan().any(1)].median(0).values for table in (stored, asked))
    frame = "" if reference.coordinates is None else reference.coordinates.frame
    words, apart = describe_ground_truth(f"{near.kind}:{near.radius:g}"), float((one - other).norm())
    seen = f"no query has a right answer {words}: their middle is {rounded(apart)} {near.unit} from"
    wanted = f"coordinates in {frame}, or lat,lon" if OF_MAPS.match(frame) else "coordinates in one system"
    return f"{seen} that of {reference.name}; expected {wanted}, or a larger distance"


def _warn_of_many(truth: GroundTruth, frames: int | None) -> None:
    """Warn if so many pairs of a query and a place are right that any answer may be."""
    if frames is None or frames < FEW or not truth.judged.any():
        return
    share = float((truth.positives[truth.judged] >= 0).sum(1).double().mean()) / frames
    if share > OFTEN:
        log.warning(
            "%.0f %% of all pairs of a query and a place count as right; is this truth meant?", 100 * share
        )


def _rows_of(table: Tensor, numbers: Tensor) -> Tensor:
    if (last := int(numbers.max())) >= len(table):
        raise InputError(f"there is a query {last}; expected numbers below {len(table)}")
    return table[numbers]


def are_aligned(reference: Traverse, query: Traverse, counters: bool = True) -> bool:
    """Whether frame i of both traverses, of equal length, is known to show the same place.

    True for the same cuts of two long images, equal coordinates, and names that agree, see `names_agree`.
    """
    if reference.cut is not None:
        return reference.cut == query.cut
    ours, theirs = reference.coordinates, query.coordinates
    if ours and theirs and ours[1:] == theirs[1:] and torch.equal(ours.values, theirs.values):
        return True
    return reference.times is None and names_agree(reference.names, query, counters)


def names_agree(names: Sequence[str], query: Traverse, counters: bool = True) -> bool:
    """Whether the frames of a query have these unique names. Times of video frames are not names: any two
    recordings share them. Nor are mere counters unless `counters`: any two exports share them."""
    unique = query.times is None and bool(names) and all(names) and len({*names}) == len(names)
    return unique and [*names] == [*query.names] and (counters or not merely_count(names))


def merely_count(names: Sequence[str]) -> bool:
    """Whether names differ only in numbers that are evenly spaced, but for one in ten.

    Example:
        >>> merely_count(["frame_09.png", "frame_10.png"]), merely_count(["0.1", "0.25", "0.3"])
        (True, False)
    """
    alike: dict[str, list[list[Decimal]]] = {}
    for name in names:
        alike.setdefault(NUMBER.sub("0", name), []).append([*map(Decimal, NUMBER.findall(name))])
    pairs = (pair for numbers in alike.values() for pair in pairwise(sorted(numbers)))
    steps = Counter(tuple(map(operator.sub, after, before)) for before, after in pairs)
    breaks = len(names) - 1 - max(steps.values(), default=0)
    return breaks <= len(names) // 10


def describe_ground_truth(truth: Truth | None, interpolate: bool = False, positions: bool = False) -> str:
    """What `find_ground_truth` uses, in words; `positions`: whether both traverses have them."""
    if truth is None:
        carried = "the positions in both sources"
        return carried if positions else ASSUMED
    parsed = check_ground_truth(truth)
    if isinstance(parsed, GroundTruth):
        return "the places that the caller gave"
    if isinstance(parsed, int):
        return "place = query" + (f" {'-' if parsed < 0 else '+'} {abs(parsed)}" if parsed else "")
    if isinstance(parsed, Near):
        where = "" if parsed.kind in ("metres", "pixels") else " in image names"
        return f"within {parsed.radius:g} {parsed.unit} by the coordinates{where}"
    return f"{truth}, interpolated" if interpolate else str(truth)


def offset_of(truth: Truth | None, positions: bool = False) -> int | None:
    """The offset of a ground truth place = query + offset; None for others. See `describe_ground_truth`."""
    if truth is None:
        return None if positions else 0
    if is_given(truth):
        return None
    with suppress(ValueError):
        return offset if abs(offset := int(str(truth))) < LARGEST else None
    return None
