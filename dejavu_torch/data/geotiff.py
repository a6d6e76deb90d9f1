"""TIFF files in parts, and their coordinates, by rasterio."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import reading
from dejavu_torch.data.folder import as_bytes
from dejavu_torch.places.rectangles import Ground
from dejavu_torch.text import one_line
from dejavu_torch.types import Facts, InputError, expect

UNREAD, EXPECTED = "cannot be read as a TIFF", "a GeoTIFF of grey, RGB or more bands"
DEGREES = "EPSG:4326"
STRETCHED = 0.01  # by how much the sides of a pixel may differ from each other, and from metres on the ground
MIDDLE, WIDEST = 5e5, 8e5  # metres east of a UTM zone's middle, and from it; there it stretches by 0.8 %
EDGES, ROUNDING = 21, 1e-3  # points along a side that bound a file elsewhere; pixels
KIND = "IMAGE_STRUCTURE"
Points: TypeAlias = "np.ndarray[Any, np.dtype[np.float64]]"  # (N,2)
CACHE = 2**28  # bytes of decoded blocks that GDAL keeps


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

    Convention: the first three bands are colours; of fewer, the first is grey. Pixels with coordinates are
        squares whose sides are metres on the ground, as a camera sees them. A file of others is reprojected
        while it is read, to the UTM zone of its middle, or, if it is in metres already, to its own system.

    Raises:
        InputError: no TIFF; one to be reprojected that is not `plain`, or reaches over 800 km from the middle
            of a UTM zone; while reading, values outside [0, 1].
    """

    def __init__(self, path: Path) -> None:
        self.path, self._file, self._owner, self._system = path, None, 0, ""
        with self._opened() as file:
            self.bands = [1, 2, 3] if file.count >= 3 else [1]
            kind = {*file.tags(ns=KIND), *file.tags(1, ns=KIND), file.colorinterp[0].name}
            self.plain = kind.isdisjoint({"NBITS", "MINISWHITE", "palette"})
            placed = file.crs is not None and not file.transform.is_identity
            system = _system_of_squares(path, file) if placed else ""
        if system:
            seen = f"{path} has a palette, or bits, and pixels that are no squares of metres"
            how = f"gdal_translate -expand rgb, then gdalwarp -t_srs {system}"
            expect(self.plain, f"colours, as by {how}", seen)
            self._file, self._system = None, system
        with self._opened() as file:
            self.shape, at = (len(self.bands), file.height, file.width), file.transform
            corner = (at.c, at.f), (at.a, at.d), (at.b, at.e)
            self.ground = Ground(*corner, "m", _name_of(file.crs)) if placed else None

    def __getstate__(self) -> Facts:
        return self.__dict__ | {"_file": None}

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """The file, opened in each process."""
        rasterio = import_module("rasterio")
        with reading(self.path, UNREAD, EXPECTED), rasterio.Env(GDAL_CACHEMAX=CACHE):
            try:
                if self._file is None or self._owner != os.getpid():
                    file = rasterio.open(self.path.absolute(), driver="GTiff")
                    self._file = _reprojected(file, self._system) if self._system else file
                    self._owner = os.getpid()
                yield self._file
            except rasterio.errors.RasterioIOError as error:
                raise (error.__cause__ or error) from None  # it says no more than that reading failed

    def __call__(self, top: int, bottom: int, left: int, right: int) -> Tensor:
        part = {"window": ((top, bottom), (left, right))}
        with self._opened() as file:
            seen = file.dataset_mask(**part) > 0
            return as_bytes(self.path, np.where(seen, file.read(self.bands, **part), 0))


def from_degrees(values: Tensor, system: str) -> Tensor:
    """Latitudes and longitudes (N,2) as x and y (N,2) in a coordinate system, float64; NaN stays.
    InputError outside it, or without rasterio."""
    expect(has_rasterio(), "pip install 'dejavu_torch[geo]'", f"degrees to be converted to {system}")
    known, found = ~values.isnan().any(1), torch.full_like(values, torch.nan)
    found[known] = torch.from_numpy(_converted(DEGREES, system, values[known].fliplr().numpy()))
    return found


