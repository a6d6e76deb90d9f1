"""The whole method as one module: learn, localize, forward."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import pytest
import torch
from helpers import Fixed, refused, template_model
from PIL import Image
from torch import nn

from dejavu_torch import model as model_module
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.source import open_source
from dejavu_torch.features.extract import READY
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.growth import associate
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer, Match, Traverse

SIZE = 16


class Tiny(nn.Module):
    """A smooth backbone with 4 features."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(1, 4, 3)
        self.norm = nn.BatchNorm2d(4)
        self.drop = nn.Dropout(0.5)

    def forward(self, frames):
        return self.drop(torch.tanh(self.norm(self.conv(frames)))).mean((2, 3))


class Made(Traverse):
    """Features or frames made as they are asked for; counts its batches."""

    def __init__(self, make: Any, count: int) -> None:
        self.make, self.count, self.given = make, count, 0

    def __len__(self):
        return self.count

    def read(self, frames):
        self.given += 1
        return self.make(torch.as_tensor(frames))


def layers(*periods, stop=72, features=4):
    chosen = tuple(range(features))
    return Fixed(*(FrequencyLayer(Fraction(tau), tau, 0, stop, chosen) for tau in periods))


def waves(frames=72, dtype=torch.float32):
    """Two features that repeat, after 8 and after 9 frames."""
    return torch.arange(frames)[:, None] % torch.tensor([8, 9], dtype=dtype)


def pictures(frames=72, dtype=torch.float32):
    """The left half of the frame repeats after 8 frames, the right half after 9."""
    random = torch.Generator().manual_seed(0)
    left, right = (torch.rand(p, 1, SIZE, SIZE, generator=random, dtype=dtype) for p in (8, 9))
    left[..., -1] = right[..., 0] = 0.5  # so that no gradient sees both
    at = torch.arange(frames)
    return torch.cat([left[at % 8], right[at % 9]], 3)


def wave_model(**arguments):
    return template_model(periods=SpectrogramAnalysis(window=72, strongest=1), **arguments)


# what goes in and what comes out


def test_features_that_repeat_are_found_exactly():
    model = wave_model().learn(waves())
    assert [layer.period for layer in model.map.plan] == [8, 9]
    match = model.localize(waves())
    assert isinstance(match, Match)
    assert match.index.tolist() == list(range(72))
    assert match.score.tolist() == [0.0] * 72
    assert match.accepted.all()


@pytest.mark.parametrize("make", [waves, pictures])
def test_tensors_traverses_and_batch_sizes_agree(make):
    values = make()
    whole = wave_model(batch_size=1000).learn(values)
    other = wave_model(batch_size=7).learn(ArrayTraverse(values))
    assert other.map.plan == whole.map.plan
    torch.testing.assert_close(other.map.templates, whole.map.templates)
    query = values[::5] + 0.01
    expected = whole.localize(query)
    for source in (query, ArrayTraverse(query), Made(lambda at: query[at], len(query))):
        found = other.localize(source)
        assert torch.equal(found.index, expected.index)
        torch.testing.assert_close(found.score, expected.score)


def test_a_model_prints_as_one_line():
    assert repr(DejaVu()) == "DejaVu(no map yet, HOG,Distilled)"
    model = wave_model()
    assert repr(model) == f"DejaVu(no map yet, {type(model.features).__name__})"
    size = round(model.learn(waves()).summary().map_bytes / 1e3)
    assert repr(model) == f"DejaVu(72 places, template map of {size} kB, ready features -> 2)"
    seen = DejaVu(HOG(), whitening="none").learn(pictures())
    size = round(seen.summary().map_bytes / 1e3)
    assert str(seen) == f"DejaVu(72 places, spectral map of {size} kB, HOG -> {seen.map.dimension})"


def test_preprocessing_comes_ahead_of_the_features_everywhere(tmp_path):
    frames = torch.rand(40, 3, SIZE, SIZE)
    by_hand = Preprocess("R-B", "patch", patch=5)(frames)
    model = template_model(preprocess=Preprocess("R-B", "patch", patch=5), periods=layers(8, stop=40))
    plain = template_model(periods=layers(8, stop=40)).learn(by_hand)
    model.learn(frames)
    assert torch.equal(model.map.templates, plain.map.templates)
    assert torch.equal(model(frames[:3]), plain(by_hand[:3]))
    assert torch.equal(model.localize(frames).score, plain.localize(by_hand).score)
    model.save(tmp_path / "map.safetensors")
    loaded = DejaVu.load(tmp_path / "map.safetensors")
    assert torch.equal(loaded(frames[:3]), model(frames[:3]))


def test_queries_of_another_size_with_as_many_features_are_told_of(caplog):
    wave_model(features=HOG()).learn(torch.rand(72, 1, 32, 16)).localize(torch.rand(3, 1, 16, 32))
    assert "1 x 16 x 32" in caplog.text


def test_so_many_features_are_told_of(monkeypatch, caplog):
    monkeypatch.setattr(model_module, "MANY_FEATURES", 50)
    template_model().learn(torch.rand(40, 200))  # ready features: nothing to be done about them
    assert "smaller frames" not in caplog.text
    template_model().learn(pictures())
    assert "each frame gives 108 features; smaller frames" in caplog.text


