"""Probabilities of being right: the fit, what it is fitted to, and the models and files that carry it."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import all_of, refused
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from test_filter import Watched
from torch import Tensor

from dejavu_torch import DejaVu, PlaceFilter, SequenceMatcher, SpectralMapper, export, open_source
from dejavu_torch.data.source import as_traverse
from dejavu_torch.evaluation.rejection import calibration_error
from dejavu_torch.features.views import LabelledFrames, augmented_segments
from dejavu_torch.model import HIGHEST
from dejavu_torch.model_file import state_to_json
from dejavu_torch.recognition.calibration import (
    Calibration,
    Platt,
    Track,
    calibrated,
    confidence_of,
    fit,
    look_alikes,
)

INF = math.inf
ROUTE, AGAIN = "sim:aerial?frames=160", "sim:aerial?frames=160&traverse=1"


def answers(seed, count=200):
    draw = torch.Generator().manual_seed(seed)
    evidence = torch.randn(count, generator=draw, dtype=torch.float64)
    return evidence, torch.rand(count, generator=draw) < torch.sigmoid(2 * evidence - 1)


# the fit


def test_the_fit_is_the_most_likely_one():
    evidence, right = answers(0)
    hits, misses = int(right.sum()), int((~right).sum())
    aim = torch.where(right, (hits + 1) / (hits + 2), 1 / (misses + 2)).double()

    def loss(at):
        p = torch.sigmoid(at[0] * evidence + at[1])
        return -float((aim * p.log() + (1 - aim) * (1 - p).log()).sum())

    expected = minimize(loss, [1.0, 0.0], tol=1e-12).x
    assert fit(evidence, right)[:2] == pytest.approx(tuple(expected), abs=1e-3)


@given(st.floats(1e-3, 1e3), st.floats(-1e3, 1e3))
def test_the_unit_and_zero_of_evidence_do_not_matter(unit, zero):
    evidence, right = answers(0)
    other = fit(unit * evidence + zero, right).probability(unit * evidence + zero)
    torch.testing.assert_close(other, fit(evidence, right).probability(evidence), atol=1e-5, rtol=0)


@pytest.mark.parametrize("wrong", [0, 1, 50])
def test_what_is_told_apart_wholly_stays_finite(wrong):
    right = torch.arange(100) >= wrong
    p = fit(torch.arange(100.0), right).probability(torch.arange(100.0))
    assert bool(((p > 0) & (p < 1)).all())
    assert bool((p.diff() >= 0).all())
    assert float(p.mean()) == pytest.approx(float(right.double().mean()), abs=0.02)


def test_evidence_that_tells_nothing_or_the_opposite_gives_the_share():
    right = torch.arange(8) % 4 != 0
    for evidence in (torch.zeros(8), -right.double()):
        platt = fit(evidence, right)
        assert platt.slope == pytest.approx(0, abs=1e-6)
        assert platt.probability(evidence).tolist() == pytest.approx([0.7] * 8, abs=0.03)


def test_no_right_answer_is_refused_and_no_answer_has_no_probability():
    with refused("none of 3 answers is right"):
        fit(torch.zeros(3), torch.zeros(3, dtype=torch.bool))
    found = Platt(1.0, 9.0).probability(torch.tensor([-INF, 0.0])).tolist()
    assert found == [0, pytest.approx(0.99988, abs=1e-5)]


# evidence


def test_single_evidence_is_the_score_beside_the_best_beyond_the_tolerance():
    scores = torch.full((3, 30), 9.0)
    # best at 11, 4 lies 5 after it: the next is 9
    scores[0, 10:17] = torch.tensor([1.0, 0, 0, 0, 0, 2.0, 4.0])
    scores[1, 3], scores[1, 20] = 1.0, 3.0
    scores[2] = INF
    assert confidence_of(scores).tolist() == pytest.approx([0, -1 / 3**0.75, -INF])
    assert confidence_of(scores, margin=2.0).tolist() == [2 * 9 - 0, 2 * 2 - 1, -INF]
    assert confidence_of(torch.tensor([[2.0]])).tolist() == pytest.approx([-(2**0.25)])  # with itself
    assert confidence_of(torch.tensor([[-1e-7, *[0.5] * 9]])).tolist() == [0]  # rounded to less than 0
    assert confidence_of(torch.tensor([[-1e-7, *[0.0] * 9]])).tolist() == [-1]  # two equal the query


@pytest.mark.parametrize("unit", [0.01, 300.0])
def test_the_order_of_confidence_does_not_depend_on_the_unit_of_scores(unit):
    scores = torch.rand(40, 30, generator=torch.Generator().manual_seed(0))
    assert torch.equal(confidence_of(unit * scores).argsort(), confidence_of(scores).argsort())


def test_a_track_remembers_how_its_answers_stood_out():
    single = torch.full((3, 20), 1.0)
    single[:, 4] = torch.tensor([0.0, 0.0, 0.8])
    single[:, 9], single[:, 10] = 0.4, 0.5  # 9 is within the tolerance of 4, 10 is not
    found = torch.full((3, 20), 5.0)
    found[:, 4] = math.log(2)  # even odds
    spread = single.std(1, correction=0)
    own = torch.tensor([0.0, 0.0, 0.8])
    first, _, last = ((single.mean(1) - own + 2 * (0.5 - own)) / spread).tolist()
    second = (0.09 * first + 0.1 * first) / 0.19
    third = (0.9 * 0.19 * second + 0.1 * last) / 0.271
    expected = [3 * first, 3 * second, 3 * third]
    track = Track()
    assert track(found, single).tolist() == pytest.approx(expected, rel=1e-5)
    other = Track()
    parts = torch.cat([other(found[:1], single[:1]), other(found[1:], single[1:])])
    assert parts.tolist() == pytest.approx(expected, rel=1e-5)  # whatever the batches


def test_calibrating_looks_for_places_that_are_there_and_that_are_not():
    draw = torch.Generator().manual_seed(0)
    places = torch.arange(40)
    scores = 1 + 0.1 * torch.randn(40, 40, generator=draw)
    scores[places, places] = 0.3
    own = calibrated(Watched(40), [(scores[:20], places[:20]), (scores[20:], places[20:])])
    assert own.single is not None
    there = own.single.probability(confidence_of(scores))
    away = own.single.probability(confidence_of(1 + 0.1 * torch.randn(40, 40, generator=draw)))
    assert float(there.mean()) > 0.9
    assert float(away.mean()) < 0.1
    known = places.where(places % 2 == 0, -1)  # what is not known does not count
    half = calibrated(Watched(40), [(scores, known)])
    other = calibrated(Watched(40), [(scores[::2], places[::2])]).single
    assert half.single[:2] == pytest.approx(other[:2], rel=1e-5)
    visit = calibrated(Watched(40), [(scores, places)], another_visit=True)  # none was wrong
    assert float(visit.single.probability(confidence_of(scores)).mean()) > float(there.mean())
    beside = [(scores, (places + 3) % 40)]  # right within 3 and 5 places, not within 2
    assert calibrated(Watched(40), beside, reach=3).single[:2] == calibrated(Watched(40), beside).single[:2]
    everywhere = calibrated(Watched(40), beside, reach=10**9).single
    assert float(everywhere.probability(confidence_of(scores)).min()) > 0.9
    with refused("answers is right"):
        calibrated(Watched(40), [(scores[3:30], places[3:30] + 3)], reach=2)
    with refused("none of 80 answers"):
        calibrated(Watched(40), [(scores, (places + 20) % 40)])
    with refused("no queries"):
        calibrated(Watched(40), [])


# frames to calibrate by


@pytest.mark.parametrize(
    ("frames", "stretch", "starts"), [(160, 16, [0]), (1000, 20, [0, 200, 400, 600, 800]), (7, 1, [0])]
)
def test_every_tenth_stretch_is_taken(frames, stretch, starts):
    route = open_source(f"sim:aerial?frames={frames}")
    changed = augmented_segments(route, frames, {"noise": 0.01})
    shown = changed.places.view(len(starts), -1, stretch)
    assert shown[:, 0].flatten().tolist() == [start + i for start in starts for i in range(stretch)]
    assert min(600, 2 * frames) <= len(changed) <= 1200
    assert bool((shown == shown[:, :1]).all())


def test_long_routes_are_looked_at_in_fewer_frames():
    route = open_source("sim:aerial?frames=30")  # none of it is read
    for frames, places, most in ((10**5, None, 1200), (10**6, None, 260), (10**5, 10**7, 260)):
        changed = augmented_segments(route, frames, {"noise": 0.01}, places=places)
        assert most * 0.7 < len(changed) <= most
        assert int(changed.places.max()) > 0.8 * frames


def test_what_looks_like_a_map_elsewhere_limits_the_probability():
    """Of 200 own frames, 4 have look-alikes as sure as 2, and 8 as sure as 1: half of the right answers are
    above either."""
    right, own = torch.tensor([0.5, 3.0]).repeat(50), torch.full((200,), 3.0)
    others = torch.full((200,), -9.0)
    others[::50], others[1::50] = 2.0, 1.0
    limited = look_alikes(Platt(5.0, 0.0), right, own, others)
    found = (0.5 + 1.0) / 2
    two, four, eight = (found / (found + k / 200) for k in (2, 4, 8))
    assert limited.most == ((2.0, round(two, 3)), (2.0, round(four, 3)), (1.0, round(eight, 3)))
    p = limited.probability(torch.tensor([3.0, 2.0, 1.5, 1.0, 0.0, -math.inf]))
    assert p.tolist() == pytest.approx([1, four, four, eight, 0.5, 0], abs=1e-3)
    assert (
        look_alikes(Platt(5.0, 0.0), right, own, others[2::50]).most == ()
    )  # none of them looks like another
    again = torch.where(torch.arange(100) < 6, 2.0, -9.0)  # as of a road that is passed twice
    assert look_alikes(Platt(5.0, 0.0), right, own, again).most == ()


def test_limits_are_kept_in_files(tmp_path):
    route = torch.randn(60, 6)
    model = DejaVu(whitening="none", mapper=SpectralMapper(12.0)).learn(route)
    for most in ((), ((1.5, 0.98), (0.25, 0.9))):
        model.calibration = Calibration(Platt(2.0, 0.5, most), None)
        model.save(tmp_path / "a.safetensors")
        assert DejaVu.load(tmp_path / "a.safetensors").calibration == model.calibration


def test_a_calibration_of_an_older_file_keeps_the_weight_it_was_fitted_to():
    """Files that do not name the margin have twice it: their probabilities stay as they were."""
    model = DejaVu(whitening="none", mapper=SpectralMapper(12.0)).learn(torch.randn(60, 6))
    model.calibration = Calibration(Platt(2.0, 0.5, (), 2.0), None)
    older = state_to_json(model.state)
    assert older["calibration"]["single"].pop("margin") == 2.0
    queries = torch.randn(30, 6)
    before = model.localize(queries).probability
    model.set_extra_state(older)
    assert torch.equal(model.localize(queries).probability, before)
    expected = Platt(2.0, 0.5).probability(confidence_of(model(queries), margin=2.0))
    torch.testing.assert_close(before, expected, rtol=0, atol=1e-4)


def test_a_floor_that_was_never_learned_is_known_by_look_alikes(data_dir):
    """Three floors of one plan are learned; a fourth looks like them."""
    floors, queries = (
        open_source(f"{data_dir}/floors_rejection/{name}.npy") for name in ("reference", "query")
    )
    match = DejaVu(precision=0.99).learn(floors).calibrate(floors).localize(queries, sequence=None)
    right = (match.index - torch.arange(400)).abs() <= 1
    right[300:] = False
    # the copies that calibrate are rounded otherwise on other machines, which moves a few answers
    assert float(right[match.accepted].double().mean()) >= 0.9
    assert int((right & match.accepted).sum()) >= 250


def test_of_many_views_evenly_spaced_stretches_are_taken(monkeypatch):
    route, seen = torch.randn(2000, 6), list[Tensor]()
    views = LabelledFrames(as_traverse(route + 0.2 * torch.randn_like(route)), torch.arange(2000))
    model = DejaVu(whitening="none", mapper=SpectralMapper(12.0)).learn(route)
    monkeypatch.setattr("dejavu_torch.learning.MAX_SEGMENT", 20)
    monkeypatch.setattr("dejavu_torch.learning.CALIBRATION_SCORES", 400 * 2000)

    def noted(_, segments, *more):
        seen.extend(places for _, places in segments)
        return Calibration()

    monkeypatch.setattr("dejavu_torch.learning.calibrated", noted)
    model.calibrate(None, views)
    starts = torch.stack(seen)[:, 0]
    assert all(torch.equal(part, part[0] + torch.arange(20)) for part in seen)
    assert (len(seen), int(starts[0]), int(starts[-1])) == (20, 0, 1980)
    assert set(starts.diff().tolist()) <= {100, 120}


def test_changed_frames_show_their_places_whatever_the_batch():
    route = open_source("sim:aerial?frames=300")
    frames = all_of(route)
    nothing = dict.fromkeys(("rotation", "scale", "gamma", "illumination", "blur", "occlusion"), 0.0)
    plain = {**nothing, "colour": [0, 0], "shift": [0, 0], "exposure": [0, 0], "noise": 0.0}
    same = augmented_segments(route, 300, plain)
    torch.testing.assert_close(all_of(same, 50), frames[same.places])
    changed = augmented_segments(route, 300, {**plain, "noise": 0.1})
    once = all_of(changed, 7)
    assert torch.equal(once, all_of(changed))
    spread = (once - frames[changed.places]).std()
    assert spread == pytest.approx(0.15 * 0.7**0.5, rel=0.3)  # 1.5 times as much
    with refused("ready features"):
        augmented_segments(as_traverse(torch.rand(30, 4)), 30, plain)
    for strengths in ({"noise": {}}, {"noise": float("nan")}, {"nose": 0.1}):  # of a file
        with refused(*strengths):
            augmented_segments(open_source("sim:aerial?frames=30"), 30, strengths)


# models


@pytest.fixture(scope="module")
def model():
    route = open_source(ROUTE)
    return DejaVu().learn(route).calibrate(route)


def test_probabilities_hold_on_another_day_and_off_the_map(model):
    for sequence in (None, PlaceFilter()):
        match = model.localize(open_source(AGAIN), sequence=sequence)
        assert match.probability is not None
        right = (match.index - torch.arange(160)).abs() <= 5
        assert calibration_error(match.probability, right) < 0.1
        strange = torch.cat(list(open_source("sim:aerial?frames=160&seed=5").batches(64)))
        off = model.localize(strange.flip(2), sequence=sequence).probability
        assert off is not None
        assert float((off >= 0.99).double().mean()) < 0.01 < float((match.probability >= 0.9).double().mean())


def test_batches_and_files_do_not_change_probabilities(model, tmp_path):
    queries = all_of(open_source(AGAIN))[:40]
    model.save(tmp_path / "map.safetensors")
    again = DejaVu.load(tmp_path / "map.safetensors")
    assert again.calibration == model.calibration
    again.batch_size = 7
    for sequence in (None, PlaceFilter()):
        whole, parts = (one.localize(queries, sequence=sequence).probability for one in (model, again))
        torch.testing.assert_close(whole, parts, atol=1e-5, rtol=0)


def test_convention_4_without_a_threshold_a_calibrated_map_accepts_from_a_half_on(model):
    queries = all_of(open_source(AGAIN))[::2]
    queries[40:] = queries[40:].flip(-1)  # some that are hard to find
    for sequence in (None, PlaceFilter()):
        match = model.localize(queries, sequence=sequence)
        assert match.probability is not None
        assert torch.equal(match.accepted, match.probability >= 0.5)
        assert 0 < int(match.accepted.sum()) < len(queries)
    assert model.acceptance() == model.acceptance(PlaceFilter()) == (None, 0.5, False)
    assert model.acceptance(PlaceFilter(threshold=3.0)) == (3.0, None, True)
    assert model.acceptance(SequenceMatcher(5)) == (None, None, False)
    for settings, single, filtered, sequence in (
        ({"threshold": 0.2}, (0.2, None, True), (None, 0.5, False), (0.2, None, True)),
        ({"precision": 0.9}, (None, 0.9, True), (None, 0.9, True), None),
        ({"threshold": math.inf}, (HIGHEST, None, True), (None, 0.5, False), (HIGHEST, None, True)),
    ):
        other = DejaVu(**(model.settings() | settings))
        other.load_state_dict(model.state_dict())
        assert (other.acceptance(), other.acceptance(PlaceFilter())) == (single, filtered)
        if sequence is not None:
            assert other.acceptance(SequenceMatcher(5)) == sequence
    other.calibration = Calibration()
    assert other.localize(queries).accepted.all()  # the last one, whatever the score
    assert other.acceptance(PlaceFilter()) == (math.log(2), None, False)


def test_precision_accepts_what_is_probable_enough(model, tmp_path):
    strange = all_of(open_source("sim:aerial?frames=20&seed=5")).flip(2)
    queries = torch.cat([all_of(open_source(AGAIN)), strange])
    sure = DejaVu(**(model.settings() | {"precision": 0.99}))
    sure.load_state_dict(model.state_dict())
    match = sure.localize(queries)
    assert match.probability is not None
    assert torch.equal(match.accepted, match.probability >= 0.99)
    assert 0 < int(match.accepted.sum()) < len(queries)
    sure.save(tmp_path / "map.safetensors")
    assert DejaVu.load(tmp_path / "map.safetensors").precision == 0.99
    with refused("calibrated for single queries and for a filter", "0.99"):
        sure.localize(queries, sequence=SequenceMatcher(5))
    sure.learn_features(torch.rand(64, 8))  # another map
    with refused("not calibrated", "0.99"):
        sure.localize(torch.rand(2, 8))


def test_a_map_without_calibration_tells_no_probability():
    features = torch.rand(64, 8)
    model = DejaVu(whitening="none").learn(features)
    assert model.localize(features).probability is None
    model.calibrate(None, LabelledFrames(as_traverse(features + 0.01), torch.arange(64)))
    assert model.localize(features).probability is not None


def views_of(frames, first=0):
    """Random frames that no place looks like."""
    return LabelledFrames(as_traverse(torch.rand(frames, 8)), torch.arange(first, first + frames))


@pytest.mark.parametrize(
    ("calibrate", "words"),
    [
        (lambda model: model.calibrate(torch.rand(64, 8)), ["ready features"]),
        (lambda _: DejaVu().calibrate(torch.rand(64, 8)), ["no map"]),
        (lambda model: model.calibrate(None), ["no reference and no views"]),
        (
            lambda model: model.calibrate(None, LabelledFrames(views_of(60).traverse, torch.arange(64))),
            ["60 frames"],
        ),
        (lambda model: model.calibrate(None, views_of(64, 1)), ["shows place 64", "one of 64"]),
        (lambda model: model.calibrate(None, views_of(1, 60)), ["calibrating by", "none of"]),
        (lambda _: DejaVu(precision=0.0), ["precision", "above 0 and below 1"]),
        (lambda _: DejaVu(precision=math.nan), ["precision", "above 0 and below 1"]),
        (lambda _: DejaVu(threshold=1.0, precision=0.9), ["threshold", "precision", "one of them"]),
    ],
)
def test_what_cannot_be_calibrated_is_refused(calibrate, words):
    model = DejaVu(whitening="none").learn(torch.rand(64, 8))
    with refused(*words):
        calibrate(model)


def test_an_export_tells_how_to_get_probabilities(model, tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    for name, made in {"_program": None, "_serialised": b"", "session_of": None}.items():
        monkeypatch.setattr(export, name, lambda *_, made=made: made)
    monkeypatch.setattr(export, "run_session", lambda _, frames: model(frames))  # as tests of the file say
    facts = export.export_onnx(model, tmp_path / "map.onnx").facts["calibration"]
    queries = all_of(open_source(AGAIN))[:20]
    with torch.no_grad():
        scores = model(queries)
    best, index = scores.min(1)
    beyond = (torch.arange(160) - index[:, None]).abs() > facts["tolerance"]
    sure = -best / scores.masked_fill(~beyond, INF).amin(1) ** facts["power"]
    told = torch.sigmoid(facts["slope"] * sure + facts["offset"]).double()
    torch.testing.assert_close(told, model.localize(queries).probability, atol=1e-3, rtol=0)
