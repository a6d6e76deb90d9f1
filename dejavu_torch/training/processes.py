"""A training by several processes, which share a batch, its gradients and running statistics.

Losses and gradients equal those of one process with the whole batch; only batch normalisation is per part.
All processes draw the same random numbers, except for augmentation and network. So each computes the same
whitening and the same map of the whole route, and none has to be sent.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import pytorch_lightning as pl
import torch
from pytorch_lightning.strategies import DDPStrategy
from torch import Tensor, distributed, nn
from torch.optim import Optimizer

from dejavu_torch.types import InputError


def processes() -> int:
    """The number of processes."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def process() -> int:
    """The rank of this process, from 0."""
    return distributed.get_rank() if processes() > 1 else 0


def mean_of_all(values: Tensor) -> Tensor:
    """The sum of this process's values divided by the mean number of values per process: its mean over the
    processes, also of the gradients, is the mean over all values. (n,) -> scalar, 0 without any."""
    count = averaged(torch.tensor(float(len(values)), device=values.device))
    return values.sum() / count.clamp(min=1 / processes())


def averaged(values: Tensor) -> Tensor:
    """The mean over processes, without gradients."""
    if processes() == 1:
        return values
    values = values.detach().clone()
    distributed.all_reduce(values)
    return values / processes()


def average_gradients(optimizers: Iterable[Optimizer], module: nn.Module) -> None:
    """Replace each gradient that any process has, and the running statistics of a module, by their mean."""
    if processes() == 1:
        return
    groups = [group for optimizer in optimizers for group in optimizer.param_groups]
    trained = [parameter for group in groups for parameter in group["params"]]
    without = averaged(torch.tensor([float(parameter.grad is None) for parameter in trained]).to(trained[0]))
    for parameter, share in zip(trained, without.tolist(), strict=True):
        if share < 1:
            own = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parameter.grad = averaged(own)
    for buffer in module.buffers():
        if buffer.is_floating_point():
            buffer.copy_(averaged(buffer))


def own_part(values: Tensor) -> Tensor:
    """This process's rows of values that are the same in all processes."""
    return values.tensor_split(processes())[process()]


def noise_like(values: Tensor) -> Tensor:
    """Normal noise for the rows of this process, from CPU random numbers drawn for the rows of all."""
    shape = (processes() * len(values), *values.shape[1:])
    return own_part(torch.randn(shape, dtype=values.dtype)).to(values.device)


@contextmanager
def own_random(step: int) -> Iterator[None]:
    """Random numbers of this process alone, different at each step; the common state is restored after."""
    if processes() == 1:
        yield
        return
    with torch.random.fork_rng():
        torch.manual_seed(int(torch.randint(2**62, ())) + processes() * step + process())
        yield


def share(task: pl.LightningModule, trainer: pl.Trainer) -> None:
    """Make the processes of a trainer begin with the same state; a strategy other than DDP is an InputError.

    A training creates parameters, which a model wrapped by DDP would not know. So the strategy only starts
    the processes, and the task averages its gradients by `average_gradients`.
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
