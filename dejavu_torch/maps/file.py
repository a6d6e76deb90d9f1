"""A map file: a safetensors archive of tensors, a JSON header, and digests of both. No pickle, no code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from dejavu_torch.data.files import check_regular
from dejavu_torch.data.output import whole_file
from dejavu_torch.types import Facts, InputError, expect

FORMAT = 11
NAME = "dejavu_torch-map"
ZIP = b"PK\x03\x04"  # the first bytes of a checkpoint
EXPECTED = "a map file, as DejaVu.save writes"
HEADER = "header"  # key of the header and of its digest
DIGEST = 8  # bytes


def checksums(tensors: Mapping[str, Tensor], header: object) -> dict[str, str]:
    """A digest of the header, and of each part's names, types, shapes and bytes."""
    sums = {HEADER: blake2b(json.dumps(header).encode(), digest_size=DIGEST)}
    for name, tensor in sorted(tensors.items()):
        part = sums.setdefault(name.partition(".")[0], blake2b(digest_size=DIGEST))
        part.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        part.update(tensor.cpu().contiguous().view(-1).view(torch.uint8).numpy().data)
    return {part: digest.hexdigest() for part, digest in sums.items()}


def digests(**values: object) -> dict[str, str]:
    """A digest of each of these JSON values."""
    return {name: checksums({}, {name: value})[HEADER] for name, value in values.items()}


def map_size(tensors: Mapping[str, Tensor], header: Facts) -> int:
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


def write_map(path: Path, tensors: Mapping[str, Tensor], header: Facts) -> None:
    """Write the file completely or, with an InputError, not at all; equal contents give equal bytes. Names of
    tensors begin with a part of the model and a dot; the header is JSON."""
    with whole_file(path) as temporary:
        try:
            layout = torch.contiguous_format  # with memory of its own, as safetensors needs
            plain = {name: t.detach().cpu().clone(memory_format=layout) for name, t in tensors.items()}
            safetensors.torch.save_file(plain, temporary, _metadata(checksums(plain, header), header))
        except (SafetensorError, ValueError) as error:
            raise InputError(f"{path} was not written: {error}") from error


def _metadata(sums: dict[str, str], header: Facts) -> dict[str, str]:
    """The metadata of the archive: one entry, for a fixed order."""
    try:
        return {NAME: json.dumps({"version": FORMAT, "checksums": sums, HEADER: header}, allow_nan=False)}
    except ValueError as error:
        raise InputError(f"the model cannot be written: {error}; expected finite numbers") from error


def read_map(path: Path) -> tuple[dict[str, Tensor], Facts]:
    """What `write_map` wrote; an InputError if it is missing, truncated, damaged or not of this format."""
    check_regular(path, EXPECTED)
    try:
        with path.open("rb") as file:
            cure = "or `dejavu train export` of the checkpoint"
            expect(file.read(len(ZIP)) != ZIP, f"{EXPECTED}, {cure}", f"{path} is a checkpoint or archive")
        with safe_open(path, framework="pt") as archive:
            metadata = archive.metadata() or {}
            expect(NAME in metadata, EXPECTED, f"{path} is not a map of dejavu_torch")
            sealed = json.loads(metadata[NAME])
            if (version := sealed["version"]) != FORMAT:
                seen = f"{path} has map format {version!r:.40}, of another dejavu_torch"
                raise InputError(f"{seen}; expected {FORMAT}")
            tensors = {name: archive.get_tensor(name) for name in archive.keys()}  # noqa: SIM118
        header, sums = sealed[HEADER], sealed["checksums"]
        computed = checksums(tensors, header)
        damaged = sorted(part for part in {*computed, *sums} if computed.get(part) != sums.get(part))
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{path} is truncated or not a map file ({error}); expected a whole one") from error
    expect(not damaged, "it as it was written", f"{path} is damaged: its {' and '.join(damaged)}")
    return tensors, header


def part_of(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    """The tensors of one part of a file, without the part in their names."""
    prefix = f"{part}."
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
