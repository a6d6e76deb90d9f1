"""Frames to coded chunks, one chunk at a time: the same bytes wherever and however they are made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.database.spectral import CodedChunk, code_chunk
from dejavu_torch.database.spectrum import Transform
from dejavu_torch.features.extract import feature_batches
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.types import InputError, Traverse

SHARD = 1024  # places at least, of the chunks that are made, kept and lost together


class ChunkCoder(NamedTuple):
    """All that makes coded chunks of frames, once whitening, mean and step are known.

    pipeline: makes features of frames. whitening: makes descriptors of these, if not None.
    batch_size: frames at a time. frames: N, of the route. chunk: places of a chunk.
    mean, step, transform, resolution: as of `code_chunk`.

    Convention: batches begin where a chunk does, so that what is ahead of a chunk changes nothing in it.
        Matrix products round differently by the number of threads: work `in_one_thread`.
    """

    pipeline: nn.Module
    whitening: Whitening | None
    batch_size: int
    frames: int
    chunk: int
    mean: Tensor
    step: float
    transform: Transform
    resolution: float

    @torch.no_grad()
    def chunks(self, traverse: Traverse, wanted: range, progress: str | None = None) -> Iterator[CodedChunk]:
        """The chunks of these numbers, one behind the other, holding no more than one.

        Args:
            progress: see `feature_batches`.

        Raises:
            InputError: frames that cannot be read, or as of `feature_batches` and `code_chunk`.
        """
        part = _Aligned(
            traverse, wanted.start * self.chunk, min(wanted.stop * self.chunk, self.frames), self.chunk
        )
        device = self.mean.device
        held: list[Tensor] = []
        left = part.length
        for features in feature_batches(part, self.pipeline, self.batch_size, device, progress):
            held.append(features if self.whitening is None else self.whitening(features))
            left -= len(features)
            if (part.length - left) % self.chunk == 0 or not left:
                yield code_chunk(torch.cat(held), self.mean, self.step, self.transform, self.resolution)
                held = []
        if left:
            seen = f"{traverse.name} ended at frame {part.start + part.length - left}"
            raise InputError(f"{seen}; expected {self.frames} frames, as it had before")

    def shards(self) -> list[range]:
        """The numbers of all chunks, those that are made together in one range."""
        together, count = -(-SHARD // self.chunk), -(-self.frames // self.chunk)
        return [range(first, min(first + together, count)) for first in range(0, count, together)]


class _Aligned(Traverse):
    """The frames [start, stop) of a traverse, in batches none of which spans two chunks.

    Batches are as large as they may be, so that their borders do not hang on how the traverse is read.
    """

    length: int

    def __init__(self, traverse: Traverse, start: int, stop: int, chunk: int) -> None:
        self.traverse, self.name, self.start, self.chunk = traverse, traverse.name, start, chunk
        self.length = stop - start
        self.frame = getattr(traverse, "frame", range(stop))[start:stop]  # of the source, for messages

    def batches(self, size: int) -> Iterator[Tensor]:
        held: list[Tensor] = []
        done, wanted = 0, min(size, self.chunk, self.length)
        for batch in self.traverse.select(range(self.start, self.start + self.length), size):
            while len(batch):
                part, batch = batch[:wanted], batch[wanted:]
                held.append(part)
                wanted -= len(part)
                done += len(part)
                if not wanted:
                    yield held[0] if len(held) == 1 else torch.cat(held)
                    held, wanted = [], min(size, self.chunk - done % self.chunk, self.length - done)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape


Made = Iterator[tuple[range, list[CodedChunk]]]


def code_here(
    coder: ChunkCoder, traverse: Traverse, shards: Sequence[range], progress: str | None = None
) -> Made:
    """The chunks of shards, made in this process: each shard with its chunks, as they are finished."""
    with in_one_thread():
        for run in joined(shards):
            chunks = coder.chunks(traverse, range(run[0].start, run[-1].stop), progress)
            for shard in run:
                yield shard, list(islice(chunks, len(shard)))


def joined(shards: Sequence[range]) -> list[list[range]]:
    """Shards in runs that follow each other, so that a traverse that cannot seek is read once.

    Example:
        >>> joined([range(0, 2), range(2, 4), range(6, 8)])
        [[range(0, 2), range(2, 4)], [range(6, 8)]]
    """
    runs: list[list[range]] = []
    for shard in shards:
        if runs and runs[-1][-1].stop == shard.start:
            runs[-1].append(shard)
        else:
            runs.append([shard])
    return runs


@contextmanager
def in_one_thread() -> Iterator[None]:
    """In the block torch computes in one thread, so that the number of cores changes no bit of a product."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
