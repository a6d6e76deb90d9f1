"""The compiled loop for L1: when it is used, and that its numbers do not depend on where they stand."""

from __future__ import annotations

import logging
import multiprocessing
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from processes import python
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from dejavu_torch import phase_distances
from dejavu_torch.maps import distance as l1

ENOUGH = (64, l1.WORTH_COMPILING // 64)  # the smallest templates that are left to the compiled loop


@pytest.fixture
def forget():
    """What was found out about numba is found out anew, in the test and after it."""
    l1._compiled.cache_clear()
    yield
    l1._compiled.cache_clear()


@pytest.fixture(params=[1, 3], ids=["one thread", "three threads"])
def compiled(request, monkeypatch):
    """Everything that can be is computed by the compiled loop, and cut into tasks, however small."""
    pytest.importorskip("numba")
    monkeypatch.setattr(l1, "WORTH_COMPILING", 1)
    monkeypatch.setattr(l1, "TASK", 1)
    monkeypatch.setattr(l1, "QUERIES_AT_ONCE", 3)
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(before)


def distances(query, templates):
    """What the compiled loop gives, never torch."""
    result = l1.compiled_l1(query, templates)
    assert result is not None
    assert result.shape == (len(query), len(templates))
    assert result.dtype == torch.float32
    return result


@pytest.mark.usefixtures("compiled")
class TestTheCompiledLoop:
    @given(st.integers(1, 9), st.integers(1, 14), st.integers(1, 300), st.integers(0, 2**16))
    def test_equals_float64_and_does_not_depend_on_where_a_pair_stands(self, queries, phases, features, seed):
        torch.manual_seed(seed)
        query, mu = torch.randn(queries, features), torch.randn(phases, features)
        found = distances(query, mu)
        expected = (query.double()[:, None] - mu.double()).abs().sum(2)
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)
        assert found.tolist() == [[distances(a[None], b[None]).item() for b in mu] for a in query]
        equal = distances(query, mu[:1].repeat(phases, 1))
        assert torch.equal(equal, equal[:, :1].expand(-1, phases))

    @pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
    def test_nan_and_infinity_arrive(self, value):
        query, mu = torch.rand(4, 100), torch.rand(6, 100)
        query[1, 40] = mu[5, 40] = value
        expected = torch.cdist(query, mu, p=1.0)
        assert expected.isfinite().sum() == 3 * 5
        torch.testing.assert_close(distances(query, mu), expected, equal_nan=True)

    def test_rows_need_not_lie_side_by_side(self):
        query, mu = torch.rand(80, 7).T, torch.rand(20, 161)[::2, 1::2]
        assert torch.equal(distances(query, mu), distances(query.clone(), mu.clone()))

    @pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
    @pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
    def test_after_fork(self):
        query, mu = torch.rand(20, 33), torch.rand(21, 33)
        expected = distances(query, mu)

        def child():
            sys.exit(0 if torch.equal(distances(query, mu), expected) else 3)

        process = multiprocessing.get_context("fork").Process(target=child)
        process.start()
        process.join(60)
        assert process.exitcode == 0


def test_a_query_alone_gets_the_bits_it_gets_in_a_batch():
    for templates in (torch.rand(ENOUGH), torch.rand(ENOUGH)[1:]):
        query = torch.rand(5, templates.shape[1])
        alone = torch.cat([phase_distances(row[None], templates) for row in query])
        assert torch.equal(alone, phase_distances(query, templates))


def traced(function, a, b):
    """The function as each tracer records it, on other numbers than it was recorded with."""
    others = torch.rand_like(a), torch.rand_like(b)

    class Module(torch.nn.Module):
        def forward(self, a, b):
            return function(a, b)

    with torch.no_grad():
        tracers = [
            torch.jit.trace(Module(), others),  # type: ignore[no-untyped-call]
            make_fx(Module())(*others),
            make_fx(Module(), tracing_mode="fake")(*others),
            torch.export.export(Module(), others).module(),
            torch.compile(Module(), backend="eager", fullgraph=True),
        ]
        return [tracer(a, b) for tracer in tracers]


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_what_traces_finds_operations_of_torch():
    query, mu = torch.rand(3, ENOUGH[1]), torch.rand(ENOUGH)
    for found in traced(phase_distances, query, mu):
        assert torch.equal(found, torch.cdist(query, mu, p=1.0))


