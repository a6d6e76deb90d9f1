"""A map that grows by every drive: what changes refines it, and ground that it lacks is appended."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from command_line import run
from helpers import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from dejavu_torch import DejaVu, PlaceSmoother, SpectralMapper
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.growth import merge
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.centring import centred
from dejavu_torch.updating import PIECE, Update, update

END = 240  # places that the map has; the route goes on


def waves(places, seed=0):
    noise = torch.randn(places + 3, 16, generator=torch.Generator().manual_seed(seed))
    smooth = torch.nn.functional.avg_pool1d(noise.T[None], 4, 1)[0].T
    return smooth / smooth.norm(dim=1, keepdim=True)


def seen(rows, seed=1):
    return rows + 0.05 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(seed))


ROUTE, ASIDE = waves(400), waves(150, seed=9)


def model_of(rows):
    return DejaVu(None, "none", mapper=SpectralMapper(24.0)).learn(rows)


def spectral(model):
    assert isinstance(model.map, SpectralMap)
    return model.map


def located(model, queries):
    return model.localize(ArrayTraverse(queries, "asked"), sequence=PlaceSmoother()).index


def close(stretch, first, last):
    return abs(stretch[0] - first) <= 3 and abs(stretch[1] - last) <= 3


def test_ground_beyond_the_end_becomes_a_route_with_names():
    model = model_of(ROUTE[:END])
    drive = ArrayTraverse(seen(ROUTE[100:330]), "data/monday.npy")
    drive.names = [f"{i}.png" for i in range(230)]
    found = update(model, drive, own="base")
    (stretch,) = found.stretches
    assert close(stretch, END - 100, 230)
    assert found.names == ("monday",)
    base, new = model.map.routes
    assert (base.name, base.places, new.name, new.places) == ("base", END, "monday", stretch[1] - stretch[0])
    assert model.frame_names[:END] == [""] * END
    assert model.frame_names[END:] == [f"{i}.png" for i in range(*stretch)]
    ((one, two, share),) = model.map.connections
    assert abs(one - (END - 1)) <= 2
    assert two == END
    assert share == (1.0 if one == END - 1 else 0.5)
    shown = located(model, seen(ROUTE[50:320], seed=5))
    assert ((shown - torch.arange(50, 320)).abs() <= 5).float().mean() > 0.97


def test_the_same_drive_brings_nothing_new_and_other_laps_are_stored_once():
    model, drive = model_of(ROUTE[:END]), seen(ROUTE[100:380])
    assert len(drive) - (END - 100) > PIECE
    assert update(model, drive).stretches
    size = spectral(model).summary().route_bytes
    again = update(model, drive)
    assert (again.stretches, again.unknown) == ((), ())
    assert str(again).endswith("nothing new")
    assert spectral(model).summary().route_bytes == size
    laps = torch.cat([seen(ROUTE[100:END]), *(seen(ROUTE[END:380], seed=i) for i in range(3))])
    other = model_of(ROUTE[:END])
    (stretch,) = update(other, laps).stretches
    assert close(stretch, END - 100, 380 - 100)


def test_a_detour_is_connected_at_both_ends_in_either_direction():
    way = torch.cat([ROUTE[40:120], ASIDE, ROUTE[120:200]])
    places = []
    for drive in (seen(way), seen(way).flip(0)):
        model = model_of(ROUTE[:END])
        (stretch,) = update(model, drive).stretches
        assert 140 <= stretch[1] - stretch[0] <= 156
        (came, start, there), (stop, went, on) = model.map.connections
        assert abs(came - 119) <= 3
        assert abs(went - 120) <= 3
        assert (start, stop, there, on) == (END, model.map.places - 1, 0.5, 0.5)
        places.append(located(model, seen(ASIDE[20:130], seed=4)))
        assert ((places[-1] - torch.arange(END + 20, END + 130)).abs() <= 8).float().mean() > 0.95
    assert ((places[0] - places[1]).abs() <= 6).float().mean() > 0.95  # stored in the map's direction


def test_new_ground_is_stored_without_the_light_of_the_day():
    light = 0.4 * torch.randn(16, generator=torch.Generator().manual_seed(3))
    model, drive = model_of(ROUTE[:END]), seen(ROUTE[60:360]) + light
    (stretch,) = update(model, drive).stretches
    place_map = spectral(model)
    stored = place_map.decode(1)
    expected = centred(place_map, drive)[slice(*stretch)]
    plain = torch.nn.functional.cosine_similarity(stored, drive[slice(*stretch)], dim=1).mean()
    assert torch.nn.functional.cosine_similarity(stored, expected, dim=1).mean() > max(0.9, float(plain))


def test_short_gaps_stay_out_and_short_drives_do_not_refine():
    model = model_of(ROUTE[:END])
    gap = torch.cat([ROUTE[20:100], ASIDE[:12], ROUTE[100:200]])
    assert update(model, seen(gap)).stretches == ()
    short = seen(ROUTE[END - 25 : END + 30])
    found = update(model, short)
    assert found.refinement is None
    assert "too few frames to learn from" in str(found)
    assert len(found.stretches) == 1


@pytest.mark.parametrize(("noise", "stored"), [(0.05, True), (0.22, False)])
def test_what_may_be_hard_to_recognise_is_told_and_not_stored(noise, stored):
    """Where single images rarely find places of the map, a stretch without any may be of the map too."""
    way = torch.cat([ROUTE[20:150], ASIDE[:60], ROUTE[150:]])
    drive = way + noise * torch.randn(way.shape, generator=torch.Generator().manual_seed(1))
    found = update(model_of(ROUTE), drive)
    new, unknown = (found.stretches, found.unknown) if stored else (found.unknown, found.stretches)
    assert unknown == ()
    assert len(new) == 1
    assert close(new[0], 130, 190)
    assert ("may be new, or hard to recognise" in str(found)) != stored


def test_what_fits_no_map_is_refused():
    model = model_of(ROUTE[:END])
    with refused("the array has 29 frames; expected at least 30"):
        update(model, seen(ROUTE[:29]))
    with refused("gives 8 features; the map expects 16"):
        update(model, torch.rand(40, 8))
    with refused("no map yet to update"):
        update(DejaVu(None, "none"), seen(ROUTE[:40]))
    assert model.map.routes == ()


def test_an_update_in_words():
    assert str(Update(None, True)) == "too few frames to learn from; nothing new"
    told = str(Update(None, True, ((3, 40),), ("monday",), ((60, 90),)))
    assert told.endswith(
        "frames 3-39 are new, the route monday; frames 60-89 may be new, or hard to recognise"
    )


def test_connections_are_followed_by_a_whole_drive():
    model = model_of(ROUTE[:END])
    update(model, seen(torch.cat([ROUTE[40:120], ASIDE, ROUTE[120:200]])))
    assert len(model.map.connections) == 2
    drive = seen(torch.cat([ROUTE[60:120], ASIDE, ROUTE[120:180]]), seed=6)
    match = model.localize_descriptors(drive, PlaceSmoother())
    assert match.smoother is not None
    ((end, start, _), (last, back, _)) = match.smoother.map_links
    assert match.smoother.map_links == model.map.connections
    model.replace_map(spectral(model).linked([]))
    without = model.localize_descriptors(drive, match.smoother).smoother  # which learns anew
    assert without is not None
    assert without.map_links == ()
    assert match.smoother.log_likelihood > without.log_likelihood + 5  # type: ignore[operator]
    expected = [*range(60, end + 1), *range(start, last + 1), *range(back, 180)]
    assert ((match.index[:60] - torch.tensor(expected[:60])).abs() <= 5).all()


def test_maps_that_are_saved_merged_and_cut_keep_their_connections(tmp_path):
    model = model_of(ROUTE[:END])
    update(model, seen(ROUTE[100:330]))
    model.save(tmp_path / "m.safetensors")
    loaded = DejaVu.load(tmp_path / "m.safetensors")
    links = model.map.connections
    assert links
    assert loaded.map.connections == links
    assert loaded.map.routes == model.map.routes
    other = model_of(ROUTE[:50])
    both = merge([other, model], ["first", "second"])
    assert both.map.connections == tuple((one + 50, two + 50, share) for one, two, share in links)
    place_map = spectral(model)
    assert place_map.part(place_map.routes[1].name).connections == ()
    assert place_map.linked([]).connections == ()
    with refused("links"):
        place_map.linked([(0, place_map.places, 0.5)])


@settings(deadline=None, max_examples=4)
@given(st.integers(60, 200), st.integers(80, 140), st.booleans())
def test_places_of_the_map_score_as_before(start, length, back):
    model = model_of(ROUTE[:END])
    drive, queries = seen(ROUTE[start : END + length]), waves(7, seed=2)
    before = copy.deepcopy(model).map
    found = update(model, drive.flip(0) if back else drive)
    assert len(found.stretches) == 1
    if found.refinement is None or not found.refinement.accepted:
        torch.testing.assert_close(model.map.scores(queries)[:, :END], before.scores(queries))
    assert spectral(model).coded()[0].stream.checksum == before.coded()[0].stream.checksum


def test_the_command_updates_a_map(tmp_path, capsys):
    days = {"route": ROUTE[:END], "monday": seen(ROUTE[90:330]), "other": waves(90, seed=9)}
    for name, values in days.items():
        np.save(tmp_path / f"{name}.npy", values.numpy())
    path = tmp_path / "yard.safetensors"
    run("learn", tmp_path / "route.npy", "--map", path)
    before = path.read_bytes()
    run("update", path, tmp_path / "other.npy")
    assert "not a drive on this map; nothing is learned, the map stays as it was" in capsys.readouterr().out
    assert path.read_bytes() == before
    run("update", path, tmp_path / "monday.npy", tmp_path / "monday.npy")
    out = capsys.readouterr().out
    assert "are new, the route monday" in out
    assert "nothing new" in out
    assert "route yard: places 0-239" in out
    assert "route monday: places 240-" in out
    run("localize", path, tmp_path / "monday.npy", "--ordered", "--out", tmp_path / "m.csv")
    assert ",monday," in (tmp_path / "m.csv").read_text()
