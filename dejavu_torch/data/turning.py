"""Images that are turned: by quarters, as a camera that is mounted so needs, or so that north is up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.traverse import Part, at_size
from dejavu_torch.memory import without_autocast
from dejavu_torch.places.layout import Layout
from dejavu_torch.types import Traverse, expect

MOST = 360  # headings of an image that are tried
# frames (..., H, W) turned clockwise, in degrees, with left and right or height and width exchanged
TURNS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "90": lambda frames: frames.rot90(-1, (-2, -1)),
    "180": lambda frames: frames.flip(-2, -1),
    "270": lambda frames: frames.rot90(1, (-2, -1)),
    "mirror": lambda frames: frames.flip(-1),
    "transpose": lambda frames: frames.transpose(-2, -1),
}
# degrees by which the upper side turns; of a transposed frame it is the former left one
QUARTERS = {"90": 90, "180": 180, "270": 270, "mirror": 0, "transpose": 90}


def composed(*turns: str) -> str | None:
    """The one of `TURNS` that does what several do, one after the other; "" if they undo each other, None if
    there is none.

    Example:
        >>> composed("90", "180"), composed("90", "270"), composed("mirror", "180")
        ('270', '', None)
    """
    turned = picture = torch.arange(6).view(2, 3)
    for turn in filter(None, turns):
        turned = TURNS[turn](turned)
    same = {"": picture, **{name: alter(picture) for name, alter in TURNS.items()}}
    return next((name for name, other in same.items() if torch.equal(other, turned)), None)


class Upright(Part):
    """Frames turned by one of `TURNS`, for a camera that is mounted otherwise, or mirrored.

    Raises:
        InputError: another turn, ready features, or an area.
    """

    def __init__(self, traverse: Traverse, turn: str) -> None:
        super().__init__(traverse, range(len(traverse)))
        seen = f"{traverse.name}: turn={turn}"
        expect(turn in TURNS, f"{', '.join(TURNS)}, clockwise", seen)
        expect(len(traverse.frame_shape) == 3, "frames, which can be turned", seen)
        traverse.layout.expect_route("a route: windows of an area are turned by --headings", seen)
        self.turn = turn
        self.headings = None if self.headings is None else (self.headings - QUARTERS[turn]) % 360

    def read(self, frames: range | list[int]) -> Tensor:
        return TURNS[self.turn](super().read(frames)).contiguous()

    def decoded_at(self, height: int, width: int) -> Upright:
        """The frames at another size, of which the images are decoded at theirs."""
        size = (width, height) if QUARTERS[self.turn] % 180 else (height, width)
        return self.changed(traverse=at_size(self.traverse, size), sized=True)

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        return tuple(TURNS[self.turn](torch.empty(self.traverse.frame_shape, device="meta")).shape)


@without_autocast
def turned_north(frames: Tensor, heading: Tensor) -> Tensor:
    """Frames (B,C,H,W) whose upper side looks towards `heading` (B,), degrees clockwise from north, turned by
    it about their middle, bilinear. Corners that they do not show are reflected."""
    angle = heading.to(frames).deg2rad()
    height, width = frames.shape[-2:]
    cos, sin, none = angle.cos(), angle.sin(), torch.zeros_like(angle)
    rows = torch.stack([cos, sin * height / width, none, -sin * width / height, cos, none], 1)
    grid = F.affine_grid(rows.view(-1, 2, 3), list(frames.shape), align_corners=False)
    return F.grid_sample(frames, grid, padding_mode="reflection", align_corners=False)


class Turned(Part):
    """Frames turned north, see `turned_north`.

    Args:
        heading: (n,) degrees; frames whose heading is NaN stay as they are. copies: n is a multiple of it,
            and each frame follows so many times.
    """

    def __init__(self, traverse: Traverse, heading: Tensor, copies: int = 1) -> None:
        every = range(len(traverse))
        super().__init__(traverse, every if copies == 1 else torch.tensor(every).repeat_interleave(copies))
        self.heading, self.headings = heading.nan_to_num(), None

    def read(self, frames: range | list[int]) -> Tensor:
        return turned_north(super().read(frames), self.heading[torch.as_tensor(frames)])


def is_turned(traverse: Traverse) -> bool:
    """Whether images are turned, and what they have in common has to be removed, see `set_apart`."""
    return hasattr(traverse, "heading")


def facing_north(traverse: Traverse, layout: Layout, headings: int = 1) -> Traverse:
    """Queries as the map of an area compares them: turned by their own headings, if these are known, or, for
    more than one of `headings`, as many copies of each frame, turned evenly over 360 degrees. On a route, and
    without known headings, they stay as they are.

    Raises:
        InputError: several headings on a route, of ready features, or out of range.
    """
    fits = isinstance(headings, int) and 1 <= headings <= MOST
    expect(fits, f"a whole number from 1 to {MOST}", headings=headings)
    if headings > 1:
        layout.expect_area("the map of an area, as of grid:PICTURE", f"headings {headings} on a route")
        seen = f"headings {headings}, and {traverse.name} has ready features"
        expect(len(traverse.frame_shape) == 3, "images, which can be turned", seen)
        evenly = (torch.arange(headings) * 360 / headings).repeat(len(traverse))
        return Turned(traverse, evenly, headings)
    if traverse.headings is None or len(traverse.frame_shape) != 3 or not layout.on_ground:
        return traverse
    return Turned(traverse, traverse.headings + layout.north)
