"""Output files: whole or not at all."""

from __future__ import annotations

import errno
import os
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import refused

from dejavu_torch.data.files import (
    check_output_file,
    check_regular,
    make_output_folder,
    read_text,
    reading,
    whole_file,
)
from dejavu_torch.types import InputError


def full_disk(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_new_file_appears_whole(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    with whole_file(target) as temporary:
        temporary.write_text("first half, ")
        assert not target.exists()
        temporary.write_text("all of it")
    assert target.read_text() == "all of it"
    assert list(tmp_path.iterdir()) == [target]


def test_the_temporary_file_lies_beside_its_target_and_keeps_the_suffix(tmp_path: Path) -> None:
    with whole_file(tmp_path / "curve.png") as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".png")
        temporary.touch()


@pytest.mark.parametrize("before", ["", "old"])
@pytest.mark.parametrize("problem", [RuntimeError("bug"), KeyboardInterrupt(), InputError("bad")])
def test_an_exception_leaves_what_was_there(tmp_path: Path, before: str, problem: BaseException) -> None:
    target = tmp_path / "a.txt"
    if before:
        target.write_text(before)

    def write_half() -> None:
        with whole_file(target) as temporary:
            temporary.write_text("half")
            raise problem

    with pytest.raises(type(problem)):
        write_half()
    assert [file.read_text() for file in tmp_path.iterdir()] == [before] * bool(before)


def test_a_full_disk_while_writing_is_one_line(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with refused(str(target), "No space left on device"), whole_file(target) as temporary:
        temporary.write_text("half")
        full_disk()
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"a.txt": "old"}


def test_a_full_disk_while_renaming_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    monkeypatch.setattr(Path, "replace", full_disk)
    with refused(str(target), "No space left on device"), whole_file(target) as temporary:
        temporary.write_text("new")
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"a.txt": "old"}


@pytest.mark.parametrize("check", [check_output_file, lambda path: whole_file(path).__enter__()])
def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path, check: object) -> None:
    assert callable(check)
    with refused(str(tmp_path), "folder"):
        check(tmp_path)
    with refused("missing", "does not exist"):
        check(tmp_path / "missing" / "a.txt")
    (tmp_path / "file").touch()
    with refused("file"):
        check(tmp_path / "file" / "a.txt")


def test_output_folders_are_made_with_their_parents(tmp_path: Path) -> None:
    make_output_folder(tmp_path / "a" / "b")
    make_output_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


@pytest.mark.parametrize("path", ["file", "file/below"])
def test_an_output_folder_that_is_a_file_is_refused(tmp_path: Path, path: str) -> None:
    (tmp_path / "file").touch()
    with refused("file"):
        make_output_folder(tmp_path / path)


def test_messages_are_one_line_whatever_a_name_holds() -> None:
    message = str(InputError("a\nb\r\x1b[2J\udcff\u202e.png is no image"))
    assert message == r"a\nb\r\x1b[2J\udcff\u202e.png is no image"
    assert message.encode()
    long = str(InputError("seen " + "x" * 10**5 + "; expected less"))
    assert (len(long) < 2100, long[:5], long[-15:]) == (True, "seen ", "; expected less")


@pytest.mark.parametrize("read", [check_regular, read_text])
def test_what_is_no_regular_file_is_not_waited_for(
    tmp_path: Path, read: Callable[[Path, str], object]
) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name, seen in (("fifo", "no regular file"), ("device", "no regular file"), (".", "directory")):
        with refused(seen, "expected lines"):
            read(tmp_path / name, "lines")
    for name in ("a\0b", "a" * 5000):
        with refused("cannot be read", "expected lines"):
            read(tmp_path / name, "lines")


def test_whatever_a_decoder_raises_is_one_refusal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a").touch()
    for problem in (struct.error("x\ny"), KeyError(3), MemoryError(), OverflowError("big"), RecursionError()):
        with refused("a is broken", "expected better"), reading(tmp_path / "a", "is broken", "better"):
            warnings.warn("more lines", UserWarning, stacklevel=1)
            raise problem
    with refused("as it is"), reading(tmp_path / "a", "is broken", "better"):
        raise InputError("as it is")
    assert capsys.readouterr().err == ""


def test_a_text_larger_than_the_memory_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as file:
        file.truncate(2**40)
    with refused("the text of", "GB free"):
        read_text(tmp_path / "a", "lines")
