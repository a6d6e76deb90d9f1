"""Frames one at a time are found where `localize` finds them together."""

from __future__ import annotations

import copy
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from footage import QUERY, REFERENCE, camera, footage
from helpers import refused

from dejavu_torch import (
    DejaVu,
    ImposedPeriods,
    LiveLocalizer,
    PlaceFilter,
    SequenceMatcher,
    SpectralMapper,
    TemplateMapper,
    Whitening,
)
from dejavu_torch.live.localizer import as_batch
from dejavu_torch.recognition.calibration import Calibration, Platt
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.types import Match

PLACES, SHAPE = 48, (3, 24, 32)


def answers(localizer, frames):
    return [localizer(frame) for frame in frames]


@pytest.fixture(scope="module")
def route():
    """A camera that moves along a texture."""
    ground = torch.rand(1, 3, 6, 40, generator=torch.Generator().manual_seed(1))
    ground = torch.nn.functional.interpolate(ground, (24, 32 + 3 * PLACES), mode="bicubic").clamp(0, 1)[0]
    return torch.stack([ground[..., 3 * i : 3 * i + 32] for i in range(PLACES)])


@pytest.fixture(scope="module")
def drive(route):
    noise = torch.randn(route[10:40].shape, generator=torch.Generator().manual_seed(2))
    return (route[10:40] + 0.03 * noise).clamp(0, 1)


@pytest.fixture(scope="module")
def spectral(route):
    return (
        DejaVu(whitening=Whitening(views=1), mapper=SpectralMapper(20.0), threshold=0.7).learn(route).eval()
    )


SEQUENCES = {
    "single": None,
    "sequence": SequenceMatcher(5),
    "speeds": SequenceMatcher(4, (1.0, 0.5)),
    "filter": PlaceFilter(),
}


@pytest.mark.parametrize("sequence", SEQUENCES.values(), ids=SEQUENCES)
@pytest.mark.parametrize("kind", ["spectral", "templates"])
def test_one_by_one_is_as_all_together(kind, sequence, spectral, route, drive):
    model = spectral
    if kind == "templates":
        model = DejaVu(mapper=TemplateMapper(ImposedPeriods([5, 7, 9], bin=4)), threshold=1.0).learn(route)
    match = model.localize(drive, sequence=sequence)
    found = answers(LiveLocalizer(model, sequence), drive)
    assert [one.place for one in found] == match.index.tolist()
    assert [one.accepted for one in found] == match.accepted.tolist()
    torch.testing.assert_close(
        torch.tensor([one.score for one in found]), match.score.float(), rtol=1e-3, atol=1e-4
    )
    assert (match.index - torch.arange(10, 40)).abs().float().median() <= 2


def test_with_a_lag_answers_come_later_and_know_of_it(spectral, drive):
    sequence = PlaceFilter(lag=4)
    localizer = LiveLocalizer(spectral, sequence)
    due = []
    for t, frame in enumerate(drive):
        if t == 10:
            with refused("0 to 1"):
                localizer.due(frame + 9)
        due.append(localizer.due(frame))
        assert localizer.scores is None or int(localizer.scores.argmin()) == due[-1][0].place
    assert [len(one) for one in due] == [0] * 4 + [1] * 26
    found = [match for one in due for match in one] + localizer.finish()
    scores = spectral(drive)
    expected = sequence(scores).detach()
    assert [one.place for one in found] == expected.argmin(1).tolist()
    assert [one.score for one in found] == pytest.approx(expected.amin(1).tolist(), rel=1e-3, abs=1e-4)
    assert localizer.finish() == []
    with refused("lag of 4", "due"):
        localizer(drive[0])


def test_the_mean_of_the_frames_so_far_is_removed_if_asked_for(spectral, drive):
    assert spectral.whitening is not None
    queries = spectral.whitening(spectral.descriptor.describe(drive)).detach()
    mean = spectral.map.mean
    localizer = LiveLocalizer(spectral, None, centre=True)
    for t, frame in enumerate(drive):
        query = queries[t] - (queries[: t + 1] - mean).sum(0) / (t + 1 + 50)
        found, scores = localizer(frame), spectral.map.scores(query[None])
        assert (found.place, found.score) == (
            int(scores.argmin()),
            pytest.approx(float(scores.amin()), abs=1e-4),
        )


