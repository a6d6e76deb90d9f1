"""What a map can tell apart and what it costs."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations
from typing import NamedTuple

from dejavu_torch.periods.support import common_period, shared_factor
from dejavu_torch.types import Plan


class ChunkSummary(NamedTuple):
    """One chunk [start, stop): its periods, how many places they can tell apart, and what they share.

    common_period: the least common multiple of the periods, in frames; the capacity.
    shared_factors: greatest common divisor of each pair of periods, in the order of
        itertools.combinations(periods, 2).
    features: number of features of each layer.
    """

    start: int
    stop: int
    periods: tuple[Fraction, ...]
    features: tuple[int, ...]
    common_period: Fraction
    shared_factors: tuple[Fraction, ...]


class MapSummary(NamedTuple):
    """Capacity and storage of a map.

    places: N. covered: places that at least one layer covers.
    templates: sum of phases. template_numbers: sum of phases x features.
    map_bytes: size of the map file. bytes_per_place: map_bytes / N.
    """

    places: int
    covered: int
    templates: int
    template_numbers: int
    map_bytes: int
    bytes_per_place: float
    chunks: tuple[ChunkSummary, ...]


def summarise(plan: Plan, places: int, map_bytes: int) -> MapSummary:
    """The certificate of a plan over `places` places stored in `map_bytes` bytes."""
    chunks = []
    covered: set[int] = set()
    for start, stop in sorted({(layer.start, layer.stop) for layer in plan}):
        members = [layer for layer in plan if (layer.start, layer.stop) == (start, stop)]
        periods = tuple(layer.period for layer in members)
        chunks.append(
            ChunkSummary(
                start,
                stop,
                periods,
                tuple(len(layer.features) for layer in members),
                common_period(periods),
                tuple(shared_factor(a, b) for a, b in combinations(periods, 2)),
            )
        )
        covered.update(range(start, stop))
    return MapSummary(
        places,
        len(covered),
        sum(layer.phases for layer in plan),
        sum(layer.phases * len(layer.features) for layer in plan),
        map_bytes,
        map_bytes / max(places, 1),
        tuple(chunks),
    )


def describe(certificate: MapSummary) -> str:
    """The plan and the certificate in lines for a person.

    Example:
        >>> from dejavu_torch.types import FrequencyLayer
        >>> layers = [FrequencyLayer(Fraction(p), p, 0, 1024, (0, 1)) for p in (93, 171)]
        >>> print(describe(summarise(tuple(layers), places=1024, map_bytes=4096)))
        frames 0-1023: 2 layers, periods 93 (2 features), 171 (2 features); lcm 5301 frames, gcd 3
        1024 of 1024 places covered; 264 templates, 528 numbers; 4096 bytes, 4.0 per place
    """
    lines = []
    for chunk in certificate.chunks:
        largest = sorted(range(len(chunk.periods)), key=lambda j: -chunk.features[j])[:6]
        shown = ", ".join(
            f"{_number(chunk.periods[j])} ({chunk.features[j]} features)" for j in sorted(largest)
        )
        more = len(chunk.periods) - len(largest)
        lcm = _number(chunk.common_period) if chunk.common_period < 10**9 else "over 1e9"
        layers = f"{len(chunk.periods)} layer{'s' * (len(chunk.periods) > 1)}"
        line = f"frames {chunk.start}-{chunk.stop - 1}: {layers}, periods {shown}" + (
            f" and {more} smaller layer{'s' * (more > 1)}" if more else ""
        )
        line += f"; lcm {lcm} frames"
        if chunk.shared_factors:
            low, high = min(chunk.shared_factors), max(chunk.shared_factors)
            line += f", gcd {_number(low)}" + ("" if low == high else f" to {_number(high)}")
        lines.append(line)
    lines.append(
        f"{certificate.covered} of {certificate.places} places covered; {certificate.templates} templates, "
        f"{certificate.template_numbers} numbers; {certificate.map_bytes} bytes, "
        f"{certificate.bytes_per_place:.1f} per place"
    )
    return "\n".join(lines)


def _number(value: Fraction) -> str:
    return f"{float(value):.9g}" if value.denominator > 1 else str(value.numerator)
