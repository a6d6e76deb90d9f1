"""The picture that tells whether a machine describes frames as another did, in map files and beside ONNX."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from command_line import fails, run

from dejavu_torch import HOG, DejaVu, SpectralMapper, Whitening, growth, open_source
from dejavu_torch.features.probe import NUMBERS, TOLERANCE, probe_distance, probe_of, probe_picture
from dejavu_torch.maps.file import read_map, write_map


@pytest.fixture(scope="module")
def model():
    return DejaVu(HOG(), Whitening(16, views=1), SpectralMapper(24.0)).learn("sim:aerial?frames=60&size=32")


@pytest.fixture
def file(model, tmp_path):
    model.save(tmp_path / "route.safetensors")
    return tmp_path / "route.safetensors"


@pytest.mark.parametrize("shape", [(1, 32, 64), (3, 96, 171), (3, 1, 1), (2, 5, 3)])
def test_the_picture_is_of_whole_numbers_and_each_time_the_same(shape):
    picture = probe_picture(shape)
    assert picture.shape == (1, *shape)
    assert 0 <= picture.min() <= picture.max() <= 1
    pixels = (255 * picture).round()
    assert torch.equal(pixels.byte().float() / 255, picture)
    assert torch.equal(probe_picture(shape), picture)


def test_every_wrong_reading_of_the_picture_is_plain(model):
    picture, known = probe_picture(model.frame_shape), torch.tensor(model.probe)
    for wrong in (picture.flip(1), picture.transpose(2, 3), picture.flip(3), 255 * picture, picture**2.2):
        with torch.no_grad():
            found = model.descriptor(wrong)[0]
        assert (found - known).norm() / known.norm() > 10 * TOLERANCE


def test_a_map_file_keeps_the_probe_and_an_older_one_has_none(model, file, tmp_path):
    assert len(model.probe) == 16
    assert DejaVu.load(file).probe == model.probe
    tensors, header = read_map(file)
    del header["probe"]
    write_map(tmp_path / "older.safetensors", tensors, header)
    assert DejaVu.load(tmp_path / "older.safetensors").probe is None
    wide = DejaVu(HOG(), "none").learn("sim:aerial?frames=60&size=64")
    assert len(wide.probe) == NUMBERS < wide.map.dimension
    assert DejaVu().learn(torch.rand(60, 8)).probe is None


def test_a_probe_depends_on_the_descriptor_alone(model, file, tmp_path):
    """Not on threads, nor on the mode, nor on how the map has grown: its file stays that of whole maps."""
    before, mode = torch.get_num_threads(), model.training
    torch.set_num_threads(2)
    assert probe_of(model.train().descriptor, model.frame_shape) == model.probe
    torch.set_num_threads(before)
    model.train(mode)
    grown = growth.append(DejaVu.load(file), open_source("sim:aerial?frames=60&size=32&seed=2"))
    merged = growth.merge([DejaVu.load(file), DejaVu.load(file)], ["a", "b"])
    assert grown.probe == merged.probe == model.probe


def test_info_tells_whether_frames_are_described_as_at_learning(model, file, tmp_path, capsys):
    run("info", file, "--check")
    assert "the probe is described as at learning: 0 of its length apart" in capsys.readouterr().out
    other = DejaVu.load(file)
    with torch.no_grad():
        other.whitening.scale[:8] *= 1.01  # type: ignore[union-attr]
    other.save(tmp_path / "other.safetensors")
    assert TOLERANCE < probe_distance(other.descriptor, other.frame_shape, other.probe) < 0.01  # type: ignore[arg-type]
    error = fails(capsys, "info", tmp_path / "other.safetensors", "--check")
    assert "of its length from that at learning; expected at most 0.001" in error
    assert "other weights" in error
    run("info", tmp_path / "other.safetensors")  # which asks nothing
    DejaVu().learn(torch.rand(60, 8)).save(tmp_path / "ready.safetensors")
    run("info", tmp_path / "ready.safetensors", "--check")
    assert "no probe to check the descriptor with" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [[], ["--descriptor"], ["--match", "filter", "--centre", "mean", "--descriptor"]]
)
def test_an_exported_file_gives_what_its_probe_says(words, model, file, tmp_path, capsys):
    pytest.importorskip("onnxscript")
    from dejavu_torch.export import session_of

    run("export", file, "--onnx", tmp_path / "route.onnx", *words)
    assert f"{tmp_path / 'route.probe.npz'}" in capsys.readouterr().out
    session, probe = session_of(str(tmp_path / "route.onnx")), dict(np.load(tmp_path / "route.probe.npz"))
    given = {one.name: probe.pop(one.name) for one in session.get_inputs()}
    np.testing.assert_array_equal(given["frames"], probe_picture(model.frame_shape).numpy())
    names = [one.name for one in session.get_outputs()]
    assert ("descriptor" in names) == ("--descriptor" in words)
    assert {*probe} == {*names, "descriptor"}
    for name, found in zip(names, session.run(None, given), strict=True):
        np.testing.assert_allclose(found, probe[name], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(probe["descriptor"][0], model.probe, rtol=0, atol=1e-4)
    with np.testing.assert_raises(AssertionError):  # blue first
        scores = session.run(names[:1], given | {"frames": given["frames"][:, ::-1]})[0]
        np.testing.assert_allclose(scores, probe["scores"], rtol=1e-3, atol=1e-3)
