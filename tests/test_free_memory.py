from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dejavu_torch import memory
from dejavu_torch.memory import check_room, free_memory, in_one_thread
from dejavu_torch.types import InputError


def test_what_does_not_fit_is_refused_with_both_numbers(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 2e9)
    check_room(2e9, "a strip")
    with pytest.raises(InputError, match=r"^a strip takes 3.5 GB; expected at most the 2 GB free$"):
        check_room(3.5e9, "a strip")


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="this system does not say what is available")
def test_what_the_system_has_available_is_free():
    assert 2**20 < free_memory() < 2**60


def test_small_operations_are_in_one_thread_and_the_setting_comes_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with in_one_thread(2**20):
            assert torch.get_num_threads() == 2
        with in_one_thread():
            with in_one_thread(7):
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 1  # the inner block does not end the outer one
        with pytest.raises(ZeroDivisionError), in_one_thread():
            1 / 0  # noqa: B018
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
