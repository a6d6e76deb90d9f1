"""AdamW with a learning rate that rises, then falls to 0."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch.nn import Module, Parameter
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from dejavu_torch.types import InputError


def adamw_of(
    parameters: Iterable[Parameter],
    lr: float,
    weight_decay: float,
    steps: float,
    first: int = 0,
    held: Sequence[Parameter] = (),
) -> dict[str, Any]:
    """AdamW, and a schedule: the learning rate rises over the first tenth of the steps, then falls along a
    cosine to 0. Only what is multiplied with something decays: matrices and kernels.

    Args:
        parameters: those without gradient are left out.
        first: steps of a stage ahead of the others, in which the rate rises and falls as well.
        held: parameters that get no gradient after that stage, which a resumed optimizer has nevertheless.

    Returns:
        What Lightning's `configure_optimizers` gives.

    Raises:
        InputError: steps without an end.
    """
    if not math.isfinite(steps):
        raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
    until = {id(parameter) for parameter in held}
    trained = [parameter for parameter in parameters if parameter.requires_grad or id(parameter) in until]
    groups = [
        {"params": [p for p in trained if p.ndim > 1], "weight_decay": weight_decay},
        {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
    ]
    optimizer = AdamW([group for group in groups if group["params"]], lr=lr)

    def height(step: int) -> float:
        past, length = (step, first) if step < first else (step - first, steps - first)
        rise = max(1, round(length / 10))
        if past < rise:
            return (past + 1) / rise
        return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (past - rise) / max(1.0, length - rise)))

    schedule = {"scheduler": LambdaLR(optimizer, height), "interval": "step"}
    return {"optimizer": optimizer, "lr_scheduler": schedule}


def replace(optimizer: torch.optim.Optimizer, before: Module, after: Module) -> None:
    """Train the parameters of `after` instead of those of `before`, with nothing remembered of the old."""
    new = dict(after.named_parameters())
    for name, old in before.named_parameters():
        for group in optimizer.param_groups:
            group["params"] = [new[name] if parameter is old else parameter for parameter in group["params"]]
        optimizer.state.pop(old, None)
