"""Periods that are imposed instead of found, for features that are trained to repeat."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from fractions import Fraction

from torch import Tensor

from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.support import Support, support_of, supportive_periods
from dejavu_torch.types import FrequencyLayer, InputError, Plan

log = logging.getLogger("dejavu_torch")


class ImposedPeriods(PeriodFinder):
    """The same small layers over the whole route, whatever the features: frame i has phase i // bin mod P.

    Args:
        periods: P of each layer, distinct, >= 2, in bins; None chooses `supportive_periods` for the route.
        bin: frames that share a phase, >= 1; the tolerance is a sensible size.
        templates, corrects, layers: what `supportive_periods` may spend and must give where `periods` is
            None; unused otherwise. Without `templates` it spends the least that will do.
        separate: give layer j the j-th of L equal slices of the features instead of all of them.
        stagger: let the bins of the layers drift past each other, so that together they tell frames apart
            that share a bin: the periods are P * bin frames and, in turn, a tenth of a bin more and less.
            What `support` says holds for nearly all places then, not for every one.

    Shape: features (N,D), N >= 2 -> plan of L layers, each of period P * bin frames and P phases over 0..N.

    Convention: the last bin may be short. Given periods keep their order. Those that cannot tell the bins of
        the route apart are allowed and logged in a line; one period of as many phases as bins is a
        classifier of places. A phase that no frame has gets a template that nothing reads.

    Raises:
        InputError: periods or a bin out of range, features not (N,D) with N >= 2 and D >= 1, a D that L
            slices do not divide, or a budget that no set of periods fits.

    Example:
        >>> [layer.phases for layer in ImposedPeriods(bin=5).plan(Tensor(2700, 8))]
        [4, 5, 7, 9, 11, 13]
    """

    def __init__(
        self,
        periods: list[int] | None = None,
        bin: int = 5,
        templates: int | None = None,
        corrects: int = 1,
        layers: int | None = None,
        separate: bool = False,
        stagger: bool = False,
    ) -> None:
        super().__init__()
        if bin < 1 + stagger:
            least = "2 frames to stagger" if stagger else "1 frame"
            raise InputError(f"imposed periods got bin={bin}; expected at least {least}")
        if periods is not None and not _fit(periods):
            raise InputError(f"imposed periods are {periods}; expected distinct whole numbers >= 2, in bins")
        self.periods = None if periods is None else list(periods)
        self.bin = bin
        self.templates = templates
        self.corrects = corrects
        self.layers = layers
        self.separate = separate
        self.stagger = stagger

    def periods_for(self, places: int) -> tuple[int, ...]:
        """The periods, in bins, of a route of `places` frames."""
        if self.periods is not None:
            return tuple(self.periods)
        bins = max(2, self._bins(places))  # a route of a single bin leaves nothing to tell apart
        return supportive_periods(bins, self.templates, self.corrects, self.layers)

    def support(self, places: int, tolerance: int) -> Support:
        """How the layers support each other over a route, counted in bins.

        Args:
            places, tolerance: in frames; bins that hold frames within the tolerance count as one.
        """
        return support_of(self.periods_for(places), self._bins(places), self._bins(tolerance))

    def plan(self, features: Tensor) -> Plan:
        if features.ndim != 2 or len(features) < 2 or features.shape[1] < 1:
            raise InputError(
                f"imposed periods got features {tuple(features.shape)}; expected (N,D) with N >= 2, D >= 1"
            )
        frames, dimension = features.shape
        periods = self.periods_for(frames)
        slices = len(periods) if self.separate else 1
        if dimension % slices:
            raise InputError(
                f"{slices} layers cannot share {dimension} features; expected a multiple of {slices}"
            )
        told = math.lcm(*periods)
        if told < self._bins(frames):
            log.warning(
                f"periods {periods} tell {told} bins apart; the route has {self._bins(frames)}, "
                f"so frames {told * self.bin} apart look alike"
            )
        width = dimension // slices
        parts = [tuple(range(j * width, (j + 1) * width)) for j in range(slices)]
        drift = Fraction(self.bin, 10) if self.stagger and len(periods) > 1 else Fraction(0)
        return tuple(
            FrequencyLayer(period * self.bin + (-1) ** j * drift, period, 0, frames, parts[j % slices])
            for j, period in enumerate(periods)
        )

    def _bins(self, frames: int) -> int:
        return -(-frames // self.bin)

    def extra_repr(self) -> str:
        names = ("periods", "bin", "templates", "corrects", "layers", "separate", "stagger")
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in names)


def _fit(periods: Sequence[int]) -> bool:
    """Whether these are periods that can be imposed."""
    whole = all(isinstance(period, int) and period >= 2 for period in periods)
    return whole and 0 < len(periods) == len(set(periods))
