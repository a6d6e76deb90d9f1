"""A descriptor's stretches of frames that look alike, and codes that are learned of a descriptor."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused
from small_training import (
    FRAMES,
    backbone,
    coded,
    data_of,
    fit,
    footage,
    new_descriptor,
    new_task,
    recall,
    still,
    trainer,
    warned,
)
from torch import nn

from dejavu_torch import HOG, SpectralMapper
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.training.datamodule import StoredFrames
from dejavu_torch.training.descriptors import similar_span


def stored(*routes):
    count = sum(map(len, routes))
    return StoredFrames([(255 * one).byte() for one in routes], as_ground_truth(torch.arange(count)[:, None]))


def slid(step, count=200, noise=0.0, seed=0):
    """A window of 64 x 64 pixels, slid so many pixels a frame along a picture in which nothing repeats."""
    random = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, 4, (64 + step * count) // 16 + 1, generator=random)
    picture = nn.functional.interpolate(coarse, scale_factor=16, mode="bicubic")[0]
    frames = torch.stack([picture[:, :, step * i : step * i + 64] for i in range(count)])
    return (frames + noise * torch.randn(frames.shape, generator=random)).clamp(0, 1)


@pytest.mark.parametrize(("step", "noise", "expected"), [(1, 0.0, 5), (1, 0.1, 5), (80, 0.0, 1)])
def test_a_stretch_is_as_long_as_frames_stay_alike(step, noise, expected):
    frames = slid(step, noise=noise)
    assert similar_span(stored(frames), [200], 5) == expected
    assert [similar_span(stored(frames), [200], most) for most in (1, 0)] == [1, 1]  # the tolerance at most
    stop = torch.cat([frames[:100], frames[100:101].expand(60, -1, -1, -1), frames[100:]])
    assert similar_span(stored(stop), [260], 5) == expected


def test_places_are_right_within_a_stretch(tmp_path, caplog):
    task = new_descriptor(backbone=backbone(), mapper=SpectralMapper(6.0))
    fit(tmp_path, task, data_of(slid(80), tolerance=5), max_steps=1)
    assert (task.every, len(task.proxies)) == (1, 200)
    assert (task.tolerance, task.metric.tolerance) == (1, 5)
    assert task.chance() == {"descriptor": pytest.approx(math.log(200 / 3))}
    (line,) = [line for line in warned(caplog) if "stay similar" in line]
    assert all(fact in line for fact in ("for 1, fewer than data.tolerance 5", "dejavu learn"))


# codes ---------------------------------------------------------------------------------------------------


def code_of(folder, **settings):
    task = new_task(backbone=coded(network=HOG()))
    trainer(folder).fit(task, data_of(**settings))
    assert task.views is not None
    return task


def test_a_code_is_learned_of_a_network_that_stays(tmp_path):
    embedding = coded()
    before = {name: value.clone() for name, value in embedding.state_dict().items()}
    fit(tmp_path, new_task(backbone=embedding, weight_bits=32), data_of())
    after = embedding.state_dict()
    changed = {n for n in after if not torch.equal(before[n], after[n]) and "num_" not in n}
    assert {name.partition(".")[0] for name in changed} == {"linear", "standardise"}
    assert after["linear.whitened"]


def test_what_is_learned_finds_places_on_another_day(tmp_path):
    mild = still(noise=0.1, exposure=(0.1, 0.1))
    given = {"max_steps": 300, "limit_val_batches": 0}
    fit(tmp_path / "one", new_descriptor(), data_of(augmentation=mild), **given)
    start = str(tmp_path / "one" / "map.safetensors")
    task = new_task(backbone=coded(hidden=64, noise=0.5), start=start)
    assert recall(fit(tmp_path / "two", task, data_of(augmentation=mild), **given), footage(0.05)) > 0.7


def test_a_second_traverse_tells_what_a_season_changes(tmp_path):
    """Winter is darker at the left: without augmentation that is all the change that there is."""
    winter = (footage().float() * torch.linspace(0.2, 1, 16)).byte()
    given = {"second": ArrayTraverse(winter), "second_truth": "0", "augmentation": still()}
    views, _ = code_of(tmp_path / "both", **given).views  # type: ignore[misc]
    assert len({tuple(view) for view in views.tolist()}) == 2 * FRAMES
    with refused("data.augmentation changes nothing", "data.second"):
        code_of(tmp_path / "one", augmentation=still())


def test_frames_of_no_known_place_are_not_learned_from(tmp_path):
    truth = tmp_path / "truth.csv"
    truth.write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(10)))
    given = {"second": ArrayTraverse(footage(0.1)), "second_truth": str(truth), "batch_size": 2}
    views, positives = code_of(tmp_path, **given).views  # type: ignore[misc]
    assert positives.min() == 0
    assert len(views) == len(positives) == 10 * (FRAMES + 10)
