"""Frames as training wants them: all within reach, in batches of clips."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from kornia.geometry.transform import resize as antialiased_resize
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from dejavu_torch.features.memory import concatenate
from dejavu_torch.types import GroundTruth, InputError, Traverse

READ_AT_ONCE = 64


class Batch(NamedTuple):
    """frames: (B,C,H,W) or features (B,D). truth: their right places; rows of nothing known are -1."""

    frames: Tensor
    truth: GroundTruth


class StoredFrames(Dataset[Batch]):
    """Frames as bytes, which may lie in a temporary file (see `concatenate`), with their right places.

    Args:
        values: frames (n,C,H,W) uint8, or features (n,D) float. more: further ones behind them.
        truth: of all of them.
    """

    def __init__(self, values: Tensor, truth: GroundTruth, *more: Tensor) -> None:
        self.values, self.more = values, more
        self.truth = truth._replace(positives=truth.positives.masked_fill(~truth.judged[:, None], -1))

    def __len__(self) -> int:
        return len(self.values) + sum(len(part) for part in self.more)

    def __getitem__(self, index: list[int]) -> Batch:
        frames, first = torch.tensor(index), 0
        chosen = self.values.new_empty(len(frames), *self.values.shape[1:])
        for part in (self.values, *self.more):  # which may lie in files: never as one
            here = (frames >= first) & (frames < first + len(part))
            chosen[here] = part[frames[here] - first]
            first += len(part)
        return Batch(as_frames(chosen), GroundTruth(*(part[index] for part in self.truth)))


class Clips(Sampler[list[int]]):
    """Each frame about once an epoch, in clips of consecutive frames from all over the route.

    Args:
        lengths: frames of each traverse; no clip crosses from one to the next.
        batch_size: frames of a batch. clip: frames of a clip; a last clip that is shorter is left out.
    """

    def __init__(self, lengths: list[int], batch_size: int, clip: int) -> None:
        self.lengths, self.clip = lengths, clip
        self.clips = min(batch_size // clip, sum(length // clip for length in lengths))

    def __len__(self) -> int:
        return sum(length // self.clip for length in self.lengths) // self.clips

    def __iter__(self) -> Iterator[list[int]]:
        starts, first = [], 0
        for length in self.lengths:
            left_over = int(torch.randint(length % self.clip + 1, ()))
            starts.append(first + left_over + torch.arange(length // self.clip) * self.clip)
            first += length
        order = torch.cat(starts)
        order = order[torch.randperm(len(order))]
        frames = order[:, None] + torch.arange(self.clip)
        for batch in frames.split(self.clips)[: len(self)]:  # an incomplete batch is left out
            yield batch.flatten().tolist()


def store(traverse: Traverse, resize: tuple[int, int] | None = None) -> Tensor:
    """All frames of a traverse as bytes: (N,C,H,W) uint8; ready features as they are, (N,D)."""
    shape: tuple[int, ...] = ()

    def rows() -> Iterator[Tensor]:
        nonlocal shape
        for batch in traverse.batches(READ_AT_ONCE):
            if batch.ndim == 4 and resize is not None and tuple(batch.shape[-2:]) != tuple(resize):
                batch = antialiased_resize(batch, (resize[0], resize[1]), antialias=True)
            if shape and tuple(batch.shape[1:]) != shape:
                raise InputError(
                    f"{traverse.name} holds frames of {shape} and of {tuple(batch.shape[1:])}; "
                    "expected one size, as data.resize makes"
                )
            shape = tuple(batch.shape[1:])
            if not batch.isfinite().all():
                raise InputError(f"{traverse.name} holds NaN or infinite values; expected finite numbers")
            yield (batch if batch.ndim == 2 else (batch * 255).round().clamp(0, 255).byte().flatten(1)).cpu()

    values = concatenate(rows())
    return values.view(len(values), *shape)


def as_frames(values: Tensor) -> Tensor:
    """Bytes as frames in [0, 1]; features as they are."""
    return values.float() / 255 if values.dtype == torch.uint8 else values
