"""Queries that are not independent of a map, or not made as it was: of whose answers little follows."""

from __future__ import annotations

import logging
import math
from base64 import b64decode, b64encode
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.traverse import Part
from dejavu_torch.maps.digest import BITS, BYTES, digests_of, signs_of
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.types import Doubt, Facts, InputError, Traverse

log = logging.getLogger("dejavu_torch")

ASKED = 2**17  # queries that are looked at, the first ones
ROWS = 256  # of ready descriptors whose mean is taken, at most
LEVELS = 127  # of the numbers of a mean

# Chosen on every other route of `benchmarks provenance`, which tells of the others.
SAME, FEWEST_SAME = 0.15, 8  # share of the places, and places, at least, that a query equals
CHANGED = 3  # signs that change to the next frame, at least, so that equal ones tell something
BETWEEN, FEWEST_BETWEEN = 0.31, 32  # signs beyond both queries, as a share of those that change; places
CORRELATED, STEADY = 0.25, 0.3  # means of other networks at most, and of parts of one drive at least
LARGER = 4.0  # ratio of the sizes of one network's, at most
WIDE, FEWEST_SPREAD = 16, 50  # dimensions, and descriptors, of fewer of which nothing is told

Relation = Literal["", "frames", "between"]
OWN: dict[Relation, str] = {
    "frames": "the queries are frames of the map itself",
    "between": "the queries lie between the frames of the map, as those of the same drive",
}
SO = "another visit will be found less often"


class Spread(NamedTuple):
    """How ready descriptors are spread.

    mean: of each dimension, about that of all, as whole numbers up to 127. size: root mean square of all
    numbers. steady: the least correlation of the mean of a quarter of them with that of the others.
    """

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
        mean, quarters = rows.mean(0), rows.tensor_split(4)
        others = [(mean * len(rows) - one.sum(0)) / (len(rows) - len(one)) for one in quarters]
        pairs = zip(quarters, others, strict=True)
        steady = min(correlation(one.mean(0), other) for one, other in pairs)
        about = mean - mean.mean()
        levels = (about * (LEVELS / about.abs().max().clamp(min=1e-30))).round().to(torch.int8)
        return cls(levels.numpy().tobytes(), float(rows.square().mean().sqrt()), steady)

    def unlike(self, other: Spread) -> bool:
        """Whether descriptors of the other seem to be made by something else."""
        if len(other.mean) != len(self.mean):
            return False
        far = abs(math.log(max(other.size, 1e-30) / max(self.size, 1e-30))) > math.log(LARGER)
        return far or (self.steady >= STEADY and correlated(self, other) < CORRELATED)


def correlated(one: Spread, other: Spread) -> float:
    """The correlation of the means of two drives."""
    means = (torch.tensor([*each.mean], dtype=torch.uint8).view(torch.int8).float() for each in (one, other))
    return correlation(*means)


def correlation(one: Tensor, other: Tensor) -> float:
    """Of two vectors; 0 if one of them is constant."""
    one, other = one - one.mean(), other - other.mean()
    return float(torch.nn.functional.cosine_similarity(one, other, 0))


class Taught(NamedTuple):
    """A traverse that taught a map: its name, and digests of some of its frames."""

    name: str
    digests: bytes

    @property
    def known(self) -> Tensor:
        """The digests, (n,9)."""
        return torch.tensor([*self.digests], dtype=torch.uint8).view(-1, BYTES)


@dataclass(frozen=True)
class Provenance:
    """Where a map comes from, beside what makes its descriptors.

    Attributes:
        maker: of ready descriptors, as their files tell; "" if they do not. spread: of these.
        taught: the traverses that taught it beside its own: further visits, drives, and those it was
            calibrated by.
    """

    maker: str = ""
    spread: Spread | None = None
    taught: tuple[Taught, ...] = ()

    @classmethod
    def of(cls, traverse: Traverse) -> Provenance:
        """Of a map that is learned from a traverse."""
        return cls(traverse.maker, Spread.of(traverse))

    @classmethod
    def merged(cls, parts: Sequence[Provenance]) -> Provenance:
        """That of a map of several."""
        taught = dict.fromkeys(one for part in parts for one in part.taught)
        return replace(parts[0], taught=tuple(taught))

    def taught_by(self, name: str, digests: Tensor) -> Provenance:
        """The same of a map that a traverse has taught, too."""
        one = Taught(name, digests.numpy().tobytes())
        return replace(self, taught=tuple(dict.fromkeys((*self.taught, one))))

    def stored(self) -> Facts:
        """As JSON values, without what is not known."""
        facts: Facts = {"maker": self.maker} if self.maker else {}
        if self.spread is not None:
            facts["spread"] = [b64encode(self.spread.mean).decode(), *self.spread[1:]]
        taught = [[one.name, b64encode(one.digests).decode()] for one in self.taught]
        return facts | ({"taught": taught} if taught else {})

    @classmethod
    def restored(cls, facts: Facts) -> Provenance:
        """From the result of `stored`."""
        spread, taught = facts.get("spread"), facts.get("taught", ())
        known = spread and Spread(b64decode(spread[0]), *map(float, spread[1:]))
        each = tuple(Taught(name, b64decode(digests)) for name, digests in taught)
        return cls(facts.get("maker", ""), known, each)

    def check_spread(self, added: Traverse) -> None:
        """Refuse ready descriptors that seem to be made by something else, unless their files name them."""
        if self._unlike(added):
            expected = 'a {"maker": ...} in the .json beside the .npy of both, if one network made them'
            raise InputError(f"{unlike(added)}; expected others, or {expected}")

    def _unlike(self, queries: Traverse) -> bool:
        named, own = self.maker and queries.maker, None if self.spread is None else Spread.of(queries)
        return not named and self.spread is not None and own is not None and self.spread.unlike(own)

    def doubts(self, place_map: PlaceMap, digests: Tensor, queries: Traverse) -> list[Doubt]:
        """Why answers to queries may mislead, of which there are digests."""
        lines = [unlike(queries)] if self._unlike(queries) else []
        if found := relation(place_map.digest, digests):
            lines.append(f"{OWN[found]}: {SO}")
        elif names := [one.name for one in self.taught if relation(one.known, digests)]:
            lines.append(f"the queries taught this map ({', '.join(names)}): {SO}")
        return [Doubt("provenance", line) for line in lines]


