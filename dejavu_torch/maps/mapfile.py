"""One safetensors file for a map: tensors, JSON that says what they are, and checksums of both.

No pickle, no code.
"""

from __future__ import annotations

import json
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from dejavu_torch.data.files import check_regular
from dejavu_torch.data.output import whole_file
from dejavu_torch.types import InputError

FORMAT = 9
SEALED = 7  # the first with checksums; before it the version stood by itself
NAME = "dejavu_torch-map"
ZIP = b"PK\x03\x04"  # what an archive begins with
EXPECTED = "a map file, as DejaVu.save writes"
HEADER = "header"  # the part that is no tensor


class Contents(NamedTuple):
    """tensors: by name, the part that each belongs to ahead of the first dot. header: JSON values."""

    tensors: dict[str, Tensor]
    header: dict[str, Any]


def seal(tensors: dict[str, Tensor], header: dict[str, Any]) -> dict[str, str]:
    """The file's metadata: version, header and a checksum of each part, as JSON.

    It is one entry, since safetensors writes several in no fixed order.
    """
    sums = checksums(tensors, header)
    text = json.dumps({"version": FORMAT, "checksums": sums, HEADER: header}, allow_nan=False)
    return {NAME: text}


def checksums(tensors: dict[str, Tensor], header: dict[str, Any]) -> dict[str, str]:
    """A digest of each part of a map file: of all names, types, shapes and bytes, and of all JSON values."""
    sums = {HEADER: blake2b(json.dumps(header).encode(), digest_size=8)}
    for name, tensor in sorted(tensors.items()):
        part = sums.setdefault(name.partition(".")[0], blake2b(digest_size=8))
        part.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        part.update(tensor.cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
    return {part: digest.hexdigest() for part, digest in sums.items()}


def digests(**values: Any) -> dict[str, str]:
    """A digest of each of these JSON values."""
    return {name: checksums({}, {name: value})[HEADER] for name, value in values.items()}


def map_size(tensors: dict[str, Tensor], header: dict[str, Any]) -> int:
    """Bytes of the file that `write_map` writes."""
    plain = _plain(tensors)
    return len(safetensors.torch.save(plain, seal(plain, header)))


def write_map(path: Path, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    """Write the file whole or not at all; the same tensors and header give the same bytes.

    Raises:
        InputError: the file cannot be written.
    """
    plain = _plain(tensors)
    with whole_file(path) as temporary:
        try:
            safetensors.torch.save_file(plain, temporary, seal(plain, header))
        except SafetensorError as error:
            raise InputError(f"{path} was not written: {error}") from error


def _plain(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """As safetensors takes them: whole, and none in another's memory."""
    plain: dict[str, Tensor] = {}
    taken: set[int] = set()
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        memory = tensor.untyped_storage()
        if memory.data_ptr() in taken or memory.nbytes() != tensor.nbytes:
            tensor = tensor.clone()
        taken.add(tensor.untyped_storage().data_ptr())
        plain[name] = tensor
    return plain


def read_map(path: Path) -> Contents:
    """Tensors and header of a map file, as they were written.

    Raises:
        InputError: missing, truncated, foreign, damaged, or of another format.
    """
    check_regular(path, EXPECTED)
    try:
        with path.open("rb") as file:
            if file.read(len(ZIP)) == ZIP:
                raise InputError(
                    f"{path} is a checkpoint or another archive; expected a map, as `dejavu train export` "
                    "makes of a checkpoint"
                )
        with safe_open(path, framework="pt") as archive:
            metadata = archive.metadata() or {}
            if NAME not in metadata and metadata.get("format") != NAME:
                raise InputError(f"{path} is no map of dejavu_torch; expected {EXPECTED}")
            sealed: dict[str, Any] = (
                _json(metadata[NAME]) if NAME in metadata else {"version": int(metadata["version"])}
            )
            _check_version(path, sealed["version"], NAME in metadata)
            tensors = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118
        header, seen = sealed[HEADER], checksums(tensors, sealed[HEADER])
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is truncated or no map file ({error}); expected a whole one") from error
    sums = sealed.get("checksums")
    if seen != sums:
        known = sums if isinstance(sums, dict) else {}
        damaged = sorted(part for part in {*seen, *known} if seen.get(part) != known.get(part))
        raise InputError(
            f"{path} is damaged: its {' and '.join(damaged)}; expected the file as it was written"
        )
    return Contents(tensors, header)


def _json(text: str) -> dict[str, Any]:
    value = json.loads(text, parse_constant=_no_number)
    if not isinstance(value, dict) or not isinstance(value.get(HEADER), dict):
        raise ValueError("the header is no mapping")
    return value


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


def _check_version(path: Path, version: object, sealed: bool) -> None:
    if type(version) is not int or (sealed and version < SEALED):
        raise ValueError(f"its version is {version!r:.40}")
    if version != FORMAT:
        newer = "a newer dejavu_torch is needed" if version > FORMAT else "learn the route again"
        raise InputError(f"{path} has map format {version}; this version reads {FORMAT}: {newer}")
