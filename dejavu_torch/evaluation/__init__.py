"""From places and a ground truth to scores, pictures and reports."""

from typing import TYPE_CHECKING

from dejavu_torch.lazy import lazily

if TYPE_CHECKING:
    from dejavu_torch.evaluation.curves import Judgement as Judgement
    from dejavu_torch.evaluation.curves import Scores as Scores
    from dejavu_torch.evaluation.curves import judge as judge
    from dejavu_torch.evaluation.curves import pr_curve as pr_curve
    from dejavu_torch.evaluation.curves import recall_at as recall_at

_NAMES = {
    "curves": "Judgement Scores judge pr_curve recall_at",
}
__getattr__, __dir__ = lazily(__name__, _NAMES)
