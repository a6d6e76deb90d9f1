"""`python -m benchmarks scale`: what is made and kept, what is measured of it, and what is written."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from command_line import benchmark
from helpers import all_of

from benchmarks import scale, scale_contenders
from benchmarks.made import MadeRoute, likeness
from benchmarks.repeating import TiledRoute, tiles_of
from benchmarks.scale import Task
from benchmarks.scale_contenders import FLOWN, ONE_CHUNK, PLACED, REPEATED, Mapped
from benchmarks.scale_report import exponents, scale_row, scale_tables
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.simulate.aerial import TILES, AerialRoad
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu


def smooth(count, numbers, seed=0):
    """Descriptors of length 1 that change little from place to place."""
    noise = torch.randn(count + 15, numbers, generator=torch.Generator().manual_seed(seed))
    return F.normalize(F.avg_pool1d(noise.T[None], 16, 1)[0].T, dim=1)


@pytest.fixture(scope="module")
def like():
    """Of a route whose numbers 0 to 3 are seen again as 0.8 of them, 4 to 7 as 0.4, with noise."""
    route, shown = smooth(6000, 8), torch.arange(0, 6000, 2)
    kept = torch.tensor([0.8] * 4 + [0.4] * 4)
    noise = torch.randn(len(shown), 8, generator=torch.Generator().manual_seed(1))
    return likeness(route, kept * route[shown] + 0.1 * noise, shown)


def test_a_made_route_and_its_queries_are_like_those_that_were_measured(like):
    route, made = smooth(6000, 8), all_of(MadeRoute(like, 6000), 1000)
    assert torch.linalg.vector_norm(made, dim=1).allclose(torch.ones(6000))
    for apart in (1, 4, 8, 40):  # the triangle of a moving mean, and nothing beyond it
        own, theirs = (float((x[apart:] * x[:-apart]).sum(1).mean()) for x in (made, route))
        assert own == pytest.approx(theirs, abs=0.06)
    assert torch.allclose(made.T @ made / 6000, route.T @ route / 6000, atol=0.04)
    shown = torch.arange(0, 6000, 2)
    again, seen = MadeRoute(like, 6000).seen_again(shown), made[shown]
    # scaled to length 1: what is left is told by the ratio of the two halves
    rho = ((again - again.mean(0)) * (seen - seen.mean(0))).mean(0) / seen.var(0)
    assert float(rho[:4].mean() / rho[4:].mean()) == pytest.approx(2, abs=0.3)
    assert torch.equal(again, MadeRoute(like, 6000).seen_again(shown))


def test_descriptors_of_tiles_are_those_of_the_frames():
    model = DejaVu(HOG(), Whitening(numbers=16))
    assert model.whitening is not None
    still = {"ground": "repeat", "noise": 0, "drift": 0, "yaw": 0}
    drive = AerialRoad(frames=200, **still)  # type: ignore[arg-type]
    features = torch.cat([model.descriptor.describe(part) for part in drive.batches(64)])
    noise = torch.randn(features.shape, generator=torch.Generator().manual_seed(0))
    model.whitening.learn(features, [(features + 0.02 * noise, torch.arange(200))])
    road = AerialRoad(frames=math.lcm(*TILES), **still)  # type: ignore[arg-type]
    at = range(100, 10**6, 99_991)
    own = TiledRoute(**tiles_of(model), length=len(road)).read(at)
    drawn = model.descriptor(road[at])
    assert (own * drawn).sum(1).min() > 0.97  # the light moves a few gradients to another bin
    assert (own @ drawn.T).fill_diagonal_(0).max() < (own * drawn).sum(1).min()


def test_a_null_tells_the_frames_that_it_shuffled(tmp_path):
    route = smooth(600, 16)
    null = Mapped(SpectralMapper(8.0, chunk=10_000), shuffled=True)
    null.learn(ArrayTraverse(route), tmp_path / "kept")  # type: ignore[arg-type]
    _, place = null.load(tmp_path / "kept")(route[::20])
    assert ((place - torch.arange(0, 600, 20)).abs() <= 5).double().mean() > 0.9


def in_this_process(module, arguments):
    """In the place of `in_process`; what is given goes through JSON, as there."""
    what, task, folder = json.loads(json.dumps(arguments))
    threads = torch.get_num_threads()
    try:
        facts = getattr(scale, what)(Task(*task), Path(folder))
    except Exception as error:
        return {"skipped": str(error)}
    finally:
        torch.set_num_threads(threads)
    return facts


@pytest.fixture
def _small(monkeypatch):
    monkeypatch.setattr(scale, "in_process", in_this_process)
    monkeypatch.setattr(scale, "give_back", lambda: None)  # of a process of its own
    sizes = {"RENDERED": 600, "SHUFFLED": 600, "CHECKED": 520, "QUERIES": 40, "BATCH": 20, "COPIED": 2**20}
    for name, value in sizes.items():
        monkeypatch.setattr(scale, name, value)
    monkeypatch.setattr(scale_contenders, "CHUNK", 128)
    for name in PLACED.keys() - {"dejavu 4 B", "dejavu 4 B, one chunk", "null 4 B", "faiss flat"}:
        monkeypatch.delitem(PLACED, name)


@pytest.mark.usefixtures("_small")
def test_rows_of_all_cases_are_written(tmp_path, capsys):
    benchmark("scale", "--places", "600", "900", "--out", tmp_path)
    written = json.loads((tmp_path / "bench.json").read_text())
    rows = {(row["case"], row["contender"]): row for row in written["rows"]}
    placed = ("places=600", "made=520", "places=900")
    repeated = ("repeat=600", "repeat=900", "templates=600", "templates=900")
    assert {case for case, _ in rows} == {*placed, *repeated}
    for case in placed:
        ours = rows[case, "dejavu 4 B"]
        assert 3.8 < ours["bytes_per_place"] <= 4.0
        assert min(ours["recall_at_1"], rows[case, "dejavu 4 B, one chunk"]["recall_at_1"]) > 0.8
        assert (ours["queries"], ours["device"]) == (40, "cpu")
        assert ours["ratio_to_ours"] >= 1
        shares = ("bandwidth_share", "learn_rate", "bytes")
        assert min(ours[key] for key in ("seconds", "seconds_one", "seconds_load", *shares)) > 0
    whole, flown = rows["repeat=600", ONE_CHUNK], rows["repeat=600", FLOWN]
    assert rows["repeat=600", "null"]["bytes_per_place"] == pytest.approx(whole["bytes_per_place"], rel=0.02)
    assert flown["step"] == whole["step"] > 0
    assert flown["bytes_per_place"] != whole["bytes_per_place"]
    assert "600" in rows["repeat=900", FLOWN]["skipped"]
    assert "600" in rows["places=900", "null 4 B"]["skipped"]
    assert set(REPEATED) <= {name for _, name in rows}
    assert rows["templates=900", "dejavu two layers"]["seconds"] > 0
    assert written["exponents"] == {}  # of two sizes
    assert {"faiss", "versions", "cpu_capability"} <= set(written)
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
    assert "places=600" in capsys.readouterr().out


def test_exponents_and_tables():
    sizes, cycle = (100, 1000, 10_000), math.lcm(*TILES)
    rows = [scale_row(f"places={n}", "dejavu", n, seconds=1e-6 * n**0.5, route_bytes=7) for n in sizes]
    rows += [scale_row(f"repeat={n}", "dejavu", n, seconds=1e-6 * n, route_bytes=7) for n in sizes]
    rows += [scale_row(f"places={n}", "dejavu 1 B", n, seconds=1.0, route_bytes=n) for n in sizes]
    rows += [scale_row(f"places={n}", "null 1 B", n, seconds=1.0) for n in sizes[:2]]
    rows += [scale_row(f"repeat={cycle}", "dejavu", cycle, route_bytes=1)]
    rows += [scale_row("places=100", "faiss flat", 100, skipped="no faiss")]
    found = exponents(rows)
    assert found["places"]["dejavu"]["seconds"] == pytest.approx(0.5)
    assert found["repeat"]["dejavu"] == pytest.approx({"seconds": 1, "route_bytes": 0}, abs=1e-9)
    assert found["places"]["dejavu 1 B"].keys() == {"seconds"}  # its bytes are given
    assert not found["places"].keys() & {"faiss flat", "null 1 B"}  # of two sizes at most
    first, *_, last = scale_tables(rows)
    assert first.splitlines()[0] == "places=100"
    assert first.splitlines()[-1].split() == ["faiss", "flat", "skipped:", "no", "faiss"]
    assert last.startswith("repeat=N: exponents of N\n")
