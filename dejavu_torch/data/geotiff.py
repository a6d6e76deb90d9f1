"""TIFF files in parts, and their coordinates, by rasterio."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from dejavu_torch.area import Ground
from dejavu_torch.data.files import reading
from dejavu_torch.data.folder import as_bytes
from dejavu_torch.types import Facts, expect

UNREAD, EXPECTED = "cannot be read as a TIFF", "a GeoTIFF of grey, RGB or more bands"
DEGREES, STRETCHED = "EPSG:4326", 0.01  # by how much metres of a map may differ from those on the ground
KIND = "IMAGE_STRUCTURE"
CACHE = 2**28  # bytes of decoded blocks that GDAL keeps
BENT = 1.0  # metres, or pixels if these are larger, by which rows may differ from a straight line


def has_rasterio() -> bool:
    """Whether rasterio is installed."""
    try:
        import_module("rasterio")
    except ImportError:
        return False
    return True


class GeoTiff:
    """The pixels of a TIFF file: `tiff(top, bottom, left, right)` are (C,h,w) uint8, black where none are.

    Attributes:
        shape: (C,H,W). ground: where they lie; None without coordinates. plain: whether its pixels are values
            of grey or colours, not single bits, or numbers of a palette.

    Convention: the first three bands are colours; of fewer, the first is grey.

    Raises:
        InputError: no TIFF, or coordinates that no plane fits; while reading, values outside [0, 1].
    """

    def __init__(self, path: Path) -> None:
        self.path, self._file, self._owner = path, None, 0
        with self._opened() as file:
            self.bands = [1, 2, 3] if file.count >= 3 else [1]
            self.shape = len(self.bands), file.height, file.width
            kind = {*file.tags(ns=KIND), *file.tags(1, ns=KIND), file.colorinterp[0].name}
            self.plain = kind.isdisjoint({"NBITS", "MINISWHITE", "palette"})
            self.ground = None if file.crs is None or file.transform.is_identity else _ground(path, file)

    def __getstate__(self) -> Facts:
        return self.__dict__ | {"_file": None}

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """The file, opened in each process."""
        rasterio = import_module("rasterio")
        with reading(self.path, UNREAD, EXPECTED), rasterio.Env(GDAL_CACHEMAX=CACHE):
            try:
                if self._file is None or self._owner != os.getpid():
                    self._file = rasterio.open(self.path.absolute(), driver="GTiff")
                    self._owner = os.getpid()
                yield self._file
            except rasterio.errors.RasterioIOError as error:
                raise (error.__cause__ or error) from None  # it says no more than that reading failed

    def __call__(self, top: int, bottom: int, left: int, right: int) -> Tensor:
        part = {"window": ((top, bottom), (left, right))}
        with self._opened() as file:
            seen = file.dataset_mask(**part) > 0
            return as_bytes(self.path, np.where(seen, file.read(self.bands, **part), 0))


def _ground(path: Path, file: Any) -> Ground:
    """The coordinates of the file, if they are metres on the ground; else those of its zone of UTM."""
    crs, corner, code = file.crs, file.transform, file.crs.to_epsg()
    convert = import_module("rasterio.warp").transform
    at = np.array([(x * file.width, y * file.height) for x in (0, 0.5, 1) for y in (0, 0.5, 1)])
    points = at @ [[corner.a, corner.d], [corner.b, corner.e]] + [corner.c, corner.f]
    (longitude,), (latitude,) = convert(crs, DEGREES, *points[4:5].T.tolist())
    zone = f"EPSG:{32601 + 100 * (latitude < 0) + int((longitude + 180) // 6) % 60}"
    known = np.array(convert(crs, zone, *points.T.tolist())).T
    known, origin, terms = known - known[4], known[4], np.column_stack([at, np.ones(len(at))])
    fit = np.linalg.lstsq(terms, known, rcond=None)[0]
    longer = np.hypot(*fit[:2].T) / np.hypot([corner.a, corner.b], [corner.d, corner.e])
    metres = crs.is_projected and crs.linear_units_factor[1] == 1
    if metres and (np.abs(longer - 1) <= STRETCHED).all():
        frame = f"EPSG:{code}" if code else crs.to_wkt()
        return Ground((corner.c, corner.f), (corner.a, corner.d), (corner.b, corner.e), "m", frame)
    bent = np.abs(terms @ fit - known).max()
    seen = f"{path} has coordinates of {f'EPSG:{code}' if code else 'a system'} that bend by {bent:.3g} m"
    expect(bent <= max(BENT, np.hypot(*fit[0])), f"metres, as by gdalwarp -t_srs {zone}", seen)
    right, down, first = ((float(x), float(y)) for x, y in (*fit[:2], fit[2] + origin))
    return Ground(first, right, down, "m", zone)
