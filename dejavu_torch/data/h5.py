"""Global descriptors in an HDF5 file, as hloc writes them, as a traverse."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import reading
from dejavu_torch.data.folder import numbers_increase, sort_names
from dejavu_torch.data.maker import as_maker
from dejavu_torch.memory import check_room
from dejavu_torch.text import one_line, printable
from dejavu_torch.types import InputError, Traverse, expect

H5_SUFFIXES = {".h5", ".hdf5"}
KEY = "global_descriptor"
EXPECTED = f"a group for each image with a dataset {KEY} (D,) of floats, as hloc writes it"


class DescriptorFile(Traverse):
    """The global descriptors in an HDF5 file of hloc (Hierarchical-Localization), sorted as in `ImageFolder`.

    Args:
        path: a file with a group for each image, whose name may contain slashes, each with a dataset
            `global_descriptor` (D,) float; other datasets are ignored.
        order: as for `ImageFolder`.

    Attributes:
        maker: the attribute "maker" of the file, if it has one.

    Shape: batches (B,D) float32.

    Raises:
        InputError: h5py is not installed, a file that cannot be read, no descriptors in it, or descriptors of
            different dimensions; while reading, NaN or infinite values.
    """

    def __init__(self, path: str | Path, order: str = "") -> None:
        self.path, self.name = Path(path), printable(path)
        shapes: dict[str, tuple[int, ...]] = {}

        def visit(name: str, item: object) -> None:
            image, _, leaf = name.rpartition("/")
            if leaf != KEY or not image:
                return
            shape, kind = getattr(item, "shape", None) or (), getattr(item, "dtype", np.dtype("O"))
            elsewhere = getattr(item, "external", None) or getattr(item, "is_virtual", False)
            if len(shape) != 1 or kind.kind != "f" or elsewhere:
                seen = f"{shape} {kind.name}{' of another file' if elsewhere else ''}"
                raise InputError(f"{self.name}: {KEY} of {image} is {seen}; expected {EXPECTED}")
            shapes[image] = shape

        with self._open() as file:
            file.visititems(visit)
            shared = KEY in file
            self.maker = as_maker(file.attrs.get("maker", ""), self.name)
            self.names = sort_names(shapes, order, self.name)
        seen = f"has one {KEY} for all images" if shared else f"contains no {KEY}"
        expect(shapes, EXPECTED, f"{self.name} {seen}")
        (width,) = shapes[self.names[0]]
        for image in self.names:
            seen = f"{KEY} of {image} has {shapes[image][0]} dimensions"
            expected = f"{width} like {self.names[0]}" if width else "at least 1"
            expect(shapes[image] == (width,) and width, expected, f"{self.name}: {seen}")
        check_room(24.0 * width, f"a descriptor of {self.name}")
        self.ordered = numbers_increase(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def read(self, frames: range | list[int]) -> Tensor:
        with self._open() as file:
            rows = np.stack([file[f"{self.names[i]}/{KEY}"][()] for i in frames])
            batch = torch.from_numpy(rows.astype(np.float32))
        bad = ~batch.isfinite().all(1)
        if bad.any():
            image = self.names[frames[int(bad.nonzero()[0])]]
            raise InputError(f"{self.name}: {KEY} of {image} has NaN or infinite values; expected none")
        return batch

    @contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            h5py = import_module("h5py")
        except ImportError as error:
            seen = f"{self.name} needs h5py, which cannot be imported ({one_line(error)})"
            raise InputError(f"{seen}; expected pip install 'dejavu_torch[h5]'") from error
        unread = "cannot be read as an HDF5 file"
        with reading(self.path, unread, EXPECTED), h5py.File(self.path, "r") as file:
            yield file
