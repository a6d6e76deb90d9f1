"""Runs readers on mutated inputs, and tells what went wrong: `python -m tests.fuzz --cases 20000`.

Every case is known by reader, seed and number, and runs in a folder of its own in a process forked from this
one, with 4 GiB more address space than it begins with and 20 s of CPU. A process that dies is a finding
of the case it died of, and another goes on behind it.

What counts as a finding:

- any exception but InputError;
- a message of more than one line, a warning or a traceback that is printed;
- more time or memory than that; the end of the process;
- files that are left, temporary ones among them;
- files that were there and are changed: inputs, and the user's own;
- what a reader itself finds: damage that changes what is read, values out of range.
"""

from __future__ import annotations

import argparse
import gc
import logging
import multiprocessing
import os
import resource
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter, defaultdict
from contextlib import ExitStack, suppress
from pathlib import Path
from random import Random
from typing import NamedTuple

import torch

import dejavu_torch
from dejavu_torch import cli, memory
from dejavu_torch.data.output import PREFIX
from dejavu_torch.maps import codec
from dejavu_torch.types import InputError

from .readers import READERS, Case, Wrong

CPU, WALL = 20, 90  # seconds of a case
SILENT = 300  # seconds after which a process that says nothing is ended
MEMORY = 4 * 2**30  # bytes of a case
GROWN = 2**29  # bytes by which a process may have grown when it goes on to another case
MOST = 300  # characters of a message
PACKAGE = Path(dejavu_torch.__file__).parent
BYSTANDER = f"{PREFIX}notes"  # a folder of the user's own


class Finding(NamedTuple):
    """kind: the exception, or what else is wrong. where: the innermost frame of the package."""

    kind: str
    where: str
    message: str


class Result(NamedTuple):
    """outcome: accepted or refused, or broken where there are findings."""

    case: int
    outcome: str
    findings: list[Finding]


class Hang(BaseException):
    """A case that takes too long; no handler of `Exception` may stop it."""


# in the forked process ----------------------------------------------------------------------------------


def _run_case(reader, seed, number, root):
    """One case, whatever it does."""
    shutil.rmtree(root / "work", ignore_errors=True)
    folder = root / "work" / "a" / "b" / "case"  # so deep that ../.. is still inside
    temporary = root / "tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    for made in (folder / "in", folder / "out", temporary):
        made.mkdir(parents=True)
    for place in (folder, folder / "out"):
        (place / BYSTANDER).mkdir()
        (place / BYSTANDER / "x").write_text("of the user")
    os.chdir(folder)
    random = Random(f"{seed}/{reader.name}/{number}")
    torch.manual_seed(number)
    case = Case(random, folder, root / "made")
    outcome, findings = "accepted", []
    for output in (1, 2):
        os.ftruncate(output, 0)
    before = {}
    case.begin = lambda: before.update(_files(root / "work"))
    signal.setitimer(signal.ITIMER_PROF, CPU)
    signal.setitimer(signal.ITIMER_REAL, WALL)
    try:
        with warnings.catch_warnings():  # each is told once a case, not once a process
            reader.run(case)
    except InputError as error:
        outcome = "refused"
        if len(str(error).splitlines()) != 1:
            findings.append(_finding(error, "message of several lines"))
    except Wrong as error:
        findings.append(Finding("wrong", str(error).partition(":")[0], str(error)[:MOST]))
    except BaseException as error:
        findings.append(_finding(error, type(error).__name__))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    sys.stdout.flush()
    sys.stderr.flush()
    findings += _told(root) if not findings else []
    findings += _left(root, outcome, before, temporary) if before else []
    return Result(number, "broken" if findings else outcome, findings)


def _finding(error, kind):
    where = ""
    for frame in traceback.extract_tb(error.__traceback__):
        if Path(frame.filename).is_relative_to(PACKAGE):
            where = f"{Path(frame.filename).relative_to(PACKAGE)}:{frame.lineno} {frame.name}"
    return Finding(kind, where, str(error)[:MOST])


def _told(root):
    """What is wrong with what a case wrote to stderr; lines of C code, as libtiff's, cannot be turned off."""
    text = (root / "stderr").read_text(errors="replace")
    said = [line for line in text.splitlines() if any(word in line for word in ("Warning: ", "Traceback"))]
    return [Finding("stderr", said[0][:100], text[: 2 * MOST])] if said else []


def _left(root, outcome, before, temporary):
    """What is wrong with the files after a case."""
    if any(temporary.iterdir()):
        gc.collect()  # a tensor that is kept in a temporary file
    left = [path.name for path in temporary.iterdir()]
    findings = [Finding("temporary file left", "", str(left))] if left else []
    after = _files(root / "work")
    new = sorted(name for name in after if name not in before)
    changed = [name for name in before if after.get(name, "gone") != before[name]]
    if new:
        findings.append(Finding(f"file left where {outcome}", "", str(new)[:MOST]))
    if changed:
        findings.append(Finding("input changed", "", str(changed)[:MOST]))
    return findings


def _files(folder):
    """Every file and folder by its path, and the size and time of files."""
    found = {}
    for path in folder.rglob("*"):
        status = path.lstat()
        told = None if stat.S_ISDIR(status.st_mode) else (status.st_size, status.st_mtime_ns)
        found[str(path.relative_to(folder))] = told
    return found


