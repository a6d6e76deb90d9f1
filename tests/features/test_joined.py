"""Features of several modules side by side, in a model and on the command line."""

from __future__ import annotations

import sys

import pytest
import torch
from command_line import fails, run
from helpers import refused
from torch import nn

from dejavu_torch import (
    HOG,
    DejaVu,
    Embedding,
    SpectralMapper,
    Whitening,
    compare,
    open_source,
)
from dejavu_torch.cli.commands import run_learn
from dejavu_torch.cli.parser import parse
from dejavu_torch.features.descriptor import default_features
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.model import features_per_frame
from dejavu_torch.model_file import recipe_of

ZOO = """
from torch import nn

def load(repo, model, **settings):
    return nn.Sequential(nn.Conv2d(3, 4, 3), nn.ReLU(), nn.Conv2d(4, 50, 3))
"""


class Means(nn.Module):
    """A user's own: the mean of each of some rows."""

    def __init__(self, rows: int = 8) -> None:
        super().__init__()
        self.linear = nn.Linear(rows, 12)

    def forward(self, frames):
        rows = nn.functional.adaptive_avg_pool2d(frames.mean(1, keepdim=True), (8, 1))
        made = self.linear(rows.flatten(1))
        return made


def network():
    torch.manual_seed(0)
    return Embedding(nn.Conv2d(3, 6, 3), None, resize=(20, 20), grid=2)


def both():
    return Joined([HOG(), PatchPixels((16, 24), channel="grey")])


@pytest.fixture(scope="module")
def flights():
    """120 frames of a road and of another flight over it."""
    sources = (open_source(f"sim:aerial?frames=120&traverse={i}") for i in range(2))
    return [torch.cat([*source.batches(120)])[..., ::2, ::2].contiguous() for source in sources]


