"""Frames -> descriptors: preprocessing, features and whitening, as one module (section IV-A)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import cast

import torch
from torch import Tensor, nn

from dejavu_torch.data.maker import check_maker
from dejavu_torch.data.moving import Moved
from dejavu_torch.data.traverse import Part
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.extract import (
    as_weights,
    check_alone,
    feature_batches,
    features_of,
    in_mode,
    moved_features,
    moves,
    warn_of_bright,
    warn_of_raw,
)
from dejavu_torch.features.hog import CELL, HOG
from dejavu_torch.features.joined import Joined, groups_of
from dejavu_torch.features.preprocess import BLANK, DEEP, Preprocess, measured_range
from dejavu_torch.features.shared import Blocks, Sharing, Windows
from dejavu_torch.features.views import SAMPLE, AugmentedFrames, LabelledFrames, Sample, augmented_route
from dejavu_torch.features.whitening import INDEPENDENT, MOST_VIEWS, WIDEST, Visits, Whitening
from dejavu_torch.memory import IN_MEMORY, concatenate
from dejavu_torch.text import progress_of
from dejavu_torch.types import BATCH_NUMBERS, BATCH_SIZE, InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

DRAWN = 32  # frames that the preprocessing adapts to
NARROW = 0.1  # share of the values of 16 bits; a warning is given if the frames use less
ROWS = 4096  # descriptors on the device at a time
DESCRIPTOR_MEMORY = IN_MEMORY // 4  # bytes of descriptors kept in memory

OnFirst = Callable[[Tensor, Tensor], None]  # receives the first batch of frames and its features


class Descriptor(nn.Module):
    """Computes descriptors: preprocessing, features, whitening.

    Args:
        preprocess, features, whitening: see `DejaVu`; without whitening the features are the descriptors.
        batch_size: frames in memory at a time, fewer if the features enlarge them.
        weight_bits: of each weight of the features in a map file.

    Shape: frames (B,C,H,W), or ready features (B,D) -> descriptors (B,K), differentiable.

    Raises:
        InputError: neither frames nor features, or features of another dimension than the whitening's.

    Example:
        >>> from dejavu_torch import open_source
        >>> descriptor, route = Descriptor(whitening=Whitening(4)), open_source("sim:aerial?frames=40")
        >>> descriptor.learn(route).shape, descriptor(route[:2]).shape
        (torch.Size([40, 4]), torch.Size([2, 4]))
    """

    _where: Tensor
    offset: Tensor

    def __init__(
        self,
        preprocess: Preprocess | None = None,
        features: nn.Module | None = None,
        whitening: Whitening | None = None,
        batch_size: int = BATCH_SIZE,
        weight_bits: int = 32,
    ) -> None:
        super().__init__()
        self.preprocess = Preprocess() if preprocess is None else preprocess
        self.features = default_features(whitening is not None) if features is None else features
        self.whitening = whitening
        self.batch_size, self.weight_bits = batch_size, weight_bits
        self.reduces = False  # whether the whitening was added for ready features that are too wide for a map
        self.warned: set[tuple[str, str]] = set()  # (traverse, line) of warnings that were logged
        self.known: dict[object, tuple[object, Tensor]] | None = None  # features, see `remembering`
        self.aside: dict[int, list[Tensor]] = {}  # batches of HOG, see `setting_aside`
        self.register_buffer("_where", torch.zeros(0), persistent=False)
        # of features of windows that share them, see `Sharing`; empty before it is known
        self.register_buffer("offset", torch.zeros(0), persistent=False)

    @property
    def device(self) -> torch.device:
        """The device that computes."""
        return self._where.device

    def describe(self, frames: Tensor) -> Tensor:
        """Preprocess, then features: (B,C,H,W) -> (B,D); 0 for frames that show nothing."""
        features = self.describe_all(frames)
        fits = isinstance(features, Tensor) and features.ndim == 2 and features.shape[0] == frames.shape[0]
        if self.preprocess.blank == 0 or not fits:
            return features
        return features * self.preprocess.shows(frames)[:, None].to(features)

    def describe_all(self, frames: Tensor) -> Tensor:
        """As `describe`, also of frames that show nothing."""
        features: Tensor = self.features(as_weights(self.preprocess(frames), self.features))
        return features

    def describe_moved(self, frames: Tensor, shifts: Sequence[float]) -> Tensor:
        """As `describe`, of copies that are moved sideways, see `Moved`: (B,C,H,W) -> (B,V,D)."""
        features = moved_features(self.features, self.preprocess(frames), shifts)
        return features * self.preprocess.shows(frames)[:, None, None].to(features)

    def whitened(self, features: Tensor) -> Tensor:
        """Features (B,D) -> descriptors (B,K); 0 for features of 0."""
        if self.whitening is None:
            return features
        whitened: Tensor = self.whitening(features)
        return whitened * features.any(1, keepdim=True).to(whitened)

    def forward(self, frames: Tensor) -> Tensor:
        return self.whitened(features_of(frames, self.describe, "the input"))

    def features_in(
        self,
        traverse: Traverse | AugmentedFrames,
        progress: bool = False,
        verb: str = "describing",
        on_first: OnFirst | None = None,
        shared: bool = False,
    ) -> Iterator[Tensor]:
        """Batches (B,D) of features, without gradients; see `feature_batches`.

        Args:
            shared: of a picture's windows, by `Sharing`, if it knows these features.
        """
        height, width = own_size(self.features) or (1, 1)
        size = max(1, min(self.batch_size, BATCH_NUMBERS // (3 * height * width)))
        settings = self.device, progress, verb, on_first, self.describe
        windows = Windows.of(traverse) if shared else None
        if windows is not None and self.sharing.fits(windows.grid):
            return self._shared(windows, traverse, size, progress, verb, on_first)
        batches = (
            self._moved(cast(Moved, traverse), size, progress, verb, on_first)
            if hasattr(traverse, "shifts")
            else feature_batches(traverse, self, size, *settings)
        )
        once = len(getattr(traverse, "shifts", ())) > 1  # copies are made anew each time
        if self.known is None or once:
            return self._set_aside(batches, traverse) if id(traverse) in self.aside else batches
        key = traverse.name if isinstance(traverse, AugmentedFrames) else id(traverse)
        if key not in self.known:
            features = concatenate(batches, len(traverse))
            self.known[key] = traverse, features  # which keeps its id
        return (part.to(self.device) for part in self.known[key][1].split(ROWS))

    def _moved(
        self,
        traverse: Moved,
        size: int,
        progress: bool,
        verb: str,
        on_first: OnFirst | None,
    ) -> Iterator[Tensor]:
        """Features of copies of each frame, see `Moved`, which share what can be computed once."""
        shifts, count = traverse.shifts, len(traverse.shifts)

        def describe(frames: Tensor) -> Tensor:
            return self.describe_moved(frames, shifts).flatten(1)

        def first(frames: Tensor, features: Tensor) -> None:
            if on_first is not None:
                on_first(frames, features[:, : features.shape[1] // count])

        settings = self.device, progress, verb, first, describe
        for batch in feature_batches(traverse.traverse, self, size, *settings):
            yield batch.unflatten(1, (count, -1)).flatten(0, 1)

    @property
    def moves(self) -> bool:
        """Whether views of a frame share most of what is computed, so that they cost little."""
        return moves(self.features)

    def fits(self, dimension: int, traverse: Traverse | AugmentedFrames) -> bool:
        """Whether it describes a traverse in so many dimensions, as those of a map that others made."""
        if self.whitening is not None and not self.whitening.learned:
            return False
        return next(self.batches(Part(cast(Traverse, traverse), range(1)))).shape[1] == dimension

    @property
    def sharing(self) -> Sharing:
        """Describes windows of a picture with what they share."""
        return Sharing(self.preprocess, self.features, self.device)

    @torch.no_grad()
    def _shared(
        self,
        windows: Windows,
        traverse: Traverse | AugmentedFrames,
        size: int,
        progress: bool,
        verb: str,
        on_first: OnFirst | None,
    ) -> Iterator[Tensor]:
        if on_first is not None:
            some = Part(windows.grid, range(min(size, len(windows.grid))))
            on_first(some[:], torch.cat([*self.features_in(some)]))
        with progress_of(verb, len(traverse), progress) as update, in_mode(self.features, False):
            offset = self.offset if len(self.offset) else 0.0
            for batch in self.sharing.batches(windows, offset):
                update(len(batch))
                yield batch

    @contextmanager
    def remembering(self) -> Iterator[None]:
        """In the block, the features of each traverse, and of the copies of one, are computed once."""
        self.known = {}
        try:
            yield
        finally:
            self.known = None

    @contextmanager
    def setting_aside(self, *traverses: Traverse) -> Iterator[None]:
        """In the block, `HOG()` of these traverses is kept where the features have it, for `hog_of`."""
        self.aside = {id(traverse): [] for traverse in traverses if not is_ready(traverse)}
        try:
            yield
        finally:
            self.aside = {}

    def hog_of(self, traverse: Traverse) -> Tensor | None:
        """`HOG()` (N,D) of a traverse, if it was set aside whole."""
        parts = self.aside.get(id(traverse), [])
        return torch.cat(parts) if sum(map(len, parts)) == len(traverse) else None

    def _set_aside(self, batches: Iterator[Tensor], traverse: Traverse | AugmentedFrames) -> Iterator[Tensor]:
        """The batches, whose part that is `HOG()` is kept, unless it is large."""
        parts = self.aside[id(traverse)]
        parts.clear()  # of an earlier reading
        for batch in batches:
            hog = _plain_hog(self.features, batch)
            if hog is not None and 4 * len(traverse) * hog.shape[1] <= DESCRIPTOR_MEMORY:
                parts.append(hog.to("cpu", copy=True))
            yield batch

    def batches(
        self,
        traverse: Traverse | AugmentedFrames,
        progress: bool = False,
        verb: str = "describing",
        on_first: OnFirst | None = None,
        shared: bool = False,
    ) -> Iterator[Tensor]:
        """Batches (B,K) of the descriptors of a traverse, in order, without gradients.

        Args:
            shared: of a reference that is windows of a picture, see `features_in`.
            progress: show a bar on stderr, or lines if it is no terminal. verb: its name.
            on_first: called with the first batch of frames and its features.
        """
        for features in self.features_in(traverse, progress, verb, on_first, shared):
            descriptors = self.whitened(features)
            seen = f"the whitening makes NaN or infinity of the features of {traverse.name}"
            expect(descriptors.isfinite().all(), "a map of such frames", seen)
            yield descriptors

    def all_of(self, traverse: Traverse, progress: bool = False, on_first: OnFirst | None = None) -> Tensor:
        """Descriptors (N,K) of a whole traverse; many are kept in a temporary file, see `concatenate`."""
        batches = self.batches(traverse, progress, f"describing {traverse.name}", on_first)
        return concatenate(batches, len(traverse))

    def learn(
        self,
        traverse: Traverse,
        second: LabelledFrames | None = None,
        progress: bool = False,
        spectral: bool = True,
        verb: str = "learning",
    ) -> Tensor:
        """Descriptors (N,K) of a reference, from which the whitening is learned first, unless it is fixed.

        Args:
            second: another traverse of the same places, from which the whitening learns what changes between
                visits, instead of from augmented copies, or besides; see `growth.second_traverse`.
            spectral: for a spectral map: ready features of over 256 dimensions are reduced to principal
                components if there is no whitening, whitening learns from a sample if the features exceed
                the memory, and many descriptors are kept in a temporary file, as float16 if they are
                whitened, which is finer than any step.

        Raises:
            InputError: no whitening that learns from `second`; frames that cannot be described, or whose
                features depend on other frames. The whitening stays as it was.
        """
        if second is not None:
            self.require_learning(second.traverse.name)

        def check_first(frames: Tensor, features: Tensor) -> None:
            self.warn_of_bright(frames, traverse.name)
            self._warn_of_narrow(frames, traverse)
            warn_of_raw(self.features, frames)
            check_alone(self, self.describe, frames, features, traverse.name)

        again = traverse, second, progress, spectral, verb
        with self.unchanged_by_errors():
            self.adapt(traverse)
            self.reduce_if_wide(traverse, spectral)
            whitening = self.whitening
            if whitening is not None and not whitening.fixed:
                if not (spectral and self._exceeds_memory(traverse)):
                    batches = self.features_in(traverse, progress, verb, check_first, True)
                    features = concatenate(batches, len(traverse))
                    if self._mostly_blank(features, traverse):
                        return self.learn(*again)
                    self._learn_whitening(whitening, features, traverse, second, progress)
                    parts = features.split(ROWS)
                    return concatenate((self.whitened(part.to(self.device)) for part in parts), len(features))
                sample = Sample.of_route(traverse.layout, SAMPLE)
                views = second and sample.views(second)
                self.learn(Part(traverse, sample.frame), views, progress, verb="sampling")
            storage = (DESCRIPTOR_MEMORY, self.whitening is not None) if spectral else ()
            batches = self.batches(traverse, progress, verb, check_first, True)
            rows = concatenate(batches, len(traverse), *storage)
            return self.learn(*again) if self._mostly_blank(rows, traverse) else rows

    def _mostly_blank(self, rows: Tensor, traverse: Traverse) -> bool:
        """Whether most frames count as blank, as where values have another unit; from then on none does."""
        if is_ready(traverse) or self.preprocess.blank != BLANK or 2 * int(rows.any(1).sum()) >= len(rows):
            return False
        self.preprocess.blank = 0.0
        if self.known is not None:
            self.known.clear()
        return True

    def adapt(self, traverse: Traverse, resumed: bool = False) -> None:
        """Fix the cells of HOG if they follow the size of a reference's frames, and measure a range that is
        "auto" on 32 of them, evenly drawn; for a run that is resumed, also whether most count as blank, which
        the run before has found."""
        own = self.preprocess
        if not is_ready(traverse):
            self.features = _for_frames(self.features, *traverse.frame_shape[1:])
        windows = Windows.of(traverse)
        if windows is not None and not isinstance(traverse, Blocks) and self.sharing.fits(windows.grid):
            with torch.no_grad(), in_mode(self.features, False):
                self.offset = self.sharing.offset(windows.grid)
        if is_ready(traverse) or not (own.range == "auto" or (resumed and own.blank == BLANK)):
            return
        drawn = torch.linspace(0, len(traverse) - 1, min(DRAWN, len(traverse))).round().long()
        frames = [traverse[i] for i in drawn]
        if own.range == "auto":
            own.range = low, high = measured_range(frames)
            known = f"{round(DEEP * low)} to {round(DEEP * high)} of {DEEP}" if traverse.deep else ""
            log.warning("%s: values from %s are used", traverse.name, known or f"{low:.3g} to {high:.3g}")
        if resumed and 2 * sum(bool(own.shows(frame[None])) for frame in frames) < len(frames):
            own.blank = 0.0

    def reduce_if_wide(self, traverse: Traverse, spectral: bool = True) -> None:
        """Without whitening of the user's: one for ready features that are too wide for a spectral map."""
        if self.reduces or self.whitening is None:
            self.reduces = spectral and is_ready(traverse) and traverse.frame_shape[0] > WIDEST
            self.whitening = Whitening(views=0).to(self.device) if self.reduces else None

    def _exceeds_memory(self, traverse: Traverse) -> bool:
        """Whether the float32 features of a traverse longer than `SAMPLE` exceed the memory."""
        frames = len(traverse)
        return frames > SAMPLE and 4 * frames * self.count_features(traverse) > IN_MEMORY

    def _learn_whitening(
        self,
        whitening: Whitening,
        features: Tensor,
        traverse: Traverse,
        second: LabelledFrames | None,
        progress: bool,
    ) -> None:
        expect(len(features) >= 2, "at least 2", f"{traverse.name} has 1 frame")
        visits = second if second is not None and second.placed is not None else None
        second = None if visits is not None else second
        source = "" if second is None else f"by {second.traverse.name}"
        if second is None and not is_ready(traverse) and whitening.views != 0:
            copies = whitening.copies(*features.shape)
            settings = copies, MOST_VIEWS, whitening.strengths, whitening.seed, self.preprocess.span
            second, source = augmented_route(traverse, len(features), *settings)
        shows = features.any(1)
        if 2 <= int(shows.sum()) < len(features):  # nothing is learned from blank frames
            features, number = features[shows], torch.where(shows, shows.cumsum(0) - 1, -1).cpu()
            visits, second = (views and views.renumbered(number) for views in (visits, second))
        groups = None if is_ready(traverse) else groups_of(self.features)
        copied = second is not None and isinstance(second.traverse, AugmentedFrames)
        samples = INDEPENDENT * len(features) if copied else None
        views = None if second is None else self._shown(second, source, progress)
        if visits is None or not (known := visits.places >= 0).any():
            whitening.learn(features, views, groups, samples)
        else:
            assert visits.placed is not None
            shown = self._shown(visits, f"by {visits.traverse.name}", progress)
            whitening.learn(features, views, groups, samples, Visits(shown, visits.placed.drive[known]))
        whitening.to(self.device)
        if whitening.lengths and whitening.decides:
            found = "the lengths of its descriptors are kept: places are told apart by them"
            log.warning("%s: %s (--whitening.lengths false leaves them out)", traverse.name, found)

    def _shown(self, views: LabelledFrames, source: str, progress: bool) -> Iterator[tuple[Tensor, Tensor]]:
        """Batches of features and the places that they show."""
        batches = self.features_in(views.traverse, progress, f"learning what changes: {source}")
        return _with_places(batches, views.places.to(self.device))

    @contextmanager
    def unchanged_by_errors(self) -> Iterator[None]:
        """Restores the whitening and what the preprocessing adapts if the block raises."""
        adapted = self.preprocess.range, self.preprocess.blank
        features, offset = self.features, self.offset
        before = self.whitening, self.reduces, None if self.whitening is None else self.whitening.state_dict()
        try:
            yield
        except BaseException:
            self.preprocess.range, self.preprocess.blank = adapted
            self.features, self.offset = features, offset
            self.whitening, self.reduces, state = before
            if self.whitening is not None and state is not None:
                self.whitening.load_state_dict(state)
            raise

    def take(self, other: Descriptor, whitening: bool = False) -> None:
        """Use the preprocess and features of another descriptor, such as one trained on many routes, and its
        whitening too if asked for, which becomes fixed. Raises InputError if it has none.

        Example:
            >>> descriptor = Descriptor(features=HOG())
            >>> descriptor.take(Descriptor(features=HOG(cell=16)))
            >>> descriptor.features.cell
            16
        """
        if whitening:
            if other.whitening is None or not other.whitening.learned:
                raise InputError("its map was learned without whitening; expected one learned with whitening")
            self.whitening, self.reduces = other.whitening, False
            self.whitening.fixed = True
        self.preprocess, self.features = other.preprocess, other.features
        self.weight_bits = other.weight_bits

    def require_learning(self, name: str) -> None:
        """Refuse a second traverse of this name if no whitening learns from it."""
        if self.whitening is None or self.whitening.fixed or self.reduces:
            fixed = self.whitening is not None and self.whitening.fixed
            seen = "the whitening is another map's" if fixed else "there is no whitening"
            raise InputError(f"{seen} to learn from {name}; expected a whitening that is learned")

    def warn_of_bright(self, frames: Tensor, name: str) -> None:
        """`warn_of_bright`, once for each traverse."""
        if (name, "bright") not in self.warned and warn_of_bright(frames, name):
            self.warned.add((name, "bright"))

    def _warn_of_narrow(self, frames: Tensor, traverse: Traverse) -> None:
        """Tell of frames of 16 bits that use few of them, as of a thermal or depth camera."""
        if is_ready(traverse) or self.preprocess.contrast or self.preprocess.range or not traverse.deep:
            return
        low, high = (float(value) for value in frames.aminmax())
        if high - low < NARROW and (traverse.name, "narrow") not in self.warned:
            self.warned.add((traverse.name, "narrow"))
            seen = f"values from {round(DEEP * low)} to {round(DEEP * high)} of {DEEP}"
            log.warning("%s has %s; --preprocess.range auto makes use of so few", traverse.name, seen)

    @property
    def keeps_lengths(self) -> bool:
        """Whether the lengths of ready features count, which a drive's own mean would change."""
        return self.whitening is not None and bool(self.whitening.lengths)

    def count_features(self, traverse: Traverse) -> int:
        """D, from the first frame."""
        return next(self.features_in(Part(traverse, range(1)))).shape[1]

    def check_sizes(self, reference: Traverse, *queries: Traverse) -> int:
        """The number of features per frame; refuses queries in which it differs before any long work."""
        for query in queries:
            check_maker(reference.maker, reference.name, query)
        counts = [self.count_features(traverse) for traverse in (reference, *queries)]
        for query, count in zip(queries, counts[1:], strict=True):
            if count != counts[0]:
                seen = " and ".join(
                    f"{traverse.name} gives {number} features per frame of "
                    f"{' x '.join(map(str, traverse.frame_shape))}{_pixels(traverse)}"
                    for traverse, number in ((reference, counts[0]), (query, count))
                )
                swapped = is_ready(reference) and is_ready(query) and len(reference) == len(query)
                hint = ". If rows and columns are swapped, save the transposes" if swapped else ""
                raise InputError(f"{seen}; expected the same number, from frames of the same size{hint}")
        return counts[0]


