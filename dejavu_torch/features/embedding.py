"""Any network as a backbone."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dejavu_torch.features.cnn import local_contrast
from dejavu_torch.features.coder import Coder
from dejavu_torch.types import InputError


class Embedding(nn.Module):
    """What a network makes of a frame, pooled to a coarse grid and projected to D standardised features.

    Args:
        network: frames (B,channels,h,w) -> maps (B,K,h',w'), tokens (B,T,K) or vectors (B,K), such as
            `kornia.feature.HardNet()`, which takes 1 channel of 32 x 32.
        dimension: D, number of features.
        channels: that the network takes, 3 or 1; grey frames are repeated, colours become luminance.
        resize: (height, width) in pixels that frames are brought to, antialiased.
        grid: cells along each side that maps are averaged over.
        cell: of `local_contrast` ahead of the network, pixels; 0 leaves the contrast as it is.
        hidden: width of the hidden layer of a `Coder`, which stands for the linear layer then; 0 has none.
        noise, kept: of the `Coder`.

    Shape: (B,C,H,W) float in [0, 1], C of 1 or 3 -> (B,D).

    Convention: of tokens (B,T,K), as transformers give, the mean counts. The network's output shape is found
        by running it once on a black frame, in eval mode.

    Raises:
        InputError: settings out of range, a network that cannot take such frames or gives neither maps
            nor vectors; forward: frames that are neither grey nor colour.

    Example:
        >>> net = Embedding(nn.Conv2d(1, 4, 3), dimension=8, channels=1, resize=(16, 16), grid=2)
        >>> net(torch.rand(2, 3, 32, 32)).shape
        torch.Size([2, 8])
    """

    def __init__(
        self,
        network: nn.Module,
        dimension: int = 96,
        channels: int = 3,
        resize: tuple[int, int] = (96, 96),
        grid: int = 1,
        cell: int = 0,
        hidden: int = 0,
        noise: float = 1.0,
        kept: int = 128,
    ) -> None:
        super().__init__()
        at_least_0 = min(cell, hidden) >= 0
        if len(resize) != 2 or min(dimension, grid, *resize) < 1 or channels not in (1, 3) or not at_least_0:
            raise InputError(
                f"Embedding got dimension={dimension}, channels={channels}, resize={tuple(resize)}, "
                f"grid={grid}, cell={cell}, hidden={hidden}; expected 1 or 3 channels, cell and hidden of 0 "
                "or more, the others at least 1"
            )
        self.network = network
        self.dimension = dimension
        self.channels = channels
        self.resize = (int(resize[0]), int(resize[1]))  # a map gives a list
        self.grid = grid
        self.cell = cell
        self.hidden = hidden
        self.noise = noise
        self.kept = kept
        black = torch.zeros(1, channels, *self.resize)
        modes = [(module, module.training) for module in network.modules()]
        try:
            with torch.no_grad():
                output = network.eval()(black)
        except Exception as error:  # whatever the network objects with
            raise InputError(
                f"{type(network).__name__} does not take frames {tuple(black.shape)}: "
                f"{' '.join(str(error).split())}"
            ) from error
        finally:
            for module, training in modes:
                module.training = training
        inputs = self._seen(output).shape[1]
        self.linear = (
            Coder(inputs, dimension, hidden, noise, kept) if hidden else nn.Linear(inputs, dimension)
        )
        self.standardise = nn.BatchNorm1d(dimension, affine=False, momentum=0.02)

    def _seen(self, output: object) -> Tensor:
        """What the network made, one row a frame."""
        if isinstance(output, Tensor) and output.ndim == 4:
            return nn.functional.adaptive_avg_pool2d(output, self.grid).flatten(1)
        if isinstance(output, Tensor) and output.ndim == 3:
            return output.mean(1)
        if isinstance(output, Tensor) and output.ndim == 2:
            return output
        seen = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
        raise InputError(
            f"{type(self.network).__name__} made {seen}; expected maps (B,K,h,w) or vectors (B,K)"
        )

    def describe(self, frames: Tensor) -> Tensor:
        """What the network makes of frames, one row each: (B,C,H,W) -> (B,K)."""
        if frames.ndim != 4 or frames.shape[1] not in (1, 3):
            raise InputError(f"Embedding got frames {tuple(frames.shape)}; expected (B,1,H,W) or (B,3,H,W)")
        if self.channels == 1 and frames.shape[1] == 3:
            from kornia.color import rgb_to_grayscale

            frames = rgb_to_grayscale(frames)
        frames = frames.expand(-1, self.channels, -1, -1)
        if tuple(frames.shape[-2:]) != self.resize:
            from kornia.geometry.transform import resize as antialiased_resize

            frames = antialiased_resize(frames, self.resize, antialias=True)
        if self.cell:
            frames = local_contrast(frames, self.cell)
        return self._seen(self.network(frames))

    def code(self, descriptors: Tensor) -> Tensor:
        """Features of what `describe` gives: (B,K) -> (B,D)."""
        features: Tensor = self.linear(descriptors)
        standardised: Tensor = self.standardise(features.float())
        return standardised

    def forward(self, frames: Tensor) -> Tensor:
        return self.code(self.describe(frames))

    def extra_repr(self) -> str:
        return (
            f"dimension={self.dimension}, channels={self.channels}, resize={self.resize}, grid={self.grid}, "
            f"cell={self.cell}, hidden={self.hidden}"
        )
