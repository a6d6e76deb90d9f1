"""Features of a traverse, batch by batch."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from dejavu_torch.features.progress import shown
from dejavu_torch.features.views import AugmentedTraverse
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

BRIGHTEST = 1.5  # of a frame in [0, 1], whatever was done to it
APART = 1e-3  # of its length: by how much the features of a frame may differ alone and among others
ULPS = 4  # and of the coarsest numbers
TF32 = 2**-10  # what it rounds by


def feature_batches(
    traverse: Traverse,
    module: nn.Module,
    batch_size: int = 64,
    device: torch.device | str = "cpu",
    progress: str | None = None,
    look: Callable[[Tensor, Tensor], None] | None = None,
) -> Iterator[Tensor]:
    """Features of the frames of a traverse, in order, without gradients.

    Args:
        traverse: frames (B,C,H,W), or ready features (B,D), which pass unchanged.
        module: (B,C,H,W) -> (B,D). It runs in eval mode; the modes of its parts are restored.
        batch_size: frames in memory at a time; fewer if they are large.
        progress: what to call this work on stderr, see `shown`. Copies of an AugmentedTraverse count once.
        look: called with the first batch and its features.

    Shape: yields (B,D) float.

    Raises:
        InputError: features that are not (B,D) or not finite, or no frames at all.
    """
    done, looks = 0, traverse.copies if isinstance(traverse, AugmentedTraverse) else 1
    total = traverse.length and traverse.length // looks
    with shown(progress, total) as update, in_mode(module, False):
        for batch in traverse.batches(traverse.batch_size(batch_size)):
            with torch.no_grad():
                features = features_of(batch.to(device), module, traverse.name).detach()
            if features.dtype in (torch.float16, torch.bfloat16):  # too coarse to add up and to transform
                features = features.float()
            bad = ~features.isfinite().all(1)
            if bad.any():
                first = done + int(bad.nonzero()[0])
                first = int(getattr(traverse, "frame", range(first + 1))[first])  # of the source
                raise InputError(
                    f"{traverse.name}: frame {first} gives NaN or infinite features; expected finite numbers"
                )
            if look is not None and done == 0:
                look(batch, features)
            update((done + len(features)) // looks - done // looks)
            done += len(features)
            yield features
    if done == 0:
        raise InputError(f"{traverse.name} holds no frames; expected at least one")


def features_of(batch: Tensor, describe: Callable[[Tensor], Tensor], name: str = "the input") -> Tensor:
    """Features of one batch: (B,C,H,W) frames are described, (B,D) features stay unchanged."""
    if not isinstance(batch, Tensor):
        raise InputError(f"{name} is a {type(batch).__name__}; expected a tensor of frames or features")
    if batch.ndim not in (2, 4) or not batch.is_floating_point():
        raise InputError(
            f"{name} gives batches {tuple(batch.shape)} {batch.dtype}; "
            "expected float frames (B,C,H,W) in [0, 1] or float features (B,D)"
        )
    if batch.ndim == 2:
        return batch
    features = describe(batch)
    if features.ndim != 2 or features.shape[0] != batch.shape[0]:
        maker = describe[-1] if isinstance(describe, nn.Sequential) else describe
        owner = maker if isinstance(maker, nn.Module) else getattr(maker, "__self__", None)
        owner = getattr(owner, "features", owner)
        raise InputError(
            f"{type(owner).__name__} made {tuple(features.shape)} of {tuple(batch.shape)}; "
            f"expected features ({len(batch)}, D)"
        )
    return features


def warn_of_bright(frames: Tensor, name: str) -> bool:
    """Whether frames (B,C,H,W) exceed [0, 1] by far, and then a line; ready features (B,D) may be any."""
    most = float(frames.detach().amax()) if frames.ndim == 4 and len(frames) else 0.0
    if most > BRIGHTEST:
        seen = f"{name} has frames with values up to {most:.4g}"
        log.warning("%s; expected floats in [0, 1], such as frames / 255", seen)
    return most > BRIGHTEST


def check_alone(module: nn.Module, frames: Tensor, features: Tensor, name: str) -> None:
    """Refuse a network, in eval mode, whose features of a frame depend on the other frames of the batch.

    Raises:
        InputError: those of the first frame differ by over 1e-3 of their length, or what its numbers round
            by.
    """
    if frames.ndim != 4 or len(frames) < 2:
        return
    with torch.no_grad():
        alone = features_of(frames[:1].to(features.device), module, name).to(features)
    apart = float((alone[0] - features[0]).norm() / features[0].norm().clamp(min=1e-12))
    device = features.device.type
    kinds = {one.dtype for one in module.parameters() if one.is_floating_point()}
    if torch.is_autocast_enabled(device):
        kinds.add(torch.get_autocast_dtype(device))
    coarsest = 0.0 if device == "cpu" else TF32  # which a GPU may use in one batch and not in another
    coarsest = max([coarsest, *(torch.finfo(kind).eps for kind in kinds)])
    if apart > max(APART, ULPS * coarsest):
        raise InputError(
            f"frame 0 of {name} has other features alone than in a batch with {len(frames) - 1} others, by "
            f"{apart:.2g} of their length; expected --batch_size 1, where every frame is alone"
        )


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
