"""Map files of every kind of layout, as earlier versions wrote them: all that they know of their places."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from dejavu_torch import DejaVu

MAPS = Path(__file__).parents[1] / "golden" / "maps"
FACTS = json.loads((MAPS / "facts.json").read_text())


@pytest.mark.parametrize("name", FACTS)
def test_a_map_file_tells_what_it_told(name, tmp_path):
    model, facts = DejaVu.load(MAPS / f"{name}.safetensors"), FACTS[name]
    place_map, table = model.map, model.map.table
    every = torch.arange(facts["places"])
    queries = torch.randn(3, place_map.dimension, generator=torch.Generator().manual_seed(9))
    torch.testing.assert_close(place_map.scores(queries), torch.tensor(facts["scores"]), atol=1e-3, rtol=1e-3)
    assert (place_map.places, table.frames) == (facts["places"], facts["frames"])
    assert table.frame_of(every).tolist() == facts["frame_of"]
    assert table.borders.tolist() == facts["borders"]
    assert table.steps.tolist() == pytest.approx(facts["steps"], abs=1e-3)
    assert [*place_map.route_starts] == facts["starts"]
    assert [[*route] for route in place_map.routes] == facts["routes"]
    assert [[*link] for link in place_map.connections] == facts["connections"]
    if "route_of" in facts:
        assert table.route_of(every).tolist() == facts["route_of"]
        assert table.own_frame_of(every).tolist() == facts["own_frame_of"]
    if "tiles" in facts:
        area = place_map.area
        assert area.coordinates(every).tolist() == facts["coordinates"]
        assert area.cells(every).tolist() == facts["cells"]
        assert [[*tile] for tile in area.tiles] == facts["tiles"]
        assert [area.rows, area.columns] == facts["size"]
        assert area.north == facts["north"]
    # and it is written as it was, byte for byte
    model.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (MAPS / f"{name}.safetensors").read_bytes()
