"""What every way of finding periods offers."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor, nn

from dejavu_torch.types import Plan


class PeriodFinder(nn.Module):
    """Finds which features repeat, where and how often. Subclass it to bring your own."""

    @abstractmethod
    def plan(self, features: Tensor) -> Plan:
        """Layers of a traverse: exact numbers, the one place where gradients stop.

        Shape: features (N,D) -> plan; empty where nothing repeats.
        """
