"""A map as one file: what comes back, what is refused, and that no file runs code."""

from __future__ import annotations

import errno
import json
import pickle
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from helpers import Fixed, refused, template_model
from safetensors import safe_open
from torch import Tensor, nn

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.names import encode_names
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.file import FORMAT, NAME, write_map
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import read_place_map, recipe_of
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer, Training

WINDOW = SpectrogramAnalysis(window=64, strongest=1)


class Small(nn.Module):
    """A backbone that is not of the package."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(1, 3, 3), nn.BatchNorm2d(3), nn.AdaptiveAvgPool2d(1), nn.Flatten()
        )

    def forward(self, frames: Tensor) -> Tensor:
        return self.layers(frames)


class Other(Small):
    """Same weights, another class."""


class Tied(nn.Module):
    """Two layers that share one weight."""

    def __init__(self) -> None:
        super().__init__()
        self.encode = nn.Linear(8, 8)
        self.again = nn.Linear(8, 8)
        self.again.weight = self.encode.weight

    def forward(self, frames: Tensor) -> Tensor:
        return self.again(self.encode(frames.mean((1, 2))))


class Stateful(Fixed):
    """A period finder with a buffer of its own."""

    def __init__(self, *layers: FrequencyLayer) -> None:
        super().__init__(*layers)
        self.register_buffer("prior", torch.ones(3))


def waves(frames: int = 64) -> Tensor:
    """Two features that repeat, after 8 and after 9 frames."""
    return torch.arange(frames)[:, None] % torch.tensor([8.0, 9.0])


def pictures(frames: int = 64, size: int = 24) -> Tensor:
    """Frames that repeat after 8."""
    random = torch.Generator().manual_seed(0)
    return torch.rand(8, 1, size, size, generator=random)[torch.arange(frames) % 8]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "route.safetensors"


@pytest.fixture
def saved(path: Path) -> Path:
    template_model(periods=WINDOW).learn(waves()).save(path)
    return path


def mapper(**changes: Any) -> dict[str, Any]:
    """The recipe of the mapper of `saved`, with other arguments."""
    recipe = recipe_of(TemplateMapper(WINDOW))
    return {"class_path": recipe.class_path, "init_args": recipe.init_args | changes}


def backbone_bytes(model: DejaVu) -> int:
    return model.summary().fixed.get("backbone", 0)


def contents(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors of a map file, and what its one entry of metadata says."""
    with safe_open(path, framework="pt") as file:
        assert list(file.metadata()) == [NAME]
        return {name: file.get_tensor(name) for name in file.keys()}, json.loads(file.metadata()[NAME])  # noqa: SIM118


def craft(path: Path, tensors: dict[str, Any] | None = None, **header: Any) -> None:
    """Write a map file anew, sealed as it should be, with other tensors or entries of its header.

    A tensor is None to take it away, or a list of numbers; an entry may be a path such as "map.places".
    """
    own, sealed = contents(path)
    for name, value in (tensors or {}).items():
        listed = isinstance(value, list)
        own[name] = torch.tensor(value, dtype=own[name].dtype) if listed else value
    for names, value in header.items():
        *outer, last = names.split(".")
        place = sealed["header"]
        for name in outer:
            place = place[name]
        place[last] = value
    path.unlink()
    write_map(path, {name: one for name, one in own.items() if one is not None}, sealed["header"])


def with_metadata(path: Path, metadata: dict[str, str] | None) -> None:
    """Give a map file other metadata, and leave its tensors as they are."""
    tensors, _ = contents(path)
    path.unlink()
    safetensors.torch.save_file(tensors, path, metadata)


# what comes back


@pytest.mark.parametrize(("metric", "reduction"), [("l1", "mean"), ("l2", "sum"), ("cosine", "mean")])
def test_scores_are_equal_bit_for_bit(path: Path, metric: str, reduction: Any) -> None:
    model = template_model(periods=WINDOW, metric=metric, reduction=reduction, batch_size=7).learn(waves())
    model.save(path)
    again = DejaVu.load(path)
    query = waves() + 0.3 * torch.rand(64, 2)
    assert torch.equal(again(query), model(query))
    assert again.map.plan == model.map.plan
    assert (again.map.metric, again.map.reduction, again.batch_size) == (metric, reduction, 7)
    assert repr(again.summary()) == repr(model.summary())


def test_a_map_of_frames_comes_back_with_its_features_and_periods(path: Path) -> None:
    model = template_model(
        HOG(cell=4, resize=(16, 16)), SpectrogramAnalysis(window=64, peaks="bins", false_alarm=None)
    )
    model.learn(pictures()).save(path)
    again = DejaVu.load(path)
    query = pictures(20) + 0.1 * torch.rand(20, 1, 24, 24)
    assert torch.equal(again(query), model(query))
    assert torch.equal(again.learn(pictures()).map.templates, model.map.templates)
    assert again.map.plan == model.map.plan


