"""The part of a long route that its whitening, mean and step are learned from."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.selection import Selection
from dejavu_torch.features.views import Views
from dejavu_torch.types import InputError

SAMPLE = 10_000  # frames at most; a route that has no more is learned from all of them
STRETCHES = 4  # at least


class Sample(NamedTuple):
    """Evenly spaced stretches of a route; whole chunks of it, where these are short enough.

    frame: (n,) int64, the frames. stretch: how many each stretch has.
    """

    frame: Tensor
    stretch: int

    def views(self, second: Views) -> Views:
        """As `shown`, to learn from.

        Raises:
            InputError: it shows nothing of the sample.
        """
        found = self.shown(second)
        if not len(found.places):
            seen = f"{second.traverse.name} shows none of the {len(self.frame)} frames that are learned from"
            raise InputError(f"{seen}, in stretches of {self.stretch} all along the route; expected some")
        return found

    def shown(self, second: Views) -> Views:
        """What another traverse shows of the sample, with places that count in it."""
        places = second.places.cpu()
        at = torch.searchsorted(self.frame, places).clamp(max=len(self.frame) - 1)
        shown = (self.frame[at] == places).nonzero().flatten()
        return Views(Selection(second.traverse, shown), at[shown])


def sample_of(frames: int, chunk: int) -> Sample:
    """The sample of a route of over `SAMPLE` frames, coded in chunks of so many.

    Example:
        >>> sample = sample_of(100_000, chunk=1000)
        >>> len(sample.frame), sample.frame[::1000].tolist()
        (10000, [0, 11000, 22000, 33000, 44000, 55000, 66000, 77000, 88000, 99000])
    """
    stretch = min(chunk, SAMPLE // STRETCHES)
    count, last = SAMPLE // stretch, frames // stretch - 1
    starts = torch.arange(count) * last // (count - 1) * stretch
    return Sample((starts[:, None] + torch.arange(stretch)).flatten(), stretch)
