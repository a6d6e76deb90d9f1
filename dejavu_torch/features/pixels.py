"""The pixels of small frames as features, as SeqSLAM compares them."""

from __future__ import annotations

from torch import Tensor, nn

from dejavu_torch.features.preprocess import FLAT, channel_name, check_frames, select_channel
from dejavu_torch.resize import check_size, resize_frames
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError, expect


class PatchPixels(nn.Module):
    """Pixels of small frames; each patch is normalised to mean 0 and standard deviation 1, but standard
    deviations below 1/255 count as 1/255 (Milford and Wyeth, SeqSLAM, ICRA 2012).

    Args:
        size: (height, width) in pixels; smaller frames keep their size, reduced to whole patches.
        patch: side of the square patches in pixels.
        channel: see `Preprocess`, None is all; for "grey", 2 or more than 3 channels are averaged.

    Shape: (B,C,H,W) -> (B, C x height x width).

    Raises:
        InputError: a size smaller than a patch; forward: not (B,C,H,W) float, or smaller than a patch.
    """

    def __init__(self, size: tuple[int, int] = (32, 64), patch: int = 8, channel: str | None = None) -> None:
        super().__init__()
        expect(patch >= 2, "at least 2", f"PatchPixels got patches of {patch} pixels")
        self.size, self.patch = check_size(size, patch, "PatchPixels got size"), patch
        self.channel = None if channel is None else channel_name(channel)

    def forward(self, frames: Tensor) -> Tensor:
        check_frames(frames, "PatchPixels got")
        side, (height, width) = self.patch, frames.shape[-2:]
        if min(height, width) < side:
            seen = f"PatchPixels got frames of {height} x {width} pixels"
            raise InputError(f"{seen}; expected at least one patch, {side} x {side}")
        if self.channel == "grey" and frames.shape[1] not in (1, 3):
            frames = frames.mean(1, keepdim=True)
        elif self.channel is not None:
            frames = select_channel(frames, self.channel)
        small = (min(height, self.size[0]) // side * side, min(width, self.size[1]) // side * side)
        patches = resize_frames(frames, small).unflatten(-1, (-1, side)).unflatten(-3, (-1, side))
        centred = patches - patches.mean((-3, -1), keepdim=True)  # (B,C,rows,side,columns,side)
        deviation = centred.square().mean((-3, -1), keepdim=True).clamp(min=FLAT**2).sqrt()
        pixels: Tensor = (centred / deviation).flatten(1)
        return pixels

    extra_repr = settings_of
