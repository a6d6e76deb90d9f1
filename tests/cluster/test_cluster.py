"""A route learned by two workers: the file of one process, whatever happens to them."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from command_line import fails, frames, run, write_images
from helpers import Fixed, Stream, refused, template_model
from torch import Tensor, nn

from dejavu_torch.cluster import session
from dejavu_torch.cluster.learning import code_on
from dejavu_torch.cluster.searching import ClusterSearcher, _map_of, _parts
from dejavu_torch.cluster.session import Cluster
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.features.views import Views
from dejavu_torch.growth import append, merge
from dejavu_torch.maps import spectral
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.streaming import coder, sample
from dejavu_torch.streaming.work import WorkFolder
from dejavu_torch.types import FrequencyLayer, Traverse

CHUNK, PLACES = 50, 620
FEATURES = """
import os, time
from pathlib import Path
import torch

class Watched(torch.nn.Module):
    '''Means of blocks. A worker says its number and waits until it may go on; a white frame ends it.'''

    def __init__(self, folder):
        super().__init__()
        self.folder, self.home = str(folder), os.getpid()

    def forward(self, frames):
        if os.getpid() != self.home:
            here = Path(self.folder)
            (here / f"{os.getpid()}.worker").touch()
            while not (here / "go").exists():
                time.sleep(0.01)
            if (here / "deadly").exists() and (frames.flatten(1).amin(1) > 0.95).any():
                os._exit(1)
        return torch.nn.functional.avg_pool2d(frames, 4).flatten(1)
"""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Two workers for all tests here: to start Ray takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "processors", lambda: 2)
        with Cluster() as workers:
            yield workers


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "SAMPLE", 400)
    monkeypatch.setattr(coder, "SHARD", 100)


@pytest.fixture
def watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> nn.Module:
    """Features of a user's own file, which is gone before any worker could read it."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "features_of_mine.py").write_text(FEATURES)
    module: ModuleType = importlib.import_module("features_of_mine")
    (tmp_path / "features_of_mine.py").unlink()
    monkeypatch.delitem(sys.modules, "features_of_mine", raising=False)
    sys.modules["features_of_mine"] = module
    features: nn.Module = module.Watched(tmp_path)
    return features


def route() -> Tensor:
    noise = torch.randn(PLACES + 9, 1, 8, generator=torch.Generator().manual_seed(1))
    return 4 * torch.nn.functional.avg_pool1d(noise.permute(2, 1, 0), 10, 1)[:, 0].T.contiguous()


def learned(traverse: Traverse | Tensor, features: nn.Module | None = None, **settings: object) -> DejaVu:
    model = DejaVu(features, "none", SpectralMapper(6.0, chunk=CHUNK))
    return model.learn(traverse, **settings)  # type: ignore[arg-type]


def file_of(model: DejaVu, folder: Path) -> bytes:
    model.save(folder / "map.safetensors")
    return (folder / "map.safetensors").read_bytes()


@pytest.mark.parametrize("kind", ["array", "stream"])
def test_workers_write_the_file_of_one_process(kind: str, cluster: Cluster, tmp_path: Path) -> None:
    traverse = route() if kind == "array" else Stream(route())
    whitened = DejaVu(mapper=SpectralMapper(6.0, chunk=CHUNK)).learn(traverse)  # type: ignore[arg-type]
    other = DejaVu(mapper=SpectralMapper(6.0, chunk=CHUNK))
    other.learn(traverse, make=partial(code_on, cluster))  # type: ignore[arg-type]
    assert file_of(other, tmp_path) == file_of(whitened, tmp_path)


def test_a_worker_that_is_killed_is_made_up_for(cluster: Cluster, watched: nn.Module, tmp_path: Path) -> None:
    images = write_images(tmp_path / "route", frames(PLACES, size=16))
    whole = file_of(learned(open_source(images), watched), tmp_path)
    killed: list[int] = []

    def kill() -> None:
        stop = time.monotonic() + 60
        while not killed and time.monotonic() < stop:
            for file in tmp_path.glob("*.worker"):
                killed.append(int(file.stem))
                os.kill(killed[0], signal.SIGKILL)
                break
            time.sleep(0.01)
        (tmp_path / "go").touch()

    thread = threading.Thread(target=kill)
    thread.start()
    model = learned(
        open_source(images), watched, work=WorkFolder(tmp_path / "work"), make=partial(code_on, cluster)
    )
    thread.join()
    assert killed
    assert killed[0] != os.getpid()
    assert len(list(tmp_path.glob("*.worker"))) >= 2
    assert file_of(model, tmp_path) == whole


