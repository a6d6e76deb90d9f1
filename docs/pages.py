"""What the site has beyond the files in docs/: the reference, from help texts and docstrings."""

from __future__ import annotations

import inspect
import io
import os
import pkgutil
import re
import shlex
import shutil
import sys
from collections import Counter
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import tomllib

DOCS = Path(__file__).parent
ROOT = DOCS.parent
NOTEBOOKS = DOCS / "notebooks"  # copies, as Sphinx reads one folder
TEXTS = (r"Convention(?: \d+)?", "Environment", "Returns", "Shape", "Source")  # sections without entries
SECTION = re.compile(rf"^(Args|Attributes|Buffers[\w ,]*|Example|Raises|{'|'.join(TEXTS)}):(?: (.*))?$", re.M)
MARKUP = re.compile(r"(`[^`]*`|\*[\w'][^*\n]*[\w']\*)|[|*\\]|(?<=\w)_(?!\w)")  # what stays; what is escaped
LINK = re.compile(r"(!?\[[^]]*\]\()([\w./-]+)(#[^)\s]*)?\)")
WIDTH = "88"  # characters of a line of help, as many as the page shows


def address(name: str) -> str:
    """An address in [project.urls] of pyproject.toml, "" if it is not there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return str(project.get("urls", {}).get(name, "")).rstrip("/")


def help_of(lines: str) -> str:
    """What command lines such as `dejavu learn --help` print, each command under its own heading."""
    from benchmarks.__main__ import run
    from dejavu_torch.cli import run_command

    os.environ["COLUMNS"] = WIDTH
    shown = []
    for line in lines.splitlines():
        words = shlex.split(line)
        program, words = (run_command, words[1:]) if words[0] == "dejavu" else (run, words[3:])
        printed = io.StringIO()
        with redirect_stdout(printed), suppress(SystemExit):
            program(words)
        shown += [f"## {line.partition(' --help')[0]}"] if words[-1].startswith("--help") else []
        text = printed.getvalue().strip().replace(" \b", "")  # jsonargparse takes a blank back
        shown.append(f"```text\n{text}\n```")
    return "\n\n".join(shown)


@cache
def public_names() -> dict[str, Any]:
    """Classes and functions that are documented for users, by module and name.

    Those of the front door, those whose docstring has a section such as Args, and the classes that these
    inherit from or name in their signatures.
    """
    import dejavu_torch

    own: dict[Any, str] = {}
    for found in pkgutil.walk_packages(dejavu_torch.__path__, "dejavu_torch."):
        if not found.name.startswith("dejavu_torch.cli"):
            for name, value in vars(import_module(found.name)).items():
                defined = callable(value) and getattr(value, "__name__", "") == name and name[0] != "_"
                if defined and value.__module__ == found.name:
                    own[value] = f"{found.name}.{name}"
    door = {getattr(dejavu_torch, name) for name in dejavu_torch.__all__}
    public = door | {one for one in own if SECTION.search(inspect.cleandoc(one.__doc__ or ""))}
    while more := {other for one in public for other in named_by(one) if other in own} - public:
        public |= more
    return {name: value for value, name in own.items() if value in public}


def named_by(one: Any) -> set[type]:
    """The bases of a class, and the classes in signatures, also those in aliases such as `Pictures`."""
    members = [value for name, value in vars(one).items() if name[0] != "_" or name == "__init__"]
    words = {
        word
        for annotated in [one, *members]
        for text in getattr(annotated, "__annotations__", {}).values()
        for word in re.findall(r"\w+", str(text))
    }
    space = vars(sys.modules[one.__module__])
    found = (part for word in words for part in (space.get(word), *get_args(space.get(word))))
    return {*filter(inspect.isclass, found), *getattr(one, "__mro__", ())}


def room_of(one: Any) -> str:
    """The folder of the package that a class or function lives in."""
    parts = one.__module__.split(".")
    return ".".join(parts[:2]) if (ROOT / "/".join(parts[:2])).is_dir() else parts[0]


@cache
def imported() -> Counter[str]:
    """How often pages import each name."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))
    return Counter(re.findall(r"\w+", " ".join(re.findall(r"^from dejavu_torch.* import (.*)", text, re.M))))


def api_of(room: str) -> str:
    """Public names of a room, module by module, beginning with those that users call."""
    import dejavu_torch

    def asked(name: str) -> tuple[bool, int]:
        short = name.rpartition(".")[2]
        return short not in dejavu_torch.__all__, -imported()[short]

    modules: dict[str, list[str]] = {}
    for name in sorted(names := public_names(), key=asked):
        if room_of(one := names[name]) == room:
            kind = "autoclass" if inspect.isclass(one) else "autofunction"
            modules.setdefault(one.__module__, []).append(f".. {kind}:: {name}")
    door = [f"[{name}](#dejavu_torch.{home}.{name})" for name, home in sorted(dejavu_torch._HOMES.items())]
    lines = [f"`from dejavu_torch import ...` has {', '.join(door)}.", ""] if room == "dejavu_torch" else []
    for module, directives in modules.items():
        lines += [f"## {module.removeprefix('dejavu_torch.')}", "", import_module(module).__doc__ or "", ""]
        lines += ["```{eval-rst}", *directives, "```", ""]
    if room == "dejavu_torch":
        lines += ["## The paper", "", dejavu_torch.__doc__ or ""]
    return "\n".join(lines)


