"""Localize one frame at a time, with the state of a sequence or a filter."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.traverse import resize_like
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.memory import in_one_thread
from dejavu_torch.model import DejaVu, check_queries
from dejavu_torch.recognition import odometry
from dejavu_torch.recognition.centring import running_mean, set_apart
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.querying import SEQUENCES, Sequences
from dejavu_torch.recognition.views import ALONE
from dejavu_torch.types import Facts, InputError, Match, SequenceModel, check_shape, expect

EXPECTED = "uint8 (H,W), (H,W,3) or (3,H,W), or float in [0, 1], or float (D,) for a map of ready features"
DTYPES = ("uint8", "float16", "bfloat16", "float32", "float64")
SMALL = (HOG, Distilled, PatchPixels)  # features that one thread computes as fast as several
MAX_SKIPPED = 100  # skipped frames that a filter moves for; after more, a jump finds the place again
# columns of a match, and what stands for those that are not known
TOLD = {"accepted": True, "stale": 0, **dict.fromkeys(("probability", "shift", "shift_degrees"), math.nan)}
ROUNDING = 1e-3  # tolerance of the range [0, 1]
Move: TypeAlias = "float | Sequence[float] | Tensor | None"  # places, or these and their standard deviation


class LiveMatch(NamedTuple):
    """The match of a frame; place, score, probability and accepted as in `Match`, NaN for none."""

    place: int
    frame: int  # the reference frame of the place, -1 for none
    name: str  # of that frame, if it has one
    score: float
    posterior: float  # probability of the place from a filter
    probability: float
    accepted: bool
    milliseconds: float  # taken by this frame
    route: str = ""  # of a merged map
    x: float = math.nan  # of the place in an area, pixels or metres as its coordinates
    y: float = math.nan
    shift: float = math.nan  # of the camera, see `Match`
    shift_degrees: float = math.nan
    stale: int = 0  # frames in a row that repeat one picture, see `Match`


class LiveLocalizer:
    """`DejaVu.localize` for one frame at a time.

    Args:
        model: with a map; frames are moved to its device.
        sequence: "filter" is a `PlaceFilter`; None matches each frame by itself.
        keep_scores: keep the scores of all places; otherwise single frames are searched as in `localize`.
        centre: remove the mean of the frames so far from each, see `RunningMean`.
        turned: the frames are turned north, on the map of an area; see `set_apart`.
        looking: its shifts and fov; views are learned from the first 100 frames, and answer after these.

    Shape: a frame (H,W), (H,W,3) or (C,H,W), tensor or array, uint8 or float in [0, 1] -> `LiveMatch`.

    Attributes:
        scores: (N,) of the latest answer, on the model's device; None before the first, or if not kept.

    Convention: the answers equal those of `DejaVu.localize` up to rounding; without a sequence, the first 100
        of a drive know no views yet. A refused frame changes nothing.
        `left_out` in `localizer(frame, left_out, moved)` is the number of frames skipped before this one: a
        `PlaceFilter` moves once more for each. `moved` is how many places the camera moved since the frame
        before, as odometry tells, or (places, standard deviation); then the number of skipped frames does not
        count. With a `PlaceFilter` that has a lag, `due(frame, left_out, moved)` gives the answers that this
        frame completes, none or one, in the order of the frames, and `finish()` those that are left at the
        end; without a lag `due` has the answer of the frame itself.

    Raises:
        InputError: no map, or one of even steps along the ground; a frame of another type, shape or range;
            `localizer(frame)` with a lag.

    Example:
        >>> route = torch.rand(60, 1, 32, 32)
        >>> localizer = LiveLocalizer(DejaVu().learn(route), sequence=None)
        >>> localizer(route[20]).place, localizer(route[21, 0].mul(255).byte().numpy()).place
        (20, 21)
    """

    def __init__(
        self,
        model: DejaVu,
        sequence: SequenceModel | Literal["filter"] | None = "filter",
        keep_scores: bool = True,
        centre: bool = False,
        turned: bool = False,
        looking: Sequences = SEQUENCES,
    ) -> None:
        if model.step is not None and model.velocity is not None:
            seen = "the map's places are even steps along the ground, which only a whole traverse shows"
            raise InputError(f"{seen}; expected a map without --velocity, or unchanged frames (--as_is)")
        fits = sequence in (None, "filter") or isinstance(sequence, SequenceModel)
        expect(fits, "a SequenceModel such as PlaceFilter, 'filter' or None", f"the sequence is {sequence!r}")
        self.keep_scores, self.turned = keep_scores, turned
        self.centring = running_mean(model.map) if centre and not turned else None
        self.model, self.sequence = model, PlaceFilter() if isinstance(sequence, str) else sequence
        self._shape: tuple[int, ...] | None = None  # of the latest valid frame
        images = len(model.frame_shape or ()) == 3
        self._views = model.views_at_first(looking, images, True)
        whitening = model.whitening
        members = getattr(model.features, "members", [model.features])
        self._small = all(isinstance(one, SMALL) for one in members)
        self._projection = whitening.all_unpacked() if whitening is not None and whitening.learned else None
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.scores: Tensor | None = None
        self._latest: tuple[Tensor, Tensor] | None = None  # descriptors as they are, and centred
        place_map = self.model.map
        self._mean = torch.zeros(place_map.dimension + 1, device=place_map.device)  # of the frames so far
        matching, self._driven = self.model.matching(self.sequence), self._views.as_it_drives(describes=True)
        keep = self._keep if self.keep_scores else None
        wrappers = () if self._views == ALONE else (self._driven,)
        matching = matching._replace(callback=keep, wrappers=wrappers, ordered=True)
        self._localizer = self.model.localizer(matching)

    def _keep(self, scores: Tensor) -> None:
        self.scores = scores[-1] if len(scores) else self.scores

    def __call__(self, frame: Tensor | np.ndarray, left_out: int = 0, moved: Move = None) -> LiveMatch:
        expect(not self.lag, "due(frame)", f"an answer for each frame with a lag of {self.lag}")
        return self.due(frame, left_out, moved)[0]

    @torch.no_grad()
    def due(self, frame: Tensor | np.ndarray, left_out: int = 0, moved: Move = None) -> list[LiveMatch]:
        """The answers that a frame completes: its own, or that of the frame `lag` before, if there is one."""
        told = torch.as_tensor([] if moved is None else moved, dtype=torch.float64).view(-1)
        if len(told):
            expect(self._filters, "a PlaceFilter", f"moved {told[0]:g} without a filter")
            self.model.map.layout.expect_route("a route", "moved, and the map of an area")
            odometry.check_move(float(told[0]))
        with self._localizer.alone_asked():
            return self._due(frame, left_out, told)

    def _due(self, frame: Tensor | np.ndarray, left_out: int, moved: Tensor) -> list[LiveMatch]:
        start, mean, latest = time.perf_counter(), self._mean, self._latest
        batch = as_batch(frame, self.model.map.device)
        with in_one_thread(batch.numel() if self._small else math.inf):
            descriptor = self._describe(batch)
        if self.turned:
            descriptor = set_apart(self.model.map, descriptor)
        if self.centring is not None:
            if self._latest is not None and torch.equal(self._latest[0], descriptor):
                descriptor, mean = self._latest[1], self._mean  # a picture that repeats counts once
            else:
                raw, (descriptor, mean) = descriptor, self.centring(descriptor, mean, len(descriptor))
                latest = raw, descriptor
        with in_one_thread(self.model.map.places):
            if len(moved):
                self._localizer.told(moved)
            else:
                self._localizer.skip(min(left_out, MAX_SKIPPED))
            match = self._localizer(descriptor)
        self._mean, self._latest = mean, latest
        return self._told(match, start)

    @torch.no_grad()
    def finish(self) -> list[LiveMatch]:
        """The answers of the latest `lag` frames, at the end of all."""
        start = time.perf_counter()
        return self._told(self._localizer.finish(), start)

    @property
    def _filters(self) -> bool:
        return self.sequence is not None and self.sequence.answers == "filter"

    @property
    def lag(self) -> int:
        """Frames by which an answer comes later."""
        return 0 if self.sequence is None else self.sequence.lag

    def _told(self, matches: Match, start: float) -> list[LiveMatch]:
        milliseconds = 1e3 * (time.perf_counter() - start) / max(1, len(matches))
        return [self._live(matches[i], milliseconds) for i in range(len(matches))]

    def _live(self, match: Match, milliseconds: float) -> LiveMatch:
        model = self.model
        place, score, table = int(match.index), float(match.score), model.map.table
        shown, layout = int(table.frame_of(match.index)), model.map.layout
        x, y = layout.coordinates(match.index).tolist()
        columns = {name: column.item() for name, column in match.columns.items()}
        told: Facts = {name: columns.get(name, missing) for name, missing in TOLD.items()}
        return LiveMatch(
            place=place,
            frame=int(table.own_frame_of(match.index)),
            name=model.frame_names[shown] if model.frame_names and shown >= 0 else "",
            score=score,
            posterior=math.exp(-score) if self._filters else math.nan,
            milliseconds=milliseconds,
            route=layout.names("")[int(layout.route_of(match.index))] if place >= 0 else "",
            x=x,
            y=y,
            **told,
        )

    @property
    def posterior(self) -> Tensor | None:
        """(N+1,) of a filter for the latest answer; None without a filter, or before the first frame."""
        return self._localizer.posterior

    def _describe(self, batch: Tensor) -> Tensor:
        """The descriptors (V,K) of the views of a frame, which has to fit the map."""
        whitening, dimension, shifts = self.model.whitening, self.model.map.dimension, self._driven.shifts
        batch, own = resize_like(batch, self.model.frame_shape), self.model.descriptor

        def views(frame: Tensor) -> Tensor:
            return own.describe_moved(frame, shifts).flatten(1)

        with in_mode(own, False):
            features = features_of(batch, own.describe if len(shifts) == 1 else views, "the frame")
        features = features.view(len(shifts), -1)
        if batch.shape[1:] != self._shape:
            check_queries(self.model, tuple(batch.shape[1:]), features.shape[1], "the frame")
            self._shape = batch.shape[1:]
        features = features.to(torch.promote_types(features.dtype, torch.float32))
        shows = features.any(1, keepdim=True).to(features)
        descriptor = features if whitening is None else whitening(features, self._projection) * shows
        check_shape(descriptor, f"{len(shifts)} {dimension}", "the frame gives features")
        expect(descriptor.isfinite().all(), "finite numbers", "the frame gives NaN or infinite features")
        return descriptor


def as_batch(frame: Tensor | np.ndarray, device: torch.device | str = "cpu") -> Tensor:
    """A frame as a batch (1,C,H,W) of floats in [0, 1], or ready features (D,) as (1,D)."""
    if isinstance(frame, np.ndarray) and frame.dtype.name in DTYPES:
        frame = torch.from_numpy(np.require(frame, frame.dtype.newbyteorder("="), ["C", "W"]))
    shape = tuple(getattr(frame, "shape", ()))
    kind = str(getattr(frame, "dtype", type(frame).__name__)).removeprefix("torch.")
    last, first = shape[-1:] in ((1,), (3,)), shape[:1] in ((1,), (3,))
    image = len(shape) == 2 or (len(shape) == 3 and (last or first))
    fits = image or (len(shape) == 1 and kind != "uint8")
    if not isinstance(frame, Tensor) or kind not in DTYPES or not fits or 0 in shape:
        seen = f"{shape} {kind}{', which is empty' if 0 in shape else ''}" if shape else f"a {kind}"
        raise InputError(f"the frame is {seen}; expected {EXPECTED}")
    values = frame.detach().to(device)
    if len(shape) == 1:
        return values.float()[None]
    if len(shape) == 2:
        values = values[None]
    elif last and not (first and kind != "uint8"):  # if both fit, floats have their channels first
        values = values.permute(2, 0, 1)
    if kind == "uint8":
        return values[None].float().div_(255)
    values = values if values.dtype == torch.float64 else values.float()
    low, high = (float(end) for end in values.aminmax())
    seen = f"the frame has values from {low:.4g} to {high:.4g}"
    expect(low >= -ROUNDING and high <= 1 + ROUNDING, "0 to 1", seen)
    return values[None].clamp(0, 1)