def _pixels(traverse: Traverse) -> str:
    """The shape of the pixels of a video, if they are not square, in words."""
    while isinstance(traverse, Part):
        traverse = traverse.traverse
    pixels = getattr(traverse, "pixels", 1)
    return "" if pixels == 1 else f" (its pixels are {pixels.numerator}:{pixels.denominator}, not square)"


def is_ready(traverse: Traverse | AugmentedFrames | None) -> bool:
    """Whether a traverse holds ready features, not frames."""
    return traverse is not None and len(traverse.frame_shape) == 1


def default_features(whitens: bool = True) -> nn.Module:
    """HOG and the package's network side by side; without whitening HOG alone, as in the paper."""
    return Joined([HOG(cell=None), Distilled()]) if whitens else HOG()


def _for_frames(features: nn.Module, height: int, width: int) -> nn.Module:
    """Features whose HOG has the cells of frames of this size; other parts are the same modules."""
    if isinstance(features, HOG):
        return features.for_frames(height, width)
    if not isinstance(features, Joined):
        return features
    members = [_for_frames(member, height, width) for member in features.members]
    same = all(one is own for one, own in zip(members, features.members, strict=True))
    return features if same else Joined(members).train(features.training)


def _plain_hog(features: nn.Module, rows: Tensor) -> Tensor | None:
    """The columns of features (B,D) that are those of `HOG()`, if any."""
    members = [*features.members] if isinstance(features, Joined) else [features]
    parts = rows.split(groups_of(features) or rows.shape[1], 1)
    plain = HOG().extra_repr()
    known = (type(one) is HOG and one.extra_repr() == plain for one in members)
    return next((part for part, same in zip(parts, known, strict=True) if same), None)


def own_size(features: nn.Module, block: bool = False) -> tuple[int, int] | None:
    """The size (height, width) to which features of this package resize frames, the largest of joined ones;
    None if they do not. With `block`, also the size of a block of HOG."""
    if isinstance(features, Joined):
        sizes = [*filter(None, (own_size(member, block) for member in features.members))]
        return (max(height for height, _ in sizes), max(width for _, width in sizes)) if sizes else None
    known = type(features).__module__.startswith("dejavu_torch.")
    size: tuple[int, int] | None = getattr(features, "resize", None) if known else None
    if size is None and block and type(features) is HOG:
        size = ((features.cell or CELL) * features.block,) * 2
    return size


def _with_places(batches: Iterator[Tensor], places: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of features with their places (B,), without frames that show none."""
    done = 0
    for batch in batches:
        shown = places[done : done + len(batch)]
        yield batch[shown >= 0], shown[shown >= 0]
        done += len(batch)
