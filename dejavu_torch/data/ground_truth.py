"""The ground truth: which reference frames each query may report."""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from dejavu_torch.data.files import LARGEST, as_number, check_regular, read_rows, read_text, reading
from dejavu_torch.memory import check_room
from dejavu_torch.types import InputError, Traverse

PAIRS_AT_ONCE = 2**20
EXPECTED = (
    "an integer offset such as 0, a .csv of query,place, a .json with a list of places for each query, an "
    ".npz with GThard or utm:25 for coordinates in image names"
)
PLACE_BYTES = 32  # of each place in a table of right places, with what is computed from it


class GroundTruth(NamedTuple):
    """The correct places of each query, and the queries and places that are not scored.

    positives: (Q,R) int64, every correct place of each query, -1 as padding; a row of -1 has none.
    judged: (Q,) bool, False where the ground truth does not mention a query: it is left out of every score.
    ignored: (Q,S) int64, places that count neither as correct nor as wrong, -1 as padding; S may be 0.
    """

    positives: Tensor
    judged: Tensor
    ignored: Tensor


def as_ground_truth(truth: Tensor | GroundTruth) -> GroundTruth:
    """Correct places (Q,R), -1 as padding, as a GroundTruth that judges every query."""
    if isinstance(truth, GroundTruth):
        return truth
    judged = torch.ones(len(truth), dtype=torch.bool)
    return GroundTruth(truth, judged, truth.new_zeros(len(truth), 0))


def padded(rows: Iterable[Tensor]) -> Tensor:
    """Places of each query, (n,) int64, as a table (Q,R), -1 as padding; refuses one too large for memory."""
    rows = list(rows)
    check_table(len(rows), max(map(len, rows), default=0))
    return pad_sequence(rows, batch_first=True, padding_value=-1)


def check_table(queries: int, places: int) -> None:
    """Refuse a ground truth of more places a query than there is room for, before it is made."""
    needed = PLACE_BYTES * queries * places
    check_room(needed, f"a ground truth of up to {places} places for each of {queries} queries")


def offset_truth(queries: int | Tensor, frames: int | None, offset: int = 0) -> Tensor:
    """Query i is frame i + offset, (Q,1) int64; -1, no right answer, if there is no such frame.

    Args:
        queries: how many, or (Q,) int64 the number of each. frames: of the reference, None where unknown.
    """
    frame = (torch.arange(queries) if isinstance(queries, int) else queries) + offset
    there = frame >= 0 if frames is None else (frame >= 0) & (frame < frames)
    return torch.where(there, frame, -1)[:, None]