def test_gradients_reach_the_members_weights_and_the_frames():
    features, frames = Joined([Means(), PatchPixels((8, 8))]).double(), torch.rand(2, 1, 8, 8).double()
    assert torch.autograd.gradcheck(features, (frames.requires_grad_(),))
    features(frames).sum().backward()
    assert all(one.grad is not None for one in features.parameters())


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_frames_of_any_number_of_channels_are_described(channels):
    frames = torch.rand(40, channels, 32, 32)
    assert DejaVu().learn(frames).localize(frames).index.tolist() == [*range(40)]
    grey = frames.mean(1, keepdim=True) if channels in (2, 4) else frames
    pixels = PatchPixels(channel="grey")
    assert torch.equal(pixels(frames), pixels(grey))


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: Joined([]), ("members of the features are none", "at least one")),
        (lambda: Joined([HOG(), "HOG"]), ("HOG, str", "expected modules")),  # type: ignore[list-item]
        (lambda: Joined("HOG"), ("str, str, str", "expected modules")),  # type: ignore[arg-type]
        (lambda: Joined([HOG(), nn.Identity()])(torch.rand(2, 3, 16, 16)), ("Identity made (2, 3, 16, 16)",)),
        (lambda: both()(torch.rand(2, 7)), ("Joined got (2, 7)", "float frames")),
        (lambda: PatchPixels(channel="mauve"), ("'mauve'", "'grey'")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


def test_a_whitening_takes_the_groups_of_the_features(flights, tmp_path):
    model = DejaVu(both(), mapper=SpectralMapper(12.0)).learn(flights[0])
    assert model.whitening is not None
    assert model.whitening.sizes == [324, 384]
    assert model.whitening.dimension == 60  # half of the places, as without groups
    assert features_per_frame(model) == 708
    found = model.localize(flights[1])
    assert float(((found.index - torch.arange(120)).abs() <= 5).float().mean()) > 0.9
    model.save(tmp_path / "map.safetensors")
    again = DejaVu.load(tmp_path / "map.safetensors")  # its classes are the package's own
    assert repr(again.features) == repr(model.features)
    assert torch.equal(again.localize(flights[1]).score, found.score)
    assert torch.equal(again(flights[1][:3]), model(flights[1][:3]))
    other = DejaVu()
    other.descriptor.take(again.descriptor, whitening=True)
    assert other.learn(flights[1]).whitening is again.whitening


def test_ready_features_have_no_groups_but_those_that_are_asked_for():
    features = both()
    features(torch.rand(1, 3, 32, 32))
    rows = torch.randn(80, 300)
    sizes = []
    for groups in (None, [100, 200]):
        model = DejaVu(features, Whitening(groups=groups)).learn(rows)
        assert model.whitening is not None
        sizes.append(model.whitening.sizes)
    assert sizes == [[300], [100, 200]]
    with refused("groups of 100 + 100", "(80, 300)", "(N, 200)"):
        DejaVu(features, Whitening(groups=[100, 100])).learn(rows)


def test_a_users_own_module_beside_ours_comes_from_the_caller(flights, tmp_path):
    model = DejaVu(Joined([HOG(), Means()])).learn(flights[0])
    model.save(tmp_path / "map.safetensors")
    with refused("Means", "only the caller can load"):
        DejaVu.load(tmp_path / "map.safetensors")
    with refused("Joined with members"):
        DejaVu.load(tmp_path / "map.safetensors", Joined([Means(), HOG()]))
    expected = model(flights[1][:4])
    for given in (Joined([HOG(), Means()]), Means()):
        again = DejaVu.load(tmp_path / "map.safetensors", given)
        assert torch.equal(again(flights[1][:4]), expected)


def test_one_module_is_not_two_members(flights, tmp_path):
    model = DejaVu(Joined([Means(), Means()]), mapper=SpectralMapper(None, 0.1)).learn(flights[0])
    model.save(tmp_path / "map")
    with refused("several members of the features are", "Means", "as a list"):
        DejaVu.load(tmp_path / "map", features=Means())
    again = DejaVu.load(tmp_path / "map", features=Joined([Means(), Means()]))
    torch.testing.assert_close(again.descriptor.describe(flights[1]), model.descriptor.describe(flights[1]))


# the command line -------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "zoo.py").write_text(ZOO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "zoo", raising=False)
    return tmp_path


ROUTE = "sim:aerial?frames=60"
LEARN = ("learn", ROUTE, "--map", "map.safetensors", "--calibration", "none", "--features")
LIST = "[dejavu_torch.HOG, {class_path: PatchPixels, init_args: {channel: grey}}]"
HUB = (
    "[HOG, {class_path: dejavu_torch.Embedding, init_args: {dimension: null, resize: [16, 16], network: "
    "{class_path: zoo.load, init_args: {repo: a/b, model: m}}}}]"
)


def features_of(*words):
    model = parse("learn", run_learn, [ROUTE, "--map", "map.safetensors", *words])["model"]
    assert isinstance(model, DejaVu)
    return model.features


@pytest.mark.parametrize("words", [("--features", LIST), (f"--features={LIST}",)])
def test_a_list_of_features_is_joined(words):
    expected = Joined([HOG(), PatchPixels(channel="grey")])
    assert repr(features_of(*words)) == repr(expected)


@pytest.mark.parametrize(
    "words",
    [
        ("--features.cell", "4"),
        ("--features.cell=4",),
        ("--config", "settings.yaml"),
        ("-c", "settings.yaml"),
        ("--config", "default", "--features.cell", "4"),
        ("--config=other.yaml", "--features.cell", "4"),
    ],
)
def test_settings_of_hog_alone_mean_hog(folder, words):
    (folder / "settings.yaml").write_text("features: {init_args: {cell: 4}}")
    (folder / "other.yaml").write_text("batch_size: 9")
    assert recipe_of(features_of(*words)) == recipe_of(HOG(cell=4))
    assert recipe_of(features_of(*words, "--features.bins", "linear")) == recipe_of(
        HOG(cell=4, bins="linear")
    )
    assert recipe_of(features_of()) == recipe_of(default_features())
    assert recipe_of(features_of("--whitening", "none")) == recipe_of(HOG())
    other = features_of("--features", "PatchPixels", "--features.patch", "4")
    assert recipe_of(other) == recipe_of(PatchPixels(patch=4))


def test_a_network_of_a_function_beside_hog(folder, capsys):
    run(*LEARN, HUB)
    sys.modules.pop("zoo")
    words = "localize", "map.safetensors", f"{ROUTE}&traverse=1", "--out", "matches.csv"
    assert "Sequential" in fails(capsys, *words)
    assert "zoo" not in sys.modules  # a map names no code
    run(*words, "--features", HUB)
    assert len((folder / "matches.csv").read_text().splitlines()) == 61


@pytest.mark.parametrize(
    ("words", "seen"),
    [
        (("[HOG, zoo.nothing]",), "--features.members: module 'zoo' has no attribute 'nothing'"),
        (("[HOG, {",), "--features is '[HOG, {'; expected a list of classes"),
        (("[2020-13-45]",), "--features is '[2020-13-45]'; expected a list of classes"),
    ],
)
def test_mistakes_are_one_line(words, seen, folder, capsys):
    assert seen in fails(capsys, *LEARN, *words)
    assert not (folder / "map.safetensors").exists()


def test_plain_hog_is_set_aside_where_the_features_have_it():
    route, other = (open_source(f"sim:aerial?frames=80&traverse={i}") for i in (0, 1))
    model = DejaVu()
    with model.descriptor.setting_aside(route, other):
        model.learn(route)
        next(model.descriptor.batches(other))  # not whole
        assert torch.equal(model.descriptor.hog_of(route), HOG()(route[:]))
        assert model.descriptor.hog_of(other) is None
    assert model.descriptor.hog_of(route) is None
    model = DejaVu(HOG(cell=16))
    with model.descriptor.setting_aside(route):
        model.learn(route)
        assert model.descriptor.hog_of(route) is None


def test_the_baseline_of_hog_is_that_of_the_features(monkeypatch):
    route, other = (open_source(f"sim:aerial?frames=80&traverse={i}") for i in (0, 1))
    same = compare(route, other, truth=0).report
    monkeypatch.setattr(DejaVu().descriptor.__class__, "hog_of", lambda *_: None)  # described once more
    again = compare(route, other, truth=0).report
    assert again.contenders["hog"].scores == same.contenders["hog"].scores
