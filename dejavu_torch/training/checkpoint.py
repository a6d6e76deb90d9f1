"""What a checkpoint must agree with."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch

from dejavu_torch.database.template_map import CompressedMap
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.types import InputError, Plan

PREFIX = "dejavu.map."


def stored_map(checkpoint: dict[str, Any], periods: PeriodFinder) -> CompressedMap:
    """The map of a checkpoint. Found layers are taken over; imposed ones have to be those of this run.

    Raises:
        InputError: no map in it, or one of other imposed periods.
    """
    named = checkpoint["state_dict"].items()
    state = {name.removeprefix(PREFIX): tensor for name, tensor in named if name.startswith(PREFIX)}
    if "size" not in state:
        raise InputError("the checkpoint holds no map; expected one of a PlaceRecognitionTask")
    route = CompressedMap()
    route.load_state_dict(state)
    if isinstance(periods, ImposedPeriods):
        imposed = periods.plan(torch.zeros(1, 1).expand(route.places, route.dimension))
        if imposed != route.plan:
            raise InputError(
                f"the checkpoint holds layers of {_layers(route.plan)} frames, this run imposes "
                f"{_layers(imposed)}; expected a checkpoint of the same periods"
            )
    return route


def check_trained(checkpoint: dict[str, Any], own: Collection[str]) -> None:
    """Refuse a checkpoint in which other parameters were trained.

    Raises:
        InputError: naming some of them.
    """
    other = sorted(set(own) ^ set(checkpoint.get("trained", own)))
    if other:
        raise InputError(
            f"{', '.join(other[:3])}: trained in the checkpoint or in this run, not in both; expected a "
            "checkpoint of the same settings"
        )


def _layers(plan: Plan) -> str:
    return ", ".join(f"{layer.phases} in {layer.period}" for layer in plan) or "no"
