"""Who asks what: a question belongs to the file that can answer it, and the lists of the others only shrink.

`python tests/test_questions.py` writes `questions.json` anew, where fewer lines ask than before.
"""

from __future__ import annotations

import ast
import json
import sys
from collections import Counter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "dejavu_torch"
TABLE = Path(__file__).with_name("questions.json")
WAYS = {"SequenceMatcher", "PlaceFilter", "PlaceSmoother"}
MAPS = {"SpectralMap", "TemplateMap", "SpectralMapper", "TemplateMapper"}
NOUNS = {"Layout", "PlaceMap", "SequenceModel", "Traverse", "Localizer", "Searcher", *WAYS, *MAPS}
ASKED = {  # names of variables and, after a dot, of attributes
    "area": {"area", "rectangles", ".area", ".rectangles", ".columns", ".dimensions"},
    "routes": {"routes", ".routes"},
    "maps": {".kind"},
}
MOST = 8  # parameters


def traverses(trees):
    """Every kind of traverse, also of kinds of them."""
    bases = {
        node.name: {base.id for base in node.bases if isinstance(base, ast.Name)}
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    found = {"Traverse"}
    while more := {name for name, own in bases.items() if own & found} - found:
        found |= more
    return found


def conditions(tree):
    """Every expression on whose truth something depends."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If | ast.IfExp | ast.Assert | ast.While):
            yield node.test
        elif isinstance(node, ast.BoolOp):  # a default by `or` asks, too
            yield from node.values[:-1]
        elif isinstance(node, ast.Match):
            yield node.subject
        elif isinstance(node, ast.comprehension):
            yield from node.ifs
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "expect":
            yield node.args[0]


def words(node, dot=""):
    """Every name that an expression mentions, as `self`, `.area` and `.rows` in `self.area.rows`; but for
    tables by dimensions, as `MOST[layout.dimensions]`, which are what is asked for."""
    tables = [one.slice for one in ast.walk(node) if isinstance(one, ast.Subscript)]
    apart = {one for one in tables if isinstance(one, ast.Attribute) and one.attr == "dimensions"}
    for one in ast.walk(node):
        if one in apart:
            continue
        if isinstance(one, ast.Name):
            yield one.id
        elif isinstance(one, ast.Attribute):
            yield f"{dot}{one.attr}"


def questions(tree, kinds):
    """What a file asks, and in which lines: pairs."""
    for condition in conditions(tree):
        mentioned = {*words(condition, ".")}
        for question, names in ASKED.items():
            if mentioned & names:
                yield question, condition.lineno
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
            classes = {*words(node.args[1])}
            for question, names in {"ways": WAYS, "maps": MAPS, "traverses": kinds}.items():
                if classes & names:
                    yield question, node.lineno
        elif isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in (one for whole in targets for one in ast.walk(whole)):
                if isinstance(target, ast.Attribute) and isinstance(target.ctx, ast.Store):
                    owner = target.value.id if isinstance(target.value, ast.Name) else ""
                    if owner not in ("self", "cls"):
                        yield "others' attributes", node.lineno
        elif isinstance(node, ast.FunctionDef):
            given = node.args.posonlyargs + node.args.args
            optional = zip(given[::-1], node.args.defaults[::-1], strict=False)
            keywords = zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
            for argument, default in (*optional, *keywords):
                none = isinstance(default, ast.Constant) and default.value is None
                if none and argument.annotation is not None and NOUNS & {*words(argument.annotation)}:
                    yield "nouns that may be missing", argument.lineno
            if (
                len(given) + len(node.args.kwonlyargs) - (given[:1] == ["self"]) > MOST
                and node.name != "__init__"
            ):
                yield "many parameters", node.lineno


def asked(sources):
    """How many lines of each file ask each question, {question: {file: lines}}."""
    trees = {name: ast.parse(source) for name, source in sources.items()}
    kinds, found = traverses(trees.values()), {}
    for name, tree in trees.items():
        for question, _ in {*questions(tree, kinds)}:
            found.setdefault(question, Counter())[name] += 1
    return {question: dict(sorted(files.items())) for question, files in sorted(found.items())}


def package():
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if file.parent.name != "places"]  # which answers
    return asked({str(file.relative_to(PACKAGE)): file.read_text(encoding="utf-8") for file in files})


def more(found, known):
    """What asks more than a table allows, in words."""
    return [
        f"{file} asks {count} times for {question}, {known.get(question, {}).get(file, 0)} before"
        for question, files in found.items()
        for file, count in files.items()
        if count > known.get(question, {}).get(file, 0)
    ]


def test_nobody_asks_more_than_before():
    found, known = package(), json.loads(TABLE.read_text())
    assert not more(found, known), "find the noun that answers it"
    assert found == known, "fewer ask: python tests/test_questions.py"


@pytest.mark.parametrize(
    ("line", "question"),
    [
        ("if model.map.area is None: pass", "area"),
        ("x = 1 if self.area.columns > 1 else 2", "area"),
        ("if layout.dimensions == 1: pass", "area"),
        ("if MOST[layout.dimensions] > 1: pass", None),
        ("x = [i for i in y if area]", "area"),
        ("expect(area is None, 'a', 'b')", "area"),
        ("assert not place_map.routes", "routes"),
        ("x = area or Layout(n)", "area"),
        ("while place_map.kind == 'spectral': pass", "maps"),
        ("match area:\n    case _: pass", "area"),
        ("isinstance(x, SpectralMap | TemplateMap)", "maps"),
        ("isinstance(x, (str, PlaceFilter))", "ways"),
        ("isinstance(x, Lap)", "traverses"),
        ("model.map = x", "others' attributes"),
        ("a, model.map.area = x", "others' attributes"),
        ("smoother.within += 1", "others' attributes"),
        ("def f(layout: Layout | None = None): pass", "nouns that may be missing"),
        ("def f(*, way: 'PlaceMap' = None): pass", None),
        ("def f(*, place_map: PlaceMap | None = None): pass", "nouns that may be missing"),
        ("def f(a, b, c, d, e, f, g, h, *, i): pass", "many parameters"),
        ("def __init__(a, b, c, d, e, f, g, h, *, i): pass", None),
        ("self.area = area", None),
        ("if rows: x = area", None),
        ("if columns: pass", None),
        ("isinstance(x, str)", None),
        ("def f(layout: Layout, count: int | None = None): pass", None),
    ],
)
def test_what_counts_as_asking(line, question):
    sources = {"a.py": line, "b.py": "class Part(Traverse): pass\nclass Lap(Part): pass"}
    assert asked(sources) == ({} if question is None else {question: {"a.py": 1}})


def test_more_is_told():
    (told,) = more({"area": {"a.py": 3, "b.py": 1}}, {"area": {"a.py": 2, "b.py": 1}})
    assert told == "a.py asks 3 times for area, 2 before"
    assert more({"ways": {"new.py": 1}}, {}) == ["new.py asks 1 times for ways, 0 before"]


if __name__ == "__main__":
    now = package()
    before = json.loads(TABLE.read_text()) if TABLE.exists() else now
    if grown := more(now, before):
        sys.exit("\n".join(grown))
    TABLE.write_text(json.dumps(now, indent=1) + "\n")
