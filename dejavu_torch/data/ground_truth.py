"""The ground truth: which reference frames each query may report.

A new format of ground truth is one function that reads it and one line of `FORMATS`.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from dejavu_torch.data.arrays import HEADER, read_header
from dejavu_torch.data.files import LARGEST, as_number, check_regular, read_text, reading
from dejavu_torch.memory import check_room
from dejavu_torch.types import GroundTruth, InputError, Traverse

PAIRS_AT_ONCE = 2**20
BYTES_A_PLACE = 32  # of a table of right places, and of what is computed of it


def as_ground_truth(truth: Tensor | GroundTruth) -> GroundTruth:
    """Correct places (Q,R), -1 as padding, as a GroundTruth that judges every query."""
    if isinstance(truth, GroundTruth):
        return truth
    judged = torch.ones(len(truth), dtype=torch.bool)
    return GroundTruth(truth, judged, truth.new_zeros(len(truth), 0))


def padded(rows: Iterable[Tensor]) -> Tensor:
    """Places of each query, (n,) int64, as a table (Q,R), -1 as padding.

    Raises:
        InputError: a table for which there is no room.
    """
    rows = list(rows)
    check_table(len(rows), max(map(len, rows), default=0))
    return pad_sequence(rows, batch_first=True, padding_value=-1)


def check_table(queries: int, places: int) -> None:
    """Refuse, before it is made, a ground truth of more places a query than there is room for."""
    needed = BYTES_A_PLACE * queries * places
    check_room(needed, f"a ground truth of up to {places} places for each of {queries} queries")


def offset_truth(queries: int | Tensor, frames: int | None, offset: int = 0) -> Tensor:
    """Query i is frame i + offset; where there is no such frame, the query has no right answer (-1).

    Args:
        queries: how many, or (Q,) int64 the number of each. frames: of the reference, None where unknown.

    Shape: -> (Q,1) int64.

    Example:
        >>> offset_truth(3, 3, offset=1).flatten().tolist()
        [1, 2, -1]
    """
    frame = (torch.arange(queries) if isinstance(queries, int) else queries) + offset
    there = frame >= 0 if frames is None else (frame >= 0) & (frame < frames)
    return torch.where(there, frame, -1)[:, None]


def position_truth(reference: Tensor, query: Tensor) -> Tensor:
    """The reference frame nearest to each query by position along the route.

    Args:
        reference: (N,) positions of the reference frames. query: (Q,) positions of the queries, in
            the same unit.

    Shape: -> (Q,1) int64, -1 for a query further than the widest step of the reference from all
        of its frames.
    """
    ordered, order = reference.double().sort()
    slot = torch.searchsorted(ordered, query.double()).clamp(1, max(1, len(ordered) - 1))
    pair = torch.stack([slot - 1, slot.clamp(max=len(ordered) - 1)])
    gaps = (ordered[pair] - query.double()).abs()
    nearest = gaps.argmin(0, keepdim=True)
    widest = float(ordered.diff().max()) if len(ordered) > 1 else 0.0
    place = torch.where(gaps.gather(0, nearest) <= widest, order[pair.gather(0, nearest)], -1)
    return place.T


def near_truth(reference: Tensor, query: Tensor, radius: float) -> Tensor:
    """Every reference frame within a distance of each query.

    Args:
        reference: (N,K) coordinates of the reference frames. query: (Q,K) those of the queries.
        radius: inclusive, in the unit of the coordinates.

    Shape: -> (Q,R) int64, -1 as padding.

    Example:
        >>> near_truth(torch.tensor([[0.0, 0.0], [3.0, 4.0]]), torch.zeros(1, 2), radius=5.0).tolist()
        [[0, 1]]
    """
    rows: list[Tensor] = []
    most = 0
    for part in query.double().split(max(1, PAIRS_AT_ONCE // max(1, len(reference)))):
        # matrix products would cancel the metres of large coordinates
        distance = torch.cdist(part, reference.double(), compute_mode="donot_use_mm_for_euclid_dist")
        near = distance <= radius
        most = max(most, int(near.sum(1).max()))
        check_table(len(query), most)
        rows += _columns(near)
    return padded(rows)


def is_right(index: Tensor, truth: Tensor, tolerance: int) -> Tensor:
    """Whether each reported place is within the tolerance of any of its correct places.

    Shape: index (Q,) int64, truth (Q,R) int64 -> (Q,) bool.

    Convention: the tolerance is inclusive, |index - truth| <= tolerance; -1 is no place.

    Example:
        >>> is_right(torch.tensor([5, 6, -1]), torch.tensor([[0], [0], [0]]), tolerance=5).tolist()
        [True, False, False]
    """
    near = (index[:, None] - truth).abs() <= min(
        tolerance, LARGEST
    )  # what int64 cannot hold would compare wrong
    return (near & (truth >= 0) & (index >= 0)[:, None]).any(1)


def counted(index: Tensor, truth: GroundTruth, tolerance: int) -> Tensor:
    """Which queries a score counts: those that are judged and do not report an ignored place.

    Shape: (Q,) -> (Q,) bool.
    """
    ignored = is_right(index, truth.ignored, 0)
    return truth.judged & (is_right(index, truth.positives, tolerance) | ~ignored)


def ground_truth_in_places(truth: GroundTruth, place_of: Callable[[Tensor], Tensor]) -> GroundTruth:
    """A ground truth that counts reference frames as one that counts places.

    Args:
        place_of: the place nearest to each frame, -1 for none, as `PlaceMap.place_of`.
    """
    return truth._replace(positives=place_of(truth.positives), ignored=place_of(truth.ignored))


# what is read -------------------------------------------------------------------------------------------


class Request(NamedTuple):
    """What a ground truth is needed for; see `find_ground_truth`."""

    reference: Traverse | None
    query: Traverse | None
    frames: int | None
    queries: int | Tensor
    interpolate: bool
    resampled: bool
    aligned: bool

    @property
    def numbers(self) -> Tensor:
        """(Q,) int64, the frame of each query."""
        return torch.arange(self.queries) if isinstance(self.queries, int) else self.queries

    def numbers_below(self, count: int) -> Tensor:
        """The same, where the query's traverse has so many frames."""
        last = int(self.numbers.max())
        if last >= count:
            raise InputError(f"there is a query {last}; expected numbers below {count}")
        return self.numbers


