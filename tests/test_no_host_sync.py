"""`DejaVu.forward` never waits for a number: its operations can be queued on a device without a stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from dejavu_torch import (
    DejaVu,
    ImposedPeriods,
    SpectralMapper,
    SpectrogramAnalysis,
    TemplateMapper,
    Whitening,
    open_source,
)

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

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
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
def host_synchronisations(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The names of all operations and methods that read a number from a tensor."""
    found: list[str] = []

    def counted(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(self: Tensor, *args: Any, **kwargs: Any) -> Any:
            found.append(f"Tensor.{name}")
            return method(self, *args, **kwargs)

        return wrapper

    with monkeypatch.context() as patched, ReadingOperations(found):
        for name in METHODS:
            patched.setattr(Tensor, name, counted(name, getattr(Tensor, name)))
        yield found


@pytest.fixture(scope="module")
def frames() -> Tensor:
    return torch.cat(list(open_source("sim:aerial?frames=96").batches(96)))


PERIODS = {"imposed": ImposedPeriods([3, 4, 5], bin=4), "found": SpectrogramAnalysis(32, false_alarm=None)}


def models(frames: Tensor) -> Iterator[DejaVu]:
    """HOG with every kind of layers, metric, reduction, temperature and weights."""
    settings: list[dict[str, Any]] = [
        *({"metric": metric} for metric in ("l1", "l2", "cosine")),
        {"reduction": "sum"},
        {"temperature": 0.5},
    ]
    features = DejaVu().extract_all(open_source("sim:aerial?frames=96"))
    for periods in PERIODS.values():
        for setting in settings:
            yield DejaVu(mapper=TemplateMapper(periods, **setting)).learn_features(features).eval()
        model = DejaVu(mapper=TemplateMapper(periods)).learn_features(features).eval()
        model.map.trainable(weights=True)
        yield model
        model.map.freeze()
        yield model


def test_forward_makes_none(frames: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    for model in models(frames):
        for queries in (frames[:5], DejaVu().describe(frames[:5])):
            assert model.map.summary().covered == 96
            with host_synchronisations(monkeypatch) as found:
                scores = model(queries)
            assert found == [], model.map
            assert scores.shape == (5, 96)


@pytest.fixture(scope="module")
def spectral(frames: Tensor) -> list[DejaVu]:
    """The default, and maps of several chunks, whatever the transform and the metric."""
    models = [DejaVu(whitening=Whitening(views=1)).learn(frames).eval()]
    features = models[0].whitened(models[0].describe(frames))
    for settings in ({"chunk": 32}, {"transform": "dct", "metric": "l2", "chunk": 40}):
        mapper = SpectralMapper(8.0, **settings)  # type: ignore[arg-type]
        models.append(DejaVu(whitening="none", mapper=mapper).learn_features(features.detach()).eval())
    return models


@pytest.mark.parametrize("count", [5, 96])
def test_forward_of_spectral_maps_makes_none(
    count: int, spectral: list[DejaVu], frames: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    features = spectral[0].describe(frames[:count])
    descriptors = spectral[0].whitened(features)
    both = zip(spectral, (frames[:count], descriptors, descriptors), strict=True)
    for model, queries in [*both, (spectral[0], features)]:
        with host_synchronisations(monkeypatch) as found:
            scores = model(queries)
        assert found == [], model.map
        assert scores.shape == (count, 96)
        with FakeTensorMode(allow_non_fake_inputs=True) as mode:
            assert model(mode.from_tensor(queries)).shape == (count, 96)


def test_backward_makes_none(frames: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    model = DejaVu(mapper=TemplateMapper(PERIODS["imposed"], temperature=0.5, trainable=True)).learn(frames)
    with host_synchronisations(monkeypatch) as found:
        model(frames[:5]).sum().backward()
    assert found == []
    assert model.map.templates.grad is not None


def test_forward_runs_where_no_number_can_be_read(frames: Tensor) -> None:
    """Fake tensors have shapes and no values: whatever reads one of them fails."""
    model = DejaVu(mapper=TemplateMapper(PERIODS["found"], temperature=0.5)).learn(frames).eval()
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        scores = model(mode.from_tensor(frames[:5]))
    assert scores.shape == (5, 96)


READERS: dict[str, Callable[[Tensor], Any]] = {
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
def test_the_counter_sees_them(reads: Callable[[Tensor], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    with host_synchronisations(monkeypatch) as found:
        reads(torch.tensor([1.0, 0.0, 1.0]))
    assert found
