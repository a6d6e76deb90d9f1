"""The interface of period finders."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from dejavu_torch.types import Plan


class PeriodFinder(nn.Module, ABC):
    """Finds which features repeat, where and how often. Subclass it to add another.

    A map file names only finders of this package: a map learned with your own loads without it.
    """

    @abstractmethod
    def plan(self, features: Tensor) -> Plan:
        """The layers of a route, without gradient: features (N,D) -> plan, empty if nothing repeats."""
