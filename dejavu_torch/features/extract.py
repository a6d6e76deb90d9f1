"""Features of a traverse, batch by batch."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import chain

import torch
from torch import Tensor, nn

from dejavu_torch.data.moving import moved
from dejavu_torch.features.preprocess import check_frames
from dejavu_torch.features.views import AugmentedFrames
from dejavu_torch.text import progress_of
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

LARGE = 10**6  # parameters from which a network was probably trained elsewhere
BRIGHTEST = 1.5  # frames should be in [0, 1]; preprocessing may exceed it a little
BATCH_TOLERANCE = 1e-3  # of their length: how much features may differ between a frame alone and in a batch
BATCH_ULPS = 4  # of the coarsest dtype: the same tolerance, if it is larger
TF32 = 2**-10  # the rounding of this format
READY = 256  # ready features at a time, at least: a search takes longer per query for fewer


def feature_batches(
    traverse: Traverse | AugmentedFrames,
    module: nn.Module,
    batch_size: int = 64,
    device: torch.device | str = "cpu",
    progress: bool = False,
    verb: str = "describing",
    on_first: Callable[[Tensor, Tensor], None] | None = None,
    describe: Callable[[Tensor], Tensor] | None = None,
) -> Iterator[Tensor]:
    """Features (B,D) of the frames of a traverse, in order, without gradients.

    Args:
        traverse: frames (B,C,H,W), or ready features (B,D), which pass unchanged.
        module: (B,C,H,W) -> (B,D). It runs in eval mode; the modes of its parts are restored.
        batch_size: frames in memory at a time, fewer if they are large; at least 256 ready features.
        progress: show a bar on stderr, or lines if it is no terminal; copies count once. verb: its name.
        on_first: called with the first batch and its features.
        describe: a method of the module; None is its forward.

    Raises:
        InputError: features that are not (B,D) or not finite, or no frames at all.
    """
    done, copies = 0, traverse.copies if isinstance(traverse, AugmentedFrames) else 1
    size = max(batch_size, READY) if len(traverse.frame_shape) == 1 else batch_size
    with progress_of(verb, len(traverse) // copies, progress) as update, in_mode(module, False):
        where = (device,) if isinstance(traverse, AugmentedFrames) else ()
        for batch in traverse.batches(size, *where):
            with torch.no_grad():
                features = features_of(batch.to(device), describe or module, traverse.name).detach()
            if features.dtype in (torch.float16, torch.bfloat16):  # too coarse for sums and transforms
                features = features.float()
            bad = ~features.isfinite().all(1)
            if bad.any():
                i = done + int(bad.nonzero()[0])
                i = int(getattr(traverse, "frame", range(i + 1))[i])  # of the source
                raise InputError(f"{traverse.name}: frame {i} has NaN or infinite features; expected none")
            if on_first is not None and done == 0:
                on_first(batch, features)
            update((done + len(features)) // copies - done // copies)
            done += len(features)
            yield features


def as_weights(frames: Tensor, module: nn.Module) -> Tensor:
    """Frames in the type of a module's weights, else of its buffers, which torch expects."""
    if getattr(module, "casts", False):
        return frames
    dtypes = [tensor.dtype for tensor in chain(module.parameters(), module.buffers())]
    return frames.to([*(dtype for dtype in dtypes if dtype.is_floating_point), frames.dtype][0])


def features_of(batch: Tensor, describe: Callable[[Tensor], Tensor], name: str = "the input") -> Tensor:
    """Features of one batch: frames (B,C,H,W) are described, features (B,D) pass unchanged."""
    if isinstance(batch, Tensor) and batch.ndim == 2 and batch.is_floating_point():
        return batch
    check_frames(batch, f"{name} is", " or float features (B,D)")
    features = describe(batch)
    # no len(): it would fix the batch of an exported graph
    if not isinstance(features, Tensor) or features.ndim != 2 or features.shape[0] != batch.shape[0]:
        output = tuple(features.shape) if isinstance(features, Tensor) else f"a {type(features).__name__}"
        owner = describe[-1] if isinstance(describe, nn.Sequential) else describe
        owner = getattr(owner, "__self__", owner)  # of a method
        owner = getattr(owner, "features", owner)
        seen = f"{type(owner).__name__} made {output} of {tuple(batch.shape)}"
        raise InputError(f"{seen}; expected features ({len(batch)}, D)")
    return features


