"""What shells complete."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest
from command_line import fails, run

from dejavu_torch.cli import COMMANDS, FIRST_DAY
from dejavu_torch.cli.presets import preset_names


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """That of bash, as a file."""
    pytest.importorskip("shtab")
    folder = tmp_path_factory.mktemp("completion")
    with (folder / "bash").open("w") as file, redirect_stdout(file), redirect_stderr(io.StringIO()) as said:
        run("completion", "bash")
    assert said.getvalue() == ""
    (folder / "zoo").touch()
    return folder / "bash"


def completed(script, line):
    """What bash offers for the last word of a line, in the folder of the script."""
    words = line.split(" ")
    code = (
        f'source "{script}"; COMP_WORDS=("$@"); COMP_CWORD={len(words) - 1}\n'
        '[[ $(complete -p dejavu) =~ -F.([^ ]+) ]]; "${BASH_REMATCH[1]}"; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    ran = subprocess.run(["bash", "-c", code, "-", *words], capture_output=True, text=True, cwd=script.parent)
    assert ran.stderr == ""
    return ran.stdout.split()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("dejavu compa", {"compare"}),
        ("dejavu compare --search ", {"auto", "coarse", "exact", "scan"}),
        ("dejavu learn morning --mapper.hol", {"--mapper.hold"}),
        ("dejavu compare ba", {"bash"}),  # a file of the folder
        ("dejavu train fit --trainer.max_st", {"--trainer.max_steps"}),
        ("dejavu train fit --config ", {*preset_names(), "bash", "zoo"}),
    ],
)
def test_a_tab_completes(line, offered, script):
    assert {*completed(script, line)} == offered


def test_without_shtab_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert "[completion]" in fails(capsys, "completion")


def test_help_begins_with_the_commands_of_a_first_day(capsys):
    with pytest.raises(SystemExit) as stop:
        run("--help")
    assert stop.value.code == 0
    first, more = capsys.readouterr().out.split("\nmore:\n")
    listed = [re.findall(r"^  (\w+)  +\S", part, re.MULTILINE) for part in (first, more)]
    assert listed[0] == [*FIRST_DAY]
    assert listed[1] == [name for name in COMMANDS if name not in FIRST_DAY]
