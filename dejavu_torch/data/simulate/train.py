"""A camera on the front of a train: its ride, its sway and its light, whatever the railway."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral, Real
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.draw import Light, Painter
from dejavu_torch.data.simulate.motion import reference_place, ride
from dejavu_torch.data.simulate.paint import Random
from dejavu_torch.data.simulate.scenery import FOOT, Structure, World
from dejavu_torch.data.simulate.sheets import View
from dejavu_torch.types import InputError, Traverse

EXPOSURE = 0.4  # part of a frame's time during which the shutter is open
LEFT, RIGHT, AHEAD = 1.4, 2.4, 12.0  # metres: a strip of ground beside the sleepers, and how far it goes
LIMITS: dict[str, tuple[float, float]] = {
    "seed": (0, math.inf),
    "traverse": (0, 9),
    "frames": (0, math.inf),
    "height": (16, 512),
    "width": (16, 1024),
    "speed": (5, 40),
    "noise": (0, 1),
    "shake": (0, 3),
}
SLIM, FLAT = 0.5, 4  # width over height, the least and the most


@dataclass(eq=False)
class Railway(Traverse):
    """What both railways share: the ride, the camera and its light.

    The camera takes 25 frames a second, 2.6 m above the track bed and 2.4 m above the level of the rails,
    with square pixels, a focal length of 0.55 frame widths and its horizon at 0.38 of the frame's height;
    the shutter is open for 0.4 of a frame's time. The rails lie 1.5 m apart. The train speeds up and brakes
    by 0.9 m/s^2, crawls twice and stops once, on odd traverses twice.

    Attributes:
        distance: (N,) float64, metres along the track of each frame.
        place: (N,) float64, the same in units of reference frames; where the reference stands still,
            the first frame of the stop, and past its last frame, that one.
        structures: what repeats, each with its name, period, start and stop in metres.
        size: height and width of a frame in pixels.
        ground: (x, y) of the corners of a strip of ground: far left, far right, near right, near left, in
            fractions of the frame, (0, 0) the centre of its top left pixel and (1, 1) of its bottom right
            one. 1.4 to 2.4 m to the right, beside the sleepers, of which the train may pass about one a
            frame; from just above the bottom row (where that does not show it all, from where it is seen) to
            12 m ahead; sway and roll are left out.
        ground_span: metres along the track from that strip's near edge to its far one.

    Convention: all of these figures, and those of the scenery, are frozen: results are judged on these
        routes.

    Raises:
        InputError: an argument that is no number or out of its range, a frame less than half or over 4 times
            as wide as high, or more frames than the route has.
    """

    seed: int = 0
    traverse: int = 0
    frames: int = 0
    height: int = 64
    width: int = 128
    speed: float = 17.0
    noise: float = 0.02
    shake: float = 1.0

    kind: ClassVar[str]
    route: ClassVar[float]  # metres
    length: int = field(init=False, repr=False)
    place: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.name = f"sim:{self.kind}?" + "&".join(self._checked())
        reference = self._ride(0, self.speed)
        distance = self._ride(self.traverse, self.speed) if self.traverse else reference
        if self.frames > len(distance):
            raise InputError(
                f"sim:{self.kind} has frames={self.frames}; expected at most the {len(distance)} of its route"
            )
        self.size = self.height, self.width
        self.length = self.frames or len(distance)
        self.distance = distance[: self.length]
        if self.traverse:
            self.place = reference_place(reference, self.distance)
        else:
            self.place = torch.arange(self.length).double()
        self._step = distance.diff(append=distance[-1:])[: self.length] * EXPOSURE
        self._paths = self._wander(len(distance))
        view = View(*self.size)
        # a little above the bottom row, and where all of it is in sight
        near = 1.05 * max(FOOT / float(view.up.min()), RIGHT / float(view.right.max()))
        corners = (LEFT, AHEAD), (RIGHT, AHEAD), (RIGHT, near), (LEFT, near)
        self.ground = tuple(view.project(x, FOOT, ahead) for x, ahead in corners)
        self.ground_span = AHEAD - near

    def _checked(self) -> list[str]:
        """Refuse arguments out of their range, and return those that an address needs."""
        address = []
        for key, (low, high) in LIMITS.items():
            value, usual = getattr(self, key), getattr(type(self), key)
            whole = isinstance(usual, int)
            fits = isinstance(value, Integral if whole else Real)
            if not (fits and low <= value <= high):
                span = f"{low} <= {key} <= {high}" if high < math.inf else f"{key} >= {low}"
                wanted = f"{span}, a whole number" if whole else span
                raise InputError(f"sim:{self.kind} has {key}={value}; expected {wanted}")
            value = type(usual)(value)
            setattr(self, key, value)
            if key in ("seed", "traverse") or value != usual:
                address.append(f"{key}={value}")
        if not SLIM <= self.width / self.height <= FLAT:
            raise InputError(
                f"sim:{self.kind} has height={self.height} and width={self.width}; "
                f"expected a width of {SLIM} to {FLAT} times the height"
            )
        return address

    def _ride(self, traverse: int, speed: float) -> Tensor:
        """Metres of each frame of a traverse over the whole route."""
        random, route = Random(self.kind, "ride", self.seed, traverse), self.route
        cruise = speed * (random.uniform(0.85, 1.2) if traverse else 1.0)
        slow = []
        for k in range(2):
            start = route * (k + random.uniform(0.2, 0.7)) / 2
            slow.append((start, start + random.uniform(60, 150), cruise * random.uniform(0.45, 0.7)))
        first = random.uniform(0.15, 0.4)
        stops = [(route * at, random.uniform(2.5, 5.0)) for at in (first, first + random.uniform(0.25, 0.5))]
        return ride(route, cruise, tuple(slow), tuple(stops[: 1 + traverse % 2]))

    def _wander(self, frames: int) -> dict[str, Tensor]:
        """The camera's sway and the light's drift, each (N,) within [-1, 1]."""
        random = Random(self.kind, "camera", self.seed, self.traverse)
        slow = {name: random.wander(frames) for name in ("gain", "warm", "gamma")}
        i = torch.arange(frames, dtype=torch.float64)
        for name in ("aside", "lift", "pitch", "yaw", "roll"):
            quick = [torch.sin(i * random.uniform(0.1, 0.5) + random.uniform(0, 6.3)) for _ in range(3)]
            slow[name] = (random.wander(frames) + torch.stack(quick).mean(0)) / 2
        return slow

    @property
    def structures(self) -> tuple[Structure, ...]:
        return self._world.structures

    @cached_property
    @abstractmethod
    def _world(self) -> World:
        """The railway with this traverse's visitors."""

    @abstractmethod
    def _light(self, world: World, random: Random) -> Light: ...

    @abstractmethod
    def _sky(self, view: View, random: Random) -> Tensor:
        """What lies behind everything, (3,P)."""

    @property
    def _looks(self) -> tuple[float, float, float]:
        """Gain, gamma and warmth of a traverse's camera."""
        random = Random(self.kind, "looks", self.seed, self.traverse)
        other = [random.pick(values) for values in ((0.72, 0.82, 1.18), (0.85, 1.18), (-0.09, 0.09))]
        return (other[0], other[1], other[2]) if self.traverse else (1.0, 1.0, 0.0)

    @cached_property
    def _painter(self) -> tuple[Painter, Tensor, int]:
        margin = math.ceil(0.05 * max(self.size))
        view = View(*self.size, margin)
        random = Random(self.kind, "light", self.seed, self.traverse)
        light = self._light(self._world, random)
        return Painter(view, list(self._world.sheets.values()), light), self._sky(view, random), margin

    def batches(self, size: int) -> Iterator[Tensor]:
        """Yield the frames in order, at most `size` at a time. Shape: (B,3,H,W) float32 in [0,1]."""
        if size < 1:
            raise InputError(f"a batch holds {size} frames; expected at least 1")
        for part in torch.arange(self.length).split(size):
            yield self._frames(part)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        for part in torch.arange(self.length)[start:stop].split(64):
            yield self._frames(part)

    def _frames(self, at: Tensor) -> Tensor:
        painter, sky, margin = self._painter
        path = {name: curve[at] for name, curve in self._paths.items()}
        swing = self.shake * (1.0 if self.traverse else 0.5)
        sway = swing * torch.stack([0.06 * path["aside"], 0.04 * path["lift"]], 1)
        seen = painter.draw(self.distance[at], self._step[at], sway, sky)
        seen = self._turned(seen, swing, path, margin)
        gain, gamma, warm = self._looks
        warmth = warm + 0.02 * path["warm"]
        balance = torch.stack([1 + warmth, torch.ones_like(warmth), 1 - warmth], 1)
        level = gain * (1 + 0.06 * path["gain"])
        seen = (seen * (balance * level[:, None]).float()[:, :, None, None]).clamp(0, 1)
        seen = seen ** (gamma + 0.03 * path["gamma"]).float()[:, None, None, None]
        for frame, i in zip(seen, at.tolist(), strict=True):
            random = Random(self.kind, "noise", self.seed, self.traverse, i)
            frame += self.noise * random.normal(3, *self.size)
        return seen.clamp_(0, 1)

    def _turned(self, seen: Tensor, swing: float, path: dict[str, Tensor], margin: int) -> Tensor:
        """Cut the frames out of their margin, shifted by pitch and yaw and turned by roll."""
        height, width = self.size
        roll = math.radians(0.5) * swing * path["roll"]
        reach = 0.012 * width * swing  # pixels
        c, s = roll.cos()[:, None, None], roll.sin()[:, None, None]
        down = (torch.arange(height).double() + 0.5 - height / 2)[:, None]
        across = torch.arange(width).double() + 0.5 - width / 2
        x = c * across - s * down + (reach * path["yaw"])[:, None, None]
        y = s * across + c * down + (0.7 * reach * path["pitch"])[:, None, None]
        grid = torch.stack([2 * x / (width + 2 * margin), 2 * y / (height + 2 * margin)], -1).float()
        return F.grid_sample(seen, grid, padding_mode="border", align_corners=False)
