"""Batches of frames with their right places, from any traverse."""

from __future__ import annotations

from typing import Any

import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader

from dejavu_torch.data.source import open_source
from dejavu_torch.data.truth import Shown, as_truth
from dejavu_torch.data.truthfile import find_truth
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.training.frames import Batch, Clips, StoredFrames, store
from dejavu_torch.types import InputError, Traverse


class RouteData(LightningDataModule):
    """A reference traverse to train on, and what to train, validate and test with beside it.

    Args:
        source: the reference, whose frames are the places of the map: what `open_source` reads, or a
            Traverse.
        second: another traverse of the same route to train on as well: its frames are positives of the
            places they show.
        second_truth: which places those are, see `find_truth`.
        validation: a traverse to validate on during training. None: the reference itself under
            augmentation, always the same, which needs no second traverse.
        validation_truth: see `find_truth`.
        query: the traverse that `test` localizes. truth: its places, see `find_truth`.
        tolerance: places within which one is right, inclusive.
        batch_size: frames of a batch.
        clip: consecutive frames in a batch, which get the same augmentation; 1 draws each frame by itself.
        resize: (height, width) in pixels that frames are kept in; None keeps their size.
        augmentation: of the training frames; None is `Augmentation` with its defaults.
        velocity: makes places and queries even steps along the ground, as in `DejaVu`.

    Convention: frames are kept as bytes; beyond `concatenate`'s share of memory they lie in a file.

    Raises:
        InputError: a traverse that cannot be read, no longer than the tolerance, without known places, or of
            frames of another size than the reference's.
    """

    def __init__(
        self,
        source: Any,
        second: Any = None,
        second_truth: str | None = None,
        validation: Any = None,
        validation_truth: str | None = None,
        query: Any = None,
        truth: str | None = None,
        tolerance: int = 5,
        batch_size: int = 64,
        clip: int = 1,
        resize: tuple[int, int] | None = None,
        augmentation: Augmentation | None = None,
        velocity: GroundOdometry | None = None,
    ) -> None:
        super().__init__()
        if tolerance < 0 or clip < 1 or batch_size < 2 or batch_size % clip:
            raise InputError(
                f"tolerance is {tolerance}, batch_size {batch_size}, clip {clip}; expected a tolerance of 0 "
                "or more, and batches of at least 2 frames made of whole clips"
            )
        if resize is not None and (len(resize) != 2 or min(resize) < 1):
            raise InputError(f"resize is {resize}; expected (height, width), at least 1 pixel each")
        self.source = source
        self.others = {
            "second": (second, second_truth),
            "validation": (validation, validation_truth),
            "query": (query, truth),
        }
        self.tolerance = tolerance
        self.batch_size = batch_size
        self.clip = clip
        self.resize = None if resize is None else (int(resize[0]), int(resize[1]))
        self.augmentation = Augmentation() if augmentation is None else augmentation
        self.velocity = velocity
        self.augmenting = True  # the frames that are trained on
        self.raw: Traverse  # the reference as it came
        self.reference: Traverse  # the same, at even steps where asked for
        self.sets: dict[str, StoredFrames] = {}

    def setup(self, stage: str) -> None:
        """Read the reference, and what the stage needs beside it."""
        if "reference" not in self.sets:
            self.raw = _open(self.source)
            self.reference = self._evenly(self.raw)
            values = store(self.reference, self.resize)
            self._check_length(self.reference.name, len(values))
            self.sets["reference"] = StoredFrames(values, as_truth(torch.arange(len(values))[:, None]))
        needed = {"fit": ("second", "validation"), "validate": ("validation",), "test": ("query",)}
        for name in needed.get(stage, ()):
            if self.others[name][0] is not None and name not in self.sets:
                self.sets[name] = self._read(name)
        if stage == "test" and "query" not in self.sets:
            raise InputError("there is nothing to test on; expected data.query, a second traverse")

    def _read(self, name: str) -> StoredFrames:
        source, truth = self.others[name]
        raw, reference = _open(source), self.sets["reference"]
        step = self.reference.step if isinstance(self.reference, ResampledTraverse) else None
        traverse = self._evenly(raw, step)
        values = store(traverse, self.resize)
        self._check_length(traverse.name, len(values))
        if values.shape[1:] != reference.values.shape[1:]:
            raise InputError(
                f"{traverse.name} has frames of {tuple(values.shape[1:])}, the reference of "
                f"{tuple(reference.values.shape[1:])}; expected the same channels, and one size, "
                "as data.resize makes"
            )
        shown = None
        if isinstance(self.reference, ResampledTraverse):
            frame = traverse.frame if isinstance(traverse, ResampledTraverse) else None
            shown = Shown(frame, self.reference.frame, self.reference.place_of, raw.length)
        known = find_truth(truth, self.raw, raw, len(reference), len(values), shown=shown)
        if known is None:
            option = "data.truth" if name == "query" else f"data.{name}_truth"
            raise InputError(
                f"nothing tells which of {len(reference)} places the {len(values)} frames of {traverse.name} "
                f"show; expected {option}"
            )
        return StoredFrames(values, known)

    def _evenly(self, traverse: Traverse, step: float | None = None) -> Traverse:
        return DejaVu(velocity=self.velocity, batch_size=self.batch_size).evenly(traverse, step)

    def _check_length(self, name: str, frames: int) -> None:
        if frames <= max(1, self.tolerance):
            raise InputError(
                f"{name} has {frames} frame{'s' * (frames != 1)} and the tolerance is {self.tolerance}: "
                "every answer would be right; expected a longer route"
            )

    def train_dataloader(self) -> DataLoader[Batch]:
        """Frames of the reference and of the second traverse, augmented."""
        parts = [self.sets[name] for name in ("reference", "second") if name in self.sets]
        lengths = [len(part) for part in parts]
        if max(lengths) < self.clip:
            raise InputError(f"clip is {self.clip} and the route has {max(lengths)} frames; expected fewer")
        rights = [part.truth.positives for part in parts]
        width = max(right.shape[1] for right in rights)
        pad = torch.nn.functional.pad
        right = torch.cat([pad(right, (0, width - right.shape[1]), value=-1) for right in rights])
        frames = StoredFrames(parts[0].values, as_truth(right), *(part.values for part in parts[1:]))
        return _loader(frames, Clips(lengths, self.batch_size, self.clip))

    def val_dataloader(self) -> DataLoader[Batch]:
        """The validation traverse, or the reference under augmentations that are the same each time."""
        return self._in_order("validation" if "validation" in self.sets else "reference")

    def test_dataloader(self) -> DataLoader[Batch]:
        """The query traverse, as it is."""
        return self._in_order("query")

    def _in_order(self, name: str) -> DataLoader[Batch]:
        frames = torch.arange(len(self.sets[name])).split(self.batch_size)
        return _loader(self.sets[name], [part.tolist() for part in frames])

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Augment where frames train, and where the reference stands in for a validation traverse."""
        if batch.frames.ndim != 4 or self.trainer is None:
            return batch
        if self.trainer.training:
            return (
                batch._replace(frames=self.augmented(batch.frames, self.clip)) if self.augmenting else batch
            )
        if (self.trainer.validating or self.trainer.sanity_checking) and "validation" not in self.sets:
            with torch.random.fork_rng():
                torch.manual_seed(int(batch.truth.positives[0, 0]))
                return batch._replace(frames=self.augmented(batch.frames, 1))
        return batch

    def augmented(self, frames: Tensor, clip: int) -> Tensor:
        """Frames (B,C,H,W), clip after clip, as on another day."""
        self.augmentation.train()
        augmented: Tensor = self.augmentation(frames.unflatten(0, (-1, clip)))
        return augmented.flatten(0, 1)


def _open(source: Any) -> Traverse:
    return source if isinstance(source, Traverse) else open_source(source)


def _loader(frames: StoredFrames, batches: Any) -> DataLoader[Batch]:
    # the sampler yields whole batches of indices, so that frames are read many at a time; a generator of its
    # own, so that a validation takes none of training's random numbers
    return DataLoader(frames, sampler=batches, batch_size=None, generator=torch.Generator())
