"""The railway in the open: masts, fences, vegetation, houses and stations along two tracks."""

from __future__ import annotations

import torch

from dejavu_torch.data.simulate.paint import Random
from dejavu_torch.data.simulate.scenery import (
    FOOT,
    RAIL,
    STATION,
    Structure,
    World,
    ground,
    growth,
    houses,
    mottled,
    rails,
    scattered,
    solid,
    stretches,
    waiting,
)
from dejavu_torch.data.simulate.sheets import FAR, Sheet, Thing

TRACKS = [0.0, 4.0]
HALF = 13.0  # metres of fine ground on either side


def _side(x: float, height: float) -> tuple[tuple[float, float], tuple[float, float]]:
    return (x, FOOT), (x, FOOT + height)


def outdoor_world(seed: int, route: float) -> World:
    """Everything that both traverses of a seed meet."""
    random, end = Random("outdoor", seed), route + FAR
    stations = tuple(route * (k + random.uniform(0.3, 0.6)) / 3 for k in range(3))[1 if seed % 2 else 0 :]
    sheets: dict[str, Sheet] = {}

    def textured(
        x: float, height: float, cell: tuple[float, float], leaves: tuple[str, str], gaps: float
    ) -> Sheet:
        return Sheet(
            *_side(x, height), growth(random, round(end / cell[1]), height, cell, leaves, gaps), cell
        )

    # nearest first
    sheets["wires"] = Sheet((-3.4, 3.3), (4.6, 3.3))
    sheets["edge"] = Sheet((-1.65, FOOT), (-1.65, RAIL + 0.9))
    sheets["platform"] = Sheet((-1.65, RAIL + 0.9), (-3.4, RAIL + 0.9))
    sheets["masts"] = Sheet(*_side(-3.4, 7.2))
    sheets["people"] = Sheet(*_side(-5.2, 4.5))
    sheets["platform back"] = Sheet((-3.4, RAIL + 0.9), (-7.0, RAIL + 0.9))
    sheets["shelter"] = Sheet(*_side(-7.0, 5.0))
    sheets["train"] = Sheet(*_side(5.5, 4.2))
    sheets["signals"] = Sheet(*_side(6.6, 6.0))
    sheets["fence"] = Sheet(*_side(7.4, 2.2))
    sheets["bushes left"] = textured(-7.8, 3.2, (0.1, 0.2), ("4c6b2a", "7a7a38"), 0.45)
    sheets["bushes right"] = textured(8.2, 2.8, (0.1, 0.2), ("3f6130", "8a7a3a"), 0.5)
    sheets["trees left"] = textured(-11.0, 9.5, (0.16, 0.3), ("2f5426", "58702f"), 0.5)
    sheets["trees right"] = textured(12.5, 10.5, (0.16, 0.3), ("2a4a2a", "6a7434"), 0.5)
    cell = (0.1, 0.2)
    soil = ground(random, round(end / cell[1]), HALF, cell, TRACKS)
    sheets["ground"] = Sheet((-HALF, FOOT), (HALF, FOOT), soil, cell)
    for side, x in (("left", -26.0), ("right", 30.0)):
        far = textured(x, 13.0, (0.3, 0.5), ("35543a", "4d6140"), 0.55)
        assert far.texture is not None
        houses(random, far.texture, far.cell, scattered(random, 0, end, (25, 140)))
        sheets[f"far {side}"] = far
    cell = (0.6, 1.0)
    fields = mottled(random, "8a8f4a", round(160 / cell[0]), round(end / cell[1]), 0.06, 0.22)
    sheets["fields"] = Sheet((-80, FOOT), (80, FOOT), solid(fields), cell)

    structures = [Structure("sleeper", 0.6, 0.0, end)]
    structures += stretches(random, "mast", route, (50, 60), (350, 700), (20, 60))
    structures += stretches(random, "fence post", route, (2.4, 4.0), (150, 400), (40, 160))
    structures += stretches(random, "cable lid", route, (9, 16), (200, 500), (60, 200))
    for start in stations:
        structures.append(Structure("platform lamp", 15.0, start + 6, start + STATION))
    structures = [s._replace(start=round(s.start, 2), stop=round(s.stop, 2)) for s in structures]
    rails(sheets["ground"], TRACKS, route, -HALF)
    for structure in structures:
        _build(sheets, structure, random)
    whole, length = torch.tensor([-FAR]), route + 3 * FAR
    for x in TRACKS:
        sheets["wires"].add(Thing(x + 3.4 - 0.025, x + 3.4 + 0.025, "2a2d33", whole, length))
    for start in stations:
        _station(sheets, start, random)
    _waymarks(sheets, random, end, stations)
    return World(sheets, tuple(structures), stations)


