"""The correspondence of places, reference frames and routes."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.positions import borders, look_up, place_of, shown_frames
from dejavu_torch.types import InputError

Link = tuple[int, int, float]  # a step from one place to another, with its probability


class Route(NamedTuple):
    """One of several routes of a map: its name and its numbers of places and frames."""

    name: str
    places: int
    frames: int


class FrameTable(NamedTuple):
    """The frame and route of each place of a map; for the fields see `PlaceMap`.

    Convention: places and frames are int64 of any shape, numbered through all routes. -1, for none, stays.
    """

    places: int
    positions: Tensor
    routes: tuple[Route, ...] = ()

    @property
    def frames(self) -> int:
        """F, number of frames of the reference."""
        return len(self.positions) or self.places

    @property
    def steps(self) -> Tensor:
        """(F,) step of each frame, through all routes; for several in double, since float32 loses places."""
        if len(self.routes) < 2 or not len(self.positions):
            return self.positions
        parts = self.positions.double().clamp(min=0).split([route.frames for route in self.routes])
        starts = accumulate((route.places for route in self.routes), initial=0)
        return torch.cat([part + start for part, start in zip(parts, starts, strict=False)])

    @property
    def borders(self) -> Tensor:
        """(N+1,) int64, the first frame of each place, then the number of frames."""
        return borders(self.steps) if len(self.positions) else torch.arange(self.places + 1)

    def frame_of(self, places: Tensor) -> Tensor:
        """The frame that each place shows."""
        return look_up(shown_frames(self.steps), places) if len(self.positions) else places

    def place_of(self, frames: Tensor) -> Tensor:
        """The place nearest to each frame below F, -1 for a frame before the first place."""
        if frames.numel() and int(frames.max()) >= self.frames:
            raise InputError(f"reference frame {int(frames.max())}; expected frames 0 to {self.frames - 1}")
        return place_of(self.steps, frames) if len(self.positions) else frames

    def scored(self, places: Tensor) -> Tensor:
        """For each place, the nearest one to the frame it shows, as in a ground truth of frames."""
        return self.place_of(self.frame_of(places))

    def route_of(self, places: Tensor) -> Tensor:
        """The index of the route of each place."""
        ends = torch.tensor([route.places for route in self.routes], device=places.device).cumsum(0)
        return torch.where(places >= 0, torch.searchsorted(ends, places.contiguous(), right=True), -1)

    def own_frame_of(self, places: Tensor) -> Tensor:
        """As `frame_of`, with frames numbered on their own route."""
        starts = torch.tensor([0, *(route.frames for route in self.routes)], device=places.device).cumsum(0)
        return torch.where(places >= 0, self.frame_of(places) - look_up(starts, self.route_of(places)), -1)