def _converted(one: Any, other: Any, points: Points) -> Points:
    """Points (N,2) of one coordinate system in another; degrees as longitude and latitude."""
    try:
        x, y = import_module("rasterio.warp").transform(one, other, *points.T.tolist())
    except Exception as error:  # of types that rasterio keeps to itself
        seen = f"coordinates cannot be converted to {other}: {one_line(error)}"
        raise InputError(f"{seen}; expected ones that it covers") from error
    return np.column_stack([x, y])


def _name_of(crs: Any) -> str:
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else str(crs.to_wkt())


def _at(file: Any, pixels: Points) -> Points:
    """Coordinates of pixels (N,2), column and row, in the file's own system."""
    corner = file.transform
    steps = np.array([(corner.a, corner.d), (corner.b, corner.e)])
    placed: Points = pixels @ steps + np.array([corner.c, corner.f])
    return placed


def _system_of_squares(path: Path, file: Any) -> str:
    """The coordinate system in which the pixels of a file become squares of metres; "" if they are that."""
    parts = np.linspace(0, 1, 3)
    corners = np.stack(np.meshgrid(parts * file.width, parts * file.height), -1).reshape(-1, 1, 2)
    points = _at(file, (corners + np.array([(0, 0), (1, 0), (0, 1)])).reshape(-1, 2))  # and the next pixels
    longitude, latitude = _converted(file.crs, DEGREES, points[12:13])[0]
    zone = f"EPSG:{32601 + 100 * (latitude < 0) + int((longitude + 180) // 6) % 60}"
    on_ground = _converted(file.crs, zone, points)
    far = float(np.abs(on_ground[:, 0] - MIDDLE).max())
    part = f"a part of it, of at most {WIDEST / 1e3:g} km to each side, as by gdal_translate -projwin"
    expect(far <= WIDEST, part, f"{path} reaches {far / 1e3:.0f} km from the middle of its UTM zone")
    steps, seen = (one.reshape(9, 3, 2)[:, 1:] - one.reshape(9, 3, 2)[:, :1] for one in (points, on_ground))
    told = np.linalg.norm(steps, axis=2)
    metres = file.crs.is_projected and file.crs.linear_units_factor[1] == 1
    if not metres or not np.allclose(np.linalg.norm(seen, axis=2) / told, 1, 0, STRETCHED):
        return zone
    across, down = steps[4] / told[4][:, None]
    square = abs(told[4, 0] / told[4, 1] - 1) <= STRETCHED and abs(across @ down) <= STRETCHED
    return "" if square else _name_of(file.crs)


def _reprojected(file: Any, system: str) -> Any:
    """A file as it would be in a coordinate system, bilinear: north up, transparent beside it, in squares of
    the shorter side of the pixels in its middle."""
    rasterio, enums = import_module("rasterio"), import_module("rasterio.enums")
    pixels = np.array([file.width, file.height]) / 2 + np.array([(0, 0), (1, 0), (0, 1)])
    middle, *ends = _converted(file.crs, system, _at(file, pixels))
    side = float(np.hypot(*(np.array(ends) - middle).T).min())
    parts = np.linspace(0, 1, EDGES)
    every = np.stack(np.meshgrid(parts * file.width, parts * file.height), -1).reshape(-1, 2)
    seen = _converted(file.crs, system, _at(file, every))
    (left, bottom), (right, top) = seen.min(0), seen.max(0)
    width, height = np.ceil(np.array([right - left, top - bottom]) / side - ROUNDING).astype(int).tolist()
    place = rasterio.Affine(side, 0, left, 0, -side, top)
    told = {flag for flags in file.mask_flag_enums for flag in flags}
    options = {"crs": system, "transform": place, "width": width, "height": height}
    if told.isdisjoint({enums.MaskFlags.alpha, enums.MaskFlags.nodata}):
        options["add_alpha"] = True
    return import_module("rasterio.vrt").WarpedVRT(file, resampling=enums.Resampling.bilinear, **options)
