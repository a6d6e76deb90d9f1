"""Samples that are kept in a file are those that are made; a file of anything else is refused and stays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import safetensors.torch
import torch
from helpers import refused
from safetensors import SafetensorError
from test_coarse import queries_of, smooth_model
from test_search import walk

from dejavu_torch import DejaVu, PlaceFilter, SequenceMatcher, SpectralMapper, TemplateMapper
from dejavu_torch.growth import append
from dejavu_torch.live.localizer import LiveLocalizer
from dejavu_torch.maps.file import read_map, write_map
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.recognition import coarse
from dejavu_torch.recognition.search import Search


@pytest.fixture(autouse=True)
def searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps of a few hundred places are searched as long ones are."""
    monkeypatch.setattr(coarse, "MIN_PLACES", 500)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "route.samples"


@pytest.fixture
def kept(file: Path) -> DejaVu:
    """A model whose samples are in the file."""
    model = smooth_model()
    model.search_file = file
    model.localize(queries_of()[:1])
    return model


def again(model: DejaVu, file: Path) -> DejaVu:
    """The model as another process opens it."""
    model.save(file.with_name("m.safetensors"))
    opened = DejaVu.load(file.with_name("m.safetensors"))
    opened.search_file = str(file)
    return opened


def made_anew(*_: object) -> None:
    pytest.fail("what is in the file was made")


@pytest.mark.parametrize("search", ["coarse", "exact"])
@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_answers_are_the_same_with_a_file(
    search: Search, transform: Transform, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, queries = smooth_model(transform=transform), queries_of()[:60]
    ways = [None, PlaceFilter(search_every=10)]
    expected = [model.localize(queries, sequence=way, search=search) for way in ways]
    model.search_file = file
    written = [model.localize(queries, sequence=way, search=search) for way in ways]
    before = file.read_bytes()
    opened = again(model, file)
    monkeypatch.setattr(SpectralMap, "samples", made_anew)
    monkeypatch.setattr(coarse.CoarseSearch, "_bounds", made_anew)
    read = [opened.localize(queries, sequence=way, search=search) for way in ways]
    for one, *others in zip(expected, written, read, strict=True):
        for other in others:
            assert torch.equal(one.index, other.index)
            assert torch.equal(one.score, other.score)
    assert file.read_bytes() == before
    assert {one.name for one in file.parent.iterdir()} == {file.name, "m.safetensors"}


def test_samples_of_another_map_or_plan_are_refused_and_stay(kept: DejaVu, file: Path) -> None:
    queries, before, other = queries_of()[:2], file.read_bytes(), smooth_model(seed=1)
    other.search_file = file
    with refused(str(file), "has samples of map ", "; expected map ", "remove it, or name another"):
        other.localize(queries)
    with refused("has samples of coarse spacing ", "; expected coarse spacing 1, fine spacing 1"):
        kept.localize(queries, search="exact")
    chosen = coarse.plan(kept.map)
    assert chosen is not None
    kept.search_memory = chosen.bytes - 1
    with refused("has samples of ", "; expected fine spacing "):
        kept.localize(queries)
    kept.search_memory = None
    kept.localize(queries)
    append(kept, walk(1000, 24, 5, 0.99))
    with refused("has samples of map "):
        kept.localize(queries)
    assert file.read_bytes() == before


def cut(file: Path, _: DejaVu) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def damage(file: Path, _: DejaVu) -> None:
    data = bytearray(file.read_bytes())
    data[-100] ^= 1
    file.write_bytes(data)


def text(file: Path, _: DejaVu) -> None:
    file.write_text("query,place\n0,1\n")


def a_map(file: Path, model: DejaVu) -> None:
    model.save(file)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (cut, "truncated"),
        (damage, "damaged: its fine"),
        (text, "not a map file"),
        (a_map, "a map or another file of this package"),
    ],
)
def test_what_is_no_whole_file_of_samples_is_refused_and_stays(
    change: Callable[[Path, DejaVu], None], reason: str, kept: DejaVu, file: Path
) -> None:
    change(file, kept)
    before = file.read_bytes()
    with refused(str(file), "is not a complete file of search samples: it is ", reason, "or no file there"):
        again(kept, file).localize(queries_of()[:1])
    assert file.read_bytes() == before


