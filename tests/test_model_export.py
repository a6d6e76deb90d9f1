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

CHUNKS: Plan = (  # overlapping, with gaps, and a rational period
    FrequencyLayer(4, 4, 0, 20, (0, 2)),
    FrequencyLayer("5/2", 3, 5, 25, (0, 1)),
    FrequencyLayer(7, 7, 10, 25, (3,)),
    FrequencyLayer(7, 7, 30, 50, (1, 2, 3)),
)
UNCOVERED = [*range(25, 30), *range(50, 60)]


def embedding() -> Embedding:
    return Embedding(nn.Conv2d(3, 4, 3), dimension=8, resize=(16, 16), grid=2, cell=4)


def spectral(features: Callable[[], nn.Module], size: tuple[int, int] = (32, 24)) -> DejaVu:
    """The default, a spectral map of whitened descriptors, of a route of 60 colour frames."""
    model = DejaVu(features(), Whitening(views=1), SpectralMapper(16.0))
    return model.learn(torch.rand(60, 3, *size)).eval()


def templates(features: Callable[[], nn.Module], **settings: Any) -> DejaVu:
    """Templates of a route of 60 colour frames."""
    mapper = TemplateMapper(ImposedPeriods([3, 4, 5], bin=4))
    return DejaVu(features(), mapper=mapper, **settings).learn(torch.rand(60, 3, 32, 24)).eval()


def of_chunks(plan: Plan = CHUNKS, **settings: Any) -> DejaVu:
    """A model of 4 features and several chunks, with places that no layer covers."""
    mapper = TemplateMapper(Fixed(*plan), **settings)
    return DejaVu(mapper=mapper).learn(torch.rand(60, 4)).eval()


def whitened(**settings: Any) -> DejaVu:
    return DejaVu(mapper=SpectralMapper(16.0, **settings)).learn(torch.rand(60, 8)).eval()


MODELS: dict[str, Callable[[], DejaVu]] = {
    "HOG": partial(templates, HOG),
    "HOG resized": partial(templates, lambda: HOG(resize=(24, 16), bins="linear")),
    "PatchPixels": partial(templates, lambda: PatchPixels((16, 24))),
    "SmallCNN": partial(
        templates, lambda: SmallCNN(8, channels=3, resize=(16, 16), widths=(4, 8), squeeze=4)
    ),
    "grey": partial(templates, HOG, preprocess=Preprocess("grey")),
    "patches": partial(templates, HOG, preprocess=Preprocess("R-B", "patch")),
    "spectral": partial(spectral, HOG),
    "spectral Embedding": partial(spectral, embedding),
    "in parts": partial(spectral, HOG, (64, 64)),  # eagerly HOG takes 42 frames of this size at a time
    "spectral chunks": partial(whitened, chunk=25),
    "spectral dct, l2": partial(whitened, transform="dct", metric="l2"),
    "no layers": partial(of_chunks, ()),
    "l1, sum": partial(of_chunks, metric="l1", reduction="sum"),
    "l2": partial(of_chunks, metric="l2"),
    "cosine, sum": partial(of_chunks, metric="cosine", reduction="sum"),
    "l1, temperature": partial(of_chunks, temperature=0.1),
}


def exported(model: DejaVu, queries: Tensor) -> torch.export.ExportedProgram:
    return torch.export.export(model, (queries,), dynamic_shapes={"queries": {0: torch.export.Dim("batch")}})


def saved(program: torch.export.ExportedProgram) -> Any:
    """The program as it is read again."""
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    buffer.seek(0)
    return torch.export.load(buffer).module()


def queries_of(model: DejaVu, batch: int) -> Tensor:
    assert model.frame_shape is not None
    return torch.rand(batch, *model.frame_shape)


def assert_scores_alike(run: Callable[[Tensor], Tensor], model: DejaVu) -> None:
    for batch in (1, 8, 100):
        queries = queries_of(model, batch)
        scores = run(queries)
        assert scores.dtype == torch.float32
        torch.testing.assert_close(scores, model(queries), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", MODELS)
def test_the_exported_model_scores_as_the_model_does(kind: str) -> None:
    model = MODELS[kind]()
    program = exported(model, queries_of(model, 2))
    # torch does not read a split into nothing
    assert_scores_alike(program.module() if kind == "no layers" else saved(program), model)


@pytest.mark.parametrize("kind", ["HOG", "SmallCNN", "spectral", "no layers", "l1, temperature"])
def test_the_compiled_model_scores_as_the_model_does(kind: str) -> None:
    model = MODELS[kind]()
    torch.compiler.reset()
    assert_scores_alike(torch.compile(model, fullgraph=True, backend="eager"), model)


def test_places_that_nothing_covers_and_frames_that_run_in_parts_are_among_them() -> None:
    assert of_chunks()(torch.rand(3, 4))[:, UNCOVERED].isposinf().all()
    assert VALUES_AT_ONCE < 100 * 3 * 64 * 64


@pytest.mark.figures
@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")
def test_the_model_compiled_by_inductor_scores_frames_as_the_model_does() -> None:
    model = MODELS["HOG"]()
    torch.compiler.reset()
    run = torch.compile(model, fullgraph=True, dynamic=True)
    for batch in (8, 100):
        queries = queries_of(model, batch)
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
