"""What several test files need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.types import FrequencyLayer, InputError, Plan, Traverse


@contextmanager
def refused(*words: str) -> Iterator[None]:
    """The block is refused in one line that holds these words."""
    with pytest.raises(InputError) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message


def all_of(traverse: Traverse, batch: int = 64) -> Tensor:
    return torch.cat(list(traverse.batches(batch)))


class Fixed(PeriodFinder):
    """Layers that are known beforehand."""

    def __init__(self, *layers: FrequencyLayer) -> None:
        super().__init__()
        self.layers = layers

    def plan(self, features: Tensor) -> Plan:
        return self.layers