class Format(NamedTuple):
    """One way to give a ground truth as text.

    expected: how a message names it. fits: whether a text is one. read: what it means. describe: in words.
    """

    expected: str
    fits: Callable[[str], bool]
    read: Callable[[str, Request], GroundTruth]
    describe: Callable[[str], str] = str


def check_ground_truth(truth: str, interpolate: bool = False) -> Format:
    """The format of a text; refuses one that is no ground truth early, before long work.

    Raises:
        InputError: none of `FORMATS`, a file that cannot be opened, or interpolation of anything but a .csv.
    """
    for format in FORMATS:
        if format.fits(truth):
            if interpolate and format.read is not read_table:
                raise InputError(f"truth {truth} cannot be interpolated; expected a .csv of query,place")
            return format
    raise InputError(f"truth {truth!r} is not known; expected {_expected()}")


def find_ground_truth(
    truth: str | None,
    reference: Traverse | None,
    query: Traverse | None,
    frames: int | None,
    queries: int | Tensor,
    interpolate: bool = False,
    resampled: bool = False,
    aligned: bool = False,
) -> GroundTruth | None:
    """The ground truth that a text means, or what is known without one, in frames of the reference.

    Args:
        truth: one of

            - an integer offset: place = query + offset;
            - a `.csv` of `query,place[,place...]`, with or without such a header: every listed place is
              right, so no other columns. A query listed without a place, or with -1, has no right answer; a
              query not listed is not known, and is left out of the scores;
            - an `.npz` with the boolean matrices (reference frames, query frames) `GThard` and/or `GTsoft`,
              as the visual place recognition tutorial of Schubert et al. keeps them. What is in GThard is
              right (in GTsoft, if that is the only one); what is in GTsoft only counts neither way;
            - `utm:25`: every reference frame within 25 metres (inclusive; `utm` alone means 25) by the UTM
              coordinates in the names of both traverses' images, `@easting@northing@...@.jpg`;
            - None: the positions that both traverses carry; else frame i is place i where they say so, see
              `say_aligned`, are equally long and nothing is resampled; else there is no ground truth.
        reference, query: the sources, not resampled; None where there is none at hand.
        frames: how many frames the reference has, None where unknown.
        queries: how many, or (Q,) int64 the frame of each query in its source.
        interpolate: a query between two that the .csv lists gets the place between theirs, rounded.
        resampled: queries and places are resampled by distance: a query frame that is listed but shown by no
            query then speaks for the nearest one that is shown and not listed.
        aligned: of two traverses that are equally long, frame i is place i whatever they say, as where a user
            names one as another traverse of the same places.

    Convention 11: a ground truth counts frames of the sources, whether or not they are resampled; see
        `ground_truth_in_places`. The tolerance of the scores applies on top, inclusive.

    Raises:
        InputError: a ground truth that cannot be read or does not fit, or by which no query has a right
            answer.

    Example:
        >>> find_ground_truth("-1", None, None, frames=3, queries=3).positives.tolist()
        [[-1], [0], [1]]
    """
    request = Request(reference, query, frames, queries, interpolate, resampled, aligned)
    if truth is None:
        return _default(request)
    format = check_ground_truth(truth, interpolate)
    found = format.read(truth, request)
    if not (found.positives >= 0).any():
        raise InputError(f"no query has a right answer: {format.describe(truth)}")
    return found