def test_a_map_without_layers_comes_back(path: Path) -> None:
    template_model().learn(torch.ones(64, 3)).save(path)
    again = DejaVu.load(path)
    assert (again.map.plan, again.map.places, again.map.dimension) == ((), 64, 3)
    assert again.localize(torch.ones(2, 3)).index.tolist() == [-1, -1]


def test_a_fractional_period_survives(path: Path) -> None:
    """97.5 frames in 98 phases."""
    layer = FrequencyLayer(Fraction(195, 2), 98, 10, 300, (0, 3))
    model = template_model(periods=Fixed(layer)).learn(torch.rand(310, 5))
    model.save(path)
    again = DejaVu.load(path)
    assert again.map.plan == (layer,)
    query = torch.rand(20, 5)
    assert torch.equal(again(query), model(query))
    assert torch.equal(again.map.plan[0].place_phases, layer.place_phases)


@pytest.mark.parametrize("threshold", [0.0, 0.7])
def test_the_threshold_is_stored(path: Path, threshold: float | None) -> None:
    model = template_model(periods=WINDOW, threshold=threshold).learn(waves())
    model.save(path)
    again = DejaVu.load(path)
    assert again.threshold == threshold
    query = waves() + 2 * torch.rand(64, 2)
    assert torch.equal(again.localize(query).accepted, model.localize(query).accepted)


@pytest.mark.parametrize("shape", [(2,), (3, 64, 48), None])
def test_a_map_knows_what_it_was_learnt_from(path: Path, shape: tuple[int, ...] | None) -> None:
    traverse = None if shape is None else ArrayTraverse(torch.rand(2, *shape))
    template_model(periods=WINDOW).learn_features(waves(), traverse).save(path)
    assert DejaVu.load(path).frame_shape == shape


def test_features_of_other_settings_are_refused(path: Path) -> None:
    template_model(HOG(cell=4), periods=WINDOW).learn(torch.rand(64, 1, 16, 16)).save(path)
    assert DejaVu.load(path, HOG(cell=4)).map.places == 64
    with refused("cell", "learned with"):
        DejaVu.load(path, HOG(cell=8))


def test_float64_templates_stay_float64(path: Path) -> None:
    model = template_model(periods=WINDOW).learn(waves().double() / 3)
    model.save(path)
    assert torch.equal(DejaVu.load(path).map.templates, model.map.templates)
    assert model.map.templates.dtype == torch.float64


# the file


def test_one_file_of_the_size_the_map_claims(saved: Path) -> None:
    assert list(saved.parent.iterdir()) == [saved]
    model = DejaVu.load(saved)
    assert saved.stat().st_size == model.summary().map_bytes
    assert model.summary().bytes_per_place == model.summary().map_bytes / 64


@pytest.mark.parametrize("features", [HOG(), Small()])
def test_the_claimed_size_holds_with_any_features(path: Path, features: nn.Module) -> None:
    model = template_model(features, WINDOW).learn(pictures())
    model.save(path)
    assert path.stat().st_size == model.summary().map_bytes
    assert DejaVu.load(path, features).summary().map_bytes == model.summary().map_bytes


def test_metadata_names_version_checksums_and_header(saved: Path) -> None:
    tensors, sealed = contents(saved)
    assert sealed["version"] == FORMAT
    assert sealed["checksums"].keys() == {"header", "map"}
    assert tensors["map.layers"].tolist() == [[8, 1, 8, 0, 64], [9, 1, 9, 0, 64]]
    config = sealed["header"]
    assert config["features"]["class_path"] == "HOG"
    assert config["mapper"]["init_args"]["periods"]["init_args"]["window"] == 64
    assert (config["map"]["kind"], config["map"]["metric"], config["threshold"]) == ("templates", "l1", None)


