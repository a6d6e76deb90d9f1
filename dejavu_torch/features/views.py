"""Further looks at the places of a route, from which whitening learns what changes between two visits."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.types import InputError, Traverse

BLOCK = 64  # frames augmented at once


class Views(NamedTuple):
    """Frames of places of the reference.

    places: (n,) int64, which place each frame shows; -1 for none, and the frame is left out.
    """

    traverse: Traverse
    places: Tensor


class AugmentedTraverse(Traverse):
    """Augmented copies of a traverse's frames: one of each frame of a block, another of each, and so on.

    Args:
        traverse: frames (B,C,H,W).
        frames: their number N.
        copies: of each frame. most: in all; frames are drawn evenly where there would be more.
        strengths: arguments of `Augmentation`.
        seed: of the copies.

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
        from dejavu_torch.features.augmentation import Augmentation  # kornia takes a second to import

        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames to augment")
        self.traverse, self.copies, self.seed = traverse, copies, seed
        self.shown = range(0, frames, max(1, -(-frames * copies // most)))
        self.block = traverse.batch_size(BLOCK)  # of frames, whatever the batch size: the same copies
        try:
            self.augmentation = Augmentation(**strengths).train()
        except TypeError as error:
            known = ", ".join(inspect.signature(Augmentation).parameters)
            raise InputError(f"the strengths of whitening are {strengths}; expected {known}") from error
        self.name = f"augmented copies of {traverse.name}"
        self.length = copies * len(self.shown)

    def batches(self, size: int) -> Iterator[Tensor]:
        state = torch.Generator().manual_seed(self.seed).get_state()
        for frames in self.traverse.select(self.shown, self.block):
            for _ in range(self.copies):
                with torch.random.fork_rng(devices=[]):
                    torch.set_rng_state(state)
                    copies: Tensor = self.augmentation(frames)
                    state = torch.get_rng_state()
                yield from copies.split(size)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """See `Traverse`."""
        return self.traverse.frame_shape

    @property
    def views(self) -> Views:
        """The copies with the frames that they show."""
        blocks = torch.tensor(self.shown).split(self.block)
        return Views(self, torch.cat([block.repeat(self.copies) for block in blocks]))
