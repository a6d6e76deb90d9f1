"""The railway in a tunnel: an arched lining with what hangs on it, and wide bright stations."""

from __future__ import annotations

import torch
from torch import Tensor

from dejavu_torch.data.simulate.paint import Random
from dejavu_torch.data.simulate.scenery import (
    FOOT,
    RAIL,
    STATION,
    Structure,
    World,
    concrete,
    mottled,
    rails,
    scattered,
    solid,
    stretches,
    waiting,
)
from dejavu_torch.data.simulate.sheets import FAR, Sheet, Thing

HALF = 2.5  # metres from the middle to the wall
SPRING, CROWN, FLAT = 0.8, 2.1, 1.1  # heights where the arch begins and ends; half its flat top
EDGE, STEP, BACK = -1.6, RAIL + 1.0, -7.5  # a platform's edge, height and back wall
ROOF = 3.2  # height of a station's ceiling
CELL = (0.12, 0.25)


def _lining() -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    """The tunnel's cross-section, each part from its lower or left edge to the other."""
    parts = {"floor": ((-HALF, FOOT), (HALF, FOOT)), "ceiling": ((-FLAT, CROWN), (FLAT, CROWN))}
    for side, sign in (("left", -1), ("right", 1)):
        parts[f"wall {side}"] = ((sign * HALF, FOOT), (sign * HALF, SPRING))
        parts[f"arch {side}"] = ((sign * HALF, SPRING), (sign * FLAT, CROWN))
    return parts


def underground_world(seed: int, route: float) -> World:
    """Everything that both traverses of a seed meet."""
    random, end = Random("underground", seed), route + FAR
    stations = tuple(round(route * (k + random.uniform(0.3, 0.7)) / 4, 2) for k in range(4))
    columns = round(end / CELL[1])
    s = (torch.arange(columns) + 0.5) * CELL[1]
    inside = torch.stack([(s >= start) & (s < start + STATION) for start in stations]).any(0)
    sheets: dict[str, Sheet] = {}
    sheets["edge"] = Sheet((EDGE, FOOT), (EDGE, STEP))
    sheets["platform"] = Sheet((EDGE, STEP), (-HALF, STEP))
    for name, (a, b) in _lining().items():
        sheet = Sheet(a, b, cell=CELL)
        if name == "floor":
            rows = round(sheet.size / CELL[0])
            sheet.texture = solid(mottled(random, "5f5a54", rows, columns, 0.16, 0.10))
        else:
            sheet.texture = concrete(random, sheet.size, columns, CELL, "8b8780")
            if name != "wall right":  # a station is open above the track and to the left
                sheet.texture *= ~inside
        sheets[name] = sheet
    sheets["tiles"] = Sheet((HALF, SPRING - 0.3), (HALF, ROOF))  # behind the wall's upper edge
    sheets["people"] = Sheet((-5.0, STEP), (-5.0, ROOF))
    sheets["signs"] = Sheet((-5.0, 1.6), (-1.7, 1.6))
    sheets["platform back"] = Sheet((-HALF, STEP), (BACK, STEP))
    sheets["back"] = Sheet((BACK, STEP), (BACK, ROOF), _portal(random, ROOF - STEP, columns), CELL)
    sheets["roof"] = Sheet((BACK, ROOF), (HALF, ROOF), _portal(random, HALF - BACK, columns), CELL)

    structures = [Structure("sleeper", 0.75, 0.0, end)]
    for name, period, length, gap in (
        ("lamp", (10, 18), (350, 800), (20, 90)),
        ("rib", (4.5, 8.0), (180, 450), (60, 250)),
        ("panel", (2.4, 3.6), (200, 500), (50, 200)),
        ("bracket", (1.5, 2.5), (200, 600), (50, 250)),
        ("niche", (22, 38), (300, 700), (50, 250)),
    ):
        for found in stretches(random, name, route, period, length, gap):
            structures += _between_stations(found, stations)
    for start in stations:
        structures.append(Structure("station light", 6.0, start, round(start + STATION, 2)))
        structures.append(Structure("column", 12.0, round(start + 5, 2), round(start + STATION - 3, 2)))
    rails(sheets["floor"], [0.0], route, -HALF)
    for structure in structures:
        _build(sheets, structure, random)
    _fittings(sheets, random, route, stations)
    for start in stations:
        _station(sheets, start, random)
    return World(sheets, tuple(structures), stations)


