"""What a store of few bytes gives back: quantisers, and frames as a video codec gives them back."""

from __future__ import annotations

import av
import pytest
import torch
from helpers import all_of, refused
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.coded_video import CodedVideo
from benchmarks.quantisers import Quantiser, every_kth, principal, signs, spectral
from dejavu_torch.data.arrays import ArrayTraverse
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


def test_the_map_and_its_null_take_the_same_bytes_and_give_back_places_in_order():
    places = route()
    ours, null = spectral(places, 2.0), spectral(places, 2.0, seed=0)
    assert 0.9 * 600 < ours.route <= 600
    assert 0.9 * 600 < null.route <= 600
    assert error(ours, places) < error(null, places) < error(torch.zeros_like(places), places)


def test_all_components_give_back_all():
    places = route()
    few, whole = principal(places, 2), principal(places, 12)
    assert error(whole, places) < 1e-5 < error(few, places)
    assert (few.route, few.fixed) == (600, 2 * 12 + 2 * 4 + 12 * 4)


def test_longer_codes_give_back_more_also_of_padded_descriptors(capfd):
    pytest.importorskip("faiss")
    places, other = route(numbers=13), normalize(torch.randn(2000, 13), dim=1)
    codes = [Quantiser(other, f"PQ{m}x8np", m) for m in (1, 4, 12)]
    assert [(code.each, code.width) for code in codes] == [(1, 13), (4, 16), (12, 24)]
    errors = [error(code(places), places) for code in codes]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < error(torch.zeros_like(places), places) / 10
    assert codes[1](places).shape == places.shape
    assert capfd.readouterr().err == ""  # faiss warns of few places


@pytest.mark.parametrize(
    ("better", "worse"),
    [("OPQ3,PQ3x8np", "PQ3x8np"), ("RQ4x8", "RQ3x8"), ("LSQ3x8", "RQ1x8"), ("PRQ3x2x8", "PQ3x8np")],
)
def test_codes_of_numbers_that_go_together(better, worse):
    pytest.importorskip("faiss")
    torch.manual_seed(0)
    mixed = torch.randn(600, 12) * 0.6 ** torch.arange(12)  # some parts hold all, others nothing
    assert error(Quantiser(mixed, better)(mixed), mixed) < 0.9 * error(Quantiser(mixed, worse)(mixed), mixed)


@pytest.mark.parametrize(
    ("key", "each"), [("PCAR8,SQtqmse1", 1), ("RR16,RaBitQ", 2 + 8), ("RR16,EDEN", 2 + 8)]
)
def test_codes_without_codebooks_keep_directions(key, each):
    pytest.importorskip("faiss")
    places = normalize(torch.randn(200, 16, generator=torch.Generator().manual_seed(0)), dim=1)
    code = Quantiser(places, key)
    assert code.each == each
    nearest = (normalize(code(places), dim=1) @ places.T).argmax(1)
    assert (nearest == torch.arange(200)).float().mean() > (0.2 if each == 1 else 0.8)


def test_what_faiss_refuses_is_said():
    pytest.importorskip("faiss")
    with refused("faiss", "XQ7"):
        Quantiser(route(), "XQ7")
    with refused("faiss", "PCAR16,SQtqmse1"):
        Quantiser(route(), "PCAR16,SQtqmse1")  # of 12 numbers
    with refused("200 places", "at least 256"):
        Quantiser(route(200), "RQ4x8")


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


def test_grey_frames_of_odd_sizes_and_ready_features():
    if "libx264" not in av.codecs_available:
        pytest.skip("no libx264")
    traverse = ArrayTraverse(torch.rand(3, 1, 33, 17).round())
    assert all_of(CodedVideo(traverse, "libx264", 20)).shape == (3, 3, 33, 17)
    with refused("ready features", "expected frames"):
        CodedVideo(ArrayTraverse(torch.rand(5, 8)), "libx264", 20)
