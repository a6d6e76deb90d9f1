"""The mapper of spectral maps: it finds the quantisation step for a budget, and codes the lines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dejavu_torch.maps.codec import encode
from dejavu_torch.maps.digest import Digest, digests_of
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.maps.quantisation import RouteLines
from dejavu_torch.maps.spectral_map import CHUNK_BYTES, Chunk, SpectralMap, SpectralMetric
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError, expect

ROWS = 2**14  # descriptors checked at a time
HELD = 0.85  # default share of the variance: such maps are nearly as accurate as their descriptors
LINE_BYTES = 5.0  # per place: lines take as many by default, if they then hold more


class SpectralMapper(Mapper):
    """Codes descriptors along the route: the spectrum of each dimension over a chunk, all with one step.

    Args:
        route_bytes_per_place: bytes that grow with the route, but for positions of frames; the step is the
            smallest that fits.
        step: the step itself, in units of the descriptor.
        chunk: places of a chunk. Shorter chunks cost more bytes; a shorter route is one chunk.
        transform, metric: of the maps, see `SpectralMap`.
        resolution: places; the dead zone of a line of period P is 1 + (resolution / P)^2 times as wide.
            For video with many frames per place, 8 makes a better map than 0; with few, a worse one.
        hold: share of the descriptors' variance that the lines hold before `resolution` removes any: 1 -
            squared errors / squared differences from the mean. The step is the largest that holds it. None,
            without bytes and step, is .85, or more if 5 bytes per place hold more, as with few features.

    Shape: descriptors (N,K) -> SpectralMap of N places; with a `Layout` of as many places, of that.

    Convention: the written route takes 98 to 100 % of the budget, or less if the finest useful step needs
        less. Without `resolution` a map holds at least `hold`, unless that step holds less; a long route is
        held as far as its sample tells.

    Raises:
        InputError: settings out of range; forward: fewer than two places, descriptors that are not finite or
            all the same, or a budget that cannot be met.

    Example:
        >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> SpectralMapper()(wave).scores(wave[20:21]).argmin()
        tensor(20)
    """

    kind = SpectralMap.kind
    whitens = True

    def __init__(
        self,
        route_bytes_per_place: float | None = None,
        step: float | None = None,
        chunk: int = 10_000,
        transform: Transform = "dft",
        metric: SpectralMetric = "cosine",
        resolution: float = 0.0,
        hold: float | None = None,
    ) -> None:
        super().__init__()
        every = {"route_bytes_per_place": route_bytes_per_place, "step": step, "hold": hold}
        given = {name: value for name, value in every.items() if value is not None}
        expect(len(given) <= 1, "one of them, None for the others", **given)
        for name, value in given.items():
            if not 0 < value < (1 if name == "hold" else math.inf):
                share = " and below 1, such as 0.85" if name == "hold" else ""
                raise InputError(f"{name} is {value}; expected a number above 0{share}")
        self.route_bytes_per_place, self.step, self.hold = route_bytes_per_place, step, hold
        self.chunk, self.transform, self.metric, self.resolution = chunk, transform, metric, resolution
        self.empty()  # checks the settings

    @classmethod
    def of_equal_size(cls, place_map: SpectralMap) -> SpectralMapper:
        """A mapper with a map's settings and bytes per place, but no `resolution`, for routes of any kind."""
        size = (place_map.summary().route_bytes - place_map.positions.nbytes) / place_map.places
        return cls(size, None, place_map.chunk, place_map.transform, place_map.metric)

    @torch.no_grad()
    def forward(self, features: Tensor, layout: Layout = ROUTE) -> SpectralMap:
        check_descriptors(features)
        layout = layout.reaching(len(features))
        seen = f"{len(features)} descriptors of {layout.kind} of {layout.rows} x {layout.columns} places"
        expect(len(features) == layout.places, "one for each", seen)
        sizes = layout.sizes(self.chunk)
        place_map, lines = self._fitted(features, sizes)
        place_map.laid_out(layout)
        for (start, stop), (_, columns), levels in zip(
            lines.chunks, sizes, lines.levels(place_map.step), strict=True
        ):
            chunk = stop - start, place_map.step, encode(levels), unseen(features[start:stop]), columns
            place_map.extend([Chunk(*chunk)], [levels])
        return place_map

    @torch.no_grad()
    def fit(self, sample: Tensor, sizes: Sequence[tuple[int, int]], share: float = 1.0) -> SpectralMap:
        """A map without places: mean and step for the chunks of a route or an area, from a sample (n,K) of
        these rows and columns. It pays for a `share` of the mean, its part of the places."""
        return self._fitted(sample, sizes, share)[0]

    def empty(self, means: Tensor | None = None, step: float = 0.0) -> SpectralMap:
        return SpectralMap(means, self.metric, self.transform, self.chunk, self.resolution, step)

    extra_repr = settings_of

    def _fitted(
        self, features: Tensor, sizes: Sequence[tuple[int, int]], share: float = 1.0
    ) -> tuple[SpectralMap, RouteLines]:
        """The map without places, and the lines to code with its step."""
        check_descriptors(features)
        places = len(features)
        lines = RouteLines(features, sizes, self.transform, self.resolution)
        if not lines.scale > 1e-6 * float(lines.mean.float().square().mean().sqrt()):
            raise InputError(f"the {places} descriptors are all the same; expected a route that changes")
        fixed = round(share * lines.mean_bytes) + CHUNK_BYTES * len(lines.chunks)
        step = float(torch.tensor(self._fitting_step(lines, fixed), dtype=torch.float32))  # as in the file
        return self.empty(lines.mean[None], step), lines

    def _fitting_step(self, lines: RouteLines, fixed: int) -> float:
        """The smallest step whose coded lines fit into the budget, or the step that `step` or `hold` says."""
        if self.step is not None:
            return self.step
        if self.route_bytes_per_place is None:
            # lines that `resolution` removes do not count as missing
            step = lines.even().step_that_holds(self.hold or HELD)
            room = 0 if self.hold else LINE_BYTES * len(lines.lines)
            return lines.step_of(room) if lines.coded_bytes(step) < room else step
        places, dimension = lines.lines.shape
        budget, least = self.route_bytes_per_place, (fixed + lines.coded_bytes(lines.coarsest)) / places
        most = math.floor(least) + 4 * dimension  # all numbers as floats
        if not least < budget <= most:
            example = math.ceil(least + min(5, 2 * dimension))
            expected = f"more than {least:.3g} for mean and chunks, such as {example}"
            expected += f", and at most {most}, with all numbers as floats"
            raise InputError(f"route_bytes_per_place is {budget:g}; expected {expected}")
        return lines.step_of(budget * places - fixed)


