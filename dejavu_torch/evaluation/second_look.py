"""A second look at queries of which few are found: would they be, if they were turned, mirrored, cropped?"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.traverse import Frames, Part, as_shape, fitted
from dejavu_torch.data.turning import TURNS, composed
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.calibration import confidence_of
from dejavu_torch.recognition.chosen import FAST, MOVES, SLOW
from dejavu_torch.recognition.localizer import Matching, answer
from dejavu_torch.recognition.scorer import Scorer
from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.taken import NATS, Singly, singly
from dejavu_torch.resize import reduced_size
from dejavu_torch.types import Doubt, Match, SequenceModel, Traverse

QUERIES = 32  # that are looked at, in a row
STARTS = 0.5, 0.25, 0.75  # shares of the drive, where they may begin
SECONDS = 4.5  # after which no further look begins
ANY_SPEED = [sum(one) / 3 for one in zip(MOVES, SLOW, FAST, strict=True)]  # which is fitted once
ENOUGH = 0.5  # share of the queries that are found, from which on all is well


class Look(NamedTuple):
    """Another way to look at frames. words: "they are turned". remedy: one of `TURNS`, or words."""

    words: str
    alter: Callable[[Tensor], Tensor]  # (B,C,H,W) -> (B,C,H,W), or with sides exchanged
    remedy: str

    def doubt(self, found: int, count: int, before: int, turn: str) -> Doubt:
        """That so many of `count` frames are found by it, of a source that has a `turn`."""
        text = f"{found} of {count} frames are found if {self.words} ({before} as they are)"
        remedy = self.remedy
        if remedy in TURNS:
            if option := composed(turn, remedy):
                return Doubt("look", text, f"?turn={option}")
            remedy = "remove its" if option == "" else "alter the pictures themselves, beside"
            remedy += f" ?turn={turn}"
        return Doubt("look", f"{text}; {remedy}")


def _warped(scale: float, right: float = 0.0, down: float = 0.0) -> Callable[[Tensor], Tensor]:
    """Enlarges frames about their middle and moves them, in shares of a side; beyond it they reflect."""

    def alter(frames: Tensor) -> Tensor:
        rows = frames.new_tensor([[1 / scale, 0, -2 * right], [0, 1 / scale, -2 * down]])
        grid = F.affine_grid(rows.expand(len(frames), 2, 3), list(frames.shape), align_corners=False)
        return F.grid_sample(frames, grid, padding_mode="reflection", align_corners=False)

    return alter


TURNED = {
    "180": "they are turned by 180 degrees",
    "mirror": "they are mirrored",
    "90": "they are turned by 90 degrees",
    "270": "they are turned by 270 degrees",
    "transpose": "they are transposed, as height and width are exchanged",
}
WARPED = {  # enlarged by, and moved by shares of a side
    "enlarged by 1.25": (1.25,),
    "reduced by 1.25": (0.8,),
    "moved right by 15 % of their width": (1, 0.15),
    "moved left by 15 % of their width": (1, -0.15),
    "moved down by 15 % of their height": (1, 0, 0.15),
    "moved up by 15 % of their height": (1, 0, -0.15),
    "enlarged by 1.5": (1.5,),
    "reduced by 1.5": (1 / 1.5,),
}
CROP = "another lens, crop or direction: crop and resize the pictures alike, see ?crop="
BGR = Look(
    "red and blue are exchanged", lambda frames: frames.flip(1), "read the pictures as RGB, not as BGR"
)
LOOKS = (  # the more usual, the earlier
    *(Look(words, TURNS[turn], turn) for turn, words in TURNED.items()),
    BGR,
    *(Look(f"they are {words}", _warped(*by), CROP) for words, by in WARPED.items()),
    Look("they are inverted", lambda frames: 1 - frames, "one of the two is a negative: invert its values"),
)
# what a look has to be better by than none: of drives in nats, by which one is taken, of so many looks; of
# single images in shares of the null's level, than which they have to be surer by a larger one
CLEARLY = {True: NATS + math.log(len(LOOKS) * len(STARTS)), False: 0.3}
SURE = 0.55


class Seen(NamedTuple):
    """Whether enough queries are found, and surely so, how plainly, and how many are: more is better."""

    enough: bool
    plainly: float
    found: int


def is_doubtful(found: int, queries: int, way: SequenceModel | None) -> bool:
    """Whether few queries are found, they are no drive, or one that single images do not find.

    Args:
        found: answers that are probably right. way: the smoother of a drive, as fitted to it, else None.
    """
    singly: Singly | None = getattr(way, "singly", None)
    denied = singly is not None and not singly._replace(nats=0.0).stands_out
    return found < ENOUGH * queries or (way is not None and (denied or not way.is_drive))


@torch.no_grad()
def second_look(model: DejaVu, query: Traverse, ordered: bool) -> list[Doubt]:
    """Whether queries of which few are found would be if they were altered, in the words of one doubt.

    That is so by the one of `LOOKS` that finds `QUERIES` of them best, far better than none does, finds
    others too, unless it is twice as good, and finds those better that are found as they are. Nothing if most
    of these are, and of what has no looks: ready features, and areas.

    Args:
        model: with a map. query: as the model localizes them. ordered: look at queries in a row as a drive;
            else at some by themselves.
    """
    end, shape, own = monotonic() + SECONDS, model.frame_shape or (), query.frame_shape
    if not (len(shape) == len(own) == 3 and model.map.layout.ahead):
        return []
    count, see = min(QUERIES, len(query)), partial(_as_drive if ordered else _alone, model)
    firsts = dict.fromkeys(int(share * (len(query) - count)) for share in STARTS)
    some = [range(first, first + count) for first in firsts]
    some = some if ordered else [range(0, len(query) - len(query) % count, len(query) // count)]
    size = own[0], *reduced_size((own[1], own[2]), max(shape[1:]))
    parts = [fitted(Part(query, numbers), size)[:] for numbers in some]
    began, asis = monotonic(), list[Seen]()
    for frames in (parts[0][:1], *parts):  # one first, and then half of the time: features may be slow
        asis.append(see(frames))
        if (monotonic() - began) * (count if len(asis) == 1 else 2) > SECONDS:
            return []
    del asis[0]
    lost = [i for i, one in enumerate(asis) if not one.enough]
    for i in lost if 2 * len(lost) >= len(asis) else ():
        best, by = asis[i], BGR
        for look in LOOKS:
            altered = look.alter(parts[i])
            if monotonic() < end and not torch.equal(altered, parts[i]):  # as grey ones
                best, by = max((best, by), (see(altered), look), key=lambda one: one[0])
        gain = best.plainly - asis[i].plainly
        if not best.enough or gain < CLEARLY[ordered]:
            continue
        elsewhere = [(see(by.alter(parts[j])), asis[j]) for j in range(len(asis)) if j != i]
        worse = any(plain.enough and one <= plain for one, plain in elsewhere)
        sure = not ordered or gain >= 2 * CLEARLY[ordered] or any(one.enough for one, _ in elsewhere)
        if sure and not worse:
            return [by.doubt(best.found, count, asis[i].found, query.turn)]
    return []


def _as_drive(model: DejaVu, frames: Tensor) -> Seen:
    """What frames show as a drive."""
    scorer = _scorer(model, frames)
    match = answer(scorer, model.matching(PlaceSmoother(ANY_SPEED)))
    surely = match.is_drive and scorer.null is not None
    return _seen(match, surely, getattr(match.smoother, "log_likelihood", None) or 0.0)


def _alone(model: DejaVu, frames: Tensor) -> Seen:
    """What frames show by themselves."""
    scorer, plainly = _scorer(model, frames), 0.0
    if scorer.null is not None:
        sure = partial(confidence_of, layout=scorer.layout)
        known = singly(scorer.rows, scorer.null, torch.ones(len(frames)), sure)
        plainly = 1 - known.shown / min(known.null, -1e-9)
    match = answer(scorer, Matching(platt=model.calibration and model.calibration.single))
    return _seen(match, plainly >= SURE, plainly)


def _scorer(model: DejaVu, frames: Tensor) -> Scorer:
    some = Frames(as_shape(frames, model.frame_shape or ()))
    return model.scorer(model.descriptor.all_of(some))


def _seen(match: Match, surely: bool, plainly: float) -> Seen:
    probable = torch.zeros(1) if match.probability is None else match.probability
    found = int((probable >= PROBABLE).sum()) if surely else 0
    return Seen(found >= ENOUGH * len(match), plainly, found)
