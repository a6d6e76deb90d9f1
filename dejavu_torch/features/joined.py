"""Concatenated features of several modules."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dejavu_torch.features.extract import as_weights, features_of, moved_features
from dejavu_torch.features.preprocess import check_frames
from dejavu_torch.types import InputError


class Joined(nn.Module):
    """Concatenated features of several modules, such as HOG and the descriptor of a network.

    Args:
        members: modules (B,C,H,W) -> (B,D_i); all see the same frames.

    Attributes:
        groups: number of features of each member, for the last frames; whitening treats each by itself.

    Shape: (B,C,H,W) -> (B, D_1 + D_2 + ..).

    Raises:
        InputError: no members, or not modules; forward: a member's other output.

    Example:
        >>> from dejavu_torch.features.hog import HOG
        >>> from dejavu_torch.features.pixels import PatchPixels
        >>> features = Joined([HOG(), PatchPixels(channel="grey")])
        >>> features(torch.rand(2, 3, 64, 64)).shape, features.groups
        (torch.Size([2, 3812]), (1764, 2048))
    """

    casts = True  # gives each member frames in the type of its weights, see `as_weights`

    def __init__(self, members: list[nn.Module]) -> None:
        super().__init__()
        modules = [*members] if isinstance(members, (Sequence, nn.ModuleList)) else [members]
        if not modules or not all(isinstance(module, nn.Module) for module in modules):
            seen = ", ".join(type(module).__name__ for module in modules) or "none"
            raise InputError(f"the members of the features are {seen}; expected modules, at least one")
        self.members = nn.ModuleList(modules)
        self.groups: tuple[int, ...] | None = None

    def forward(self, frames: Tensor) -> Tensor:
        check_frames(frames, "Joined got")
        features = [features_of(as_weights(frames, member), member) for member in self.members]
        if not torch.compiler.is_compiling():  # a graph has no side effects
            self.groups = tuple(part.shape[1] for part in features)
        return torch.cat(features, 1)

    def moved(self, frames: Tensor, shifts: Sequence[float]) -> Tensor:
        """The features of frames moved sideways, see `Moved`: (B,C,H,W) -> (B,V,D)."""
        return torch.cat([moved_features(member, frames, shifts) for member in self.members], 2)


def groups_of(features: nn.Module) -> tuple[int, ...] | None:
    """The `groups` of `Joined` features, else None."""
    return features.groups if isinstance(features, Joined) else None
