"""Features of all the frames that are stored, while a backbone is in training."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from dejavu_torch.features.extract import features_of
from dejavu_torch.training.frames import as_frames
from dejavu_torch.types import InputError


@contextmanager
def in_mode(module: nn.Module, training: bool) -> Iterator[None]:
    """The module in training or eval mode; afterwards every part is in its own mode again."""
    modes = [(part, part.training) for part in module.modules()]
    module.train(training)
    try:
        yield
    finally:
        for part, before in modes:
            part.training = before


@torch.no_grad()
def reference_features(
    pipeline: nn.Module, values: Tensor, at_once: int, device: torch.device, name: str, shuffled: bool
) -> Tensor:
    """Features of stored frames, in 32 bits and in their order.

    Args:
        values: (N,C,H,W) uint8 or (N,D). at_once: frames of a batch. name: of the traverse, for messages.
        shuffled: whether batches hold frames from all over the route, as those of training do; it is that
            batch statistics are gathered from.

    Shape: -> (N,D).

    Raises:
        InputError: a backbone that does not take the frames, or makes NaN.
    """
    maker = type(list(pipeline.children())[-1]).__name__
    order = torch.randperm(len(values)) if shuffled else torch.arange(len(values))
    count = min(-(-len(order) // at_once), len(order) // 2)  # none of a single frame
    features = torch.zeros(0, device=device)
    for batch in order.tensor_split(count):
        try:
            with torch.autocast(device.type, enabled=False):
                part = features_of(as_frames(values[batch]).to(device), pipeline, "the batch")
        except RuntimeError as error:
            told = " ".join(str(error).split())[:200]
            raise InputError(f"{maker} does not take frames {tuple(values.shape[1:])}: {told}") from error
        if not len(features):
            features = part.new_empty(len(values), part.shape[1])
        features[batch.to(device)] = part
    if not features.isfinite().all():
        raise InputError(f"{maker} makes NaN or infinite features of {name}; expected finite numbers")
    return features
