"""A camera on the front of a train: its motion, sway and light on any railway."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.route import Random, SimulatedRoute, option
from dejavu_torch.data.simulate.scenery import FOOT, Structure, World
from dejavu_torch.data.simulate.sheets import FAR, Light, Painter, Thing, View
from dejavu_torch.types import expect

FPS = 25.0
ACCELERATION = 0.9  # metres per second squared, the same for braking
GRAIN = 0.125  # metres; grid of the speed profile
EXPOSURE = 0.4  # fraction of a frame's time in which the shutter is open
LEFT, RIGHT, AHEAD = 1.4, 2.4, 12.0  # metres: sides and far edge of a strip of ground next to the sleepers


@dataclass(eq=False)
class Railway(SimulatedRoute):
    """A train ride; a subclass builds the railway and its light.

    The camera takes 25 frames per second, 2.6 m above the track bed and 2.4 m above the rails, with square
    pixels, a focal length of 0.55 frame widths, the horizon at 0.38 of the frame's height and an exposure of
    0.4 frame times. The train accelerates and brakes by 0.9 m/s^2, slows down twice and stops once, on odd
    traverses twice.

    Args:
        seed: selects the railway, at least 0.
        traverse: selects the ride, 0 to 9, its speeds, stops, light, sway, people, trains; 0: the reference.
        frames: number of frames from the start; 0 for the whole route.
        height, width: of a frame in pixels, 16 to 512 and 16 to 1024; the width 0.5 to 4 times the height.
        speed: cruising speed of the reference in m/s, 5 to 40; other rides have 0.85 to 1.2 of it.
        noise: standard deviation of the sensor noise, 0 to 1; white is 1.
        shake: camera sway, 0 to 3; 1 is up to 6 cm sideways and 0.5 degrees of roll, half that at traverse 0.

    Attributes:
        distance: (N,) float64, metres along the track of each frame.
        place: (N,) float64, the same in reference frames: of a stop the first one, at most the last one.
        structures: what repeats, each with its name, period, start and stop in metres.
        corners: (x, y) of a strip of ground in fractions of the frame as in `View.project`: far left, far
            right, near right, near left. It is 1.4 to 2.4 m right of the camera, next to the sleepers, from
            the first point in view up to 12 m ahead, without sway and roll.
        ground_span: length of that strip along the track in metres.

    Convention: these values, and those of the scenery, are frozen: results are measured on these routes.
    """

    seed: int = option(0, 0)
    traverse: int = option(0, 0, 9)
    frames: int = option(0, 0)
    height: int = option(64, 16, 512)
    width: int = option(128, 16, 1024)
    speed: float = option(17.0, 5, 40)
    noise: float = option(0.02, 0, 1)
    shake: float = option(1.0, 0, 3)

    route: ClassVar[float]  # metres

    def __post_init__(self) -> None:
        super().__post_init__()
        seen = f"sim:{self.kind} has height={self.height} and width={self.width}"
        expect(0.5 <= self.width / self.height <= 4, "a width of 0.5 to 4 times the height", seen)
        reference = self._ride(0)
        distance = self._ride(self.traverse) if self.traverse else reference
        expected = f"at most the {len(distance)} of its route"
        expect(self.frames <= len(distance), expected, f"sim:{self.kind} has frames={self.frames}")
        self.size = self.height, self.width
        self.length = self.frames or len(distance)
        self.distance = distance[: self.length]
        numbers = torch.arange(self.length).double()
        self.places = reference_place(reference, self.distance) if self.traverse else numbers
        self._step = distance.diff(append=distance[-1:])[: self.length] * EXPOSURE
        self._paths = self._wander(len(distance))
        view = View(*self.size)
        near = 1.05 * max(FOOT / float(view.up.min()), RIGHT / float(view.right.max()))  # margin 5 %
        corners = (LEFT, AHEAD), (RIGHT, AHEAD), (RIGHT, near), (LEFT, near)
        self.corners = tuple(view.project(x, FOOT, ahead) for x, ahead in corners)
        self.ground_span = AHEAD - near

    def _ride(self, traverse: int) -> Tensor:
        """The position of each frame of a traverse over the whole route, metres."""
        random, route = Random(self.kind, "ride", self.seed, traverse), self.route
        cruise = self.speed * (random.uniform(0.85, 1.2) if traverse else 1.0)
        slow = []
        for k in range(2):
            start = route * (k + random.uniform(0.2, 0.7)) / 2
            slow.append((start, start + random.uniform(60, 150), cruise * random.uniform(0.45, 0.7)))
        first = random.uniform(0.15, 0.4)
        stops = [(route * at, random.uniform(2.5, 5.0)) for at in (first, first + random.uniform(0.25, 0.5))]
        return ride(route, cruise, slow, stops[: 1 + traverse % 2])

    def _wander(self, frames: int) -> dict[str, Tensor]:
        """The camera's sway and the light's drift, each (N,) within [-1, 1]."""
        random = Random(self.kind, "camera", self.seed, self.traverse)
        paths = {name: random.wander(frames) for name in ("gain", "warm", "gamma")}
        i = torch.arange(frames, dtype=torch.float64)
        for name in ("aside", "lift", "pitch", "yaw", "roll"):
            quick = [torch.sin(i * random.uniform(0.1, 0.5) + random.uniform(0, 6.3)) for _ in range(3)]
            paths[name] = (random.wander(frames) + torch.stack(quick).mean(0)) / 2
        return paths

    @property
    def structures(self) -> tuple[Structure, ...]:
        return self._world.structures

    @property
    def end(self) -> float:
        return self.route + FAR  # metres: the last frame sees the scenery up to here

    @cached_property
    def _world(self) -> World:
        """The railway with this traverse's visitors."""
        random = Random(self.kind, self.seed)
        world = self._build(random)
        visitors = self._visitors(world, Random("visitors", self.seed, self.traverse))
        for thing in chain(self._things(world, random), visitors):
            world.sheets[thing.sheet].things.append(thing)
        return world

    @abstractmethod
    def _build(self, random: Random) -> World: ...  # without anything on its sheets

    @abstractmethod
    def _things(self, world: World, random: Random) -> Iterator[Thing]: ...  # in every traverse

    @abstractmethod
    def _visitors(self, world: World, random: Random) -> Iterator[Thing]: ...  # in this traverse only

    @abstractmethod
    def _light(self, world: World) -> Light: ...

    @abstractmethod
    def _sky(self, view: View, random: Random) -> Tensor: ...  # the background (3,P)

    @cached_property
    def _painter(self) -> Painter:
        """Draws frames with a margin for pitch, yaw and roll."""
        view = View(*self.size, margin=math.ceil(0.05 * max(self.size)))
        sky = self._sky(view, Random(self.kind, "light", self.seed, self.traverse))
        return Painter(view, list(self._world.sheets.values()), self._light(self._world), sky)

    def _frames(self, at: Tensor) -> Tensor:
        path = {name: curve[at] for name, curve in self._paths.items()}
        swing = self.shake * (1.0 if self.traverse else 0.5)
        sway = swing * torch.stack([0.06 * path["aside"], 0.04 * path["lift"]], 1)
        seen = self._rotated(self._painter.draw(self.distance[at], self._step[at], sway), swing, path)
        random = Random(self.kind, "looks", self.seed, self.traverse)
        looks = [random.pick(values) for values in ((0.72, 0.82, 1.18), (0.85, 1.18), (-0.09, 0.09))]
        gain, gamma, warm = looks if self.traverse else (1.0, 1.0, 0.0)
        warmth = warm + 0.02 * path["warm"]
        balance = torch.stack([1 + warmth, torch.ones_like(warmth), 1 - warmth], 1)
        balance = balance * (gain * (1 + 0.06 * path["gain"]))[:, None]
        seen = (seen * balance.float()[:, :, None, None]).clamp(0, 1)
        seen = seen ** (gamma + 0.03 * path["gamma"]).float()[:, None, None, None]
        for frame, i in zip(seen, at.tolist(), strict=True):
            frame += self.noise * Random(self.kind, "noise", self.seed, self.traverse, i).normal(*frame.shape)
        return seen.clamp_(0, 1)

    def _rotated(self, seen: Tensor, swing: float, path: dict[str, Tensor]) -> Tensor:
        """The frames without their margin, shifted by pitch and yaw and rotated by roll."""
        height, width = self.size
        roll = math.radians(0.5) * swing * path["roll"]
        reach = 0.012 * width * swing  # pixels
        c, s = roll.cos()[:, None, None], roll.sin()[:, None, None]
        down = (torch.arange(height).double() + 0.5 - height / 2)[:, None]
        across = torch.arange(width).double() + 0.5 - width / 2
        x = c * across - s * down + (reach * path["yaw"])[:, None, None]
        y = s * across + c * down + (0.7 * reach * path["pitch"])[:, None, None]
        grid = torch.stack([2 * x / seen.shape[3], 2 * y / seen.shape[2]], -1).float()
        return F.grid_sample(seen, grid, padding_mode="border", align_corners=False)


