"""The lines of a spectral map that are not 0, a few bytes each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.maps.codec import ESCAPE, to_int8
from dejavu_torch.types import InputError

AT_ONCE = 2**20  # levels looked through at a time
MOST = 2**31 - 1  # places of a map, and coefficients: what the smaller index types hold
COUNTING = (torch.uint8, torch.int16, torch.int32)
SIGNED = (torch.int8, torch.int16, torch.int32)


class Coefficients(NamedTuple):
    """Levels that are not 0, line by line, each in the smallest type that holds all.

    counts: (W,) of each line how many. feature: (L,) the number of the descriptor that each is of, ascending
    within a line. level: (L,) in steps.
    """

    counts: Tensor
    feature: Tensor
    level: Tensor


def coefficients_of(small: Tensor, escapes: Tensor) -> Coefficients:
    """Those of the levels that `codec.to_int8` gives.

    Shape: (W,K) int8, (E,) int32.

    Raises:
        InputError: other escapes than the levels have room for.

    Example:
        >>> levels = torch.tensor([[0, 0, 5], [0, 0, 0], [-1, 2, 0]], dtype=torch.int8)
        >>> coefficients_of(levels, torch.zeros(0))
        Coefficients(counts=tensor([1, 0, 2], dtype=torch.uint8),
                     feature=tensor([2, 0, 1], dtype=torch.uint8),
                     level=tensor([ 5, -1,  2], dtype=torch.int8))
    """
    return with_escapes(nonzero_of(small), escapes)


def nonzero_of(small: Tensor) -> Coefficients:
    """`coefficients_of` of levels (W,K) int8 in which escapes are marked."""
    width, parts = small.shape[1], []
    for rows in small.split(max(1, AT_ONCE // max(1, width))):
        there = rows != 0
        counts = there.sum(1).to(_type_for(width))
        parts.append(Coefficients(counts, there.nonzero()[:, 1].to(_type_for(width - 1)), rows[there]))
    return joined(parts)


def with_escapes(marked: Coefficients, escapes: Tensor) -> Coefficients:
    """The coefficients with the escapes (E,) int32 where `nonzero_of` has their marks.

    Raises:
        InputError: other escapes than there are marks.
    """
    counts, feature, level = marked
    marks = level == ESCAPE
    if int(marks.sum()) != len(escapes) or bool((escapes.abs() <= 127).any()):
        raise InputError(
            f"{len(escapes)} escapes; expected {int(marks.sum())}, of levels that a byte does not hold"
        )
    if len(escapes):
        large = torch.int16 if int(escapes.abs().max()) < 2**15 else torch.int32
        level = level.to(large).masked_scatter(marks, escapes.to(large))
    return Coefficients(counts, feature, level)


def levels_of(coefficients: Coefficients, width: int) -> Tensor:
    """All levels, (W,K), zeros too."""
    counts, feature, level = coefficients
    levels = level.new_zeros(len(counts), width)
    return levels.index_put((lines_of(counts, len(level)).long(), feature.long()), level)


def coded_levels(coefficients: Coefficients, width: int) -> tuple[Tensor, Tensor]:
    """The inverse of `coefficients_of`: (W,K) int8 and (E,) int32."""
    small, escapes = to_int8(coefficients.level.to(torch.int32))
    return levels_of(coefficients._replace(level=small), width), escapes


def lines_of(counts: Tensor, total: int) -> Tensor:
    """The line of each coefficient, (L,) int32.

    Args:
        total: L, the sum of the counts; it is not read from them, which may be on another device.
    """
    lines = torch.arange(counts.shape[0], dtype=torch.int32, device=counts.device)
    return lines.repeat_interleave(counts.int(), output_size=total)


def joined(parts: Sequence[Coefficients]) -> Coefficients:
    """Coefficients of lines one behind the other."""
    return Coefficients(*(torch.cat(column) for column in zip(*parts, strict=True)))


def disagreement(coefficients: Coefficients, width: int) -> str:
    """What is wrong with coefficients that were read, in words; empty where nothing is."""
    kinds = COUNTING, COUNTING, SIGNED
    for name, tensor, types in zip(Coefficients._fields, coefficients, kinds, strict=True):
        if tensor.ndim != 1 or tensor.dtype not in types:
            return f"{name} {tuple(tensor.shape)} {tensor.dtype}; expected whole numbers of one dimension"
    counts, feature, level = coefficients
    total = int(counts.sum())
    if int(counts.min() if len(counts) else 0) < 0 or not total == len(feature) == len(level):
        return f"{len(feature)} features and {len(level)} levels; expected {total}, as the lines count"
    if not total:
        return ""
    begins = counts.cumsum(0, dtype=torch.int64)[:-1]
    ascending = feature[1:] > feature[:-1]
    ascending[begins[(begins > 0) & (begins < total)] - 1] = True  # from one line to the next
    if int(feature.min()) < 0 or int(feature.max()) >= width or not bool(ascending.all()):
        return f"features out of order; expected numbers from 0 to {width - 1}, ascending within a line"
    return ""


def check_sizes(places: int, coefficients: int = 0) -> None:
    """Refuse more than the index type holds.

    Raises:
        InputError: naming the numbers.
    """
    if max(places, coefficients) > MOST:
        raise InputError(
            f"the map has {places} places and {coefficients} coefficients; expected at most {MOST} of each: "
            "make several maps"
        )


def _type_for(number: int) -> torch.dtype:
    return COUNTING[0] if number < 2**8 else COUNTING[1] if number < 2**15 else COUNTING[2]
