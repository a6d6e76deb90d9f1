"""Frames to coded chunks, one chunk at a time: the same bytes wherever and however they are made."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.data.selection import Selection
from dejavu_torch.features.extract import feature_batches
from dejavu_torch.features.views import Views
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.spectral import CodedChunk, code_chunk
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.types import InputError, Traverse

SHARD = 1024  # places at least, of the chunks that are made, kept and lost together


class ChunkCoder(NamedTuple):
    """All that makes coded chunks of frames, once whitening, mean and step are known.

    pipeline: makes features of frames. whitening: makes descriptors of these, if not None.
    batch_size: frames at a time. frames: N, of the route. chunk: places of a chunk.
    mean, step, transform, resolution: as of `code_chunk`.
    visits: frames of another traverse, averaged with those of the places that they show, if not None. It is
        read a chunk's frames at a time, so that it has to be one that `seeks`.

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
    visits: Views | None = None

    @torch.no_grad()
    def chunks(self, traverse: Traverse, wanted: range, progress: str | None = None) -> Iterator[CodedChunk]:
        """The chunks of these numbers, one behind the other, holding no more than one.

        Args:
            progress: see `feature_batches`.

        Raises:
            InputError: frames that cannot be read, or as of `feature_batches` and `code_chunk`.
        """
        part = _Aligned(traverse, *self.span(wanted), self.chunk)
        device = self.mean.device
        held: list[Tensor] = []
        left = part.length
        for features in feature_batches(part, self.pipeline, self.batch_size, device, progress):
            held.append(self._whitened(features))
            left -= len(features)
            if (part.length - left) % self.chunk == 0 or not left:
                rows = torch.cat(held)
                rows = self._averaged(rows, part.start + part.length - left - len(rows))
                yield code_chunk(rows, self.mean, self.step, self.transform, self.resolution)
                held = []
        if left:
            seen = f"{traverse.name} ended at frame {part.start + part.length - left}"
            raise InputError(f"{seen}; expected {self.frames} frames, as it had before")

    def _whitened(self, features: Tensor) -> Tensor:
        return features if self.whitening is None else self.whitening(features)

    def _averaged(self, rows: Tensor, start: int) -> Tensor:
        """Descriptors (n,K) of the places from `start` on, averaged with those of the visits."""
        if self.visits is None:
            return rows
        traverse, places = self.visits.traverse, self.visits.places.cpu() - start
        frames = ((places >= 0) & (places < len(rows))).nonzero()[:, 0]
        if not len(frames):
            return rows
        some = Selection(traverse, frames)
        batches = feature_batches(some, self.pipeline, self.batch_size, self.mean.device)
        seen = torch.cat([self._whitened(features) for features in batches])
        if len(seen) != len(frames):
            told = f"{traverse.name} has fewer than the {int(frames[-1]) + 1} frames"
            raise InputError(f"{told} that it is to show places with; expected these")
        return with_visits(rows, torch.ones(len(rows)), seen, places[frames])

    def span(self, chunks: range) -> tuple[int, int]:
        """The frames [start, stop) of chunks."""
        return chunks.start * self.chunk, min(chunks.stop * self.chunk, self.frames)

    def shards(self) -> list[range]:
        """The numbers of all chunks, those that are made together in one range."""
        together, count = -(-SHARD // self.chunk), -(-self.frames // self.chunk)
        return [range(first, min(first + together, count)) for first in range(0, count, together)]


def with_visits(means: Tensor, counts: Tensor, rows: Tensor, places: Tensor) -> Tensor:
    """Means (N,K) of so many visits (N,) each, and of further ones (n,K) to places (n,) as well."""
    before = counts.to(means)[:, None]
    more = places.bincount(minlength=len(means)).to(means)[:, None]
    sums = (means * before).index_add(0, places.to(means.device), rows.to(means))
    return torch.where(more > 0, sums / (before + more), means)


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
        span = range(self.start, self.start + self.length)
        # what cannot be read is then read with no chunk but its own
        step = self.chunk if self.traverse.seeks else self.length
        parts = (self.traverse.select(span[i : i + step], size) for i in range(0, self.length, step))
        for batch in chain.from_iterable(parts):
            while len(batch):
                part, batch = batch[:wanted], batch[wanted:]
                held.append(part)
                wanted -= len(part)
                done += len(part)
                if not wanted:
                    yield held[0] if len(held) == 1 else torch.cat(held)
                    held, wanted = [], min(size, self.chunk - done % self.chunk, self.length - done)
        if held:  # the traverse ended early
            yield torch.cat(held)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape


Made = Generator[tuple[range, list[CodedChunk]], None, None]


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
