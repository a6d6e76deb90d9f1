"""Features of a traverse, batch by batch."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from tqdm import tqdm

from dejavu_torch.features.preprocess import check_frames
from dejavu_torch.features.views import AugmentedTraverse
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

BRIGHTEST = 1.5  # of a frame in [0, 1], whatever was done to it
APART = 1e-3  # of its length: by how much the features of a frame may differ alone and among others
ULPS = 4  # and of the coarsest numbers
TF32 = 2**-10  # what it rounds by
READY = 256  # ready features at a time at least: a search takes longer for each of fewer
FIRST, EVERY = 30.0, 60.0  # seconds before the first line of progress, and from one to the next


def feature_batches(
    traverse: Traverse,
    module: nn.Module,
    batch_size: int = 64,
    device: torch.device | str = "cpu",
    progress: str | None = None,
    on_first: Callable[[Tensor, Tensor], None] | None = None,
) -> Iterator[Tensor]:
    """Features (B,D) of the frames of a traverse, in order, without gradients.

    Args:
        traverse: frames (B,C,H,W), or ready features (B,D), which pass unchanged.
        module: (B,C,H,W) -> (B,D). It runs in eval mode; the modes of its parts are restored.
        batch_size: frames in memory at a time; fewer if they are large, and of ready features at least 256.
        progress: what to call this work on stderr: a bar on a terminal, else a line now and then. Copies of
            one frame count once.
        on_first: called with the first batch and its features.

    Raises:
        InputError: features that are not (B,D) or not finite, or no frames at all.
    """
    done, copies = 0, traverse.copies if isinstance(traverse, AugmentedTraverse) else 1
    total = traverse.length and traverse.length // copies
    size = max(batch_size, READY) if len(traverse.frame_shape) == 1 else batch_size
    with _progress(progress, total) as update, in_mode(module, False):
        for batch in traverse.batches(traverse.batch_size(size)):
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
            if on_first is not None and done == 0:
                on_first(batch, features)
            update((done + len(features)) // copies - done // copies)
            done += len(features)
            yield features
    if done == 0:
        raise InputError(f"{traverse.name} holds no frames; expected at least one")


@contextmanager
def _progress(text: str | None, total: int | None) -> Iterator[Callable[[int], object]]:
    """A function to call with how many more frames are done, which shows it on stderr; None shows nothing."""
    if text is not None and sys.stderr.isatty():
        with tqdm(total=total, desc=text, unit="frame", leave=False) as bar:
            yield bar.update
        return
    began, done = time.monotonic(), 0
    due = began + FIRST

    def update(more: int) -> None:
        nonlocal done, due
        done, now = done + more, time.monotonic()
        if text is None or now < due or not done:
            return
        due = now + EVERY
        of = f" of {total}" if total else ""
        left = f", {max(0, total - done) * (now - began) / done:.0f} s left" if total else ""
        tqdm.write(f"dejavu: {text}: {done}{of} frames{left}", file=sys.stderr)

    yield update


def features_of(batch: Tensor, describe: Callable[[Tensor], Tensor], name: str = "the input") -> Tensor:
    """Features of one batch: (B,C,H,W) frames are described, (B,D) features stay unchanged."""
    if isinstance(batch, Tensor) and batch.ndim == 2 and batch.is_floating_point():
        return batch
    check_frames(batch, f"{name} is", " or float features (B,D)")
    features = describe(batch)
    # no len(): it would fix the batch of an exported graph
    if not isinstance(features, Tensor) or features.ndim != 2 or features.shape[0] != batch.shape[0]:
        made = tuple(features.shape) if isinstance(features, Tensor) else f"a {type(features).__name__}"
        owner = describe[-1] if isinstance(describe, nn.Sequential) else describe
        owner = getattr(owner, "__self__", owner)  # of a method
        owner = getattr(owner, "features", owner)
        raise InputError(
            f"{type(owner).__name__} made {made} of {tuple(batch.shape)}; expected features ({len(batch)}, D)"
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
    """Refuse a network, in eval mode, whose features of a frame depend on the other frames of the batch: by
    over 1e-3 of their length, or what its numbers round by."""
    if frames.ndim != 4 or len(frames) < 2:
        return
    device = features.device.type
    with torch.no_grad():
        alone = features_of(frames[:1].to(features.device), module, name).to(features)
    apart = float((alone[0] - features[0]).norm() / features[0].norm().clamp(min=1e-12))
    kinds = {one.dtype for one in module.parameters() if one.is_floating_point()}
    if torch.is_autocast_enabled(device):
        kinds.add(torch.get_autocast_dtype(device))
    # a GPU may use TF32 in one batch and not in another
    coarsest = max([0.0 if device == "cpu" else TF32, *(torch.finfo(kind).eps for kind in kinds)])
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