def _default(request: Request) -> GroundTruth | None:
    reference, query, queries = request.reference, request.query, request.queries
    if reference is None or query is None:
        return None
    if reference.place is not None and query.place is not None:
        position = query.place[request.numbers_below(len(query.place))]
        return as_ground_truth(position_truth(reference.place, position))
    count = queries if isinstance(queries, int) else query.length
    if request.resampled or count is None or count != request.frames:
        return None
    if not (request.aligned or say_aligned(reference, query, count)):
        return None
    return as_ground_truth(offset_truth(queries, request.frames))


def say_aligned(reference: Traverse, query: Traverse, frames: int) -> bool:
    """Whether two traverses of so many frames say themselves that frame i of both shows the same place.

    They do where both were cut alike, each out of a long image, or where the frames of both have the same
    names, all different. Times, as of the frames of a video, are no such names: any two recordings share
    them.

    Example:
        >>> from dejavu_torch.data.source import open_source
        >>> one, two = (open_source(f"sim:aerial?frames=8&traverse={i}") for i in (0, 1))
        >>> say_aligned(one, two, 8)  # they have positions, but no names
        False
    """
    if reference.cut is not None:
        return reference.cut == query.cut
    if not math.isnan(reference.frame_time(0)):
        return False
    names = [reference.frame_name(i) for i in range(frames)]
    if not all(names) or len({*names}) < frames:
        return False
    return all(query.frame_name(i) == name for i, name in enumerate(names))


def describe_ground_truth(truth: str | None, interpolate: bool = False, positions: bool = False) -> str:
    """What `find_ground_truth` takes for the ground truth, in words.

    Args:
        positions: whether both traverses carry their positions.

    Example:
        >>> describe_ground_truth("12"), describe_ground_truth(None)
        ('place = query + 12', 'place = query, as the sources say themselves')
    """
    if truth is None:
        carried = "the positions that both traverses carry"
        return carried if positions else "place = query, as the sources say themselves"
    words = check_ground_truth(truth).describe(truth)
    return f"{words}, interpolated" if interpolate else words


