"""Places, frames of the reference and routes: which belong together."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.positions import borders, look_up, place_of, shown_frames
from dejavu_torch.types import InputError


class Route(NamedTuple):
    """A route of a map that has several: its name, and how many places and frames."""

    name: str
    places: int
    frames: int


class FrameTable(NamedTuple):
    """Which frames the places of a map show, and on which route; its columns are those of `PlaceMap`.

    Convention: tensors of places and frames are int64 of any shape, and count through all routes. -1, no
        place or frame, stays -1.
    """

    places: int
    positions: Tensor
    routes: tuple[Route, ...] = ()

    @property
    def frames(self) -> int:
        """F, of the reference."""
        return len(self.positions) or self.places

    @property
    def steps(self) -> Tensor:
        """(F,) of each frame, through all routes; of several in double, as float32 would lose places."""
        if len(self.routes) < 2 or not len(self.positions):
            return self.positions
        parts = self.positions.double().clamp(min=0).split([route.frames for route in self.routes])
        starts = accumulate((route.places for route in self.routes), initial=0)
        return torch.cat([part + start for part, start in zip(parts, starts, strict=False)])

    @property
    def borders(self) -> Tensor:
        """(N+1,) int64, the frame with which each place begins, and the number of frames."""
        return borders(self.steps) if len(self.positions) else torch.arange(self.places + 1)

    def frame_of(self, places: Tensor) -> Tensor:
        """The frame that each place shows."""
        return look_up(shown_frames(self.steps), places) if len(self.positions) else places

    def place_of(self, frames: Tensor) -> Tensor:
        """The place nearest to each frame, -1 for one before the first place; no other frames than F."""
        if frames.numel() and int(frames.max()) >= self.frames:
            seen = f"frame {int(frames.max())} of the reference"
            raise InputError(f"{seen}; expected frames from 0 to {self.frames - 1}")
        return place_of(self.steps, frames) if len(self.positions) else frames

    def scored(self, places: Tensor) -> Tensor:
        """Of the places that show one frame, the nearest to it, which a ground truth in frames means."""
        return self.place_of(self.frame_of(places))

    def route_of(self, places: Tensor) -> Tensor:
        """The number of the route that each place is on."""
        ends = torch.tensor([route.places for route in self.routes], device=places.device).cumsum(0)
        return torch.where(places >= 0, torch.searchsorted(ends, places.contiguous(), right=True), -1)

    def own_frame_of(self, places: Tensor) -> Tensor:
        """As `frame_of`, with frames counted on their own route."""
        starts = torch.tensor([0, *(route.frames for route in self.routes)], device=places.device).cumsum(0)
        return torch.where(places >= 0, self.frame_of(places) - look_up(starts, self.route_of(places)), -1)
