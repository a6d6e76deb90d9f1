"""Augmented views of the places of a route, for whitening and calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.features.augmentation import LARGEST, Augmentation
from dejavu_torch.types import InputError, Traverse

BLOCK = 64  # frames augmented together
STRETCH, EVERY = 20, 10  # frames of a segment; every 10th segment is used
STRONGER = 1.5  # factor on the strengths for whitening, which has seen the frames themselves
FEWEST, MOST = 600, 1200  # frames of all segments together
MAX_COPIES = 2  # frames of all segments, relative to the frames of a short route
LEAST, SCORES = 240, 2**27  # frames of a long route at least; their scores at all places at most


class Views(NamedTuple):
    """Frames, and (n,) int64 the place of the reference that each shows, -1 for a frame to skip."""

    traverse: Traverse
    places: Tensor


class AugmentedTraverse(Traverse):
    """Augmented copies of frames, the same for any batch size: each block of frames `copies` times.

    Args:
        traverse: frames (B,C,H,W). runs: the frames, increasing. block: most frames augmented together.
        copies: of each frame. strengths: arguments of `Augmentation`. factor: to multiply them by.

    Raises:
        InputError: ready features, or strengths that `Augmentation` refuses.
    """

    def __init__(
        self,
        traverse: Traverse,
        runs: Sequence[range],
        block: int,
        copies: int,
        strengths: Mapping[str, Any],
        seed: int = 0,
        factor: float = 1.0,
    ) -> None:
        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames to augment")
        try:
            self.augmentation = Augmentation(**strengths).stronger(factor)
        except TypeError as error:
            names = ", ".join(LARGEST)
            raise InputError(f"the strengths of whitening are {strengths}; expected {names}") from error
        self.traverse, self.runs, self.block, self.copies, self.seed = traverse, runs, block, copies, seed
        blocks = (part for run in runs for part in torch.tensor(run).split(block))
        self.places = torch.cat([part.repeat(copies) for part in blocks])
        self.length = len(self.places)
        self.name = f"augmented copies of {traverse.name}"

    def batches(self, size: int) -> Iterator[Tensor]:
        state = torch.Generator().manual_seed(self.seed).get_state()
        for frames in self._blocks():
            for _ in range(self.copies):
                with torch.random.fork_rng(devices=[]):
                    torch.set_rng_state(state)
                    copies: Tensor = self.augmentation.train()(frames)
                    state = torch.get_rng_state()
                yield from copies.split(size)

    def _blocks(self) -> Iterator[Tensor]:
        """The frames of each block; a traverse that cannot seek is read only once."""
        if self.traverse.seeks or len(self.runs) == 1:
            for run in self.runs:
                yield from self.traverse.select(run, self.block)
            return
        frames = chain.from_iterable(self.traverse.between(0, self.runs[-1].stop))
        done = 0
        for run in self.runs:
            yield torch.stack(list(islice(frames, run.start - done, run.stop - done)))
            done = run.stop

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape


def augmented_route(
    traverse: Traverse, frames: int, copies: int, most: int, strengths: Mapping[str, Any], seed: int = 0
) -> tuple[Views, str]:
    """At most `most` augmented copies of N `frames`, evenly drawn, and a phrase for the log about them."""
    shown = range(0, frames, max(1, -(-frames * copies // most)))
    views = AugmentedTraverse(traverse, [shown], traverse.batch_size(BLOCK), copies, strengths, seed)
    each = "each frame" if shown.step == 1 else f"{len(shown)} of the frames"
    return Views(views, views.places), f"{copies} look{'s' * (copies > 1)} at {each}"


def augmented_segments(
    traverse: Traverse,
    frames: int,
    strengths: Mapping[str, Any],
    places: int | None = None,
    starts: Sequence[int] | None = None,
) -> AugmentedTraverse:
    """Augmented segments of a traverse, as another visit may show them, to calibrate a map.

    Every 10th segment of 20 frames, or of fewer in a short traverse. Short traverses are used several times,
    long ones in part: 1200 frames of 10^5, down to 240 of more.

    Args:
        frames: N, of the traverse. strengths: of `Augmentation`; changes are 1.5 times as strong.
        places: of the map to search; None is N.
        starts: of segments of 20 frames, increasing, instead of every 10th segment.
    """
    length = min(STRETCH, max(1, frames // EVERY)) if starts is None else STRETCH
    starts = range(0, frames - length + 1, EVERY * length) if starts is None else starts
    most = min(MOST, max(LEAST, SCORES // (places or frames)))
    runs = [range(one, one + length) for one in starts[:: max(1, -(-len(starts) * length // most))]]
    copies = max(1, -(-min(FEWEST, MAX_COPIES * frames, most) // (len(runs) * length)))
    return AugmentedTraverse(traverse, runs, length, copies, strengths, factor=STRONGER)
