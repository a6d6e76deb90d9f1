"""`DejaVu` itself goes through torch.export and torch.compile, with the eager scores whatever the batch."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from helpers import Fixed
from torch import Tensor, nn

from dejavu_torch import (
    HOG,
    DejaVu,
    Embedding,
    ImposedPeriods,
    Preprocess,
    SpectralMapper,
    TemplateMapper,
    Whitening,
)
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.preprocess import VALUES_AT_ONCE
from dejavu_torch.types import FrequencyLayer, Plan

BATCHES = (1, 8, 100)
CHUNKS: Plan = (  # overlapping, with gaps, and a rational period
    FrequencyLayer(4, 4, 0, 20, (0, 2)),
    FrequencyLayer("5/2", 3, 5, 25, (0, 1)),
    FrequencyLayer(7, 7, 10, 25, (3,)),
    FrequencyLayer(7, 7, 30, 50, (1, 2, 3)),
)
UNCOVERED = [*range(25, 30), *range(50, 60)]
BACKBONES: dict[str, Callable[[], nn.Module]] = {
    "HOG": HOG,
    "HOG resized": lambda: HOG(resize=(24, 16), bins="linear"),
    "PatchPixels": lambda: PatchPixels((16, 24)),
    "SmallCNN": lambda: SmallCNN(8, channels=3, resize=(16, 16), widths=(4, 8), squeeze=4),
    "Embedding": lambda: Embedding(nn.Conv2d(3, 4, 3), dimension=8, resize=(16, 16), grid=2, cell=4),
}
SPECTRAL: dict[str, dict[str, Any]] = {
    "default": {},
    "chunks": {"chunk": 25},
    "dct, l2": {"transform": "dct", "metric": "l2"},
}
SETTINGS: dict[str, dict[str, Any]] = {
    "l1, sum": {"metric": "l1", "reduction": "sum"},
    "l2": {"metric": "l2"},
    "cosine, sum": {"metric": "cosine", "reduction": "sum"},
    "l1, temperature": {"temperature": 0.1},
}


def spectral(backbone: str) -> DejaVu:
    """The default, a spectral map of whitened descriptors, of a route of 60 colour frames."""
    model = DejaVu(BACKBONES[backbone](), Whitening(views=1), SpectralMapper(16.0))
    return model.learn(torch.rand(60, 3, 32, 24)).eval()


def learned(backbone: str) -> DejaVu:
    """A model of a route of 60 colour frames."""
    periods = ImposedPeriods([3, 4, 5], bin=4)
    return (
        DejaVu(BACKBONES[backbone](), mapper=TemplateMapper(periods)).learn(torch.rand(60, 3, 32, 24)).eval()
    )


def of_chunks(**settings: Any) -> DejaVu:
    """A model of 4 features and several chunks, with places that no layer covers."""
    mapper = TemplateMapper(Fixed(*CHUNKS), **settings)
    return DejaVu(mapper=mapper).learn_features(torch.rand(60, 4)).eval()


def exported(model: DejaVu, queries: Tensor) -> torch.export.ExportedProgram:
    return torch.export.export(model, (queries,), dynamic_shapes={"queries": {0: torch.export.Dim("batch")}})


@pytest.mark.figures
@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")
def test_the_model_compiled_by_inductor_scores_frames_as_the_model_does() -> None:
    model = learned("HOG")
    torch.compiler.reset()
    run = torch.compile(model, fullgraph=True, dynamic=True)
    for batch in (8, 100):
        queries = torch.rand(batch, 3, 32, 24)
        torch.testing.assert_close(run(queries), model(queries), rtol=0, atol=1e-5)


@pytest.mark.parametrize("training", [True, False])
def test_the_weights_of_the_features_count(training: bool) -> None:
    model, queries = of_chunks(), torch.rand(5, 4)
    before = model(queries)
    model.map.trainable(weights=True, start=torch.tensor([0.5, 1.0, 2.0, 0.0]))
    if not training:
        model.map.freeze()
    expected = model(queries)
    assert not torch.allclose(expected[:, :20], before[:, :20])
    torch.testing.assert_close(exported(model, queries[:2]).module()(queries), expected, rtol=0, atol=1e-6)


def assert_scores_alike(
    run: Callable[[Tensor], Tensor], model: DejaVu, *shape: int, atol: float = 1e-5
) -> None:
    for batch in BATCHES:
        queries = torch.rand(batch, *shape)
        scores = run(queries)
        assert scores.dtype == torch.float32
        torch.testing.assert_close(scores, model(queries), rtol=0, atol=atol)


def saved(program: torch.export.ExportedProgram) -> Any:
    """The program as it is read again."""
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    buffer.seek(0)
    return torch.export.load(buffer).module()


OF_FRAMES: dict[str, Callable[[], DejaVu]] = {
    **{name: partial(learned, name) for name in BACKBONES},
    "spectral": partial(spectral, "HOG"),
    "spectral Embedding": partial(spectral, "Embedding"),
}


@pytest.mark.parametrize("kind", OF_FRAMES)
def test_the_exported_model_scores_frames_as_the_model_does(kind: str) -> None:
    model = OF_FRAMES[kind]()
    program = exported(model, torch.rand(2, 3, 32, 24))
    assert_scores_alike(program.module(), model, 3, 32, 24)
    if kind.startswith("spectral"):
        assert_scores_alike(saved(program), model, 3, 32, 24)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*BACKBONES, "spectral"])
def test_the_compiled_model_scores_frames_as_the_model_does(kind: str) -> None:
    model = OF_FRAMES[kind]()
    torch.compiler.reset()
    assert_scores_alike(torch.compile(model, fullgraph=True, backend="eager"), model, 3, 32, 24)


@pytest.mark.parametrize("settings", SPECTRAL.values(), ids=SPECTRAL)
def test_every_setting_of_a_spectral_map_is_exported(settings: dict[str, Any]) -> None:
    """Of whitened features."""
    model = DejaVu(mapper=SpectralMapper(16.0, **settings)).learn(torch.rand(60, 8)).eval()
    assert_scores_alike(exported(model, torch.rand(2, 8)).module(), model, 8)


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_every_setting_of_a_map_is_exported(settings: dict[str, Any]) -> None:
    model = of_chunks(**settings)
    program = exported(model, torch.rand(2, 4))
    assert model(torch.rand(3, 4))[:, UNCOVERED].isposinf().all()
    for run in (program.module(), saved(program)):
        assert_scores_alike(run, model, 4, atol=1e-6)


@pytest.mark.parametrize("plan", [(), CHUNKS], ids=["no layers", "layers"])
def test_a_map_is_compiled(plan: Plan) -> None:
    mapper = TemplateMapper(Fixed(*plan), temperature=0.1)
    model = DejaVu(mapper=mapper).learn_features(torch.rand(60, 4)).eval()
    torch.compiler.reset()
    run = torch.compile(model, fullgraph=True, backend="eager")
    assert_scores_alike(run, model, 4, atol=1e-6)
    assert_scores_alike(exported(model, torch.rand(2, 4)).module(), model, 4, atol=1e-6)


@pytest.mark.parametrize("preprocess", [Preprocess("grey"), Preprocess("R-B", "patch")], ids=repr)
def test_preprocessing_is_part_of_the_exported_model(preprocess: Preprocess) -> None:
    model = DejaVu(mapper=TemplateMapper(ImposedPeriods([3, 4])), preprocess=preprocess)
    model.learn(torch.rand(40, 3, 32, 24)).eval()
    assert_scores_alike(exported(model, torch.rand(2, 3, 32, 24)).module(), model, 3, 32, 24)


def test_frames_that_run_in_parts_are_exported_whole() -> None:
    """Eagerly HOG takes 42 frames of this size at a time."""
    model = DejaVu(HOG(), Whitening(views=1), SpectralMapper(16.0)).learn(torch.rand(60, 3, 64, 64)).eval()
    assert max(BATCHES) * 3 * 64 * 64 > VALUES_AT_ONCE
    assert_scores_alike(exported(model, torch.rand(2, 3, 64, 64)).module(), model, 3, 64, 64)
