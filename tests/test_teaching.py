"""Drives without ground truth teach a map: a smoother places their frames."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from command_line import fails, report_of, run
from helpers import refused

from dejavu_torch import (
    DejaVu,
    ImposedPeriods,
    SpectralMapper,
    TemplateMapper,
    Whitening,
    compare,
    open_source,
)
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.options import Learning
from dejavu_torch.export import export_onnx, run_session, session_of
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.features.whitening import LIGHT, VISIT, Visits
from dejavu_torch.growth import (
    append,
    associate,
    calibrate_if_possible,
    merge,
    second_traverse,
    visit_to_calibrate,
)
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.coarse import CoarseSearch, SamplingPlan
from dejavu_torch.teaching import FEWEST, ROUNDS, SURE, place_drive, refine
from dejavu_torch.updating import update

FRAMES, FIRST, LAST = 160, 20, 140


def frames_of(traverse, seed=0):
    source = open_source(f"sim:aerial?frames={FRAMES}&traverse={traverse}&seed={seed}")
    return torch.cat(list(source.batches(FRAMES)))[..., ::2, ::2].contiguous()


@pytest.fixture(scope="module")
def road():
    return ArrayTraverse(frames_of(0), "road")


@pytest.fixture(scope="module")
def drive():
    """Frames of another flight, without their positions."""
    return ArrayTraverse(frames_of(1)[FIRST:LAST], "drive")


@pytest.fixture(scope="module")
def placed(road, drive):
    return second_traverse(fresh(), road, drive)


def fresh():
    return DejaVu(whitening=Whitening(views=2), mapper=SpectralMapper(12.0, chunk=200))


def waves(places, seed=0):
    noise = torch.randn(places + 7, 16, generator=torch.Generator().manual_seed(seed))
    smooth = torch.nn.functional.avg_pool1d(noise.T[None], 8, 1)[0].T
    return smooth / smooth.norm(dim=1, keepdim=True)


def noisy(rows, seed=1, size=0.05):
    return rows + size * torch.randn(rows.shape, generator=torch.Generator().manual_seed(seed))


def test_a_drive_is_placed_where_it_is_sure_and_another_route_nowhere():
    model = DejaVu(whitening="none").learn(waves(200))
    found = place_drive(model, noisy(waves(200)[30:170]))
    assert (found >= 0).float().mean() > 0.9
    assert ((found - torch.arange(30, 170))[found >= 0].abs() <= 5).all()
    assert (place_drive(model, waves(150, seed=5)) == -1).all()
    assert (place_drive(model, noisy(waves(200)[: FEWEST - 1])) == -1).all()  # sure, but too few
    part = torch.cat([noisy(waves(200)[:70]), waves(700, seed=6)])
    assert (place_drive(model, part) == -1).all()  # below a tenth of the drive


def test_frames_are_placed_without_truth_and_teach(road, drive, placed):
    assert placed.traverse is drive
    assert placed.placed is not None
    sure = placed.places >= 0
    assert sure.float().mean() > 0.8
    assert ((placed.places - torch.arange(FIRST, LAST))[sure].abs() <= 3).float().mean() > 0.98
    assert 1 <= placed.placed.rounds <= ROUNDS
    count = int(sure.sum())
    line = f"{count} of 120 frames of drive placed, at place = 1.00 frame + 20; {120 - count} left out"
    assert [*placed.placed_lines()] == [line]
    facts = {"placed": count, "of": 120, "probability": SURE, "rounds": placed.placed.rounds}
    assert placed.placed_facts() == facts
    taught, untaught = fresh().learn(road, second=placed), fresh().learn(road)
    truth = torch.arange(FRAMES)
    found = [
        (m.localize(frames_of(2), sequence=None, centre=False).index - truth).abs() <= 5
        for m in (taught, untaught)
    ]
    assert found[0].float().mean() >= found[1].float().mean() > 0.5
    assert [m.map.drives.tolist() for m in (taught, untaught)] == [[1], []]  # type: ignore[union-attr]
    projections = [m.state_dict()["descriptor.whitening.projection"] for m in (taught, untaught)]
    assert not torch.equal(*projections)


def test_another_route_teaches_nothing(road, tmp_path):
    other = ArrayTraverse(frames_of(0, seed=7)[:120].flip(-1), "other")
    views = second_traverse(fresh(), road, other)
    assert (views.places == -1).all()
    assert [*views.placed_lines()] == ["0 of 120 frames of other placed; nothing is learned from it"]
    for name, second in (("taught", views), ("plain", None)):
        fresh().learn(road, second=second).save(tmp_path / f"{name}.safetensors")
    assert (tmp_path / "taught.safetensors").read_bytes() == (tmp_path / "plain.safetensors").read_bytes()


def test_drives_with_and_without_truth_teach_together(road, drive, placed):
    again = ArrayTraverse(frames_of(2)[:100], "again")
    views = second_traverse(fresh(), road, [again, drive], ["0", None])
    assert views.placed is not None
    assert views.placed.names == {1: "drive"}
    assert torch.equal(views.places[:100], torch.arange(100))
    assert (views.places[100:] - placed.places).abs().le(3).float().mean() > 0.8
    assert views.placed_facts() is not None
    assert views.placed_facts()["of"] == 120
    assert len(list(views.placed_lines())) == 1


def numbered(first, traverse):
    """As many frames of a flight, from a first one on, in files that merely count them."""
    source = open_source(f"sim:aerial?frames={FRAMES + 60}&traverse={traverse}")
    some = ArrayTraverse(
        next(iter(source.batches(FRAMES + 60)))[first : first + FRAMES, ..., ::2, ::2], "visit"
    )
    some.names = [f"frame_{i:05}.png" for i in range(FRAMES)]
    return some


@pytest.mark.parametrize("start", [0, 5, 40])
def test_a_visit_as_long_as_the_reference_is_placed_wherever_it_starts(start):
    again = numbered(start, 1)
    for views in (second_traverse(fresh(), numbered(0, 0), again), associate(fresh(), numbered(0, 0), again)):
        sure = views.places >= 0
        assert sure.float().mean() > 0.6
        assert ((views.places - torch.arange(FRAMES) - start)[sure].abs() <= 5).float().mean() > 0.98
        (line,) = views.placed_lines()
        assert line.startswith(f"{int(sure.sum())} of 160 frames of visit placed, at place = 1.00 frame + ")
        assert abs(int(line.split(";")[0].split()[-1]) - start) <= 1


@pytest.mark.parametrize("start", [0, 40])
def test_a_visit_calibrates_by_all_of_its_frames_wherever_it_starts(start, caplog):
    road, again = numbered(0, 0), numbered(start, 1)
    model, told = fresh().learn(road), fresh().learn(road)
    visit = visit_to_calibrate(model, road, again)
    assert visit is again
    calibrate_if_possible(model, road, visit)
    assert "calibrate, too" in caplog.text
    calibrate_if_possible(told, road, visit_to_calibrate(told, road, again, str(start)))
    query = frames_of(2)
    found = [one.localize(query, sequence=None, centre=False) for one in (model, told)]
    right = float(((found[0].index - torch.arange(FRAMES)).abs() <= 5).float().mean())
    for match in found:
        assert match.probability is not None
        assert abs(float(match.probability.mean()) - right) < 0.2


def test_a_frame_of_a_drive_counts_as_so_many_copies():
    places = waves(100)
    copies = (noisy(places), torch.arange(100))
    drive = (changed(places)[:80], torch.arange(80))
    placed, several = (Whitening(numbers=6, bits=16, shrinkage=0.1) for _ in range(2))
    placed.learn(
        places, [copies], samples=10**6, visits=Visits([drive], torch.arange(80))
    )  # each its own drive
    light = drive[0] - places[:80]
    shown = drive[0] - light / (1 + LIGHT)
    again = [(shown, drive[1])] * int(VISIT)
    several.learn(places, [copies, *again])
    products = [one(places) @ one(places).T for one in (placed, several)]
    torch.testing.assert_close(*products, rtol=0, atol=2e-3)


def test_drives_are_placed_on_what_they_have_taught(road, drive, monkeypatch):
    learn, taught = DejaVu.learn, []

    def noted(model, source, progress=False, second=None):
        taught.append(second)
        return learn(model, source, progress, second)  # type: ignore[arg-type]

    monkeypatch.setattr(DejaVu, "learn", noted)
    second_traverse(fresh(), road, drive)
    assert taught[0] is None
    assert all(isinstance(views, LabelledFrames) for views in taught[1:])
    assert len(taught) == ROUNDS


def test_the_light_of_a_drive_is_no_change(monkeypatch):
    places, shown = waves(100), torch.arange(80)
    views = noisy(places)[:80]
    light = torch.rand(16)

    def products(drive):
        whitening = Whitening(numbers=8, bits=16, shrinkage=0.1)
        copies = [(noisy(places, seed=2), torch.arange(100))]
        whitening.learn(places, copies, visits=Visits([(drive, shown)], torch.zeros_like(shown)))
        return whitening(places) @ whitening(places).T

    assert (products(views + light) - products(views)).abs().mean() > 0.01  # of which a prior leaves some
    monkeypatch.setattr("dejavu_torch.features.whitening.LIGHT", 0)
    torch.testing.assert_close(products(views + light), products(views), rtol=0, atol=1e-3)


def test_what_cannot_be_placed_is_refused(road):
    few = ArrayTraverse(frames_of(1)[:29], "few")
    with refused("road", "29 frames of few", "at least 60 frames in order", "--second_truth, such as 0"):
        second_traverse(fresh(), road, few)
    noise = ArrayTraverse(torch.rand(FRAMES, 3, 32, 32), "noise")  # as long as the reference
    with refused("noise, fewer than 60", "in order", "--second_truth, such as 0"):
        second_traverse(fresh(), road, noise)
    with refused("noise, fewer than 60", "in order", "--average_truth, such as 0"):
        associate(fresh(), road, noise)
    with refused("29 frames of few", "--calibration_truth, such as 0"):
        visit_to_calibrate(fresh(), road, few)
    with refused("noise, fewer than 60", "--calibration_truth, such as 0"):
        calibrate_if_possible(fresh().learn(road), road, noise)
    with refused("no whitening", "few"):
        second_traverse(DejaVu(whitening="none"), road, few)
    with refused("features per frame", "the same number"):
        second_traverse(fresh(), road, ArrayTraverse(torch.rand(70, 3, 30, 48), "wide"))


def test_a_report_and_the_command_tell_how_many_frames_teach(road, drive, tmp_path, capsys):
    names = {"road": road[:], "drive": drive[:], "query": frames_of(2)}
    for name, frames in names.items():
        pixels = frames.mul(255).round().byte().permute(0, 2, 3, 1).numpy()
        np.save(tmp_path / f"{name}.npy", pixels)
    pair = (tmp_path / "road.npy", tmp_path / "query.npy")
    words = "--second", tmp_path / "drive.npy", "--calibration", "none", "--whitening.views", "2"
    run("compare", *pair, *words, "--out", tmp_path / "report")
    second, out = report_of(tmp_path / "report")["second"], capsys.readouterr().out
    line = (
        f"{second['placed']} of 120 frames of {tmp_path / 'drive.npy'} placed, at place = 1.00 frame + 20; "
    )
    assert line in out
    assert second["of"] == 120
    assert second["placed"] > 60
    assert second["probability"] == SURE
    run("learn", pair[0], *words, "--map", tmp_path / "m.safetensors")
    assert "frames of" in capsys.readouterr().out
    plain = compare(
        road, ArrayTraverse(frames_of(2), "query"), "0", fresh(), learning=Learning(calibration="none")
    ).report
    assert "second" not in plain.facts


def model_of(rows, **settings):
    return DejaVu(whitening="none", mapper=SpectralMapper(16.0, chunk=100, **settings)).learn(rows)  # type: ignore[arg-type]


def changed(rows, seed=3):
    """Another visit: the first half of the dimensions changes with the day and is noise there."""
    noise = torch.randn(rows.shape, generator=torch.Generator().manual_seed(seed)) * rows.std()
    return torch.cat([rows[:, :8] + 2 * noise[:, :8], rows[:, 8:] + 0.1 * noise[:, 8:]], 1)


@pytest.mark.parametrize("metric", ["cosine", "l2"])
def test_a_stage_compares_queries_and_places_after_it(metric):
    rows, queries = waves(200), torch.randn(9, 16)
    plain, first, second = model_of(rows, metric=metric).map, torch.randn(16, 16), torch.randn(16, 16)
    assert isinstance(plain, SpectralMap)
    decoded = torch.cat([plain.decode(g) for g in range(2)])
    refined = plain.refined(first)
    assert (refined.stage.dtype, refined.stage.abs().amax(0).tolist()) == (torch.int8, [127] * 16)
    for place_map, stage in ((refined, refined.stage * refined.stage_scale), (refined.refined(second), None)):
        if stage is None:  # both in one
            stage = place_map.stage * place_map.stage_scale
            close = {"rtol": 0, "atol": 0.02 * float((first @ second).abs().max())}
            torch.testing.assert_close(stage, refined.stage * refined.stage_scale @ second, **close)
        x, q = decoded @ stage, queries @ stage
        if metric == "cosine":
            expected = 1 - torch.nn.functional.cosine_similarity(q[:, None], x[None], dim=2)
        else:
            expected = (q[:, None] - x[None]).square().sum(2)
        torch.testing.assert_close(place_map.scores(queries), expected, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(place_map.norms, x.norm(dim=1), rtol=1e-4, atol=1e-4)
        for name in ("streams", "steps", "lengths", "means"):
            assert torch.equal(getattr(place_map, name), getattr(plain, name))
    parts = [refined.between(0, 1), refined.between(1, 2)]
    torch.testing.assert_close(
        torch.cat([part.scores(queries) for part in parts], 1), refined.scores(queries)
    )
    torch.testing.assert_close(refined.of_chunks(refined.coded()).scores(queries), refined.scores(queries))


def test_gradients_pass_the_stage():
    place_map = model_of(waves(60)).map
    assert isinstance(place_map, SpectralMap)
    refined = place_map.refined(torch.eye(16) + 0.1 * torch.randn(16, 16))
    queries = torch.randn(3, 16, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(refined.scores, queries)


def test_a_drive_refines_a_map_and_the_next_one_is_found_better(tmp_path):
    rows = waves(300)
    model = model_of(rows)
    model.save(tmp_path / "before.safetensors")
    drive, third = changed(rows), changed(rows, seed=4)
    taught = refine(model, drive)
    assert taught.accepted
    assert taught.of == 300
    assert taught.placed > 250
    assert taught.gain > taught.error > 0
    assert str(taught).endswith("the map is refined")
    assert isinstance(model.map, SpectralMap)
    assert len(model.map.stage) == 16
    before, truth = DejaVu.load(tmp_path / "before.safetensors"), torch.arange(300)
    right = [
        float(((m.localize_descriptors(third).index - truth).abs() <= 2).float().mean())
        for m in (before, model)
    ]
    assert right[1] > right[0] + 0.05
    model.save(tmp_path / "after.safetensors")
    again = DejaVu.load(tmp_path / "after.safetensors")
    assert torch.equal(again.map.scores(third), model.map.scores(third))
    grown = (tmp_path / "after.safetensors").stat().st_size - (tmp_path / "before.safetensors").stat().st_size
    taught = 4 * -(-9 * 150 // 3)  # digests of every other frame of the drive, in the header
    assert 16 * 16 + 16 * 4 + 4 <= grown - taught <= 16 * 16 + 16 * 4 + 400  # the stage, with its names
    assert again.summary().fixed["stage"] == 16 * 16 + 16 * 4 + 4
    assert again.summary().map_bytes == (tmp_path / "after.safetensors").stat().st_size
    size = (tmp_path / "after.safetensors").stat().st_size
    refine(again, third)
    again.save(tmp_path / "after.safetensors")
    assert abs((tmp_path / "after.safetensors").stat().st_size - taught - size) < 50


def test_another_route_refines_nothing(tmp_path):
    model = model_of(waves(300))
    model.save(tmp_path / "before.safetensors")
    found = refine(model, waves(200, seed=9))
    assert (found.placed, found.accepted) == (0, False)
    assert "nothing is learned" in str(found)
    model.save(tmp_path / "after.safetensors")
    assert (tmp_path / "after.safetensors").read_bytes() == (tmp_path / "before.safetensors").read_bytes()
    same = refine(model, noisy(waves(300), size=1e-4))  # nothing changes that a stage could remove
    assert same.placed > 250
    assert not same.accepted
    assert str(same).endswith("the map stays as it was")


def test_few_frames_cannot_tell_whether_a_stage_helps():
    model = model_of(waves(300))
    few = refine(model, noisy(waves(300)[:64]))
    assert (few.placed >= 60, few.accepted) == (True, False)
    assert str(few).endswith("too few to tell whether they help; the map stays as it was")
    assert isinstance(model.map, SpectralMap)
    assert not len(model.map.stage)


def test_what_refines_no_map_is_refused():
    model = model_of(waves(100))
    with refused("has 29 frames", "at least 30"):
        refine(model, waves(29))
    with refused("there is no map"):
        refine(DejaVu(), waves(40))
    templates = DejaVu(mapper=TemplateMapper(ImposedPeriods([3, 4, 5], bin=4))).learn(waves(100))
    with refused("kind 'templates'", "expected one of kind 'spectral'"):
        refine(templates, waves(40))
    with refused("9 features", "16"):
        refine(model, torch.rand(40, 9))
    assert isinstance(model.map, SpectralMap)
    assert not len(model.map.stage)


def test_what_knows_of_a_stage(tmp_path):
    rows = waves(400)
    model = model_of(rows)
    refine(model, changed(rows))
    assert isinstance(model.map, SpectralMap)
    assert len(model.map.stage)
    queries = changed(rows, seed=5)[::7]
    export_onnx(model, tmp_path / "m.onnx")
    exported = run_session(session_of(str(tmp_path / "m.onnx")), queries)
    torch.testing.assert_close(exported, model.map.scores(queries), rtol=0, atol=1e-4)
    more = append(copy.deepcopy(model), waves(200, seed=8))
    assert isinstance(more.map, SpectralMap)
    assert torch.equal(more.map.stage, model.map.stage)
    torch.testing.assert_close(more.map.scores(queries)[:, :400], model.map.scores(queries))
    with refused("different drives have refined them"):
        merge([model, model_of(waves(100, seed=2))], ["a", "b"])
    both = merge([model, copy.deepcopy(model)], ["a", "b"])
    torch.testing.assert_close(both.map.scores(queries)[:, :400], model.map.scores(queries))
    score, place = CoarseSearch(model.map, SamplingPlan(4, 2, 64, 1.0, 0))(queries, [(1, 0)])
    best, at = score.min(1, keepdim=True)
    scores = model.map.scores(queries)
    torch.testing.assert_close(best, scores.gather(1, place.gather(1, at)), rtol=0, atol=1e-5)
    assert (best[:, 0] - scores.amin(1) < 1e-5).float().mean() > 0.85


def test_a_calibration_is_learned_anew_from_all_of_a_drive():
    rows = waves(300)
    model, plain = model_of(rows), model_of(rows)
    model.calibrate(None, LabelledFrames(ArrayTraverse(noisy(rows, size=0.1)), torch.arange(300)))
    before = model.calibration
    assert refine(model, changed(rows)).accepted
    assert refine(plain, changed(rows)).accepted
    assert plain.calibration is None
    assert model.calibration not in (None, before)
    third = changed(rows, seed=6)
    match = model.localize_descriptors(third)
    assert match.probability is not None
    right = ((match.index - torch.arange(300)).abs() <= 5).double()
    assert abs(float(match.probability.mean() - right.mean())) < 0.1


@pytest.mark.parametrize("verb", ["refine", "update"])
def test_a_model_stays_as_it_is_if_a_drive_fails(verb, monkeypatch):
    import dejavu_torch.teaching as teaching
    import dejavu_torch.updating as updating

    def full(*_):
        raise MemoryError("full")

    rows = waves(400)
    model = model_of(rows[:300])
    model.calibrate(None, LabelledFrames(ArrayTraverse(noisy(rows[:300], size=0.1)), torch.arange(300)))
    before = model.map, model.calibration
    drive = changed(rows)
    if verb == "refine":
        monkeypatch.setattr(teaching, "_calibration", full)
    else:
        monkeypatch.setattr(updating, "_coded", full)  # after it has taught
    with pytest.raises(MemoryError):
        (refine if verb == "refine" else update)(model, drive)
    assert (model.map, model.calibration) == before
    monkeypatch.undo()
    assert update(model, drive).stretches
    assert model.map is not before[0]
    assert model.calibration is not before[1]


def test_the_command_refines_a_map(tmp_path, capsys):
    rows = waves(200)
    for name, values in {"route": rows, "drive": changed(rows), "other": waves(90, seed=9)}.items():
        np.save(tmp_path / f"{name}.npy", values.numpy())
    run("learn", tmp_path / "route.npy", "--map", tmp_path / "m.safetensors")
    before = (tmp_path / "m.safetensors").read_bytes()
    run("refine", tmp_path / "m.safetensors", tmp_path / "other.npy")
    assert "0 of 90 frames placed; nothing is learned, the map stays as it was" in capsys.readouterr().out
    assert (tmp_path / "m.safetensors").read_bytes() == before
    run("refine", tmp_path / "m.safetensors", tmp_path / "drive.npy", "--out", tmp_path / "n.safetensors")
    assert "the map is refined" in capsys.readouterr().out
    assert (tmp_path / "m.safetensors").read_bytes() == before
    run("info", tmp_path / "n.safetensors")
    out = capsys.readouterr().out
    assert "refined by 1 drive\n" in out
    assert "stage" in out
    words = ("refine", tmp_path / "m.safetensors", tmp_path / "route.npy")
    assert f"--out {tmp_path / 'n.pt'} is not the name of a map" in fails(
        capsys, *words, "--out", tmp_path / "n.pt"
    )
    assert "none.npy" in fails(capsys, "refine", tmp_path / "m.safetensors", tmp_path / "none.npy")
