"""What is read is a regular file, and what a decoder raises is one line."""

from __future__ import annotations

import os
import warnings

import pytest
from helpers import refused

from dejavu_torch import memory
from dejavu_torch.data.files import check_regular, read_text, reading
from dejavu_torch.types import InputError


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


def test_whatever_a_decoder_raises_is_one_line_and_what_it_warns_of_is_none(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"12345")
    (tmp_path / "link").symlink_to(path)
    assert check_regular(tmp_path / "link", "a text") == 5
    for problem in (KeyError("size"), MemoryError(), ZeroDivisionError("a\nb"), OSError(5, "I/O")):
        with refused(str(path), "is no array", "expected one"), reading(path, "is no array", "one"):
            raise problem
    with pytest.raises(InputError, match=r"^ours$"), reading(path, "is no array", "one"):
        raise InputError("ours")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with reading(path, "is no array", "one"):
            warnings.warn("odd", stacklevel=1)


def test_a_text_without_its_mark_and_one_that_is_none(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_bytes(b"\xef\xbb\xbfa\r\nb")
    assert read_text(path, "lines") == "a\nb"
    for content, words in ((b"\xff\xfe1", "UTF-8 text"), (b"a\0b", "null character")):
        path.write_bytes(content)
        with refused(str(path), words, "expected lines"):
            read_text(path, "lines")
    monkeypatch.setattr(memory, "free_memory", lambda: 10.0)
    with refused(str(path), "free"):
        read_text(path, "lines")
