from __future__ import annotations

from pathlib import Path

import pytest
from processes import python

from dejavu_torch import memory
from dejavu_torch.memory import check_room, free_memory
from dejavu_torch.types import InputError


def test_what_does_not_fit_is_refused_with_both_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free_memory", lambda: 2e9)
    check_room(2e9, "a strip")
    with pytest.raises(InputError, match=r"^a strip takes 3.5 GB; expected at most the 2 GB free$"):
        check_room(3.5e9, "a strip")


def test_the_limits_of_the_groups_around_a_job_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, inside = tmp_path / "own", tmp_path / "slurm" / "job" / "step"
    monkeypatch.setattr(memory, "CGROUPS", tmp_path)
    monkeypatch.setattr(memory, "OWN_CGROUP", own)
    own.write_text("4:memory:/elsewhere\n0::/slurm/job/step\n")
    inside.mkdir(parents=True)
    assert 2**20 < free_memory() < 2**60
    for group, limit in ((inside, "max"), (inside.parent, "3000000"), (inside.parents[1], "9000000")):
        (group / "memory.max").write_text(f"{limit}\n")
        (group / "memory.current").write_text("1000000\n")
        (group / "memory.stat").write_text("anon 9\ninactive_file 400000\n")
    assert free_memory() == 2.4e6  # what caches hold is free
    own.write_text("0::/slurm/../..\n")
    assert free_memory() > 2.4e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="this system does not say what is taken")
def test_the_limit_of_the_process_counts() -> None:
    code = (
        "import resource; from dejavu_torch.memory import free_memory;"
        "resource.setrlimit(resource.RLIMIT_AS, (2**36, resource.RLIM_INFINITY));"
        "assert free_memory() < 2**36; print(free_memory())"
    )
    assert 0 < float(python(code).stdout) < 2**36
