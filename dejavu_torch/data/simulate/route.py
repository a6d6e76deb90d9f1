"""The base of all simulated routes: checked options, an address, frames on demand, reproducible draws."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import field, fields
from hashlib import blake2b
from numbers import Integral, Real
from typing import Any, ClassVar, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.memory import in_float32
from dejavu_torch.types import Facts, InputError, Traverse

_T = TypeVar("_T")


def option(default: float, low: float, high: float = math.inf) -> Any:
    """A field with its default, minimum and maximum; only whole numbers are valid if the default is one."""
    return field(default=default, metadata={"span": (low, high)})


def choice(*names: str) -> Any:
    """A field with one of these names as value, the first by default."""
    return field(default=names[0], metadata={"names": names})


class SimulatedRoute(Traverse):
    """A simulated route: the true place of every frame is known.

    A subclass is a dataclass of `option` and `choice` fields, including `seed` and `traverse`. It sets
    `length` and `places`, and draws each frame in `_frames` from its number and the options only.
    """

    kind: ClassVar[str]  # as in `sim:KIND?seed=0`
    ordered: ClassVar[bool] = True  # type: ignore[misc]
    length: int
    places: Tensor

    def __post_init__(self) -> None:
        """Check the options, and name the route by those that differ from their defaults."""
        address = []
        for entry in fields(self):  # type: ignore[arg-type]  # a subclass is a dataclass
            key, default = entry.name, getattr(type(self), entry.name)
            value = getattr(self, key)
            if expected := _expected(key, value, default, dict(entry.metadata)):
                raise InputError(f"sim:{self.kind} has {key}={value}; expected {expected}")
            value = type(default)(value)
            setattr(self, key, value)
            # the name includes the number of frames, unless 0: the whole route
            if key in ("seed", "traverse") or value != (0 if key == "frames" else default):
                address.append(f"{key}={value}")
        self.name = f"sim:{self.kind}?" + "&".join(address)

    @abstractmethod
    def _frames(self, at: Tensor) -> Tensor:
        """Draw the frames with these numbers. Shape: (B,) int64 -> (B,3,H,W) float32 in [0,1]."""

    def __reduce__(self) -> tuple[object, ...]:
        # without the scenery drawn so far
        return type(self), tuple(getattr(self, entry.name) for entry in fields(self))  # type: ignore[arg-type]

    def __len__(self) -> int:
        return self.length

    @in_float32()
    def read(self, frames: range | list[int]) -> Tensor:
        return self._frames(torch.as_tensor(frames))


def _expected(key: str, value: object, default: object, allowed: Facts) -> str:
    """The valid values of an option; "" if its value is one of them."""
    if "names" in allowed:
        return "" if value in allowed["names"] else " or ".join(allowed["names"])
    low, high = allowed["span"]
    whole = isinstance(default, int)
    if isinstance(value, Integral if whole else Real) and low <= value <= high:
        return ""
    span = f"{low} <= {key} <= {high}" if high < math.inf else f"{key} >= {low}"
    return f"{span}, a whole number" if whole else span


class Random:
    """Draws that depend on the key only, independent of torch's global generator."""

    def __init__(self, *key: object) -> None:
        digest = blake2b(repr(key).encode(), digest_size=4).digest()
        self.generator = torch.Generator().manual_seed(int.from_bytes(digest, "big"))

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), dtype=torch.float32, generator=self.generator))

    def pick(self, items: Sequence[_T]) -> _T:
        return items[int(torch.randint(len(items), (), generator=self.generator))]

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, dtype=torch.float32, generator=self.generator)

    def texture(self, height: int, width: int, cell: float) -> Tensor:
        """Smooth noise (height, width) of unit variance: 4 octaves, the coarsest of `cell` pixels."""
        total = torch.zeros(height, width)
        for k in range(4):
            knots = self.normal(1, 1, *(2 + int(n * 2**k / cell) for n in (height, width)))
            total += 0.6**k * F.interpolate(knots, (height, width), mode="bicubic")[0, 0]
        return total / total.std()

    def scattered(self, start: float, stop: float, gap: tuple[float, float]) -> Tensor:
        """Aperiodic increasing positions with gaps drawn from this range, (n,) float64, at least one."""
        found = [start + self.uniform(0, gap[1])]
        while (after := found[-1] + self.uniform(*gap)) < stop:
            found.append(after)
        return torch.tensor(found, dtype=torch.float64)

    def wander(self, frames: int) -> Tensor:
        """A slow curve within [-1, 1], (frames,) float64."""
        i, curve = torch.arange(frames, dtype=torch.float64), torch.zeros(frames, dtype=torch.float64)
        for weight, period in ((0.2, 170.0), (0.35, 420.0), (0.45, 1100.0)):
            turns = i / (period * self.uniform(0.7, 1.3)) + self.uniform(0, 1)
            curve += weight * torch.sin(2 * math.pi * turns)
        return curve


def rgb(colour: str) -> Tensor:
    """A colour rrggbb as (3,1,1) in [0,1]."""
    return torch.tensor(list(bytes.fromhex(colour))).view(3, 1, 1) / 255
