"""`dejavu learn` of long routes: what a kill leaves, and what comes of it."""

from __future__ import annotations

import errno
import signal
import subprocess
import time

import numpy as np
import pytest
import torch
from command_line import fails, frames, run, write_images
from processes import PACKAGE, Forked

from dejavu_torch.cli import main
from dejavu_torch.learning import ChunkEncoder
from dejavu_torch.model import DejaVu

# more than the sample, of which features are ready
CHUNKED = ("--mapper.chunk", "250", "--mapper.route_bytes_per_place", "2")
LONG, NUMBERS = 16_100, 8


@pytest.fixture(scope="module")
def route(tmp_path_factory):
    noise = torch.randn(LONG + 19, NUMBERS, generator=torch.Generator().manual_seed(0))
    smooth = 9 * torch.nn.functional.avg_pool1d(noise.T[:, None], 20, 1)[:, 0].T
    path = tmp_path_factory.mktemp("route") / "route.npy"
    np.save(path, smooth.numpy())
    return path


@pytest.fixture(scope="module")
def whole(route):
    """The map of a run that nothing disturbs."""
    path = route.with_name("whole.safetensors")
    main(["learn", str(route), "--map", str(path), *CHUNKED])
    return path


def test_a_killed_run_goes_on_where_it_was(route, whole, tmp_path, monkeypatch):
    out, part = tmp_path / "route.safetensors", tmp_path / "route.safetensors.part"
    words = ["learn", str(route), "--map", str(out), *CHUNKED]
    program = "import sys; from dejavu_torch import learning; learning.SAVE_INTERVAL = 0; "
    program += f"from dejavu_torch.cli import main; main({words!r})"
    process = Forked(program, imports=PACKAGE, stdout=subprocess.DEVNULL)
    stop = time.monotonic() + 120
    while not part.exists() and time.monotonic() < stop:
        time.sleep(0.001)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert not out.exists()
    began = []

    encode = ChunkEncoder.__call__

    def noted(encoder, frames):
        began.append(frames.start)
        return encode(encoder, frames)

    monkeypatch.setattr(ChunkEncoder, "__call__", noted)
    run(*words)
    assert 0 < began[0] < LONG
    assert out.read_bytes() == whole.read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == [out.name]


def test_another_command_does_not_take_over_what_is_finished(route, whole, tmp_path, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, "full")

    out, part = tmp_path / "route.safetensors", tmp_path / "route.safetensors.part"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DejaVu, "save", full)
        assert "full" in fails(capsys, "learn", route, "--map", out, *CHUNKED)
    kept = part.read_bytes()
    error = fails(capsys, "learn", route, "--map", out, *CHUNKED[:2], "--mapper.route_bytes_per_place", "3")
    assert str(part) in error
    assert "settings" in error
    assert "removed" in error
    error = fails(capsys, "learn", f"{route}?stop=600", "--map", out, *CHUNKED)
    assert str(part) in error
    assert "another run" in error
    assert part.read_bytes() == kept
    run("learn", route, "--map", out, *CHUNKED)
    assert out.read_bytes() == whole.read_bytes()
    assert not part.exists()


def test_several_sources_are_one_route(tmp_path):
    images = frames(60, size=16)
    every = write_images(tmp_path / "every", images)
    parts = write_images(tmp_path / "a", images[:25]), write_images(tmp_path / "b", images[25:])
    settings = ("--whitening", "none", "--calibration", "none", "--mapper.route_bytes_per_place", "20")
    run("learn", *parts, "--map", tmp_path / "parts.safetensors", *settings)
    run("learn", every, "--map", tmp_path / "every.safetensors", *settings)
    one, other = (DejaVu.load(tmp_path / f"{name}.safetensors") for name in ("parts", "every"))
    assert one.frame_names[24:26] == ["a/24.png", "b/0.png"]
    assert one.map.places == other.map.places == 60
    queries = torch.rand(3, 1, 16, 16)
    assert torch.allclose(one(queries), other(queries), atol=0.05)