def test_no_pickle_is_written_or_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = template_model(Small(), WINDOW).learn(pictures())

    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("pickle was used")

    for module, names in (
        (pickle, ("dump", "dumps", "load", "loads", "Pickler", "Unpickler")),
        (torch, ("load", "save")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, forbidden)
    model.save(path)
    DejaVu.load(path, Small())


def test_saving_over_an_old_map(saved: Path) -> None:
    template_model(periods=WINDOW).learn(waves(80)).save(saved)
    assert DejaVu.load(saved).map.places == 80


def test_a_full_disk_keeps_the_old_map(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, before = DejaVu.load(saved), saved.read_bytes()

    def half(_: object, path: Path, *__: object) -> None:
        path.write_bytes(before[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(safetensors.torch, "save_file", half)
    with refused(str(saved), "No space left on device"):
        model.save(saved)
    assert list(saved.parent.iterdir()) == [saved]
    assert saved.read_bytes() == before


def test_where_a_map_cannot_be_written(tmp_path: Path) -> None:
    model = template_model(periods=WINDOW).learn(waves())
    with refused("missing", "does not exist"):
        model.save(tmp_path / "missing" / "a.safetensors")
    with refused(str(tmp_path), "is a folder"):
        model.save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_saved(path: Path) -> None:
    with refused("no map yet", "learn"):
        DejaVu().save(path)
    assert not path.exists()


# files that are no whole map


def test_a_truncated_map_is_refused_at_any_length(saved: Path) -> None:
    whole = saved.read_bytes()
    for length in [0, 1, 7, 8, 9, *range(20, len(whole), 61), len(whole) - 1]:
        saved.write_bytes(whole[:length])
        with refused(str(saved), "truncated", "expected a whole one"):
            DejaVu.load(saved)


def of_version(path: Path, version: int) -> None:
    with_metadata(path, {NAME: json.dumps(contents(path)[1] | {"version": version})})


def written_anew(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def foreign(path: Path, metadata: dict[str, str] | None) -> None:
    safetensors.torch.save_file({"weight": torch.zeros(3)}, path, metadata)


OLD = {"format": NAME, "version": "3", "config": "{}"}  # before format 7


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda path: path.unlink(), ["not there"]),
        (lambda path: [path.unlink(), path.mkdir()], ["is a folder", "map file"]),
        (lambda path: written_anew(path, b"just text\n" * 50), ["no map file"]),
        (lambda path: written_anew(path, b"\x80\x04\x95"), ["no map file"]),
        (lambda path: written_anew(path, b"\x93NUMPY" * 30), ["no map file"]),
        (lambda path: written_anew(path, bytes(500)), ["no map file"]),
        (lambda path: torch.save({"state_dict": {}}, path), ["is a checkpoint", "dejavu train export"]),
        (lambda path: foreign(path, None), ["no map of dejavu_torch"]),
        (lambda path: foreign(path, {"format": "pt"}), ["no map of dejavu_torch"]),
        (lambda path: with_metadata(path, OLD), ["no map", "an old one", "learn the route anew"]),
        (lambda path: of_version(path, 5), ["format 5", f"reads {FORMAT}", "learn the route anew"]),
        (lambda path: of_version(path, FORMAT + 1), [f"format {FORMAT + 1}", f"reads {FORMAT}", "newer"]),
    ],
)
def test_what_is_no_map_is_refused(saved: Path, change: Any, words: list[str]) -> None:
    change(saved)
    with refused(str(saved), *words):
        DejaVu.load(saved)


SEALED = f'{{"version": {FORMAT}, "checksums": '


def test_damaged_metadata_is_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for text in (
        "",
        "{",
        "[]",
        "{}",
        "[" * 100_000,
        f'{{"version": {FORMAT}}}',
        SEALED + '{}, "header": []}',
        '{"version": "one", "header": {}}',
        '{"version": true, "header": {}}',
        SEALED + '{}, "header": {}}',
        SEALED + '3, "header": {"threshold": NaN}}',
        SEALED + '3, "header": {"threshold": 1e999}}',
        SEALED + '3, "header": {"threshold": ' + "1" * 5000 + "}}",
    ):
        saved.write_bytes(whole)
        with_metadata(saved, {NAME: text})
        with refused(str(saved)):
            DejaVu.load(saved)


LAYERS = [[8, 1, 8, 0, 64], [9, 1, 9, 0, 64]]
MAPPER = "mapper.init_args."
CRAFTED_TEMPLATES: list[tuple[dict[str, Any], dict[str, Any], list[str]]] = [
    *(
        ({}, header, [])
        for header in (
            {MAPPER + "metric": "l7"},
            {MAPPER + "metric": "l2"},
            {MAPPER + "reduction": "median"},
            {MAPPER + "temperature": 0.0},
            {MAPPER + "temperature": "warm"},
            {"mapper": {"class_path": "HOG", "init_args": {}}},
            {"mapper": 3},
            {MAPPER + "periods": {"class_path": "HOG", "init_args": {}}},
            {"map": {"kind": "templates"}},
            {"batch_size": 0},
            {"threshold": "low"},
            {"features": None},
            {"features": {}},
            {"features": {"class_path": 5, "init_args": {}}},
            {"features": {"class_path": "HOG", "init_args": {"cells": 8}}},
            {"features": {"class_path": "HOG", "init_args": {"cell": 0}}},
            {"features": {"class_path": "SIFT", "init_args": {}}},
            {"features": {"class_path": "dejavu_torch.features.hog.HOG", "init_args": {}}},
            {"velocity": {"class_path": "HOG", "init_args": {}}},
            {"velocity": 3},
            {"step": "far"},
            {"trained": 3},
            {"trained": {"steps": 3}},
        )
    ),
    ({}, {"map.kind": "holographic"}, ["holographic", "templates"]),
    ({}, {"step": 2.0}, ["step", "frame positions"]),
    ({}, {"step": 2.0, "velocity": recipe_of(GroundOdometry())._asdict()}, ["step", "frame positions"]),
    ({"map.positions": torch.arange(64.0)}, {}, ["step", "frame positions"]),
    ({"features.weight": torch.zeros(3)}, {}, ["features.weight"]),
    ({"map.layers": [[2**60, 1, 8, 0, 64], LAYERS[1]]}, {}, ["below 2^63"]),
    ({"map.layers": [[8, 1, 8, 0, 65], LAYERS[1]]}, {}, []),
    ({"map.layers": [[8, 1, 8, 64, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": [[8, 1, 8, -1, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": [[8, 1, 9, 0, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": [[8, 1, 0, 0, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": [[8, 0, 8, 0, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": [[-8, 1, 8, 0, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": [[-8, -1, 8, 0, 64], LAYERS[1]]}, {}, []),
    ({"map.layers": LAYERS[:1]}, {}, []),
    ({"map.layers": [8, 1, 8, 0, 64]}, {}, []),
    ({"map.layers": [[8, 1, 8, 0], [9, 1, 9, 0]]}, {}, []),
    ({"map.layers": torch.tensor(LAYERS).double()}, {}, []),
    *(
        ({"map.feature_ptr": value}, {}, [])
        for value in (
            [0, 2, 1],
            [1, 1, 2],
            [0, 1, 3],
            [0, 0, 2],
            [0, 2],
            torch.tensor([0.0, 1.0, 2.0]),
            torch.tensor(0),
        )
    ),
    *(
        ({"map.feature_index": value}, {}, [])
        for value in (
            [0, 2],
            [-1, 1],
            [0],
            [0, 1, 1],
            torch.tensor(0),
            torch.tensor([0, 1], dtype=torch.int8),
        )
    ),
    *(({"map.templates": value}, {}, []) for value in ([0.0] * 16, [0.0] * 18, [[0.0] * 17])),
    *(({"map.weights": value}, {}, []) for value in ([1.0], [1.0, float("nan")])),
    *(
        ({f"map.{name}": None}, {}, ["does not hold", name])
        for name in ("layers", "feature_ptr", "feature_index", "templates", "weights")
    ),
]


def test_crafted_template_maps_are_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for tensors, header, words in CRAFTED_TEMPLATES:
        saved.write_bytes(whole)
        craft(saved, tensors, **header)
        with refused(str(saved), *words):
            DejaVu.load(saved)


def test_layers_of_more_places_than_can_be_meant_are_refused(saved: Path) -> None:
    covered = 2**50
    layers = [[*layer[:4], covered] for layer in LAYERS]
    craft(saved, {"map.layers": layers}, **{"map.places": covered})
    for read in (DejaVu.load, read_place_map):
        with refused(f"a map of {covered} places, {2 * covered} in all layers", "expected at most"):
            read(saved)


def test_places_that_no_memory_holds_are_refused(saved: Path) -> None:
    """No tensor of a template map is as long as its route."""
    craft(saved, **{"map.places": 10**12})
    for read in (DejaVu.load, read_place_map):
        with refused("a map of 1000000000000 places", "at most"):
            read(saved)


# damage, and claims that no tensor of the file bears out


@pytest.fixture(scope="module")
def whole_maps(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A map of each kind, the spectral one with whitening, weights and names."""
    folder = tmp_path_factory.mktemp("maps")
    torch.manual_seed(0)
    template_model(periods=WINDOW).learn(waves()).save(folder / "templates.safetensors")
    spectral = DejaVu(SmallCNN(dimension=12, channels=1, resize=(16, 16), widths=(2,), squeeze=2))
    spectral.learn(torch.rand(64, 1, 24, 24))
    spectral.frame_names = [f"{i:03}.png" for i in range(64)]
    spectral.save(folder / "spectral.safetensors")
    return sorted(folder.iterdir())


def test_any_flipped_bit_is_noticed(whole_maps: list[Path], path: Path) -> None:
    for whole in whole_maps:
        content = whole.read_bytes()
        places = torch.randperm(8 * len(content), generator=torch.Generator().manual_seed(0))[:300].tolist()
        for bit in places:
            damaged = bytearray(content)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            for read in (DejaVu.load, read_place_map):
                with refused(str(path)):
                    read(path)


@pytest.mark.parametrize("part", ["header", "map", "features", "whitening"])
def test_damage_is_told_by_its_part(whole_maps: list[Path], path: Path, part: str) -> None:
    tensors, sealed = contents(whole_maps[0])
    if part == "header":
        sealed["header"]["batch_size"] += 1
    else:
        name = next(name for name, tensor in tensors.items() if name.startswith(part) and tensor.numel())
        tensors[name].view(-1).view(torch.uint8)[0] ^= 1
    safetensors.torch.save_file(tensors, path, {NAME: json.dumps(sealed)})
    with refused(f"{path} is damaged: its {part};", "as it was written"):
        DejaVu.load(path)


def test_a_checksum_that_is_missing_is_damage(saved: Path) -> None:
    sealed = contents(saved)[1]
    for sums in ({}, None, {**sealed["checksums"], "other": "0"}, {"map": sealed["checksums"]["map"]}):
        with_metadata(saved, {NAME: json.dumps(sealed | {"checksums": sums})})
        with refused("is damaged"):
            DejaVu.load(saved)


def test_the_same_model_gives_the_same_bytes(whole_maps: list[Path], path: Path) -> None:
    for whole in whole_maps:
        for _ in range(4):
            DejaVu.load(whole).save(path)
            assert path.read_bytes() == whole.read_bytes()


def spectral(path: Path, whole_maps: list[Path]) -> Path:
    path.write_bytes(whole_maps[0].read_bytes())
    return path


FEATURES, WHITENING = "features.init_args.", "whitening.init_args."
CRAFTED_LINES: list[tuple[dict[str, Any], dict[str, Any], list[str]]] = [
    *(
        ({}, header, [])
        for header in (
            {"batch_size": 2**62},
            {"batch_size": True},
            {"frame_shape": [1, 10**9, 10**9]},
            {"frame_shape": [1, -4, 4]},
            {"frame_shape": 64},
            {"trained": {"steps": 2**62, "seed": 0}},
            {"trained": {"steps": "many", "seed": 0}},
            {"names": "x" * 100},
            {"names": 7},
            {"surprise": 1},
            {FEATURES + "widths": [10**6]},
            {FEATURES + "widths": [2**62]},
            {FEATURES + "widths": "wide"},
            {FEATURES + "dimension": 10**9},
            {FEATURES + "squeeze": 10**9},
            {FEATURES + "resize": [10**9, 10**9]},
            {FEATURES + "resize": [16]},
            {WHITENING + "power": "nan"},
            {WHITENING + "bits": 4.0},
            {WHITENING + "strengths": {"gain": 2**62}},
            {MAPPER + "chunk": "all"},
            {MAPPER + "resolution": -1.0},
            {MAPPER + "route_bytes_per_place": [5]},
            {"map": [1]},
            {"map.places": 10**12},
            {"map.dimension": 10**12},
            {"map.kind": "templates"},
            {"map.metric": "l2"},
            {"map.temperature": 1.0},
        )
    ),
    ({}, {"names": encode_names([f"{i:05}.png" for i in range(10_000)])}, ["10000 frames; expected 64"]),
    ({"map.lengths": [10**12]}, {}, ["[1000000000000] places"]),
    ({"map.lengths": [-64]}, {}, ["[-64] places"]),
    ({"map.lengths": torch.tensor([64.0])}, {}, ["lengths (1,) torch.float32"]),
    ({"map.lengths": None}, {}, ["does not hold", "lengths"]),
    ({"map.streams": torch.zeros(2, 2, dtype=torch.uint8)}, {}, ["streams (2, 2)"]),
    ({"map.stream_table": [[-1, 0]]}, {}, ["the table claims [-1]"]),
    ({"map.stream_table": torch.zeros(0, 2, dtype=torch.int64)}, {}, ["(0, 2) for 1 chunks"]),
    ({"map.steps": torch.tensor([3e38])}, {}, ["not finite"]),
    ({"map.steps": torch.tensor([float("nan")])}, {}, ["finite numbers above 0"]),
]


def test_crafted_spectral_maps_are_refused(path: Path, whole_maps: list[Path]) -> None:
    for tensors, header, words in CRAFTED_LINES:
        craft(spectral(path, whole_maps), tensors, **header)
        for read in (DejaVu.load, read_place_map) if tensors else (DejaVu.load,):
            with refused(str(path), *words):
                read(path)


def test_a_map_of_large_frames_can_be_read(path: Path) -> None:
    """A frame of 24 million pixels, read one at a time, has more numbers than a batch of small ones."""
    model = template_model(HOG(resize=(16, 16)), WINDOW).learn(pictures())
    model.frame_shape = (3, 4000, 6000)
    model.save(path)
    assert DejaVu.load(path).frame_shape == (3, 4000, 6000)


def test_what_could_not_be_read_is_not_written(path: Path) -> None:
    model = template_model(periods=WINDOW).learn(waves())
    model.batch_size = 2**60
    with refused("batch_size", "2^53"):
        model.save(path)
    assert not path.exists()
    model.batch_size, model.threshold = 64, 1e30
    model.save(path)
    assert DejaVu.load(path).threshold == 1e30


def test_an_argument_newer_than_the_file_has_its_default(saved: Path) -> None:
    recipe = contents(saved)[1]["header"]["features"]
    older = {name: value for name, value in recipe["init_args"].items() if name != "bins"}
    craft(saved, features=recipe | {"init_args": older})
    assert DejaVu.load(saved).features.bins == "hard"


def test_a_header_nested_without_end_is_refused(path: Path, whole_maps: list[Path]) -> None:
    header = contents(spectral(path, whole_maps))[1]["header"]
    nested = header["features"]
    init_args = {"dimension": 4, "channels": 1, "resize": [8, 8], "grid": 1, "cell": 0, "hidden": 0}
    for _ in range(150):
        arguments = {"network": nested, **init_args, "noise": 1.0, "kept": 128}
        nested = {"class_path": "Embedding", "init_args": arguments}
    craft(path, features=nested)
    with refused(str(path), "151 parts; expected at most 16"):
        DejaVu.load(path)


class Masked(nn.Module):
    """Features with a buffer that is expanded, and infinite in part."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mask", torch.tensor([0.0, -torch.inf]).expand(4, 2))

    def forward(self, frames: Tensor) -> Tensor:
        return frames.flatten(1)[:, :32] + self.mask[:, 0].sum()


def test_buffers_of_a_network_may_be_expanded_and_infinite(path: Path) -> None:
    model = template_model(Masked(), WINDOW).learn(pictures())
    model.save(path)
    loaded = DejaVu.load(path, Masked())
    assert torch.equal(loaded.features.mask, model.features.mask)


def test_a_whitening_of_another_size_is_refused(path: Path, whole_maps: list[Path]) -> None:
    tensors, _ = contents(spectral(path, whole_maps))
    scale, offset = (tensors[f"whitening.{name}"] for name in ("scale", "offset"))
    craft(
        path,
        {
            "whitening.projection": torch.zeros(12, (len(scale) + 2) // 2, dtype=torch.uint8),
            "whitening.scale": torch.cat([scale, scale[:1]]),
            "whitening.offset": torch.cat([offset, offset[:1]]),
        },
    )
    with refused("whitening makes", f"the map's {len(scale)}"):
        DejaVu.load(path)


def test_a_position_far_off_is_refused(path: Path) -> None:
    model = template_model(periods=WINDOW, velocity=GroundOdometry()).learn_features(waves())
    model.map.positions, model.step = torch.arange(64.0), 1.0
    model.save(path)
    DejaVu.load(path)
    craft(path, {"map.positions": torch.tensor([*range(63), 2.0**50])})
    with refused(str(path), f"positions of {2**50 + 1} places; expected 64"):
        DejaVu.load(path)


# features from elsewhere


@pytest.fixture
def small_map(path: Path) -> tuple[Path, DejaVu]:
    torch.manual_seed(0)
    model = template_model(Small(), SpectrogramAnalysis(window=64, false_alarm=None)).learn(pictures())
    model.save(path)
    return path, model


def test_features_from_elsewhere_get_their_weights_from_the_file(small_map: tuple[Path, DejaVu]) -> None:
    path, model = small_map
    torch.manual_seed(1)
    features = Small()
    again = DejaVu.load(path, features)
    assert again.features is features
    for name, weight in model.features.state_dict().items():
        assert torch.equal(features.state_dict()[name], weight), name
    query = pictures(5)
    assert torch.equal(again.localize(query).score, model.localize(query).score)
    assert model.map.plan, "a test on a map without layers shows nothing"


def test_features_from_elsewhere_must_be_given(small_map: tuple[Path, DejaVu]) -> None:
    with refused("Small", "`features`"):
        DejaVu.load(small_map[0])


def test_other_features_are_refused(small_map: tuple[Path, DejaVu], tmp_path: Path) -> None:
    for wrong in (Other(), HOG(), nn.Flatten()):
        with refused(str(small_map[0]), "Small", type(wrong).__name__):
            DejaVu.load(small_map[0], wrong)
    template_model(periods=WINDOW).learn(pictures()).save(tmp_path / "hog.safetensors")
    with refused("HOG", "Small"):
        DejaVu.load(tmp_path / "hog.safetensors", Small())


def test_features_of_another_size_are_refused(small_map: tuple[Path, DejaVu]) -> None:
    wider = Small()
    wider.layers[0] = nn.Conv2d(1, 4, 3)
    with refused(str(small_map[0]), "does not fit"):
        DejaVu.load(small_map[0], wider)


def test_weights_are_counted(small_map: tuple[Path, DejaVu]) -> None:
    model = small_map[1]
    # convolution 3 x 9 + 3, batch norm 4 x 3 floats, and its int64 counter
    assert backbone_bytes(model) == 4 * (30 + 12) + 8
    assert backbone_bytes(template_model(HOG()).learn(pictures())) == 0
    without = template_model(HOG(), WINDOW)
    without.map = model.map
    assert model.summary().map_bytes > without.summary().map_bytes + backbone_bytes(model)


def test_tied_weights_can_be_saved(path: Path) -> None:
    model = template_model(Tied(), WINDOW).learn(pictures(size=8))
    model.save(path)
    query = pictures(5, 8)
    assert torch.equal(DejaVu.load(path, Tied()).localize(query).score, model.localize(query).score)


def test_a_map_made_with_a_period_finder_of_its_own_state_can_be_read(path: Path) -> None:
    template_model(periods=Stateful(FrequencyLayer(Fraction(8), 8, 0, 64, (0,)))).learn(waves()).save(path)
    DejaVu.load(path)


# an Embedding: features of this package around a network that may be from elsewhere


class Patch(nn.Module):
    """A network from elsewhere, of as many channels as it is told."""

    def __init__(self, channels: int = 2) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(1, channels, 3)

    def forward(self, frames: Tensor) -> Tensor:
        return self.convolution(frames)


class Moving(Patch):
    """A network that makes tensors as it runs."""

    def forward(self, frames: Tensor) -> Tensor:
        maps = super().forward(frames)
        return maps + torch.linspace(0, 1, maps.shape[-1])


class Sized(Small):
    """Features from elsewhere, with a `resize` of their own."""

    resize = 224


def embedding(network: nn.Module, **settings: Any) -> Embedding:
    return Embedding(network, **{"dimension": 5, "channels": 1, "resize": (8, 8)} | settings)


def learnt_with(features: nn.Module, path: Path) -> DejaVu:
    model = template_model(features, Fixed(FrequencyLayer(Fraction(8), 8, 0, 64, (0, 1, 2)))).learn(
        pictures()
    )
    model.save(path)
    return model


def test_recipes_of_nested_modules() -> None:
    own = embedding(SmallCNN(dimension=4, channels=1, widths=(2, 3)), grid=2)
    recipe = recipe_of(own)
    assert recipe.class_path == "Embedding"
    network = recipe.init_args.pop("network")
    network_of = {"layer": None, "mean": None, "std": None, "output": None}
    coder = network_of | {"hidden": 0, "noise": 1.0, "kept": 128}
    assert recipe.init_args == coder | {"dimension": 5, "channels": 1, "resize": [8, 8], "grid": 2, "cell": 0}
    assert network["class_path"] == "SmallCNN"
    assert (network["init_args"]["dimension"], network["init_args"]["widths"]) == (4, [2, 3])
    foreign = recipe_of(embedding(Patch())).init_args["network"]
    assert foreign == {"class_path": f"{__name__}.Patch", "init_args": {}}


@pytest.mark.parametrize(
    "make",
    [
        lambda: SmallCNN(dimension=4, channels=1, resize=(8, 8), widths=(2,), squeeze=2),
        lambda: embedding(SmallCNN(dimension=4, channels=1, resize=(8, 8), widths=(2,))),
        lambda: embedding(embedding(SmallCNN(dimension=4, channels=1, widths=(2, 3))), cell=4),
    ],
    ids=["SmallCNN", "Embedding", "Embedding of an Embedding"],
)
def test_learnt_features_of_this_package_load_by_themselves(path: Path, make: Any) -> None:
    torch.manual_seed(0)
    model = learnt_with(make(), path)
    query = pictures(5)
    for again in (DejaVu.load(path), DejaVu.load(path, make())):
        assert recipe_of(again.features) == recipe_of(model.features)
        assert torch.equal(again.localize(query).score, model.localize(query).score)
    assert backbone_bytes(model) > 0
    assert path.stat().st_size == model.summary().map_bytes


def test_an_embedding_of_a_network_from_elsewhere_must_be_given(path: Path) -> None:
    torch.manual_seed(0)
    model, query = learnt_with(embedding(Patch()), path), pictures(5)
    with refused(str(path), "Patch", "only the caller can load", "`features`"):
        DejaVu.load(path)
    torch.manual_seed(1)
    given = embedding(Patch())
    again = DejaVu.load(path, given)
    assert again.features is given
    assert torch.equal(given.network.convolution.weight, model.features.network.convolution.weight)
    assert torch.equal(again.localize(query).score, model.localize(query).score)


def test_a_network_that_is_given_may_do_as_it_likes(path: Path) -> None:
    learnt_with(embedding(Moving()), path)
    assert isinstance(DejaVu.load(path, Moving()).features.network, Moving)
    assert learnt_with(Sized(), path).map.places == 64


def test_of_an_embedding_the_network_alone_may_be_given(path: Path) -> None:
    torch.manual_seed(0)
    model, query = learnt_with(embedding(Patch()), path), pictures(5)
    torch.manual_seed(1)
    again = DejaVu.load(path, network := Patch())
    assert again.features.network is network
    assert not again.training
    assert torch.equal(again.localize(query).score, model.localize(query).score)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: embedding(Patch(), grid=2), ("Embedding of grid=1; got grid=2",)),
        (lambda: embedding(Small()), ("Patch", "Small")),
        (Small, ("Embedding; got", "Small")),
        (lambda: embedding(Patch(3)), ("does not fit",)),
    ],
)
def test_another_embedding_is_refused(path: Path, make: Any, words: tuple[str, ...]) -> None:
    learnt_with(embedding(Patch()), path)
    with refused(str(path), *words):
        DejaVu.load(path, make())


# what training leaves in the file


@pytest.fixture
def trained(path: Path) -> DejaVu:
    """As training leaves a model: templates, weights and temperature that no eq. 1 gives."""
    model = template_model(periods=WINDOW, temperature=0.07).learn(waves())
    model.map.trainable(weights=True, start=torch.tensor([0.5, -2.0]))
    with torch.no_grad():
        model.map.templates.add_(0.1)
    model.map.freeze()
    model.trained = Training(steps=12, seed=4)
    model.save(path)
    return model


def test_a_trained_map_comes_back(path: Path, trained: DejaVu) -> None:
    again, query = DejaVu.load(path), waves() + 0.3 * torch.rand(64, 2)
    assert torch.equal(again(query), trained(query))
    assert again.map.weights.tolist() == [0.5, 2.0]
    assert again.map.temperature == 0.07
    assert again.trained == Training(12, 4)
    assert isinstance(again.trained, Training)
    assert path.stat().st_size == trained.summary().map_bytes == again.summary().map_bytes
    assert torch.equal(read_place_map(path).weights, again.map.weights)


def test_the_header_tells_of_training(path: Path, trained: DejaVu, tmp_path: Path) -> None:
    config = contents(path)[1]["header"]
    assert config["trained"] == {"steps": 12, "seed": 4}
    assert config["map"]["temperature"] == 0.07
    trained.learn(waves())  # by eq. 1 again
    trained.save(tmp_path / "learnt.safetensors")
    again = DejaVu.load(tmp_path / "learnt.safetensors")
    assert (again.trained, len(again.map.weights)) == (None, 0)


@pytest.mark.parametrize("seed", [None, 0])
def test_training_of_any_seed_comes_back(path: Path, trained: DejaVu, seed: int | None) -> None:
    trained.trained = Training(0, seed)
    trained.save(path)
    assert DejaVu.load(path).trained == Training(0, seed)


# no file names code to import


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Importable modules that leave a mark when they are imported."""
    folder, mark = tmp_path / "importable", tmp_path / "mark"
    (folder / "dejavu_torch_extra").mkdir(parents=True)
    code = f"from pathlib import Path\nPath({str(mark)!r}).touch()\nfrom torch.nn import Flatten as Net\n"
    (folder / "trap_module.py").write_text(code)
    (folder / "dejavu_torch_extra" / "__init__.py").write_text(code)
    monkeypatch.syspath_prepend(folder)
    yield mark
    sys.modules.pop("trap_module", None)
    sys.modules.pop("dejavu_torch_extra", None)


def test_no_foreign_class_path_is_imported(saved: Path, trap: Path) -> None:
    whole = saved.read_bytes()
    for class_path in (
        "trap_module.Net",
        "dejavu_torch_extra.Net",
        "os.system",
        "builtins.exec",
        "Net",
        "",
        ".trap_module.Net",
        "dejavu_torch.types.torch.nn.Flatten",
        "dejavu_torch...trap_module.Net",
    ):
        foreign: dict[str, Any] = {"class_path": class_path, "init_args": {"command": "touch mark"}}
        nested = {"class_path": "Embedding", "init_args": {"network": foreign}}
        for features in (foreign, foreign | {"init_args": {}}, nested):
            saved.write_bytes(whole)
            craft(saved, features=features)
            with refused(class_path):
                DejaVu.load(saved)
            with refused("HOG"):
                DejaVu.load(saved, HOG())
    assert not trap.exists()
    assert not {"trap_module", "dejavu_torch_extra"} & sys.modules.keys()


def test_a_foreign_period_finder_is_not_imported_and_not_needed(saved: Path, trap: Path) -> None:
    expected = DejaVu.load(saved).localize(waves())
    craft(saved, mapper=mapper(periods={"class_path": "trap_module.Net", "init_args": {}}))
    assert torch.equal(DejaVu.load(saved).localize(waves()).index, expected.index)
    assert not trap.exists()
