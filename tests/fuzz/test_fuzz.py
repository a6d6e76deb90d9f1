"""60 cases of the fuzz, and that it finds what there is to find."""

from __future__ import annotations

from pathlib import Path

import pytest
from processes import PACKAGE, python

ROOT = Path(__file__).parents[2]
PARTED = "and now the mistakes"
BOTH = f"""
import os, shutil, signal, sys
from pathlib import Path
from dejavu_torch.types import InputError
from tests.fuzz import readers, runner

def crash(case): os.kill(os.getpid(), signal.SIGSEGV)
def end(case): os._exit(0)
def spin(case):
    while True: pass
def take(case): bytearray(8 * 2**30)
def raise_key(case): raise KeyError("seen")
def status(case): raise SystemExit(3)
def warn(case): print("Traceback of another library", file=sys.stderr)
def half(case): case.begin(); Path("out/.dejavu-x1").mkdir()
def refuse(case): case.begin(); Path("out/m").touch(); raise InputError("refused")
def change(case): Path("in/m").touch(); case.begin(); Path("in/m").write_text("x")
def wrong(case): raise readers.Wrong("damage")
def remove(case): case.begin(); shutil.rmtree(".dejavu-notes")
def well(case): case.begin()

found = runner.main(["--cases", "60"])
print("status", found)
print("{PARTED}")
runner.CPU = 0.3
readers.READERS.clear()
for name in sys.argv[1:]:
    readers.reader(name)(globals()[name])
sys.exit(runner.main(["--cases", str(2 * len(readers.READERS))]))
"""


ERRORS = ("crash", "end", "spin", "take", "raise_key", "status", "warn")
WRONG = (*ERRORS, "half", "refuse", "change", "remove", "wrong")
EVERY = (*WRONG, "well")


@pytest.fixture(scope="module")
def told():
    """What a run prints of the readers, and of the mistakes: in a process of its own, as one that has
    computed in threads cannot be forked."""
    done = python(BOTH, *EVERY, cwd=ROOT, imports=PACKAGE)
    assert done.returncode == 1, done.stdout[-5000:] + done.stderr[-5000:]
    cases, parted, mistakes = done.stdout.partition(PARTED)
    assert parted, done.stdout[-5000:] + done.stderr[-5000:]
    return cases, mistakes


def test_no_case_goes_wrong(told):
    assert told[0].endswith("status 0\n"), told[0][-5000:]


def test_every_mistake_is_found(told):
    rows = [line.split() for line in told[1].splitlines()]
    broken = {row[0]: row[1:5] for row in rows if len(row) == 6 and row[1] == "2"}
    assert broken == {name: ["2", "0", "0", "2"] if name in WRONG else ["2", "2", "0", "0"] for name in EVERY}
    for kind in ("process killed 11", "Hang", "MemoryError", "KeyError", "SystemExit", "stderr"):
        assert f"2 x {kind}" in told[1]
    assert "python -m tests.fuzz --seed 0 --reader 'raise_key' --case 0" in told[1]
