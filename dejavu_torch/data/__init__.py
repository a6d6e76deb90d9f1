"""Where frames and truth come from."""

from typing import TYPE_CHECKING

from dejavu_torch.lazy import lazily

if TYPE_CHECKING:
    from dejavu_torch.data.ground_truth import GroundTruth as GroundTruth
    from dejavu_torch.data.ground_truth import find_ground_truth as find_ground_truth

_NAMES = {
    "ground_truth": "GroundTruth find_ground_truth",
}
__getattr__, __dir__ = lazily(__name__, _NAMES)
