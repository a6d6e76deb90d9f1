"""Capacity and storage of a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple

from dejavu_torch.periods.support import common_period

LAYERS_SHOWN = 6
CHUNKS_SHOWN = 12
LARGE = 10**9  # common periods from here on are not shown


class ChunkSummary(NamedTuple):
    """One chunk [start, stop): periods of its layers, or of the ten strongest lines of a spectral map.

    features: number of features of each layer; () in a spectral map.
    """

    start: int
    stop: int
    periods: tuple[Fraction, ...]
    features: tuple[int, ...] = ()

    @property
    def common_period(self) -> Fraction:
        """The least common multiple of the layers' periods, in places: the capacity. 0 without layers."""
        return common_period(self.periods) if self.features else Fraction(0)

    def __str__(self) -> str:
        where, count = f"places {self.start}-{self.stop - 1}", len(self.periods)
        if not self.features:
            return (
                f"{where}: strongest periods {', '.join(dict.fromkeys(map(_number, self.periods))) or 'none'}"
            )
        largest = sorted(range(count), key=lambda j: -self.features[j])[:LAYERS_SHOWN]
        shown = (f"{_number(self.periods[j])} ({self.features[j]} features)" for j in sorted(largest))
        line = f"{where}: {count} layer{'s' * (count > 1)}, periods {', '.join(shown)}"
        if more := count - len(largest):
            line += f" and {more} smaller layer{'s' * (more > 1)}"
        if count > 1 and self.common_period < LARGE:
            line += f"; together {_number(self.common_period)} places"
        return line


@dataclass(frozen=True, repr=False)
class MapSummary:
    """Capacity and storage of a map; `repr` is a readable text of a few lines.

    Attributes:
        covered: places that at least one layer covers, or with a descriptor. templates: sum of phases.
        template_numbers: sum of phases x features. lines: of a spectral map.
        areas: rows and columns of each part of an area.
        route: bytes by part that grow with the route, such as the templates.
        fixed: other bytes by part, such as the backbone; only the names among them grow with the route.
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
    areas: tuple[tuple[int, int], ...] = ()

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
        """The summary with further fixed parts, unless they have 0 bytes."""
        return replace(self, fixed={**self.fixed, **{name: size for name, size in fixed.items() if size}})

    def __repr__(self) -> str:
        if not self.places:
            return f"{self.fixed_bytes} bytes without a map ({_parts(self.fixed)})"
        lines = [*map(str, self.chunks[:CHUNKS_SHOWN])]
        if len(self.chunks) > CHUNKS_SHOWN:
            lines.append(f"and {len(self.chunks) - CHUNKS_SHOWN} more chunks")
        content = f"{self.templates} templates, {self.template_numbers} numbers"
        if self.kind != "templates":
            content = f"{self.lines} coefficients kept"
        size = f"{self.map_bytes} bytes, {self.bytes_per_place:.1f} per place: {self.route_bytes} of the "
        size += f"route, {self.route_bytes / self.places:.2f} per place ({_parts(self.route)})"
        if self.fixed:
            names = ", with the names of its frames" * ("names" in self.fixed)
            size += f", and {self.fixed_bytes} fixed{names} ({_parts(self.fixed)})"
        if self.areas:
            sizes = [f"{rows} x {columns}" for rows, columns in self.areas[:CHUNKS_SHOWN]]
            more = f", and {len(self.areas) - CHUNKS_SHOWN} more parts" * (len(self.areas) > CHUNKS_SHOWN)
            lines.insert(0, f"an area of {' and '.join(sizes)} windows{more}")
        return "\n".join([*lines, f"{self.covered} of {self.places} places covered; {content}", size])


def _parts(parts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {size}" for name, size in parts.items())


def _number(value: Fraction) -> str:
    return f"{float(value):.5g}" if value.denominator > 1 else str(value.numerator)
