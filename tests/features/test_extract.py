"""Features of a traverse, batch by batch."""

from __future__ import annotations

import re

import pytest
import torch
from helpers import refused
from torch import Tensor, nn

from dejavu_torch import HOG, Embedding, Traverse, text, types
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.extract import feature_batches, warn_of_raw
from dejavu_torch.features.joined import Joined


def test_a_large_network_that_gets_frames_as_they_are_is_told_of_once(caplog):
    """Not one whose frames are prepared, nor a small one."""
    large = nn.Sequential(nn.Flatten(), nn.Linear(64, 16_000), nn.Linear(16_000, 4))
    small, frames = nn.Sequential(nn.Flatten(), nn.Linear(64, 4)), torch.rand(2, 1, 8, 8)
    bare = Embedding(large, 4, 1, (8, 8))
    for module in (small, Embedding(large, 4, 1, (8, 8), mean=0.5, std=0.2), HOG(cell=2), bare, bare):
        warn_of_raw(module, frames)
    warn_of_raw(Joined([HOG(cell=2), large]), frames[..., :7])
    assert [record.message.partition(" pixels")[0] for record in caplog.records] == [
        "Sequential gets frames of 8 x 8",
        "Sequential gets frames of 8 x 7",
    ]
    assert all("mean and std of dejavu_torch.Embedding" in record.message for record in caplog.records)


class Given(Traverse):
    """The given frames, whatever they are."""

    name = "the list"

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __len__(self):
        return len(self.values)

    def read(self, frames):
        return self.values[torch.as_tensor(frames)]


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