def position_truth(reference: Tensor, query: Tensor) -> Tensor:
    """The reference frame nearest to each query by position along the route.

    Shape: reference (N,), query (Q,), of one unit -> (Q,1) int64, -1 for a query further than the widest step
        of the reference from all of its frames.
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
    """Every reference frame within a radius, inclusive, of each query.

    Shape: coordinates reference (N,K), query (Q,K), of the radius' unit -> (Q,R) int64, -1 as padding.
    """
    rows: list[Tensor] = []
    for part in query.double().split(max(1, PAIRS_AT_ONCE // max(1, len(reference)))):
        # matrix products would cancel the metres of large coordinates
        distance = torch.cdist(part, reference.double(), compute_mode="donot_use_mm_for_euclid_dist")
        near = distance <= radius
        check_table(len(query), int(near.sum(1).max()))
        rows += [row.nonzero()[:, 0] for row in near]
    return padded(rows)


def is_right(index: Tensor, truth: Tensor, tolerance: int) -> Tensor:
    """Whether each reported place is within the tolerance of any of its correct places.

    Shape: index (Q,) int64, truth (Q,R) int64 -> (Q,) bool.

    Convention: the tolerance is inclusive, |index - truth| <= tolerance; -1 is no place.

    Example:
        >>> is_right(torch.tensor([5, 6, -1]), torch.tensor([[0], [0], [0]]), tolerance=5).tolist()
        [True, False, False]
    """
    tolerance = min(tolerance, LARGEST)  # what int64 cannot hold would compare wrong
    near = (index[:, None] - truth).abs() <= tolerance
    return (near & (truth >= 0) & (index >= 0)[:, None]).any(1)


def counted(index: Tensor, truth: GroundTruth, tolerance: int) -> Tensor:
    """Which queries a score counts, judged ones that do not report an ignored place: (Q,) -> (Q,) bool."""
    ignored = is_right(index, truth.ignored, 0)
    return truth.judged & (is_right(index, truth.positives, tolerance) | ~ignored)


def ground_truth_in_places(truth: GroundTruth, place_of: Callable[[Tensor], Tensor]) -> GroundTruth:
    """A ground truth in reference frames as one in places, by `PlaceMap.place_of`."""
    return truth._replace(positives=place_of(truth.positives), ignored=place_of(truth.ignored))


def check_ground_truth(truth: str, interpolate: bool = False) -> int | float | Path:
    """What a text says: an offset, a radius in metres, or a file that is there; refused before long work."""
    truth = str(truth)  # an offset may be a number, as of YAML
    path = Path(truth)
    suffix = path.suffix.lower()
    if interpolate and suffix != ".csv":
        raise InputError(f"truth {truth} cannot be interpolated; expected a .csv of query,place")
    if suffix in (".csv", ".json", ".npz"):
        check_regular(path, EXPECTED)
        return path
    offset = offset_of(truth)
    if offset is not None:
        return offset
    name, colon, radius = truth.partition(":")
    metres = as_number(radius) if colon else 25.0
    if name != "utm" or metres is None or metres < 0:
        raise InputError(f"truth {truth!r} is not known; expected {EXPECTED}")
    return metres


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
              right. A query listed without a place, or with -1, has no right answer; one that is not listed
              is left out of the scores;
            - a `.json` with a list for each query, in order, of all its right places; an empty one has none;
            - an `.npz` with the boolean matrices (reference frames, query frames) `GThard` and/or `GTsoft`,
              as in the visual place recognition tutorial of Schubert et al. What is in GThard is right (in
              GTsoft, if that is the only one); what is in GTsoft only counts neither way;
            - `utm:25`: every reference frame within 25 metres (inclusive; `utm` alone means 25) by the UTM
              coordinates in the names of both traverses' images, `@easting@northing@...@.jpg`;
            - None: the positions that both traverses carry; else frame i is place i where they say so, see
              `say_aligned`, are equally long and nothing is resampled; else there is no ground truth.
        reference, query: the sources, not resampled, or None.
        frames: how many frames the reference has, None where unknown.
        queries: how many, or (Q,) int64 the frame of each query in its source.
        interpolate: a query between two that the .csv lists gets the place between theirs, rounded.
        resampled: queries and places are resampled by distance: a query frame that is listed but shown by no
            query then counts for the nearest one that is shown and not listed.
        aligned: frame i is place i of any two traverses that are equally long.

    Convention 11: a ground truth counts frames of the sources, whether or not they are resampled; see
        `ground_truth_in_places`. The tolerance of the scores applies on top, inclusive.

    Raises:
        InputError: a ground truth that cannot be read or does not fit, or by which no query has a right
            answer.

    Example:
        >>> find_ground_truth("-1", None, None, frames=3, queries=3).positives.tolist()
        [[-1], [0], [1]]
    """
    numbers, every = (torch.arange(queries), True) if isinstance(queries, int) else (queries, False)
    if truth is None:
        if reference is None or query is None:
            return None
        if reference.place is not None and query.place is not None:
            position = query.place[_below(numbers, len(query.place))]
            return as_ground_truth(position_truth(reference.place, position))
        count = len(numbers) if every else query.length
        alike = not resampled and count is not None and count == frames
        if alike and (aligned or say_aligned(reference, query, count or 0)):
            return as_ground_truth(offset_truth(numbers, frames))
        return None
    said = check_ground_truth(truth, interpolate)
    if isinstance(said, int):
        found = as_ground_truth(offset_truth(numbers, frames, said))
    elif isinstance(said, float):
        if reference is None or query is None:
            raise InputError(f"truth utm:{said:g} lies in the names of images; expected both traverses")
        coordinates = utm_coordinates(query)
        coordinates = coordinates[_below(numbers, len(coordinates))]
        found = as_ground_truth(near_truth(utm_coordinates(reference), coordinates, said))
    elif said.suffix.lower() in (".csv", ".json"):
        length = query.length if query is not None and resampled else None
        if said.suffix.lower() == ".csv":
            places = _listed(said, frames, interpolate)
        else:
            places = _listed_in_json(said, frames, len(numbers) if every else length, int(numbers.max()) + 1)
        found = _read_table(said, places, numbers, length, interpolate, resampled)
    else:
        found = _read_matrices(said, numbers, frames, every)
    if (found.positives >= 0).any():
        return found
    if not isinstance(said, int):
        raise InputError(f"no query has a right answer: {describe_ground_truth(truth)}")
    last = "" if frames is None else f" to {frames - 1 - int(numbers.min())}"
    expected = f"an offset from {-int(numbers.max())}{last}"
    raise InputError(f"no query has a right answer with truth {said}; expected {expected}")


def _below(numbers: Tensor, count: int) -> Tensor:
    last = int(numbers.max())
    if last >= count:
        raise InputError(f"there is a query {last}; expected numbers below {count}")
    return numbers


