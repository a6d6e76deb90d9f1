"""Frames and their right places, in batches: what is drawn, how often, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from devices import pretend
from footage import QUERY, REFERENCE, camera
from footage import footage as ground
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.training import datamodule
from dejavu_torch.training.datamodule import Batch, Clips, RouteData, as_frames, store


def numbered(frames, first=0, side=8):
    """Frames that show their number: all pixels of frame i are first + i."""
    numbers = torch.arange(first, first + frames, dtype=torch.uint8)
    return ArrayTraverse(numbers[:, None, None].expand(frames, side, side), f"from {first}")


def route(frames=24, stage="fit", **settings):
    """A route that is read; its loaders give the frames as they are."""
    data = RouteData(numbered(frames), **{"tolerance": 2, "batch_size": 8} | settings)
    data.setup(stage)
    return data


# right places --------------------------------------------------------------------------------------------


def test_every_frame_is_drawn_once_an_epoch_with_the_places_it_shows(tmp_path):
    (tmp_path / "truth.csv").write_text("0,5\n1\n2,7,9,11\n3,-1\n")  # 4 and on are not known
    data = route(second=numbered(8, 100), second_truth=str(tmp_path / "truth.csv"))
    seen = {}
    for frames, truth in data.train_dataloader():
        assert frames.dtype == torch.float32
        for frame, right in zip(frames, truth.positives.tolist(), strict=True):
            assert frame.unique().numel() == 1
            seen.setdefault(round(float(frame[0, 0, 0]) * 255), []).append([p for p in right if p >= 0])
    second = [[5], [], [7, 9, 11], [], [], [], [], []]
    assert seen == {i: [[i]] for i in range(24)} | {100 + i: [right] for i, right in enumerate(second)}


def test_a_second_traverse_is_placed_by_what_it_shows_not_by_its_length(caplog):
    road, again = (open_source(f"sim:aerial?frames=200&traverse={i}") for i in (0, 1))
    data = RouteData(ArrayTraverse(road[:160], "road"), second=ArrayTraverse(again[40:], "again"))
    data.setup("fit")
    places = data.sets["second"].truth.positives[:, 0]
    sure, shown = places >= 0, torch.arange(160) + 40
    assert sure.float().mean() > 0.6
    on = sure & (shown < 160)
    assert ((places - shown)[on].abs() <= 5).float().mean() > 0.98
    assert f"{int(sure.sum())} of 160 frames of again placed, at place = 1.00 frame + " in caplog.text


def test_what_is_judged_and_ignored_reaches_the_metric(tmp_path):
    hard, soft = np.zeros((24, 6), bool), np.zeros((24, 6), bool)
    hard[[3, 4], 1] = soft[9, 2] = hard[8, 2] = True
    np.savez(tmp_path / "truth.npz", GThard=hard, GTsoft=soft)
    data = route(stage="test", query=numbered(6, 100), truth=str(tmp_path / "truth.npz"), batch_size=4)
    batches = [batch.truth for batch in data.test_dataloader()]
    truth = GroundTruth(*(torch.cat(column) for column in zip(*batches, strict=True)))
    assert truth.positives[1].tolist() == [3, 4]
    assert truth.ignored[2].tolist() == [9]
    assert truth.judged.tolist() == [True] * 6
    (tmp_path / "truth.csv").write_text("0,5\n1\n2,7\n")
    data = route(stage="test", query=numbered(6, 100), truth=str(tmp_path / "truth.csv"))
    (batch,) = data.test_dataloader()
    assert batch.truth.judged.tolist() == [True] * 3 + [False] * 3
    assert batch.truth.positives.tolist() == [[5], [-1], [7], [-1], [-1], [-1]]


def test_validation_and_query_come_in_order_as_they_are():
    data = route(validation=numbered(24, 100), validation_truth="0", query=numbered(20, 200), truth="2")
    data.setup("test")
    for loader, there, shift in (
        (data.val_dataloader(), numbered(24, 100), 0),
        (data.test_dataloader(), numbered(20, 200), 2),  # the last batch is not full, and counts
    ):
        batches = list(loader)
        assert len(batches) == len(loader) == 3
        assert torch.equal(torch.cat([batch.frames for batch in batches]), as_frames(store(there)))
        right = torch.cat([batch.truth.positives[:, 0] for batch in batches])
        assert right.tolist() == list(range(shift, shift + len(right)))


def test_other_traverses_come_at_the_reference_s_steps(tmp_path):
    """Of their own they would take twice as large ones, and their truth tells frames."""
    nearest = (REFERENCE - QUERY[:, None]).abs().argmin(1).tolist()
    (tmp_path / "truth.csv").write_text("".join(f"{q},{p}\n" for q, p in enumerate(nearest)))
    other, truth = ArrayTraverse(ground(QUERY)), str(tmp_path / "truth.csv")
    given = {"second": other, "second_truth": truth, "query": other, "truth": truth}
    data = RouteData(ArrayTraverse(ground(REFERENCE)), velocity=camera(step=None), **given)
    data.setup("fit")
    for name in ("reference", "second", "query"):
        right = data.sets[name].truth.positives
        assert len(right) == 600 // 4 + 1
        assert data.sets[name].truth.judged.all()
        apart = (right - torch.arange(151)[:, None]).abs().masked_fill(right < 0, 999).amin(1)
        assert apart.max() <= 3  # the other shows each frame twice


# batches -------------------------------------------------------------------------------------------------


def runs_of(lengths):
    """Of traverses, one after the other."""
    return [range(sum(lengths[:i]), sum(lengths[: i + 1])) for i in range(len(lengths))]


@given(
    lengths=st.lists(st.integers(0, 40), min_size=1, max_size=3),
    clip=st.integers(1, 5),
    clips=st.integers(1, 8),
    seed=st.integers(0, 99),
)
def test_clips(lengths, clip, clips, seed):
    if max(lengths) < clip:
        lengths = [*lengths, clip]
    torch.manual_seed(seed)
    sampler = Clips(runs_of(lengths), clip * clips, clip)
    batches = list(sampler)
    there = sum(length // clip for length in lengths)
    size = clip * min(clips, there)
    assert [len(batch) for batch in batches] == [size] * len(sampler)
    assert 0 <= there * clip - len(batches) * size < size  # what is left makes no batch
    frames = torch.tensor(batches).reshape(-1, clip)
    assert frames.unique().numel() == frames.numel()
    assert int(frames.min()) >= 0
    assert int(frames.max()) < sum(lengths)
    assert (frames.diff(dim=1) == 1).all()
    traverse = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))[frames]
    assert (traverse == traverse[:, :1]).all()
    torch.manual_seed(seed)
    assert list(Clips(runs_of(lengths), clip * clips, clip)) == batches


# augmentation --------------------------------------------------------------------------------------------


def test_a_clip_gets_one_change_and_a_validation_the_same_each_time():
    data, frames = route(augmentation=Augmentation(noise=0.0)), torch.rand(1, 1, 8, 8).expand(8, 1, 8, 8)
    clips = data.augmented(frames, 4).unflatten(0, (2, 4))
    torch.testing.assert_close(clips, clips[:, :1].expand_as(clips))
    assert not torch.allclose(clips[0], clips[1], atol=1e-3)
    batches = [Batch(frames, as_ground_truth(torch.arange(first, first + 8)[:, None])) for first in (0, 8)]
    first = data.validated(batches[0])
    assert torch.equal(data.validated(batches[0]), first)
    for other in (data.validated(batches[1]), frames):
        assert not torch.allclose(other, first, atol=1e-3)


# what is kept, and what is refused -----------------------------------------------------------------------


def test_frames_are_kept_as_bytes_and_resized(monkeypatch):
    """With room for a batch alone: what is stored of all of them may lie in a file."""
    monkeypatch.setattr("dejavu_torch.memory.free_memory", lambda: 4.0 * 64 * 12 * 16)
    values = store(numbered(200, side=24), (12, 16))
    assert (values.shape, values.dtype) == ((200, 1, 12, 16), torch.uint8)
    assert values[:, 0, 5, 5].tolist() == list(range(200))
    with refused("in frames of 12 x 17", "free"):
        store(numbered(200), (12, 17))
    assert store(ArrayTraverse(torch.full((2, 3, 4, 4), 0.5))).unique().tolist() == [128]


class Mixed(ArrayTraverse):
    """Frames of two sizes."""

    def batches(self, size=64):
        yield torch.rand(12, 1, 4, 4)
        yield torch.rand(12, 1, 4, 5)


@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        ({"tolerance": -1}, ("tolerance is -1",)),
        ({"clip": 0}, ("clip 0",)),
        ({"batch_size": 1}, ("batch_size 1", "at least 2 frames")),
        ({"batch_size": 10, "clip": 4}, ("batch_size 10, clip 4", "whole clips")),
        ({"clip": 32, "batch_size": 32}, ("clip is 32", "24 frames")),
        ({"held_out": 0.6}, ("held_out is 0.6", "from 0 to 0.5")),
        ({"resize": (0, 4)}, ("resize is (0, 4)", "(height, width)")),
        ({"tolerance": 24}, ("from 0 has 24 frames", "tolerance is 24", "longer")),
        ({"frames": 1, "tolerance": 0}, ("from 0 has 1 frame and", "longer")),
        ({"validation": numbered(20, 100)}, ("from 100", "20 frames", "24 places", "data.validation_truth")),
        ({"query": numbered(24, 100)}, ("from 100", "expected data.truth")),  # before the training
        ({"stage": "test"}, ("nothing to test on", "data.query")),
        ({"second": numbered(24, 100, side=9)}, ("(1, 9, 9)", "(1, 8, 8)", "same channels", "data.resize")),
        ({"second": numbered(24, 100), "second_truth": "nix"}, ("truth 'nix'", "offset")),
        (
            {"second": numbered(24, 100)},
            ("24 frames of from 100", "data.second_truth, such as 0"),
        ),
        ({"second": "nowhere"}, ("nowhere is not there",)),
        ({"second": Mixed(torch.rand(24, 1, 4, 4))}, ("(1, 4, 4) and of (1, 4, 5)", "data.resize")),
        ({"second": ArrayTraverse(torch.full((24, 1, 8, 8), torch.nan))}, ("the array holds NaN",)),
        ({"query": 3.5}, ("query is of type float", "a path, a Traverse, or a tensor")),
    ],
    ids=lambda value: " ".join(value),
)
def test_what_does_not_fit_is_refused(settings, facts):
    with refused(*facts):
        route(**settings).train_dataloader()


def test_frames_move_to_the_device_that_trains_if_they_fit(monkeypatch):
    with pretend() as device:
        for free, moved in ((10**9, True), (0, False)):
            monkeypatch.setattr(datamodule, "free_memory", lambda free=free: free)
            data = RouteData(torch.rand(12, 3, 4, 4), tolerance=2)
            data.setup("fit")
            stored = data.sets["reference"]
            here = stored[[3, 5]].frames
            stored.move(device)
            assert (stored.values.device == device) is moved
            assert torch.equal(stored[[3, 5]].frames.cpu(), here)