def _address_space():
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _prepare(root):
    """Outputs, timers, warnings and paths of a forked process."""

    def hang(number, _):
        raise Hang(f"over {CPU} s of CPU" if number == signal.SIGPROF else f"over {WALL} s")

    signal.signal(signal.SIGPROF, hang)
    signal.signal(signal.SIGALRM, hang)
    for output, name in ((1, "stdout"), (2, "stderr")):
        file = os.open(root / name, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_TRUNC)
        os.dup2(file, output)
    sys.stdout = open(1, "w", encoding="utf-8", errors="surrogateescape", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", 1, encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    logging.getLogger().handlers.clear()
    cli._log_to_stderr()
    os.environ["TMPDIR"] = tempfile.tempdir = str(root / "tmp")
    os.environ["MPLCONFIGDIR"] = str(root / "matplotlib")
    torch.set_num_threads(1)


def _work(reader, seed, numbers, root, told):
    """Run cases, telling of each when it begins and when it has ended."""
    _prepare(root)
    for maker in reader.makers:
        folder = root / "made" / maker.__name__
        if not folder.exists():
            (root / "tmp").mkdir(exist_ok=True)
            shutil.rmtree(root / "making", ignore_errors=True)
            (root / "making").mkdir()
            folder.parent.mkdir(exist_ok=True)
            torch.manual_seed(0)
            maker(root / "making")
            (root / "making").rename(folder)
    base = _address_space()
    resource.setrlimit(resource.RLIMIT_AS, (base + MEMORY, resource.RLIM_INFINITY))
    system = memory.free_memory
    memory.free_memory = codec.free_memory = lambda: min(system(), base + MEMORY - _address_space())
    for number in numbers:
        told.send(number)
        result = _run_case(reader, seed, number, root)
        told.send(result)
        if any(f.kind in ("Hang", "MemoryError") for f in result.findings) or _address_space() > base + GROWN:
            return  # the next case in a process that has nothing of this one


# in this process ----------------------------------------------------------------------------------------


def run(reader, seed, numbers, root):
    """The results of the cases of a reader, in order."""
    waiting, forked = list(numbers), multiprocessing.get_context("fork")
    while waiting:
        reading, writing = forked.Pipe(duplex=False)
        child = forked.Process(target=_work, args=(reader, seed, waiting, root, writing))
        child.start()
        writing.close()
        begun = None
        with suppress(EOFError):
            while reading.poll(SILENT):
                message = reading.recv()
                begun = message if isinstance(message, int) else None
                if begun is None:
                    waiting.remove(message.case)
                    yield message
            child.kill()  # it says nothing any more
        child.join()
        text = (root / "stderr").read_text(errors="replace")
        if begun is not None:
            waiting.remove(begun)
            how = "killed" if (child.exitcode or 0) < 0 else "ended"
            finding = Finding(f"process {how} {abs(child.exitcode or 0)}", "", text[-2 * MOST :])
            yield Result(begun, "broken", [finding])
        elif child.exitcode:
            raise RuntimeError(f"{reader.name} made no input: {text[-3000:]}")


def main(arguments=None):
    """The command; 1 where there are findings."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=300, help="of all readers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", action="append", choices=[*READERS], help="only this; may be given again")
    parser.add_argument("--case", type=int, help="only the case of this number, and all that it says")
    parser.add_argument("--keep", type=Path, help="a folder to leave the case's files in")
    chosen = parser.parse_args(arguments)
    print("reader               cases  accepted  refused  findings  seconds", flush=True)
    distinct = defaultdict(list)
    total = Counter()
    with ExitStack() as stack:
        root = chosen.keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fuzz-")))
        root.mkdir(exist_ok=True)
        readers = [READERS[name] for name in chosen.reader or READERS]
        for reader in readers:
            count = chosen.cases * reader.share / sum(one.share for one in readers)
            numbers = range(max(1, round(count))) if chosen.case is None else [chosen.case]
            outcomes, began = Counter(cases=len(numbers)), time.perf_counter()
            for result in run(reader, chosen.seed, numbers, root.resolve()):
                outcomes[result.outcome] += 1
                for finding in result.findings:
                    distinct[finding.kind, finding.where].append((reader.name, result.case, finding))
            total += outcomes
            print(_row(reader.name, outcomes), f"{time.perf_counter() - began:8.1f}", flush=True)
    print(_row("all", total))
    for (kind, where), found in sorted(distinct.items(), key=lambda item: -len(item[1])):
        name, case, finding = found[0]
        print(f"\n{len(found)} x {kind} {where}\n    {finding.message!r}")
        print(f"    python -m tests.fuzz --seed {chosen.seed} --reader {name!r} --case {case}")
        others = sorted({one for one, _, _ in found} - {name})
        if others:
            print(f"    also of {', '.join(others)}")
    return 1 if distinct else 0


def _row(name, counts):
    cases, accepted, refused, broken = (counts[one] for one in ("cases", "accepted", "refused", "broken"))
    return f"{name:<20} {cases:5}  {accepted:8}  {refused:7}  {broken:8}"
