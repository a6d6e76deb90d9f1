"""What processes leave where they are interrupted, killed or out of room: old files or whole ones."""

from __future__ import annotations

import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import fails, frames, run, write_images
from processes import PACKAGE, Forked

from dejavu_torch import DejaVu
from dejavu_torch.cli import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits, mounts and signals of Linux")
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


def ended(work):
    """The status of a process that has done this."""
    return os.waitstatus_to_exitcode(os.waitpid(forked(work), 0)[1])


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


def test_a_training_that_is_interrupted_leaves_a_map(folder):
    (folder / "train.yaml").write_text(
        "model:\n"
        "  class_path: dejavu_torch.TemplateTask\n"
        "  init_args:\n"
        "    backbone:\n"
        "      class_path: dejavu_torch.features.cnn.SmallCNN\n"
        "      init_args: {dimension: 8, channels: 1, resize: [16, 16], widths: [4, 8], squeeze: 4}\n"
        "data: {source: a.npy, batch_size: 20, tolerance: 2}\n"
        "trainer: {max_steps: 1000000, accelerator: cpu, enable_progress_bar: false, default_root_dir: run,\n"
        "  log_every_n_steps: 1}\n"
    )
    process = start(folder, "train", "fit", "--config", "train.yaml")
    wait_for(process, lambda: list((folder / "run").rglob("metrics.csv")))
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=60)
    lines = said.splitlines(keepends=True)
    assert (process.returncode, lines.count(INTERRUPTED)) == (130, 1)
    assert [line for line in lines if not line.startswith(b"dejavu: ")] == []
    assert b"to go on: dejavu train fit" in out
    assert DejaVu.load(folder / "run" / "map.safetensors").trained is not None


def test_a_benchmark_of_memory_that_is_interrupted_leaves_neither_files_nor_a_process(tmp_path, monkeypatch):
    from benchmarks import memory
    from dejavu_torch.cli import process
    from dejavu_torch.data.output import remove_temporaries

    (tmp_path / "tmp").mkdir()
    script = "#!/bin/sh", 'cd "${0%/*}"', "echo $$ > new", "mv new pid", "exec sleep 60"
    (tmp_path / "python").write_text("\n".join(script))
    (tmp_path / "python").chmod(0o700)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))

    def bench():
        process.take_over()
        process.cleanup[:] = [remove_temporaries]
        list(memory.bench_memory([64]))

    child = forked(bench)
    pid = tmp_path / "pid"
    late = time.monotonic() + 60
    while not pid.exists() and time.monotonic() < late:
        time.sleep(0.01)
    assert list(tmp_path.glob("tmp/.dejavu-*/*.npy"))
    os.kill(child, signal.SIGINT)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 130
    assert names_in(tmp_path / "tmp") == set()
    status = Path(f"/proc/{int(pid.read_text())}/status")
    while status.exists() and "State:\tZ" not in status.read_text() and time.monotonic() < late:
        time.sleep(0.01)
    assert time.monotonic() < late


def python(code, *words, **settings):
    """Status and output of code run by another interpreter; torch is not needed for most."""
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, **settings)  # type: ignore[call-overload]
    return done.returncode, done.stdout, done.stderr


def test_ctrl_c_when_all_is_done_changes_nothing():
    late = "import atexit, signal; atexit.register(signal.raise_signal, signal.SIGINT)"
    code = f"{late}\nfrom dejavu_torch.cli import main; main()"
    assert python(code, "--version")[::2] == (0, "")


def test_a_signal_that_is_ignored_stays_so():
    ignore = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"  # as nohup, or a shell's &, does
    code = f"{ignore}\nfrom dejavu_torch.cli import process; process.take_over(); signal.raise_signal(2)"
    assert python(code) == (0, "", "")


def test_where_interrupts_are_raised_the_second_one_ends():
    code = (
        "import signal; from dejavu_torch.cli import process; process.take_over()\n"
        "with process.interrupts_raise():\n"
        "    try: signal.raise_signal(2)\n"
        "    except KeyboardInterrupt: print('kept')\n"
        "    signal.raise_signal(2)\n"
        "print('not reached')"
    )
    assert python(code) == (130, "kept\n", "dejavu: interrupted\n")


def test_an_interrupt_that_was_turned_into_another_exception_is_one():
    code = (
        "import signal; from dejavu_torch import cli\n"
        "def run(given):\n"
        "    with cli.process.interrupts_raise():\n"
        "        try: signal.raise_signal(2)\n"
        "        except KeyboardInterrupt: raise RuntimeError('of an extension')\n"
        "cli.main(program=run)"
    )
    assert python(code) == (130, "", "dejavu: interrupted\n")


# standard streams


def opened(number):
    """A standard stream as Python opens it."""
    try:
        os.fstat(number)
    except OSError:
        return None
    return open(number, "w" if number else "r", closefd=False)


