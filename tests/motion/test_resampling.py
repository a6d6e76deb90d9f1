"""Footage resampled by distance: learning, localizing, and the one table between frames and places."""

from __future__ import annotations

import pytest
import torch
from footage import QUERY, REFERENCE, STEP, camera, everything, footage, positions
from helpers import refused, template_model

from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.traverse import frame_range
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.places.positions import place_of


@pytest.fixture(scope="module")
def model():
    velocity = camera(step=STEP)  # a whole number
    return template_model(periods=everything(101), velocity=velocity).learn(footage(REFERENCE))


def resampled(*speeds, begin=0, **settings):
    return ResampledTraverse(ArrayTraverse(footage(begin + positions(*speeds))), camera(**settings))


def test_convention_11_places_are_even_steps_and_a_stop_adds_none(model):
    assert model.map.places == 600 // STEP + 1
    shown = model.map.frame_of(torch.arange(101))
    assert (REFERENCE[shown] - STEP * torch.arange(101)).abs().max() <= 4.5  # half of the fastest step
    assert not [frame for frame in shown.tolist() if 60 < frame < 85]  # it stands


def test_convention_11_all_frames_of_one_place_are_equally_right(model):
    places = model.map.place_of(torch.arange(len(REFERENCE)))
    assert places[60:86].unique().tolist() == [40]
    assert (STEP * places - REFERENCE).abs().max() <= 4.5
    shown = model.map.frame_of(torch.arange(101))
    assert (model.map.place_of(shown) - torch.arange(101)).abs().max() <= 1


def test_queries_are_resampled_by_the_step_of_the_map():
    reference = ResampledTraverse(ArrayTraverse(footage(REFERENCE)), camera(step=None))
    model = template_model(periods=everything(len(reference)), velocity=camera(step=None))
    model.learn(footage(REFERENCE))
    assert model.step == pytest.approx(4, abs=0.05)  # the median of the moving frames
    match = model.localize(footage(QUERY))
    assert len(match.index) == 600 // 4 + 1  # though the median step of the query is 8
    assert (match.index - torch.arange(151)).abs().max() <= 3  # the query shows each frame twice


def test_another_speed_and_other_stops_are_found(model):
    match = model.localize(footage(QUERY, noise=0.02))
    assert len(match.index) == 101
    assert (match.index - torch.arange(101)).abs().max() <= 1


def test_a_single_frame_and_ready_features_are_queries_as_they_are(model):
    frames = footage(torch.tensor([300]))
    assert model.localize(frames).index.tolist() == [50]
    features = model.features(footage(torch.tensor([300, 300])))
    assert model.localize(features).index.tolist() == [50, 50]


def test_the_file_keeps_the_step_and_the_table(model, tmp_path):
    model.save(tmp_path / "map.safetensors")
    again = DejaVu.load(tmp_path / "map.safetensors")
    assert again.step == model.step
    assert repr(again.velocity) == repr(model.velocity)
    assert torch.equal(again.map.positions, model.map.positions)
    for one, other in zip(again.localize(footage(QUERY)), model.localize(footage(QUERY)), strict=True):
        assert torch.equal(one, other)


def test_a_map_learned_from_features_takes_queries_as_they_are():
    model = template_model(periods=everything(40), velocity=camera()).learn_features(torch.rand(40, 900))
    assert model.step is None
    assert len(model.map.positions) == 0
    assert len(model.localize(footage(QUERY)).index) == len(QUERY)


def test_positions_come_on_top_of_the_budget_of_a_map():
    mapper = SpectralMapper(12.0)
    model = DejaVu(whitening=Whitening(views=2), mapper=mapper, velocity=camera()).learn(footage(REFERENCE))
    summary = model.summary()
    taken = summary.route["positions"]
    assert taken == 4 * len(REFERENCE)
    assert 0.98 * 12 <= (summary.route_bytes - taken) / 101 <= 12
    # a null has no positions, nor their bytes
    null = SpectralMapper.of_equal_size(model.map)(torch.randn(101, model.map.dimension)).summary()
    assert null.route_bytes == pytest.approx(summary.route_bytes - taken, rel=0.03)


# frames and places


def test_the_way_back_belongs_to_the_places_it_passes():
    speeds = ((6, 50), (-6, 15), (6, 40))
    where = positions(*speeds)
    even = resampled(*speeds)
    assert (place_of(even.positions, torch.arange(len(where))) - where / STEP).abs().max() <= 1
    away = resampled((-6, 3), (6, 30), begin=200)
    assert place_of(away.positions, torch.arange(5)).tolist() == [0, -1, -1, -1, -1]  # behind where it began


def test_names_and_shape_are_those_of_the_frames_that_are_shown():
    traverse = ArrayTraverse(footage(REFERENCE))
    traverse.names = [f"frame {i}" for i in range(len(traverse))]
    even = ResampledTraverse(traverse, camera())
    assert even.names[100] == f"frame {int(even.frame[100])}"
    assert even.frame_shape == (1, 48, 48)
    part = frame_range(even, start=20, stop=60, step=3)
    assert part.names[2] == f"frame {int(even.frame[26])}"
    assert torch.equal(torch.cat(list(part.batches(5))), even[20:60:3])


# what is told and refused


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: resampled((4, 60), step=4000.0), ("at least one step of 4000",)),
        (lambda: resampled((4, 60), step=1e-9), ("at most 20 per frame",)),
        (lambda: resampled((4, 60), step=1e-300), ("at most 20 per frame",)),
        (lambda: resampled((0, 29)), ("does not move", "30 frames", "expected motion")),
        (
            lambda: template_model(velocity=camera()).learn(torch.rand(90, 8)),
            ("(64, 8)", "features do not show the ground"),
        ),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


def test_ground_that_moves_to_and_fro_is_told(caplog):
    with caplog.at_level("WARNING", "dejavu_torch"):
        resampled(*[(4, 2), (-4, 1)] * 10, begin=100)
    assert any("20 of 30 steps go forward and 10 backwards" in line for line in caplog.messages)
