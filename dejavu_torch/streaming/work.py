"""Finished chunks of a route that is being learned, in a folder, so that a kill loses little."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor

from dejavu_torch.data.output import PREFIX, make_output_folder, remove_empty_folders, whole_file
from dejavu_torch.maps.codec import Stream
from dejavu_torch.maps.file import read_map, write_map
from dejavu_torch.maps.spectral import CodedChunk
from dejavu_torch.streaming.coder import ChunkCoder, Made, code_here
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

KEY, FIT = "run.json", "fit.safetensors"


class Fit(NamedTuple):
    """What is learned from the sample of a route, besides the whitening.

    mean, step: of its chunks. needed: see `SpectralMap`.
    """

    mean: Tensor
    step: float
    needed: float | None


class WorkFolder:
    """What is finished of one run: the fit of its sample, and the coded chunks of shards.

    Args:
        path: the folder, made when it is opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.opened = False

    def open(self, key: Mapping[str, str]) -> None:
        """Go on with the run of a key, or begin it where nothing of any run is finished.

        Args:
            key: digests of all that the chunks are made of, by what it is.

        Raises:
            InputError: something is finished of a run with another key, or the folder cannot be made.
        """
        if not self._names() - {KEY}:
            make_output_folder(self.path)
            try:
                with whole_file(self.path / KEY) as file:
                    file.write_text(json.dumps(key))
            except BaseException:  # as on a full disk
                remove_empty_folders(self.path)
                raise
        else:
            try:
                known = json.loads((self.path / KEY).read_text())
            except (OSError, ValueError) as error:
                seen = f"{self.path} is no folder of finished chunks"
                raise InputError(f"{seen}; expected none to be there") from error
            known = known if isinstance(known, dict) else {}
            if known != key:
                other = [name for name in {**key, **known} if key.get(name) != known.get(name)]
                self._refuse(f": its {', '.join(other)} {'differs' if len(other) == 1 else 'differ'}")
        self.opened = True

    def check_unused(self) -> None:
        """Refuse a run that keeps no chunks where something is finished of one that does.

        Raises:
            InputError: as `open`.
        """
        names = self._names()
        if KEY in names and len(names) > 1:
            self._refuse()

    def remove(self) -> None:
        """Remove the folder, if this run opened it."""
        if self.opened:
            shutil.rmtree(self.path, ignore_errors=True)

    def _names(self) -> set[str]:
        """The files in the folder, but for what a kill left half written."""
        files = self.path.iterdir() if self.path.is_dir() else ()
        return {file.name for file in files if not file.name.startswith(PREFIX)}

    def _refuse(self, why: str = "") -> NoReturn:
        seen = f"{self.path} has finished chunks of another run{why}"
        raise InputError(f"{seen}; expected the command that began it, or the folder removed")

    def fit(self) -> tuple[Fit, dict[str, Tensor]] | None:
        """The fit, and the whitening's state, if they are there."""
        read = self._read(FIT)
        if read is None:
            return None
        tensors, header = read
        fit = Fit(tensors.pop("fit.mean"), header["step"], header["needed"])
        return fit, {name.removeprefix("whitening."): tensor for name, tensor in tensors.items()}

    def keep_fit(self, fit: Fit, whitening: Mapping[str, Tensor]) -> None:
        """Write the fit."""
        tensors = {f"whitening.{name}": tensor for name, tensor in whitening.items()} | {"fit.mean": fit.mean}
        write_map(self.path / FIT, tensors, {"step": fit.step, "needed": fit.needed})

    def finished(self, shard: range, state: str) -> list[CodedChunk] | None:
        """The chunks of a shard, None if they are not there, or of frames in another state."""
        read = self._read(_name(shard))
        if read is None or read[1]["state"] != state:
            return None
        tensors, header = read
        places, sizes, sums, marks = tensors["shard.table"].unbind(1)
        streams = tensors["shard.streams"].split(sizes.tolist())
        escapes = tensors["shard.escapes"].split(marks.tolist())
        return [
            CodedChunk(count, header["step"], Stream(stream, checksum), large)
            for count, stream, checksum, large in zip(
                places.tolist(), streams, sums.tolist(), escapes, strict=True
            )
        ]

    def keep(self, shard: range, state: str, chunks: list[CodedChunk]) -> None:
        """Write the chunks of a shard, made of frames in that state.

        Raises:
            InputError: the system refuses it; what was there before stays.
        """
        table = [(one.places, len(one.stream.bytes), one.stream.checksum, len(one.escapes)) for one in chunks]
        tensors = {
            "shard.table": torch.tensor(table),
            "shard.streams": torch.cat([one.stream.bytes for one in chunks]),
            "shard.escapes": torch.cat([one.escapes for one in chunks]),
        }
        write_map(self.path / _name(shard), tensors, {"step": chunks[0].step, "state": state})

    def _read(self, name: str) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        if not (self.path / name).exists():
            return None
        try:
            return read_map(self.path / name)
        except InputError as error:
            log.warning("%s: it is made again", error)
            return None


def all_chunks(
    coder: ChunkCoder,
    traverse: Traverse,
    folder: WorkFolder | None = None,
    make: Callable[..., Made] = code_here,
    progress: str | None = None,
) -> list[CodedChunk]:
    """The chunks of a route: those that a folder has, and the others, made and kept there.

    Args:
        make: as `code_here`.

    Raises:
        InputError: frames that cannot be read, or a full disk; what is finished is kept.
    """
    shards, states = coder.shards(), {}
    made: dict[range, list[CodedChunk]] = {}
    for shard in shards if folder is not None else ():
        assert folder is not None
        states[shard] = traverse.state(*coder.span(shard))
        found = folder.finished(shard, states[shard])
        if found is not None:
            made[shard] = found
    missing = [one for one in shards if one not in made]
    if not missing:
        return [one for shard in shards for one in made[shard]]
    try:
        with closing(make(coder, traverse, missing, progress)) as parts:
            for shard, chunks in parts:
                if folder is not None:
                    folder.keep(shard, states[shard], chunks)
                made[shard] = chunks
    except InputError as error:
        kept = sum(one.places for chunks in made.values() for one in chunks)
        if folder is None or not kept:
            raise
        told = f"{kept} of {coder.frames} places are kept in {folder.path} for the next run"
        raise InputError(f"{error}; {told}") from error
    return [one for shard in shards for one in made[shard]]


def work_folder_of(path: Path) -> Path:
    """The work folder of a map file, beside it."""
    return path.with_name(f"{path.name}.work")


def _name(shard: range) -> str:
    return f"chunks-{shard.start:07}.safetensors"
