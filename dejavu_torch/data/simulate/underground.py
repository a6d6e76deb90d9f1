"""An underground railway: an arched tunnel with its fittings, and wide bright stations."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dejavu_torch.data.simulate import scenery
from dejavu_torch.data.simulate.route import Random, option
from dejavu_torch.data.simulate.scenery import FOOT, RAIL, STATION, Structure, World
from dejavu_torch.data.simulate.sheets import FAR, Light, Point, Sheet, Thing, View
from dejavu_torch.data.simulate.train import Railway

HALF = 2.5  # metres from the centre to the wall
SPRING, CROWN, FLAT = 0.8, 2.1, 1.1  # heights of the foot and top of the arch; half its flat top
EDGE, STEP, BACK = -1.6, RAIL + 1.0, -7.5  # a platform's edge, height and back wall
ROOF = 3.2  # height of a station's ceiling
CELL = (0.12, 0.25)  # metres of a texture cell across and along
LINING = ("ceiling", "wall left", "arch left", "wall right", "arch right")


@dataclass(eq=False)
class Underground(Railway):
    """A train ride through 4 km of tunnel with four stations: `sim:underground`.

    Sleepers every 0.75 m; lamps every 10 to 18 m, ribs every 4.5 to 8 m, panel joints every 2.4 to 3.6 m,
    cable brackets every 1.5 to 2.5 m and niches every 22 to 38 m, each with a constant period per segment;
    in stations lights every 6 m and columns every 12 m. Signs, cabinets, signals, cross passages and stains
    do not repeat. The reference moves 0.73 m per frame on average (seed 0: 5313 frames).

    The tunnel is 5 m wide, its walls 3.4 m high and its crown 4.7 m above the track bed. Stations are 150 m
    long, with a platform from 1.6 to 7.5 m left of the camera, 1 m above the rails, under a ceiling 5.6 m
    above them.

    Args: as for `Railway`; the reference cruises at 25 m/s.
    """

    kind = "underground"
    route = 4000.0
    speed: float = option(25.0, 5, 40)

    def _build(self, random: Random) -> World:
        stations = tuple(round(self.route * (k + random.uniform(0.3, 0.7)) / 4, 2) for k in range(4))
        sheets = _sheets(random, self.end, stations)
        structures = [Structure("sleeper", 0.75, 0.0, self.end)]
        for name, *ranges in (
            ("lamp", (10, 18), (350, 800), (20, 90)),
            ("rib", (4.5, 8.0), (180, 450), (60, 250)),
            ("panel", (2.4, 3.6), (200, 500), (50, 200)),
            ("bracket", (1.5, 2.5), (200, 600), (50, 250)),
            ("niche", (22, 38), (300, 700), (50, 250)),
        ):
            for segment in scenery.periodic_segments(random, name, self.route, *ranges):
                structures += _between_stations(segment, stations)
        for start in stations:
            structures.append(Structure("station light", 6.0, start, round(start + STATION, 2)))
            structures.append(Structure("column", 12.0, round(start + 5, 2), round(start + STATION - 3, 2)))
        return World(sheets, tuple(structures), stations)

    def _things(self, world: World, random: Random) -> Iterator[Thing]:
        sizes = {name: sheet.size for name, sheet in world.sheets.items()}
        for structure in world.structures:
            yield from _pieces(structure, random, sizes, self.route)
        for y in (1.85, 2.15, 2.55):  # cables, and a walkway
            yield Thing("wall right", y, y + 0.09, "242426", -FAR, self.route + 3 * FAR, 0.08)
        yield Thing("wall left", 0.95, 1.1, "b9b4a6", -FAR, self.route + 3 * FAR, 0.1)
        for wall in ("wall left", "wall right"):
            for colour, gap in (("e8e6da", (70, 260)), ("d9a520", (120, 420)), ("2a5aa8", (120, 420))):
                at = world.away(random.scattered(15, self.end, gap), 3)  # signs
                low = random.uniform(1.2, 2.2)
                yield Thing(wall, low, low + 0.55, colour, at, random.uniform(0.5, 1.4), 0.08)
            at = world.away(random.scattered(30, self.end, (60, 320)), 3)  # cabinets
            yield Thing(wall, 0.1, 1.5, random.pick(("4d5a52", "8f8a80")), at, 1.8, 0.3)
            at = world.away(random.scattered(90, self.end, (180, 380)), 8)  # cross passages
            yield Thing(wall, 0.4, 3.1, "f0eee6", at - 0.3, 3.2)
            yield Thing(wall, 0.4, 2.9, "0b0b0c", at, 2.6)
            yield Thing(wall, 3.05, 3.3, "48e07a", at + 0.5, 1.6, lit=True)
            at = world.away(random.scattered(150, self.end, (250, 600)), 8)  # signals
            yield Thing(wall, 2.2, 3.0, "111214", at, 0.3, 0.35)
            yield Thing(wall, 2.65, 2.9, random.pick(("ff4030", "50ff80")), at, 0.25, 0.3, lit=True)
        for start in world.stations:
            yield from _station(start, random, sizes)

    def _visitors(self, world: World, random: Random) -> Iterator[Thing]:
        yield from scenery.people(world, random, 3, 0.0, 1.45)
        for wall in ("wall left", "wall right"):  # tools
            yield Thing(wall, 0, 0.9, "c8641e", random.scattered(60, self.route, (250, 700)), 1.2, 0.35)

    def _light(self, world: World) -> Light:
        """A headlight, and ambient light that is brighter in stations."""
        lamp, tunnel, station = (0.55, 0.34, 0.5) if self.traverse else (0.7, 0.22, 0.42)
        s = torch.arange(round(self.route + 2 * FAR), dtype=torch.float32)
        ambient = torch.full_like(s, tunnel)
        for start in world.stations:
            ramp = torch.minimum((s - start + 2) / 4, (start + STATION + 2 - s) / 4).clamp(0, 1)
            ambient = torch.maximum(ambient, tunnel + (station - tunnel) * ramp)
        return Light(lamp, 16.0, ambient, torch.full((3, 1), 0.03), 90.0)

    def _sky(self, view: View, random: Random) -> Tensor:
        return torch.full((3, len(view.up)), 0.03)


def _between_stations(whole: Structure, stations: tuple[float, ...]) -> Iterator[Structure]:
    """The parts of a segment between stations that are at least 4 periods long."""
    start = whole.start
    for station in (*stations, whole.stop + STATION):
        stop = min(station, whole.stop)
        if stop - start >= 4 * whole.period:
            yield whole._replace(start=start, stop=stop)
        start = max(start, round(station + STATION, 2))


def _pieces(structure: Structure, random: Random, sizes: dict[str, float], route: float) -> Iterator[Thing]:
    at, name = structure.at, structure.name
    if name == "sleeper":
        yield Thing("floor", HALF - 1.3, HALF + 1.3, "a19b90", at, 0.3)
        yield from scenery.rails("floor", HALF, route)
    elif name == "lamp":
        sheet = random.pick(("ceiling", "arch left", "arch right"))
        glow = random.pick(("ffe7b0", "dff0ff", "fff8e0"))
        middle = 0.5 * sizes[sheet]
        yield Thing(sheet, 0, sizes[sheet], glow, at - 0.6, 2.4, opacity=0.22, lit=True)
        yield Thing(sheet, middle - 0.17, middle + 0.17, glow, at, 1.2, 0.12, lit=True)
    elif name == "rib":
        colour, depth = random.pick(("57534d", "b0aaa0", "7a4f3a")), random.uniform(0.12, 0.25)
        for sheet in LINING:
            yield Thing(sheet, 0, sizes[sheet], colour, at, 0.35, depth)
    elif name == "panel":
        for wall in ("wall left", "wall right"):
            yield Thing(wall, 0.6, sizes[wall] - 0.4, random.pick(("3d3b38", "c9c4ba")), at, 0.14)
    elif name == "bracket":
        yield Thing("wall right", 1.7, 2.75, "37393c", at, 0.1, 0.1)
    elif name == "niche":
        wall = random.pick(("wall left", "wall right"))
        yield Thing(wall, 0.9, 2.7, "181715", at, 1.3)
        yield Thing(wall, 2.75, 3.0, "d8d3c6", at, 1.3)
    elif name == "station light":
        yield Thing("roof", 2.6, 3.0, "fffbe8", at, 4.6, lit=True)
        yield Thing("roof", 7.0, 7.3, "fffbe8", at, 4.6, lit=True)
    elif name == "column":
        colour = random.pick(("c8c4ba", "7c8c9c", "b58a4a"))
        yield Thing("people", 0, sizes["people"], colour, at, 0.6, 0.6)


def _station(start: float, random: Random, sizes: dict[str, float]) -> Iterator[Thing]:
    """A platform on the left, tiled walls and signs, in the station's own colours."""
    tile = random.pick(("d9dcd6", "9fb8c4", "d6c79a", "a8c09a", "c9a294"))
    band = random.pick(("1c3f94", "b3261e", "186b3a", "d08a1e", "3a3a40"))
    floor = random.pick(("a8a49c", "8d8680", "bdb4a4"))
    for sheet, low, high, colour in (
        ("edge", 0, 1.2, "77746e"),
        ("edge", 1.1, 1.2, "f0ede2"),
        ("platform", 0, sizes["platform"], floor),
        ("platform back", 0, sizes["platform back"], floor),
        ("platform", 0.1, 0.5, "e8c53a"),
        ("back", 0, sizes["back"], tile),
        ("back", 2.6, 3.2, band),
        ("roof", 0, sizes["roof"], "b9b8b2"),
        ("wall right", 1.2, sizes["wall right"], tile),
        ("tiles", 0, sizes["tiles"], tile),
        ("wall right", 2.3, 2.9, band),
    ):
        yield Thing(sheet, low, high, colour, start, STATION)
    for sheet, low in (("back", 0.8), ("wall right", 1.4)):  # posters
        for colour in ("b8452e", "2f6f9a", "e3d27a"):
            at = random.scattered(start + 2, start + STATION - 12, (14, 50))
            yield Thing(sheet, low, low + 1.5, colour, at, random.uniform(1.5, 3.5))
    at = random.scattered(start + 3, start + STATION - 20, (20, 45))
    yield Thing("signs", 0.4, 3.0, band, at, 0.15, 0.5)


