"""Networks on the command line: classes, functions that make one, and the words that bring them back."""

from __future__ import annotations

import shlex
import sys

import pytest
import torch
from command_line import fails, run

from dejavu_torch import DejaVu
from dejavu_torch.cli.commands import run_learn
from dejavu_torch.cli.parser import parse
from dejavu_torch.features.embedding import Embedding

ZOO = """
from torch import nn

def load(repo, model, *rest, source="github", **settings):
    global asked
    asked = {"repo": repo, "model": model, "source": source, **settings}
    return nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU(), nn.Conv2d(4, 50, 3))

def typed(width: int = 8) -> nn.Module:
    return nn.Conv2d(3, width, 3)

class Net(nn.Conv2d):
    @classmethod
    def pretrained(cls, name, **settings):
        return cls(3, 6, 3)

def leave():
    raise SystemExit("bye")

def transform(name):
    return name.upper
"""
ROUTE = "sim:aerial?frames=40"
OWN = ("--features", "dejavu_torch.Embedding", "--features.dimension=null", "--features.resize", "[16,16]")
NOTES = ("--features.network.note", "it's", "--features.network.notes=a b")
NOTES += ('--features.network.more={"a": 1}',)
HUB = ("--features.network", "zoo.load", "--features.network.repo=a/b", "--features.network.model", "m")


@pytest.fixture(autouse=True)
def zoo(tmp_path, monkeypatch):
    (tmp_path / "zoo.py").write_text(ZOO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "zoo", raising=False)


def features_of(*words):
    model = parse("learn", run_learn, [ROUTE, "--map", "map.safetensors", *words])["model"]
    assert isinstance(model, DejaVu)
    return model.features


def test_a_function_is_called_with_what_is_typed():
    own = ("backbone", "R50"), ("dim", "3"), ("out", "[2, 3]"), ("head", "null"), ("trust", "true")
    words = (word for name, value in own for word in (f"--features.network.{name}", value))
    net = features_of(*OWN, *HUB, *words)
    import zoo  # type: ignore[import-not-found]

    assert isinstance(net, Embedding)
    given = {"backbone": "R50", "dim": 3, "out": [2, 3], "head": None, "trust": True}
    assert zoo.asked == {"repo": "a/b", "model": "m", "source": "github"} | given


@pytest.mark.parametrize(
    ("words", "channels"),
    [
        ("--features.network zoo.typed --features.network.width 5", 5),
        ("--features.network.width 5 --features.network zoo.typed", 5),
        ("--features.network zoo.Net.pretrained --features.network.name x --features.network.depth=2", 6),
        ("--features.network zoo.Net --features.network.in_channels=3 "
         "--features.network.out_channels 7 --features.network.kernel_size=3", 7),
    ],
    ids=["typed", "ahead", "method", "class"],
)  # fmt: skip
def test_functions_methods_and_classes(words, channels):
    net = features_of(*OWN, *words.split())
    assert isinstance(net, Embedding)
    assert net.cell == 0  # the argument of another class than the default
    assert net(torch.rand(2, 3, 20, 20)).shape == (2, channels)


def test_the_next_line_brings_the_network_back(tmp_path, capsys):
    words = (*OWN, *HUB, *NOTES, "--features.layer", "0", "--features.mean=.5")
    run("learn", ROUTE, "--map", "map.safetensors", *words)
    before, _, told = capsys.readouterr().out.rpartition("next: dejavu ")
    assert [word for word in NOTES if word not in shlex.split(told)] == []
    assert "backbone 448" in before  # of 112 numbers: what lies behind the layer is not kept
    sys.modules.pop("zoo")
    assert "Sequential" in fails(capsys, "localize", "map.safetensors", ROUTE, "--out", "matches.csv")
    assert "zoo" not in sys.modules  # a map names no code
    words = ["sim:aerial?frames=40&traverse=1" if word == "QUERY" else word for word in shlex.split(told)]
    run(*words)
    found = (tmp_path / "matches.csv").read_text().splitlines()
    assert len(found) == 41
    run("live", *words[1:-2])
    assert capsys.readouterr().out.count('"place"') == 40
    short = ("--features", "zoo.load", "--features.repo", "a", "--features.model", "m")
    run("localize", "map.safetensors", words[2], "--out", "again.csv", *short)
    assert (tmp_path / "again.csv").read_text().splitlines() == found


@pytest.mark.parametrize(
    ("words", "seen"),
    [
        (("zoo.transform", "--features.network.name", "x"), ("zoo.transform made a", "nn.Module")),
        (("zoo.leave",), ("zoo.leave ends the program (bye); expected one that makes a network",)),
        (("zoo.nothing", "--features.network.name", "x"), ("'zoo' has no attribute 'nothing'",)),
        (("zoo.typed", "--features.network.widht", "x"), ("widht",)),
        (("zoo.load", "--features.network.repo", "x"), ("model",)),
    ],
)
def test_mistakes_are_one_line(words, seen, capsys):
    error = fails(capsys, "learn", ROUTE, "--map", "map.safetensors", *OWN, "--features.network", *words)
    for word in seen:
        assert word in error
