"""Nothing in the way of a frame to its place leaves the device that the model is on."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path

import pytest
import torch
from command_line import fails, run
from torch import Tensor

from dejavu_torch import (
    DejaVu,
    FrequencyLayer,
    ImposedPeriods,
    LiveLocalizer,
    PlaceFilter,
    Preprocess,
    SequenceMatcher,
    SpectralMapper,
    SpectrogramAnalysis,
    TemplateMap,
    TemplateMapper,
    Whitening,
    open_source,
)
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import SequenceModel

SEQUENCES = [PlaceFilter(), PlaceFilter(search_every=5), SequenceMatcher(3), None]
ELSEWHERE = f"cuda:{torch.cuda.device_count()}"  # the first that is not there


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
        together = PlaceFilter()(model.map.scores(descriptors))
        assert (together.device.type, together.shape) == ("meta", (4, 60))
        assert best_candidates(scores, 3, 5).index.device.type == "meta"
    with pytest.raises(RuntimeError, match="device"):
        torch.zeros(1) + scores[0, :1]


# on the CPU as well, so that the tests themselves run everywhere
CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
GPU = pytest.param("cuda", marks=[pytest.mark.gpu, CUDA])
DEVICES = ["cpu", GPU]


@pytest.fixture(autouse=True)
def whole_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Convolutions of a GPU have 10 bits of each number unless they are told otherwise."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


LEARNED: dict[str, Mapper] = {
    "templates": TemplateMapper(ImposedPeriods([3, 4, 5], bin=4)),
    "found": TemplateMapper(SpectrogramAnalysis(60, false_alarm=None), reduction="sum", temperature=3.0),
    "spectral": SpectralMapper(None, step=1e-4),  # so fine that what rounding moves by a step is not seen
    "chunks": SpectralMapper(None, step=1e-4, chunk=16, transform="dct", metric="l2"),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", LEARNED)
def test_a_map_learned_on_a_gpu_scores_as_that_of_the_cpu(kind: str, device: str, frames: Tensor) -> None:
    maps = [DejaVu(whitening="none", mapper=LEARNED[kind]).to(one).learn(frames) for one in ("cpu", device)]
    query = frames[3:40:4] * 0.9 + 0.02
    scores, found = (model(query.to(model.map.positions.device)) for model in maps)
    assert found.device.type == device
    assert scores.isfinite().all()
    torch.testing.assert_close(found.cpu(), scores, rtol=1e-4, atol=1e-4)
    matches = [model.localize(query) for model in maps]
    torch.testing.assert_close(matches[1].score, matches[0].score, rtol=1e-4, atol=1e-4)
    assert matches[0].index.tolist() == matches[1].index.tolist()


@pytest.mark.parametrize("device", DEVICES)
def test_a_whitening_learned_on_a_gpu_is_that_of_the_cpu(device: str, frames: Tensor) -> None:
    whitening = Whitening(numbers=8, views=2, bits=16)
    models = [DejaVu(whitening=copy.deepcopy(whitening)).to(one).learn(frames) for one in ("cpu", device)]
    known = [model.whitened(model.describe(frames.to(model.map.positions.device))).cpu() for model in models]
    # up to the signs of its numbers, and what 16 bits round
    torch.testing.assert_close(known[1] @ known[1].T, known[0] @ known[0].T, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_a_map_calibrated_on_a_gpu_is_as_sure_as_that_of_the_cpu(device: str, frames: Tensor) -> None:
    traverse = ArrayTraverse(frames)
    models = [DejaVu(whitening="none", mapper=LEARNED["spectral"]).to(one) for one in ("cpu", device)]
    for model in models:
        model.learn(traverse).calibrate(traverse)
    expected, found = (model.calibration for model in models)
    assert expected is not None
    assert found is not None
    assert expected.single is not None
    assert found.single == pytest.approx(expected.single, rel=1e-2)
    assert found.filter == pytest.approx(expected.filter, rel=1e-2)


@pytest.mark.parametrize("device", DEVICES)
def test_two_layers_are_searched_on_a_gpu(device: str) -> None:
    plan = tuple(FrequencyLayer(Fraction(p), p, 5, 60_000, (j,)) for j, p in enumerate((210, 286)))
    generator = torch.Generator().manual_seed(0)
    blocks = [torch.rand(layer.phases, 1, generator=generator) for layer in plan]
    queries = torch.rand(4, 2, generator=generator).to(device)
    route = TemplateMap(plan, blocks, 60_000, 2).to(device)
    found = route.lowest(queries)
    assert found is not None
    score, place = found
    assert place.device.type == device
    assert torch.equal(score, route.scores(queries).amin(1))
    assert torch.equal(route.scores(queries).gather(1, place[:, None])[:, 0], score)


@pytest.mark.parametrize("device", [GPU])
@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("kind", models())
def test_a_gpu_finds_what_the_cpu_finds(
    kind: str, sequence: SequenceModel | None, device: str, frames: Tensor
) -> None:
    here = models()[kind].learn(frames)
    there = models()[kind].to(device).learn(frames)
    assert {tensor.device.type for tensor in there.state_dict().values() if isinstance(tensor, Tensor)} == {
        device
    }
    expected = here.localize(frames, sequence=sequence)
    there.load_state_dict(here.state_dict())  # learned alike but for rounding
    match = there.localize(frames, sequence=sequence)
    assert match.score.device.type == "cpu"
    torch.testing.assert_close(match.score, expected.score, rtol=1e-4, atol=1e-4)
    localizer = LiveLocalizer(there, sequence)
    found = [localizer(frame).score for frame in frames]
    assert found == pytest.approx(expected.score.tolist(), rel=1e-4, abs=1e-4)
    assert localizer.scores is not None
    assert localizer.scores.device.type == device


@pytest.mark.gpu
@pytest.mark.slow
@CUDA
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


@pytest.mark.parametrize(
    ("command", "device"), [*zip(COMMANDS, [ELSEWHERE, "tpu", "cpu:1", "cuda:x"], strict=True)]
)
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
