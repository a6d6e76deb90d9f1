"""Capacity and storage of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import combinations
from typing import NamedTuple

from dejavu_torch.periods.support import common_period, shared_factor
from dejavu_torch.types import Plan

LAYERS_SHOWN = 6
CHUNKS_SHOWN = 12  # of a summary in lines
LARGE = 10**9  # a common period beyond it is no figure that a person compares


class ChunkSummary(NamedTuple):
    """One chunk [start, stop), and what repeats in it.

    periods: of its layers; of a spectral map, of the ten strongest lines.
    features: number of features of each layer; () in a spectral map.
    common_period: the least common multiple of the periods, in places; the capacity.
    shared_factors: greatest common divisor of each pair of periods, in the order of
        itertools.combinations(periods, 2).
    """

    start: int
    stop: int
    periods: tuple[Fraction, ...]
    features: tuple[int, ...]
    common_period: Fraction
    shared_factors: tuple[Fraction, ...]


@dataclass(frozen=True, repr=False)
class MapSummary:
    """Capacity and storage of a map; prints as a few lines for a person.

    Attributes:
        kind: of the map. places: N. covered: places that at least one layer covers.
        templates: sum of phases. template_numbers: sum of phases x features. lines: nonzero ones.
        route: bytes of the map by part, such as the templates.
        fixed: other bytes by part, such as the backbone; of these only the names grow with the route.
    """

    kind: str
    places: int
    covered: int
    templates: int
    template_numbers: int
    chunks: tuple[ChunkSummary, ...]
    route: Mapping[str, int]
    fixed: Mapping[str, int]
    lines: int = 0

    @property
    def fixed_bytes(self) -> int:
        """Sum of `fixed`."""
        return sum(self.fixed.values())

    @property
    def route_bytes(self) -> int:
        """Sum of `route`."""
        return sum(self.route.values())

    @property
    def map_bytes(self) -> int:
        """Everything that `localize` needs beyond the installed package."""
        return self.fixed_bytes + self.route_bytes

    @property
    def bytes_per_place(self) -> float:
        """`map_bytes` over the number of places."""
        return self.map_bytes / max(self.places, 1)

    def with_parts(self, fixed: Mapping[str, int]) -> MapSummary:
        """The summary with further fixed parts, without those of 0 bytes."""
        return replace(self, fixed={**self.fixed, **{name: size for name, size in fixed.items() if size}})

    def __repr__(self) -> str:
        if not self.places:
            return f"{self.fixed_bytes} bytes without a map ({_parts(self.fixed)})"
        lines = [_chunk_line(chunk) for chunk in self.chunks[:CHUNKS_SHOWN]]
        if len(self.chunks) > CHUNKS_SHOWN:
            lines.append(f"and {len(self.chunks) - CHUNKS_SHOWN} more chunks")
        stored = f"{self.templates} templates, {self.template_numbers} numbers"
        if self.kind != "templates":
            stored = f"{self.lines} lines of their spectra"
        lines.append(f"{self.covered} of {self.places} places covered; {stored}")
        stored = (
            f"{self.map_bytes} bytes, {self.bytes_per_place:.1f} per place: {self.route_bytes} of the route, "
        )
        stored += f"{self.route_bytes / self.places:.2f} per place ({_parts(self.route)})"
        if self.fixed:
            names = ", with the names of its frames" * ("names" in self.fixed)
            stored += f", and {self.fixed_bytes} fixed{names} ({_parts(self.fixed)})"
        return "\n".join([*lines, stored])


def summarise(plan: Plan, places: int, route: Mapping[str, int]) -> MapSummary:
    """The summary of a plan over `places` places, whose parts take these bytes.

    Example:
        >>> from dejavu_torch.types import FrequencyLayer
        >>> layers = [FrequencyLayer(Fraction(p), p, 0, 1024, (0, 1)) for p in (93, 171)]
        >>> summarise(tuple(layers), places=1024, route={"templates": 2112, "layers": 1984})
        places 0-1023: 2 layers, periods 93 (2 features), 171 (2 features); together 5301 places
        1024 of 1024 places covered; 264 templates, 528 numbers
        4096 bytes, 4.0 per place: 4096 of the route, 4.00 per place (templates 2112, layers 1984)
    """
    chunks = []
    covered = end = 0
    for start, stop in sorted({(layer.start, layer.stop) for layer in plan}):
        members = [layer for layer in plan if (layer.start, layer.stop) == (start, stop)]
        periods = tuple(layer.period for layer in members)
        features = tuple(len(layer.features) for layer in members)
        shared = tuple(shared_factor(a, b) for a, b in combinations(periods, 2))
        chunks.append(ChunkSummary(start, stop, periods, features, common_period(periods), shared))
        covered, end = covered + max(0, stop - max(start, end)), max(stop, end)
    templates = sum(layer.phases for layer in plan)
    numbers = sum(layer.phases * len(layer.features) for layer in plan)
    return MapSummary("templates", places, covered, templates, numbers, tuple(chunks), route, {})


def _parts(parts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {size}" for name, size in parts.items())


def _chunk_line(chunk: ChunkSummary) -> str:
    if not chunk.features:
        periods = ", ".join(_number(period) for period in chunk.periods) or "none"
        return f"places {chunk.start}-{chunk.stop - 1}: strongest periods {periods}"
    largest = sorted(range(len(chunk.periods)), key=lambda j: -chunk.features[j])[:LAYERS_SHOWN]
    shown = ", ".join(f"{_number(chunk.periods[j])} ({chunk.features[j]} features)" for j in sorted(largest))
    more = len(chunk.periods) - len(largest)
    layers = f"{len(chunk.periods)} layer{'s' * (len(chunk.periods) > 1)}"
    line = f"places {chunk.start}-{chunk.stop - 1}: {layers}, periods {shown}"
    if more:
        line += f" and {more} smaller layer{'s' * (more > 1)}"
    if len(chunk.periods) > 1 and chunk.common_period < LARGE:
        line += f"; together {_number(chunk.common_period)} places"
    return line


def _number(value: Fraction) -> str:
    return f"{float(value):.5g}" if value.denominator > 1 else str(value.numerator)