@torch.no_grad()
def encode_chunk(
    descriptors: Tensor,
    mean: Tensor,
    step: float,
    transform: Transform = "dft",
    resolution: float = 0.0,
    columns: int = 1,
) -> Chunk:
    """The coded lines of one chunk, for `SpectralMap.extend`; the same on any machine.

    Args:
        mean: (K,) of the route's descriptors. step: of the lines. transform, resolution: of the map. columns:
            of a tile of an area.

    Shape: descriptors (W,K).

    Raises:
        InputError: descriptors that are not finite floats (W,K).
    """
    check_descriptors(descriptors, len(mean))
    size = len(descriptors) // columns, columns
    (levels,) = RouteLines(descriptors, [size], transform, resolution, mean).levels(step)
    digest = Digest(torch.arange(len(descriptors)), digests_of(descriptors))
    return Chunk(len(descriptors), step, encode(levels), unseen(descriptors), columns, digest)


def unseen(descriptors: Tensor) -> tuple[int, ...]:
    """Which descriptors (W,K) are 0, as those of covered or black frames, see `Descriptor`."""
    return tuple((~descriptors.any(1)).nonzero()[:, 0].tolist())


def check_descriptors(features: Tensor, dimension: int | None = None) -> None:
    """Refuse what is not a route of descriptors or, with a dimension, a chunk of one."""
    least, expected = (2, "K") if dimension is None else (1, dimension)
    fits = features.ndim == 2 and len(features) >= least and dimension in (None, features.shape[1])
    if not fits or not features.numel() or not features.is_floating_point():
        seen = f"the descriptors are {tuple(features.shape)} {features.dtype}"
        raise InputError(f"{seen}; expected floats (N, {expected}), N at least {least}")
    if not all(bool(part.isfinite().all()) for part in features.split(ROWS)):
        raise InputError("the descriptors hold NaN or infinity; expected finite numbers")