def say_aligned(reference: Traverse, query: Traverse, frames: int) -> bool:
    """Whether two traverses of so many frames say themselves that frame i of both shows the same place.

    They do if both were cut alike, each out of a long image, or if their frames have the same names, all
    different. Times, as of the frames of a video, are no such names: any two recordings share them.
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
    """What `find_ground_truth` takes for the truth, in words; `positions`: both traverses carry them."""
    if truth is None:
        carried = "the positions that both traverses carry"
        return carried if positions else "place = query, as the sources say themselves"
    said = check_ground_truth(truth)
    if isinstance(said, int):
        return "place = query" + (f" {'-' if said < 0 else '+'} {abs(said)}" if said else "")
    if isinstance(said, float):
        return f"within {said:g} m by the coordinates in image names"
    return f"{truth}, interpolated" if interpolate else truth


def offset_of(truth: str | None, positions: bool = False) -> int | None:
    """The offset of a ground truth place = query + offset, as of `describe_ground_truth`; None for others."""
    if truth is None:
        return None if positions else 0
    try:
        offset = int(truth)
    except ValueError:
        return None
    return offset if abs(offset) < LARGEST else None


def utm_coordinates(traverse: Traverse) -> Tensor:
    """Easting and northing in the names of a traverse's images, metres: (N,2) float64."""
    names = [traverse.frame_name(i) for i in range(traverse.length or 0)]
    if not any(names):
        raise InputError(
            f"{traverse.name} has no image names; expected them for truth utm, as of folders of images"
        )
    rows = [[as_number(part) for part in name.split("@")[1:3]] for name in names]
    for name, row in zip(names, rows, strict=True):
        if len(row) != 2 or None in row:
            seen = f"{traverse.name}: {name} has no UTM coordinates"
            raise InputError(f"{seen}; expected @easting@northing@...@.jpg")
    return torch.tensor(rows, dtype=torch.float64)


def _read_table(
    path: Path,
    places: dict[int, list[float]],
    numbers: Tensor,
    length: int | None,
    interpolate: bool,
    resampled: bool,
) -> GroundTruth:
    """The places that a file lists for queries; `length`: of a query traverse that is resampled."""
    first, last = min(places), max(places)
    queries = numbers.tolist()
    if interpolate:
        knots = sorted(places)
        between = np.interp(numbers.numpy(), knots, [places[query][0] for query in knots]).tolist()
        places = {query: [at] for query, at in zip(queries, between, strict=True) if first <= query <= last}
    elif length is not None and last >= length:
        raise InputError(f"{path} lists query {last}; expected frames from 0 to {length - 1}")
    elif resampled:
        places = _at_shown(places, numbers)
    judged = torch.tensor([query in places for query in queries])
    if not judged.any():
        wanted = f"{int(numbers.min())} to {int(numbers.max())}"
        raise InputError(f"{path} lists queries from {first} to {last}; expected some of {wanted}")
    rows = [[_rounded(place) for place in places.get(query, ())] for query in queries]
    found = padded(torch.tensor(row, dtype=torch.int64) for row in rows)
    return as_ground_truth(found)._replace(judged=judged)


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
    rows = read_rows(path, "lines of query,place")
    if rows and all(as_number(cell) is None for cell in rows[0][1] if cell):
        number, names = rows.pop(0)
        # another column, such as a distance, would count as a right place
        if names[0].lower() != "query" or not all(re.match("place|$", name.lower()) for name in names[1:]):
            seen = f"{path}, line {number}: columns {','.join(names)}"
            raise InputError(f"{seen}; expected query,place[,place...]")
    end = LARGEST if frames is None else frames
    listed: dict[int, list[float]] = {}
    for line, cells in rows:
        while not cells[-1]:
            del cells[-1]
        numbers = [value for value in map(as_number, cells) if value is not None]
        query, places = (numbers or [-1.0])[0], [place for place in numbers[1:] if place != -1]
        outside = [place for place in places if place < 0 or _rounded(place) >= end]
        between = [place for place in places if place % 1 and not interpolate]
        wrong = ""
        if len(numbers) < len(cells):
            odd = next(cell for cell in cells if as_number(cell) is None)
            wrong = f"{odd!r} is no frame number; expected query,place"
        elif query < 0 or query % 1:
            wrong = f"query {cells[0]}; expected a whole number of at least 0"
        elif query in listed:
            wrong = f"query {cells[0]} is listed twice; expected each once"
        elif outside:
            last = "" if frames is None else f" to {frames - 1}"
            wrong = f"place {outside[0]:.12g}; expected a frame of the reference from 0{last}, or -1 for none"
        elif between:
            wrong = f"place {between[0]:.12g}; expected a whole number, or interpolation"
        elif interpolate and len(places) != 1:
            wrong = f"{len(places)} places; expected one in each line to interpolate"
        if wrong:
            raise InputError(f"{path}, line {line}: {wrong}")
        listed[int(query)] = places
    if not listed:
        raise InputError(f"{path} lists no query; expected lines of query,place")
    return listed