# training and deployment give equal scores


@pytest.mark.parametrize("most", [1.4, 255.0])
def test_frames_that_are_not_in_0_to_1_are_warned_of_once(most, caplog):
    frames = pictures(40)
    frames = frames / frames.max() * most
    model = DejaVu(Tiny(), Whitening(views=2)).learn(frames)
    lines = [line for line in caplog.messages if "[0, 1]" in line]
    assert [("255" in line, "40" in line) for line in lines] == [(True, False)] * (most > 2)
    caplog.clear()
    for _ in range(2):
        model.localize(ArrayTraverse(frames[:30], "a drive"))
    assert len([line for line in caplog.messages if "255" in line]) == (most > 2)
    caplog.clear()
    DejaVu().learn(torch.rand(40, 9) * most)  # ready features
    assert not caplog.text


# networks that look at other frames of a batch


class Attending(nn.Module):
    """Adds to each frame's features a share of the mean of its batch."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share
        self.sizes = []

    def forward(self, frames):
        self.sizes.append(len(frames))
        features = nn.functional.avg_pool2d(frames, 4).flatten(1)
        return features + self.share * (features.mean(0) - features)


def test_a_network_that_attends_to_its_batch_is_refused_but_frame_by_frame():
    frames = pictures(40)
    with refused("frame 0", "39 others", "--batch_size 1"):
        DejaVu(Attending(0.1), "none").learn(frames)
    with refused("frame 0", "39 others"):
        DejaVu(Attending(0.1)).learn(frames)
    network = Attending(0.1)
    model = DejaVu(network, "none", batch_size=1).learn(frames)
    found = model.localize(frames[5:15]).index
    assert torch.equal(found, torch.arange(5, 15))
    assert set(network.sizes) == {1}


def test_what_rounding_changes_is_not_refused():
    frames = pictures(40)
    network = Attending(1e-4)
    DejaVu(network, "none").learn(frames)
    assert network.sizes == [40, 1, 1]  # one frame more is described, and the probe
    DejaVu(Attending(0.1), "none").learn(frames.flatten(1)[:, :60])  # ready features
    with torch.autocast("cpu", torch.bfloat16):
        DejaVu(Attending(2e-2), "none").learn(frames)


# gradients


def test_gradcheck_from_frames_to_scores():
    torch.manual_seed(0)
    model = template_model(Tiny(), layers(8, 9)).double().eval()
    model.learn(pictures(dtype=torch.float64))
    frames = torch.rand(2, 1, 6, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(model, frames)


# a route in which nothing repeats, and bad input


def test_a_constant_route_gives_a_map_without_layers():
    for values in (torch.full((72, 3), 0.3), torch.full((72, 1, SIZE, SIZE), 0.3)):
        model = wave_model().learn(values)
        assert model.map.plan == ()
        assert (model.map.places, model.summary().covered) == (72, 0)
        match = model.localize(values[:5])
        assert match.index.tolist() == [-1] * 5
        assert match.score.tolist() == [float("inf")] * 5
        assert not match.accepted.any()
        assert model(values[:5]).isposinf().all()


def test_a_frame_that_is_not_finite_is_named():
    for make, bad in ((waves, torch.nan), (pictures, torch.inf)):
        values = make()
        values[41].view(-1)[1] = bad
        with refused("frame 41", "NaN", "expected none"):
            wave_model(batch_size=8).learn(values)
        model = wave_model(batch_size=8).learn(make())
        with refused("frame 41", "NaN"):
            model.localize(values)


def test_large_frames_are_reduced_and_queries_follow(tmp_path, caplog):
    small = torch.rand(24, 1, 20, 40, generator=torch.Generator().manual_seed(0))
    large = nn.functional.interpolate(small, scale_factor=8, mode="nearest")  # 160 x 320
    model = DejaVu(HOG(cell=4), Whitening(views=1)).learn(large)
    assert model.frame_shape == (1, 80, 160)
    assert [text for text in caplog.messages if "160 x 320 pixels are resized to 80 x 160" in text]
    model.save(tmp_path / "map.safetensors")
    for known in (model.eval(), DejaVu.load(tmp_path / "map.safetensors")):
        for frames in (large, large[..., ::2, ::2], nn.functional.interpolate(small, scale_factor=3)):
            assert known.localize(frames).index.tolist() == [*range(24)]
            assert known(frames).argmin(1).tolist() == [*range(24)]
    views = associate(model, ArrayTraverse(large), ArrayTraverse(large), "0")
    assert views.traverse.frame_shape == (1, 80, 160)
    caplog.clear()
    for frames in large[:3]:
        model.localize(frames[None])
    assert len(caplog.messages) <= 1  # told once
    large.requires_grad_()
    assert not model.localize(large[:1]).score.requires_grad
    model(large[:1]).sum().backward()
    assert large.grad is not None
    assert large.grad.isfinite().all()


def test_frames_keep_their_size_where_it_was_asked_for(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for i in range(3):
        Image.new("L", (400, 200), 40 * i).save(images / f"{i}.png")
    model = DejaVu()
    assert model.at_map_size(open_source(images)).frame_shape == (1, 80, 160)
    assert model.at_map_size(open_source(f"{images}?width=300&start=1")).frame_shape == (1, 150, 300)
    assert DejaVu(HOG(resize=(100, 100))).at_map_size(open_source(images)).frame_shape == (1, 100, 200)
    for size, shape in ((None, (1, 200, 400)), (50, (1, 25, 50))):
        small = DejaVu(preprocess=Preprocess(size=size)).at_map_size(open_source(images))
        assert small.frame_shape == shape
    for size in (0, 1.5):
        with refused("size=", "at least 1"):
            Preprocess(size=size)  # type: ignore[arg-type]


@pytest.mark.parametrize("training", [True, False])
def test_learning_ends_in_eval_mode_and_matching_restores_the_mode(training):
    model = template_model(Tiny(), layers(8)).train()
    before = {name: value.clone() for name, value in model.features.state_dict().items()}
    model.learn(pictures())
    assert not any(module.training for module in model.modules())
    model.train(training)
    model.features.norm.eval()  # each part gets its own mode back
    model.localize(pictures(5))
    with refused("NaN"):
        model.localize(torch.full((2, 1, SIZE, SIZE), torch.nan))
    modes = [part.training for part in (model.features, model.features.conv, model.features.norm)]
    assert modes == [training, training, False]
    assert all(torch.equal(before[name], value) for name, value in model.features.state_dict().items())


class Paired(nn.Module):
    """Makes features and something else, as many networks do."""

    def forward(self, frames):
        return frames.flatten(1), 1


class Wrong(nn.Module):
    """Makes no features."""

    def forward(self, frames):
        return frames.flatten(1)[:1]


def on_waves(query):
    return wave_model().learn(waves()).localize(query)


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda: DejaVu().localize(waves()), ("no map yet", "learn")),
        (lambda: DejaVu()(waves()), ("no map yet", "learn")),
        (lambda: wave_model().learn(waves(7)), ("7 place", "expected at least 8")),
        (
            lambda: template_model(periods=SpectrogramAnalysis(short="refuse")).learn(waves()),
            ("72 places", "1024"),
        ),
        (lambda: on_waves(torch.rand(3, 5)), ("the array gives 5 features", "expects 2")),
        (lambda: wave_model().learn(waves())(torch.rand(3, 1)), ("the query gives 1 features", "expects 2")),
        (
            lambda: wave_model().learn(pictures()).localize(torch.rand(3, 1, 32, 32)),
            ("32 x 32", "324 features", "expected 108"),
        ),
        (
            lambda: DejaVu().learn(pictures()).localize(torch.rand(3, 5)),
            ("the array gives 5 features", "1548, as frames of 1 x 16 x 32 give"),
        ),
        (lambda: DejaVu().learn(torch.rand(1, 6)), ("the array has 1 frame", "at least 2")),
        (lambda: on_waves(pictures(3)), ("frames", "ready features", "expected features (Q, 2)")),
        *(
            (lambda values=values: wave_model().learn(values), (str(tuple(values.shape)), "expected frames"))
            for values in (torch.zeros(72), torch.zeros(72, 2, dtype=torch.int64), torch.zeros(72, 3, 4))
        ),
        (lambda: wave_model().learn(torch.zeros(0, 2)), ("(0, 2)", "expected frames")),
        (lambda: wave_model().learn(Made(waves, 0)), ("no frames",)),
        (
            lambda: template_model(Wrong(), layers(8)).learn(pictures()),
            ("Wrong", "expected features (64, D)"),
        ),
        (
            lambda: template_model(Paired(), layers(8)).learn(pictures()),
            ("Paired made a tuple", "expected features (64, D)"),
        ),
        (lambda: DejaVu(batch_size=0), ("batch_size is 0", "expected")),
        (lambda: DejaVu(threshold=torch.nan), ("threshold is nan", "expected")),
        (lambda: template_model(metric="l7"), ("'l7'", "expected")),
        (lambda: template_model(reduction="median"), ("'median'", "expected")),
        (lambda: template_model(temperature=0.0), ("temperature", "expected")),
    ],
)
def test_what_is_refused(use, words):
    with refused(*words):
        use()


def test_queries_are_read_as_they_are_matched_in_constant_memory(largest_tensor):
    model = wave_model(batch_size=4).learn(waves())
    made, numbers = Made(lambda at: waves()[at % 72], 5 * READY), set()
    for i, match in enumerate(model.matches(made)):  # ready features come in larger batches than frames
        assert match.index.tolist() == [(READY * i + j) % 72 for j in range(READY)]
        assert made.given <= i + 5
    for batches in (3, 12):
        with largest_tensor() as seen:
            found = [*model.matches(Made(lambda at: waves()[at % 72], batches * READY))]
            assert len(found) == batches
        numbers.add(seen.numel)
    assert len(numbers) == 1
    assert numbers.pop() <= READY * 72
