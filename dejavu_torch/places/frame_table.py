"""The correspondence of places, reference frames and routes."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.places.layout import Layout
from dejavu_torch.places.positions import (
    borders,
    count_places,
    look_up,
    place_of,
    positions_behind,
    shown_frames,
)
from dejavu_torch.places.rectangles import Run
from dejavu_torch.text import InputError


class Route(NamedTuple):
    """One of several routes of a map: its name and its numbers of places and frames."""

    name: str
    places: int
    frames: int


class FrameTable(NamedTuple):
    """The frame and route of each place of a map; for the fields see `PlaceMap`.

    Convention: places and frames are int64 of any shape, numbered through all routes. -1, for none, stays.
    """

    layout: Layout
    positions: Tensor

    @property
    def places(self) -> int:
        """N."""
        return self.layout.places

    @property
    def frames(self) -> int:
        """F, number of frames of the reference."""
        return len(self.positions) or self.places

    @property
    def runs(self) -> tuple[Run, ...]:
        """As of the layout, with the frames that positions tell of a single one."""
        runs = self.layout.runs
        return runs if len(runs) > 1 else (runs[0]._replace(frames=self.frames),)

    @property
    def routes(self) -> tuple[Route, ...]:
        """The routes of a merged map, else ()."""
        return tuple(
            Route(name, *(sum(run[i] for run in self.runs if run.route == r) for i in (1, 2)))
            for r, name in enumerate(self.layout.routes)
        )

    @property
    def counted(self) -> Layout:
        """The layout, which knows its frames also where positions tell them."""
        return self.layout if self.frames == self.places else self.layout.showing(self.frames)

    @property
    def steps(self) -> Tensor:
        """(F,) step of each frame, through all routes; for several in double, since float32 loses places."""
        if len(self.runs) < 2 or not len(self.positions):
            return self.positions
        parts = self.positions.double().clamp(min=0).split([run.frames for run in self.runs])
        return torch.cat([part + start for part, start in zip(parts, self.layout.starts, strict=True)])

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
        return self.layout.route_of(places)

    def own_frame_of(self, places: Tensor) -> Tensor:
        """As `frame_of`, with frames numbered on their own route."""
        shifts, own, first = list[int](), [0] * self.layout.count, 0
        for run in self.runs:
            shifts.append(first - own[run.route])
            own[run.route], first = own[run.route] + run.frames, first + run.frames
        ends = torch.tensor([run.places for run in self.runs], device=places.device).cumsum(0)
        at = torch.searchsorted(ends, places.contiguous(), right=True).clamp(max=len(shifts) - 1)
        shift = torch.tensor(shifts, device=places.device)[at]
        return torch.where(places >= 0, self.frame_of(places) - shift, -1)

    def frames_in(self, route: int) -> Tensor:
        """The frames of a route, in its order, int64."""
        each = zip(self.runs, accumulate(run.frames for run in self.runs), strict=True)
        return torch.cat([torch.arange(end - run.frames, end) for run, end in each if run.route == route])

    def only(self, route: int) -> FrameTable:
        """That of one route."""
        sizes = [run.frames * (len(self.positions) > 0) for run in self.runs]
        parts = zip(self.positions.split(sizes), self.runs, strict=True)
        joined, *others = [part for part, run in parts if run.route == route]
        for part in others if len(joined) else ():
            joined = torch.cat([joined, positions_behind(part, count_places(joined))])
        return FrameTable(self.layout.only(route), joined)
