"""What every way of finding periods offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from torch import Tensor, nn

from dejavu_torch.types import InputError, Plan


class PeriodFinder(nn.Module, ABC):
    """Finds which features repeat, where and how often. Subclass it to bring your own."""

    @abstractmethod
    def plan(self, features: Tensor) -> Plan:
        """Layers of a route: exact numbers, where gradients stop.

        Shape: features (N,D) -> plan; empty where nothing repeats.
        """


class ForeignPeriods(PeriodFinder):
    """Stands for the finder of a map file that is not of this package: only learning would need it.

    Args:
        class_path, init_args: of the finder, as the file names it.
    """

    def __init__(self, class_path: str, init_args: dict[str, Any]) -> None:
        super().__init__()
        self.class_path, self.init_args = class_path, init_args

    def plan(self, features: Tensor) -> Plan:
        raise InputError(
            f"the map's periods were found by {self.class_path}; expected that module to learn anew"
        )

    def extra_repr(self) -> str:
        return f"class_path={self.class_path!r}"
