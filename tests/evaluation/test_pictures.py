"""Every picture of a run, from frames to figures."""

from __future__ import annotations

import pytest
import torch
from drawn import texts
from footage import QUERY, REFERENCE, STEP, camera, footage
from helpers import Fixed, template_model
from torch import nn

from dejavu_torch import HOG, Match, PlaceFilter, SpectrogramAnalysis
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth, offset_truth
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.pictures import draw_pictures, paper_pictures
from dejavu_torch.evaluation.report import PICTURES
from dejavu_torch.evaluation.template_plots import shown_chunk
from dejavu_torch.places.positions import place_of
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.types import FrequencyLayer

ALL = (
    *("examples", "pairs", "coverage", "scores", "pr", "chunks"),
    *("spectrogram", "templates", "features", "activations"),
)


def layer(period, start, stop, *features):
    return FrequencyLayer(period, period, start, stop, features)  # type: ignore[arg-type]


def frames(seed, length=120):
    """Stripes that pass with periods 12 and 20 in the upper and the lower half, and noise."""
    i = torch.arange(length, dtype=torch.float32)[:, None, None]
    rows, columns = torch.meshgrid(torch.arange(24), torch.arange(24), indexing="ij")
    stripes = 0.5 + 0.4 * torch.sin(2 * torch.pi * (i + columns) / torch.where(rows < 12, 12, 20))
    noise = torch.rand(length, 1, 24, 24, generator=torch.Generator().manual_seed(seed))
    return 0.9 * stripes[:, None] + 0.1 * noise


def localized(model, reference, query, truth):
    traverses = ArrayTraverse(reference), ArrayTraverse(query)
    stored, seen = (model.descriptor.all_of(traverse) for traverse in traverses)
    model.learn_features(stored)
    return Localization(model, *traverses, stored, seen, model.localize(seen), truth, 2)


def drawn(run, laid_out=True, **found):
    contenders = {"map": contend("this map", run.match, run.truth, 2)}
    contenders |= {key: contend(f"the {key}", match, run.truth, 2) for key, match in found.items()}
    pictures = draw_pictures(run, contenders)
    assert pictures.keys() <= set(PICTURES)
    for picture in pictures.values():
        if laid_out:
            picture.plot[0].draw_without_rendering()
        assert picture.heading
        assert picture.caption.endswith(".")
    return pictures


def model_of(window=60, features=None):
    return template_model(features or HOG(), SpectrogramAnalysis(window=window, min_period=4))


def same_places(length=120):
    return as_ground_truth(offset_truth(length, length))


@pytest.fixture(scope="module")
def run():
    return localized(model_of(), frames(0), frames(1), same_places())


def test_every_picture_of_frames_that_repeat(run):
    other = Match(torch.arange(120), torch.zeros(120), torch.ones(120, dtype=torch.bool))
    pictures = drawn(run, stride=other, leave_out=other)
    assert tuple(pictures) == ALL
    assert {"this map", "the stride"} < set(texts(pictures["pr"].plot[0]))
    best = torch.tensor(pictures["scores"].plot[1].images[0].get_array()).argmin(0)
    assert torch.equal(best, run.match.index)
    assert [name for name, picture in pictures.items() if picture.numbers] == ["activations"]
    assert "Elsewhere" in pictures["activations"].caption


RIGHT, NUMBERS = offset_truth(120, 120), torch.arange(120)
NOTHING = GroundTruth(RIGHT.clamp(max=-1), NUMBERS >= 0, NUMBERS.expand(120, -1))
OTHER = nn.Sequential(nn.AvgPool2d(2), nn.Flatten())


@pytest.mark.parametrize(
    ("left_out", "given"),
    [
        ("pr", {"truth": None}),
        ("", {"truth": GroundTruth(RIGHT, NUMBERS % 3 > 0, RIGHT - 5)}),  # some are unknown
        ("pairs pr", {"truth": NOTHING}),
        ("", {"model": model_of(window=120)}),  # one chunk
        ("examples pairs features", {"of": HOG()}),  # ready features
        ("features", {"model": model_of(features=OTHER)}),
        ("features", {"model": model_of(features=type("OtherHOG", (HOG,), {})())}),
        ("activations spectrogram", {"model": template_model(periods=Fixed(layer(12, 0, 120, 0, 1, 2)))}),
        (
            "examples pairs scores spectrogram templates features activations",
            {"model": template_model(periods=Fixed())},  # no layers
        ),
    ],
)
def test_pictures_that_there_is_nothing_for_are_left_out(left_out, given):
    model, of, truth = ({"model": model_of(), "of": nn.Identity(), "truth": same_places()} | given).values()
    run = localized(model, of(frames(0)), of(frames(1)), truth)
    pictures = drawn(run, laid_out=False)
    assert list(pictures) == [name for name in ALL if name not in left_out.split()]
    if truth is not None and "activations" in pictures and len(run.model.map.summary().chunks) == 1:
        numbers = pictures["activations"].numbers
        assert [rate["outside"] for rate in (*numbers["layers"], numbers["fused"])] == [None] * 3
        assert "lsewhere" not in pictures["activations"].caption