def test_what_cannot_be_made_is_named_and_only_that_is_made_again(
    cluster: Cluster, watched: nn.Module, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "RETRIES", 0)
    bright = frames(PLACES, size=16)
    bright[444] = 255
    assert not {110, 444} & set(sample.sample_of(PLACES, CHUNK).frame.tolist())
    images = write_images(tmp_path / "route", bright)
    good = (images / "110.png").read_bytes()
    whole = file_of(learned(open_source(images), watched), tmp_path)
    (images / "110.png").write_bytes(b"no image")
    (tmp_path / "go").touch()
    (tmp_path / "deadly").touch()
    settings = {"work": WorkFolder(tmp_path / "work"), "make": partial(code_on, cluster)}
    with refused("110.png", "read on", "1 more such part", "420 of 620"):
        learned(open_source(images), watched, **settings)
    (images / "110.png").write_bytes(good)
    with refused("frames 400 to 499: its worker died", "520 of 620"):
        learned(open_source(images), watched, **settings)
    (tmp_path / "deadly").unlink()
    dealt: list[range] = []

    def noted(*work: object) -> object:
        dealt.extend(work[2])  # type: ignore[call-overload]
        return code_on(cluster, *work)  # type: ignore[arg-type]

    settings["make"] = noted
    assert file_of(learned(open_source(images), watched, **settings), tmp_path) == whole
    assert dealt == [range(8, 10)]


def test_of_shards_read_together_those_ahead_of_a_bad_frame_are_kept(
    cluster: Cluster, tmp_path: Path
) -> None:
    bad = route()
    bad[544] = torch.nan
    assert 544 not in sample.sample_of(PLACES, CHUNK).frame
    with refused(
        "frames 500 to 599", "read on", "frame 544", "500 of 620"
    ):  # dealt out as 0 to 399, and 400 on
        learned(Stream(bad), work=WorkFolder(tmp_path / "work"), make=partial(code_on, cluster))


def found_by(model: DejaVu, queries: Tensor, searcher: ClusterSearcher | None = None) -> list[Tensor]:
    if searcher is not None:
        model.search_by(searcher)
    match, best = model.localize(queries), model.candidates(queries, 4, apart=3)
    assert searcher is None or model.searcher() is searcher
    return [match.index, match.score, *best, match.accepted]