GENERATED = {"help": help_of, "api": api_of}


def write(app: Any, docname: str, source: list[str]) -> None:
    """Put in what is generated, and let links lead where they lead on GitHub.

    A link to a file that is no page leads to the repository, or is the file's name if that has no address.
    """
    page = Path(app.env.doc2path(docname))
    folder = ROOT / "notebooks" if page.parent == NOTEBOOKS else page.parent

    def link(found: re.Match[str]) -> str:
        target, anchor = Path(os.path.normpath(folder / found[2])), found[3] or ""
        if target == ROOT / "README.md":
            target, anchor = DOCS / "index.md", ""
        elif target.parent == ROOT / "notebooks":
            target = NOTEBOOKS / target.name
        if ROOT not in target.parents or not target.is_file():
            return found[0]
        if DOCS in target.parents:
            return f"{found[1]}{os.path.relpath(target, page.parent)}{anchor})"
        path, repository = target.relative_to(ROOT).as_posix(), app.config.repository
        return f"{found[1]}{repository}/blob/main/{path}{anchor})" if repository else f"`{path}`"

    def generated(found: re.Match[str]) -> str:
        return GENERATED[found[1]](found[2])

    text = re.sub(r"^```\{(help|api)\}\n(.*?)\n```$", generated, source[0], flags=re.M | re.S)
    source[0] = LINK.sub(link, text)


def as_rst(app: Any, what: str, name: str, one: Any, options: Any, lines: list[str]) -> None:
    """A docstring in reStructuredText: each section a field, each argument a point."""
    text, _, example = "\n".join(lines).partition("\nExample:\n")
    lines[:], section = [], ""
    for line in MARKUP.sub(lambda found: found[1] or f"\\{found[0]}", text).split("\n"):
        if found := SECTION.match(line):
            section = found[1]
            lines += ["", f":{section}:"]
            line = f"    {found[2] or ''}"
        elif section and line[:1].strip() and not lines[-1].strip():
            section = ""  # a paragraph of its own
        if not section or re.fullmatch("|".join(TEXTS), section):
            lines.append(f"    {line}" if section and line[:1].strip() else line)
            continue
        parts = [line] if section == "Raises" else re.split(r"(?<=\.) (?=[a-z]\w*(?:, \w+)*: )", line)
        for part in (parts[0], *(f"    {part}" for part in parts[1:])):
            entry = re.match(r"    (\w+(?:, \w+)*): (.*)", part)
            point = f"    * **{entry[1]}**: {entry[2]}" if entry else f"      {part[8:] or part.strip()}"
            lines.append(point)
    if example:
        lines += ["", ":Example:", "", *example.split("\n"), ""]


def signed(app: Any, what: str, name: str, one: Any, options: Any, *texts: str | None) -> list[str | None]:
    """A signature without defaults that Sphinx cannot read: a class is its name, a factory three dots."""
    unread = r"<class '([\w.]+)'>|<factory>"
    return [text and re.sub(unread, lambda found: found[1] or "...", text) for text in texts]


def is_skipped(app: Any, what: str, name: str, one: Any, skip: bool, options: Any) -> bool | None:
    """Fields of a NamedTuple have no docstring of their own."""
    return True if type(one).__name__ == "_tuplegetter" else None


def mend(app: Any, pagename: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Let the keyboard scroll code and tables that are too wide; give headings of the sidebar their level."""
    if "furo_navigation_tree" in context:
        level = 'role="heading" aria-level="2"'
        context["furo_navigation_tree"] = context["furo_navigation_tree"].replace('role="heading"', level)
    if "body" in context:
        wide = r'<(pre|div class="table-wrapper[^"]*")>'
        context["body"] = re.sub(wide, r'<\1 tabindex="0">', context["body"])


def setup(app: Any) -> dict[str, bool]:
    """What Sphinx calls first."""
    for room in {path.parent.name for path in (ROOT / "dejavu_torch").glob("*/__init__.py")} - {"cli"}:
        name = f"dejavu_torch.{room}"
        text = f"# {name}\n\n{import_module(name).__doc__}\n\n```{{api}}\n{name}\n```\n"
        (DOCS / "reference" / "api" / f"{room}.md").write_text(text, encoding="utf-8")
    shutil.rmtree(NOTEBOOKS, ignore_errors=True)
    shutil.copytree(ROOT / "notebooks", NOTEBOOKS, ignore=shutil.ignore_patterns(".*"))
    app.add_config_value("repository", address("Repository"), "env")
    app.connect("source-read", write)
    app.connect("autodoc-process-docstring", as_rst)
    app.connect("autodoc-process-signature", signed)
    app.connect("html-page-context", mend, priority=900)  # after the theme
    app.connect("autodoc-skip-member", is_skipped)
    app.connect("env-get-outdated", lambda *_: ["reference/commands"])  # it follows the code
    return {"parallel_read_safe": True}
