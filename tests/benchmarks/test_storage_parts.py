"""What a store of few bytes gives back: quantisers, and frames as a video codec gives them back."""

from __future__ import annotations

import av
import pytest
import torch
from helpers import all_of
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.coded_video import CodedVideo
from benchmarks.quantisers import every_kth, signs
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.baselines import as_int8


def route(places=300, numbers=12, seed=0):
    walk = torch.randn(places, numbers, generator=torch.Generator().manual_seed(seed)).cumsum(0)
    return normalize(walk, dim=1)


def error(kept, places):
    back = kept if isinstance(kept, Tensor) else kept.descriptors
    return float((back - places).square().mean())


def test_every_kth_place_gives_back_the_one_before():
    places = route()
    kept = every_kth(places, 7, each=48)
    assert torch.equal(kept.descriptors, places[torch.arange(300) // 7 * 7])
    assert (kept.route, kept.fixed, kept.apart) == (43 * 48, 0, 7)
    between = every_kth(places, 7, 12, as_int8, between=True, overhead=5)
    assert (between.route, between.apart) == (44 * 12 + 5, 1)  # and the last place
    assert error(between, places) < error(kept, places)
    assert signs(torch.tensor([[-0.5, 0.0, 3.0]])).tolist() == [[-1, 1, 1]]


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_fewer_bytes_of_a_video_give_back_less(codec):
    if codec not in av.codecs_available:
        pytest.skip(f"no {codec}")
    traverse = open_source("sim:aerial?frames=40")
    fine, coarse, third = (
        CodedVideo(traverse, codec, crf, step) for crf, step in ((10, 1), (45, 1), (10, 3))
    )
    assert fine.bytes > 2 * coarse.bytes > 0
    assert third.bytes < fine.bytes
    frames = all_of(traverse)
    errors = [float((all_of(coded) - frames).square().mean()) for coded in (fine, coarse)]
    still = float((frames[torch.randperm(40)] - frames).square().mean())
    assert errors[0] < min(errors[1], still / 4)  # and in their order
    last = (all_of(third)[-1] - frames).square().mean((1, 2, 3))
    assert (len(third), int(last.argmin())) == (14, 39)
