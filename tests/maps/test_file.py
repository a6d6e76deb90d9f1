"""A map as one file: what comes back, what is refused, and that no file runs code."""

from __future__ import annotations

import json
import pickle
import sys
from fractions import Fraction
from unittest.mock import Mock

import pytest
import safetensors.torch
import torch
from helpers import Fixed, refused, template_model
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from torch import nn

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.names import encode_names
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.maps.file import FORMAT, NAME, map_size, write_map
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import read_place_map, recipe_of
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer, Training

TYPES = (
    torch.bool,
    torch.uint8,
    torch.int32,
    torch.int64,
    torch.float16,
    torch.bfloat16,
    torch.float32,
    torch.float64,
)
WINDOW = SpectrogramAnalysis(window=64, strongest=1)


class Small(nn.Module):
    """A backbone that is not of the package."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(1, 3, 3), nn.BatchNorm2d(3), nn.AdaptiveAvgPool2d(1), nn.Flatten()
        )

    def forward(self, frames):
        return self.layers(frames)


def waves(frames=64):
    """Two features that repeat, after 8 and after 9 frames."""
    return torch.arange(frames)[:, None] % torch.tensor([8.0, 9.0])


def pictures(frames=64, size=24):
    """Frames that repeat after 8."""
    random = torch.Generator().manual_seed(0)
    return torch.rand(8, 1, size, size, generator=random)[torch.arange(frames) % 8]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "route.safetensors"


@pytest.fixture
def saved(path):
    template_model(periods=WINDOW).learn(waves()).save(path)
    return path


def contents(path):
    """Tensors of a map file, and what its one entry of metadata says."""
    with safe_open(path, framework="pt") as file:
        assert list(file.metadata()) == [NAME]
        return {name: file.get_tensor(name) for name in file.keys()}, json.loads(file.metadata()[NAME])  # noqa: SIM118


def craft(path, tensors=None, **header):
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


def with_metadata(path, metadata):
    """Give a map file other metadata, and leave its tensors as they are."""
    tensors, _ = contents(path)
    path.unlink()
    safetensors.torch.save_file(tensors, path, metadata)


# what comes back


@pytest.mark.parametrize(("metric", "reduction"), [("l1", "mean"), ("l2", "sum"), ("cosine", "mean")])
def test_scores_are_equal_bit_for_bit(path, metric, reduction):
    settings = {"metric": metric, "reduction": reduction, "batch_size": 7, "threshold": 0.0}
    traverse = ArrayTraverse(torch.rand(2, 3, 4000, 6))
    model = template_model(periods=WINDOW, **settings).learn_features(waves().double() / 3, traverse)
    model.save(path)
    again = DejaVu.load(path)
    query = waves() + 0.3 * torch.rand(64, 2)
    assert torch.equal(again(query), model(query))
    assert again.map.plan == model.map.plan
    assert {name: getattr(again, name, getattr(again.map, name, None)) for name in settings} == settings
    assert (again.frame_shape, again.map.templates.dtype) == ((3, 4000, 6), torch.float64)
    assert repr(again.summary()) == repr(model.summary())
    template_model(periods=WINDOW).learn(waves(80)).save(path)  # over the old one
    assert (DejaVu.load(path).map.places, DejaVu.load(path).frame_shape) == (80, (2,))


def test_a_map_of_frames_comes_back_with_its_features_and_periods(path):
    finder = SpectrogramAnalysis(window=64, peaks="bins", false_alarm=None)
    model = template_model(HOG(cell=4, resize=(16, 16)), finder).learn(pictures())
    model.save(path)
    again, query = DejaVu.load(path), pictures(20) + 0.1 * torch.rand(20, 1, 24, 24)
    assert torch.equal(again(query), model(query))
    assert torch.equal(again.learn(pictures()).map.templates, model.map.templates)


# the file


@given(
    st.dictionaries(
        st.text(max_size=4).map("part.{}".format),
        st.tuples(st.sampled_from([*TYPES]), st.lists(st.integers(0, 12), max_size=3)),
        max_size=9,
    ),
    st.dictionaries(
        st.text(max_size=5), st.text(max_size=9) | st.floats(allow_nan=False, allow_infinity=False)
    ),
)
def test_the_size_of_a_file_is_known_from_types_and_shapes(tmp_path_factory, kinds, header):
    path = tmp_path_factory.getbasetemp() / "any.safetensors"
    tensors = {name: torch.zeros(shape, dtype=dtype) for name, (dtype, shape) in kinds.items()}
    write_map(path, tensors, header)
    assert map_size(tensors, header) == path.stat().st_size


def test_one_file_of_the_size_the_map_claims(saved):
    assert list(saved.parent.iterdir()) == [saved]
    model = DejaVu.load(saved)
    assert saved.stat().st_size == model.summary().map_bytes
    assert model.summary().bytes_per_place == model.summary().map_bytes / 64


def test_no_pickle_is_written_or_read(path, monkeypatch):
    model = template_model(Small(), WINDOW).learn(pictures())
    for name in ("dump", "dumps", "load", "loads", "Pickler", "Unpickler"):
        monkeypatch.delattr(pickle, name)
    for name in ("load", "save"):
        monkeypatch.delattr(torch, name)
    model.save(path)
    DejaVu.load(path, Small())


def test_where_a_map_cannot_be_written(tmp_path):
    model = template_model(periods=WINDOW).learn(waves())
    for one, where, words in (
        (model, "missing/a.safetensors", ["missing", "does not exist"]),
        (model, "", [str(tmp_path), "is a folder"]),
        (DejaVu(), "a.safetensors", ["no map yet", "learn"]),
    ):
        with refused(*words):
            one.save(tmp_path / where)
    assert list(tmp_path.iterdir()) == []


# files that are no whole map


def test_a_truncated_map_is_refused_at_any_length(saved):
    whole = saved.read_bytes()
    for length in [0, 1, 7, 8, 9, *range(20, len(whole), 211), len(whole) - 1]:
        saved.write_bytes(whole[:length])
        with refused(str(saved), "truncated", "expected a whole one"):
            DejaVu.load(saved)


TEXTS = ("", "[]", '{"version": true, "header": {}}', f'{{"version": {FORMAT}, "header": []}}')


def with_sealed(path, **changes):
    """Give a map file another version, other checksums or another header."""
    with_metadata(path, {NAME: json.dumps(contents(path)[1] | changes)})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda path: path.unlink(), ["not there"]),
        (lambda path: [path.unlink(), path.mkdir()], ["is a folder", "map file"]),
        (lambda path: path.write_bytes(bytes(500)), ["not a map file"]),
        (lambda path: torch.save({"state_dict": {}}, path), ["is a checkpoint", "dejavu train export"]),
        (lambda path: with_metadata(path, None), ["not a map of dejavu_torch"]),
        (lambda path: with_sealed(path, version=5), ["format 5", f"expected {FORMAT}"]),
        (lambda path: with_sealed(path, version=FORMAT + 1), [f"format {FORMAT + 1}", f"expected {FORMAT}"]),
        *(
            (lambda path, sums=sums: with_sealed(path, checksums=sums), ["is damaged"])
            for sums in ({}, {"map": "0"})
        ),
        *((lambda path, text=text: with_metadata(path, {NAME: text}), []) for text in TEXTS),
    ],
)
def test_what_is_no_map_is_refused(saved, change, words):
    change(saved)
    with refused(str(saved), *words):
        DejaVu.load(saved)


MAPPER, FEATURES, WHITENING = "mapper.init_args.", "features.init_args.", "whitening.init_args."
LINES = [
    ({}, {FEATURES + "widths": [10**9]}, "size mismatch for convolutions"),
    ({}, {FEATURES + "resize": [10**9, 10**9]}, "SmallCNN got resize"),
    ({}, {"map.dimension": 10**12}, "means (0, 12)"),
    ({}, {"names": encode_names([f"{i:05}.png" for i in range(10_000)])}, "10000 frames; expected 64"),
    ({"map.lengths": [10**12]}, {}, "[1000000000000] places"),
    ({"map.stream_table": [[10**12, 0]]}, {}, "the table claims [1000000000000]"),
]
TEMPLATES = [
    ({"map.positions": torch.tensor([*range(63), 2.0**50])}, {}, "expected 64"),
    ({}, {"map.places": 10**12}, "a map of 1000000000000 places"),
    (
        {"map.layers": [[8, 1, 8, 0, 2**50], [9, 1, 9, 0, 2**50]]},
        {"map.places": 2**50},
        f"a map of {2**50} places, {2**51} in all layers",
    ),
]


@pytest.mark.parametrize(("kind", "claims"), [(0, LINES), (1, TEMPLATES)])
def test_no_size_in_a_file_is_believed(path, whole_maps, kind, claims):
    for tensors, header, words in claims:
        path.write_bytes(whole_maps[kind].read_bytes())
        craft(path, tensors, **header)
        with refused(str(path), words):
            DejaVu.load(path)


def test_a_lack_of_memory_is_no_fault_of_the_file(saved, monkeypatch):
    monkeypatch.setattr("dejavu_torch.model_file.build", Mock(side_effect=MemoryError))
    with pytest.raises(MemoryError):
        DejaVu.load(saved)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"map.kind": "holographic"}, ["holographic", "this version knows templates"]),
        ({FEATURES + "cells": 8}, ["does not fit", "'cells'"]),
        ({MAPPER + "metric": "l7"}, ["metric is 'l7'", "'cosine'"]),
    ],
)
def test_what_only_another_version_knows_is_refused(saved, header, words):
    craft(saved, **header)
    with refused(str(saved), *words):
        DejaVu.load(saved)


def test_a_map_of_arguments_that_are_gone_scores_alike(path):
    features, frames = Joined([PatchPixels((8, 12)), PatchPixels((12, 8))]), pictures()
    model = DejaVu(features, mapper=SpectralMapper(step=0.1)).learn(frames)
    model.save(path)
    gone = {WHITENING + "most_views": 500, WHITENING + "power": 1.0, WHITENING + "group_numbers": None}
    craft(path, None, **gone, **{FEATURES + "shares": [1, 0.5]})  # only learning took these
    for module in (None, features):
        assert torch.equal(DejaVu.load(path, features=module)(frames), model(frames))
    craft(path, None, **{WHITENING + "power": 0.5})
    with refused(str(path), "Whitening", "'power'"):
        DejaVu.load(path)


def test_what_a_file_lacks_or_cannot_be_imported_has_its_default(saved, trap):
    expected, header = DejaVu.load(saved).localize(waves()), contents(saved)[1]["header"]
    del header["features"]["init_args"]["bins"]
    craft(saved, features=header["features"])
    craft(saved, **{MAPPER + "periods": {"class_path": "trap_module.Net", "init_args": {}}})
    again = DejaVu.load(saved)
    assert again.features.bins == "hard"
    assert torch.equal(again.localize(waves()).index, expected.index)
    assert not trap.exists()


# damage


@pytest.fixture(scope="module")
def whole_maps(tmp_path_factory):
    """A map of each kind, the spectral one with whitening, weights and names."""
    folder = tmp_path_factory.mktemp("maps")
    torch.manual_seed(0)
    template_model(periods=WINDOW).learn(waves()).save(folder / "templates.safetensors")
    spectral = DejaVu(SmallCNN(dimension=12, channels=1, resize=(16, 16), widths=(2,), squeeze=2))
    spectral.learn(torch.rand(64, 1, 24, 24))
    spectral.frame_names = [f"{i:03}.png" for i in range(64)]
    spectral.save(folder / "spectral.safetensors")
    return sorted(folder.iterdir())


def test_any_flipped_bit_is_noticed(whole_maps, path):
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
def test_damage_is_told_by_its_part(whole_maps, path, part):
    tensors, sealed = contents(whole_maps[0])
    if part == "header":
        sealed["header"]["batch_size"] += 1
    else:
        name = next(name for name, tensor in tensors.items() if name.startswith(part) and tensor.numel())
        tensors[name].view(-1).view(torch.uint8)[0] ^= 1
    safetensors.torch.save_file(tensors, path, {NAME: json.dumps(sealed)})
    with refused(f"{path} is damaged: its {part};", "as it was written"):
        DejaVu.load(path)


def test_the_same_model_gives_the_same_bytes(whole_maps, path):
    for whole in whole_maps:
        for _ in range(4):
            DejaVu.load(whole).save(path)
            assert path.read_bytes() == whole.read_bytes()


# features from elsewhere


def test_features_from_elsewhere_get_their_weights_from_the_file(path):
    torch.manual_seed(0)
    model = template_model(Small(), SpectrogramAnalysis(window=64, false_alarm=None)).learn(pictures())
    model.save(path)
    torch.manual_seed(1)
    features = Small()
    again = DejaVu.load(path, features)
    assert again.features is features
    for name, weight in model.features.state_dict().items():
        assert torch.equal(features.state_dict()[name], weight), name
    assert torch.equal(again.localize(pictures(5)).score, model.localize(pictures(5)).score)
    assert model.map.plan, "a test on a map without layers shows nothing"
    # convolution 3 x 9 + 3, batch norm 4 x 3 floats, and its int64 counter
    assert model.summary().fixed["backbone"] == 4 * (30 + 12) + 8
    assert path.stat().st_size == model.summary().map_bytes


# an Embedding: features of this package around a network that may be from elsewhere


class Patch(nn.Module):
    """A network from elsewhere, of as many channels as it is told."""

    def __init__(self, channels: int = 2) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(1, channels, 3)

    def forward(self, frames):
        return self.convolution(frames)


def embedding(network, **settings):
    return Embedding(network, **{"dimension": 5, "channels": 1, "resize": (8, 8)} | settings)


def learnt_with(features, path):
    finder = Fixed(FrequencyLayer(Fraction(8), 8, 0, 64, (0, 1, 2)))
    model = template_model(features, finder).learn(pictures())
    model.save(path)
    return model


@pytest.mark.parametrize(
    "make",
    [
        lambda: SmallCNN(dimension=4, channels=1, resize=(8, 8), widths=(2,), squeeze=2),
        lambda: embedding(embedding(SmallCNN(dimension=4, channels=1, widths=(2, 3))), cell=4),
    ],
    ids=["SmallCNN", "Embedding of an Embedding"],
)
def test_learnt_features_of_this_package_load_by_themselves(path, make):
    torch.manual_seed(0)
    model = learnt_with(make(), path)
    query = pictures(5)
    for again in (DejaVu.load(path), DejaVu.load(path, make())):
        assert recipe_of(again.features) == recipe_of(model.features)
        assert torch.equal(again.localize(query).score, model.localize(query).score)
    assert path.stat().st_size == model.summary().map_bytes


def test_an_embedding_of_a_network_from_elsewhere_must_be_given(path):
    torch.manual_seed(0)
    model, query = learnt_with(embedding(Patch()), path), pictures(5)
    with refused(str(path), "Patch", "only the caller can load", "`features`"):
        DejaVu.load(path)
    torch.manual_seed(1)
    for own in (embedding(Patch()), Patch()):  # or its network alone
        again = DejaVu.load(path, own)
        assert own in (again.features, again.features.network)
        assert torch.equal(again.localize(query).score, model.localize(query).score)
        assert not again.training


@pytest.mark.parametrize(
    ("own", "given", "words"),
    [
        (Small, HOG, ("Small", "HOG")),
        (HOG, Small, ("HOG", "Small")),
        (HOG, lambda: HOG(cell=4), ("cell", "learned with")),
        (
            lambda: embedding(Patch()),
            lambda: embedding(Patch(), grid=2),
            ("Embedding with grid=1; got grid=2",),
        ),
        (lambda: embedding(Patch()), lambda: embedding(Small()), ("Patch", "Small")),
        (lambda: embedding(Patch()), Small, ("Embedding; got", "Small")),
        (lambda: embedding(Patch()), lambda: embedding(Patch(3)), ("does not fit",)),
    ],
)
def test_other_features_are_refused(path, own, given, words):
    learnt_with(own(), path)
    with refused(str(path), *words):
        DejaVu.load(path, given())


# what training leaves in the file


def test_a_trained_map_comes_back(path):
    """Templates, weights and temperature that no eq. 1 gives."""
    model = template_model(periods=WINDOW, temperature=0.07).learn(waves())
    model.map.trainable(weights=True, start=torch.tensor([0.5, -2.0]))
    with torch.no_grad():
        model.map.templates.add_(0.1)
    model.map.freeze()
    for made in (Training(0, None), Training(12, 4)):
        model.trained = made
        model.save(path)
        assert DejaVu.load(path).trained == made
    again, query = DejaVu.load(path), waves() + 0.3 * torch.rand(64, 2)
    assert torch.equal(again(query), model(query))
    assert (again.map.weights.tolist(), again.map.temperature) == ([0.5, 2.0], 0.07)
    assert path.stat().st_size == model.summary().map_bytes == again.summary().map_bytes
    assert torch.equal(read_place_map(path).weights, again.map.weights)
    model.learn(waves()).save(path)  # by eq. 1 again
    again = DejaVu.load(path)
    assert (again.trained, len(again.map.weights)) == (None, 0)


# no file names code to import


@pytest.fixture
def trap(tmp_path, monkeypatch):
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


def test_no_foreign_class_path_is_imported(saved, trap):
    whole = saved.read_bytes()
    paths = ["trap_module.Net", "dejavu_torch_extra.Net", "os.system", "builtins.exec", "Net", ""]
    paths += [".trap_module.Net", "dejavu_torch.types.torch.nn.Flatten", "dejavu_torch...trap_module.Net"]
    for class_path in paths:
        foreign = {"class_path": class_path, "init_args": {"command": "touch mark"}}
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
