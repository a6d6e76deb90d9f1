"""Maps that grow: places appended behind those that there are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.data.arrays import as_traverse
from dejavu_torch.data.names import names_of
from dejavu_torch.data.positions import NEAR
from dejavu_torch.database.mapfile import digests
from dejavu_torch.database.spectral import CodedChunk, SpectralMap
from dejavu_torch.features.extract import feature_batches
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.streaming.coder import Made, code_here
from dejavu_torch.streaming.work import WorkFolder, all_chunks
from dejavu_torch.types import InputError, Traverse

MOST = 2**31 - 1  # places of a map, whose lines are numbered in 32 bits
EXACT = 2**24  # places whose positions float32 tells apart


@torch.no_grad()
def append(
    model: DejaVu,
    traverse: Traverse | Tensor,
    progress: bool = False,
    work: Path | None = None,
    make: Callable[..., Made] = code_here,
) -> DejaVu:
    """Add the places of a traverse behind those of a model's map, which stay as they are.

    Whitening, mean and step of the lines stay; the new places are coded in chunks of their own. Nothing is
    forgotten but the calibration, which is of fewer places: see `DejaVu.calibrate` and its `start`.

    Args:
        model: its map is spectral, learned with a `chunk` of so many places.
        traverse: as of `DejaVu.learn`, of frames like the map's. Where the map's places are even steps along
            the ground it is resampled likewise, and its first frame is the next place.
        progress: show a progress bar on a terminal.
        work, make: as of `DejaVu.learn`.

    Returns:
        The model. What is refused leaves it as it was.

    Convention: where the map's places are a multiple of `chunk`, its file is, byte for byte, that of all
        places learned at once with this whitening, mean and step. Else its last chunk stays short. One chunk
        of descriptors is in memory at a time.

    Raises:
        InputError: a map that cannot grow, or a traverse that does not fit it.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> wave = torch.sin(torch.arange(600.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> model = DejaVu(mapper=SpectralMapper(chunk=200)).learn(wave[:400])
        >>> append(model, wave[400:]).localize(wave[[50, 450]]).index
        tensor([ 50, 450])
    """
    route = growing(model)
    added = model.resample(as_traverse(traverse), model.step, progress)
    _check_alike(model, added)
    before = route.coded()
    places = added.count()
    frames = len(added.positions) if isinstance(added, ResampledTraverse) else places
    _check_count(route.places + places, model.step is not None)
    coder = model.chunk_coder(places, route, route.mean, before[-1].step)
    folder = None
    if work is not None:
        sums = [part.stream.checksum for part in before]
        folder = WorkFolder(work, model.run_key(added, places) | digests(map=sums))
    chunks = all_chunks(coder, added, folder, make, "learning" if progress else None)
    grown = with_chunks(route, [*before, *chunks])
    if isinstance(added, ResampledTraverse):
        behind = positions_behind(added.positions, route.places).to(route.positions.device)
        grown.positions = torch.cat([route.positions, behind])
        grown.check()
    names = joined_names(
        [model.frame_names, names_of(source_of(added), frames)],
        [len(route.positions) or route.places, frames],
    )
    model.map, model.frame_names, model.calibration = grown, names, None
    return model


def growing(model: DejaVu) -> SpectralMap:
    """The map of a model, which can grow.

    Raises:
        InputError: no map, one of another kind, or one whose chunk is the route.
    """
    route = model.map
    if not route.places:
        raise InputError("there is no map to append to; expected learn(...) or load(...) first")
    if not isinstance(route, SpectralMap):
        seen = f"a map of kind {route.kind!r} cannot be appended to"
        raise InputError(f"{seen}; expected one of kind {SpectralMap.kind!r}, or to learn the route anew")
    if route.chunk == "route":
        seen = "the map's chunk is the whole route, which cannot be appended to"
        raise InputError(
            f"{seen}; expected a map learned with a chunk of so many places: --mapper.chunk 1024"
        )
    return route


def with_chunks(route: SpectralMap, chunks: list[CodedChunk]) -> SpectralMap:
    """A map of these chunks, with the mean and settings of another."""
    made = SpectralMap.of_chunks(chunks, route.mean, **route.settings())
    return made.to(route.positions.device).train(route.training)


def positions_behind(positions: Tensor, places: int) -> Tensor:
    """Positions (F,) of frames whose first place is behind so many others, float32.

    Convention: frames behind their own first place are moved to it: there are other places behind it now.
    """
    double = positions.double().clamp(min=0)
    moved = (double + places).float()
    # at many places float32 would round some up to the next place
    reached = (double + NEAR).floor() + places
    below = torch.nextafter((reached + 1 - NEAR).float(), torch.zeros_like(moved))
    return torch.where((moved.double() + NEAR).floor() > reached, below, moved)


def joined_names(parts: list[list[str]], frames: list[int]) -> list[str]:
    """Names of the frames of several parts, one behind the other; "" where a part has none."""
    if not any(parts):
        return []
    return [name for part, count in zip(parts, frames, strict=True) for name in part or [""] * count]


def _check_count(places: int, resampled: bool) -> None:
    most = EXACT if resampled else MOST
    if places > most:
        steps = " at even steps" if resampled else ""
        raise InputError(f"{places} places{steps} in one map; expected at most {most}: several maps")


def _check_alike(model: DejaVu, added: Traverse) -> None:
    """Refuse frames that are not like those that the map was learned from."""
    shape, own = added.frame_shape, model.frame_shape
    if model.step is not None and not isinstance(added, ResampledTraverse):
        seen = (
            f"{added.name} has ready features or a single frame, whose steps along the ground nothing tells"
        )
        raise InputError(f"{seen}; expected frames, as the map's places are at even steps")
    own = shape if own is None else own  # of a map that was learned from descriptors
    if len(own) != len(shape):
        kinds = {1: "ready features", 3: "frames"}
        seen = f"{added.name} holds {kinds[len(shape)]}, the map was learned from {kinds[len(own)]}"
        raise InputError(f"{seen}; expected the same")
    resized = getattr(model.features, "resize", None) is not None
    one_channel = model.preprocess.channel is not None
    frames = len(shape) == 3
    if frames and ((shape[0] != own[0] and not one_channel) or (shape[1:] != own[1:] and not resized)):
        seen, known = (" x ".join(map(str, one)) for one in (shape, own))
        raise InputError(f"{added.name} has frames of {seen}; expected {known}, as the map was learned from")
    numbers = next(feature_batches(added, model.pipeline, 1, model.map.positions.device)).shape[1]
    expected = model.map.dimension
    if model.whitening is not None and model.whitening.learned:
        expected = len(model.whitening.projection)
    if numbers != expected:
        seen = f"{added.name} gives {numbers} features a frame"
        raise InputError(f"{seen}; expected {expected}, as the map was learned from")
