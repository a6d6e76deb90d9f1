"""Output files: whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest
from helpers import refused

from dejavu_torch.data.output import (
    check_output_file,
    check_output_folder,
    make_output_folder,
    whole_file,
    whole_folder,
)
from dejavu_torch.types import InputError


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


def write(target, text="new"):
    with whole_file(target) as temporary:
        temporary.write_text(text)


def held(folder):
    """The files in a folder, and what they hold."""
    return {file.name: file.read_text() for file in folder.iterdir() if file.is_file()}


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("name", [".mode", ".dejavu-notes", "a" * 255])
def test_a_file_or_folder_of_any_name_appears_whole(tmp_path, name):
    with whole_file(tmp_path / name) as temporary:
        assert (temporary.parent.parent, temporary.name) == (tmp_path, name)
        temporary.write_text("first half, ")
        assert not (tmp_path / name).exists()
        temporary.write_text("new")
    with whole_folder(tmp_path / "a" / "new") as temporary:
        (temporary / name).write_text("new")
        assert not (tmp_path / "a").exists()
    assert held(tmp_path) == held(tmp_path / "a" / "new") == {name: "new"}
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([name, "a"])


def file_in(folder):
    return whole_file(folder / "a")


def whole(folder):
    return whole_folder(folder, ["earlier"])


@pytest.mark.parametrize("problem", [RuntimeError("bug"), KeyboardInterrupt(), InputError("bad")])
@pytest.mark.parametrize(
    ("kind", "before"),
    [(file_in, {}), (file_in, {"a": "old"}), (whole, None), (whole, {"a": "old", "earlier": "old"})],
)
def test_an_exception_leaves_what_was_there(tmp_path, kind, before, problem):
    folder = tmp_path / "new" / "folder"
    if before is not None:
        folder.mkdir(parents=True)
        for name, text in before.items():
            (folder / name).write_text(text)

    def write_half():
        with kind(folder) as temporary:
            (temporary / "a" if temporary.is_dir() else temporary).write_text("half")
            raise problem

    with pytest.raises(type(problem)):
        write_half()
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    assert left == set() if before is None else held(folder) == before
    assert len(left) == (0 if before is None else 2 + len(before))


@pytest.mark.parametrize(
    ("check", "name", "words"),
    [
        (check_output_file, "", "folder"),
        (write, "", "folder"),
        (check_output_file, "missing/a.txt", "does not exist"),
        (check_output_file, "file/a.txt", "file"),
        (make_output_folder, "file", "is a file"),
        (make_output_folder, "file/below", "is a file"),
        (check_output_file, "a" * 256, "too long"),
        (check_output_folder, "a" * 256, "too long"),
        (check_output_file, "a\0b", "null"),
        (check_output_folder, "a\0b", "null"),
    ],
)
def test_what_cannot_be_written_is_refused_at_once(tmp_path, check, name, words):
    (tmp_path / "file").touch()
    with refused(str(tmp_path), words):
        check(tmp_path / name)
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_no_permission_is_told_at_once(tmp_path, monkeypatch):
    (tmp_path / "a").touch()
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != tmp_path / "a")
    with refused("no permission", str(tmp_path / "a")):
        check_output_file(tmp_path / "a")
    check_output_file(tmp_path / "b")


def test_the_folder_vanishes_meanwhile(tmp_path):
    (tmp_path / "folder").mkdir()
    with refused("a.txt", "No such file"), whole_file(tmp_path / "folder" / "a.txt") as temporary:
        temporary.write_text("new")
        (tmp_path / "folder").rename(tmp_path / "moved")
    assert list(tmp_path.glob("moved/a.txt")) == []


def test_a_folder_keeps_its_other_files(tmp_path):
    for name in ("own", "kept", "earlier"):
        (tmp_path / name).write_text("old")
    (tmp_path / "kept").chmod(0o600)
    with whole_folder(tmp_path, ["kept", "earlier", "never"]) as temporary:
        (temporary / "kept").write_text("new")
        (temporary / "one").write_text("new")
    assert held(tmp_path) == {"own": "old", "kept": "new", "one": "new"}
    assert mode_of(tmp_path / "kept") == 0o600


def test_a_full_disk_or_a_folder_in_the_way_leaves_what_was_there(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("old")
    (tmp_path / "b").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full_disk)
        for kind in (whole_file(tmp_path / "a"), whole_folder(tmp_path)):
            with refused(str(tmp_path), "No space left"), kind as temporary:
                (temporary / "a" if temporary.is_dir() else temporary).write_text("new")
    with refused(str(tmp_path / "b"), "folder"), whole_folder(tmp_path) as temporary:
        (temporary / "a").write_text("new")
        (temporary / "b").write_text("new")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a", "b"]
    assert (tmp_path / "a").read_text() == "old"
