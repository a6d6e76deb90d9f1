"""Nothing in the way of a frame to its place leaves the device that the model is on."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from command_line import fails, run
from torch import Tensor

from dejavu_torch import (
    DejaVu,
    ImposedPeriods,
    LiveLocalizer,
    PlaceFilter,
    Preprocess,
    SequenceMatcher,
    SpectralMapper,
    TemplateMapper,
    Whitening,
    open_source,
)
from dejavu_torch.cli.device import device_of
from dejavu_torch.recognition.candidates import best_candidates
from dejavu_torch.types import SequenceModel

SEQUENCES = [PlaceFilter(), PlaceFilter(search_every=5), SequenceMatcher(3), None]
ELSEWHERE = ["cuda"] if not torch.cuda.is_available() else [f"cuda:{torch.cuda.device_count()}"]


def models() -> dict[str, DejaVu]:
    return {
        "spectral": DejaVu(whitening=Whitening(views=1)),
        "chunks": DejaVu(
            preprocess=Preprocess(channel="grey", contrast="patch"),
            whitening=Whitening(views=1),
            mapper=SpectralMapper(20.0, chunk=16, transform="dct", metric="l2"),
        ),
        "templates": DejaVu(mapper=TemplateMapper(ImposedPeriods([3, 4, 5], bin=4))),
    }


@pytest.fixture(scope="module")
def frames() -> Tensor:
    return torch.cat(list(open_source("sim:aerial?frames=60").batches(64)))


@pytest.mark.parametrize("kind", models())
def test_a_frame_stays_on_its_device(kind: str, frames: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on `meta` have no numbers, and refuse to meet those of the CPU, as those of a GPU do."""
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # which does not know meta
    model = models()[kind].learn(frames).to("meta")
    with torch.no_grad():
        scores = model(torch.empty(4, 3, 64, 64, device="meta"))
        descriptors = model.whitened(model.describe(torch.empty(4, 3, 64, 64, device="meta")))
        (together,) = model.map.sequences([descriptors], PlaceFilter())
        assert (together.device.type, together.shape) == ("meta", (4, 60))
        assert best_candidates(scores, 3, 5).index.device.type == "meta"
    with pytest.raises(RuntimeError, match="device"):
        torch.zeros(1) + scores[0, :1]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("kind", models())
def test_a_gpu_finds_what_the_cpu_finds(kind: str, sequence: SequenceModel | None, frames: Tensor) -> None:
    here = models()[kind].learn(frames)
    there = models()[kind].to("cuda").learn(frames)
    assert {tensor.device.type for tensor in there.state_dict().values() if isinstance(tensor, Tensor)} == {
        "cuda"
    }
    expected = here.localize(frames, sequence=sequence)
    there.load_state_dict(here.state_dict())  # learned alike but for rounding
    match = there.localize(frames, sequence=sequence)
    assert match.score.device.type == "cpu"
    torch.testing.assert_close(match.score, expected.score, rtol=1e-3, atol=1e-4)
    localizer = LiveLocalizer(there, sequence)
    found = [localizer(frame).score for frame in frames]
    assert found == pytest.approx(expected.score.tolist(), rel=1e-3, abs=1e-4)
    assert localizer.scores is not None
    assert localizer.scores.is_cuda


@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_commands_run_on_a_gpu(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, query = "sim:aerial?frames=200", "sim:aerial?frames=200&traverse=1"
    run("learn", source, "--map", tmp_path / "map.safetensors", "--device", "cuda")
    run("localize", tmp_path / "map.safetensors", query, "--out", tmp_path / "m.csv", "--device", "cuda:0")
    run("live", tmp_path / "map.safetensors", query, "--device", "cuda")
    run("compare", source, query, "--out", tmp_path / "report", "--device", "cuda")
    assert (tmp_path / "report" / "report.json").is_file()
    assert len((tmp_path / "m.csv").read_text().splitlines()) == 201


COMMANDS = {
    "learn": ("learn", "sim:aerial?frames=60", "--map", "map.safetensors"),
    "localize": ("localize", "map.safetensors", "sim:aerial?frames=60", "--out", "matches.csv"),
    "compare": ("compare", "sim:aerial?frames=60", "sim:aerial?frames=60&traverse=1", "--out", "report"),
    "live": ("live", "map.safetensors", "sim:aerial?frames=60"),
}


@pytest.mark.parametrize("device", [*ELSEWHERE, "tpu", "cpu:1", "cuda:x"])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_device_that_is_not_there_is_one_line(
    command: str,
    device: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    error = fails(capsys, *COMMANDS[command], f"--device={device}")
    assert f"--device {device}" in error
    assert list(tmp_path.iterdir()) == []


def test_the_option_moves_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    moved: list[torch.device] = []
    to = DejaVu.to
    monkeypatch.setattr(DejaVu, "to", lambda self, device: (moved.append(device), to(self, device))[1])
    for command in ("learn", "localize", "live"):
        run(*COMMANDS[command], "--device", "cpu")
        assert moved.pop() == torch.device("cpu")
        assert moved == []


def test_learning_takes_double_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert device_of("mps").type == "mps"
    with pytest.raises(ValueError, match="double precision"):
        device_of("mps", learns=True)
