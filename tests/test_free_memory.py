from __future__ import annotations

from pathlib import Path

import pytest

from dejavu_torch import memory
from dejavu_torch.memory import check_room, free_memory
from dejavu_torch.types import InputError


def test_what_does_not_fit_is_refused_with_both_numbers(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 2e9)
    check_room(2e9, "a strip")
    with pytest.raises(InputError, match=r"^a strip takes 3.5 GB; expected at most the 2 GB free$"):
        check_room(3.5e9, "a strip")


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="this system does not say what is available")
def test_what_the_system_has_available_is_free():
    assert 2**20 < free_memory() < 2**60
