"""Frames (N,C,H,W) -> features (N,D)."""

from typing import TYPE_CHECKING

from dejavu_torch.lazy import lazily

if TYPE_CHECKING:
    from dejavu_torch.features.augmentation import Augmentation as Augmentation
    from dejavu_torch.features.cnn import SmallCNN as SmallCNN
    from dejavu_torch.features.distilled import Distilled as Distilled
    from dejavu_torch.features.joined import Joined as Joined
    from dejavu_torch.features.pixels import PatchPixels as PatchPixels

_NAMES = {
    "augmentation": "Augmentation",
    "cnn": "SmallCNN",
    "distilled": "Distilled",
    "joined": "Joined",
    "pixels": "PatchPixels",
}
__getattr__, __dir__ = lazily(__name__, _NAMES)
