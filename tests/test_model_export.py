"""`DejaVu` as a graph: torch.export and torch.compile give the eager scores whatever the batch, and `forward`
never waits for a number, so that its operations can be queued on a device without a stop."""

from __future__ import annotations

import io
import shutil
from contextlib import contextmanager
from functools import partial

import pytest
import torch
from helpers import Fixed
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

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
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.types import FrequencyLayer

CHUNKS = (  # overlapping, with gaps, and a rational period
    FrequencyLayer(4, 4, 0, 20, (0, 2)),
    FrequencyLayer("5/2", 3, 5, 25, (0, 1)),
    FrequencyLayer(7, 7, 10, 25, (3,)),
    FrequencyLayer(7, 7, 30, 50, (1, 2, 3)),
)


def embedding():
    return Embedding(nn.Conv2d(3, 4, 3), dimension=8, resize=(16, 16), grid=2, cell=4)


def spectral(features, size=(32, 24)):
    """The default, a spectral map of whitened descriptors, of a route of 60 colour frames."""
    model = DejaVu(features(), Whitening(views=1), SpectralMapper(16.0))
    return model.learn(torch.rand(60, 3, *size)).eval()


def templates(features, **settings):
    """Templates of a route of 60 colour frames."""
    mapper = TemplateMapper(ImposedPeriods([3, 4, 5], bin=4))
    return DejaVu(features(), mapper=mapper, **settings).learn(torch.rand(60, 3, 32, 24)).eval()


def of_chunks(plan=CHUNKS, **settings):
    """A model of 4 features and several chunks, with places that no layer covers."""
    mapper = TemplateMapper(Fixed(*plan), **settings)
    return DejaVu(mapper=mapper).learn(torch.rand(60, 4)).eval()


def whitened(**settings):
    return DejaVu(mapper=SpectralMapper(16.0, **settings)).learn(torch.rand(60, 8)).eval()


MODELS = {
    "HOG": partial(templates, HOG),
    "HOG resized": partial(templates, lambda: HOG(resize=(24, 16), bins="linear")),
    "SmallCNN": partial(
        templates, lambda: SmallCNN(8, channels=3, resize=(16, 16), widths=(4, 8), squeeze=4)
    ),
    "patches": partial(templates, HOG, preprocess=Preprocess("R-B", "patch")),
    "spectral": partial(spectral, HOG),
    "joined": partial(spectral, lambda: Joined([HOG(), Distilled(), PatchPixels(), embedding()])),
    "in parts": partial(spectral, HOG, (64, 64)),  # eagerly HOG takes 42 frames of this size at a time
    "spectral chunks": partial(whitened, chunk=25),
    "spectral dct, l2": partial(whitened, transform="dct", metric="l2"),
    "no layers": partial(of_chunks, ()),
    "l1, sum": partial(of_chunks, metric="l1", reduction="sum"),
    "l2": partial(of_chunks, metric="l2"),
    "cosine, sum": partial(of_chunks, metric="cosine", reduction="sum"),
    "l1, temperature": partial(of_chunks, temperature=0.1),
}


def exported(model, queries):
    return torch.export.export(model, (queries,), dynamic_shapes={"queries": {0: torch.export.Dim("batch")}})


def saved(program):
    """The program as it is read again."""
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    buffer.seek(0)
    return torch.export.load(buffer).module()


def queries_of(model, batch):
    assert model.frame_shape is not None
    return torch.rand(batch, *model.frame_shape)


def assert_scores_alike(run, model, *batches):
    for batch in batches:
        queries = queries_of(model, batch)
        scores = run(queries)
        assert scores.dtype == torch.float32
        torch.testing.assert_close(scores, model(queries), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["joined", "in parts", "spectral dct, l2", "no layers", "l1, temperature"])
def test_the_exported_model_scores_as_the_model_does(kind):
    """The modules by themselves are exported by the matrix."""
    model = MODELS[kind]()
    program = exported(model, queries_of(model, 2))
    # torch does not read a split into nothing
    assert_scores_alike(program.module() if kind == "no layers" else saved(program), model, 1, 8, 100)


@pytest.mark.figures
@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")
def test_the_model_compiled_by_inductor_scores_frames_as_the_model_does():
    model = MODELS["HOG"]()
    torch.compiler.reset()
    run = torch.compile(model, fullgraph=True, dynamic=True)
    for batch in (8, 100):
        queries = queries_of(model, batch)
        torch.testing.assert_close(run(queries), model(queries), rtol=0, atol=1e-5)


# what the host reads


# operations whose result, or the size of it, the host has to read
READING = {
    "_local_scalar_dense",
    "is_nonzero",
    "equal",
    "nonzero",
    "masked_select",
    "unique_consecutive",
    "unique_dim",
    "_unique2",
    "bincount",
}
METHODS = ("item", "tolist", "numpy", "__bool__", "__int__", "__float__", "__index__", "__array__", "cpu")


class ReadingOperations(TorchDispatchMode):
    def __init__(self, found: list[str]) -> None:
        super().__init__()
        self.found = found

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        masked = name.startswith("index") and any(
            isinstance(index, Tensor) and index.dtype == torch.bool
            for argument in args
            if isinstance(argument, (list, tuple))
            for index in argument
        )
        if name in READING or masked:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


@contextmanager
def host_synchronisations(monkeypatch):
    """The names of all operations and methods that read a number from a tensor."""
    found = []

    def counted(name, method):
        def wrapper(self, *args, **kwargs):
            found.append(f"Tensor.{name}")
            return method(self, *args, **kwargs)

        return wrapper

    with monkeypatch.context() as patched, ReadingOperations(found):
        for name in METHODS:
            patched.setattr(Tensor, name, counted(name, getattr(Tensor, name)))
        yield found


@pytest.mark.parametrize("kind", MODELS)
def test_forward_reads_no_number(kind, monkeypatch):
    model = MODELS[kind]()
    for count in (5, 96):
        queries = queries_of(model, count)
        with host_synchronisations(monkeypatch) as found:
            scores = model(queries)
        assert found == []
        with FakeTensorMode(allow_non_fake_inputs=True) as mode:  # which has shapes, and no values
            assert model(mode.from_tensor(queries)).shape == scores.shape


def test_backward_reads_no_number(monkeypatch):
    mapper = TemplateMapper(ImposedPeriods([3, 4, 5], bin=4), temperature=0.5, trainable=True)
    model = DejaVu(mapper=mapper).learn(torch.rand(60, 3, 32, 24))
    with host_synchronisations(monkeypatch) as found:
        model(queries_of(model, 5)).sum().backward()
    assert found == []
    assert model.map.templates.grad is not None


READERS = {
    "item": lambda x: x.sum().item(),
    "numpy": lambda x: x.numpy(),
    "bool": lambda x: bool(x.any()),
    "index": lambda x: [1, 2, 3][x[0].long()],
    "mask": lambda x: x[x > 0.5],
    "nonzero": lambda x: x.nonzero(),
    "unique": lambda x: x.unique(),
    "equal": lambda x: torch.equal(x, x),
}


@pytest.mark.parametrize("reads", READERS.values(), ids=READERS)
def test_the_counter_sees_them(reads, monkeypatch):
    with host_synchronisations(monkeypatch) as found:
        reads(torch.tensor([1.0, 0.0, 1.0]))
    assert found
