"""What commands and `compare` share: how a map is learned, how queries are matched, what a report has."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused

from dejavu_torch import DejaVu, Learning, PlaceFilter, PlaceSmoother, Querying, Reporting, compare
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.options import several
from dejavu_torch.recognition.sequence import SequenceMatcher


def walk(count, seed, size=12):
    draw = torch.Generator().manual_seed(seed)
    return torch.nn.functional.avg_pool1d(torch.randn(1, size, count + 5, generator=draw), 6, 1)[0].T


ROUTE = walk(90, 0)


def again(seed, noise=0.1):
    return ROUTE + noise * torch.randn(ROUTE.shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("words", "made"),
    [
        (Querying(match="filter"), PlaceFilter),
        (Querying(filter=True), PlaceFilter),
        (Querying(match="drive"), PlaceSmoother),
        (Querying(match="sequence:7"), SequenceMatcher),
        (Querying(sequence=7), SequenceMatcher),
        (Querying(match="sequence:7.0", speeds=[0.5]), SequenceMatcher),
        (Querying(match=SequenceMatcher(7)), SequenceMatcher),
    ],
)
def test_words_and_models_name_a_way(words, made):
    way = words.matcher(within=3)
    assert type(way) is made
    assert getattr(way, "within", 3) == 3
    assert way.length == (7 if made is SequenceMatcher else 1)
    assert type(words.by(way).matcher()) is made


def test_without_a_way_the_order_decides():
    assert Querying().matcher() == "auto"
    assert Querying().matcher(ordered=False) is None
    assert isinstance(Querying().matcher(ordered=True), PlaceSmoother)
    assert Querying(match="single").matcher(ordered=True) is None
    assert Querying(match="sequence:1").matcher() is None
    orders = [Querying(ordered=True), Querying(unordered=True), Querying(), Querying(match="drive")]
    assert [one.order(one.matcher()) for one in orders] == [True, False, None, True]


@pytest.mark.parametrize(
    ("querying", "line"),
    [
        (
            Querying(match="sequence:1.5"),
            "--match sequence:1.5; expected drive, filter, single or sequence:T",
        ),
        (Querying(match="fliter"), "--match fliter; expected drive, filter"),
        (Querying(match="filter", sequence=3), "--sequence 3 and --match filter; expected one of them"),
        (Querying(speeds=[2.0]), "without a sequence; expected --match sequence:T with them"),
        (Querying(top=0), "0 candidates per query; expected at least 1"),
        (Querying(loops=9, headings=4), "--loops 9 and --headings 4; expected one of them"),
        (Querying(unordered=True, match="drive"), "--unordered and --match drive"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_learned(querying, line):
    model = DejaVu(None, "none")
    with refused(line):
        compare(ROUTE, None if querying.loops else again(1), "0", model, querying=querying)
    assert model.map.places == 0
    if querying.top is None or querying.loops:
        with refused(line):
            list(model.learn(ROUTE).matches(ROUTE, querying))


def test_matches_find_loops_and_ask_for_an_order():
    twice = torch.cat([ROUTE, again(2)])
    model = DejaVu(None, "none", batch_size=16).learn(twice)
    for way, drive in (("single", False), ("drive", True)):
        (match,) = model.matches(twice, Querying(match=way, loops=30))
        assert torch.equal(match.index, model.loops(twice, 30, drive).index)
        assert float((match.index[90:] == torch.arange(90)).double().mean()) > 0.9
    single, whole = (
        torch.cat([match.index for match in model.matches(twice, one)])
        for one in (Querying(), Querying(ordered=True))
    )
    assert torch.equal(single, model.localize(twice, sequence=None).index)  # an array tells no order
    assert torch.equal(whole, model.localize(twice, sequence=PlaceSmoother()).index)


def test_learning_takes_sources_traverses_and_placed_frames(tmp_path):
    draw, model = torch.Generator().manual_seed(3), DejaVu()
    frames = torch.rand(70, 1, 24, 32, generator=draw)
    views = [
        ArrayTraverse(frames + 0.05 * torch.randn(frames.shape, generator=draw), f"v{i}") for i in range(2)
    ]
    reference, learning = Learning(second=views[0], second_truth="0").opened(
        model, ArrayTraverse(frames, "r")
    )
    assert torch.equal(learning.views.places, torch.arange(70))
    assert learning.opened(model, reference)[1].views is learning.views  # only once
    with refused("--second v0 is v0 itself; expected another visit"):
        Learning(second=[views[0], views[0]]).opened(model, reference)
    with refused("--second_truth 0 without --second"):
        Learning(second_truth="0").opened(model, reference)
    calibrated = Learning(calibration=views[1], calibration_truth="0").opened(model, reference)[1]
    assert torch.equal(calibrated.visit.places, torch.arange(70))
    assert several(views) == views
    assert several(learning.views) == [learning.views]


def test_the_seed_is_that_of_the_whitening_too():
    model = DejaVu()
    compare(
        torch.rand(40, 1, 24, 32),
        torch.rand(40, 1, 24, 32),
        "0",
        model,
        learning=Learning(7, calibration="none"),
    )
    assert model.whitening.seed == 7


def test_models_beside_have_the_share_of_the_mean_that_their_scores_need():
    around = torch.arange(256.0)[:, None] * 0.08 + torch.tensor([0, math.pi / 2])
    spiral = around.cos() * torch.linspace(1, 3, 256)[:, None]  # whose lengths tell the place
    plain, lengths = DejaVu(None, "none"), DejaVu().learn(spiral)
    assert lengths.descriptor.keeps_lengths
    assert lengths.adapted(PlaceSmoother()).removed == 0.5
    assert plain.adapted(lengths.adapted(PlaceSmoother())).removed == 1.0


def test_a_report_has_what_is_asked_for():
    found = []
    reporting = Reporting(drives="all", on_found=found.append)
    result = compare(
        ROUTE, again(1), "0", DejaVu(None, "none"), 2, querying=Querying(ordered=True), reporting=reporting
    )
    assert found[0].report.contenders == {}
    assert result.report.as_json()["stride"]["sequences"].keys() == {"filter", "smoother"}
    assert result.run.match.is_drive