def test_parts_of_a_map_on_workers_find_what_the_whole_does(cluster: Cluster) -> None:
    # more than a block of a scan, with ties between the chunks of one part, and of both
    again = torch.cat([route() * (1 + i / 9) for i in range(64 // 8)], 1)[:500].repeat(20, 1)
    other = torch.randn(300, again.shape[1], generator=torch.Generator().manual_seed(7))
    steps = {0.3: (CHUNK, again), 0.2: (40, again[:600]), 0.1: (30, other)}
    models = [
        DejaVu(None, "none", SpectralMapper(None, step, chunk)).learn(rows)
        for step, (chunk, rows) in steps.items()
    ]
    model = merge(models, ["one", "two", "three"])
    queries = torch.cat([again[:90:7], again[480:700:9] + 0.1, again[:500:31], other[::31]])
    whole = found_by(model, queries)
    assert int((whole[2][:, 1] - whole[2][:, 0]).remainder(500).eq(0).sum()) > 20
    assert torch.equal(whole[0][-10:], 10_600 + torch.arange(0, 300, 31))
    searcher = ClusterSearcher(cluster, model.map)
    assert len(searcher.actors) == 2
    assert all(map(torch.equal, found_by(model, queries, searcher), whole))
    one = [column[3:4] for column in whole]  # scored another way
    assert all(map(torch.equal, found_by(model, queries[3:4], searcher)[:1], one[:1]))


def test_a_part_is_scored_to_the_bit_as_in_the_whole_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though its coefficients alone would not be worth a compiled loop."""
    draw = torch.nn.functional.normalize(torch.randn(2000, 32, generator=torch.Generator().manual_seed(0)))
    monkeypatch.setattr(spectral, "BLOCK", 2**13)
    monkeypatch.setattr(spectral, "WORTH_COMPILING", 6500)
    whole = SpectralMapper(None, 0.25, chunk=CHUNK)(draw)
    assert not whole.rebuilds(1)
    for part in _parts(whole, 500, 0):
        one = _map_of(part)
        assert len(one.level) < 6500 < len(whole.level)
        scores = whole.scores_between(draw[:1], part.start, part.start + part.places)
        assert torch.equal(one.scores(draw[:1]), scores)


def test_parts_are_scored_in_the_blocks_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spectral, "BLOCK", 3 * CHUNK * 8)
    model = DejaVu(None, "none", SpectralMapper(6.0, chunk=CHUNK)).learn(route()[:220])
    whole = append(model, route()[220:]).map  # with a short chunk inside
    queries = route()[:2]
    starts = [start for start, _ in whole.score_blocks(queries, rebuild=True)]
    parts = list(_parts(whole, 2 * CHUNK, 0))
    assert len(parts) > 3
    found = [
        part.start + start for part in parts for start, _ in _map_of(part).score_blocks(queries, rebuild=True)
    ]
    assert found == starts


def test_probabilities_are_those_of_the_whole_map_whatever_happens_to_a_worker(cluster: Cluster) -> None:
    torch.manual_seed(0)
    views = Views(ArrayTraverse(route() + 0.3 * torch.randn(PLACES, 8)), torch.arange(PLACES))
    model = DejaVu(None, "none", SpectralMapper(6.0, chunk=CHUNK), precision=0.9).learn(route())
    model.calibrate(None, views)
    queries = route()[::5] + 0.4 * torch.randn(PLACES // 5, 8)
    whole = model.localize(queries)
    searcher = ClusterSearcher(cluster, model.map)
    model.search_by(searcher)
    assert whole.probability is not None
    for _ in range(2):
        found = model.localize(queries)
        assert found.probability is not None
        assert torch.equal(found.probability, whole.probability)
        assert torch.equal(found.accepted, whole.accepted)
        assert torch.equal(found.index, whole.index)
        os.kill(cluster.ray.get(searcher.actors[0].process.remote()), signal.SIGKILL)
    assert 0 < int(whole.accepted.sum()) < len(queries)
    with refused("templates", "spectral"):
        ClusterSearcher(
            cluster, template_model(Fixed(FrequencyLayer(7, 7, 0, 70, (0,)))).learn(route()[:70]).map
        )


def test_a_short_route_starts_no_cluster(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "route.npy", route()[:64])
    command = ("learn", tmp_path / "route.npy", "--map", tmp_path / "map.safetensors", "--mapper.chunk", "50")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "Cluster", None)
        run(*command, "--calibration", "none", "--cluster", "auto")
    assert "64 frames are learned here" in capsys.readouterr().out


def test_a_cluster_that_is_not_there_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ("learn", "sim:aerial?frames=64", "--map", tmp_path / "map.safetensors")
    chunked = (*command, "--mapper.chunk", "50")
    assert "--mapper.chunk" in fails(capsys, *command, "--cluster", "auto")
    assert "--device" in fails(capsys, *chunked, "--cluster", "auto", "--device", "cuda")
    found = ("localize", "map.safetensors", "sim:aerial", "--out", tmp_path / "m.csv", "--cluster", "auto")
    assert "--filter" in fails(capsys, *found, "--filter")
    assert "--sequence 5" in fails(capsys, *found, "--sequence", "5")
    assert "TemplateMapper" in fails(capsys, *command, "--config", "local_maxima", "--cluster", "auto")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "ray", None)
        assert "pip install 'dejavu_torch[cluster]'" in fails(capsys, *chunked, "--cluster", "auto")