def test_samples_of_other_shapes_are_refused(kept: DejaVu, file: Path) -> None:
    tensors, header = read_map(file)
    rows = tensors["fine"].clone()
    for fine in (rows[:-1], rows.int(), rows[:, :-1]):
        write_map(file, tensors | {"fine": fine}, header)
        with refused(str(file), "samples are ", "; expected ("):
            again(kept, file).localize(queries_of()[:1])


@pytest.mark.parametrize(("search", "parts"), [("coarse", "coarse, fine"), ("exact", "bounds, fine")])
def test_a_file_without_some_of_its_samples_is_refused(search: Search, parts: str, file: Path) -> None:
    model = smooth_model()
    model.search_file = file
    model.localize(queries_of()[:1], search=search)
    tensors, header = read_map(file)
    for left in ({}, {"fine": tensors["fine"]}, tensors | {"more": tensors["fine"]}):
        write_map(file, left, header)
        with refused(f"{file}: samples are {', '.join(sorted(left)) or 'nothing'}; expected {parts}"):
            again(model, file).localize(queries_of()[:1], search=search)


@pytest.mark.parametrize("name", [5, b"route.samples"])
def test_what_is_no_path_is_refused(name: object) -> None:
    model = smooth_model()
    model.search_file = name  # type: ignore[assignment]
    with refused(f"search_file is {name!r}; expected the path of a file"):
        model.localize(queries_of()[:1])


def test_a_file_that_cannot_be_written_is_refused(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise SafetensorError("No space left on device")

    model = smooth_model()
    with monkeypatch.context() as patch:
        patch.setattr(safetensors.torch, "save_file", full)
        model.search_file = file
        with refused(str(file), "was not written: No space left"):
            model.localize(queries_of()[:1])
    assert not [*tmp_path.iterdir()]
    monkeypatch.setattr(SpectralMap, "samples", made_anew)  # refused before the work
    model.search_file = tmp_path / "nowhere" / "route.samples"
    with refused("does not exist"):
        model.localize(queries_of()[:1])


def test_where_no_samples_are_searched_a_file_is_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    queries = queries_of()[:3]
    short = DejaVu(whitening="none", mapper=SpectralMapper(None, 0.1, 256)).learn(walk(300, 24))
    templates = DejaVu(whitening="none", mapper=TemplateMapper()).learn(walk(300, 24))
    single = "; expected a filter with search_every above 1, or single queries"
    for model, way, words in (
        (short, {}, ("the map is scanned, ", "300 places, chunks: 2;", "at least 20000")),
        (smooth_model(metric="l2"), {}, ("metric l2", "; expected cosine")),
        (templates, {}, ("the map is a TemplateMap", "; expected a SpectralMap")),
        (smooth_model(), {"search": "scan"}, ("search scan", "; expected search auto, coarse or exact")),
        (smooth_model(), {"sequence": SequenceMatcher(3)}, ("a sequence scores all places", single)),
        (smooth_model(), {"sequence": PlaceFilter()}, ("a filter scores all places", single)),
    ):
        model.search_file = file
        with refused(f"search_file {file}: ", *words):
            model.localize(queries, **way)  # type: ignore[arg-type]
    with refused("scores of all places are kept", "; expected none kept (no --page)"):
        LiveLocalizer(model, None)
    with monkeypatch.context() as patch, refused("places are found elsewhere", "only one of the two"):
        patch.setattr(model, "find", lambda *_: pytest.fail("searched"))
        model.localize(queries)
    assert LiveLocalizer(model, None, keep_scores=False)(queries[0]).place >= 0
    assert file.exists()