def test_the_default_is_a_filter_and_tells_its_posterior(spectral, drive):
    found = answers(LiveLocalizer(spectral), drive)
    assert [one.posterior for one in found] == pytest.approx([math.exp(-one.score) for one in found])
    assert all(0 < one.posterior <= 1 for one in found)
    assert all(math.isnan(one.posterior) for one in answers(LiveLocalizer(spectral, None), drive[:2]))
    assert all(0 < one.milliseconds < 10_000 for one in found)


@pytest.mark.parametrize(
    "given",
    [
        lambda x: x.double(),
        lambda x: (x.permute(1, 2, 0) * 255).round().byte().numpy(),
        lambda x: (x * 255).round().byte(),
        lambda x: np.rot90(np.rot90(x.permute(1, 2, 0).numpy().copy(), 2).copy(), 2),
        lambda x: x.numpy().astype(">f4"),
    ],
)
def test_every_kind_of_array(given, spectral, drive):
    batch = as_batch(given(drive[5]))
    torch.testing.assert_close(batch[0].float(), drive[5], atol=0.5 / 255 + 1e-6, rtol=0)
    assert LiveLocalizer(spectral, None)(given(drive[5])).place == 15


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (np.zeros((24, 32, 3), np.int64), ("int64", "(24, 32, 3)", "uint8")),
        (np.zeros((0, 32, 3), np.uint8), ("(0, 32, 3)", "empty")),
        (torch.full(SHAPE, 2.0), ("2", "0 to 1")),
        (torch.full(SHAPE, math.nan), ("nan", "0 to 1")),
        (np.zeros((64, 48, 3), np.uint8), ("64 x 48", "24 x 32")),
        ("photo.jpg", ("str", "uint8")),
    ],
)
def test_what_is_no_frame_of_the_map_is_refused_and_changes_nothing(frame, words, spectral, drive):
    localizer = LiveLocalizer(spectral)
    before = answers(localizer, drive[:6])
    with refused(*words):
        localizer(frame)
    found = before + answers(localizer, drive[6:9])
    expected = answers(LiveLocalizer(spectral), drive[:9])
    assert [one[:6] for one in found] == [one[:6] for one in expected]


def test_a_frame_of_another_size_is_brought_to_the_maps(spectral, drive, caplog):
    large = torch.nn.functional.interpolate(drive[:6], scale_factor=3, mode="nearest")
    found = [one.place for one in answers(LiveLocalizer(spectral, None), large)]
    assert found == spectral.localize(large).index.tolist()
    assert found == [one.place for one in answers(LiveLocalizer(spectral, None), drive[:6])]
    caplog.clear()
    answers(LiveLocalizer(spectral), torch.nn.functional.pad(drive, (0, 3)))  # as many cells
    assert len(caplog.messages) == 1


def test_scores_are_of_the_latest_frame_and_reset_forgets(spectral, drive):
    localizer = LiveLocalizer(spectral, SequenceMatcher(5))
    first = answers(localizer, drive[:8])
    assert localizer.scores is not None
    assert localizer.scores.shape == (PLACES,)
    assert (int(localizer.scores.argmin()), float(localizer.scores.min())) == first[-1][0:4:3]
    localizer.reset()
    assert localizer.scores is None
    assert [one[:6] for one in answers(localizer, drive[:8])] == [one[:6] for one in first]