def sequenced(run, model):
    """The same, with the queries matched together."""
    match = run.model.localize(run.query_features, sequence=model)
    return run._replace(matching=Matching(model), match=match)


def test_the_paper_s_own_pictures(run):
    assert list(paper_pictures(run)) == ["frames", "autocorrelogram", "layers"]
    assert list(paper_pictures(run._replace(truth=None))) == ["autocorrelogram", "layers"]
    nothing = localized(template_model(periods=Fixed()), frames(0), frames(1), same_places())
    assert list(paper_pictures(nothing)) == ["frames"]
    features = localized(model_of(), HOG()(frames(0)), HOG()(frames(1)), same_places())
    assert list(paper_pictures(features)) == ["autocorrelogram", "layers"]


# a resampled map: places are even steps, the camera stands at one of them


@pytest.fixture(scope="module")
def resampled():
    periods = SpectrogramAnalysis(window=50, min_period=4, false_alarm=None)
    model = template_model(HOG(), periods, velocity=camera())
    reference, query = (model.resample(ArrayTraverse(footage(w)), STEP) for w in (REFERENCE, QUERY))
    stored, seen = (model.descriptor.all_of(traverse) for traverse in (reference, query))
    model.learn_features(stored, reference)
    nearest = (REFERENCE - QUERY[query.frame, None]).abs().argmin(1, keepdim=True)
    truth = as_ground_truth(place_of(reference.positions, nearest))
    return Localization(model, reference, query, stored, seen, model.localize(seen), truth, 3)


@pytest.fixture(scope="module")
def pictures(resampled):
    run = resampled
    return draw_pictures(run, {"map": contend("this map", run.match, run.truth, 3)}) | paper_pictures(run)


def test_convention_11_every_axis_along_a_resampled_route_counts_frames(resampled, pictures):
    run, frames = resampled, len(REFERENCE)
    assert run.model.map.places == 101 < frames
    axes = {name: picture.plot[1] for name, picture in pictures.items()}
    shown = [frame for line in axes["coverage"].lines for frame in line.get_ydata().tolist()]
    assert sorted(shown) == sorted(run.model.map.frame_of(run.match.index).tolist())
    asked = [frame for line in axes["coverage"].lines for frame in line.get_xdata().tolist()]
    assert sorted(asked) == run.query.frame.tolist()
    assert axes["coverage"].get_ylim()[1] == axes["chunks"].get_xlim()[1] == frames
    scores = axes["scores"]
    assert scores.get_ylim() == (-0.5, frames - 0.5)
    filtered = draw_pictures(sequenced(run, PlaceFilter()), {})["posterior"].plot[1][0]
    assert filtered.get_ylim() == (-0.5, frames - 0.5)
    assert filtered.get_xlim() == scores.get_xlim()
    assert axes["spectrogram"][1].get_xlim() == (0, frames)
    middle, end = run.model.map.frame_of(torch.tensor([50, 100])).tolist()  # of chunks of 50 places
    borders = [line.get_xdata()[0] for line in axes["chunks"].lines]
    assert set(borders) == {0, middle, end}
    assert middle > 85  # it stands from frame 60 to 85
    start, stop = axes["activations"][-1].get_xlim()
    assert (start, stop) in ((0, middle), (middle, end))
    assert axes["activations"][0].images[0].get_array().shape[1] == stop - start  # a column a frame
    assert axes["layers"].get_xlim() == (start - 0.5, stop - 0.5)
    for name in ("spectrogram", "chunks", "scores", "activations", "layers"):
        assert "place (frame)" in texts(pictures[name].plot[0]), name


def test_convention_11_what_counts_places_says_so(pictures):
    for name in ("spectrogram", "chunks", "layers"):
        assert "period (places at even steps)" in texts(pictures[name].plot[0]), name
    assert "lag (places at even steps)" in texts(pictures["autocorrelogram"].plot[0])
    for name in ("coverage", "pr"):
        assert "right within 3 places at even steps" in texts(pictures[name].plot[0]), name
    assert "within 3 places at even steps" in pictures["activations"].caption
    assert pictures["activations"].numbers["start"] in (0, 50)  # as the chunks of report.json
    plain = draw_pictures(localized(model_of(), frames(0), frames(1), None), {})
    assert "period (frames)" in texts(plain["chunks"].plot[0])


def test_convention_11_frames_of_a_resampled_route_are_called_as_in_the_matches(resampled, pictures):
    run = resampled
    titles = [axis.get_title(loc="left") for axis in pictures["pairs"].plot[1].flat]
    asked, reported = ([int(title.split()[-1]) for title in titles[k::3]] for k in (0, 1))
    shown = run.model.map.frame_of(run.match.index)
    pairs = set(zip(run.query.frame.tolist(), shown.tolist(), strict=True))
    assert set(zip(asked, reported, strict=True)) <= pairs
    layer = run.model.map.plan[shown_chunk(run.model.map.plan)[0]]
    middle = int(run.model.map.frame_of(torch.tensor((layer.start + layer.stop) // 2)))
    assert f"drawn on frame {middle} as" in pictures["features"].caption
    numbers = [axis.get_title(loc="left").split()[-1] for axis in pictures["frames"].plot[1].flat]
    assert max(int(number) for number in numbers) > 101