def offset_of(truth: str | None, positions: bool = False) -> int | None:
    """The offset of a ground truth place = query + offset, as of `describe_ground_truth`; None for others."""
    if truth is None:
        return None if positions else 0
    return _offset(truth)


# offsets and coordinates --------------------------------------------------------------------------------


def read_offset(truth: str, request: Request) -> GroundTruth:
    """An integer: place = query + offset."""
    numbers, frames = request.numbers, request.frames
    positives = offset_truth(numbers, frames, int(truth))
    if not (positives >= 0).any():
        last = "" if frames is None else f" to {frames - 1 - int(numbers.min())}"
        expected = f"an offset from {-int(numbers.max())}{last}"
        raise InputError(f"no query has a right answer with truth {truth}; expected {expected}")
    return as_ground_truth(positives)


def read_coordinates(truth: str, request: Request) -> GroundTruth:
    """`utm:25`: every reference frame within 25 metres."""
    if request.reference is None or request.query is None:
        raise InputError(f"truth {truth} lies in the names of images; expected both traverses")
    query = utm_coordinates(request.query)
    near = near_truth(
        utm_coordinates(request.reference), query[request.numbers_below(len(query))], _radius(truth) or 0.0
    )
    return as_ground_truth(near)


def utm_coordinates(traverse: Traverse) -> Tensor:
    """Easting and northing in the names of a traverse's images, metres: (N,2) float64.

    Raises:
        InputError: no folder of images, or a name without them.
    """
    names = [traverse.frame_name(i) for i in range(traverse.length or 0)]
    if not any(names):
        raise InputError(f"{traverse.name} has no image names; expected folders of images for truth utm")
    rows = []
    for name in names:
        row = [as_number(part) for part in name.split("@")[1:3]]
        if len(row) != 2 or None in row:
            raise InputError(
                f"{traverse.name}: {name} has no UTM coordinates; expected @easting@northing@...@.jpg"
            )
        rows.append(row)
    return torch.tensor(rows, dtype=torch.float64)


def _offset(truth: str) -> int | None:
    try:
        offset = int(truth)
    except ValueError:
        return None
    return offset if abs(offset) < LARGEST else None


def _radius(truth: str) -> float | None:
    name, colon, radius = truth.partition(":")
    metres = as_number(radius) if colon else 25.0
    return metres if name == "utm" and metres is not None and metres >= 0 else None


# tables -------------------------------------------------------------------------------------------------


def read_table(truth: str, request: Request) -> GroundTruth:
    """A csv of `query,place[,place...]`."""
    path, numbers, interpolate = Path(truth), request.numbers, request.interpolate
    listed = _listed(path, request.frames, interpolate)
    first, last = min(listed), max(listed)
    if interpolate:
        knots = sorted(listed)
        between = np.interp(numbers.numpy(), knots, [listed[query][0] for query in knots]).tolist()
        judged = (numbers >= first) & (numbers <= last)
        sets = [[place] if inside else [] for place, inside in zip(between, judged.tolist(), strict=True)]
    else:
        if request.resampled:
            length = None if request.query is None else request.query.length
            if length is not None and last >= length:
                raise InputError(f"{path} lists query {last}; expected frames from 0 to {length - 1}")
            listed = _at_shown(listed, numbers)
        judged = torch.tensor([query in listed for query in numbers.tolist()])
        sets = [listed.get(query, []) for query in numbers.tolist()]
    if not judged.any():
        wanted = f"{int(numbers.min())} to {int(numbers.max())}"
        raise InputError(f"{path} lists queries from {first} to {last}; expected some of {wanted}")
    rows = (torch.tensor([_rounded(place) for place in places], dtype=torch.int64) for places in sets)
    return as_ground_truth(padded(rows))._replace(judged=judged)


