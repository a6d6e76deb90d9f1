"""A route learned by two workers: the file of one process, whatever happens to them."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest
import torch
from command_line import fails, frames, run, write_images
from helpers import Fixed, long_from, refused, template_model

from dejavu_torch import cluster as clustering
from dejavu_torch.cluster import Cluster, ClusterSearch
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.growth import learn_mean, merge
from dejavu_torch.learning import Checkpoint, Sample
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.places.layout import Layout
from dejavu_torch.types import FrequencyLayer

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
def cluster():
    """Two workers for all tests here: to start Ray takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clustering, "_processors", lambda: 2)
        with Cluster() as workers:
            yield workers


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    long_from(monkeypatch, 400)
    monkeypatch.setattr(clustering, "TASK", 100)


@pytest.fixture
def watched(tmp_path, monkeypatch):
    """Features of a user's own file, which is gone before any worker could read it."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "features_of_mine.py").write_text(FEATURES)
    module = importlib.import_module("features_of_mine")
    (tmp_path / "features_of_mine.py").unlink()
    monkeypatch.delitem(sys.modules, "features_of_mine", raising=False)
    sys.modules["features_of_mine"] = module
    features = module.Watched(tmp_path)
    return features


def route():
    noise = torch.randn(PLACES + 9, 1, 8, generator=torch.Generator().manual_seed(1))
    return 4 * torch.nn.functional.avg_pool1d(noise.permute(2, 1, 0), 10, 1)[:, 0].T.contiguous()


def learned(traverse, features=None, **settings):
    model = DejaVu(features, "none", SpectralMapper(6.0, chunk=CHUNK))
    return model.learn(traverse, **settings)  # type: ignore[arg-type]


def file_of(model, folder):
    model.save(folder / "map.safetensors")
    return (folder / "map.safetensors").read_bytes()


def test_workers_write_the_file_of_one_process(cluster, tmp_path):
    """Whitened, and with a second traverse averaged in."""
    visits, files = LabelledFrames(ArrayTraverse(route() + 0.1), torch.arange(PLACES)), []
    for map_tasks in (map, cluster.map):
        model = DejaVu(mapper=SpectralMapper(6.0, chunk=CHUNK))
        files.append(file_of(learn_mean(model, route(), visits, map_tasks=map_tasks), tmp_path))
    assert files[0] == files[1]


def test_a_worker_that_is_killed_is_made_up_for(cluster, watched, tmp_path):
    images = write_images(tmp_path / "route", frames(PLACES, size=16))
    whole = file_of(learned(open_source(images), watched), tmp_path)
    killed = []

    def kill():
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
        open_source(images), watched, checkpoint=Checkpoint(tmp_path / "m"), map_tasks=cluster.map
    )
    thread.join()
    assert killed
    assert killed[0] != os.getpid()
    assert len(list(tmp_path.glob("*.worker"))) >= 2
    assert file_of(model, tmp_path) == whole


def test_what_cannot_be_made_is_named_and_what_precedes_it_is_kept(cluster, watched, tmp_path, monkeypatch):
    monkeypatch.setattr(clustering, "RETRIES", 0)
    bright = frames(PLACES, size=16)
    bright[444] = 255
    assert not {110, 444} & set(Sample.of_route(Layout(PLACES), CHUNK).frame.tolist())
    images = write_images(tmp_path / "route", bright)
    good = (images / "110.png").read_bytes()
    whole = file_of(learned(open_source(images), watched), tmp_path)
    (images / "110.png").write_bytes(b"no image")
    (tmp_path / "go").touch()
    (tmp_path / "deadly").touch()
    began = []

    def noted(encode, tasks):
        began.append(tasks[0].start)
        return cluster.map(encode, tasks)

    def learn():
        return learned(open_source(images), watched, checkpoint=Checkpoint(tmp_path / "m"), map_tasks=noted)

    with refused("110.png", "read on", "frames 100 to 199", "100 of 620 places"):
        learn()
    (images / "110.png").write_bytes(good)
    with refused("frames 400 to 499: its worker died", "400 of 620"):
        learn()
    (tmp_path / "deadly").unlink()
    assert file_of(learn(), tmp_path) == whole
    assert began == [0, 100, 400]


def test_chunks_made_together_before_a_bad_frame_are_kept(cluster, tmp_path):
    bad = route()
    bad[544] = torch.nan
    assert 544 not in Sample.of_route(Layout(PLACES), CHUNK).frame
    with refused("frames 500 to 599", "read on", "frame 544", "500 of 620"):
        learned(bad, checkpoint=Checkpoint(tmp_path / "m"), map_tasks=cluster.map)


def found_by(model, queries, search=None):
    if search is not None:
        model.searcher = search
    match, best = model.localize(queries), model.candidates(queries, 4, apart=3)
    return [match.index, match.score, *best, match.accepted]


def test_parts_of_a_map_on_workers_find_what_the_whole_does(cluster):
    # with ties between the chunks of one part, and of both
    again = torch.cat([route() * (1 + i / 9) for i in range(64 // 8)], 1)[:500].repeat(20, 1)
    steps = {0.3: (CHUNK, again), 0.2: (40, again[:600])}
    models = [
        DejaVu(None, "none", SpectralMapper(None, step, chunk)).learn(rows)
        for step, (chunk, rows) in steps.items()
    ]
    model = merge(models, ["one", "two"])
    queries = torch.cat([again[:90:7], again[480:700:9] + 0.1, again[:500:31]])
    whole = found_by(model, queries)
    search = ClusterSearch(cluster, model.map)
    assert len(search.actors) == 2
    found = found_by(model, queries, search)
    assert torch.allclose(found[1], whole[1], atol=1e-5)
    assert torch.allclose(found[3], whole[3], atol=1e-5)
    assert (found[0] == whole[0]).float().mean() > 0.9  # of places whose scores differ by rounding, any


def test_a_part_scores_as_in_the_whole_map(monkeypatch):
    settings = None, "none", SpectralMapper(6.0, chunk=CHUNK)
    models = [DejaVu(*settings).learn(route()[i:] + i) for i in (0, 300)]  # of other means
    whole, queries = merge(models, ["one", "two"]).map, route()[:3]
    assert isinstance(whole, SpectralMap)
    for first, last in ((0, 3), (2, 9), (11, 17), (13, len(whole.chunks))):
        part = whole.between(first, last)
        expected = whole.scores(queries)[:, whole.chunks[first][0] : whole.chunks[last - 1][1]]
        assert torch.allclose(part.scores(queries), expected, atol=1e-6)


def test_probabilities_are_those_of_the_whole_map_whatever_happens_to_a_worker(cluster):
    torch.manual_seed(0)
    views = LabelledFrames(ArrayTraverse(route() + 0.3 * torch.randn(PLACES, 8)), torch.arange(PLACES))
    model = DejaVu(None, "none", SpectralMapper(6.0, chunk=CHUNK), precision=0.9).learn(route())
    model.calibrate(None, views)
    queries = route()[::5] + 0.4 * torch.randn(PLACES // 5, 8)
    whole = model.localize(queries)
    search = ClusterSearch(cluster, model.map)
    model.searcher = search
    assert whole.probability is not None
    for killed in (False, True):
        found = model.localize(queries)
        assert found.probability is not None
        assert torch.allclose(found.probability, whole.probability, atol=1e-3)
        assert torch.equal(found.accepted, whole.accepted)
        assert torch.equal(found.index, whole.index)
        if not killed:
            process = search.actors[0].__ray_call__.remote(lambda _: os.getpid())
            os.kill(cluster.ray.get(process), signal.SIGKILL)
    assert 0 < int(whole.accepted.sum()) < len(queries)
    with refused("templates", "spectral"):
        ClusterSearch(
            cluster, template_model(Fixed(FrequencyLayer(7, 7, 0, 70, (0,)))).learn(route()[:70]).map
        )


def test_a_short_route_starts_no_cluster(tmp_path, capsys):
    np.save(tmp_path / "route.npy", route()[:64])
    command = ("learn", tmp_path / "route.npy", "--map", tmp_path / "map.safetensors", "--mapper.chunk", "50")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clustering, "Cluster", None)
        run(*command, "--calibration", "none", "--cluster", "auto")
    assert "is not used for 64 frames" in capsys.readouterr().out


def test_a_cluster_that_is_not_there_is_refused(tmp_path, capsys):
    command = ("learn", "sim:aerial?frames=64", "--map", tmp_path / "map.safetensors")
    chunked = (*command, "--mapper.chunk", "50")
    assert "--device" in fails(capsys, *chunked, "--cluster", "auto", "--device", "cuda")
    found = ("localize", "map.safetensors", "sim:aerial", "--out", tmp_path / "m.csv", "--cluster", "auto")
    assert "--match filter" in fails(capsys, *found, "--filter")
    assert "--match sequence:5" in fails(capsys, *found, "--match", "sequence:5")
    assert "TemplateMapper" in fails(capsys, *command, "--config", "local_maxima", "--cluster", "auto")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "ray", None)
        assert "pip install 'dejavu_torch[cluster]'" in fails(capsys, *chunked, "--cluster", "auto")