def _build(sheets: dict[str, Sheet], structure: Structure, random: Random) -> None:
    """Stand a structure's pieces on their sheets."""
    at, name = structure.at, structure.name
    if name == "sleeper":
        for x in TRACKS:
            low = x + HALF - 1.3
            sheets["ground"].things.insert(0, Thing(low, low + 2.6, "b5aea2", at, 0.26))
    elif name == "mast":
        colour = random.pick(("5f6a66", "4a4640", "7d8288"))
        sheets["masts"].add(Thing(0, 7.0, colour, at, 0.3, 0.3))
        sheets["wires"].add(Thing(0, 3.6, colour, at, 0.12, 0.14))
    elif name == "fence post":
        colour = random.pick(("d9d6cd", "6b5138", "8f969c"))
        sheets["fence"].add(Thing(0, 1.7, colour, at, 0.12, 0.12))
        span = torch.tensor([structure.start])
        for y in (0.7, 1.4):
            sheets["fence"].add(Thing(y, y + 0.06, colour, span, structure.stop - structure.start))
    elif name == "cable lid":
        sheets["ground"].add(Thing(HALF - 3.0, HALF - 2.3, "c9c4b6", at, 1.1))
    elif name == "platform lamp":
        sheets["people"].add(
            Thing(1.1, 4.4, "3a3f45", at, 0.14, 0.14), Thing(4.2, 4.5, "fff6d8", at, 0.9, 0.5, lit=True)
        )


def _station(sheets: dict[str, Sheet], start: float, random: Random) -> None:
    """A platform with its edge, a wall with windows or a hedge behind it, signs and a bench."""
    one, size = torch.tensor([start]), STATION
    sheets["edge"].add(Thing(0, 1.1, "8d8a84", one, size), Thing(0.95, 1.1, "e8e4d8", one, size))
    paving = random.pick(("a39e96", "8f8078", "b3aca0"))
    sheets["platform back"].add(Thing(0, 3.6, paving, one, size))
    sheets["platform"].add(
        Thing(0, 1.75, paving, one, size),
        Thing(0.05, 0.3, "f0ede2", one, size),
        Thing(0.8, 0.95, "e8c53a", one, size),
    )
    wall, sign = random.pick(("8b4a38", "c9bfa8", "6f7f8c")), random.pick(("1c3f94", "186b3a", "f2f2f0"))
    house = start + random.uniform(20, 80)
    sheets["shelter"].add(
        Thing(0, 2.2, "6c6f6a", one, size),
        Thing(0, 4.6, wall, torch.tensor([house]), 38, 4.0),
        Thing(2.0, 3.4, "26303a", house + 2.5 + 5.5 * torch.arange(6), 2.6),
        Thing(4.6, 5.0, "4a3a34", torch.tensor([house]), 38, 4.5),
    )
    at = scattered(random, start + 4, start + size - 25, (18, 45))
    sheets["people"].add(Thing(2.6, 3.5, sign, at, 2.6, 1.3), Thing(1.1, 2.6, "55585c", at, 0.1, 0.1))


def _waymarks(sheets: dict[str, Sheet], random: Random, end: float, stations: tuple[float, ...]) -> None:
    """What is met once in a while: signals, cabinets, level crossings and bridges' shadows."""
    at = scattered(random, 40, end, (160, 420))
    sheets["signals"].add(
        Thing(0, 5.2, "33373c", at, 0.2, 0.16),
        Thing(3.9, 5.6, "141517", at, 0.5, 0.6),
        Thing(5.0, 5.35, random.pick(("ff5040", "5cff7a")), at, 0.3, 0.35, lit=True),
    )
    at = scattered(random, 20, end, (45, 170))
    sheets["signals"].add(Thing(0, 1.3, random.pick(("9aa39b", "c0b59a")), at, 0.9, 0.6))
    at = scattered(random, 200, end, (420, 800))
    at = at[[not any(s - 20 < place < s + STATION + 20 for s in stations) for place in at.tolist()]]
    if len(at):  # the road reaches across, its lines beside the rails
        sheets["ground"].add(
            Thing(0, 2 * HALF, "4b4c4f", at, 7.0), Thing(0, HALF - 2, "e8e6dc", at + 3.4, 0.25)
        )
        rails(sheets["ground"], TRACKS, end, -HALF)
        sheets["signals"].add(Thing(0, 3.0, "e03528", at - 1.5, 0.3, 0.35))
        sheets["masts"].add(Thing(0, 3.0, "f0f0ee", at - 1.5, 0.3, 0.35))


def outdoor_visitors(world: World, random: Random, route: float, sunny: bool) -> None:
    """What one traverse alone meets: people, a train on the other track, and shadows in the sun."""
    sheets = world.sheets
    waiting(world, random, 2, 1.1, 2.5)
    at = torch.tensor([random.uniform(0.15, 0.8) * route]).double()
    body = random.pick(("c9352c", "2f5fa8", "e0e2e4"))
    sheets["train"].add(
        Thing(0.3, 3.9, body, at, 76, 2.8),
        Thing(2.0, 3.1, "1c232c", at, 76, 2.6),
        Thing(3.9, 4.1, "5a5d60", at, 76, 2.8),
    )
    if sunny:
        for mast in (s for s in world.structures if s.name == "mast"):
            sheets["ground"].add(Thing(HALF - 3.4, HALF + 9, "101418", mast.at + 1.5, 0.35, opacity=0.5))
        at = scattered(random, 0, route + FAR, (5, 22))
        sheets["ground"].add(Thing(HALF + 2.2, 2 * HALF, "101418", at, 4.5, opacity=0.45))
