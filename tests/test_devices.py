"""Nothing in the way of a frame to its place leaves the device that the model is on."""

from __future__ import annotations

import copy
from contextlib import nullcontext

import pytest
import torch
from command_line import fails, run
from devices import DEVICE, pretend
from helpers import long_from
from torch import Tensor, nn

from dejavu_torch import (
    HOG,
    DejaVu,
    Embedding,
    GroundOdometry,
    ImposedPeriods,
    LiveLocalizer,
    PlaceFilter,
    Preprocess,
    SequenceMatcher,
    SpectralMapper,
    SpectrogramAnalysis,
    TemplateMapper,
    Whitening,
    compare,
    evaluate,
    growth,
    open_source,
)
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.controls import leave_out_match, null_control
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.views import LabelledFrames, augmented_route
from dejavu_torch.recognition import coarse
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.samples import RowSearch
from dejavu_torch.recognition.select import best_candidates, best_match

SEQUENCES = [PlaceFilter(), SequenceMatcher(3), None]
ELSEWHERE = f"cuda:{torch.cuda.device_count()}"  # the first that is not there


def models():
    return {
        "spectral": DejaVu(whitening=Whitening(views=1)),
        "chunks": DejaVu(
            preprocess=Preprocess(channel="grey", contrast="patch"),
            whitening=Whitening(views=1),
            mapper=SpectralMapper(20.0, chunk=16, transform="dct", metric="l2"),
        ),
        "templates": DejaVu(mapper=TemplateMapper(ImposedPeriods([3, 4, 5], bin=4))),
    }


@pytest.fixture(scope="module")
def frames():
    """(40,3,32,32)"""
    whole = torch.cat(list(open_source("sim:aerial?frames=40").batches(64)))
    return nn.functional.interpolate(whole, (32, 32), mode="area")


MODULES = {
    "HOG": HOG(),
    "Distilled": Distilled(),
    "Joined": Joined([HOG(), PatchPixels()]),
    "PatchPixels": PatchPixels(),
    "SmallCNN": SmallCNN(8, channels=3, resize=(16, 16), widths=(4, 8), squeeze=4),
    "Embedding": Embedding(nn.Conv2d(3, 8, 3), 8, hidden=12, cell=4, resize=(16, 16), mean=0.5, std=0.2),
    "Preprocess": Preprocess(channel="grey", contrast="patch"),
    "Augmentation": Augmentation(perspective=3.0),
}


@pytest.mark.parametrize("name", MODULES)
def test_a_module_gives_what_it_gives_on_the_cpu(name):
    """But an augmentation draws numbers of its own."""
    frames, module = torch.rand(3, 3, 32, 32), MODULES[name].train(name == "Augmentation")
    expected = module(frames)
    with pretend() as device:
        found = copy.deepcopy(module).to(device)(frames.to(device))
        assert found.device == device
        if name != "Augmentation":
            torch.testing.assert_close(found.cpu(), expected, rtol=1e-4, atol=1e-4)


def refused_mixtures(device):
    there = torch.arange(3.0, device=device)
    return {
        "an index": lambda: torch.zeros(3)[there.long()],
        "a mask": lambda: torch.zeros(3)[there > 0],
        "a sum": lambda: there + torch.zeros(3),
        "a number among rows": lambda: torch.stack([there[0], torch.tensor(0.0)]),
        "values put": lambda: there.index_put((torch.tensor([0]),), torch.zeros(1)),
        "another's generator": lambda: torch.rand(3, generator=torch.Generator(), device=device),
        "numpy": there.numpy,
    }


@pytest.mark.parametrize("name", refused_mixtures(torch.device("cpu")))
def test_the_pretended_device_refuses(name):
    with pretend() as device, pytest.raises((RuntimeError, TypeError), match="device"):
        refused_mixtures(device)[name]()  # type: ignore[operator]


CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
GPU = pytest.param("cuda", marks=[pytest.mark.gpu, CUDA])


@pytest.fixture(params=[DEVICE.type, GPU])
def device(request):
    """The pretended device, and a GPU where there is one."""
    with pretend() if request.param == DEVICE.type else nullcontext():
        yield request.param


