"""An outdoor railway: masts, fences, vegetation, houses and stations along two tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dejavu_torch.data.simulate import scenery
from dejavu_torch.data.simulate.route import Random, option, rgb
from dejavu_torch.data.simulate.scenery import FOOT, RAIL, STATION, Range, Structure, World
from dejavu_torch.data.simulate.sheets import FAR, Light, Sheet, Thing, View
from dejavu_torch.data.simulate.train import Railway

TRACKS = (0.0, 4.0)
HALF = 13.0  # metres of detailed ground on either side
CELL = (0.1, 0.2)  # metres of a texture cell across and along


@dataclass(eq=False)
class Outdoor(Railway):
    """An outdoor train ride along 2 km of double track: `sim:outdoor`.

    Sleepers every 0.6 m; overhead-line masts every 50 to 60 m, fence posts every 2.4 to 4 m, cable lids every
    9 to 16 m, each with a constant period per segment; platform lamps every 15 m. Vegetation, houses,
    signals, crossings and stations do not repeat. The reference moves 0.49 m per frame on average (seed 0:
    4195 frames).

    Metres right of the camera's track: the other track 4, signals 6.6, fence 7.4, bushes -7.8 and 8.2, trees
    -11 and 12.5, houses -26 and 30. Two or three platforms of 150 m from -1.65 to -7, 0.9 above the rails;
    masts at -3.4, 7 high.

    Args: as for `Railway`; the reference cruises at 17 m/s.
    """

    kind = "outdoor"
    route = 2000.0
    speed: float = option(17.0, 5, 40)

    def _build(self, random: Random) -> World:
        stations = tuple(self.route * (k + random.uniform(0.3, 0.6)) / 3 for k in range(3))
        stations = stations[1 if self.seed % 2 else 0 :]
        sheets = _sheets(random, self.end)
        structures = [Structure("sleeper", 0.6, 0.0, self.end)]
        for name, *ranges in (
            ("mast", (50, 60), (350, 700), (20, 60)),
            ("fence post", (2.4, 4.0), (150, 400), (40, 160)),
            ("cable lid", (9, 16), (200, 500), (60, 200)),
        ):
            structures += scenery.periodic_segments(random, name, self.route, *ranges)
        for start in stations:
            lamps = round(start + 6, 2), round(start + STATION, 2)
            structures.append(Structure("platform lamp", 15.0, *lamps))
        return World(sheets, tuple(structures), stations)

    def _things(self, world: World, random: Random) -> Iterator[Thing]:
        for structure in world.structures:
            yield from _pieces(structure, random, self.route)
        for x in TRACKS:
            yield Thing("wires", x + 3.4 - 0.025, x + 3.4 + 0.025, "2a2d33", -FAR, self.route + 3 * FAR)
        for start in world.stations:
            yield from _station(start, random)
        at = random.scattered(40, self.end, (160, 420))
        yield Thing("signals", 0, 5.2, "33373c", at, 0.2, 0.16)
        yield Thing("signals", 3.9, 5.6, "141517", at, 0.5, 0.6)
        yield Thing("signals", 5.0, 5.35, random.pick(("ff5040", "5cff7a")), at, 0.3, 0.35, lit=True)
        at = random.scattered(20, self.end, (45, 170))
        yield Thing("signals", 0, 1.3, random.pick(("9aa39b", "c0b59a")), at, 0.9, 0.6)  # cabinets
        at = world.away(random.scattered(200, self.end, (420, 800)), 20)
        if len(at):  # level crossings: road, centre line, rails and signs
            yield Thing("ground", 0, 2 * HALF, "4b4c4f", at, 7.0)
            yield Thing("ground", 0, HALF - 2, "e8e6dc", at + 3.4, 0.25)
            for x in TRACKS:
                yield from scenery.rails("ground", x + HALF, self.end)
            yield Thing("signals", 0, 3.0, "e03528", at - 1.5, 0.3, 0.35)
            yield Thing("masts", 0, 3.0, "f0f0ee", at - 1.5, 0.3, 0.35)

    def _visitors(self, world: World, random: Random) -> Iterator[Thing]:
        yield from scenery.people(world, random, 2, 1.1, 2.5)
        nose, body = random.uniform(0.15, 0.8) * self.route, random.pick(("c9352c", "2f5fa8", "e0e2e4"))
        yield Thing("train", 0.3, 3.9, body, nose, 76, 2.8)
        yield Thing("train", 2.0, 3.1, "1c232c", nose, 76, 2.6)
        yield Thing("train", 3.9, 4.1, "5a5d60", nose, 76, 2.8)
        if self.traverse % 2:  # sunshine: shadows of the masts, and from the right
            for mast in (s for s in world.structures if s.name == "mast"):
                yield Thing("ground", HALF - 3.4, HALF + 9, "101418", mast.at + 1.5, 0.35, opacity=0.5)
            at = random.scattered(0, self.end, (5, 22))
            yield Thing("ground", HALF + 2.2, 2 * HALF, "101418", at, 4.5, opacity=0.45)

    def _light(self, world: World) -> Light:
        haze = torch.tensor([0.80, 0.84, 0.88])[:, None]
        return Light(0.0, 1.0, torch.ones(round(self.route + 2 * FAR)), haze, 350.0)

    def _sky(self, view: View, random: Random) -> Tensor:
        height = (view.up / view.up.max()).clamp(0, 1) ** 0.7
        low, high = torch.tensor([0.86, 0.89, 0.92])[:, None], torch.tensor([0.45, 0.62, 0.85])[:, None]
        clouds = random.texture(*view.shape, view.shape[1] / 4).flatten().clamp(-1, 1.5)
        blue = low + height * (high - low)
        return (blue + 0.10 * clouds * height * (0.95 - blue).sign()).clamp(0, 1)


def _pieces(structure: Structure, random: Random, route: float) -> Iterator[Thing]:
    at, name = structure.at, structure.name
    if name == "sleeper":
        for x in reversed(TRACKS):  # the camera's own track is painted last, over the other
            yield Thing("ground", x + HALF - 1.3, x + HALF + 1.3, "b5aea2", at, 0.26)
        for x in TRACKS:
            yield from scenery.rails("ground", x + HALF, route)
    elif name == "mast":
        colour = random.pick(("5f6a66", "4a4640", "7d8288"))
        yield Thing("masts", 0, 7.0, colour, at, 0.3, 0.3)
        yield Thing("wires", 0, 3.6, colour, at, 0.12, 0.14)
    elif name == "fence post":
        colour = random.pick(("d9d6cd", "6b5138", "8f969c"))
        yield Thing("fence", 0, 1.7, colour, at, 0.12, 0.12)
        for y in (0.7, 1.4):
            yield Thing("fence", y, y + 0.06, colour, structure.start, structure.stop - structure.start)
    elif name == "cable lid":
        yield Thing("ground", HALF - 3.0, HALF - 2.3, "c9c4b6", at, 1.1)
    elif name == "platform lamp":
        yield Thing("people", 1.1, 4.4, "3a3f45", at, 0.14, 0.14)
        yield Thing("people", 4.2, 4.5, "fff6d8", at, 0.9, 0.5, lit=True)


def _station(start: float, random: Random) -> Iterator[Thing]:
    """A platform with its edge and signs, a low wall and a house with windows."""
    yield Thing("edge", 0, 1.1, "8d8a84", start, STATION)
    yield Thing("edge", 0.95, 1.1, "e8e4d8", start, STATION)
    paving = random.pick(("a39e96", "8f8078", "b3aca0"))
    yield Thing("platform back", 0, 3.6, paving, start, STATION)
    yield Thing("platform", 0, 1.75, paving, start, STATION)
    yield Thing("platform", 0.05, 0.3, "f0ede2", start, STATION)
    yield Thing("platform", 0.8, 0.95, "e8c53a", start, STATION)
    wall, sign = random.pick(("8b4a38", "c9bfa8", "6f7f8c")), random.pick(("1c3f94", "186b3a", "f2f2f0"))
    house = start + random.uniform(20, 80)
    yield Thing("shelter", 0, 2.2, "6c6f6a", start, STATION)
    yield Thing("shelter", 0, 4.6, wall, house, 38, 4.0)
    yield Thing("shelter", 2.0, 3.4, "26303a", house + 2.5 + 5.5 * torch.arange(6), 2.6)
    yield Thing("shelter", 4.6, 5.0, "4a3a34", house, 38, 4.5)
    at = random.scattered(start + 4, start + STATION - 25, (18, 45))
    yield Thing("people", 2.6, 3.5, sign, at, 2.6, 1.3)
    yield Thing("people", 1.1, 2.6, "55585c", at, 0.1, 0.1)


def _sheets(random: Random, end: float) -> dict[str, Sheet]:
    """The cross-section, nearest first."""

    def upright(x: float, height: float, texture: Tensor | None = None, cell: Range = CELL) -> Sheet:
        return Sheet((x, FOOT), (x, FOOT + height), texture, cell)

    def plants(x: float, height: float, cell: Range, leaves: tuple[str, str], bare: float) -> Sheet:
        return upright(x, height, _growth(random, end, height, cell, leaves, bare), cell)

    def houses(x: float) -> Sheet:
        cell = (0.3, 0.5)
        texture = _growth(random, end, 13.0, cell, ("35543a", "4d6140"), 0.55)
        _paint_houses(random, texture, cell, end)
        return upright(x, 13.0, texture, cell)

    def fields() -> Sheet:
        image = scenery.mottled(random, "8a8f4a", round(160 / 0.6), round(end), 0.06, 0.22)
        return Sheet((-80, FOOT), (80, FOOT), scenery.solid(image), (0.6, 1.0))

    return {
        "wires": Sheet((-3.4, 3.3), (4.6, 3.3)),
        "edge": Sheet((-1.65, FOOT), (-1.65, RAIL + 0.9)),
        "platform": Sheet((-1.65, RAIL + 0.9), (-3.4, RAIL + 0.9)),
        "masts": upright(-3.4, 7.2),
        "people": upright(-5.2, 4.5),
        "platform back": Sheet((-3.4, RAIL + 0.9), (-7.0, RAIL + 0.9)),
        "shelter": upright(-7.0, 5.0),
        "train": upright(5.5, 4.2),
        "signals": upright(6.6, 6.0),
        "fence": upright(7.4, 2.2),
        "bushes left": plants(-7.8, 3.2, CELL, ("4c6b2a", "7a7a38"), 0.45),
        "bushes right": plants(8.2, 2.8, CELL, ("3f6130", "8a7a3a"), 0.5),
        "trees left": plants(-11.0, 9.5, (0.16, 0.3), ("2f5426", "58702f"), 0.5),
        "trees right": plants(12.5, 10.5, (0.16, 0.3), ("2a4a2a", "6a7434"), 0.5),
        "ground": Sheet((-HALF, FOOT), (HALF, FOOT), _ground(random, round(end / CELL[1])), CELL),
        "far left": houses(-26.0),
        "far right": houses(30.0),
        "fields": fields(),
    }


def _ground(random: Random, columns: int) -> Tensor:
    """Ballast under the tracks, a path next to them and grass beyond, (4,V,S)."""
    size = round(2 * HALF / CELL[0]), columns
    x = ((torch.arange(size[0]) + 0.5) * CELL[0] - HALF)[:, None]
    off = torch.stack([(x - track).abs() for track in TRACKS]).amin(0)
    rim = 0.35 * scenery.broad(random, *size, 12.0)

    def blend(image: Tensor, colour: Tensor, cover: Tensor) -> Tensor:
        return (colour - image).mul_(cover.clamp(0, 1)).add_(image)

    image = scenery.mottled(random, "5d6b33", *size, 0.10, 0.14)
    image = blend(image, rgb("9a8a55"), scenery.broad(random, *size, 90.0) - 0.6)
    gravel = scenery.mottled(random, "8a8074", *size, 0.16, 0.06)
    image = blend(image, gravel, (3.1 - off + rim) / 0.4)
    ballast = scenery.mottled(random, "6d6258", *size, 0.22, 0.05)
    image = blend(image, ballast, (1.75 - off + 0.3 * rim) / 0.2)
    weeds = scenery.broad(random, *size, 30.0) - 1.3
    return scenery.solid(blend(image, rgb("55662c"), weeds.clamp(max=0.8)))


def _growth(
    random: Random, end: float, height: float, cell: Range, leaves: tuple[str, str], bare: float
) -> Tensor:
    """Bushes or trees from the side, (4,V,S), row 0 at the foot; bare is the fraction without any."""
    rows, columns = round(height / cell[0]), round(end / cell[1])
    y = ((torch.arange(rows) + 0.5) * cell[0])[:, None]
    crowns = random.texture(1, columns, 0.9 * height / cell[1])[0]
    clearing = random.texture(1, columns, 60 / cell[1])[0]
    top = height * (0.55 + 0.2 * crowns) * ((clearing - clearing.quantile(bare)) / 0.15).clamp(0, 1)
    ragged = random.texture(rows, columns, 5.0)
    alpha = ((top - y + 0.07 * height * ragged) / (2 * cell[0])).clamp(0, 1)
    kind = (0.5 + 0.5 * random.texture(1, columns, 14 / cell[1])).clamp(0, 1)
    colour = rgb(leaves[0]) + kind * (rgb(leaves[1]) - rgb(leaves[0]))
    light = 0.55 + 0.5 * (y / top.clamp(min=0.5)).clamp(0, 1) + 0.22 * random.texture(rows, columns, 9.0)
    return torch.cat([(colour * light).clamp(0, 1) * alpha, alpha[None]])


def _paint_houses(random: Random, texture: Tensor, cell: Range, end: float) -> None:
    """Paint buildings with rows of windows into a side texture, in place."""
    for s in random.scattered(0, end, (25, 140)).tolist():
        width, height = random.uniform(9, 34), random.uniform(4, 10)
        colour = rgb(random.pick(("c9bda3", "a2553f", "d8d4cc", "8a8f98", "c48f5a", "e2d9b8")))
        part = texture[:, : round(height / cell[0]), round(s / cell[1]) : round((s + width) / cell[1])]
        if part.shape[2] == 0:  # past the end of the texture
            continue
        y = ((torch.arange(part.shape[1]) + 0.5) * cell[0])[:, None]
        x = (torch.arange(part.shape[2]) + 0.5) * cell[1]
        pitch = random.uniform(2.4, 4.5)
        window = ((x % pitch) < 0.5 * pitch) & ((y % 3.0) > 1.1) & ((y % 3.0) < 2.5) & (y < height - 1.2)
        part[:3] = torch.where(window, rgb("2b343f"), colour) * torch.where(y > height - 1.0, 0.45, 1.0)
        part[3] = 1.0
