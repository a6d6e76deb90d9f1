"""Queries that are not independent of a map, or not made as it was: of whose answers little follows."""

from __future__ import annotations

import logging
import math
from base64 import b64decode, b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.traverse import Part
from dejavu_torch.maps.digest import BITS, BYTES, digests_of, signs_of
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.types import Doubt, Facts, Traverse, expect

log = logging.getLogger("dejavu_torch")

ASKED = 2**17  # queries that are looked at, the first ones
AT_ONCE = 16  # places that are compared with all queries
ROWS = 256  # of ready descriptors whose mean is taken, at most

# Chosen on every other route of `benchmarks provenance`, which tells of the others.
SAME, FEWEST_SAME = 0.15, 8  # share of the places, and places, at least, that a query equals
CHANGED = 3  # signs that change to the next frame, at least, so that equal ones tell something
OWN = 0.9  # share of all places, from which on a visit is the map's own drive
BETWEEN, BEYOND = 0.31, 0.41  # signs beyond both queries: of those that change, and of those that differ
FEWEST_BETWEEN = {1: 32, 2: math.inf}  # places, by the dimensions of a layout: over areas nothing is told
CORRELATED, STEADY = 0.25, 0.3  # means of other networks at most, and of parts of one drive at least
LARGER = 4.0  # ratio of the sizes of one network's, at most
WIDE, FEWEST_SPREAD = 16, 50  # dimensions, and ready descriptors, of fewer of which little can be told

Relation = Literal["", "frames", "between"]
SEEN: dict[Relation, str] = {
    "frames": "frames of the map itself",
    "between": "frames between those of the map, as of the same drive",
}
SO = "another visit will be found less often"
THEMSELVES = f"the queries are {SEEN['frames']}: {SO}"