def _portal(random: Random, size: float, columns: int) -> Tensor:
    """The dark face that closes a station where the tunnel goes on."""
    return solid(mottled(random, "4e4c49", round(size / CELL[0]), columns, 0.04, 0.08))


def _between_stations(whole: Structure, stations: tuple[float, ...]) -> list[Structure]:
    """The parts of a stretch that lie in the tunnel, each long enough to repeat."""
    parts, start = [], whole.start
    for station in (*stations, whole.stop + STATION):
        stop = min(station, whole.stop)
        if stop - start >= 4 * whole.period:
            parts.append(whole._replace(start=start, stop=stop))
        start = max(start, round(station + STATION, 2))
    return parts


def _build(sheets: dict[str, Sheet], structure: Structure, random: Random) -> None:
    """Stand a structure's pieces on their sheets."""
    at, name = structure.at, structure.name
    if name == "sleeper":
        sheets["floor"].things.insert(0, Thing(HALF - 1.3, HALF + 1.3, "a19b90", at, 0.3))
    elif name == "lamp":
        where = random.pick(("ceiling", "arch left", "arch right"))
        glow = random.pick(("ffe7b0", "dff0ff", "fff8e0"))
        middle = 0.5 * sheets[where].size
        sheets[where].add(
            Thing(0, sheets[where].size, glow, at - 0.6, 2.4, opacity=0.22, lit=True),
            Thing(middle - 0.17, middle + 0.17, glow, at, 1.2, 0.12, lit=True),
        )
    elif name == "rib":
        colour, depth = random.pick(("57534d", "b0aaa0", "7a4f3a")), random.uniform(0.12, 0.25)
        for part, sheet in sheets.items():
            if part.startswith(("wall", "arch", "ceiling")):
                sheet.add(Thing(0, sheet.size, colour, at, 0.35, depth))
    elif name == "panel":
        for side in ("left", "right"):
            sheet, joint = sheets[f"wall {side}"], random.pick(("3d3b38", "c9c4ba"))
            sheet.add(Thing(0.6, sheet.size - 0.4, joint, at, 0.14))
    elif name == "bracket":
        sheets["wall right"].add(Thing(1.7, 2.75, "37393c", at, 0.1, 0.1))
    elif name == "niche":
        wall = sheets[random.pick(("wall left", "wall right"))]
        wall.add(Thing(0.9, 2.7, "181715", at, 1.3), Thing(2.75, 3.0, "d8d3c6", at, 1.3))
    elif name == "station light":
        sheets["roof"].add(
            Thing(2.6, 3.0, "fffbe8", at, 4.6, lit=True), Thing(7.0, 7.3, "fffbe8", at, 4.6, lit=True)
        )
    elif name == "column":
        colour = random.pick(("c8c4ba", "7c8c9c", "b58a4a"))
        sheets["people"].add(Thing(0, sheets["people"].size, colour, at, 0.6, 0.6))


