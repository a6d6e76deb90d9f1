"""The samples of a search, kept in a file beside the map: making them takes longer than reading them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from dejavu_torch.data.files import why
from dejavu_torch.data.output import check_output_file
from dejavu_torch.maps.file import HEADER, SHOWN, checksums, read_map, write_map
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.coarse import CoarseSearch, Plan, plan
from dejavu_torch.types import InputError

FORMAT = 1  # one more where samples of the same map and plan are others


def kept_search(
    path: Path, route: PlaceMap, limit: int | None = None, exact: bool = False
) -> CoarseSearch | None:
    """As `coarse_search`, by samples that are read from a file, or written there if there is none.

    Args:
        path: of the file. limit: bytes of the samples. exact: a sample of every place; see `plan`.

    Raises:
        InputError: the file is of another map or plan, damaged or no such file, or it cannot be written.
    """
    chosen = plan(route, limit, exact)
    if chosen is None or not isinstance(route, SpectralMap):
        return None
    if os.path.exists(path):  # False also of what can be no path, which is refused below
        return read_samples(path, route, chosen)
    check_output_file(path)
    search = CoarseSearch(route, chosen)
    write_map(path, search.made, key_of(route, chosen))
    return search


def read_samples(path: Path, route: SpectralMap, chosen: Plan) -> CoarseSearch:
    """The search whose samples a file holds, which stays mapped into memory on a CPU; see `kept_search`."""
    key = key_of(route, chosen)
    try:
        made, header = read_map(path)
        if not isinstance(header, dict) or header.keys() != key.keys():
            raise InputError("it is another file of this package")
    except InputError as error:
        reason = f" ({why(error.__cause__)})" if isinstance(error.__cause__, Exception) else ""
        seen = f"{path} is no whole file of a search's samples{reason}"
        raise InputError(f"{seen}; expected one, or none to be there") from error
    other = [name for name in key if header[name] != key[name]]
    if other:
        seen, expected = (
            ", ".join(f"{name} {str(one[name])[:SHOWN]}" for name in other) for one in (header, key)
        )
        raise InputError(f"{path} has samples of {seen}; expected {expected}: remove it, or name another")
    try:
        return CoarseSearch(route, chosen, made)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def key_of(route: SpectralMap, chosen: Plan) -> dict[str, Any]:
    """What samples are of, as JSON values: a digest of the map, and places from one sample to the next."""
    sums = checksums({f"map.{name}": one for name, one in route.packed().items()}, route.get_extra_state())
    spacings = {"coarse spacing": chosen.coarse, "fine spacing": chosen.fine}
    return {"format": FORMAT, "map": sums["map"] + sums[HEADER], **spacings}
