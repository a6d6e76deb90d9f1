"""`DejaVu` with whitening and a spectral map, from frames to places."""

from __future__ import annotations

import pytest
import torch
from helpers import all_of, refused

from dejavu_torch import HOG, DejaVu, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.traverse import frame_range
from dejavu_torch.features.views import LabelledFrames, augmented_route
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.growth import second_traverse
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap

FRAMES = 200


def near_share(model, traverse):
    """Of the frames, that are found within 5 places."""
    return float(((model.localize(traverse).index - torch.arange(FRAMES)).abs() <= 5).float().mean())


@pytest.fixture(scope="module")
def reference():
    return open_source(f"sim:aerial?frames={FRAMES}")


@pytest.fixture(scope="module")
def second():
    return open_source(f"sim:aerial?frames={FRAMES}&traverse=1")


def spectral(**settings):
    few = {"views": 4}  # sooner than those of a short route
    return DejaVu(whitening=Whitening(**(few | settings)), mapper=SpectralMapper())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def model(reference):
    return spectral().learn(reference)


def test_a_second_traverse_is_found(model, reference, second):
    assert near_share(model, second) > 0.95
    assert isinstance(model.map, SpectralMap)
    halves = (1764 + 1440 + 2 * 100) * 100 / 2  # half a byte for each number of a projection
    assert halves < model.summary().fixed["whitening"] < 1.02 * halves
    few = DejaVu(mapper=SpectralMapper(5.0))
    few.descriptor.take(model.descriptor, whitening=True)
    assert near_share(few.learn(reference), second) > 0.95
    assert 4.8 * FRAMES <= few.summary().route_bytes <= 5 * FRAMES


def test_two_runs_give_the_same_map(model, reference):
    torch.manual_seed(5)  # of the caller: not of the copies
    again, other = spectral().learn(reference), spectral(seed=1).learn(reference)
    projection = "descriptor.whitening.projection"
    states = [one.state_dict() for one in (model, again, other)]
    assert torch.equal(states[0][projection], states[1][projection])
    for name in ("map.streams", "map.steps", "map.means"):
        assert torch.equal(states[0][name], states[1][name])
    assert not torch.equal(states[0][projection], states[2][projection])


def test_frames_that_show_no_place_are_left_out(reference, second):
    part = open_source(f"sim:aerial?frames={FRAMES}&traverse=1&start=100")
    shown = torch.arange(FRAMES).where(torch.arange(FRAMES) >= 100, -1)
    learned = [
        spectral(numbers=20).learn(reference, second=views)
        for views in (LabelledFrames(second, shown), LabelledFrames(part, shown[100:]))
    ]
    first, other = (model.whitening.unpacked.int() for model in learned)  # type: ignore[union-attr]
    assert (first - other).abs().max() <= 1  # a step of rounding


def test_views_of_a_second_traverse(reference, second):
    model = spectral()
    views = second_traverse(model, reference, second)
    assert views.traverse is second
    assert (views.places - torch.arange(FRAMES)).abs().max() <= 2  # by the positions that both carry
    assert second_traverse(model, reference, second, "190").places.tolist() == [*range(190, 200), *[-1] * 190]
    plain = ArrayTraverse(torch.rand(FRAMES, 1, 9, 9), "plain"), ArrayTraverse(torch.rand(9, 1, 9, 9), "few")
    assert second_traverse(model, plain[0], plain[0], "0").places.tolist() == list(range(FRAMES))
    again = second_traverse(model, plain[0][:], plain[0][:], "0")  # tensors, as `learn` takes them
    assert again.places.tolist() == list(range(FRAMES))
    with refused("plain", "9 frames of few", "--second_truth"):
        second_traverse(model, *plain)
    with refused("no whitening", "few"):
        second_traverse(DejaVu(whitening="none"), *plain, "0")
    with refused("no whitening", "few"):
        DejaVu(whitening="none").learn(plain[0], second=LabelledFrames(plain[1], torch.arange(9)))


def test_a_failed_relearning_keeps_map_and_whitening(reference, second):
    model = DejaVu(whitening=Whitening(views=4), mapper=SpectralMapper(200.0)).learn(reference)
    frames = next(iter(second.batches(8)))
    before = model(frames)
    with refused("route_bytes_per_place is 200"):
        model.learn(open_source("sim:aerial?frames=40"))  # 20 numbers
    assert torch.equal(model(frames), before)


def test_copies_are_those_of_the_seed_and_in_order(reference):
    (copies, places, _), _ = augmented_route(reference, FRAMES, copies=3, most=60, strengths={}, seed=4)
    assert len(copies) == 60
    assert places.tolist() == 3 * list(range(0, FRAMES, 10))  # one block
    frames = all_of(copies, 12)
    torch.manual_seed(1)
    assert frames.shape == (60, *reference.frame_shape)
    assert torch.equal(all_of(copies, 50), frames)
    own = all_of(reference)[places]
    strangers = own.roll(7, 0)
    assert (
        (frames - own).abs().mean((1, 2, 3)) < (frames - strangers).abs().mean((1, 2, 3))
    ).float().mean() > 0.7
    with refused("ready features", "frames to augment"):
        augmented_route(ArrayTraverse(torch.rand(9, 2), "nine"), 9, 1, 9, {})
    with refused("colour2", "occlusion"):
        augmented_route(reference, FRAMES, 1, 9, {"colour2": 1})


# ready features ---------------------------------------------------------------------------------------


def isolated(places=300, features=600, rank=100):
    """Features of places that have nothing in common with those beside them, and of another visit."""
    random = torch.Generator().manual_seed(0)
    own = torch.randn(places, rank, generator=random) @ torch.randn(rank, features, generator=random)
    return own + 8, own + 8 + 40 * torch.randn(places, features, generator=random)


def share_found(model, queries):
    return float((model.localize(queries).index == torch.arange(len(queries))).float().mean())


@pytest.mark.parametrize("whitening", [None, "none"])
def test_ready_features_are_found_as_by_their_cosine(whitening):
    places, queries = isolated()
    plain = torch.nn.functional.cosine_similarity(queries[:, None], places[None], dim=2).argmax(1)
    cosine = float((plain == torch.arange(300)).float().mean())
    held = DejaVu(whitening=whitening).learn(places)  # type: ignore[arg-type]
    few = DejaVu(mapper=SpectralMapper(5.0)).learn(places)
    assert share_found(held, queries) > cosine - 0.05 > 0.9
    assert share_found(few, queries) < cosine - 0.2
    assert held.map.dimension <= 257
    sizes = [model.summary().route_bytes / 300 for model in (held, few)]
    assert sizes[1] <= 5 < 2 * sizes[1] < sizes[0]


def test_frames_that_five_bytes_are_too_few_for(reference):
    """The mean of 1764 numbers alone takes 58.8 bytes of each of 60 places."""
    few = frame_range(reference, 0, 60, 1)
    with refused("route_bytes_per_place is 5;", "expected more than 59.3"):
        DejaVu(whitening="none", mapper=SpectralMapper(5.0)).learn(few)
    assert DejaVu(whitening="none").learn(few).map.dimension == 1764
    plain = DejaVu(HOG(), Whitening(views=0), SpectralMapper(5.0)).learn(few)
    assert plain.map.dimension == 60  # their rank, 59, and one constant number
    assert plain.summary().route_bytes <= 5 * 60
