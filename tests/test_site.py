"""The documentation's site: built without a warning, with every public name and command, its links whole."""

from __future__ import annotations

import ast
import re
from functools import cache
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import processes
import pytest

import dejavu_torch
from benchmarks.__main__ import BENCHES
from dejavu_torch.cli import COMMANDS

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
PACKAGE, DOCS = ROOT / "dejavu_torch", ROOT / "docs"
SECTIONS = re.compile("^(Args|Attributes|Convention|Raises|Returns|Shape|Example):", re.MULTILINE)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for needed in ("sphinx", "furo", "myst_nb"):
        pytest.importorskip(needed)
    out = tmp_path_factory.mktemp("site")
    # without pages of source code, an index and furo's navigation, which take half of the time
    words = ["-W", "--keep-going", "-q", "-d", out / "trees"]
    plain = ("extensions=myst_nb,sphinx.ext.autodoc,pages", "html_theme=basic", "html_use_index=0")
    words += [word for setting in plain for word in ("-D", setting)]
    code = "import sys; from sphinx.cmd.build import main; sys.exit(main(sys.argv[1:]))"
    ran = processes.python(code, *words, "docs", out / "html", cwd=ROOT, imports=processes.PACKAGE)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")
    return out / "html"


def documented():
    """Public names and their docstrings: those of the front door, and those with sections."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                text, home = ast.get_docstring(node) or "", dejavu_torch._HOMES.get(node.name)
                door = f"dejavu_torch.{home}" == module
                if door or (SECTIONS.search(text) and path.parent.name != "cli"):
                    found[f"{module}.{node.name}"] = text
    return found


def words(text):
    """What is left of marked-up text."""
    return " ".join(re.findall(r"\w+", text))


@cache
def shown(page):
    return words(unescape(re.sub(r"<[^>]*>", "", page.read_text())))


def test_every_public_name_has_its_docstring_on_the_page_of_its_folder(site):
    from sphinx.util.inventory import InventoryFile

    with (site / "objects.inv").open("rb") as file:
        objects = InventoryFile.load(file, "", lambda base, uri: uri)
    entries = objects["py:class"] | objects["py:function"] | objects.get("py:exception", {})
    names = documented()
    assert len(names) > 150
    assert {f"dejavu_torch.{home}.{name}" for name, home in dejavu_torch._HOMES.items()} <= set(names)
    assert set(names) <= set(entries)
    assert "dejavu_torch.evaluation.plots.Picture" in entries  # in signatures by an alias only
    assert not (site / "_downloads").exists()  # to which Sphinx copies what a page links to and is no page
    for name, text in names.items():
        page = site / entries[name].uri.partition("#")[0]
        assert page.parent == site / "reference" / "api"
        assert words(text.partition("\n\n")[0]) in shown(page), name


def test_every_command_has_its_help(site):
    text = shown(site / "reference" / "commands.html")
    for name in (*COMMANDS, "train options fit"):
        assert f"usage dejavu {name} " in text
    for name in BENCHES:
        assert f"usage python m benchmarks {name} " in text
    for option in ("search_memory", "mapper route_bytes_per_place", "model rate", "codebooks"):
        assert option in text


def test_a_page_of_the_api_begins_with_what_users_call(site):
    for page in (site / "reference" / "api").glob("*.html"):
        first = re.search(r'<dt class="sig [^>]*id="dejavu_torch[\w.]*\.(\w+)"', page.read_text())
        assert first[1] in dejavu_torch.__all__, page.name


def test_the_sidebar_has_at_most_thirty_entries():
    text = (DOCS / "index.md").read_text()
    entries = "\n".join(re.findall(r"```{toctree}(.*?)```", text, re.S))
    shown = re.findall(r"^(?:[\w ]+<)?([\w/*]+)>?$", entries, re.M)
    pages = {page for one in shown for page in (ROOT if "notebooks" in one else DOCS).glob(f"{one}.*")}
    assert 20 < len(pages) <= 30
    assert shown[0] == "tutorial/install"


@pytest.mark.parametrize("repository", ["", "https://example.org/dejavu"])
def test_a_file_that_is_no_page_is_a_link_if_the_repository_has_an_address(repository, monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    import pages

    source = ["[its text](../../LICENSE#a-part), [files](files.md), ![](../scale.png), [d](../../gone.md)"]
    page = SimpleNamespace(doc2path=lambda name: str(DOCS / f"{name}.md"))
    app = SimpleNamespace(env=page, config=SimpleNamespace(repository=repository))
    pages.write(app, "reference/modules", source)
    file = f"[its text]({repository}/blob/main/LICENSE#a-part)" if repository else "`LICENSE`"
    assert source == [f"{file}, [files](files.md), ![](../scale.png), [d](../../gone.md)"]


def test_addresses_are_those_of_the_project(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(DOCS)
    import pages

    monkeypatch.setattr(pages, "ROOT", tmp_path)
    for urls, address in (("", ""), ("urls.Repository = 'https://a.org/b/'", "https://a.org/b")):
        (tmp_path / "pyproject.toml").write_text(f"[project]\nname = 'b'\n{urls}\n")
        assert pages.address("Repository") == address
