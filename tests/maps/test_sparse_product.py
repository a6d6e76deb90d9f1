"""Products by the compiled loop are those by torch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dejavu_torch.maps import sparse_product, spectral
from dejavu_torch.maps.codec import to_int8
from dejavu_torch.maps.coefficients import Coefficients, coefficients_of, levels_of
from dejavu_torch.maps.compiling import compiled
from dejavu_torch.maps.sparse_product import _compiled, compiled_sums
from dejavu_torch.maps.spectral import SpectralMap

pytest.importorskip("numba")


def some(largest: int, numbers: int) -> Coefficients:
    draw = torch.Generator().manual_seed(0)
    levels = torch.randint(-largest, largest + 1, (90, numbers), generator=draw)
    return coefficients_of(*to_int8(levels * (torch.rand(90, numbers, generator=draw) < 0.4)))


@pytest.mark.parametrize(("largest", "numbers"), [(9, 12), (900, 300)])
def test_sums_are_those_of_the_levels(largest: int, numbers: int) -> None:
    own, queries = some(largest, numbers), torch.randn(3, numbers)
    where, factor = torch.randperm(100)[:90], torch.rand(90)
    found = compiled_sums(queries, own, where, factor, 100)
    expected = torch.zeros(3, 100, dtype=torch.float64)
    expected[:, where] = queries.double() @ levels_of(own, numbers).double().T * factor.double()
    assert found is not None
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6 * largest * numbers)


def test_what_it_cannot_do_is_left_to_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    own, where, factor = some(9, 12), torch.arange(90), torch.ones(90)

    def sums(queries: Tensor) -> Tensor | None:
        return compiled_sums(queries, own, where, factor, 90)

    assert sums(torch.randn(3, 12)) is not None
    assert sums(torch.randn(3, 12, requires_grad=True)) is None
    assert sums(torch.randn(3, 12, dtype=torch.float64)) is None


def test_what_cannot_be_compiled_is_left_to_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing, or the loop for larger numbers alone."""

    def broken(function: object, signature: str, **options: object) -> object:
        if "int16" in signature:
            raise OSError("libllvm is of another time")
        return compiled(function, signature, **options)  # type: ignore[type-var]

    monkeypatch.setattr(sparse_product, "compiled", broken)
    _compiled.cache_clear()
    for largest, left in ((9, False), (900, True)):
        found = compiled_sums(torch.randn(3, 12), some(largest, 12), torch.arange(90), torch.ones(90), 90)
        assert (found is None) == left
    _compiled.cache_clear()


@pytest.mark.parametrize("metric", ["cosine", "l2"])
@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_scores_by_it_are_those_by_torch(
    metric: str, transform: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, lengths = some(300, 12), torch.tensor([40, 40, 10])
    mean = torch.randn(12).bfloat16()
    steps = torch.rand(3) + 0.5
    route = SpectralMap(own, lengths, steps, mean, metric, transform, chunk=40)  # type: ignore[arg-type]
    monkeypatch.setattr(route, "rebuilds", lambda queries: False)
    queries, calls = torch.randn(5, 12), []
    assert not route.compiled  # too few to be worth it
    expected = route.scores(queries)
    monkeypatch.setattr(spectral, "WORTH_COMPILING", 1)
    route.loaded()
    monkeypatch.setattr(
        spectral, "compiled_sums", lambda *args: calls.append(compiled_sums(*args)) or calls[-1]
    )
    torch.testing.assert_close(route.scores(queries), expected, rtol=1e-5, atol=1e-5)
    assert len(calls) == 2  # of the chunks of 40 places together, and of the last
    assert all(one is not None for one in calls)
