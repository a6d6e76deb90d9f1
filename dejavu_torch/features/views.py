"""Further looks at the places of a route, from which whitening learns what changes between two visits."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.types import InputError, Traverse


class Views(NamedTuple):
    """Frames of places of the reference.

    places: (n,) int64, which place each frame shows; -1 for none, and the frame is left out.
    """

    traverse: Traverse
    places: Tensor


class AugmentedTraverse(Traverse):
    """Augmented copies of a traverse's frames: all of the first frame, all of the second, and so on.

    Args:
        traverse: frames (B,C,H,W).
        frames: their number N.
        copies: of each frame. most: in all; frames are drawn evenly where there would be more.
        strengths: arguments of `Augmentation`; None is its defaults.
        seed: of the copies; the same batch size gives the same copies.

    Raises:
        InputError: ready features, or strengths that `Augmentation` refuses.
    """

    def __init__(
        self,
        traverse: Traverse,
        frames: int,
        copies: int,
        most: int,
        strengths: Mapping[str, Any] | None = None,
        seed: int = 0,
    ) -> None:
        from dejavu_torch.features.augmentation import Augmentation  # kornia takes a second to import

        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames to augment")
        self.traverse, self.copies, self.seed = traverse, copies, seed
        self.shown = range(0, frames, max(1, -(-frames * copies // most)))
        try:
            self.augmentation = Augmentation(**(strengths or {})).train()
        except TypeError as error:
            known = ", ".join(inspect.signature(Augmentation).parameters)
            raise InputError(f"the strengths of whitening are {strengths}; expected {known}") from error
        self.name = f"augmented copies of {traverse.name}"
        self.length = copies * len(self.shown)

    def batches(self, size: int) -> Iterator[Tensor]:
        state = torch.Generator().manual_seed(self.seed).get_state()
        for batch in self.traverse.select(self.shown, max(1, size // self.copies)):
            with torch.random.fork_rng(devices=[]):
                torch.set_rng_state(state)
                copies = torch.stack([self.augmentation(batch) for _ in range(self.copies)], 1)
                state = torch.get_rng_state()
            yield copies.flatten(0, 1)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """See `Traverse`."""
        return self.traverse.frame_shape

    @property
    def views(self) -> Views:
        """The copies with the frames that they show."""
        return Views(self, torch.tensor(self.shown).repeat_interleave(self.copies))