def test_gradients_and_vmap_are_left_to_torch():
    """Sum of |a - b|: the gradient of each number is how many of the others it exceeds, less the rest."""
    mu, query = torch.rand(ENOUGH), torch.full((1, ENOUGH[1]), 2.0)
    slope = torch.func.grad(lambda a: phase_distances(a, mu).sum())(query)
    assert torch.equal(slope, torch.full((1, ENOUGH[1]), float(ENOUGH[0])))
    phase_distances(query.requires_grad_(), mu).sum().backward()
    assert query.grad is not None
    assert torch.equal(query.grad, slope)
    queries = torch.rand(2, 3, ENOUGH[1])
    expected = torch.stack([torch.cdist(one, mu, p=1.0) for one in queries])
    torch.testing.assert_close(torch.vmap(lambda one: phase_distances(one, mu))(queries), expected)
    with forward_ad.dual_level():  # torch has no rule for this: it says so, and nothing is dropped silently
        dual = forward_ad.make_dual(torch.rand(1, ENOUGH[1]), torch.rand(1, ENOUGH[1]))
        assert l1.compiled_l1(dual, mu) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda query, mu: (query, mu[1:]),  # few
        lambda query, mu: (query.double(), mu.double()),
        lambda query, mu: (query, mu.half()),
        lambda query, mu: (query.requires_grad_(), mu),
        lambda query, mu: (query, mu.requires_grad_()),
        lambda query, mu: (query.to("meta"), mu.to("meta")),
        lambda query, mu: (query, mu.to_sparse()),
    ],
)
def test_what_is_left_to_torch(change):
    assert l1.compiled_l1(*change(torch.rand(2, ENOUGH[1]), torch.rand(ENOUGH))) is None


def test_what_is_not_left_to_torch():
    pytest.importorskip("numba")
    query, mu = torch.rand(2, ENOUGH[1], requires_grad=True), torch.nn.Parameter(torch.rand(ENOUGH))
    assert l1.compiled_l1(query.detach(), mu.detach()) is not None
    with torch.no_grad():
        assert l1.compiled_l1(query, mu) is not None
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        assert l1.compiled_l1(torch.rand(2, ENOUGH[1]), mu) is not None


@pytest.mark.parametrize(
    ("problem", "told"),
    [
        ("missing", "by torch, not by numba"),
        ("broken", "libllvm is of another time"),
        ("switched off", "NUMBA_DISABLE_JIT"),
    ],
)
@pytest.mark.usefixtures("forget")
def test_without_numba_one_line_is_logged_and_torch_does_the_work(problem, told, monkeypatch, caplog):
    def njit(*args, **options):
        raise OSError("libllvm\nis of another time")

    if problem == "missing":
        monkeypatch.setitem(sys.modules, "numba", None)
    elif problem == "broken":
        monkeypatch.setattr(pytest.importorskip("numba"), "njit", njit)
    else:
        monkeypatch.setattr(pytest.importorskip("numba").config, "DISABLE_JIT", 1)
    query, mu = torch.rand(3, ENOUGH[1]), torch.rand(ENOUGH)
    with caplog.at_level(logging.INFO, "dejavu_torch"):
        for _ in range(2):
            assert l1.l1_backend() == "torch"
            assert torch.equal(phase_distances(query, mu), torch.cdist(query, mu, p=1.0))
    (line,) = caplog.messages
    assert told in line
    assert "\n" not in line


@pytest.mark.usefixtures("forget")
def test_there_may_be_nowhere_to_keep_what_is_compiled(monkeypatch):
    numba = pytest.importorskip("numba")
    njit = numba.njit

    def nowhere(*args, cache, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*args, cache=cache, **options)

    monkeypatch.setattr(numba, "njit", nowhere)
    assert l1.l1_backend() == "numba"


def test_numba_waits_until_it_is_needed():
    code = (
        "import sys, torch, dejavu_torch as d; d.phase_distances(torch.rand(99, 9), torch.rand(99, 9));"
        "sys.exit('numba' in sys.modules)"
    )
    assert python(code).returncode == 0
