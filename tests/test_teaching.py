"""Drives without ground truth teach a map: a smoother places their frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import fails, report_of, run
from helpers import refused
from torch import Tensor

from dejavu_torch import DejaVu, SpectralMapper, Whitening, compare, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.views import LabelledFrames, Placed, Sample, views_of
from dejavu_torch.features.whitening import LIGHT, VISIT, Visits, learned_whitening
from dejavu_torch.growth import second_traverse
from dejavu_torch.teaching import FEWEST, ROUNDS, SURE, place_drive

FRAMES, FIRST, LAST = 160, 20, 140


def frames_of(traverse: int, seed: int = 0) -> Tensor:
    source = open_source(f"sim:aerial?frames={FRAMES}&traverse={traverse}&seed={seed}")
    return torch.cat(list(source.batches(FRAMES)))[..., ::2, ::2].contiguous()


@pytest.fixture(scope="module")
def road() -> ArrayTraverse:
    return ArrayTraverse(frames_of(0), "road")


@pytest.fixture(scope="module")
def drive() -> ArrayTraverse:
    """Frames of another flight, without their positions."""
    return ArrayTraverse(frames_of(1)[FIRST:LAST], "drive")


@pytest.fixture(scope="module")
def placed(road: ArrayTraverse, drive: ArrayTraverse) -> LabelledFrames:
    return second_traverse(fresh(), road, drive)


def fresh() -> DejaVu:
    return DejaVu(whitening=Whitening(views=2), mapper=SpectralMapper(12.0, chunk=200))


def waves(places: int, seed: int = 0) -> Tensor:
    noise = torch.randn(places + 7, 16, generator=torch.Generator().manual_seed(seed))
    smooth = torch.nn.functional.avg_pool1d(noise.T[None], 8, 1)[0].T
    return smooth / smooth.norm(dim=1, keepdim=True)


def noisy(rows: Tensor, seed: int = 1, size: float = 0.05) -> Tensor:
    return rows + size * torch.randn(rows.shape, generator=torch.Generator().manual_seed(seed))


def test_a_drive_is_placed_where_it_is_sure_and_another_route_nowhere() -> None:
    model = DejaVu(whitening="none").learn(waves(200))
    found = place_drive(model, noisy(waves(200)[30:170]))
    assert (found >= 0).float().mean() > 0.9
    assert ((found - torch.arange(30, 170))[found >= 0].abs() <= 5).all()
    assert (place_drive(model, waves(150, seed=5)) == -1).all()
    assert (place_drive(model, noisy(waves(200)[: FEWEST - 1])) == -1).all()  # sure, but too few
    part = torch.cat([noisy(waves(200)[:70]), waves(700, seed=6)])
    assert (place_drive(model, part) == -1).all()  # below a tenth of the drive


def test_frames_are_placed_without_truth_and_teach(
    road: ArrayTraverse, drive: ArrayTraverse, placed: LabelledFrames
) -> None:
    assert placed.traverse is drive
    assert placed.placed is not None
    sure = placed.places >= 0
    assert sure.float().mean() > 0.8
    assert ((placed.places - torch.arange(FIRST, LAST))[sure].abs() <= 3).float().mean() > 0.98
    assert 1 <= placed.placed.rounds <= ROUNDS
    count = int(sure.sum())
    assert [*placed.placed_lines()] == [f"{count} of 120 frames of drive placed; {120 - count} left out"]
    facts = {"placed": count, "of": 120, "probability": SURE, "rounds": placed.placed.rounds}
    assert placed.placed_facts() == facts
    taught, untaught = fresh().learn(road, second=placed), fresh().learn(road)
    truth = torch.arange(FRAMES)
    found = [
        (m.localize(frames_of(2), sequence=None, centre=False).index - truth).abs() <= 5
        for m in (taught, untaught)
    ]
    assert found[0].float().mean() >= found[1].float().mean() > 0.5
    projections = [m.state_dict()["descriptor.whitening.projection"] for m in (taught, untaught)]
    assert not torch.equal(*projections)


def test_another_route_teaches_nothing(road: ArrayTraverse, tmp_path: Path) -> None:
    other = ArrayTraverse(frames_of(0, seed=7)[:120].flip(-1), "other")
    views = second_traverse(fresh(), road, other)
    assert (views.places == -1).all()
    assert [*views.placed_lines()] == ["0 of 120 frames of other placed; nothing is learned from it"]
    for name, second in (("taught", views), ("plain", None)):
        fresh().learn(road, second=second).save(tmp_path / f"{name}.safetensors")
    assert (tmp_path / "taught.safetensors").read_bytes() == (tmp_path / "plain.safetensors").read_bytes()


def test_drives_with_and_without_truth_teach_together(
    road: ArrayTraverse, drive: ArrayTraverse, placed: LabelledFrames
) -> None:
    again = ArrayTraverse(frames_of(2)[:100], "again")
    views = second_traverse(fresh(), road, [again, drive], ["0", None])
    assert views.placed is not None
    assert views.placed.names == {1: "drive"}
    assert torch.equal(views.places[:100], torch.arange(100))
    assert (views.places[100:] - placed.places).abs().le(3).float().mean() > 0.8
    assert views.placed_facts() is not None
    assert views.placed_facts()["of"] == 120
    assert len(list(views.placed_lines())) == 1


def test_features_are_computed_once(
    road: ArrayTraverse, drive: ArrayTraverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, seen = fresh(), []
    describe = type(model.descriptor).describe
    monkeypatch.setattr(
        type(model.descriptor),
        "describe",
        lambda own, frames: (seen.append(len(frames)), describe(own, frames))[1],
    )
    second_traverse(model, road, drive)
    once = FRAMES + 2 * FRAMES + len(drive)  # with two copies of each
    assert once <= sum(seen) < once + FRAMES  # and a few to compare sizes


def test_a_weight_counts_as_so_many_pairs() -> None:
    views, places = torch.randn(40, 6), torch.randn(40, 6)
    weight = torch.ones(40)
    weight[25:] = 3.0
    number = torch.arange(40).repeat_interleave(weight.long())
    expected = learned_whitening(views[number], places[number], 4, 0.1)
    for found, known in zip(learned_whitening(views, places, 4, 0.1, weight=weight), expected, strict=True):
        torch.testing.assert_close(found.abs(), known.abs(), rtol=1e-4, atol=1e-5)


def test_the_light_of_a_drive_is_no_change() -> None:
    places, count = waves(100), 80
    views = (noisy(places[:count]) - places[:count]) / 2
    views = views - views.mean(0)  # what changes, without any light
    batches = [(places[:count] + views, torch.arange(count))]
    light = torch.rand(16) * (count + LIGHT) / LIGHT
    shifted = [(places[:count] + views + light, torch.arange(count))]
    found = []
    for batch in (batches, shifted):
        whitening = Whitening(numbers=8, bits=16)
        copies = [(noisy(places), torch.arange(100))]
        whitening.learn(places, copies, visits=Visits(batch, torch.zeros(count, dtype=torch.int64)))
        found.append(whitening(places) @ whitening(places).T)
    assert 0 < (found[0] - found[1]).abs().mean() < 0.1  # what the prior leaves
    whitening = Whitening(numbers=8, bits=16)
    several = [
        (
            torch.cat([places, places[:count] + views + light]),
            torch.cat([torch.arange(100), torch.arange(count)]),
        )
    ]
    whitening.learn(places, several)
    assert (whitening(places) @ whitening(places).T - found[0]).abs().mean() > 0.02
    assert VISIT > 1


def test_a_sample_keeps_the_drive_of_each_frame() -> None:
    which, places = torch.tensor([0, 0, 1, 1, 1]), torch.tensor([3, -1, 0, 4, 9])
    views = LabelledFrames(ArrayTraverse(torch.rand(5, 4)), places, Placed(which, {1: "b"}, 0.9, 1))
    some = views_of(views, torch.tensor([0, 3, 9]))
    assert some.places.tolist() == [1, 0, 2]
    assert some.placed is not None
    assert some.placed.drive.tolist() == [0, 1, 1]
    nothing = views._replace(places=torch.full((5,), -1))
    assert not len(Sample(torch.arange(3), 3).views(nothing).places)  # not refused: copies are left


def test_what_cannot_be_placed_is_refused(road: ArrayTraverse) -> None:
    few = ArrayTraverse(frames_of(1)[:29], "few")
    with refused("few has 29 frames and road 160", "a truth for its places", "at least 30 frames in order"):
        second_traverse(fresh(), road, few)
    with refused("no whitening", "few"):
        second_traverse(DejaVu(whitening="none"), road, few)
    with refused("features per frame", "the same number"):
        second_traverse(fresh(), road, ArrayTraverse(torch.rand(40, 3, 30, 48), "wide"))


def test_a_report_and_the_command_tell_how_many_frames_teach(
    road: ArrayTraverse, drive: ArrayTraverse, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"road": road[:], "drive": drive[:], "query": frames_of(2)}
    for name, frames in names.items():
        pixels = frames.mul(255).round().byte().permute(0, 2, 3, 1).numpy()
        np.save(tmp_path / f"{name}.npy", pixels)
    pair = (tmp_path / "road.npy", tmp_path / "query.npy")
    run(
        "compare",
        *pair,
        "--second",
        tmp_path / "drive.npy",
        "--out",
        tmp_path / "report",
        "--calibration",
        "none",
    )
    second, out = report_of(tmp_path / "report")["second"], capsys.readouterr().out
    assert f"{second['placed']} of 120 frames of {tmp_path / 'drive.npy'} placed; " in out
    assert second["of"] == 120
    assert second["placed"] > 60
    assert second["probability"] == SURE
    run("learn", pair[0], "--second", tmp_path / "drive.npy", "--map", tmp_path / "m.safetensors")
    assert "frames of" in capsys.readouterr().out
    np.save(tmp_path / "few.npy", np.load(tmp_path / "drive.npy")[:20])
    words = ("learn", pair[0], "--second", tmp_path / "few.npy", "--map", tmp_path / "n.safetensors")
    assert "few.npy has 20 frames" in fails(capsys, *words)
    plain = compare(road, ArrayTraverse(frames_of(2), "query"), "0", fresh(), calibration="none").report
    assert "second" not in plain.facts