def ride(
    route: float, cruise: float, slow: Sequence[tuple[float, ...]], stops: Sequence[tuple[float, ...]]
) -> Tensor:
    """The position of a train at each frame from one end of a route to the other, (N,) float64 metres.

    Args:
        route: metres. cruise: m/s. slow: (start, stop, m/s) of each slow section.
        stops: (metres, seconds) of each full stop, in order.
    """
    s = np.arange(round(route / GRAIN) + 1) * GRAIN
    square = np.full(len(s), cruise**2)  # of the speed: linear in s under constant acceleration
    for start, stop, speed in slow:
        square[(s >= start) & (s <= stop)] = speed**2
    nodes = np.arange(len(s))
    halts = [round(place / GRAIN) for place, _ in stops]
    square[[0, *halts]] = 0
    gain = 2 * ACCELERATION * GRAIN
    square = np.minimum.accumulate(square - gain * nodes) + gain * nodes
    square = np.minimum.accumulate((square - gain * nodes[::-1])[::-1])[::-1] + gain * nodes[::-1]
    speed = np.sqrt(square)
    clock = np.concatenate([[0.0], np.cumsum(2 * GRAIN / (speed[1:] + speed[:-1]))])
    for halt, (_, seconds) in reversed(list(zip(halts, stops, strict=True))):
        clock = np.concatenate([clock[: halt + 1], clock[halt:] + seconds])
        s = np.concatenate([s[: halt + 1], s[halt:]])
    return torch.from_numpy(np.interp(np.arange(0, clock[-1], 1 / FPS), clock, s))


def reference_place(reference: Tensor, distance: Tensor) -> Tensor:
    """The interpolated reference frame at each distance; for a stop, its first frame.

    Shape: metres of the reference frames (N,), never decreasing, and distance (Q,) -> (Q,) float64.
    """
    after = torch.searchsorted(reference, distance.contiguous()).clamp(1, len(reference) - 1)
    low, high = reference[after - 1], reference[after]
    part = (distance - low) / (high - low)
    return torch.where(distance <= reference[0], 0.0, after - 1 + part.clamp(max=1)).double()