def unlike(queries: Traverse) -> str:
    """What is said of ready descriptors that seem to be made by something else."""
    return f"the descriptors of {queries.name} differ from the map's as those of another network do"


class Heard:
    """The digests of queries, batch by batch."""

    def __init__(self) -> None:
        self.parts = [torch.zeros(0, BYTES, dtype=torch.uint8)]

    def __call__(self, descriptors: Tensor) -> None:
        self.parts.append(digests_of(descriptors, follow=False))

    @property
    def digests(self) -> Tensor:
        """(Q,9)."""
        return torch.cat(self.parts)


class Alike(NamedTuple):
    """How queries and the places of a map, or of a drive, are alike.

    places: that are compared. same: of them that equal a query. beyond: signs in which places differ from
    both of two queries that follow each other, in proportion to those that change from a query, or a place,
    to the next.
    """

    places: int = 0
    same: int = 0
    beyond: float = math.inf

    @property
    def relation(self) -> Relation:
        """Whether the queries are frames of the map, or lie between them."""
        if self.same >= max(FEWEST_SAME, SAME * self.places):
            return "frames"
        return "between" if self.places >= FEWEST_BETWEEN and self.beyond <= BETWEEN else ""


def alike(known: Tensor, asked: Tensor) -> Alike:
    """Compare places with the nearest queries, where both are nearest to each other. A frame that was taken
    between two queries differs from both in few signs. Where signs change nearly at random from frame to
    frame, as in sparse footage, nothing can be told.

    Args:
        known: (n,9) digests of the places. asked: (Q,9) of the queries, in order if they are.
    """
    known, asked = (one.cpu()[(one.cpu()[:, :-1] > 0).any(1)] for one in (known, asked[:ASKED]))
    if min(len(known), len(asked)) < FEWEST_SAME:
        return Alike()
    places, queries = signs_of(known), signs_of(asked)
    apart = _apart(places, queries)
    nearest, at = apart.min(1)
    pairs = nearest == apart.amin(0)[at]
    places, nearest, at = places[pairs], nearest[pairs], at[pairs]
    others = _apart(queries[at], queries).scatter_(1, at[:, None], BITS).amin(1)
    changed = torch.minimum(others, known[pairs, -1].float())
    differs = queries[at] != places
    beside = [queries[(at + step).clamp(0, len(queries) - 1)] != places for step in (-1, 1)]
    beyond = torch.stack([(differs & one).sum(1) for one in beside]).amin(0)
    same = int(((nearest == 0) & (changed >= CHANGED)).sum())
    return Alike(len(places), same, float(beyond.sum()) / max(float(changed.sum()), 1e-9))


def relation(known: Tensor, asked: Tensor) -> Relation:
    """See `Alike`."""
    return alike(known, asked).relation


def _apart(one: Tensor, other: Tensor) -> Tensor:
    """In how many signs each of one differs from each of the other: (n,64), (m,64) -> (n,m)."""
    return (BITS - one @ other.T) / 2


def check_independent(place_map: PlaceMap, visit: Traverse, descriptors: Tensor) -> None:
    """Refuse to calibrate a map by its own drive; of ready descriptors between its frames only warn, since
    those of another visit with little noise look alike."""
    found = relation(place_map.digest, digests_of(descriptors, follow=False))
    seen = {
        "frames": "has frames of the map",
        "between": "lies between the frames of the map, as the same drive",
    }
    if found == "frames" or (found and len(visit.frame_shape) == 3):
        raise InputError(f"calibrating by {visit.name}: it {seen[found]}; expected another visit")
    if found:
        log.warning("calibrating by %s: it %s; probabilities may be too high", visit.name, seen[found])
