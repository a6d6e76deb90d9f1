"""Any network as a backbone: its descriptor, with whitening and a code."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dejavu_torch.features.cnn import local_contrast
from dejavu_torch.features.extract import in_mode
from dejavu_torch.features.preprocess import select_channel
from dejavu_torch.features.truncate import members_of, run, tensors_in, up_to
from dejavu_torch.features.whitening import learned_whitening
from dejavu_torch.resize import check_size, resize_frames
from dejavu_torch.text import one_line, settings_of
from dejavu_torch.types import InputError, expect

WIDEST = 256  # cells along a side of a grid
SHOWN = 4  # shapes in a message


class Coder(nn.Module):
    """Whitens a descriptor (B,K) and maps it, by one hidden layer, to the code (B,D) of its place.

    Training adds noise to the whitened descriptor, so that the code is robust to changes it has not seen.

    Args:
        inputs: K, of a descriptor. dimension: D, of the code, before standardisation.
        hidden: width of the hidden layer.
        noise: standard deviation of the noise in training mode; components are about 1.
        kept: number of components after whitening, at most K.

    Convention: until `whiten`, components are the first dimensions of the descriptor. They are scaled to
        length sqrt(components) before and after the noise.
    """

    mean: Tensor
    projection: Tensor
    whitened: Tensor

    def __init__(
        self, inputs: int, dimension: int, hidden: int = 400, noise: float = 1.0, kept: int = 128
    ) -> None:
        super().__init__()
        if min(inputs, dimension, hidden, kept) < 1 or not 0 <= noise < math.inf:
            seen = f"{inputs=}, {dimension=}, {hidden=}, {kept=}, {noise=}"
            raise InputError(f"Coder got {seen}; expected at least 1 each, the noise 0 or more")
        self.noise = noise
        kept = min(kept, inputs)
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("projection", torch.eye(inputs, kept))
        self.register_buffer("whitened", torch.tensor(False))
        norm = nn.BatchNorm1d(hidden)
        # the scale does not change the function; AdamW reaches the units' thresholds sooner if it is small
        nn.init.constant_(norm.weight, 0.1)
        first, last = nn.Linear(kept, hidden, bias=False), nn.Linear(hidden, dimension)
        self.layers = nn.Sequential(first, norm, nn.ReLU(inplace=True), last)

    def whiten(self, views: Tensor, places: Tensor) -> None:
        """Set `learned_whitening` of (n,K) views and the (n,K) places that they show."""
        mean, projection = learned_whitening(views, places, self.projection.shape[1])
        self.mean.copy_(mean)
        # an eigenvector may have either sign, on which the layers behind it depend
        largest = projection.gather(0, projection.abs().argmax(0, keepdim=True))
        self.projection.copy_(projection * largest.sign())
        self.whitened.fill_(True)

    def forward(self, descriptors: Tensor) -> Tensor:
        # bf16 is too coarse for the small differences that whitening amplifies
        with torch.autocast(descriptors.device.type, enabled=False):
            components = to_length((descriptors.to(self.mean.dtype) - self.mean) @ self.projection)
            if self.training and self.noise:
                # drawn on the CPU: the same on every device
                noise = torch.randn(components.shape, dtype=torch.float32).to(components)
                components = to_length(components + self.noise * noise)
        coded: Tensor = self.layers(components)
        return coded


def to_length(components: Tensor) -> Tensor:
    """Each row to length sqrt(components)."""
    return nn.functional.normalize(components, dim=1) * math.sqrt(components.shape[1])


class Embedding(nn.Module):
    """The output of a network, pooled to a coarse grid and projected to D standardised features.

    Args:
        network: frames (B,channels,h,w) -> feature maps (B,K,h',w'), tokens (B,T,K), which are averaged, or
            vectors (B,K), such as `kornia.feature.HardNet()` with 1 channel of 32 x 32; of several outputs,
            the first vectors.
        dimension: D, number of features; None returns the pooled output itself.
        channels: of the network's input, 3 or 1; grey frames are repeated, colours become luminance.
        resize: (height, width) in pixels to resize frames to, antialiased.
        grid: cells along each side over which feature maps are averaged.
        cell: of `local_contrast` before the network, pixels; 0 leaves the contrast unchanged.
        hidden: width of the hidden layer of a `Coder`, which replaces the linear layer; 0 has none.
        noise, kept: of the `Coder`.
        layer: name of the submodule, as in `named_modules`, at which the network ends, see `up_to`.
        mean, std: to normalise frames in [0, 1], per channel or one for all; (.485, .456, .406) and
            (.229, .224, .225) for most networks trained on ImageNet.
        output: index of the output to use, if the network returns a tuple, list or dict.

    Shape: (B,C,H,W) float in [0, 1], C of 1 or 3 -> (B,D).

    Raises:
        InputError: settings out of range or not of this network; forward: frames neither grey nor RGB.

    Example:
        >>> blocks = nn.Sequential(nn.Conv2d(3, 4, 3), nn.Conv2d(4, 9, 3))
        >>> Embedding(blocks, dimension=8, grid=2)(torch.rand(2, 3, 32, 32)).shape
        torch.Size([2, 8])
    """

    offset: Tensor
    factor: Tensor

    def __init__(
        self,
        network: nn.Module,
        dimension: int | None = 96,
        channels: int = 3,
        resize: tuple[int, int] = (96, 96),
        grid: int = 1,
        cell: int = 0,
        hidden: int = 0,
        noise: float = 1.0,
        kept: int = 128,
        layer: str | None = None,
        mean: float | list[float] | None = None,
        std: float | list[float] | None = None,
        output: int | None = None,
    ) -> None:
        super().__init__()
        expect(isinstance(network, nn.Module), "an nn.Module", network=type(network))
        fits = hidden == 0 if dimension is None else dimension >= 1
        self.resize = check_size(resize, 1, "Embedding got resize")
        self.dimension, self.channels, self.grid, self.cell = dimension, channels, grid, cell
        self.hidden, self.noise, self.kept = hidden, noise, kept
        self.layer, self.mean, self.std, self.output = layer, mean, std, output
        if not fits or not 1 <= grid <= WIDEST or channels not in (1, 3) or min(cell, hidden) < 0:
            expected = "channels 1 or 3, cell, hidden 0 or more, dimension at least 1, or none and hidden 0"
            raise InputError(f"Embedding got {self.extra_repr()}; expected {expected}, grid 1 to {WIDEST}")
        # not persistent: the settings hold the same
        self.register_buffer("offset", _per_channel("mean", mean, channels, 0.0), persistent=False)
        self.register_buffer("factor", 1 / _per_channel("std", std, channels, 1.0), persistent=False)
        size = (1, channels, *self.resize)
        frame = torch.linspace(0, 1, math.prod(size)).view(size)
        try:
            self.network = network if layer is None else up_to(network, layer, frame)
            with torch.no_grad(), in_mode(self.network, False):
                inputs = self._pooled(run(self.network, frame)).shape[1]
        except InputError:
            raise
        except Exception as error:  # a network may raise anything
            raise InputError(f"{type(network).__name__} fails on frames {size}: {one_line(error)}") from error
        self.linear: nn.Module = nn.Identity()
        self.standardise: nn.Module = nn.Identity()
        if dimension is not None:
            sizes = (inputs, dimension, hidden, noise, kept)
            self.linear = Coder(*sizes) if hidden else nn.Linear(inputs, dimension)
            self.standardise = nn.BatchNorm1d(dimension, affine=False, momentum=0.02)

    def _pooled(self, output: object) -> Tensor:
        """The output of the network, one row per frame."""
        name = type(self.network).__name__
        if self.output is not None:
            members = members_of(output)
            if not -len(members) <= self.output < len(members):
                raise InputError(f"output is {self.output}; {name} made {len(members)}, expected one of them")
            output = members[self.output]
        tensors = tensors_in(output)
        chosen = tensors if len(tensors) == 1 else [tensor for tensor in tensors if tensor.ndim == 2]
        if chosen and chosen[0].ndim in (2, 3):
            return chosen[0].mean(1) if chosen[0].ndim == 3 else chosen[0]
        if chosen and chosen[0].ndim == 4:
            return nn.functional.adaptive_avg_pool2d(chosen[0], self.grid).flatten(1)
        seen = ", ".join(str(tuple(tensor.shape)) for tensor in tensors[:SHOWN]) or type(output).__name__
        if len(tensors) > 1:
            seen = f"{len(tensors)} tensors, {seen}{', ..' * (len(tensors) > SHOWN)}, none of them vectors"
        expected = "maps (B,K,h,w), vectors (B,K), output=INDEX of one of several, or layer=NAME of a layer"
        raise InputError(f"{name} made {seen}; expected {expected}")

    @property
    def coder(self) -> Coder | None:
        """The whitening and the code, if there is a hidden layer."""
        return self.linear if isinstance(self.linear, Coder) else None

    def without_code(self) -> Embedding:
        """An Embedding with the same network that returns the descriptor itself."""
        settings = {name: getattr(self, name) for name in ("layer", "mean", "std", "output")}
        return Embedding(self.network, None, self.channels, self.resize, self.grid, self.cell, **settings)

    def describe(self, frames: Tensor) -> Tensor:
        """Descriptors, the pooled output of the network: (B,C,H,W) -> (B,K)."""
        if frames.ndim != 4 or frames.shape[1] not in (1, 3):
            raise InputError(f"Embedding got frames {tuple(frames.shape)}; expected (B,1,H,W) or (B,3,H,W)")
        if self.channels == 1:
            frames = select_channel(frames, "grey")
        frames = resize_frames(frames.expand(-1, self.channels, -1, -1), self.resize)
        weight = [*self.network.parameters(), frames][0]  # older versions do not compile next with a default
        frames = frames.to(weight.dtype) if weight.is_floating_point() else frames
        if self.cell:
            frames = local_contrast(frames, self.cell)
        if self.mean is not None or self.std is not None:
            frames = (frames - self.offset.to(frames)) * self.factor.to(frames)
        return self._pooled(run(self.network, frames))

    def code(self, descriptors: Tensor) -> Tensor:
        """Features of descriptors: (B,K) -> (B,D)."""
        features: Tensor = self.linear(descriptors)
        buffer = [*self.standardise.buffers(), None][0]
        dtype = torch.promote_types(features.dtype, torch.float32) if buffer is None else buffer.dtype
        standardised: Tensor = self.standardise(features.to(dtype))
        return standardised

    def forward(self, frames: Tensor) -> Tensor:
        return self.code(self.describe(frames))

    def extra_repr(self) -> str:
        return settings_of(self, "network")


def _per_channel(name: str, value: float | list[float] | None, channels: int, default: float) -> Tensor:
    """(channels,1,1), from a number per channel or one for all."""
    numbers = [*value] if isinstance(value, (list, tuple)) else [default if value is None else value]
    # in the range of float32, as are inverses
    least, most = (-1e38, 1e38) if name == "mean" else (1e-37, 1e37)
    if len(numbers) not in (1, channels) or not all(least <= number <= most for number in numbers):
        expected = f"a number for each of {channels} channels, or one for all"
        expected += ", above 0" * (name == "std")
        raise InputError(f"Embedding got {name}={f'{value}':.80}; expected {expected}")
    return torch.tensor(numbers, dtype=torch.float32).expand(channels).clone().view(channels, 1, 1)
