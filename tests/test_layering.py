"""Imports point one way (CONTRIBUTING.md, Structure)."""

from __future__ import annotations

import ast
from pathlib import Path

import dejavu_torch

PACKAGE = Path(dejavu_torch.__file__).parent
FILES = sorted(file.relative_to(PACKAGE) for file in PACKAGE.rglob("*.py"))
SOURCES = {file: (PACKAGE / file).read_text(encoding="utf-8") for file in FILES}
# what each room uses, all of it above: a new arrow between two rooms is a decision, and is written down here
ARROWS = {
    "lazy": "",
    "text": "",
    "places": "text",
    "version": "",
    "types": "places text",
    "memory": "types",
    "resize": "types memory",
    "data": "places lazy text types memory resize",
    "features": "places text types memory resize data",
    "periods": "text types memory",
    "maps": "places lazy types text memory data periods",
    "recognition": "places text types memory data maps",
    "motion": "places text types memory data",
    "learning": "places text types memory data features maps recognition motion",
    "model_file": "text version types memory data features periods maps recognition motion",
    "model": "places types resize data features maps recognition motion learning model_file",
    "teaching": "types memory data features maps recognition model",
    "growth": "places types data features maps motion recognition learning model_file model teaching",
    "updating": "places types data maps motion recognition model teaching growth",
    "cluster": "text types maps recognition",
    "live": "types memory data features recognition model",
    "evaluation": "places lazy text version types memory resize data features periods maps recognition "
    "motion model_file model growth",
    "export": "text version types data features maps recognition model",
    "training": "places lazy text types memory resize data features periods maps recognition "
    "motion model_file model growth evaluation",
    "cli": "text types data features periods maps recognition motion learning model_file model "
    "growth teaching updating cluster live export evaluation training",
}


def room_of(file):
    return file.parts[0].removesuffix(".py")


def imported(source, file):
    """Every import in a file, in functions and under TYPE_CHECKING too, as a dotted name."""
    package = ["dejavu_torch", *file.parent.parts]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            targets = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from targets


def rooms_imported(source, file):
    """Rooms that a file imports; the front door itself, as of `HOG`, counts as the room ""."""
    targets = [target.split(".") for target in imported(source, file)]
    found = {rest[0] if rest else "" for name, *rest in targets if name == "dejavu_torch"}
    return {room if room in ARROWS else "" for room in found} - {room_of(file)}


def circles(sources):
    """Files that import one another, if through others: of each circle the names of its files."""
    named = {".".join(("dejavu_torch", *file.with_suffix("").parts)): file for file in sources}
    named |= {name.removesuffix(".__init__"): file for name, file in named.items()}
    del named["dejavu_torch"]  # the front door opens lazily
    reached = {}
    for file, source in sources.items():
        targets = list(imported(source, file))
        names = {name if name in named else name.rpartition(".")[0] for name in targets}
        reached[file] = {named[name] for name in names & named.keys()} - {file}
    for middle in sources:  # Warshall: all that can be reached through any file
        for file in sources:
            if middle in reached[file]:
                reached[file] |= reached[middle]
    found = {frozenset(other for other in reached[file] if file in reached[other]) for file in sources}
    return [", ".join(sorted(map(str, circle))) for circle in found if circle]


def test_arrows_between_rooms_are_these_and_point_one_way():
    used = {room: set() for room in ARROWS}
    for file, source in SOURCES.items():
        if file.stem not in ("__init__", "__main__") or len(file.parts) > 1:
            used[room_of(file)] |= rooms_imported(source, file)
    assert used.pop("cli") - {""} == set(ARROWS["cli"].split())  # which the front door may be opened by
    assert used == {room: set(rooms.split()) for room, rooms in ARROWS.items() if room != "cli"}
    above = set()
    for room, rooms in ARROWS.items():
        assert set(rooms.split()) <= above, room
        above.add(room)
    assert circles(SOURCES) == []


def test_circles_are_caught():
    sources = {
        "__init__.py": "from dejavu_torch.maps.one import f",
        "maps/__init__.py": "from dejavu_torch.maps import two",
        "maps/one.py": "from dejavu_torch.maps.two import f",
        "maps/three.py": "from dejavu_torch import maps\nfrom dejavu_torch.maps.one import f",
    }

    def found(two):
        return circles({Path(name): text for name, text in {**sources, "maps/two.py": two}.items()})

    assert found("import torch") == []
    for source in (
        "from dejavu_torch.maps.one import f",
        "from . import one",
        "def f():\n    from dejavu_torch.maps import one",
        "if TYPE_CHECKING:\n    from .one import f",
        "from dejavu_torch.maps.three import f",
    ):
        (circle,) = found(source)
        assert "maps/two.py" in circle, source


def test_rooms_are_seen_however_they_are_imported():
    for file, source, rooms in (
        ("types.py", "import dejavu_torch.data.files", {"data"}),
        ("features/hog.py", "from dejavu_torch import periods", {"periods"}),
        ("features/hog.py", "from dejavu_torch import HOG", {""}),
        ("features/hog.py", "from ..data.strip import SlidingWindow", {"data"}),
        ("features/deep/net.py", "from ...maps import phase", {"maps"}),
        ("data/files.py", "def f():\n    from dejavu_torch.model import DejaVu", {"model"}),
        ("model.py", "try:\n    from .training import metrics\nexcept ImportError: pass", {"training"}),
        ("features/hog.py", "from .extract import f\nfrom . import hog", set()),
        ("types.py", "import dejavu_torch_other\nfrom torch import cli", set()),
    ):
        assert rooms_imported(source, Path(file)) == rooms, (file, source)
