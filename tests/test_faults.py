"""What processes leave where they are interrupted, killed or out of room: old files or whole ones."""

from __future__ import annotations

import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import fails, frames, run, write_images
from processes import PACKAGE, Forked

from dejavu_torch import DejaVu

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="mounts and signals of Linux")
DEJAVU = (sys.executable, "-m", "dejavu_torch.cli")
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
INTERRUPTED = b"dejavu: interrupted\n"
REPORT = {"index.html", "report.json", "matches.csv", "map.safetensors", "pr.png", "coverage.png"}
PLAIN = ("--whitening.views", "1", "--whitening.bits", "4")  # little time, and small maps
REPORT_OF_ARRAYS = ("compare", "a.npy", "b.npy", *PLAIN, "--truth", "0", "--out", "new/report")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    np.save(folder / "a.npy", frames(64))
    np.save(folder / "b.npy", frames(64, seed=1))
    run("learn", folder / "a.npy", "--map", folder / "map.safetensors", *PLAIN, "--mapper.chunk", "64")
    return folder


@pytest.fixture
def folder(made, tmp_path):
    """A folder of its own with arrays and their map."""
    for file in made.iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path


def start(folder, *words):
    return Forked("from dejavu_torch.cli import main; main()", *words, imports=PACKAGE, cwd=folder, **PIPES)


def wait_for(process, there):
    late = time.monotonic() + 60
    while not there():
        assert process.poll() is None, process.communicate()
        if time.monotonic() > late:
            process.kill()
            pytest.fail(f"it never came to it: {process.communicate()}")
        time.sleep(0.01)