def moves(features: nn.Module) -> bool:
    """Whether features of moved frames are known without computing all of them again."""
    return all(hasattr(member, "moved") for member in getattr(features, "members", [features]))


def moved_features(features: nn.Module, frames: Tensor, shifts: Sequence[float]) -> Tensor:
    """Features of frames moved sideways, see `Moved`, by the module's method `moved` if it has one, else of
    moved frames: (B,C,H,W) -> (B,V,D)."""
    frames = as_weights(frames, features)
    if (own := getattr(features, "moved", None)) is not None:
        return own(frames, shifts)  # type: ignore[no-any-return]
    return torch.stack([features_of(moved(frames, [shift]), features) for shift in shifts], 1)


def warn_of_bright(frames: Tensor, name: str) -> bool:
    """Whether frames (B,C,H,W) exceed [0, 1] by far, with a warning; ready features (B,D) never do."""
    most = float(frames.detach().amax()) if frames.ndim == 4 and len(frames) else 0.0
    if most > BRIGHTEST:
        seen = f"{name} has frames with values up to {most:.4g}"
        log.warning("%s; expected floats in [0, 1], such as frames / 255", seen)
    return most > BRIGHTEST


def warn_of_raw(features: nn.Module, frames: Tensor) -> None:
    """Warn, once for each kind and size, of networks that get frames as they are."""
    for member in getattr(features, "members", [features]):
        ours = type(member).__module__.partition(".")[0] == "dejavu_torch"
        network = getattr(member, "network", None) if ours else member
        prepared = getattr(member, "mean", None) is not None if ours else hasattr(member, "resize")
        if frames.ndim != 4 or network is None or prepared:
            continue
        if sum(one.numel() for one in network.parameters()) >= LARGE:
            size = getattr(member, "resize", None) or tuple(frames.shape[2:])
            _warn_of_raw(f"{type(network).__name__} gets frames of {size[0]} x {size[1]} pixels")


@cache
def _warn_of_raw(seen: str) -> None:
    why = "a network trained on others, as of ImageNet, needs its size and normalisation"
    log.warning("%s, from 0 to 1; %s: resize, mean and std of dejavu_torch.Embedding", seen, why)


def check_alone(
    module: nn.Module, describe: Callable[[Tensor], Tensor], frames: Tensor, features: Tensor, name: str
) -> None:
    """Refuse a network in eval mode whose features of a frame depend on its batch beyond 1e-3 or rounding."""
    if frames.ndim != 4 or len(frames) < 2:
        return
    device = features.device.type
    with torch.no_grad():
        alone = features_of(frames[:1].to(features.device), describe, name).to(features)
    difference = float((alone[0] - features[0]).norm() / features[0].norm().clamp(min=1e-12))
    dtypes = {weight.dtype for weight in module.parameters() if weight.is_floating_point()}
    if torch.is_autocast_enabled(device):
        dtypes.add(torch.get_autocast_dtype(device))
    # a GPU may use TF32 in one batch and not in another
    coarsest = max([0.0 if device == "cpu" else TF32, *(torch.finfo(dtype).eps for dtype in dtypes)])
    if difference > max(BATCH_TOLERANCE, BATCH_ULPS * coarsest):
        seen = f"frame 0 of {name} has other features alone than in a batch with {len(frames) - 1} others"
        expected = "--batch_size 1, where every frame is alone"
        raise InputError(f"{seen}, by {difference:.2g} of their length; expected {expected}")


@contextmanager
def in_mode(module: nn.Module, training: bool) -> Iterator[None]:
    """The module in training or eval mode; afterwards every part has its own mode again."""
    modes = [(part, part.training) for part in module.modules()]
    module.train(training)
    try:
        yield
    finally:
        for part, before in modes:
            part.training = before
