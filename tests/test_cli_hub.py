"""Short names of networks of torch.hub: the call that each stands for, with `torch.hub.load` replaced."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import torch
from command_line import fails, run
from torch import nn

from dejavu_torch import DejaVu
from dejavu_torch.cli.commands import run_learn
from dejavu_torch.cli.parser import parse
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.hub import NETWORKS, Network

ROUTE = "sim:aerial?frames=40"
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


class Net(nn.Module):
    """Numbers in the form in which a network of the hub makes them."""

    def __init__(self, repository):
        super().__init__()
        self.repository, self.linear = repository, nn.Linear(12, 512)

    def forward(self, frames):
        made = self.linear(nn.functional.adaptive_avg_pool2d(frames, 2).flatten(1))
        if "queries" in self.repository:  # the attention of each block
            return made, [made.view(len(made), -1, 2)]
        return (made[:, :99], made.sign(), made.repeat(1, 8)) if "Sela" in self.repository else made


@pytest.fixture
def asked(monkeypatch):
    """Calls of `torch.hub.load`."""
    calls = []

    def load(repo_or_dir, model, **arguments):
        calls.append({"repository": repo_or_dir, "entry": model, **arguments})
        sys.stdout.write("Using a cache\n")  # as some do
        torch.manual_seed(0)
        net = Net(repo_or_dir)
        return nn.DataParallel(net) if repo_or_dir.startswith("Lu-Feng") else net

    monkeypatch.setattr(torch.hub, "load", load)
    return calls


def features_of(*words):
    return parse("learn", run_learn, [ROUTE, "--map", "map.safetensors", *words])["model"].features


@pytest.mark.parametrize("name", NETWORKS)
def test_a_short_name_is_a_call_of_the_hub(name, asked):
    net, own = features_of("--features", f"hub:{name}"), NETWORKS[name]
    assert asked == [{"repository": own.repository, "entry": own.entry, "trust_repo": True} | own.settings]
    assert (net.resize, net.mean, net.std, net.dimension, net.layer) == (own.size, MEAN, STD, None, None)
    with torch.no_grad():
        features = net.eval()(torch.rand(2, 3, 60, 80))
    assert features.shape == (2, 512)
    if name == "selavpr++":
        assert set(features.unique().tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize(
    "words",
    [
        "--features hub:anyloc --features.resize [28,42] --features.network.domain aerial",
        "--features.network.domain=aerial --features.resize=[28,42] --features=hub:anyloc",
    ],
)
def test_options_overrule_it_wherever_they_are(words, asked):
    net = features_of(*words.split())
    assert net.resize == (28, 42)
    assert net.mean == MEAN
    assert [one["domain"] for one in asked] == ["aerial"]


def test_the_words_in_full_are_the_same(asked):
    page = (Path(__file__).parents[1] / "docs" / "howto" / "pretrained.md").read_text().replace("\\\n", " ")
    shown = re.findall(r"^dejavu learn \S+ --map \S+ (.*eigenplaces.*)$", page, re.MULTILINE)
    nets = [features_of(*shlex.split(words)) for words in shown]
    assert len(nets) == 2
    assert repr(nets[0]) == repr(nets[1])
    assert asked[0] == asked[1]
    assert asked[0]["repository"] == "gmberton/eigenplaces"


@pytest.mark.parametrize(
    ("beside", "seen"),
    [
        ("dict_kwargs: {domain: aerial}", "hub:anyloc with dict_kwargs;"),
        ("network: {domain: aerial}", "hub:anyloc with network;"),
        ("init_args: {network.domain: aerial}", "hub:anyloc with network.domain;"),
    ],
)
def test_what_stands_beside_a_member_is_not_dropped(beside, seen, capsys):
    value = f"[HOG, {{class_path: hub:anyloc, {beside}}}]"
    error = fails(capsys, "learn", ROUTE, "--map", "map.safetensors", "--features", value)
    assert f"{seen} expected settings under init_args" in error


CONFIGS = [
    "{class_path: HOG, init_args: {cell: 4}}",
    "{class_path: dejavu_torch.Embedding, init_args: {dimension: null, layer: linear, network: {class_path: "
    "dejavu_torch.cli.parser.made, init_args: {function: torch.hub.load}, dict_kwargs: {repo_or_dir: "
    "AnyLoc/DINO, model: get_vlad_model, domain: urban}}}}",
]


@pytest.mark.parametrize("features", CONFIGS)
def test_settings_of_a_config_are_not_its_own(features, asked, tmp_path):
    config = tmp_path / "own.yaml"
    config.write_text(f"features: {features}\nmapper: {{init_args: {{route_bytes_per_place: 3}}}}\n")
    words = "--features", "hub:megaloc", "--features.resize=[28,42]"
    net = features_of(*words, "--config", str(config))
    assert repr(net) == repr(features_of(*words))
    assert (net.cell, net.layer) == (0, None)
    assert asked[0] == asked[1]


@pytest.mark.parametrize("value", ["hub:megalock", "[HOG, hub:megalock]", "hub:"])
def test_an_unknown_name_lists_the_known(value, capsys):
    error = fails(capsys, "learn", ROUTE, "--map", "map.safetensors", "--features", value)
    assert ": hub:" in error
    assert all(f"hub:{name}" in error for name in NETWORKS)


@pytest.mark.parametrize("value", ["hub:selavpr++", "[HOG, hub:eigenplaces]"])
def test_the_next_line_runs(value, asked, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run("learn", ROUTE, "--map", "map.safetensors", "--features", value)
    told = shlex.split(capsys.readouterr().out.rpartition("next: dejavu ")[2])
    assert value in told
    words = [f"{ROUTE}&traverse=1" if word == "QUERY" else word for word in told]
    run(*words)
    assert len((tmp_path / "matches.csv").read_text().splitlines()) == 41
    capsys.readouterr()
    run("live", *words[1:-2])
    lines = capsys.readouterr().out.splitlines()
    assert len([json.loads(line) for line in lines]) == 40  # nothing else is printed there
    assert len(asked) == 3


@pytest.mark.parametrize("config", [(), ("--config", "train_road")])
def test_a_training_takes_it_and_says_the_words(config, asked, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = "--model.backbone", "hub:cosplace", "--model.backbone.dimension=4"
    made += "--model.mapper", "SpectralMapper"
    steps = "--trainer.max_steps=1", "--trainer.accelerator=cpu", "--trainer.default_root_dir=run"
    run("train", "fit", "--data.source", ROUTE, *config, *made, *steps)
    words = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("next: dejavu "))
    begin = next(i for i, word in enumerate(words) if word.startswith("--features"))
    features = [word for word in words[begin:] if word.startswith("--features")]
    trained = DejaVu.load("run/map.safetensors", features_of(*features)).features
    assert isinstance(trained, Embedding)
    assert trained.cell == 0  # that of train_road is 8
    assert asked[0] == asked[-1]


def test_a_repository_that_is_really_loaded(tmp_path, monkeypatch):
    code = (
        "dependencies = ['torch']\n"
        "from torch import nn\n"
        "def get_trained_model(width=4):\n"
        "    return nn.Conv2d(3, width, 3)\n"
    )
    (tmp_path / "hubconf.py").write_text(code)
    local = Network(str(tmp_path), "get_trained_model", {"source": "local", "width": 5})
    monkeypatch.setitem(NETWORKS, "megaloc", local)
    for value in ("hub:megaloc", "[hub:megaloc]"):
        net = features_of("--features", value)
        assert net(torch.rand(2, 3, 20, 20)).shape == (2, 5)
