"""Where a backbone starts from, and what of it stays as it is while the rest is trained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from torch import nn

from dejavu_torch.database.mapfile import read_map
from dejavu_torch.types import InputError

# follow the batches in training: their running statistics change without any gradient
BATCH = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm)
RUNNING = (*BATCH, nn.InstanceNorm1d, nn.InstanceNorm2d, nn.InstanceNorm3d)
CODE = ("linear.layers.", "standardise.")  # of an Embedding with a Coder


def freeze(
    backbone: nn.Module, prefixes: Sequence[str], batch_norm: Literal["train", "frozen"]
) -> list[nn.Module]:
    """Take the gradient from parameters; return the modules whose running statistics have to stay.

    Args:
        prefixes: parameters whose names begin with one of these are frozen; "" is all of them.
        batch_norm: "frozen" keeps the running statistics of all BatchNorm, "train" of those in frozen parts.

    Raises:
        InputError: a prefix that no parameter begins with.
    """
    for prefix in prefixes:
        chosen = [p for name, p in backbone.named_parameters() if name.startswith(prefix)]
        if not chosen:
            known = sorted({name.partition(".")[0] for name, _ in backbone.named_parameters()})
            raise InputError(
                f"freeze names {prefix!r}, which no parameter of {type(backbone).__name__} begins with; "
                f"expected one of {', '.join(known) or 'none, it has none'}"
            )
        for parameter in chosen:
            parameter.requires_grad_(False)
    return [
        module
        for name, module in backbone.named_modules()
        if isinstance(module, RUNNING)
        and (batch_norm == "frozen" or any(f"{name}.".startswith(prefix) for prefix in prefixes))
    ]


def start_from(backbone: nn.Module, path: str | Path) -> None:
    """Give a backbone the weights that a map file holds.

    Of a whitened descriptor its code is left out, which is of the other route, and of any dimension.

    Raises:
        InputError: no map file, or one of another backbone.
    """
    tensors, header = read_map(Path(path))
    prefix = "features."
    weights = {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
    if bool(weights.get("linear.whitened", False)):
        own = {name: t for name, t in backbone.state_dict().items() if name.startswith(CODE)}
        weights = {name: t for name, t in weights.items() if not name.startswith(CODE)} | own
    try:
        backbone.load_state_dict(weights)
    except RuntimeError as error:
        raise InputError(
            f"{path} holds weights of {header['features']}; expected those of the same "
            f"{type(backbone).__name__}"
        ) from error