@pytest.fixture(autouse=True)
def whole_numbers(monkeypatch):
    """Convolutions of a GPU have 10 bits of each number unless they are told otherwise."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)


LEARNED = {
    "templates": TemplateMapper(ImposedPeriods([3, 4, 5], bin=4)),
    "found": TemplateMapper(SpectrogramAnalysis(40, false_alarm=None), reduction="sum", temperature=3.0),
    "spectral": SpectralMapper(None, step=1e-4),  # so fine that what rounding moves by a step is not seen
    "chunks": SpectralMapper(None, step=1e-4, chunk=16, transform="dct", metric="l2"),
}


def small(**settings):
    return DejaVu(**{"features": HOG(), "mapper": SpectralMapper(chunk=30)} | settings)


@pytest.fixture(scope="module")
def visits(frames):
    """A route, and a second visit."""
    return ArrayTraverse(frames), ArrayTraverse(0.9 * frames + 0.02 * torch.rand_like(frames))


@pytest.mark.parametrize("kind", LEARNED)
def test_a_map_learned_on_a_gpu_scores_as_that_of_the_cpu(kind, device, frames):
    maps = [DejaVu(whitening="none", mapper=LEARNED[kind]).to(one).learn(frames) for one in ("cpu", device)]
    query = frames[3::4] * 0.9 + 0.02
    scores, found = (model(query.to(model.map.device)) for model in maps)
    assert found.device.type == device
    assert scores.isfinite().all()
    torch.testing.assert_close(found.cpu(), scores, rtol=1e-4, atol=1e-4)
    matches = [model.localize(query) for model in maps]
    torch.testing.assert_close(matches[1].score, matches[0].score, rtol=1e-4, atol=1e-4)
    assert matches[0].index.tolist() == matches[1].index.tolist()


def test_a_whitening_learned_on_a_gpu_is_that_of_the_cpu(device, frames):
    whitening = Whitening(numbers=8, views=2, bits=16)
    models = [DejaVu(whitening=copy.deepcopy(whitening)).to(one).learn(frames) for one in ("cpu", device)]
    known = [model.descriptor(frames.to(model.map.device)).cpu() for model in models]
    # up to the signs of its numbers, what 16 bits round, and votes that rounding moves to another bin
    products = [one @ one.T for one in known]
    assert float((products[1] - products[0]).norm() / products[0].norm()) < 0.01


def test_copies_of_frames_are_those_of_the_cpu(device, frames):
    (views, *_), _ = augmented_route(ArrayTraverse(frames), len(frames), 2, 99, {"perspective": 5})
    made = [torch.cat([part.cpu() for part in views.batches(16, where)]) for where in ("cpu", device)]
    torch.testing.assert_close(made[1], made[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bins", ["hard", "linear"])
def test_hog_on_a_gpu_is_that_of_the_cpu(device, frames, bins):
    features = HOG(bins=bins)
    torch.testing.assert_close(features(frames.to(device)).cpu(), features(frames), rtol=1e-5, atol=1e-5)


def test_a_map_calibrated_on_a_gpu_is_as_sure_as_that_of_the_cpu(device, visits):
    models = [small(whitening="none", mapper=LEARNED["spectral"]).to(one) for one in ("cpu", device)]
    for model in models:
        model.learn(visits[0]).calibrate(visits[0], LabelledFrames(visits[1], torch.arange(40)))
    expected, found = (model.calibration for model in models)
    assert expected is not None
    assert found is not None
    assert expected.single is not None
    assert found.single[:2] == pytest.approx(expected.single[:2], rel=1e-2)
    assert found.filter[:2] == pytest.approx(expected.filter[:2], rel=1e-2)


@pytest.mark.parametrize("kind", models())
def test_a_gpu_finds_what_the_cpu_finds(kind, device, frames):
    here = models()[kind].learn(frames)
    there = models()[kind].to(device).learn(frames)
    assert {tensor.device.type for tensor in there.state_dict().values() if isinstance(tensor, Tensor)} == {
        device
    }
    there.load_state_dict(here.state_dict())  # learned alike but for rounding
    queries = frames[::8]
    candidates = there.candidates(queries, 2)
    # of other batches, which a GPU rounds otherwise
    torch.testing.assert_close(candidates.score[:, 0], there.localize(queries).score, rtol=1e-4, atol=1e-4)
    for sequence in SEQUENCES:
        expected = here.localize(queries, sequence=sequence)
        match = there.localize(queries, sequence=sequence)
        assert match.score.device.type == "cpu"
        torch.testing.assert_close(match.score, expected.score, rtol=1e-4, atol=1e-4)
        localizer = LiveLocalizer(there, sequence)
        found = [localizer(frame).score for frame in queries]
        assert found == pytest.approx(expected.score.tolist(), rel=1e-4, abs=1e-4)
        assert localizer.scores is not None
        assert localizer.scores.device.type == device


@pytest.mark.parametrize("mapper", ["templates", "spectral"])
def test_a_comparison_runs_on_a_gpu(mapper, device, visits, tmp_path, monkeypatch):
    """With calibration, baselines and nulls; the map is then saved, and loaded to the device."""
    for drawn in ("draw_pictures", "draw_compared", "draw_reliability"):  # from a model on the CPU
        monkeypatch.setattr(f"dejavu_torch.evaluation.compare.{drawn}", lambda *_: {})
    chosen = LEARNED["templates"] if mapper == "templates" else SpectralMapper()
    compared = compare(*visits, "0", small(mapper=chosen).to(device), querying=Querying(ordered=True, top=2))
    assert compared.report.ours.scores is not None
    model, path = compared.run.model, tmp_path / "map.safetensors"
    model.to(device).save(path)
    other = DejaVu.load(path).to(device)
    assert torch.equal(other.localize(visits[1]).index, model.cpu().localize(visits[1]).index)


def test_a_map_grows_on_a_gpu(device, visits):
    route, again = visits
    second = LabelledFrames(again, torch.arange(40))
    model = small().to(device).learn(route, second=second, visits=second)
    model.calibrate(route, second)
    grown = growth.append(copy.deepcopy(model), again, visits=LabelledFrames(route, torch.arange(40)))
    assert growth.average(model, LabelledFrames(again, torch.arange(40))) == 40
    merged = growth.merge([model, grown], ["a", "b"])
    assert merged.map.places == 120
    for sequence in (PlaceFilter(), SequenceMatcher(3), None):
        assert merged.localize(torch.cat([*again.batches(5)])[::8], sequence=sequence).index.shape == (5,)
    assert {one.device.type for one in merged.state_dict().values() if isinstance(one, Tensor)} == {device}


@pytest.mark.parametrize("decoded", [0, coarse.DECODED])
def test_a_long_route_is_learned_and_searched_on_a_gpu(decoded, device, monkeypatch):
    """From a sample, chunk by chunk, with principal components of wide features; then by its own samples, or
    all its places."""
    long_from(monkeypatch, 200)
    monkeypatch.setattr(coarse, "MIN_PLACES", 100)
    monkeypatch.setattr(coarse, "DECODED", decoded)
    wave = torch.sin(0.05 * torch.arange(600.0)[:, None] * torch.rand(260) + torch.arange(260))
    model = DejaVu(mapper=SpectralMapper(8.0, chunk=200)).to(device).learn(wave)
    queries = wave[::50] + 0.01
    expected = model.localize(queries, search="scan")
    assert torch.equal(model.localize(queries).index, expected.index)
    assert type(model.searcher) is (RowSearch if decoded else coarse.CoarseSearch)


def test_a_search_reads_no_value_back(device):
    """Nothing waits between the queries and their places."""
    place_map = SpectralMapper(8.0).to(device)(torch.randn(600, 24, device=device).cumsum(0))
    search, queries, wanted = RowSearch(place_map), torch.randn(5, 24), [(3, 2), (2, 5)]
    expected = [best_candidates(place_map.scores(queries.to(device)), *spec).index.cpu() for spec in wanted]
    here = queries.to(device)
    if device == "cuda":
        torch.cuda.set_sync_debug_mode("error")
    try:
        score, place = search(here, wanted)
        found = [best_candidates(score, *spec, places=place).index for spec in wanted]
    finally:
        if device == "cuda":
            torch.cuda.set_sync_debug_mode("default")
    assert all(map(torch.equal, [one.cpu() for one in found], expected))


def test_even_steps_are_learned_on_a_gpu(device):
    strip = nn.functional.interpolate(torch.rand(1, 1, 60, 16), scale_factor=4)[0]
    frames = torch.stack([strip[:, 2 * i : 2 * i + 64] for i in range(40)]).flip(0)
    model = small(velocity=GroundOdometry(step=3.0, size=(32, 32))).to(device).learn(frames)
    assert model.map.device.type == device
    shown = model.map.frame_of(model.localize(frames).index)
    assert (shown.device.type, int(shown.diff().min()) >= 0) == ("cpu", True)
    assert GroundOdometry().to(device)(frames[:3].to(device))[0].device.type == device


def test_controls_and_scores_are_computed_on_a_gpu(device, visits):
    model = small(mapper=LEARNED["templates"]).to(device).learn(visits[0])
    features = model.descriptor.describe(next(visits[0].batches(40)).to(device))
    for same in (True, False):
        assert null_control(model, features, features, same_plan=same).index.shape == (40,)
    assert leave_out_match(model, features, 2).index.shape == (40,)
    match, truth = best_match(model.map.scores(features)), torch.arange(40)[:, None]
    assert match.index.device.type == device
    scores = evaluate(match.map(Tensor.cpu), truth, 2)
    assert evaluate(match, truth, 2) == evaluate(match, truth.to(device), 2) == scores


COMMANDS = {
    "learn": ("learn", "sim:aerial?frames=60", "--map", "map.safetensors"),
    "localize": ("localize", "map.safetensors", "sim:aerial?frames=60", "--out", "matches.csv"),
    "compare": ("compare", "sim:aerial?frames=60", "sim:aerial?frames=60&traverse=1", "--out", "report"),
    "live": ("live", "map.safetensors", "sim:aerial?frames=60"),
}


@pytest.mark.parametrize(
    ("command", "device"), [*zip(COMMANDS, [ELSEWHERE, "tpu", "cpu:1", "cuda:x"], strict=True)]
)
def test_a_device_that_is_not_there_is_one_line(command, device, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    error = fails(capsys, *COMMANDS[command], f"--device={device}")
    assert f"--device {device}" in error
    assert list(tmp_path.iterdir()) == []


def test_the_option_moves_the_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    moved = []
    to = DejaVu.to
    monkeypatch.setattr(DejaVu, "to", lambda self, device: (moved.append(device), to(self, device))[1])
    for command in ("learn", "localize", "live"):
        run(*COMMANDS[command], "--device", "cpu")
        assert moved.pop() == torch.device("cpu")
        assert moved == []


def test_learning_takes_double_precision(monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert device_of("mps").type == "mps"
    with pytest.raises(ValueError, match="double precision"):
        device_of("mps", learns=True)
