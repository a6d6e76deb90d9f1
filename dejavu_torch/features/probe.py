"""A picture that code makes, whose descriptor tells whether frames are described as they were at learning."""

from __future__ import annotations

from contextlib import suppress

import torch
from torch import Tensor

from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.extract import in_mode
from dejavu_torch.memory import in_one_thread
from dejavu_torch.types import InputError

NUMBERS = 256  # of a descriptor that are kept, the first ones
# relative to their length: the code of a default map is off by a fifth, so less changes hardly an answer, and
# the order of sums, by threads or devices, changes a thousandth of that
TOLERANCE = 1e-3
SEED = 1


def probe_picture(shape: tuple[int, ...]) -> Tensor:
    """A picture of a size, (C,H,W) -> (1,C,H,W) float32, by integer arithmetic: slanted waves and blocks with
    edges, in whole steps of 1/255 up to 254/255.

    Example:
        >>> picture = probe_picture((3, 60, 80))
        >>> picture.shape, int((255 * picture).sum())
        (torch.Size([1, 3, 60, 80]), 1801796)
    """
    channels, height, width = shape
    c, y, x = (torch.arange(n) for n in shape)
    c, y = c[:, None, None], y[:, None]

    def wave(at: Tensor, period: int) -> Tensor:  # a triangle from 0 to 79
        return (at % (2 * period) - period).abs() * 79 // period

    smooth = wave(x + 2 * y, width // 2 + 1) + wave(3 * y - x + 5 * c, height // 2 + 1)
    blocks = (x * 7 // width * 73 + y * 5 // height * 151 + (c + SEED) * 37) % 97
    return ((smooth + blocks) / 255).float().view(1, channels, height, width)


@torch.no_grad()
def probe_of(descriptor: Descriptor, shape: tuple[int, ...]) -> tuple[float, ...] | None:
    """The first numbers of the descriptor of the picture; None of ready features, which have no picture, and
    of frames that others have described."""
    if len(shape) != 3 or (descriptor.whitening is not None and not descriptor.whitening.learned):
        return None
    with suppress(InputError), in_one_thread(), in_mode(descriptor, False):
        rows = descriptor(probe_picture(shape).to(descriptor.device))
        return tuple(rows[0, :NUMBERS].float().tolist())
    return None


def probe_distance(descriptor: Descriptor, shape: tuple[int, ...], known: tuple[float, ...]) -> float:
    """How far the picture's descriptor now lies from a known one, relative to the length of that."""
    before, now = torch.tensor(known), torch.tensor(probe_of(descriptor, shape) or ())
    if len(now) != len(before):
        return torch.inf
    return float((now - before).norm() / before.norm().clamp(min=1e-12))
