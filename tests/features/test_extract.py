"""Features of a traverse, batch by batch."""

from __future__ import annotations

import io
import re
import sys

import pytest
import torch
from helpers import refused
from torch import Tensor, nn

from dejavu_torch import HOG, Traverse, text, types
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.extract import feature_batches, features_of
from dejavu_torch.features.views import augmented_route


class Pooled(nn.Module):
    """Channel means through a layer with weights; remembers in which mode it ran."""

    def __init__(self, channels: int = 1) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels)
        self.modes = []

    def forward(self, frames):
        self.modes.append(self.training)
        return self.norm(frames).mean((2, 3))


class Given(Traverse):
    """The given frames, whatever they are."""

    name = "the list"

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __len__(self):
        return len(self.values)

    def read(self, frames):
        return self.values[torch.as_tensor(frames)]


def test_frames_go_through_the_module_in_order():
    frames = torch.rand(10, 1, 24, 24)
    whole = HOG()(frames)
    for size in (1, 3, 10, 64):
        batches = list(feature_batches(ArrayTraverse(frames), HOG(), size))
        assert max(len(batch) for batch in batches) <= size
        torch.testing.assert_close(torch.cat(batches), whole, rtol=0, atol=1e-6)


def test_runs_in_eval_mode_and_restores_the_mode_of_every_part():
    for whole, part in ((True, True), (True, False), (False, False)):
        module = Pooled().train(whole)
        module.norm.train(part)
        list(feature_batches(ArrayTraverse(torch.rand(5, 1, 4, 4)), module, 2))
        assert module.modes == [False] * 3
        assert (module.training, module.norm.training) == (whole, part)
        assert int(module.norm.num_batches_tracked) == 0


def test_restores_the_mode_after_an_error_and_when_abandoned():
    module = Pooled().train()
    frames = torch.rand(6, 1, 4, 4)
    batches = feature_batches(ArrayTraverse(frames), module, 2)
    next(batches)
    batches.close()
    assert module.training
    frames[3] = torch.nan
    with refused("frame 3"):
        list(feature_batches(ArrayTraverse(frames), module, 2))
    assert module.training


def test_batches_keep_no_gradients_and_features_of_one_do():
    frames = torch.rand(4, 1, 16, 16, requires_grad=True)
    for features in feature_batches(ArrayTraverse(frames), HOG(), 2):
        assert not features.requires_grad
    features_of(frames, HOG()).sum().backward()
    assert frames.grad is not None


def test_ready_features_pass_as_they_are():
    module = Pooled()
    features = torch.rand(7, 3)
    assert torch.equal(torch.cat(list(feature_batches(ArrayTraverse(features), module, 2))), features)
    assert module.modes == []


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("size", [1, 2, 64])
def test_a_bad_frame_is_named_by_its_number(bad, size):
    frames, features = torch.rand(8, 1, 16, 16), torch.rand(8, 3)
    frames[5, 0, 8, 8] = features[5, 1] = bad
    for values in (frames, features):
        with refused("frame 5 ", "NaN or infinite"):
            list(feature_batches(ArrayTraverse(values), HOG(), size))


@pytest.mark.parametrize(
    ("module", "values", "facts"),
    [
        (nn.Identity(), torch.rand(4, 1, 2, 2), ("(4, 1, 2, 2)", "(4, D)")),
        (nn.Flatten(0), torch.rand(4, 1, 2, 2), ("(4, 1, 2, 2)", "(4, D)")),
        (HOG(), torch.rand(2, 3, 4), ("the list", "(2, 3, 4)", "float frames")),
        (HOG(), torch.zeros(2, 1, 4, 4, dtype=torch.uint8), ("the list", "uint8", "float frames")),
        (HOG(), torch.zeros(2, 3).long(), ("the list", "int64", "float frames")),
        (HOG(), torch.zeros(0, 3), ("the list", "no frames")),
    ],
)
def test_what_is_refused(module, values, facts):
    with refused(*facts):
        list(feature_batches(Given(values), module))


def test_coarse_floats_become_float32():
    features = torch.rand(4, 3).bfloat16()
    assert next(feature_batches(Given(features), HOG())).dtype == torch.float32


def test_batches_of_large_frames_are_smaller(monkeypatch):
    monkeypatch.setattr(types, "BATCH_NUMBERS", 3 * 16 * 16 + 1)
    frames = torch.rand(7, 1, 16, 16)
    batches = list(feature_batches(ArrayTraverse(frames), HOG(), 64))
    assert [len(batch) for batch in batches] == [3, 3, 1]
    torch.testing.assert_close(torch.cat(batches), HOG()(frames))


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_bar_counts_frames_however_often_they_are_looked_at(monkeypatch):
    frames = ArrayTraverse(torch.rand(70, 1, 16, 16))
    (copies, *_), looks = augmented_route(frames, 70, 3, 10_000, {"noise": 0.01})
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("tqdm.std.time", iter(range(10**6)).__next__)  # each update is shown
    batches = list(feature_batches(copies, nn.Flatten(), 64, progress=True, verb=f"learning: {looks}"))
    assert sum(map(len, batches)) == 210
    counts = [tuple(map(int, pair)) for pair in re.findall(r"(\d+)/(\d+)", terminal.getvalue())]
    assert {total for _, total in counts} == {70}
    assert counts == sorted(counts)
    assert counts[-1] == (70, 70)
    assert "3 looks at each frame" in terminal.getvalue()
    assert augmented_route(frames, 70, 3, 100, {"noise": 0.01})[1] == "3 looks at 24 of the frames"
    assert augmented_route(frames, 70, 1, 100, {"noise": 0.01})[1] == "1 look at each frame"


def test_without_a_terminal_there_is_a_line_now_and_then(monkeypatch, capsys):
    frames = ArrayTraverse(torch.rand(100, 1, 4, 4))
    list(feature_batches(frames, nn.Flatten(), 1, progress=True, verb="learning"))
    assert capsys.readouterr().err == ""  # over at once
    clock = iter(range(10**6))
    monkeypatch.setattr(text.time, "monotonic", lambda: float(next(clock)))  # a second a frame
    list(feature_batches(frames, nn.Flatten(), 1, progress=True, verb="learning"))
    lines = capsys.readouterr().err.splitlines()
    assert [re.findall(r"\d+", line) for line in lines] == [["30", "100", "70"], ["90", "100", "10"]]
    assert all("learning" in line for line in lines)
    list(feature_batches(frames, nn.Flatten(), 1))
    assert capsys.readouterr().err == ""
