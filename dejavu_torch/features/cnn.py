"""A small CNN to train on a route: the learned counterpart of HOG."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from dejavu_torch.resize import check_size, resize_frames
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError, check_shape

FLAT = 2 / 255  # contrast below which nothing is amplified


def local_contrast(frames: Tensor, cell: int = 8) -> Tensor:
    """Each pixel (B,C,H,W) minus the mean around it, divided by the contrast around it.

    Both are computed in cells of `cell` x `cell` pixels, the contrast over all channels, and interpolated,
    which is faster than a window at every pixel (`normalise_patches`). A gain or an offset of brightness
    changes almost nothing; contrast below 2/255 is not amplified.
    """
    height, width = frames.shape[-2:]
    grid = (-(-height // cell), -(-width // cell))

    def around(values: Tensor) -> Tensor:
        cells = nn.functional.adaptive_avg_pool2d(values, grid)
        return nn.functional.interpolate(cells, (height, width), mode="bilinear", align_corners=False)

    centred = frames - around(frames)
    return centred * (around(centred.square().mean(1, keepdim=True)) + FLAT**2).rsqrt()


class SmallCNN(nn.Module):
    """Local contrast, strided convolutions, and a linear layer, which sees where things are. Features are
    standardised by their running mean and variance over the training frames.

    Args:
        dimension: D, number of features.
        channels: of the frames; None is 3, or as training frames or loaded weights have.
        resize: (height, width) in pixels to resize frames to, antialiased.
        widths: channels after each convolution; each halves height and width.
        squeeze: channels before the linear layer.
        cell: of `local_contrast`, pixels; 0 leaves the contrast unchanged.

    Shape: (B,C,H,W) float in [0, 1] -> (B,D).

    Raises:
        InputError: settings below 1; forward: frames of another number of channels.
    """

    def __init__(
        self,
        dimension: int = 96,
        channels: int | None = None,
        resize: tuple[int, int] = (96, 96),
        widths: Sequence[int] = (16, 32, 64, 96),
        squeeze: int = 32,
        cell: int = 8,
    ) -> None:
        super().__init__()
        self.resize = check_size(resize, 1, "SmallCNN got resize")
        self.follows, self.channels = channels is None, 3 if channels is None else channels
        self.dimension, self.squeeze, self.cell = dimension, squeeze, cell
        self.widths = tuple(int(width) for width in widths)  # a map file holds a list
        if not widths or min(dimension, self.channels, squeeze, *widths) < 1 or cell < 0:
            raise InputError(f"SmallCNN got {settings_of(self)}; expected at least 1 each, cell 0 or more")
        layers: list[nn.Module] = []
        height, width = self.resize
        for before, after in zip((self.channels, *self.widths), self.widths, strict=False):
            side = 3 if layers else 5
            convolution = nn.Conv2d(before, after, side, stride=2, padding=side // 2, bias=False)
            layers += [convolution, nn.BatchNorm2d(after), nn.ReLU(inplace=True)]
            height, width = -(-height // 2), -(-width // 2)
        layers += [nn.Conv2d(self.widths[-1], squeeze, 1), nn.ReLU(inplace=True)]
        self.convolutions = nn.Sequential(*layers)
        self.linear = nn.Linear(squeeze * height * width, dimension)
        self.standardise = nn.BatchNorm1d(dimension, affine=False, momentum=0.02)

    def follow(self, channels: int) -> None:
        """Adapt to this number of channels if none was given, with a new first layer."""
        if self.follows and channels != self.channels:
            self.channels = channels
            first = nn.Conv2d(channels, self.widths[0], 5, stride=2, padding=2, bias=False)
            trained = next(self.convolutions[0].parameters()).requires_grad  # unless it is frozen
            self.convolutions[0] = first.to(self.linear.weight).requires_grad_(trained)

    def _load_from_state_dict(self, state: dict[str, Tensor], prefix: str, *args: object) -> None:
        stored = state.get(f"{prefix}convolutions.0.weight")
        if stored is not None and stored.ndim == 4 and stored.shape[1]:
            self.follow(stored.shape[1])
            self.follows = False
        super()._load_from_state_dict(state, prefix, *args)

    def forward(self, frames: Tensor) -> Tensor:
        check_shape(frames, f"B {self.channels} H W", "SmallCNN got")
        frames = resize_frames(frames, self.resize).to(self.linear.weight.dtype)
        if self.cell:
            frames = local_contrast(frames, self.cell)
        features: Tensor = self.linear(self.convolutions(frames).flatten(1))
        standardised: Tensor = self.standardise(features.to(self.standardise.running_mean))
        return standardised

    extra_repr = settings_of