def _at_shown(listed: dict[int, list[float]], frames: Tensor) -> dict[int, list[float]]:
    """Listed query frames that no query shows, given to the nearest frame that is shown and not listed."""
    ordered = frames.sort().values
    moved = {frame: list(places) for frame, places in listed.items()}
    for frame in listed:
        after = int(torch.searchsorted(ordered, frame))
        near = ordered[max(0, after - 1) : after + 1].tolist()
        nearest = min(near, key=lambda other: abs(other - frame))
        if nearest not in listed:
            moved.setdefault(nearest, []).extend(listed[frame])
    return moved


def _listed(path: Path, frames: int | None, interpolate: bool) -> dict[int, list[float]]:
    """The places of each query that a csv lists."""
    listed: dict[int, list[float]] = {}
    for line, cells in _table_rows(path):
        where = f"{path}, line {line}"
        values = []
        for cell in cells:
            value = as_number(cell)
            if value is None:
                raise InputError(f"{where}: {cell!r} is no frame number; expected query,place")
            values.append(value)
        query, found = values[0], [place for place in values[1:] if place != -1]
        if query < 0 or query % 1:
            raise InputError(f"{where}: query {cells[0]}; expected a whole number of at least 0")
        if query in listed:
            raise InputError(f"{where}: query {cells[0]} is listed twice; expected each once")
        for place in found:
            if place < 0 or (frames is not None and _rounded(place) >= frames):
                last = "" if frames is None else f" to {frames - 1}"
                expected = f"a frame of the reference from 0{last}, or -1 for none"
                raise InputError(f"{where}: place {place:.12g}; expected {expected}")
            if place % 1 and not interpolate:
                raise InputError(f"{where}: place {place:.12g}; expected a whole number, or interpolation")
        if interpolate and len(found) != 1:
            raise InputError(f"{where}: {len(found)} places; expected one in each line to interpolate")
        listed[int(query)] = found
    if not listed:
        raise InputError(f"{path} lists no query; expected lines of query,place")
    return listed


