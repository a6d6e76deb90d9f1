"""Imports point one way (CONTRIBUTING.md, Structure)."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import dejavu_torch

PACKAGE = Path(dejavu_torch.__file__).parent
FILES = sorted(file.relative_to(PACKAGE) for file in PACKAGE.rglob("*.py"))
SOURCES = {file: (PACKAGE / file).read_text(encoding="utf-8") for file in FILES}
ORDER = [
    {"text", "version"},
    {"types"},
    {"resize", "memory"},
    {"features", "periods", "data"},
    {"maps"},
    {"recognition"},
    {"motion"},
    {"learning"},
    {"model_file"},
    {"model"},
    {"growth"},
    {"cluster"},
    {"live", "export"},
    {"evaluation"},
    {"training"},
    {"cli"},
]
RANK = {room: rank for rank, rooms in enumerate(ORDER) for room in rooms}
ONLY = {"motion": {"types", "memory", "data"}}  # rooms that use less than all to their left
# what each room uses: a new arrow between two rooms is a decision, and is written down here
ARROWS = {
    "types": "text",
    "memory": "types",
    "resize": "types",
    "data": "text types memory resize",
    "features": "types resize",
    "periods": "types memory",
    "maps": "types memory data periods",
    "recognition": "types maps",
    "motion": "types memory data",
    "learning": "types memory data features maps recognition motion",
    "model_file": "text version types data features periods maps recognition motion learning",
    "model": "types memory resize data features maps recognition motion learning model_file",
    "growth": "types data features maps motion learning model_file model",
    "cluster": "text types data maps recognition learning",
    "live": "types data features recognition model",
    "evaluation": "text version types memory resize data features periods maps recognition motion model_file "
    "model growth",
    "export": "text version types data features maps recognition model",
    "training": "text types memory resize data features periods maps recognition "
    "motion model_file model evaluation",
    "cli": "text types data features periods maps recognition motion learning model_file model "
    "growth cluster live export evaluation training",
}


def room_of(file: Path) -> str:
    return file.parts[0].removesuffix(".py")


def imported(source: str, file: Path) -> Iterator[tuple[int, str]]:
    """Every import in a file, in functions and under TYPE_CHECKING too: (line, dotted name)."""
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
        yield from ((node.lineno, target) for target in targets)


def rooms_imported(source: str, file: Path) -> Iterator[tuple[int, str]]:
    """Every import of the package in a file: (line, room).

    A name of the front door itself, such as `__version__`, counts as the room "".
    """
    for line, target in imported(source, file):
        name, *rest = target.split(".")
        if name == "dejavu_torch":
            yield line, rest[0] if rest and rest[0] in RANK else ""


def circles(sources: dict[Path, str]) -> list[str]:
    """Files that import one another, if through others: of each circle the names of its files."""
    named = {".".join(("dejavu_torch", *file.with_suffix("").parts)): file for file in sources}
    named |= {name.removesuffix(".__init__"): file for name, file in named.items()}
    del named["dejavu_torch"]  # the front door opens lazily
    reached: dict[Path, set[Path]] = {}
    for file, source in sources.items():
        targets = [target for _, target in imported(source, file)]
        names = {name if name in named else name.rpartition(".")[0] for name in targets}
        reached[file] = {named[name] for name in names & named.keys()} - {file}
    for middle in sources:  # Warshall: all that can be reached through any file
        for file in sources:
            if middle in reached[file]:
                reached[file] |= reached[middle]
    found = {frozenset(other for other in reached[file] if file in reached[other]) for file in sources}
    return [", ".join(sorted(map(str, circle))) for circle in found if circle]


def wrong_arrows(source: str, file: Path) -> list[str]:
    """Imports of a file that go against the order of the rooms."""
    here = room_of(file)
    if here == "__init__":
        return []
    ranks = {**RANK, "": RANK["evaluation"]}  # the front door opens lazily, and reaches that far
    return [
        f"{file}:{line}: {here} imports {room or 'the front door'}"
        for line, room in rooms_imported(source, file)
        if room != here and (ranks[room] >= RANK[here] or room not in ONLY.get(here, ranks))
    ]


def test_imports_of_all_files_point_one_way() -> None:
    assert [file for file in FILES if room_of(file) not in RANK.keys() | {"__init__", "__main__"}] == []
    assert [arrow for file, source in SOURCES.items() for arrow in wrong_arrows(source, file)] == []
    assert circles(SOURCES) == []


def test_the_arrows_between_rooms_are_these() -> None:
    used: dict[str, set[str]] = {}
    for file, source in SOURCES.items():
        here = room_of(file)
        rooms = {room for _, room in rooms_imported(source, file)} - {here, ""}
        if here in RANK and rooms:
            used[here] = used.get(here, set()) | rooms
    assert used == {room: set(rooms.split()) for room, rooms in ARROWS.items()}


def test_circles_are_caught() -> None:
    sources = {
        "__init__.py": "from dejavu_torch.maps.one import f",
        "maps/__init__.py": "from dejavu_torch.maps import two",
        "maps/one.py": "from dejavu_torch.maps.two import f",
        "maps/three.py": "from dejavu_torch import maps\nfrom dejavu_torch.maps.one import f",
    }

    def found(two: str) -> list[str]:
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


def test_wrong_arrows_are_caught_and_right_ones_pass() -> None:
    for file, source, wrong in (
        ("types.py", "import dejavu_torch.data.files", 1),
        ("features/hog.py", "from dejavu_torch import periods", 1),
        ("features/hog.py", "from dejavu_torch import HOG", 1),
        ("features/hog.py", "from ..data.strip import SlidingWindow", 1),
        ("features/deep/net.py", "from ...maps import phase", 1),
        ("data/files.py", "def f():\n    from dejavu_torch.model import DejaVu", 1),
        ("motion/odometry.py", "from dejavu_torch.features.preprocess import select_channel", 1),
        ("model.py", "try:\n    from .training import metrics\nexcept ImportError: pass", 1),
        ("__init__.py", "from dejavu_torch.cli import main", 0),
        ("features/hog.py", "from ..types import InputError\nfrom .extract import f\nfrom . import hog", 0),
        ("cli/parser.py", "from dejavu_torch import model\nfrom dejavu_torch.evaluation import compare", 0),
        ("types.py", "import dejavu_torch_other\nfrom torch import cli", 0),
    ):
        assert len(wrong_arrows(source, Path(file))) == wrong, (file, source)
