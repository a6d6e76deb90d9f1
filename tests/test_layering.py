"""Imports point one way (CONTRIBUTING.md, Structure)."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import dejavu_torch

PACKAGE = Path(dejavu_torch.__file__).parent
FILES = sorted(file.relative_to(PACKAGE) for file in PACKAGE.rglob("*.py"))
NAMES = [str(file) for file in FILES]
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
    "motion model_file model growth evaluation",
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


def front_door_rank() -> int:
    """It opens lazily, what it names reaches as far as the evaluation."""
    return RANK["evaluation"]


def wrong_arrows(source: str, file: Path) -> list[str]:
    """Imports of a file that go against the order of the rooms."""
    here = room_of(file)
    if here == "__init__":
        return []
    ranks = {**RANK, "": front_door_rank()}
    return [
        f"{file}:{line}: {here} imports {room or 'the front door'}"
        for line, room in rooms_imported(source, file)
        if room != here and (ranks[room] >= RANK[here] or room not in ONLY.get(here, ranks))
    ]


def test_every_file_stands_in_a_room() -> None:
    assert [file for file in FILES if room_of(file) not in RANK.keys() | {"__init__", "__main__"}] == []


def arrows() -> dict[str, set[str]]:
    """The rooms that each room uses, the front door left out."""
    used: dict[str, set[str]] = {}
    for file in FILES:
        here = room_of(file)
        rooms = {room for _, room in rooms_imported((PACKAGE / file).read_text(encoding="utf-8"), file)}
        if here in RANK and rooms - {here, ""}:
            used[here] = used.get(here, set()) | (rooms - {here, ""})
    return used


def test_the_arrows_between_rooms_are_these() -> None:
    assert arrows() == {room: set(rooms.split()) for room, rooms in ARROWS.items()}


def test_no_files_import_one_another() -> None:
    assert circles({file: (PACKAGE / file).read_text(encoding="utf-8") for file in FILES}) == []


@pytest.mark.parametrize(
    "source",
    [
        "from dejavu_torch.maps.one import f",
        "import dejavu_torch.maps.one",
        "from . import one",
        "def f():\n    from dejavu_torch.maps import one",
        "if TYPE_CHECKING:\n    from .one import f",
        "from dejavu_torch.maps.three import f",
        "from dejavu_torch import maps",
    ],
)
def test_a_circle_is_caught(source: str) -> None:
    sources = {
        "__init__.py": "from dejavu_torch.maps.one import f",
        "maps/__init__.py": "from dejavu_torch.maps import two",
        "maps/one.py": "from dejavu_torch.maps.two import f",
        "maps/three.py": "from dejavu_torch import maps\nfrom dejavu_torch.maps.one import f",
        "types.py": "import torch",
    }
    assert (
        circles({Path(name): text for name, text in {**sources, "maps/two.py": "import torch"}.items()}) == []
    )
    (circle,) = circles({Path(name): text for name, text in {**sources, "maps/two.py": source}.items()})
    assert "maps/two.py" in circle


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_imports_point_one_way(file: Path) -> None:
    assert wrong_arrows((PACKAGE / file).read_text(encoding="utf-8"), file) == []


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("types.py", "import dejavu_torch.data.files"),
        ("features/hog.py", "from dejavu_torch.periods.spectrogram import layers_of"),
        ("features/hog.py", "from dejavu_torch import periods"),
        ("features/hog.py", "from dejavu_torch import HOG"),
        ("features/hog.py", "import dejavu_torch"),
        ("features/hog.py", "from ..data.strip import SlidingWindow"),
        ("features/hog.py", "from .. import model"),
        ("features/deep/net.py", "from ...maps import phase"),
        ("data/files.py", "def f():\n    from dejavu_torch.model import DejaVu"),
        ("data/simulate/aerial.py", "if True:\n    import dejavu_torch.evaluation as e"),
        ("maps/templates.py", "import torch, dejavu_torch.recognition.select"),
        ("recognition/select.py", "from dejavu_torch.motion import resampling"),
        ("motion/odometry.py", "from dejavu_torch.features.preprocess import select_channel"),
        ("maps/scores.py", "from ..model import DejaVu"),
        ("model.py", "from .evaluation import curves"),
        ("model.py", "from . import evaluation"),
        (
            "evaluation/curves.py",
            "try:\n    from dejavu_torch.training import metrics\nexcept ImportError: pass",
        ),
        ("evaluation/compare.py", "from dejavu_torch.cli import main"),
    ],
)
def test_a_wrong_arrow_is_caught(file: str, source: str) -> None:
    assert len(wrong_arrows(source, Path(file))) == 1


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("__init__.py", "from dejavu_torch.cli import main"),
        ("features/hog.py", "import torch\nfrom dejavu_torch.types import InputError"),
        (
            "features/hog.py",
            "from ..types import InputError\nfrom .extract import feature_batches\nfrom . import hog",
        ),
        ("data/simulate/aerial.py", "from .paint import Canvas\nfrom ..strip import read_strip"),
        ("model.py", "from .data import arrays\nfrom . import types"),
        (
            "cli/parser.py",
            "from dejavu_torch import model\nfrom dejavu_torch.evaluation import compare",
        ),
        ("types.py", "import dejavu_torch_other\nfrom torch import cli"),
    ],
)
def test_right_arrows_pass(file: str, source: str) -> None:
    assert wrong_arrows(source, Path(file)) == []