def _table_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Number and cells of each line that is not blank, without the header."""
    text = read_text(path, "lines of query,place").replace('"', "")
    # where semicolons separate, a comma may be a decimal one: it stays in its cell and is refused
    separator = next((sign for sign in ";\t," if sign in text), None)
    rows = []
    for number, line in enumerate(text.split("\n"), 1):
        cells = [cell.strip() for cell in line.strip(" ").split(separator)]
        while cells and not cells[-1]:
            del cells[-1]
        if cells:
            rows.append((number, cells))
    if rows and all(as_number(cell) is None for cell in rows[0][1]):
        number, names = rows.pop(0)
        first, *others = [name.lower() for name in names]
        # another column, such as a distance, would count as a right place
        if first != "query" or any(name and not name.startswith("place") for name in others):
            raise InputError(
                f"{path}, line {number}: columns {','.join(names)}; expected query,place[,place...]"
            )
    return rows


def _rounded(place: float) -> int:
    return math.floor(place + 0.5)


# matrices -----------------------------------------------------------------------------------------------


def read_matrices(truth: str, request: Request) -> GroundTruth:
    """An npz of the matrices (reference frames, query frames) GThard and/or GTsoft."""
    path = Path(truth)
    matrices = _load_matrices(path, request)
    if len({matrix.shape for matrix in matrices.values()}) > 1:
        raise InputError(f"{path}: GThard and GTsoft differ in shape; expected the same")
    hard, *soft = [torch.from_numpy(m[:, request.numbers.numpy()].astype(bool)).T for m in matrices.values()]
    found = as_ground_truth(padded(_columns(hard)))
    return found._replace(ignored=padded(_columns(soft[0] & ~hard))) if soft else found


def _columns(which: Tensor) -> Iterator[Tensor]:
    """(Q,N) bool -> Q of (n,) int64, the columns that are true in each row."""
    return (row.nonzero()[:, 0] for row in which)


def _load_matrices(path: Path, request: Request) -> dict[str, np.ndarray]:
    """GThard and GTsoft in this order, those that are there; nothing is read of one that does not fit."""
    expected = "boolean matrices GThard and/or GTsoft"
    found: dict[str, np.ndarray] = {}
    with reading(path, "is no whole .npz file of arrays", expected), zipfile.ZipFile(path) as archive:
        there = [name.removesuffix(".npy") for name in archive.namelist()]
        for name in ("GThard", "GTsoft"):
            if name not in there:
                continue
            entry = archive.getinfo(f"{name}.npy")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(
                    "another compression than that of numpy"
                )  # which a few bytes can make endless
            with archive.open(entry) as file:
                shape, kind, by_columns, start = read_header(file.read(HEADER))
            _check_shape(f"{path}: {name}", shape, kind, request.frames, request.queries)
            count = math.prod(shape)
            if start + count * kind.itemsize != entry.file_size:
                raise ValueError(f"{name} is {shape} {kind} in {entry.file_size} bytes")
            check_room(2.0 * entry.file_size + 16.0 * count, f"{path}: {name} {shape} {kind}")
            with archive.open(entry) as file:  # no more than it says, whatever it unpacks to
                numbers = np.frombuffer(file.read(entry.file_size), kind, count, start)
            if not np.isfinite(numbers).all():
                raise ValueError(f"{name} holds numbers that are not finite")
            found[name] = numbers.reshape(shape, order="F" if by_columns else "C")
    if not found:
        raise InputError(f"{path} holds {', '.join(there) or 'nothing'}; expected {expected}")
    return found


def _check_shape(
    name: str, sides: tuple[int, ...], kind: np.dtype, frames: int | None, queries: int | Tensor
) -> None:
    count = queries if isinstance(queries, int) else int(queries.max()) + 1
    seen = f"{name} is {sides} {kind}"
    rows = "reference frames" if frames is None else frames
    wanted = f"expected a matrix of ({rows}, {count}), a column a query frame"
    if len(sides) != 2 or kind.kind not in "biuf":
        raise InputError(f"{seen}; {wanted}")

    def fits(rows: int, columns: int) -> bool:
        # queries that are given by number may be some of those in the matrix
        enough = columns == count or (columns > count and not isinstance(queries, int))
        return enough and frames in (None, rows)

    shape = sides[0], sides[1]
    # where the reference is not known, as many rows as queries speak for a transposed matrix
    if not fits(*shape) or (frames is None and shape[1] != count == shape[0]):
        raise InputError(f"{seen}; {wanted}{'; transposed it fits' if fits(*shape[::-1]) else ''}")


# the registry -------------------------------------------------------------------------------------------


def _file(suffix: str, truth: str) -> bool:
    """Whether a text names a file of a kind; refuses one that cannot be opened."""
    if Path(truth).suffix.lower() != suffix:
        return False
    check_regular(Path(truth), _expected())
    return True


def _describe_offset(truth: str) -> str:
    offset = int(truth)
    return "place = query" + (f" {'-' if offset < 0 else '+'} {abs(offset)}" if offset else "")


def _describe_radius(truth: str) -> str:
    return f"within {_radius(truth):g} m by the coordinates in image names"


def _expected() -> str:
    *first, last = [format.expected for format in FORMATS]
    return f"{', '.join(first)} or {last}"


FORMATS = (
    Format(
        "an integer offset such as 0", lambda text: _offset(text) is not None, read_offset, _describe_offset
    ),
    Format("a .csv of query,place", partial(_file, ".csv"), read_table),
    Format("an .npz with GThard", partial(_file, ".npz"), read_matrices),
    Format(
        "utm:25 for coordinates in image names",
        lambda text: _radius(text) is not None,
        read_coordinates,
        _describe_radius,
    ),
)
