"""Further looks at the places of a route, from which whitening learns what changes between two visits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.features.augmentation import LARGEST, Augmentation
from dejavu_torch.types import InputError, Traverse

BLOCK = 64  # frames augmented at once
STRETCH, EVERY = 20, 10  # frames of a stretch, and which of the stretches are taken
STRONGER = 1.5  # than what a whitening knows, since it has seen the frames themselves
FEWEST, MOST = 600, 1200  # frames of all stretches together
TIMES = 2  # of a short route, as many as it has itself at most
LEAST, SCORES = 240, 2**27  # frames of a long route at least, and scores of them all at all of its places


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
        from dejavu_torch.features.kornia_augmentation import KorniaAugmentation  # kornia takes a second

        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames to augment")
        self.traverse, self.copies, self.seed = traverse, copies, seed
        self.shown = range(0, frames, max(1, -(-frames * copies // most)))
        self.block = traverse.batch_size(BLOCK)  # of frames, whatever the batch size: the same copies
        self.augmentation = KorniaAugmentation(**_checked(strengths)).train()
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
    def looks(self) -> str:
        """How often it looks at which frames, in words."""
        each = "each frame" if self.shown.step == 1 else f"{len(self.shown)} of the frames"
        return f"{self.copies} look{'s' * (self.copies > 1)} at {each}"

    @property
    def views(self) -> Views:
        """The copies with the frames that they show."""
        blocks = torch.tensor(self.shown).split(self.block)
        return Views(self, torch.cat([block.repeat(self.copies) for block in blocks]))


class Stretches(Traverse):
    """Stretches of a traverse, each frame as it may look on another visit: what a map is calibrated by.

    Every 10th stretch of 20 frames is taken, of a short traverse fewer frames; several times where that is
    little, and of a long one not all: 1200 frames of one of 10^5, down to 240 of longer ones. Each frame is
    changed for itself, 1.5 times as much as by `strengths`.

    Args:
        traverse: frames (B,C,H,W). frames: their number N. strengths: arguments of `Augmentation`.
        seed: of the changes. places: of the map, among which they are looked up; None is N.
        starts: of the stretches of 20 frames that are taken instead; None is as above.

    Raises:
        InputError: ready features.
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
        from dejavu_torch.features.kornia_augmentation import KorniaAugmentation

        if len(traverse.frame_shape) != 3:
            raise InputError(f"{traverse.name} holds ready features; expected frames to calibrate by")
        length = min(STRETCH, max(1, frames // EVERY)) if starts is None else STRETCH
        starts = range(0, frames - length + 1, EVERY * length) if starts is None else starts
        most = min(MOST, max(LEAST, SCORES // (places or frames)))
        self.starts = starts[:: max(1, -(-len(starts) * length // most))]
        wanted = min(FEWEST, TIMES * frames, most)
        self.times = max(1, -(-wanted // (len(self.starts) * length)))
        self.traverse, self.stretch, self.seed = traverse, length, seed
        self.augmentation = KorniaAugmentation(**_checked(strengths, STRONGER))
        self.name, self.length = f"changed frames of {traverse.name}", len(self.places)

    @property
    def places(self) -> Tensor:
        """The frame that each shows, (n,) int64."""
        one = torch.tensor(self.starts)[:, None] + torch.arange(self.stretch)
        return one[:, None].expand(-1, self.times, -1).flatten()

    def batches(self, size: int) -> Iterator[Tensor]:
        state = torch.Generator().manual_seed(self.seed).get_state()
        for frames in self._stretches():
            for _ in range(self.times):
                with torch.random.fork_rng(devices=[]):
                    torch.set_rng_state(state)
                    changed: Tensor = self.augmentation.train()(frames)
                    state = torch.get_rng_state()
                yield from changed.split(size)

    def _stretches(self) -> Iterator[Tensor]:
        """The frames of each."""
        if self.traverse.seeks:
            for start in self.starts:
                yield torch.cat(list(self.traverse.between(start, start + self.stretch)))
            return
        held: list[Tensor] = []
        starts = iter(self.starts)
        place, start = 0, next(starts)
        for batch in self.traverse.between(0, self.starts[-1] + self.stretch):
            for frame in batch:
                held += [frame] if place >= start else []
                place += 1
                if len(held) == self.stretch:
                    yield torch.stack(held)
                    held, start = [], next(starts, place)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """See `Traverse`."""
        return self.traverse.frame_shape

    @property
    def views(self) -> Views:
        """The frames with the places that they show."""
        return Views(self, self.places)


def _checked(strengths: Mapping[str, Any], factor: float = 1.0) -> dict[str, Any]:
    """Strengths, which may come from a file, times a factor, as far as `Augmentation` takes them."""
    try:
        known = Augmentation(**strengths).strengths
    except TypeError as error:
        expected = ", ".join(LARGEST)
        raise InputError(f"the strengths of whitening are {strengths}; expected {expected}") from error
    scaled = {
        name: tuple(min(factor * one, most) for one, most in zip(known[name], LARGEST[name], strict=True))
        for name in strengths
    }
    return {name: pair if len(pair) > 1 else pair[0] for name, pair in scaled.items()}