class Spread(NamedTuple):
    """Ready descriptors: mean of each dimension about that of all, as int8 up to 127; root mean square of all
    numbers; and the least correlation of the mean of a quarter of them with that of the others."""

    mean: bytes
    size: float
    steady: float

    @classmethod
    def of(cls, traverse: Traverse) -> Spread | None:
        """That of a traverse; None of frames, of few descriptors, and of few dimensions."""
        if len(traverse.frame_shape) != 1 or traverse.frame_shape[0] < WIDE:
            return None
        rows = Part(traverse, range(0, len(traverse), -(-len(traverse) // ROWS)))[:].float()
        rows = rows[rows.any(1)]
        if len(rows) < FEWEST_SPREAD or not rows.square().mean().isfinite():
            return None
        total = rows.sum(0)
        sums = [(part.sum(0), total - part.sum(0)) for part in rows.tensor_split(4)]
        about = total - total.mean()
        mean = (about * (127 / about.abs().max().clamp(min=1e-30))).round().to(torch.int8)
        size = float(rows.square().mean().sqrt())
        return cls(mean.numpy().tobytes(), size, min(correlation(*pair) for pair in sums))

    def correlation(self, other: Spread) -> float:
        """That of the means of two drives."""
        means = (torch.tensor([*one.mean]).to(torch.uint8).view(torch.int8).float() for one in (self, other))
        return correlation(*means)

    def unlike(self, other: Spread) -> bool:
        """Whether descriptors of the other seem to be made by something else."""
        ratio = max(other.size, 1e-30) / max(self.size, 1e-30)
        far = abs(math.log(ratio)) > math.log(LARGER)
        alike = len(other.mean) != len(self.mean)  # which is refused elsewhere
        return not alike and (far or (self.steady >= STEADY and self.correlation(other) < CORRELATED))


def correlation(one: Tensor, other: Tensor) -> float:
    """Of two vectors; 0 if one of them is constant."""
    return float(torch.nn.functional.cosine_similarity(one - one.mean(), other - other.mean(), 0))


@dataclass(frozen=True)
class Provenance:
    """Where a map comes from, beside what makes its descriptors.

    Attributes:
        maker: of ready descriptors, as their files tell; "" if they do not. spread: of these.
        taught: names of the traverses that taught it beside its own (further visits, drives, those it was
            calibrated by), and digests of some of their frames.
    """

    maker: str = ""
    spread: Spread | None = None
    taught: tuple[tuple[str, bytes], ...] = ()

    @classmethod
    def of(cls, traverse: Traverse) -> Provenance:
        """Of a map that is learned from a traverse."""
        return cls(traverse.maker, Spread.of(traverse))

    @classmethod
    def merged(cls, parts: Sequence[Provenance]) -> Provenance:
        """That of a map of several."""
        return replace(parts[0], taught=tuple(dict.fromkeys(one for part in parts for one in part.taught)))

    def taught_by(self, name: str, digests: Tensor) -> Provenance:
        """The same of a map that a traverse has taught, too."""
        return self.merged([self, Provenance(taught=((name, digests.numpy().tobytes()),))])

    def stored(self) -> Facts:
        """As JSON values, without what is not known."""
        spread = self.spread and [b64encode(self.spread.mean).decode(), *self.spread[1:]]
        taught = [[name, b64encode(digests).decode()] for name, digests in self.taught]
        facts = {"maker": self.maker, "spread": spread, "taught": taught}
        return {name: value for name, value in facts.items() if value}

    @classmethod
    def restored(cls, facts: Facts) -> Provenance:
        """From the result of `stored`."""
        spread = (known := facts.get("spread")) and Spread(b64decode(known[0]), *map(float, known[1:]))
        taught = tuple((name, b64decode(digests)) for name, digests in facts.get("taught", ()))
        return cls(facts.get("maker", ""), spread, taught)

    def unlike(self, queries: Traverse) -> str:
        """What is said of ready descriptors that seem to be made by something else; "" of others."""
        if self.spread is None or (self.maker and queries.maker) or (own := Spread.of(queries)) is None:
            return ""
        line = f"the descriptors of {queries.name} differ from the map's as those of another network do"
        return line if self.spread.unlike(own) else ""

    def doubts(self, place_map: PlaceMap, digests: Tensor, queries: Traverse) -> list[Doubt]:
        """Why answers to queries may mislead, of which there are digests (Q,9)."""
        images = len(queries.frame_shape) == 3
        lines, found = [self.unlike(queries)], relation(place_map, place_map.digest, digests, images)
        known = [(name, torch.tensor([*own], dtype=torch.uint8).view(-1, BYTES)) for name, own in self.taught]
        names = [name for name, own in known if not found and relation(place_map, own, digests, images)]
        lines += [f"the queries are {SEEN[found]}: {SO}"] if found else []
        lines += [f"the queries taught this map ({', '.join(names)}): {SO}"] if names else []
        return [Doubt("provenance", line) for line in lines if line]


class Alike(NamedTuple):
    """How queries and the places of a map, or of a drive, are alike.

    places: that are compared. same: of them that equal a query. beyond: signs in which places differ from
    both of two queries that follow each other, in proportion to those that change from a query, or a place,
    to the next; both: in proportion to those in which they differ from the nearest query.
    """

    places: int = 0
    same: int = 0
    beyond: float = math.inf
    both: float = math.inf


def relation(place_map: PlaceMap, known: Tensor, asked: Tensor, images: bool = True) -> Relation:
    """Whether queries are frames of a map, or of a drive that taught it, or lie between them; see `alike`.
    Not of `images`, those of another visit with little noise lie between, too: of them that is not told, and
    of few dimensions nothing, whose signs are few."""
    if not images and place_map.dimension < WIDE:
        return ""
    places, same, beyond, both = alike(known, asked)
    if same >= max(FEWEST_SAME, SAME * places):
        return "frames"
    tells = places >= FEWEST_BETWEEN[place_map.layout.dimensions] and images
    return "between" if tells and beyond <= BETWEEN and both <= BEYOND else ""


def alike(known: Tensor, asked: Tensor) -> Alike:
    """Compare places with the nearest queries, where both are nearest to each other. A frame that was taken
    between two queries differs from both in few signs. Where signs change nearly at random from frame to
    frame, as in sparse footage, nothing can be told.

    Args:
        known: (n,9) digests of the places. asked: (Q,9) of the queries, in order if they are.
    """
    known, asked = (one[(one[:, :-1] > 0).any(1)] for one in (known.cpu(), asked[:ASKED].cpu()))
    if min(len(known), len(asked)) < FEWEST_SAME:
        return Alike()
    places, queries = signs_of(known), signs_of(asked)
    found = [(*apart.min(1), apart.amin(0, True)) for apart in _apart(places, queries)]
    nearest, at, own = map(torch.cat, zip(*found, strict=True))
    pairs = nearest == own.amin(0)[at]
    places, nearest, at = places[pairs], nearest[pairs], at[pairs]
    each = zip(_apart(queries[at], queries), at.split(AT_ONCE), strict=True)
    others = torch.cat([apart.scatter_(1, one[:, None], BITS).amin(1) for apart, one in each])
    changed = torch.minimum(others, known[pairs, -1].float())
    differs = queries[at] != places
    beside = [queries[(at + step).clamp(0, len(queries) - 1)] != places for step in (-1, 1)]
    beyond = float(torch.stack([(differs & one).sum(1) for one in beside]).amin(0).sum())
    same = int(((nearest == 0) & (changed >= CHANGED)).sum())
    shares = (beyond / max(float(signs.sum()), 1e-9) for signs in (changed, nearest))
    return Alike(len(places), same, *shares)


def _apart(rows: Tensor, queries: Tensor) -> Iterator[Tensor]:
    """Signs in which some rows (n,64) differ from each of the queries (Q,64): (at most `AT_ONCE`,Q)."""
    return ((BITS - part @ queries.T).div_(2) for part in rows.split(AT_ONCE))


def check_independent(place_map: PlaceMap, visit: Traverse, descriptors: Tensor) -> None:
    """Refuse to calibrate a map by its own drive, and warn of another that looks as some of it does: those of
    another visit with little noise do, too."""
    digests = digests_of(descriptors, follow=False)
    tells = len(visit.frame_shape) == 3 or place_map.dimension >= WIDE
    if not (found := relation(place_map, place_map.digest, digests, tells)):
        return
    line = f"calibrating by {visit.name}: it has {SEEN[found]}"
    apart = _apart(signs_of(place_map.digest.cpu()), signs_of(digests[:ASKED]))
    equal = torch.cat([(part == 0).any(1) for part in apart]).double().mean()
    expect(equal < OWN or place_map.dimension < WIDE, "another visit", line)
    log.warning("%s; probabilities may be too high", line)