def _listed_in_json(path: Path, frames: int | None, count: int | None, least: int) -> dict[int, list[float]]:
    """The places of each query in a list of lists.

    Args:
        count, least: how many queries there are, None where unknown, and there are so many at least.
    """
    expected = "a list of whole numbers, its right places, for each query"
    with reading(path, "is no JSON", expected):
        rows = json.loads(read_text(path, expected))
    if not isinstance(rows, list) or len(rows) < least or count not in (None, len(rows)):
        seen = f"a list of {len(rows)}" if isinstance(rows, list) else f"a {type(rows).__name__}"
        queries = f"{least} queries or more" if count is None else f"{count} queries"
        raise InputError(f"{path} holds {seen}; expected {expected}, {queries}")
    end = LARGEST if frames is None else frames
    for query, row in enumerate(rows):
        listed = isinstance(row, list)
        wrong = [one for one in (row if listed else [row]) if type(one) is not int or not 0 <= one < end]
        if wrong or not listed:
            last = "" if frames is None else f" to {frames - 1}"
            seen = f"{path}, query {query}: {json.dumps(wrong[0] if listed else row)[:40]}"
            raise InputError(f"{seen}; expected a list of frames of the reference from 0{last}")
    return dict(enumerate(rows))


def _rounded(place: float) -> int:
    return math.floor(place) + (place % 1 >= 0.5)  # a half added to a large number is lost


def _read_matrices(path: Path, numbers: Tensor, frames: int | None, every: bool) -> GroundTruth:
    """An npz of the matrices (reference frames, query frames) GThard and/or GTsoft."""
    expected = "boolean matrices GThard and/or GTsoft"
    matrices: list[np.ndarray] = []
    with reading(path, "is no whole .npz file of arrays", expected), zipfile.ZipFile(path) as archive:
        there = [name.removesuffix(".npy") for name in archive.namelist()]
        for name in ("GThard", "GTsoft"):
            if name not in there:
                continue
            entry = archive.getinfo(f"{name}.npy")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("another compression than numpy's")  # a few bytes of it can be endless
            check_room(2.0 * entry.file_size, f"{path}: {name}")
            with archive.open(entry) as file:  # no more than it says, whatever it unpacks to
                matrix = np.lib.format.read_array(file, allow_pickle=False)
                if file.read(1):
                    raise ValueError(f"{name} is longer than its shape says")
            _check_shape(f"{path}: {name} is {matrix.shape} {matrix.dtype}", matrix, numbers, frames, every)
            check_room(16.0 * matrix.size, f"{path}: {name} {matrix.shape}")
            matrices.append(matrix)
    if not matrices:
        raise InputError(f"{path} holds {', '.join(there) or 'nothing'}; expected {expected}")
    if len({matrix.shape for matrix in matrices}) > 1:
        raise InputError(f"{path}: GThard and GTsoft differ in shape; expected the same")
    if not all(np.isfinite(matrix).all() for matrix in matrices):
        raise InputError(f"{path} holds numbers that are not finite; expected {expected}")
    hard, *soft = (torch.from_numpy(matrix[:, numbers.numpy()] != 0).T for matrix in matrices)
    found = as_ground_truth(padded(row.nonzero()[:, 0] for row in hard))
    return found._replace(ignored=padded(row.nonzero()[:, 0] for row in soft[0] & ~hard)) if soft else found


def _check_shape(seen: str, matrix: np.ndarray, numbers: Tensor, frames: int | None, every: bool) -> None:
    """Refuse what is no matrix (reference frames, query frames), and say if it is transposed."""
    count = int(numbers.max()) + 1

    def fits(rows: int, columns: int) -> bool:
        # queries that are given by number may be some of those in the matrix
        return frames in (None, rows) and (columns == count or (columns > count and not every))

    plain = matrix.ndim == 2 and matrix.dtype.kind in "biuf"
    # as many rows as queries speak for a transposed matrix if the reference is not known
    turned = plain and frames is None and matrix.shape[1] != count == matrix.shape[0]
    if not plain or turned or not fits(*matrix.shape):
        rows = "reference frames" if frames is None else frames
        wanted = f"expected a matrix of ({rows}, {count}), a column a query frame"
        hint = "; transposed it fits" if plain and fits(*matrix.shape[::-1]) else ""
        raise InputError(f"{seen}; {wanted}{hint}")