def _sheets(random: Random, end: float, stations: tuple[float, ...]) -> dict[str, Sheet]:
    """The cross-section, nearest first; in stations the lining is open on the left and above."""
    columns = round(end / CELL[1])
    s = (torch.arange(columns) + 0.5) * CELL[1]
    tunnel = torch.stack([(s < start) | (s >= start + STATION) for start in stations]).all(0)

    def surface(size: float, colour: str, rough: float, patchy: float) -> Tensor:
        return scenery.solid(scenery.mottled(random, colour, round(size / CELL[0]), columns, rough, patchy))

    def lining(a: Point, b: Point, cover: Tensor | float) -> Sheet:
        return Sheet(a, b, _concrete(random, round(math.dist(a, b) / CELL[0]), columns) * cover, CELL)

    return {
        "edge": Sheet((EDGE, FOOT), (EDGE, STEP)),
        "platform": Sheet((EDGE, STEP), (-HALF, STEP)),
        "floor": Sheet((-HALF, FOOT), (HALF, FOOT), surface(2 * HALF, "5f5a54", 0.16, 0.10), CELL),
        "ceiling": lining((-FLAT, CROWN), (FLAT, CROWN), tunnel),
        "wall left": lining((-HALF, FOOT), (-HALF, SPRING), tunnel),
        "arch left": lining((-HALF, SPRING), (-FLAT, CROWN), tunnel),
        "wall right": lining((HALF, FOOT), (HALF, SPRING), 1.0),
        "arch right": lining((HALF, SPRING), (FLAT, CROWN), tunnel),
        "tiles": Sheet((HALF, SPRING - 0.3), (HALF, ROOF)),  # behind the wall's upper edge
        "people": Sheet((-5.0, STEP), (-5.0, ROOF)),
        "signs": Sheet((-5.0, 1.6), (-1.7, 1.6)),
        "platform back": Sheet((-HALF, STEP), (BACK, STEP)),
        # a dark face closes the station at its ends
        "back": Sheet((BACK, STEP), (BACK, ROOF), surface(ROOF - STEP, "4e4c49", 0.04, 0.08), CELL),
        "roof": Sheet((BACK, ROOF), (HALF, ROOF), surface(HALF - BACK, "4e4c49", 0.04, 0.08), CELL),
    }


def _concrete(random: Random, rows: int, columns: int) -> Tensor:
    """The tunnel's lining with vertical stains, (4,V,S)."""
    image = scenery.mottled(random, "8b8780", rows, columns, 0.05, 0.10)
    streaks = random.texture(1, columns, 6.0) + 0.4 * random.texture(rows, columns, 10.0)
    damp = (random.texture(1, columns, 160.0) - 0.2).clamp(0, 1)
    image = image * (1 - 0.5 * ((streaks - 0.8).clamp(0, 1) * damp))
    return scenery.solid(image * (1 + 0.22 * random.texture(1, columns, 300.0).clamp(-2, 2)))
