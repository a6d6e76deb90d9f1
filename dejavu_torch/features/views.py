"""Further views of the places of a route, from which whitening learns what changes between two visits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.features.augmentation import LARGEST, Augmentation
from dejavu_torch.types import InputError, Traverse

BLOCK = 64  # frames augmented at once
STRETCH, EVERY = 20, 10  # frames of a stretch, and which of the stretches are used
STRONGER = 1.5  # than for a whitening, which has seen the frames themselves
FEWEST, MOST = 600, 1200  # frames of all stretches together
TIMES = 2  # frames of all stretches over the frames of a short route, at most
LEAST, SCORES = 240, 2**27  # frames of a long route at least, and scores of them all at all of its places


class Views(NamedTuple):
    """Frames of places of the reference.

    places: (n,) int64, which place each frame shows; -1 for none, and the frame is left out.
    """

    traverse: Traverse
    places: Tensor


class _Augmented(Traverse):
    """Blocks of frames of a traverse, each augmented several times."""

    def __init__(
        self,
        traverse: Traverse,
        blocks: Sequence[Tensor],
        copies: int,
        strengths: Mapping[str, Any],
        seed: int,
    ) -> None:
        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames to augment")
        try:
            self.augmentation = Augmentation(**strengths)
        except TypeError as error:
            names = ", ".join(LARGEST)
            raise InputError(f"the strengths of whitening are {strengths}; expected {names}") from error
        self.traverse, self.copies, self.seed = traverse, copies, seed
        self.places = torch.cat([block.repeat(copies) for block in blocks])
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
        """The frames of each block."""
        raise NotImplementedError

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """See `Traverse`."""
        return self.traverse.frame_shape

    @property
    def views(self) -> Views:
        """The copies with the frames that they show."""
        return Views(self, self.places)


class AugmentedTraverse(_Augmented):
    """Augmented copies of a traverse's frames: one of each frame of a block, another of each, and so on.

    Args:
        traverse: frames (B,C,H,W). frames: their number N. strengths: arguments of `Augmentation`.
        copies: of each frame. most: in all; frames are drawn evenly if there would be more.

    Raises:
        InputError: ready features, or strengths that `Augmentation` refuses.
    """

    def __init__(
        self,
        traverse: Traverse,
        frames: int,
        copies: int,
        most: int,
        strengths: Mapping[str, Any],
        seed: int = 0,
    ) -> None:
        self.shown = range(0, frames, max(1, -(-frames * copies // most)))
        self.block = traverse.batch_size(BLOCK)  # whatever the batch size: the same copies
        super().__init__(traverse, torch.tensor(self.shown).split(self.block), copies, strengths, seed)

    def _blocks(self) -> Iterator[Tensor]:
        return self.traverse.select(self.shown, self.block)

    @property
    def looks(self) -> str:
        """How often it looks at which frames, in words."""
        each = "each frame" if self.shown.step == 1 else f"{len(self.shown)} of the frames"
        return f"{self.copies} look{'s' * (self.copies > 1)} at {each}"


class Stretches(_Augmented):
    """Stretches of a traverse, each frame as it may look on another visit, by which a map is calibrated.

    Every 10th stretch of 20 frames, shorter ones of a short traverse; several times if that is little, and
    fewer of a long one: 1200 frames of one of 10^5, down to 240 of longer ones. Each frame changes
    separately.

    Args:
        traverse, frames, strengths: see `AugmentedTraverse`; changes are 1.5 times as strong.
        places: of the map, among which they are searched; None is N.
        starts: of stretches of 20 frames, increasing, in place of every 10th.
    """

    def __init__(
        self,
        traverse: Traverse,
        frames: int,
        strengths: Mapping[str, Any],
        seed: int = 0,
        places: int | None = None,
        starts: Sequence[int] | None = None,
    ) -> None:
        length = min(STRETCH, max(1, frames // EVERY)) if starts is None else STRETCH
        starts = range(0, frames - length + 1, EVERY * length) if starts is None else starts
        most = min(MOST, max(LEAST, SCORES // (places or frames)))
        self.starts, self.stretch = starts[:: max(1, -(-len(starts) * length // most))], length
        wanted = min(FEWEST, TIMES * frames, most)
        times = max(1, -(-wanted // (len(self.starts) * length)))
        blocks = [torch.arange(start, start + length) for start in self.starts]
        super().__init__(traverse, blocks, times, strengths, seed)
        self.augmentation = self.augmentation.stronger(STRONGER)

    def _blocks(self) -> Iterator[Tensor]:
        if self.traverse.seeks:
            for start in self.starts:
                yield torch.cat(list(self.traverse.between(start, start + self.stretch)))
            return
        frames = chain.from_iterable(self.traverse.between(0, self.starts[-1] + self.stretch))
        at = 0
        for start in self.starts:
            yield torch.stack(list(islice(frames, start - at, start - at + self.stretch)))
            at = start + self.stretch
