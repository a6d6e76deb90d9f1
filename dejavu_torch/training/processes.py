"""What the processes of one training share: a batch, its statistics and its gradients.

Each process takes its part of every batch, and what follows is that of one process with all of it. Random
numbers are drawn alike in all processes, but for those of the augmentation and of the network itself, so that
what is made of the whole route, such as a whitening or a map, is the same in each without being sent. A
process that is alone does nothing of this.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.strategies import DDPStrategy
from torch import Tensor, distributed, nn
from torch.nn.modules.batchnorm import _BatchNorm

from dejavu_torch.types import InputError


def processes() -> int:
    """How many there are."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def process() -> int:
    """The number of this one, from 0."""
    return distributed.get_rank() if processes() > 1 else 0


class _Sum(torch.autograd.Function):
    """The sum over processes, whose gradient is one too."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        values = values.clone()
        distributed.all_reduce(values)
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return _Sum.forward(ctx, gradients[0])


def mean_of_all(values: Tensor) -> Tensor:
    """The sum of a process's values over how many a process has on average: the mean over processes of such
    figures, and of their gradients, is the mean over all values. (n,) -> scalar, 0 where there are none.

    Example:
        >>> mean_of_all(torch.tensor([1.0, 2.0]))
        tensor(1.5000)
    """
    count = averaged(torch.tensor(float(len(values)), device=values.device))
    return values.sum() / count.clamp(min=1 / processes())


def averaged(values: Tensor) -> Tensor:
    """The mean over processes, without gradients."""
    if processes() == 1:
        return values
    values = values.detach().clone()
    distributed.all_reduce(values)
    return values / processes()


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace each gradient by its mean over processes, all in one message.

    What no process has a gradient of stays without.
    """
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    if processes() == 1 or not trained:
        return
    parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in trained]
    has = parts[0].new_tensor([p.grad is not None for p in trained], dtype=torch.float32)
    mean = averaged(torch.cat([has, *(part.float().flatten() for part in parts)]))
    has, *means = mean.split([len(trained), *(p.numel() for p in trained)])
    for parameter, found, part in zip(trained, has.tolist(), means, strict=True):
        if found:
            parameter.grad = part.view_as(parameter).to(parameter.dtype)


def own_part(values: Tensor) -> Tensor:
    """This process's rows of values that all have alike."""
    return values.tensor_split(processes())[process()]


def noise_like(values: Tensor) -> Tensor:
    """Normal noise on the rows of this process, drawn for those of all, of the CPU's random numbers."""
    shape = (processes() * len(values), *values.shape[1:])
    return own_part(torch.randn(shape, dtype=values.dtype)).to(values.device)


@contextmanager
def own_random(step: int) -> Iterator[None]:
    """Random numbers of this process alone, others at each step; those of all go on as if none were drawn."""
    if processes() == 1:
        yield
        return
    with torch.random.fork_rng():
        torch.manual_seed(int(torch.randint(2**62, ())) + processes() * step + process())
        yield


@contextmanager
def shared_statistics(module: nn.Module) -> Iterator[None]:
    """Batch normalisation in training mode is by the statistics of the batch of all processes.

    Torch's SyncBatchNorm is for GPUs alone, and takes the place of modules that others hold.
    """
    found = (part for part in module.modules() if isinstance(part, _BatchNorm) and part.training)
    norms = list(found) if processes() > 1 else []
    for norm in norms:
        norm.forward = partial(_normalised, norm)  # type: ignore[method-assign]
    try:
        yield
    finally:
        for norm in norms:
            del norm.forward


def _normalised(norm: _BatchNorm, batch: Tensor) -> Tensor:
    """What a batch normalisation gives of its part of a batch, (B,C,...); running statistics are updated."""
    values = batch.float()
    dims, shape = [0, *range(2, batch.ndim)], (1, -1, *[1] * (batch.ndim - 2))

    def summed(of: Tensor) -> Tensor:
        total: Tensor = _Sum.apply(of)  # type: ignore[no-untyped-call]
        return total

    count = summed(values.new_tensor(values.numel() // values.shape[1]))
    mean = summed(values.sum(dims)) / count
    centred = values - mean.view(shape)
    variance = summed(centred.square().sum(dims)) / count
    if norm.track_running_stats and norm.running_mean is not None and norm.running_var is not None:
        with torch.no_grad():
            assert norm.num_batches_tracked is not None
            norm.num_batches_tracked += 1
            share = 1 / norm.num_batches_tracked if norm.momentum is None else norm.momentum
            norm.running_mean += share * (mean - norm.running_mean)
            norm.running_var += share * (variance * count / (count - 1) - norm.running_var)
    out = centred * (variance + norm.eps).rsqrt().view(shape)
    if norm.affine:
        out = out * norm.weight.view(shape) + norm.bias.view(shape)
    return out.to(batch.dtype)


def share(task: pl.LightningModule, trainer: pl.Trainer) -> None:
    """Make the processes of a trainer begin alike.

    Convention: a training makes new parameters as it goes, which a model that DDP has wrapped would not know;
        so the strategy starts the processes, and the task averages its gradients by `average_gradients`.

    Raises:
        InputError: a strategy that is not DDP.
    """
    if trainer.world_size == 1:
        return
    strategy = trainer.strategy
    if not isinstance(strategy, DDPStrategy):
        raise InputError(f"the strategy is {type(strategy).__name__}; expected ddp on several devices")
    strategy.configure_ddp = lambda: None  # type: ignore[method-assign]
    state, random = strategy.broadcast((task.state_dict(), torch.get_rng_state()))
    task.load_state_dict(state)
    torch.set_rng_state(random)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(torch.initial_seed())