def in_hand(process):
    """Whether the command handles its signals; the start of Python itself is beyond it."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    (caught,) = (int(line.split()[1], 16) for line in lines if line.startswith("SigCgt"))
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def forked(work):
    """The number of a process that does this: torch takes seconds to import in one that is started."""
    child = os.fork()
    if child:
        return child
    try:
        torch.set_num_threads(1)  # those of OpenMP do not survive a fork
        work()
    except SystemExit as stop:
        sys.stderr.flush()
        os._exit(stop.code)  # type: ignore[arg-type]
    except BaseException:
        os._exit(1)
    os._exit(0)


def names_in(folder):
    return {file.name for file in folder.iterdir()} if folder.exists() else set()


# interrupts


def test_ctrl_c_at_any_moment_is_one_line_and_130(folder):
    moments = [0, 0.7, 1.6]
    before = names_in(folder)
    for twice, moment in enumerate(moments):
        # which imports torch, as the earlier moments find it
        process = subprocess.Popen([*DEJAVU, *REPORT_OF_ARRAYS], cwd=folder, **PIPES)
        wait_for(process, lambda process=process: in_hand(process))
        time.sleep(moment)
        process.send_signal(signal.SIGINT)
        if twice % 2:
            process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        if process.returncode == 0:  # it was done
            assert (said, names_in(folder / "new" / "report") >= REPORT) == (b"", True)
            shutil.rmtree(folder / "new")
        assert (process.returncode, said) in ((130, INTERRUPTED), (0, b"")), moment
        assert names_in(folder) == before


@pytest.mark.parametrize(
    ("number", "status", "said"), [(signal.SIGINT, 130, INTERRUPTED), (signal.SIGTERM, 143, b"")]
)
def test_a_file_that_is_half_written_goes_and_the_old_one_stays(folder, number, status, said):
    (folder / "m.csv").write_text("old")
    np.lib.format.open_memmap(folder / "long.npy", "w+", np.uint8, (100_000, 32, 32)).flush()  # takes no room
    before = names_in(folder)
    process = start(folder, "localize", "map.safetensors", "long.npy", "--out", "m.csv")
    wait_for(process, lambda: list(folder.glob(".dejavu-*/*")))
    process.send_signal(number)
    assert process.communicate(timeout=60)[1] == said
    assert (process.returncode, names_in(folder)) == (status, before)
    assert (folder / "m.csv").read_text() == "old"


def test_what_a_writer_could_not_take_is_refused_ahead_of_the_work(folder, capsys):
    os.mkfifo(folder / "fifo.safetensors")
    (folder / "link").symlink_to("nowhere")
    before = names_in(folder)
    for out, words in (("fifo.safetensors", "expected"), ("a" * 244 + ".safetensors", "too long")):
        assert words in fails(capsys, "learn", "sim:aerial?frames=100000", "--map", folder / out)
    for out in ("fifo.safetensors", "link", "/dev/null"):
        error = fails(capsys, "compare", *["sim:aerial?frames=100000"] * 2, "--out", folder / out)
        assert "expected" in error
    assert names_in(folder) == before
    assert (folder / "fifo.safetensors").is_fifo()


def test_a_file_that_gets_what_is_printed_is_no_output(folder):
    with (folder / "said.txt").open("w") as stdout:
        pipes = {"stdout": stdout, "stderr": subprocess.PIPE}
        words = [*DEJAVU, "localize", "map.safetensors", "b.npy", "--out", "/dev/stdout"]
        done = subprocess.run(words, cwd=folder, **pipes)
    assert done.returncode == 2
    assert b"/dev/stdout is a standard stream of this process" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        "localize map.safetensors b.npy --out map.safetensors",
        "localize map.safetensors b.npy?start=3 --out ./b.npy",
        "localize map.safetensors images?width=8 --out images/0.png",
        "localize map.safetensors b.npy --out b.txt",
        "localize map.safetensors b.npy --out new.csv --pairs map.safetensors",
        "localize map.safetensors b.npy?start=3 --out new.csv --pairs ./b.txt",
        "learn link.npy --map link.safetensors",
        "learn a.npy --second b.npy --second_truth link.safetensors --map link.safetensors",
        "learn a.npy --whitening map.safetensors --map ./map.safetensors",
        "compare a.npy b.npy --whitening report/map.safetensors --out report",
        "compare a.npy b.npy --truth report/matches.csv --out report",
        "evaluate m.csv --truth 0 --reference strip:report/pr.png?width=8 --out report",
        "demo --second images --out images",
    ],
)
def test_an_output_that_is_what_is_read_is_refused_and_stays(folder, words, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    for name in ("npy", "safetensors"):
        (folder / f"link.{name}").symlink_to("b.npy")
    (folder / "report").mkdir()
    shutil.copy("map.safetensors", "report")
    shutil.copy(write_images(folder / "images", frames(2)) / "0.png", "report/pr.png")
    (folder / "report" / "matches.csv").write_text("query,place\n0,0\n")
    shutil.copy("report/matches.csv", "m.csv")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert "is an input; expected another" in fails(capsys, *words.split())
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


# kills


def mounted(folder, options, *commands):
    """The lines that commands say behind one another with a small disk at `disk`, by themselves, and one that
    can only be read at `sealed`."""
    probe = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"]
    if subprocess.run(probe, capture_output=True).returncode:
        pytest.skip("nothing can be mounted here")
    (folder / "disk").mkdir()
    (folder / "sealed").mkdir()
    mounts = f"mount -t tmpfs -o {options} none disk", "mount -t tmpfs -o ro none sealed"
    script = "; ".join([*mounts, *commands])
    done = subprocess.run(
        ["unshare", "-rm", "bash", "-c", script], cwd=folder, capture_output=True, text=True
    )
    return [*done.stdout.splitlines(), *done.stderr.splitlines()]


def commands_of_one_process(*lines):
    """For a shell: commands, and behind a `!` lines of a shell, in one process, which loads torch once and
    whose pictures are bytes without their drawing."""
    code = (
        "import os, sys; from dejavu_torch.cli import main; from dejavu_torch.evaluation import report\n"
        "report.as_png = lambda picture: bytes(5000)\n"
        "for line in sys.argv[1:]:\n"
        "    try: os.system(line[1:]) if line[0] == '!' else main(line.split())\n"
        "    except SystemExit as stop: print('status', stop.code, flush=True)"
    )
    return shlex.join([sys.executable, "-c", code, *lines])


def test_a_disk_that_is_full_or_sealed_is_one_line_and_leaves_what_was_there(folder):
    """A sealed one is told ahead of the work."""
    plain = " ".join(PLAIN)
    words = commands_of_one_process(
        f"compare a.npy b.npy {plain} --truth 0 --out disk/old",
        "!dd if=/dev/zero of=disk/full bs=1k count=64 status=none 2> /dev/null",
        f"learn a.npy {plain} --map disk/map.safetensors",
        "learn b.npy --append disk/map.safetensors",
        "learn sim:aerial?frames=1000000 --map sealed/map.safetensors",
        "compare a.npy b.npy --out sealed/report",
    )
    found = mounted(
        folder,
        "size=84k",
        "mkdir disk/old; echo old > disk/old/matches.csv; echo old > disk/old/pr.png",
        "cp map.safetensors disk; dd if=/dev/zero of=disk/full bs=1k count=36 status=none",
        f"{words} | grep ^status",
        "find disk -mindepth 1 | sort; cat disk/old/*; cmp map.safetensors disk/map.safetensors",
    )
    said = [line for line in found if line.startswith("dejavu: ")]
    assert [line.rpartition(": ")[2][:13] for line in said[:3]] == ["No space left"] * 3
    assert ["no permission" in line for line in said[3:]] == [True] * 2
    assert [line for line in found if line not in said] == [
        *["status 2"] * 5,
        *("disk/full", "disk/map.safetensors", "disk/old", "disk/old/matches.csv", "disk/old/pr.png"),
        *("old", "old"),
    ]


def test_a_kill_leaves_a_whole_map_and_a_whole_report(folder):
    model, target, moment = DejaVu.load(folder / "map.safetensors"), folder / "out", random.Random(0)
    whole = (folder / "map.safetensors").read_bytes()

    def save_for_ever():
        from dejavu_torch.data.output import whole_folder

        while True:
            model.save(folder / "map.safetensors")
            shutil.rmtree(target, ignore_errors=True)
            with whole_folder(target) as temporary:
                for name in "abc":
                    (temporary / name).write_bytes(whole)

    for _ in range(20):
        child = forked(save_for_ever)
        time.sleep(moment.uniform(0.005, 0.1))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        DejaVu.load(folder / "map.safetensors")
        # fewer are there where the removal was killed, never a part of one
        assert {file.read_bytes() for file in target.glob("*")} <= {whole}
