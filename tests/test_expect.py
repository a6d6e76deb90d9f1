"""Refusals of bad input in one line."""

from __future__ import annotations

import pytest
import torch
from helpers import refused

from dejavu_torch.types import InputError, check_shape, expect


def test_what_fits_passes() -> None:
    expect([0], "a member", members=[0])
    for dims in ("5 3", "Q K", "Q 3", "Q>=5 K>=1"):
        check_shape(torch.zeros(5, 3), dims, "the queries are")


def test_messages_tell_what_was_seen_and_expected() -> None:
    with refused("k is 0 and name is 'x'; expected 1 or more"):
        expect(False, "1 or more", k=0, name="x")
    with refused("mapper is a dict; expected a Mapper"):
        expect(0, "a Mapper", mapper=dict)
    with pytest.raises(InputError, match=r"^a route without frames; expected some$"):
        expect([], "some", "a route without frames")


def test_other_shapes_are_refused() -> None:
    for dims, expected in (
        ("Q 2", "(Q, 2)"),
        ("Q 4", "(Q, 4)"),
        ("Q K 3", "(Q, K, 3)"),
        ("Q>=6 K", "(Q>=6, K)"),
        ("5", "(5,)"),
    ):
        with refused(f"the queries are (5, 3); expected {expected}"):
            check_shape(torch.zeros(5, 3), dims, "the queries are")