def test_frames_left_out_move_the_filter_on(route):
    """Of every 6th frame only a filter that knows is not lost."""
    torch.manual_seed(3)
    model = DejaVu(whitening="none", mapper=SpectralMapper(None, step=0.05, metric="l2"))
    wave = torch.randn(300, 24)
    model.learn(wave)
    frames, noise = range(10, 290, 6), 1.2

    def posteriors(told):
        generator = torch.Generator().manual_seed(0)
        localizer = LiveLocalizer(model)
        seen = (wave[i] + noise * torch.randn(24, generator=generator) for i in frames)
        found = [localizer(one, 5 * told) for one in seen]
        return torch.tensor(
            [one.posterior * (abs(one.place - i) <= 5) for one, i in zip(found, frames, strict=True)]
        )

    assert posteriors(True)[10:].mean() > posteriors(False)[10:].mean() + 0.2


def test_names_and_interruption(spectral, drive, monkeypatch):
    localizer = LiveLocalizer(spectral)
    monkeypatch.setattr(spectral.state, "frame_names", [f"{i}.png" for i in range(PLACES)])
    found = localizer(drive[0])
    assert found.name == f"{found.frame}.png"

    def interrupted(queries):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(spectral.map, "scores", interrupted)
        broken = LiveLocalizer(spectral)
        with pytest.raises(KeyboardInterrupt):
            broken(drive[0])
    broken.reset()
    assert broken(drive[0])[:6] == LiveLocalizer(spectral)(drive[0])[:6]


def test_what_cannot_be_localised_live_is_refused(spectral):
    for model, sequence, words in (
        (DejaVu(), None, ["no map"]),
        (spectral, "best", ["best", "PlaceFilter"]),
        (spectral, SequenceMatcher(PLACES + 1), ["expected a shorter one"]),
    ):
        with refused(*words):
            LiveLocalizer(model, sequence)  # type: ignore[arg-type]


def test_a_map_of_even_steps_takes_frames_as_they_are_or_none():
    model = DejaVu(velocity=camera(), mapper=SpectralMapper(20.0), whitening="none").learn(footage(REFERENCE))
    with refused("even steps", "as_is"):
        LiveLocalizer(model)
    model.velocity = None
    match = LiveLocalizer(model, None)(footage(QUERY)[0])
    assert match.frame == int(model.map.frame_of(torch.tensor(match.place)))


def test_two_threads_that_ask_one_localizer_are_refused(monkeypatch):
    """Its answers depend on the frames before, in their order."""
    model = DejaVu(whitening="none").learn(torch.rand(60, 1, 32, 32))
    localizer, frame = LiveLocalizer(model), torch.rand(1, 32, 32)
    with localizer._localizer.alone_asked(), ThreadPoolExecutor(1) as pool:
        with refused("two threads ask one localizer", "one for each camera"):
            pool.submit(localizer, frame).result()
        localizer(frame)  # the thread that holds it goes on
    localizer(frame)


@pytest.mark.parametrize("sequence", ["filter", None])
def test_a_stream_that_stalls_is_less_and_less_sure(spectral, drive, sequence):
    spectral = copy.deepcopy(spectral)
    spectral.calibration, spectral.precision = Calibration(Platt(0.0, 3.0), Platt(1.0, 0.0)), 0.9
    spectral.threshold = None
    localizer = LiveLocalizer(spectral, sequence)
    frames = drive[[min(t, 20) for t in range(50)]]
    found = [localizer(frame) for frame in frames]
    assert [match.stale for match in found] == [0] * 21 + [*range(1, 30)]
    querying = Querying(match=sequence or "single", ordered=True)
    whole = Match.joined(spectral.matches(frames, querying))
    assert spectral.localize(frames, sequence=None).stale is None  # in no order
    assert whole.stale.tolist() == [match.stale for match in found]
    assert whole.index.tolist() == [match.place for match in found]
    assert whole.accepted.tolist() == [match.accepted for match in found]
    sure = [match.posterior if sequence else match.probability for match in found]
    if sequence:
        assert sure[49] < sure[30] < 0.9 * sure[20]
        assert sure[20] > 0.5 > sure[49]
    else:  # the first repeat may be that of a video of another rate
        assert sure[19:22] == [sure[20]] * 3
        assert sure[30] == pytest.approx(0.9**9 * sure[20])
        assert whole.probability.tolist() == pytest.approx(sure)
        assert found[21].accepted
        assert not found[30].accepted
