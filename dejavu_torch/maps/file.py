"""A map file: a safetensors archive of tensors, a JSON header, and digests of both. No pickle, no code."""

from __future__ import annotations

import json
import math
import types
from collections.abc import Mapping, Sequence
from contextlib import suppress
from hashlib import blake2b
from inspect import formatannotation
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from dejavu_torch.data.files import LARGEST, check_regular
from dejavu_torch.data.output import whole_file
from dejavu_torch.types import InputError

FORMAT = 11
NAME = "dejavu_torch-map"
ZIP = b"PK\x03\x04"  # the first bytes of a checkpoint
EXPECTED = "a map file, as DejaVu.save writes"
HEADER = "header"  # key of the header and of its digest
SHOWN = 60  # characters of a value in a message
DIGEST = 8  # bytes


def checksums(tensors: Mapping[str, Tensor], header: Any) -> dict[str, str]:
    """A digest of the header, and of each part's names, types, shapes and bytes."""
    sums = {HEADER: blake2b(json.dumps(header).encode(), digest_size=DIGEST)}
    for name, tensor in sorted(tensors.items()):
        part = sums.setdefault(name.partition(".")[0], blake2b(digest_size=DIGEST))
        part.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        part.update(tensor.cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
    return {part: digest.hexdigest() for part, digest in sums.items()}


def digests(**values: Any) -> dict[str, str]:
    """A digest of each of these JSON values."""
    return {name: checksums({}, {name: value})[HEADER] for name, value in values.items()}


def map_size(tensors: Mapping[str, Tensor], header: dict[str, Any]) -> int:
    """Bytes of the file that `write_map` writes, from names, types and shapes alone."""
    sums = dict.fromkeys((HEADER, *(name.partition(".")[0] for name in tensors)), "0" * 2 * DIGEST)
    empty = {name: torch.empty(0, dtype=tensor.dtype) for name, tensor in tensors.items()}
    # of tensors without data, so that safetensors gives the order
    entries, end = json.loads(safetensors.torch.save(empty, _metadata(sums, header))[8:]), 0
    for name, entry in entries.items():
        if name in tensors:
            begin, end = end, end + tensors[name].nbytes
            entry |= {"shape": tensors[name].shape, "data_offsets": (begin, end)}
    text = json.dumps(entries, separators=(",", ":"), ensure_ascii=False)
    return 8 + -(-len(text.encode()) // 8) * 8 + end


def write_map(path: Path, tensors: Mapping[str, Tensor], header: dict[str, Any]) -> None:
    """Write the file completely or, with an InputError, not at all; equal contents give equal bytes. Names of
    tensors begin with a part of the model and a dot; the header is JSON."""
    with whole_file(path) as temporary:
        try:
            layout = torch.contiguous_format  # with memory of its own, as safetensors needs
            plain = {name: t.detach().cpu().clone(memory_format=layout) for name, t in tensors.items()}
            safetensors.torch.save_file(plain, temporary, _metadata(checksums(plain, header), header))
        except (SafetensorError, ValueError) as error:
            raise InputError(f"{path} was not written: {error}") from error


def _metadata(sums: dict[str, str], header: dict[str, Any]) -> dict[str, str]:
    """The metadata of the archive: one entry, for a fixed order."""
    try:
        return {NAME: json.dumps({"version": FORMAT, "checksums": sums, HEADER: header}, allow_nan=False)}
    except ValueError as error:
        raise InputError(f"the model cannot be written: {error}; expected finite numbers") from error


def _finite(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ValueError(f"{text} is no finite number")
    return float(text)


def read_map(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `write_map` wrote; an InputError if it is missing, truncated, damaged or not of this format."""
    check_regular(path, EXPECTED)
    try:
        with path.open("rb") as file:
            if file.read(len(ZIP)) == ZIP:
                cure = "or `dejavu train export` of the checkpoint"
                raise InputError(f"{path} is a checkpoint or another archive; expected {EXPECTED}, {cure}")
        with safe_open(path, framework="pt") as archive:
            metadata = archive.metadata() or {}
            if NAME not in metadata:
                raise InputError(f"{path} is not a map of dejavu_torch; expected {EXPECTED}")
            sealed = json.loads(metadata[NAME], parse_constant=_finite, parse_float=_finite)
            if (version := sealed["version"]) != FORMAT:
                seen = f"{path} has map format {version!r:.40}, of another dejavu_torch"
                raise InputError(f"{seen}; expected {FORMAT}")
            tensors = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118
        header, sums = sealed[HEADER], dict(sealed["checksums"] or {})
        computed = checksums(tensors, header)
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is truncated or not a map file ({error}); expected a whole one") from error
    damaged = sorted(part for part in {*computed, *sums} if computed.get(part) != sums.get(part))
    if damaged:
        raise InputError(f"{path} is damaged: its {' and '.join(damaged)}; expected it as it was written")
    return tensors, header


def part_of(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """The tensors of one part of a file, without the part in their names."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def checked(value: Any, kind: Any, where: str) -> Any:
    """A JSON value if it has a type, else an InputError. Numbers must be finite, integers below 2^53.

    Args:
        kind: int, float, str, bool, None, Any, a Literal, a union, a sequence or mapping of these, or a
            NamedTuple, for a mapping with exactly its fields, but those with a default may lack; any other
            type means a mapping.
        where: name of the value in messages.

    Example:
        >>> checked("4", int | None, "block")
        Traceback (most recent call last):
        dejavu_torch.types.InputError: block is '4'; expected int | None
    """
    origin, inner = get_origin(kind) or kind, get_args(kind)
    if hasattr(kind, "_fields"):
        known = value if isinstance(value, dict) else {}
        default = {key: of for key, of in kind._field_defaults.items() if key not in known}
        hints = {key: hint for key, hint in get_type_hints(kind).items() if key not in default}
        return kind(**checked_fields(value, hints, where), **default)
    if origin in (Union, types.UnionType):
        for member in inner:
            with suppress(InputError):
                return checked(value, member, where)
    elif origin in (tuple, list, Sequence) and isinstance(value, list | tuple):
        kinds = inner if origin is tuple and ... not in inner else inner[:1] * len(value)
        if len(kinds) == len(value):
            items = [checked(value[i], kinds[i], f"{where}[{i}]") for i in range(len(value))]
            return items if origin is list else tuple(items)
    elif origin in (dict, Mapping) and isinstance(value, dict):
        return checked_fields(value, dict.fromkeys(value, inner[1] if inner else Any), where)
    elif _fits(value, origin, inner):
        return value
    limit = ", finite and below 2^53" if isinstance(value, int | float) else ""
    raise InputError(f"{where} is {repr(value)[:SHOWN]}; expected {formatannotation(kind)}{limit}")


def _fits(value: Any, origin: Any, inner: tuple[Any, ...]) -> bool:
    """Whether a value has a type other than a union, a sequence or a NamedTuple."""
    if type(value) in (int, float) and not abs(value) < (LARGEST if type(value) is int else math.inf):
        return False
    if origin is Literal:
        return any(type(value) is type(literal) and value == literal for literal in inner)
    if origin in (int, float, str, bool, None, type(None)):
        return type(value) in ((int, float) if origin is float else (origin or type(None),))
    return origin is Any or (isinstance(value, dict) and origin not in (tuple, list, Sequence))


def checked_fields(value: Any, kinds: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A mapping with exactly these keys, its values `checked` by these types."""
    if not isinstance(value, dict) or value.keys() != kinds.keys():
        seen = ", ".join(sorted(map(str, value))) if isinstance(value, dict) else repr(value)
        raise InputError(f"{where} holds {seen[:SHOWN] or 'nothing'}; expected {', '.join(kinds)}")
    return {name: checked(value[name], kind, f"{where}.{name}") for name, kind in kinds.items()}
