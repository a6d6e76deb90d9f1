"""One query's scores on a spectral map, as the sum of the periods that answer it most strongly."""

from __future__ import annotations

from collections import defaultdict
from fractions import Fraction

import torch
from torch import Tensor

from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import from_spectrum, period_of

COUNTS = (1, 4, 16)  # strongest periods that are added up, beside all


@torch.no_grad()
def components(
    route: SpectralMap, query: Tensor, chunk: int = 0
) -> list[tuple[tuple[Fraction, ...], Tensor]]:
    """Scores of a query with its 1, 4 and 16 strongest periods only, and with all: the map's own scores.

    The product of a query with all descriptors of a chunk is a sum of waves, one for each period, besides a
    constant; the strongest have the largest energy. Cosine and sine of a period count together.

    Shape: query (K,) -> periods, the strongest first, and scores (W,) of the places of the chunk, each.

    Convention: the constant, and what the metric does with products and norms, are part of every sum.
    """
    start, stop = route.chunks[chunk]
    kept_lines = route.lines(chunk)
    query = query.to(kept_lines.value)
    length = torch.linalg.vector_norm(query)
    if route.metric == "cosine":
        query = query / torch.where(length > 0, length, 1)
    terms = query[kept_lines.feature] * kept_lines.value
    lines = query.new_zeros(stop - start).index_add(0, kept_lines.line, terms)
    lines_of: dict[Fraction, list[int]] = defaultdict(list)
    for line in range(1, stop - start):
        if lines[line]:
            lines_of[period_of(line, stop - start, route.transform)].append(line)
    strongest = sorted(lines_of, key=lambda period: -float(lines[lines_of[period]].square().sum()))
    found = []
    for count in (*(count for count in COUNTS if count < len(strongest)), len(strongest)):
        kept = torch.zeros_like(lines)
        for chosen in ([0], *(lines_of[period] for period in strongest[:count])):
            kept[chosen] = lines[chosen]
        products = from_spectrum(kept, route.transform) + query @ route.means[0].to(query)
        if route.metric == "cosine":
            scores = 1 - products * route.inverse_norms(start, stop)
        else:
            scores = length.square() - 2 * products + route.norms[start:stop].square()
        found.append((tuple(strongest[:count]), scores.cpu()))
    return found
