"""What is read is a regular file, and what a decoder raises is one line."""

from __future__ import annotations

import os

import pytest
from helpers import refused

from dejavu_torch.data.files import check_regular


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing", "is not there"),
        ("", "a folder"),
        ("fifo", "not a regular file"),
        ("a\0b", "null"),
        ("x" * 5000, "too long"),
    ],
    ids=["missing", "directory", "fifo", "null", "long"],
)
def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path, name, words):
    os.mkfifo(tmp_path / "fifo")
    with refused(words, "expected a text"):
        check_regular(tmp_path / name, "a text")
