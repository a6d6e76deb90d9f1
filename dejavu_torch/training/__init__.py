"""Feature learning: losses, stages, task, data and metrics."""

from typing import TYPE_CHECKING

from dejavu_torch.lazy import lazily

if TYPE_CHECKING:
    from dejavu_torch.training.losses import phase_cross_entropy as phase_cross_entropy
    from dejavu_torch.training.losses import place_cross_entropy as place_cross_entropy

_NAMES = {
    "losses": "phase_cross_entropy place_cross_entropy",
}
__getattr__, __dir__ = lazily(__name__, _NAMES)
