"""A small network that imitates the first blocks of an ImageNet network; its weights are in the package."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, conv2d

from dejavu_torch.data.moving import sideways
from dejavu_torch.features.preprocess import check_frames
from dejavu_torch.resize import resize_frames
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError, expect

SIZE = (96, 96)  # pixels of its training frames
STRIDES = (2, 2, 2, 1, 1)  # of its convolutions
AT_ONCE = 16  # frames, so that their feature maps stay in the cache
WIDEST = 12  # cells along a side of its feature maps
WEIGHTS = {"lite0": Path(__file__).with_name("lite0.safetensors")}


class Distilled(nn.Module):
    """Textures and colours, to complement the edges of HOG, from a network of 65 kB.

    Convolutions, averaged over a grid. They were trained on drawn images to reproduce the output of the first
    four blocks of EfficientNet-Lite0 (Tan and Le, ICML 2019) trained on ImageNet.

    Args:
        grid: cells along each side of the frame, at most 12.
        weights: "lite0", the only choice so far, made by `python -m benchmarks distil`. They are part of the
            package, in 8 bits each, and fixed: a map file holds only their checksum.

    Shape: (B,C,H,W) float in [0, 1] -> (B, 40 x grid^2).

    Convention: frames are resized to 96 x 96, and averaged to grey unless they have 1 or 3 channels.

    Raises:
        InputError: settings out of range; forward: not (B,C,H,W) float; load_state_dict: another checksum.

    Example:
        >>> import torch
        >>> Distilled()(torch.rand(2, 1, 64, 64)).shape
        torch.Size([2, 1440])
    """

    checksum: Tensor

    def __init__(self, grid: int = 6, weights: str = "lite0") -> None:
        super().__init__()
        self.grid, self.weights = grid, weights
        expected = f"a grid of 1 to {WIDEST}, and weights {' or '.join(WEIGHTS)}"
        expect(1 <= grid <= WIDEST and weights in WEIGHTS, expected, f"Distilled got {settings_of(self)}")
        for name, tensor in loaded(WEIGHTS[weights]).items():
            self.register_buffer(name, tensor, persistent=name == "checksum")

    def forward(self, frames: Tensor) -> Tensor:
        return torch.cat([adaptive_avg_pool2d(part, self.grid).flatten(1) for part in self._maps(frames)])

    def moved(self, frames: Tensor, shifts: Sequence[float]) -> Tensor:
        """The features of frames moved sideways, see `Moved`, of feature maps that are computed once:
        (B,C,H,W) -> (B,V,D)."""
        count, found = len(shifts), []
        for maps in self._maps(frames):
            at = torch.arange(WIDEST, device=maps.device)
            by = WIDEST * torch.tensor(shifts, device=maps.device)[:, None]
            rows = adaptive_avg_pool2d(maps, (self.grid, WIDEST)).flatten(1, 2)
            copies = sideways(rows, (at - by).flatten()).unflatten(2, (count, WIDEST))
            cells = adaptive_avg_pool2d(copies, (count, self.grid))  # (B,40 x grid,V,grid)
            found.append(cells.transpose(1, 2).flatten(2))
        return torch.cat(found)

    def _maps(self, frames: Tensor) -> Iterator[Tensor]:
        """Feature maps of some frames at a time."""
        check_frames(frames, "Distilled got")
        if frames.shape[1] not in (1, 3):
            frames = frames.mean(1, keepdim=True)
        layers = dict(self.named_buffers())
        # a graph has one batch, and a GPU takes as long for few frames
        whole = torch.compiler.is_compiling() or frames.device.type != "cpu"
        for part in [frames] if whole else frames.split(AT_ONCE):
            yield distilled_maps(resize_frames(part, SIZE), layers)

    def _load_from_state_dict(self, state: dict[str, Tensor], prefix: str, *args: object) -> None:
        stored = state.get(f"{prefix}checksum")
        if stored is not None and not torch.equal(stored.cpu(), self.checksum.cpu()):
            seen = f"it was learned with other weights {self.weights} of Distilled than this version has"
            raise InputError(f"{seen}; expected the version that learned it, or a map learned anew")
        super()._load_from_state_dict(state, prefix, *args)

    extra_repr = settings_of


def loaded(path: Path) -> dict[str, Tensor]:
    """The weights (O,I,k,k) and biases (O,) of a file of integers and scales, and a checksum."""
    stored, layers = load_file(path), {}
    # sensitive to order, as a hash is, but a tensor
    sums = [stored[f"{i}.weight"].flatten().long().cumsum(0).sum() for i in range(len(STRIDES))]
    layers["checksum"] = torch.stack(sums)
    for i in range(len(STRIDES)):
        layers[f"weight{i}"] = stored[f"{i}.weight"] * stored[f"{i}.scale"].float().view(-1, 1, 1, 1)
        layers[f"bias{i}"] = stored[f"{i}.bias"]
    return layers


def distilled_maps(frames: Tensor, layers: Mapping[str, Tensor]) -> Tensor:
    """Feature maps of grey or RGB frames in [0, 1]: (B,C,96,96) -> (B,40,12,12)."""
    values = 2 * frames - 1
    for i, stride in enumerate(STRIDES):
        weight, bias = (layers[f"{name}{i}"].to(values) for name in ("weight", "bias"))
        if not i and values.shape[1] == 1:  # the result for three equal channels
            weight = weight.sum(1, keepdim=True)
        values = conv2d(values.relu() if i else values, weight, bias, stride, weight.shape[-1] // 2)
    return values
