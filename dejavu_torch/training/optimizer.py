"""AdamW with a learning rate that rises, then falls to 0."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch.nn import Module, Parameter
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR


def adamw(parameters: Iterable[Parameter], lr: float, weight_decay: float) -> AdamW:
    """AdamW that lets only what is multiplied with something decay: matrices and kernels."""
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    groups = [
        {"params": [p for p in trained if p.ndim > 1], "weight_decay": weight_decay},
        {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
    ]
    return AdamW([group for group in groups if group["params"]], lr=lr)


def rise_and_fall(optimizer: AdamW, steps: int) -> LambdaLR:
    """The learning rate rises over the first tenth of the steps, then falls along a cosine to 0."""
    rise = max(1, round(steps / 10))

    def height(step: int) -> float:
        if step < rise:
            return (step + 1) / rise
        return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (step - rise) / max(1, steps - rise)))

    return LambdaLR(optimizer, height)


def replace(optimizer: torch.optim.Optimizer, before: Module, after: Module) -> None:
    """Train the parameters of `after` instead of those of `before`, with nothing remembered of the old."""
    new = dict(after.named_parameters())
    for name, old in before.named_parameters():
        for group in optimizer.param_groups:
            group["params"] = [new[name] if parameter is old else parameter for parameter in group["params"]]
        optimizer.state.pop(old, None)
