"""A train ride outdoors and one underground: two built-in routes with known truth.

All traverses of a seed meet the same railway; `structures` tells what repeats along it, with which
period, and where it starts and stops.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dejavu_torch.data.simulate.draw import Light
from dejavu_torch.data.simulate.outdoor import outdoor_visitors, outdoor_world
from dejavu_torch.data.simulate.paint import Random
from dejavu_torch.data.simulate.scenery import World
from dejavu_torch.data.simulate.sheets import FAR, View
from dejavu_torch.data.simulate.train import Railway
from dejavu_torch.data.simulate.underground import ambient_light, underground_visitors, underground_world


@dataclass(eq=False)
class Outdoor(Railway):
    """A train ride in the open along 2 km of double track: `sim:outdoor`.

    Sleepers every 0.6 m; overhead-line masts every 50 to 60 m, fence posts every 2.4 to 4 m, cable lids
    every 9 to 16 m, each period constant within a stretch; platform lamps every 15 m. Vegetation,
    houses, signals, crossings and stations are found once. At 25 frames per second the reference moves
    about 0.49 m per frame on average (seed 0: 4195 frames).

    Metres right of the camera's track: the other track 4, signals 6.6, fence 7.4, bushes -7.8 and 8.2, trees
    -11 and 12.5, houses -26 and 30. Two or three platforms of 150 m from -1.65 to -7, 0.9 above the rails;
    masts at -3.4, 7 high.

    Args:
        seed: chooses the railway, at least 0.
        traverse: chooses the ride, 0 to 9; 0 is the reference. Each has its own speeds and stops,
            light, sway, people and trains.
        frames: number of frames from the start; 0 for the whole route.
        height, width: of a frame in pixels, 16 to 512 and 16 to 1024; half to 4 times as wide as high.
        speed: metres per second at which the reference cruises, 5 to 40; other rides, at 0.85 to 1.2 of it.
        noise: standard deviation of the sensor noise, on the scale where white is 1.
        shake: how much the camera sways, 0 to 3; 1 moves it up to 6 cm aside and 0.5 degrees in roll, the
            reference's half as much.

    Convention: camera, attributes and errors as `Railway`. All of these figures are frozen: results are
        judged on this route.

    Example:
        >>> Outdoor(traverse=1, frames=40).distance[-1].item() < 2000
        True
    """

    kind = "outdoor"
    route = 2000.0
    speed: float = 17.0

    @cached_property
    def _world(self) -> World:
        world = outdoor_world(self.seed, self.route)
        sunny = self.traverse % 2 == 1
        outdoor_visitors(world, Random("visitors", self.seed, self.traverse), self.route, sunny)
        return world

    def _light(self, world: World, random: Random) -> Light:
        haze = torch.tensor([0.80, 0.84, 0.88])[:, None]
        return Light(0.0, 1.0, torch.full((round(self.route + 2 * FAR),), 1.0), haze, 350.0)

    def _sky(self, view: View, random: Random) -> Tensor:
        height = (view.up / view.up.max()).clamp(0, 1) ** 0.7
        low, high = torch.tensor([0.86, 0.89, 0.92])[:, None], torch.tensor([0.45, 0.62, 0.85])[:, None]
        clouds = random.texture(*view.shape, view.shape[1] / 4).flatten().clamp(-1, 1.5)
        blue = low + height * (high - low)
        return (blue + 0.10 * clouds * height * (0.95 - blue).sign()).clamp(0, 1)


@dataclass(eq=False)
class Underground(Railway):
    """A train ride through 4 km of tunnel with four stations: `sim:underground`.

    Sleepers every 0.75 m; stretches of lamps every 10 to 18 m, ribs every 4.5 to 8 m, panel joints every
    2.4 to 3.6 m, cable brackets every 1.5 to 2.5 m and niches every 22 to 38 m, each period constant
    within a stretch that starts and stops anywhere; in stations lights every 6 m and columns every 12 m.
    Signs, cabinets, signals, cross passages and stains are found once. At 25 frames per second the
    reference moves about 0.73 m per frame on average (seed 0: 5313 frames).

    The tunnel is 5 m wide, its walls 3.4 m high and its crown 4.7 m above the track bed. Stations are 150 m
    long, with a platform from 1.6 to 7.5 m left of the camera, 1 m above the rails, under a ceiling 5.6 m
    above them.

    Args:
        seed: chooses the railway, at least 0.
        traverse: chooses the ride, 0 to 9; 0 is the reference. Each has its own speeds and stops,
            light, sway and people.
        frames: number of frames from the start; 0 for the whole route.
        height, width: of a frame in pixels, 16 to 512 and 16 to 1024; half to 4 times as wide as high.
        speed: metres per second at which the reference cruises, 5 to 40; other rides, at 0.85 to 1.2 of it.
        noise: standard deviation of the sensor noise, on the scale where white is 1.
        shake: how much the camera sways, 0 to 3; 1 moves it up to 6 cm aside and 0.5 degrees in roll, the
            reference's half as much.

    Convention: camera, attributes and errors as `Railway`. All of these figures are frozen: results are
        judged on this route.

    Example:
        >>> Underground(traverse=1, frames=40).distance[-1].item() < 4000
        True
    """

    kind = "underground"
    route = 4000.0
    speed: float = 25.0

    @cached_property
    def _world(self) -> World:
        world = underground_world(self.seed, self.route)
        underground_visitors(world, Random("visitors", self.seed, self.traverse), self.route)
        return world

    def _light(self, world: World, random: Random) -> Light:
        lamp, tunnel, station = (0.7, 0.22, 0.42) if self.traverse == 0 else (0.55, 0.34, 0.5)
        ambient = ambient_light(world, self.route, tunnel, station)
        return Light(lamp, 16.0, ambient, torch.full((3, 1), 0.03), 90.0)

    def _sky(self, view: View, random: Random) -> Tensor:
        return torch.full((3, len(view.up)), 0.03)
