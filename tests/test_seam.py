"""Another kind of map behind the seam: one class, one mapper, one line of registration."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import refused
from torch import Tensor, nn

from dejavu_torch import HOG, best_match, evaluate, model_file
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.compare import compare
from dejavu_torch.evaluation.controls import leave_out_match, null_control
from dejavu_torch.maps.place_map import Mapper, PlaceMap, require
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMap, TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import read_place_map
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.types import FrequencyLayer


class StoredMap(PlaceMap):
    """All features, as they are."""

    kind = "stored"
    values: Tensor

    def __init__(self, values: Tensor | None = None, power: float = 1.0) -> None:
        super().__init__(*((0, 0) if values is None else values.shape))
        self.power = power
        self.register_buffer("values", torch.zeros(0, 0) if values is None else values)

    def scores(self, queries):
        return torch.cdist(queries, self.values, p=self.power)

    def settings(self):
        return {"power": self.power}

    def summary(self):
        return MapSummary(self.kind, self.places, self.places, 0, 0, (), {"values": self.values.nbytes}, {})

    def check(self):
        seen, expected = tuple(self.values.shape), (self.places, self.dimension)
        require(seen == expected, f"values {seen}; expected {expected}")
        super().check()


class StoredMapper(Mapper):
    """Keeps the features."""

    kind = StoredMap.kind

    def __init__(self, power: float = 1.0, every: int = 1) -> None:
        super().__init__()
        self.power, self.every = power, every

    def forward(self, features):
        return StoredMap(features[:: self.every].clone(), self.power)

    def empty(self):
        return StoredMap(power=self.power)


@pytest.fixture
def registered(monkeypatch):
    """The one line: the class in `CLASSES`."""
    monkeypatch.setattr(model_file, "REGISTRY", {**model_file.REGISTRY, "StoredMapper": StoredMapper})


def test_learn_localize_save_load(registered, tmp_path):
    values = torch.rand(40, 6)
    model = DejaVu(mapper=StoredMapper()).learn(values)
    assert model.localize(values + 0.01).index.tolist() == list(range(40))
    model.save(tmp_path / "m.safetensors")
    again = DejaVu.load(tmp_path / "m.safetensors")
    assert isinstance(again.mapper, StoredMapper)
    assert torch.equal(again(values), model(values))
    assert again.summary().map_bytes == (tmp_path / "m.safetensors").stat().st_size
    assert read_place_map(tmp_path / "m.safetensors").places == 40


def test_a_kind_that_is_not_registered_is_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(model_file, "REGISTRY", {**model_file.REGISTRY, "StoredMapper": StoredMapper})
        DejaVu(mapper=StoredMapper()).learn(torch.rand(9, 2)).save(tmp_path / "m.safetensors")
    with refused("'stored'", "templates"):
        DejaVu.load(tmp_path / "m.safetensors")


def test_compare_reports_any_kind():
    reference, query = (torch.rand(30, 4, generator=torch.Generator().manual_seed(0)) for _ in range(2))
    result = compare(
        ArrayTraverse(reference, "a"), ArrayTraverse(query + 0.01, "b"), "0", DejaVu(mapper=StoredMapper())
    )
    report = result.report.as_json()
    assert (report["kind"], report["recall_at_1"], report["templates"]) == ("stored", 1.0, 0)
    assert report["map_bytes"] == result.run.model.summary().map_bytes > report["route_bytes"] == 30 * 4 * 4
    assert {"uncompressed", "stride", "null"} <= report.keys()
    assert "null_same_plan" not in report
    assert {"pr", "coverage"} <= result.pictures.keys()


def test_what_is_of_templates_alone_is_refused_in_one_line():
    values = torch.rand(30, 4)
    model = DejaVu(mapper=StoredMapper()).learn(values)
    for use in (
        lambda: leave_out_match(model, values, 1),
        lambda: null_control(model, values, values, same_plan=True),
    ):
        with refused("a template map", "'stored'"):
            use()


def test_the_one_table_between_frames_and_places():
    """A camera that stands over frames 2 to 4: all of them are place 2."""
    route = TemplateMap((), (), 4, 2)
    route.positions = torch.tensor([0.0, 1.0, 2.0, 2.0, 2.0, 3.0])
    route.check()
    assert route.frame_of(torch.arange(-1, 4)).tolist() == [-1, 0, 1, 2, 5]
    assert route.place_of(torch.tensor([-1, 0, 2, 3, 4, 5])).tolist() == [-1, 0, 2, 2, 2, 3]
    assert route.table.borders.tolist() == [0, 1, 2, 5, 6]
    route.positions = torch.tensor([0.0, 1.0])
    with refused("positions of 2 places", "expected 4"):
        route.check()
    route, some = TemplateMap((), (), 5, 2), torch.tensor([[0, 4], [-1, 2]])  # not resampled
    assert torch.equal(route.frame_of(some), some)
    assert torch.equal(route.place_of(some), some)
    with refused("frame 5", "0 to 4"):
        route.place_of(torch.tensor([5]))


def test_a_mapper_that_does_not_fit_is_refused():
    with refused("StoredMapper made a map of 5 places", "(9, 2)"):
        DejaVu(mapper=StoredMapper(every=2)).learn(torch.rand(9, 2))
    with refused("Linear", "Mapper"):
        DejaVu(mapper=nn.Linear(2, 2))  # type: ignore[arg-type]
    with refused("Linear", "PeriodFinder"):
        TemplateMapper(nn.Linear(2, 2))  # type: ignore[arg-type]


class Foreign(PeriodFinder):
    """A finder that no map file can bring."""

    def plan(self, features):
        return (FrequencyLayer(10, 10, 0, len(features), tuple(range(features.shape[1]))),)


def test_a_loaded_map_says_that_its_period_finder_is_missing(tmp_path, caplog):
    values = torch.rand(60, 4)
    DejaVu(mapper=TemplateMapper(Foreign())).learn(values).save(tmp_path / "m.safetensors")
    model = DejaVu.load(tmp_path / "m.safetensors")
    with refused("period finder is not of this package", "learn anew"):
        model.learn(values)
    report = compare(ArrayTraverse(values, "a"), ArrayTraverse(values + 0.01, "b"), "0", model).report
    assert "null" not in report.contenders
    assert "null_same_plan" in report.contenders
    assert "outside this package" in caplog.text
    model.save(tmp_path / "again.safetensors")
    assert DejaVu.load(tmp_path / "again.safetensors").mapper.periods is None


@pytest.mark.parametrize(
    "use",
    [
        lambda: DejaVu().learn(7),
        lambda: compare("one/", "two/"),
        lambda: evaluate(torch.arange(3), torch.arange(3)[:, None], 0),
        lambda: best_match(np.zeros((2, 3))),
        lambda: HOG()(np.zeros((1, 1, 32, 32))),
        lambda: DejaVu().learn(torch.rand(64, 2))(np.zeros((3, 2))),
    ],
    ids=["learn", "compare", "evaluate", "best_match", "HOG", "forward"],
)
def test_what_is_no_tensor_or_traverse_is_refused_in_one_line(use):
    with refused("expected"):
        use()
