"""The samples of a coarse search, kept in a file: they are slower to compute than to read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from dejavu_torch.data.files import why
from dejavu_torch.data.output import check_output_file
from dejavu_torch.maps.file import HEADER, SHOWN, checksums, read_map, write_map
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.coarse import MIN_PLACES, CoarseSearch, Plan, plan
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.types import InputError

FORMAT = 1  # increase when the same map and plan give other samples


def check_searches(path: Any, matching: Matching, elsewhere: bool) -> None:
    """Refuse a file of samples if the queries are matched without samples.

    Args:
        elsewhere: something else, such as a cluster, finds the places.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"search_file is {path!r:.{SHOWN}}; expected the path of a file")
    single, every = matching.sequence is None, getattr(matching.sequence, "search_every", 0)
    all_places = f"a {'filter' if every else 'sequence'} scores all places of every query"
    others = "a filter with search_every above 1, or single queries (--sequence 1)"
    for refused, seen, expected in (
        (not single and every <= 1, all_places, others),
        (single and matching.callback, "scores of all places are kept", "none kept (no --page)"),
        (elsewhere, "places are found elsewhere, such as by a cluster", "only one of the two"),
        (matching.search == "scan", "search scan scores all places", "search auto, coarse or exact"),
    ):
        if refused:
            raise InputError(f"search_file {path}: {seen}; expected {expected}")


def kept_search(path: Path, route: PlaceMap, limit: int | None = None, exact: bool = False) -> CoarseSearch:
    """As `coarse_search`, with samples read from a file, or written to it if it does not exist.

    Args:
        limit, exact: see `plan`.

    Raises:
        InputError: the map has to be scanned; the file is damaged, not a file of samples, or of another map
            or plan; or it cannot be written.
    """
    if not isinstance(route, SpectralMap):
        raise InputError(f"search_file {path}: the map is a {type(route).__name__}; expected a SpectralMap")
    chosen = plan(route, limit, exact)
    if chosen is None:
        seen = f"metric {route.metric}, {route.places} places, chunks: {len(route.chunks)}"
        expected = f"cosine, at least {MIN_PLACES} that change smoothly, several chunks or more search_memory"
        raise InputError(f"search_file {path}: the map is scanned, {seen}; expected {expected}")
    if os.path.exists(path):  # False for an invalid path, which is refused below
        return read_samples(path, route, chosen)
    check_output_file(path)
    search = CoarseSearch(route, chosen)
    write_map(path, search.tensors, key_of(route, chosen))
    return search


def read_samples(path: Path, route: SpectralMap, chosen: Plan) -> CoarseSearch:
    """The search from a file of samples, which stays memory-mapped on a CPU; see `kept_search`."""
    key = key_of(route, chosen)
    try:
        tensors, header = read_map(path)
        if not isinstance(header, dict) or header.keys() != key.keys():
            raise InputError("is a map or another file of this package")
    except InputError as error:
        reason = why(error).removeprefix(f"{path} ").partition(";")[0]  # the rest is about maps
        seen = f"{path} is not a complete file of search samples: it {reason}"
        raise InputError(f"{seen}; expected one, or no file there") from error
    other = [name for name in key if header[name] != key[name]]
    if other:
        seen, expected = (
            ", ".join(f"{name} {str(values[name])[:SHOWN]}" for name in other) for values in (header, key)
        )
        raise InputError(f"{path} has samples of {seen}; expected {expected}: remove it, or name another")
    try:
        search = CoarseSearch(route, chosen, tensors)
        if search.tensors.keys() != tensors.keys():
            seen, expected = (", ".join(sorted(names)) or "nothing" for names in (tensors, search.tensors))
            raise InputError(f"samples are {seen}; expected {expected}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return search


def key_of(route: SpectralMap, chosen: Plan) -> dict[str, Any]:
    """Identifies samples, as JSON values: a digest of the map, and the places from one sample to the next."""
    sums = checksums({f"map.{name}": one for name, one in route.packed().items()}, route.get_extra_state())
    spacings = {"coarse spacing": chosen.coarse, "fine spacing": chosen.fine}
    return {"format": FORMAT, "map": sums["map"] + sums[HEADER], **spacings}
