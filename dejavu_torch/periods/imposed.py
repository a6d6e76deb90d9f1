"""Periods that are imposed instead of found, for features that are trained to repeat."""

from __future__ import annotations

import logging
import math
from fractions import Fraction

from torch import Tensor

from dejavu_torch.memory import check_room
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.support import supportive_periods
from dejavu_torch.text import settings_of
from dejavu_torch.types import FrequencyLayer, InputError, Plan, check_shape, expect

LONGEST = 2**24  # bins in a period, and places in a bin, so that products fit into int64

log = logging.getLogger("dejavu_torch")


class ImposedPeriods(PeriodFinder):
    """The same small layers over the whole route, whatever the features: place i has phase i // bin mod P.

    Args:
        periods: P of each layer, distinct, >= 2, in bins; None chooses `supportive_periods` for the route.
        bin: places that share a phase, >= 1; the tolerance is a good choice.
        stagger: shift the bins of different layers, to distinguish the places within a bin: the periods
            are P * bin places, alternately plus and minus a tenth of a bin.

    Shape: features (N,D), N >= 2 -> plan of L layers, each of P phases over 0..N and all D features.

    Convention: the last bin may be short. Periods too few to distinguish the bins of the route are allowed,
        with a warning. One period of as many phases as bins is a classifier of places.

    Raises:
        InputError: periods or bin out of range, features of another shape.

    Example:
        >>> [layer.phases for layer in ImposedPeriods(bin=5).plan(Tensor(2700, 8))]
        [4, 5, 7, 9, 11, 13]
    """

    def __init__(self, periods: list[int] | None = None, bin: int = 5, stagger: bool = False) -> None:
        super().__init__()
        expected = f"at least {'2 places to stagger' if stagger else '1 place'}, at most {LONGEST}"
        expect(1 + stagger <= bin <= LONGEST, expected, f"imposed periods got bin={bin}")
        if periods is not None:
            fits = all(isinstance(period, int) and 2 <= period <= LONGEST for period in periods)
            if not fits or not periods or len(periods) > len(set(periods)):
                expected = f"distinct integers from 2 to {LONGEST}"
                raise InputError(f"imposed periods are {periods}; expected {expected}")
        self.periods = None if periods is None else list(periods)
        self.bin, self.stagger = bin, stagger

    def plan(self, features: Tensor) -> Plan:
        check_shape(features, "N>=2 D>=1", "imposed periods got")
        places, dimension = features.shape
        bins = -(-places // self.bin)
        periods = self.periods or supportive_periods(bins)
        check_room(4 * sum(periods) * dimension, f"a template for each of {sum(periods)} imposed phases")
        if (distinct := math.lcm(*periods)) < bins:
            seen = f"periods {tuple(periods)} distinguish {distinct} bins; the route has {bins}"
            log.warning(f"{seen}, so places {distinct * self.bin} apart look the same")
        drift = Fraction(self.bin, 10) if self.stagger and len(periods) > 1 else Fraction(0)
        return tuple(
            FrequencyLayer(period * self.bin + (-1) ** j * drift, period, 0, places, tuple(range(dimension)))
            for j, period in enumerate(periods)
        )

    extra_repr = settings_of