@pytest.mark.parametrize(("redirected", "status"), [("left", 0), ("closed", 0), ("full", 2)])
def test_files_are_written_whatever_becomes_of_what_is_printed(redirected, status, folder, capfd):
    """Where who reads has left, as `head` does, where streams are closed, and where a disk is full."""

    def command():
        os.chdir(folder)
        read, write = os.pipe()
        os.close(read)
        if redirected == "closed":
            os.closerange(0, 3)
        else:
            os.dup2(os.open("/dev/full", os.O_WRONLY) if redirected == "full" else write, 1)
        os.close(write)
        for number, name in enumerate(("stdin", "stdout", "stderr")):
            stream = opened(number)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)
        sys.argv[1:] = ["localize", "map.safetensors", "b.npy", "--out", "m.csv"]
        main()

    assert ended(command) == status
    said = "dejavu: the printed output is incomplete: No space left on device\n"
    assert capfd.readouterr().err == said * (redirected == "full")
    text = (folder / "m.csv").read_text()  # and nothing that was printed
    assert (text[:12], text.count("\n")) == ("query,place,", 65)


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        ("| grep -q usage:", 0, ""),
        ("> /dev/full", 2, "dejavu: the printed output is incomplete: No space left on device\n"),
        ("dance 2>&-", 2, ""),
        ("''", 2, "dejavu: '' is no command; expected one of"),
    ],
)
def test_the_overview_whatever_becomes_of_what_is_printed(words, status, said):
    command = f"set -o pipefail; {' '.join(DEJAVU)} {words}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (status, "", bool(said))
    assert done.stderr.startswith(said)


def test_a_folder_that_is_gone_is_no_traceback(tmp_path):
    code = "import os; os.rmdir(os.getcwd()); from dejavu_torch.cli import main; main()"
    (tmp_path / "gone").mkdir()
    path = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    words = ("learn", "a.npy", "--map", "a.safetensors")
    status, _, said = python(code, *words, cwd=tmp_path / "gone", env=path)
    assert (status, said.count("\n")) == (2, 1)
    assert "current folder" in said


# names


def test_names_that_are_no_text_do_not_fail_a_report(tmp_path):
    for name, seed in ((b"caf\xe9\n\x1b[31m", 1), ("\xe9$_{$".encode(), 2)):
        plain = write_images(tmp_path / f"{seed}", frames(32, seed=seed))
        for image in plain.iterdir():
            os.rename(image, os.fsencode(plain) + b"/\xff\n$_{$" + os.fsencode(image.name))
        plain.rename(Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)))
    words = [b"compare", b"caf\xe9\n\x1b[31m", "\xe9$_{$".encode(), b"--truth", b"0", b"--out", b"out"]
    words += map(os.fsencode, (*PLAIN, "--calibration", "none"))
    (tmp_path / "matplotlibrc").write_text("savefig.dpi: 20")  # names are drawn, in few pixels
    plain_c = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    plain_c["MATPLOTLIBRC"] = str(tmp_path)
    done = subprocess.run([*map(os.fsencode, DEJAVU), *words], cwd=tmp_path, env=plain_c, capture_output=True)
    assert (done.returncode, done.stderr.count(b"\n")) == (0, done.stderr.count(b"dejavu: "))
    assert b"\x1b" not in done.stdout
    assert names_in(tmp_path / "out") >= REPORT
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert page.count(r"caf\udce9\n\x1b[31m") >= 3
    rows = (tmp_path / "out" / "matches.csv").read_text(encoding="utf-8").splitlines()
    assert (len(rows), rows[1].count(r"\udcff\n$_{$")) == (33, 2)


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


def test_a_report_may_lie_beside_what_it_is_of(folder, monkeypatch):
    monkeypatch.chdir(folder)
    run("localize", "map.safetensors", "b.npy", "--out", "m.csv")
    (folder / "0").mkdir()
    run("evaluate", "m.csv", "--truth", "0", "--out", ".")
    run("evaluate", "m.csv", "--truth", "0", "--map", "map.safetensors", "--out", "0")
    assert {"index.html", "m.csv", "map.safetensors"} <= names_in(folder)
    assert "index.html" in names_in(folder / "0")


# no room


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


def test_a_limit_on_files_is_one_line(folder, capfd):
    (folder / "m.csv").write_text("old")
    before = names_in(folder)

    def limited():
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))
        run("localize", "map.safetensors", "b.npy", "--out", "m.csv")

    assert (ended(limited), capfd.readouterr().err) == (2, "dejavu: m.csv was not written: File too large\n")
    assert (names_in(folder), (folder / "m.csv").read_text()) == (before, "old")


# kills


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


def test_two_writers_of_a_map_and_a_folder_both_end_well(folder):
    from dejavu_torch.data.output import whole_file, whole_folder

    def write(text):
        for _ in range(100):
            with whole_file(folder / "one") as temporary:
                temporary.write_text(text)
            with whole_folder(folder / "new") as temporary:
                (temporary / "a").write_text(text)
                (temporary / "b").write_text(text)

    before = names_in(folder)
    children = [forked(lambda text=text: write(text * 10_000)) for text in "xyz"]
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0, 0]
    texts = {text * 10_000 for text in "xyz"}
    assert {(folder / "one").read_text(), (folder / "new" / "a").read_text()} <= texts
    assert names_in(folder) == before | {"one", "new"}
    assert names_in(folder / "new") == {"a", "b"}
