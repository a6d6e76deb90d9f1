"""What every way of finding periods offers."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from dejavu_torch.types import Plan


class PeriodFinder(nn.Module, ABC):
    """Finds which features repeat, where and how often. Subclass it to bring your own.

    A map file names a finder of this package only: a map learned with your own loads without it.
    """

    @abstractmethod
    def plan(self, features: Tensor) -> Plan:
        """Layers of a route: exact numbers, where gradients stop.

        Shape: features (N,D) -> plan; empty where nothing repeats.
        """