def _fittings(sheets: dict[str, Sheet], random: Random, route: float, stations: tuple[float, ...]) -> None:
    """Cables and a walkway that never end, and signs, cabinets, signals and cross passages now and then."""
    whole, length = torch.tensor([-FAR]), route + 3 * FAR
    for y in (1.85, 2.15, 2.55):
        sheets["wall right"].add(Thing(y, y + 0.09, "242426", whole, length, 0.08))
    sheets["wall left"].add(Thing(0.95, 1.1, "b9b4a6", whole, length, 0.1))
    end = route + FAR

    def away(at: Tensor, size: float) -> Tensor:
        clear = [not any(x - size < p < x + STATION + size for x in stations) for p in at.tolist()]
        return at[torch.tensor(clear)]

    for side in ("left", "right"):
        wall = sheets[f"wall {side}"]
        for colour, gap in (("e8e6da", (70, 260)), ("d9a520", (120, 420)), ("2a5aa8", (120, 420))):
            at = away(scattered(random, 15, end, gap), 3)
            low = random.uniform(1.2, 2.2)
            wall.add(Thing(low, low + 0.55, colour, at, random.uniform(0.5, 1.4), 0.08))
        at = away(scattered(random, 30, end, (60, 320)), 3)
        wall.add(Thing(0.1, 1.5, random.pick(("4d5a52", "8f8a80")), at, 1.8, 0.3))
        at = away(scattered(random, 90, end, (180, 380)), 8)
        wall.add(
            Thing(0.4, 3.1, "f0eee6", at - 0.3, 3.2),
            Thing(0.4, 2.9, "0b0b0c", at, 2.6),
            Thing(3.05, 3.3, "48e07a", at + 0.5, 1.6, lit=True),
        )
        at = away(scattered(random, 150, end, (250, 600)), 8)
        wall.add(Thing(2.2, 3.0, "111214", at, 0.3, 0.35))
        wall.add(Thing(2.65, 2.9, random.pick(("ff4030", "50ff80")), at, 0.25, 0.3, lit=True))


def _station(sheets: dict[str, Sheet], start: float, random: Random) -> None:
    """A platform on the left under a high ceiling, tiled walls and signs; every station has its colours."""
    one, size = torch.tensor([start]).double(), STATION
    tile = random.pick(("d9dcd6", "9fb8c4", "d6c79a", "a8c09a", "c9a294"))
    band = random.pick(("1c3f94", "b3261e", "186b3a", "d08a1e", "3a3a40"))
    floor = random.pick(("a8a49c", "8d8680", "bdb4a4"))
    back, right = sheets["back"], sheets["wall right"]
    sheets["edge"].add(Thing(0, 1.2, "77746e", one, size), Thing(1.1, 1.2, "f0ede2", one, size))
    for name in ("platform", "platform back"):
        sheets[name].add(Thing(0, sheets[name].size, floor, one, size))
    sheets["platform"].add(Thing(0.1, 0.5, "e8c53a", one, size))
    back.add(Thing(0, back.size, tile, one, size), Thing(2.6, 3.2, band, one, size))
    sheets["roof"].add(Thing(0, sheets["roof"].size, "b9b8b2", one, size))
    for sheet, low in ((right, 1.2), (sheets["tiles"], 0.0)):
        sheet.add(Thing(low, sheet.size, tile, one, size))
    right.add(Thing(2.3, 2.9, band, one, size))
    for sheet, low in ((back, 0.8), (right, 1.4)):
        for colour in ("b8452e", "2f6f9a", "e3d27a"):
            at = scattered(random, start + 2, start + size - 12, (14, 50))
            sheet.add(Thing(low, low + 1.5, colour, at, random.uniform(1.5, 3.5)))
    at = scattered(random, start + 3, start + size - 20, (20, 45))
    sheets["signs"].add(Thing(0.4, 3.0, band, at, 0.15, 0.5))


def underground_visitors(world: World, random: Random, route: float) -> None:
    """What one traverse alone meets: people who wait, tools left at the wall."""
    waiting(world, random, 3, 0.0, 1.45)
    for side in ("left", "right"):
        at = scattered(random, 60, route, (250, 700))
        world.sheets[f"wall {side}"].add(Thing(0, 0.9, "c8641e", at, 1.2, 0.35))


def ambient_light(world: World, route: float, tunnel: float, station: float) -> Tensor:
    """Light along the track, one value per metre, that rises where a station begins, (S,)."""
    s = torch.arange(round(route + 2 * FAR), dtype=torch.float32)
    light = torch.full_like(s, tunnel)
    for start in world.stations:
        ramp = torch.minimum((s - start + 2) / 4, (start + STATION + 2 - s) / 4).clamp(0, 1)
        light = torch.maximum(light, tunnel + (station - tunnel) * ramp)
    return light
