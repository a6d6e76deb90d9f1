"""Where a library meets the code around it: other types, other threads of autograd, other forms of input."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch
from command_line import fails
from helpers import refused
from torch import nn
from torch.autograd import forward_ad

from dejavu_torch import (
    DejaVu,
    ImposedPeriods,
    Match,
    PhaseTemplates,
    PlaceFilter,
    SequenceMatcher,
    SpectralMapper,
    TemplateMapper,
    Whitening,
    compare,
    evaluate,
    open_source,
)
from dejavu_torch.data import GroundTruth
from dejavu_torch.data.source import as_traverse
from dejavu_torch.evaluation import judge
from dejavu_torch.evaluation.options import Learning
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.types import FrequencyLayer

FRAMES = torch.rand(60, 3, 32, 24, generator=torch.Generator().manual_seed(0))
SOME = torch.arange(0, 60, 9)


def spectral(features=None, **settings):
    return DejaVu(features, Whitening(views=1), SpectralMapper(16.0), **settings)


def templates(**settings):
    return DejaVu(mapper=TemplateMapper(ImposedPeriods([3, 4, 5], bin=4), **settings))


def finds_itself(model, frames=FRAMES):
    assert model.localize(frames[SOME]).index.tolist() == SOME.tolist()


@pytest.fixture(scope="module")
def learned():
    return spectral().learn(FRAMES)


# one model beside another


def test_learning_a_second_model_leaves_the_first_alone(learned):
    before = learned(FRAMES[SOME])
    other = DejaVu(**learned.settings())
    assert other.features is learned.features
    assert other.whitening is not None
    assert learned.whitening is not None
    assert torch.equal(other.whitening.projection, learned.whitening.projection)
    other.learn(1 - FRAMES.flip(0))
    assert torch.equal(learned(FRAMES[SOME]), before)


def test_cells_follow_the_frames_of_each_model(tmp_path):
    small, large = torch.rand(40, 1, 32, 48), torch.rand(40, 1, 80, 120)
    first = DejaVu().learn(small)
    before = first(small[:3])
    second = DejaVu(**first.settings()).learn(large)
    with refused("NaN"):
        second.learn(small * torch.nan)
    second.save(tmp_path / "large.safetensors")
    loaded = DejaVu.load(tmp_path / "large.safetensors")
    assert [model.features.members[0].cell for model in (first, second, loaded)] == [8, 16, 16]
    assert torch.equal(first(small[:3]), before)
    assert torch.equal(loaded(large[:3]), second(large[:3]))


def test_an_optimiser_goes_on_with_the_templates_of_a_map_made_anew(caplog):
    model = templates(trainable=True).learn(FRAMES)
    kept, before = model.map.templates, model.map.templates.detach().clone()
    kept.grad, former = torch.ones_like(kept), model.map
    model.learn(FRAMES.flip(0))
    assert model.map.templates is kept
    assert kept.grad is None
    fresh = templates(trainable=True).learn(FRAMES.flip(0))
    assert torch.equal(kept, fresh.map.templates)
    assert torch.equal(former.templates, before)  # who holds the former map has it as it was
    model.learn(FRAMES[:50, :, :24])
    assert model.map.templates is not kept
    assert "new parameters" in caplog.text


# types


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_the_default_model_learns_and_localizes_under_autocast(dtype):
    with torch.autocast("cpu", dtype):
        model = DejaVu(whitening=Whitening(views=1), mapper=SpectralMapper(16.0)).learn(FRAMES)
        finds_itself(model)
    assert model(FRAMES[:2]).dtype == torch.float32


def test_phase_means_are_exact_under_autocast():
    plan = (FrequencyLayer(4, 4, 0, 60, (0, 1)),)
    features = 100 + torch.rand(60, 2)
    with torch.autocast("cpu", torch.bfloat16):
        found = PhaseTemplates()(features, plan)[0]
    assert torch.equal(found, PhaseTemplates()(features, plan)[0])


def network():
    return nn.Sequential(nn.Conv2d(3, 4, 5, stride=3), nn.Flatten())


@pytest.mark.parametrize(
    "make",
    [lambda: network().bfloat16(), lambda: network().double(), lambda: SmallCNN(8, 3, (16, 16)).double()],
    ids=["bfloat16", "double", "SmallCNN"],
)
def test_frames_have_the_type_of_the_network(make):
    torch.manual_seed(0)
    finds_itself(spectral(make()).learn(FRAMES))


@pytest.mark.parametrize("to", ["double", "half", "bfloat16"])
def test_frame_positions_keep_their_type(to):
    route = SpectralMapper(16.0)(torch.rand(60, 8))
    route.positions = torch.linspace(0, 3000, 60)
    getattr(route, to)()
    assert torch.equal(route.positions, torch.linspace(0, 3000, 60))


@pytest.mark.parametrize("to", ["double", "half", "bfloat16"])
def test_a_converted_model_is_saved_as_maps_are(to, tmp_path):
    model = spectral().learn(FRAMES)
    getattr(model, to)().save(tmp_path / "map.safetensors")
    finds_itself(DejaVu.load(tmp_path / "map.safetensors"))


# forms of input


def test_what_holds_a_route():
    shades = (255 * FRAMES).round().byte()
    for held in (shades, shades.numpy(), shades.permute(0, 2, 3, 1)):
        assert torch.equal(next(as_traverse(held).batches(60)), shades / 255)
        finds_itself(spectral().learn(held))
    both = torch.zeros(20, 3, 16, 3, dtype=torch.uint8)
    assert next(as_traverse(both).batches(2)).shape == (2, 3, 3, 16)  # colours are last
    with refused("(60, 4, 32, 24)", "(N,3,H,W) uint8"):
        spectral().learn(torch.zeros(60, 4, 32, 24, dtype=torch.uint8))


def test_a_path_is_opened():
    source = "sim:aerial?frames=60&size=32"
    model = spectral().learn(source).calibrate(source)
    expected = spectral().learn(open_source(source)).localize(open_source(source + "&traverse=1"))
    assert torch.equal(model.localize(source + "&traverse=1").index, expected.index)
    with refused("nowhere is not there"):
        spectral().learn("nowhere")


def test_no_queries_have_no_scores(learned):
    assert learned(FRAMES[:0]).shape == (0, 60)
    assert templates().learn(FRAMES)(FRAMES[:0]).shape == (0, 60)
    with refused("empty"):
        learned.localize(FRAMES[:0])


# sequences side by side


@pytest.mark.parametrize("model", [SequenceMatcher(3, (1, 0.5)), PlaceFilter()], ids=["matcher", "filter"])
def test_several_sequences_are_each_as_alone(model):
    scores = torch.rand(2, 3, 7, 20)
    scores[0, 1, 4, 3] = math.inf
    state = scores[..., :2, :] if isinstance(model, SequenceMatcher) else torch.rand(2, 3, 21).softmax(-1)
    for given in (None, state):
        alone = [
            model(scores[i, j], None if given is None else given[i, j]) for i in range(2) for j in range(3)
        ]
        torch.testing.assert_close(model(scores, given), torch.stack(alone).view(2, 3, 7, 20))
    run = torch.compile(model, fullgraph=True, backend="eager")
    torch.testing.assert_close(run(scores[0, 0], state[0, 0]), model(scores[0, 0], state[0, 0]))


def test_states_have_to_fit_several_sequences():
    scores = torch.rand(3, 7, 20)
    for model, state in ((SequenceMatcher(3), torch.rand(2, 20)), (PlaceFilter(), torch.rand(21).softmax(0))):
        assert model(scores[:0]).shape == (0, 7, 20)
        with refused("(3, 7, 20)", "a state for each"):
            model(scores, state)
    with refused("adds up to 21", "probabilities"):
        PlaceFilter()(scores, torch.ones(3, 21))


# truth in any form


def test_every_form_of_truth_gives_the_same_scores(learned, tmp_path):
    match, places = learned.localize(FRAMES[SOME]), SOME.tolist()
    expected = evaluate(match, SOME[:, None], 2)
    forms = {
        "places": SOME,
        "list": places,
        "array": SOME.numpy(),
        "lists": [[place, place + 1] for place in places],
        "ragged": [[place] * (1 + i) for i, place in enumerate(places)],
        "matrix": torch.eye(60, dtype=torch.bool)[SOME],
        "lists of a matrix": torch.eye(60, dtype=torch.bool)[SOME].tolist(),
        "rows of a matrix": [*torch.eye(60, dtype=torch.bool)[SOME]],
        "array backwards": SOME.flip(0).numpy()[::-1],
        "array of a matrix": np.eye(60, dtype=bool)[places],
        "truth": GroundTruth(SOME[:, None], torch.ones(7, dtype=torch.bool), SOME.new_zeros(7, 0)),
    }
    for name, truth in forms.items():
        assert evaluate(match, truth, 2) == expected, name
    assert evaluate(learned.candidates(FRAMES[SOME], 3), places, 2) == expected
    every = learned.localize(FRAMES)
    (tmp_path / "truth.json").write_text(str([[i] for i in range(60)]))
    for told in ("0", tmp_path / "truth.json"):
        assert evaluate(every, told, 2) == evaluate(every, range(60), 2)
    assert evaluate(every, [[0, 1, 1]] * 60, 2).recall_at_1 == 4 / 60  # no matrix
    metric = PlaceRecognition(2)
    metric.update(learned.candidates(FRAMES[SOME], 3), SOME)
    assert float(metric.compute()["recall_at_1"]) == expected.recall_at_1


@pytest.mark.parametrize(
    ("truth", "facts"),
    [
        (torch.eye(60)[SOME].long(), ("(7, 60) of 0 and 1", "truth.bool()")),
        (torch.eye(60)[SOME].long().tolist(), ("(7, 60) of 0 and 1", "truth.bool()")),
        (SOME.float(), ("torch.float32", "integer places")),
        ([[0.5]] * 7, ("torch.float32", "integer places")),
        (SOME > 3, ("one truth value", "integer places")),
        ([0, 1], ("(2, 1)", "(7, R)")),
        ({"a": 1}, ("a dict", "integer places")),
        (torch.zeros(7, 2, 2, dtype=torch.int64), ("(2, 2)", "integer places")),
    ],
)
def test_another_truth_is_refused(learned, truth, facts):
    with refused(*facts):
        evaluate(learned.localize(FRAMES[SOME]), truth, 2)


def test_what_cannot_be_judged_is_refused():
    for shape in ((2, 3, 4), (2, 0)):
        index = torch.zeros(shape).long()
        with refused(str(shape), "candidates (Q,k)"):
            evaluate(Match(index, index.float(), index > 0), [0, 1], 0)
    index = torch.zeros(2).long()
    with refused("[0, 1]", "at least 1"):
        judge(Match(index, index.float(), index > 0), [0, 1], 0, recalls=(0, 1))


def test_judged_queries_and_recalls():
    """By hand: right at rank 1, at rank 2, never."""
    index = torch.tensor([[5, 40], [40, 9], [40, 50]])
    match = Match(index, torch.tensor([[0.1, 0.5], [0.3, 0.4], [0.2, 0.6]]), index >= 0)
    found = judge(match, [[5], [9], [7]], tolerance=0, recalls=(1, 2, 5))
    assert found.right.tolist() == [True, False, False]
    assert found.recalls == {1: 1 / 3, 2: 2 / 3}
    assert found.scores == evaluate(match, [5, 9, 7], 0)
    assert found.scores.average_precision == 1.0


def test_average_precision_is_that_of_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    score, right = torch.rand(40).mul(10).round(), torch.rand(40) < 0.6
    match = Match(torch.where(right, 0, 9), score, right | ~right)
    expected = metrics.average_precision_score(right.numpy(), -score.numpy())
    assert evaluate(match, torch.zeros(40, 1).long(), 0).average_precision == pytest.approx(expected)
    perfect = Match(torch.arange(5), torch.ones(5), torch.ones(5) > 0)  # of tied scores
    assert evaluate(perfect, range(5), 0).average_precision == 1.0


def test_a_comparison_takes_places_as_truth():
    route = "sim:aerial?frames=60&size=32"
    unordered, uncalibrated = Querying(unordered=True), Learning(calibration="none")
    settings = {"model": spectral(), "learning": uncalibrated, "querying": unordered}
    found = compare(route, route + "&traverse=1", torch.arange(60), **settings)
    expected = compare(route, route + "&traverse=1", "0", **settings)
    assert found.report.ours.scores == expected.report.ours.scores
    assert found.report.facts["truth"] == "the places that the caller gave"


def test_the_length_and_parts_of_a_match_are_queries():
    each = Match(torch.tensor([3, 1, -1]), torch.tensor([0.5, 0.25, 9.0]), torch.tensor([True, True, False]))
    sure = dataclasses.replace(each, probability=each.score / 2, sequences={5: each})
    match = pickle.loads(pickle.dumps(sure))
    assert match.columns.keys() == {"index", "score", "accepted", "probability"}
    assert len(match) == 3
    for some in (slice(1, 3), torch.tensor([False, True, True])):
        index, score, accepted = match[some]
        assert [index.tolist(), score.tolist(), accepted.tolist()] == [[1, -1], [0.25, 9.0], [True, False]]
        assert match[some].sequences[5].index.tolist() == [1, -1]
    assert repr(match[1]) == "Match(index=1, score=0.25, accepted=True, probability=0.125)"


def test_a_match_prints_as_one_line():
    index, score = torch.arange(250), torch.rand(250)
    match = Match(index, score, index >= 10)
    assert repr(match) == "Match(250 queries, 240 accepted)"
    assert repr(match[:1]) == "Match(1 query, 0 accepted)"
    assert repr(match[:0]) == "Match(0 queries, 0 accepted)"
    sure = dataclasses.replace(match, probability=index.double() / 249)
    assert repr(sure) == "Match(250 queries, 240 accepted, median probability 0.50)"
    assert repr(sure[:0]) == "Match(0 queries, 0 accepted)"
    nan = torch.full((250, 2), torch.nan).double()
    ranked = sure.map(lambda column: column[:, None].expand(-1, 3))
    ranked = dataclasses.replace(ranked, probability=torch.cat([sure.probability[:, None], nan], 1))
    assert repr(ranked) == "Match(250 queries x 3 candidates, 240 accepted, median probability 0.50)"
    assert repr(ranked[:0]) == "Match(0 queries x 3 candidates, 0 accepted)"
    assert repr(match.map(lambda column: column.view(2, 5, 25))) == "Match(2 x 5 x 25 queries, 240 accepted)"


# torch.func through a whole model


def test_a_slope_through_frames_descriptors_and_map(learned):
    frames = FRAMES[:2].clone().requires_grad_()
    (expected,) = torch.autograd.grad(learned(frames).sum(), frames)
    found = torch.func.grad(lambda some: learned(some).sum())(FRAMES[:2])
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    lines = copy.deepcopy(learned.map)
    rows = torch.rand(3, lines.dimension)
    assert torch.func.jacrev(lines)(rows).shape == (3, 60, 3, lines.dimension)
    assert torch.func.jvp(lines, (rows,), (rows,))[1].shape == (3, 60)
    with forward_ad.dual_level():
        dual = lines(forward_ad.make_dual(rows, rows))
        assert forward_ad.unpack_dual(dual).tangent.shape == (3, 60)


# what a saved config names


def test_why_a_module_of_a_config_cannot_be_imported_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_networks.py").write_text("import missing_library\n")
    made = "dejavu_torch.cli.parser.made"
    (tmp_path / "saved.yaml").write_text(
        f"features:\n  class_path: {made}\n  init_args:\n    function: own_networks.Net\n"
    )
    error = fails(
        capsys, "learn", "sim:aerial?frames=60", "--map", "map.safetensors", "--config", "saved.yaml"
    )
    assert "own_networks.Net cannot be imported" in error
    assert "missing_library" in error
