"""The spectral map: what it keeps, what it costs, and that its scores are those of what it holds."""

from __future__ import annotations

import copy
import math
import re

import pytest
import torch
from helpers import refused
from processes import python

from dejavu_torch import DejaVu, PhaseTemplates
from dejavu_torch.maps import spectral_map
from dejavu_torch.maps.quantisation import dead_zone, quantise
from dejavu_torch.maps.spectral import SpectralMapper, encode_chunk
from dejavu_torch.maps.spectrum import from_spectrum, spectrum
from dejavu_torch.types import FrequencyLayer, InputError


def route(places=400, numbers=12, seed=0):
    """Smooth descriptors of length 1, as whitening gives."""
    noise = torch.randn(places, numbers, generator=torch.Generator().manual_seed(seed))
    lines = spectrum(noise.T) / (1 + torch.arange(places) / 20)
    return torch.nn.functional.normalize(from_spectrum(lines).T, dim=1)


def held(learned):
    return torch.cat([learned.decode(g) for g in range(len(learned.chunks))])


def share_held(learned, descriptors):
    """The share of the descriptors' variance that the lines of a map hold."""
    missing, centred = held(learned) - descriptors, descriptors - descriptors.mean(0)
    return 1 - float(missing.square().sum() / centred.square().sum())


def levels_of(learned):
    """(N,K), all levels, zeros too."""
    levels = torch.zeros(learned.places, learned.dimension, dtype=torch.int64)
    for g, (start, stop) in enumerate(learned.chunks):
        line, feature, value = learned.lines(g)
        whole = levels[start:stop]
        whole[line, feature] = (value / learned.steps[g]).round().long()
    return levels


def grow(learned, descriptors):
    coding = learned.means[-1], learned.step, learned.transform, learned.resolution
    learned.extend(encode_chunk(part, *coding) for part in descriptors.split(learned.chunk))


def copied(learned, empty):
    empty.load_packed(learned.packed(), learned.get_extra_state())
    return empty


@pytest.fixture(params=[True, False], ids=["csr", "scatter"])
def way(request, monkeypatch):
    """Products of queries with lines by either way."""
    monkeypatch.setattr(spectral_map, "_has_csr", lambda: request.param)


SETTINGS = [
    {},
    {"metric": "l2"},
    {"transform": "dct"},
    {"chunk": 64},
    {"chunk": 150, "transform": "dct", "metric": "l2", "resolution": 4.0},
]


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.usefixtures("way")
def test_scores_are_those_of_the_decoded_descriptors(settings):
    descriptors = route(403)
    learned = SpectralMapper(**settings)(descriptors)
    queries = descriptors[::7] + 0.1 * torch.randn(58, 12)
    own = held(learned)
    if settings.get("metric") == "l2":
        expected = torch.cdist(queries, own).square()
    else:
        expected = 1 - torch.nn.functional.cosine_similarity(queries[:, None], own, dim=2)
    assert torch.allclose(learned.scores(queries), expected, atol=1e-5)
    assert (own - descriptors).square().mean() < 0.1 * descriptors.var()


@pytest.mark.usefixtures("way")
def test_gradients_reach_the_queries():
    for settings in SETTINGS[::4]:
        learned = SpectralMapper(**settings)(route(90, 3)).double()
        queries = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(learned.scores, queries, atol=1e-6)


@pytest.mark.parametrize(("budget", "chunk"), [(0.8, 500), (5.0, 10_000)])
def test_the_written_route_is_within_the_budget(budget, chunk, tmp_path):
    descriptors = route(2000, 24)
    model = DejaVu(mapper=SpectralMapper(budget, chunk=chunk)).learn(descriptors)
    per_place = model.summary().route_bytes / 2000
    assert 0.98 * budget <= per_place <= budget
    model.save(tmp_path / "m.safetensors")
    again = DejaVu.load(tmp_path / "m.safetensors")
    assert (
        (tmp_path / "m.safetensors").stat().st_size == model.summary().map_bytes == again.summary().map_bytes
    )
    assert torch.equal(again(descriptors[:5]), model(descriptors[:5]))


@pytest.mark.parametrize(
    ("places", "numbers", "chunk"),
    [(2, 1, 10_000), (3, 6, 10_000), (8, 300, 4), (12, 2, 10_000)],
)
def test_by_default_a_route_of_any_length_is_held(places, numbers, chunk, caplog):
    descriptors = torch.randn(places, numbers, generator=torch.Generator().manual_seed(0))
    learned = SpectralMapper(chunk=chunk)(descriptors)
    assert share_held(learned, descriptors) >= 0.85 - 1e-5
    if numbers > 1:  # one number has no direction
        assert learned.scores(descriptors).argmin(1).tolist() == [*range(places)]
    assert not caplog.messages
    # a budget that is less than the mean takes is refused, and what the line names works
    with pytest.raises(InputError) as refusal:
        SpectralMapper(1.0, chunk=chunk)(descriptors)
    (least, works, most) = map(float, re.findall(r"(?:than|such as|at most) ([\d.]+)", str(refusal.value)))
    assert least < works < most
    for budget in (works, most):
        assert SpectralMapper(budget, chunk=chunk)(descriptors).summary().lines > 0
    for budget in (0.99 * least, most + 1):
        with refused(f"route_bytes_per_place is {budget:g}"):
            SpectralMapper(budget, chunk=chunk)(descriptors)


@pytest.mark.parametrize(("places", "numbers"), [(10, 2), (64, 3), (500, 6), (500, 64)])
def test_few_or_smooth_features_are_told_apart_by_what_5_bytes_hold(places, numbers):
    """Small differences beside a large drift are little of the variance."""
    walk = torch.randn(places, numbers, generator=torch.Generator().manual_seed(0)).cumsum(0)

    def found(**settings):
        index = SpectralMapper(**settings)(walk).scores(walk).argmin(1)
        return float((index == torch.arange(places)).float().mean())

    assert found() > 0.85
    assert found(hold=0.85) < 0.8


def test_by_default_more_than_5_bytes_are_taken_where_85_percent_need_them():
    noise = torch.randn(400, 60, generator=torch.Generator().manual_seed(0))
    learned = SpectralMapper()(noise)
    assert learned.step == SpectralMapper(hold=0.85)(noise).step
    assert learned.summary().route["lines"] > 5 * 400
    smooth = SpectralMapper()(route())
    assert 0.98 * 5 * 400 <= smooth.summary().route["lines"] <= 5 * 400
    assert smooth.step < SpectralMapper(hold=0.85)(route()).step


def test_by_default_few_numbers_take_what_changes_a_score():
    """5 bytes are more than one number takes as a float: by default they only bound it."""
    assert 1 < SpectralMapper()(route(200, 1)).summary().route_bytes / 200 < 4
    with refused("route_bytes_per_place is 6", "at most 4"):
        SpectralMapper(6.0)(route(200, 1))


def test_a_step_of_ones_own():
    descriptors = route()
    fine, coarse = (SpectralMapper(None, step=step)(descriptors) for step in (0.05, 0.5))
    assert (held(fine) - descriptors).square().mean().sqrt() <= 0.05
    assert coarse.summary().lines < fine.summary().lines
    assert coarse.summary().route_bytes < fine.summary().route_bytes


@pytest.mark.parametrize("settings", SETTINGS)
def test_the_lines_hold_the_share_that_is_asked_for(settings):
    descriptors = route(403)
    sizes = []
    for hold in (0.3, 0.85, 0.99):
        learned = SpectralMapper(hold=hold, **settings | {"resolution": 0.0})(descriptors)
        share = share_held(learned, descriptors)
        assert hold - 1e-5 <= share < hold + 0.01  # few lines: one of them is over a thousandth
        sizes.append(learned.summary().route_bytes)
    assert sizes[0] < sizes[1] < sizes[2]
    coarse = SpectralMapper(hold=0.99, **settings)(descriptors)  # what `resolution` leaves out counts
    assert coarse.step == learned.step
    assert (share_held(coarse, descriptors) < share - 1e-6) == (coarse.resolution > 0)


def test_the_step_that_holds_most_of_white_noise_is_known():
    """What is missing of a number lies between -.35 and .65 of a step."""
    noise = torch.randn(4000, 16, generator=torch.Generator().manual_seed(0))
    for hold, transform in ((0.99, "dft"), (0.999, "dct")):
        step = SpectralMapper(hold=hold, transform=transform)(noise).step
        assert step**2 * (0.65**3 + 0.35**3) / 3 == pytest.approx(1 - hold, rel=0.02)
    finest = SpectralMapper(hold=1 - 1e-9)(noise)  # no finer step changes a score
    assert finest.step == pytest.approx(1 / 64, rel=0.01)
    assert share_held(finest, noise) > 0.9999


def waves(cycles, period=20):
    """Four features of three harmonics each, a whole number of cycles."""
    time = torch.arange(cycles * period, dtype=torch.float64)[:, None] * (2 * math.pi / period)
    features = [sum(torch.sin(h * time + f + h) / h for h in (1, 2, 3)) for f in range(4)]
    return torch.cat(features, 1).float()  # type: ignore[arg-type]


def test_at_equal_error_the_file_grows_by_the_logarithm_of_the_cycles():
    sizes, counts = {}, {}
    for cycles in (10, 1000):
        learned = SpectralMapper(None, step=0.02 * math.sqrt(20 * cycles), chunk=10**6)(waves(cycles))
        sizes[cycles], counts[cycles] = learned.summary().route_bytes, learned.summary().lines
    assert counts[10] == counts[1000] == 24
    assert sizes[1000] <= sizes[10] + 64 + 24 * math.log2(1000 * 20) / 8 * 2


def test_at_the_resolution_the_dead_zone_is_twice_as_wide():
    """Waves of one period each, whose lines are 1.2 dead zones high."""
    for transform in ("dft", "dct"):
        time = torch.arange(96, dtype=torch.float64)
        phase = 0.5 if transform == "dct" else 0.0
        kept = []
        for period in (48, 24, 12, 8, 4):
            wave = (2 * math.pi * (time + phase) / period).cos()[:, None]
            height = float(spectrum(wave.T, transform).abs().max())
            route = SpectralMapper(None, step=height / 0.65 / 1.2, resolution=8.0, transform=transform)(wave)
            kept.append(len(route.level))
        assert kept == [1, 1, 0, 0, 0]  # dead zones 1.03, 1.11, 1.44, 2 and 5 times as wide


def test_resolution_is_kept_and_extends_alike():
    descriptors = route(300)
    mapper = SpectralMapper(None, step=0.3, chunk=100, resolution=6.0)
    grown = mapper(descriptors[:200])
    again = copied(grown, mapper.empty())
    grow(again, descriptors[200:])
    assert again.resolution == 6.0
    assert torch.equal(levels_of(again)[:200], levels_of(grown))
    lines = spectrum((descriptors[200:] - grown.means[0].float()).T).T
    levels = [quantise(lines, 0.3, dead_zone(lines, [(100, 1)], r, "dft")).long() for r in (6.0, 0.0)]
    assert torch.equal(levels_of(again)[200:], levels[0])
    assert not torch.equal(levels[0], levels[1])


def test_phase_means_are_the_spectrum_at_the_harmonics_of_the_period():
    """Eq. 1 repeated along whole cycles is the projection onto the lines of 1 / tau and its multiples."""
    for period, cycles in ((7, 11), (8, 6)):
        series = torch.randn(period * cycles, 3, dtype=torch.float64)
        layer = FrequencyLayer(period, period, 0, len(series), (0, 1, 2))
        (means,) = PhaseTemplates()(series, (layer,))
        lines = spectrum(series.T)
        of_line = (torch.arange(len(series)) + 1) // 2
        harmonics = torch.where(of_line % cycles == 0, lines, 0)
        assert torch.allclose(from_spectrum(harmonics).T, means.repeat(cycles, 1), atol=1e-12)


@pytest.mark.usefixtures("way")
def test_a_place_without_a_descriptor_scores_cosine_0():
    tiny = torch.full((1, 4), 1e-12)
    descriptors = torch.cat([torch.eye(4)[[0, 1]], tiny, -torch.eye(4)[[0, 1]]]).repeat(20, 1)
    learned = SpectralMapper(None, step=3e-7)(descriptors)
    assert learned.summary().covered == 80
    queries = torch.randn(3, 4, requires_grad=True)
    scores = learned.scores(queries)
    assert torch.equal(scores[:, 2::5], torch.ones(3, 20))
    (gradient,) = torch.autograd.grad(scores[:, 2::5].sum(), queries)
    assert torch.equal(gradient, torch.zeros(3, 4))


def test_a_place_without_a_descriptor_is_never_found():
    descriptors = torch.cat([torch.eye(4)[[0, 1]], torch.zeros(1, 4), -torch.eye(4)[[0, 1]]]).repeat(20, 1)
    learned = SpectralMapper(None, step=3e-7)(descriptors)
    assert learned.summary().covered == 80
    queries = torch.randn(3, 4, requires_grad=True)
    scores = learned.scores(queries)
    assert torch.equal(scores[:, 2::5], torch.full((3, 20), math.inf))
    assert scores[:, 1::5].isfinite().all()
    (gradient,) = torch.autograd.grad((-scores).softmax(1)[:, 0].sum(), queries)
    assert gradient.isfinite().all()
    assert learned.visit_counts.tolist() == [1, 1, 0, 1, 1] * 20
    for other in (
        learned.of_chunks(learned.coded()),
        copied(learned, SpectralMapper().empty()),
        learned.between(0, 1),
    ):
        assert torch.equal(other.scores(queries), scores)
    grown = SpectralMapper(None, step=3e-7, chunk=30)(descriptors)  # chunk after chunk
    assert grown.visit_counts.tolist() == [1, 1, 0, 1, 1] * 20
    assert grown.scores(queries)[:, 2::5].isinf().all()
    squared = SpectralMapper(None, step=3e-7, metric="l2")(descriptors)  # where 0 is a descriptor like any
    assert squared.scores(queries).isfinite().all()
    nothing = torch.zeros(2, 4, requires_grad=True)
    (gradient,) = torch.autograd.grad(learned.scores(nothing).sum(), nothing)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"route_bytes_per_place": 5.0, "step": 0.1}, ("5.0", "0.1", "None")),
        ({"route_bytes_per_place": math.nan}, ("nan", "above 0")),
        ({"route_bytes_per_place": 5.0, "hold": 0.85}, ("5.0", "hold is 0.85", "None")),
        ({"step": 0.1, "hold": 0.85}, ("step is 0.1", "hold is 0.85", "None")),
        ({"step": 0.0}, ("step is 0", "above 0")),
        ({"hold": 0.0}, ("hold is 0", "below 1")),
        ({"hold": 1.0}, ("hold is 1.0", "below 1", "0.85")),
        ({"hold": math.nan}, ("hold is nan", "below 1")),
        ({"chunk": 1}, ("chunk is 1", "at least 2")),
        ({"chunk": "route"}, ("'route'", "10000")),
        ({"transform": "fft"}, ("'fft'", "'dct'")),
        ({"metric": "l1"}, ("'l1'", "'cosine', 'l2'")),
        ({"resolution": math.nan}, ("resolution is nan", "0 or more")),
        ({"route_bytes_per_place": 0.01}, ("0.01", "mean", "at most 48")),
        ({"route_bytes_per_place": 200.0}, ("200", "mean", "at most 48")),
    ],
)
def test_settings_out_of_range_are_refused(settings, words):
    with refused(*words):
        SpectralMapper(**settings)(route())


@pytest.mark.parametrize(
    ("descriptors", "words"),
    [
        (torch.rand(1, 4), ("(1, 4)", "at least 2")),
        (torch.rand(4), ("(4,)", "(N, K)")),
        (torch.rand(4, 0), ("(4, 0)", "(N, K)")),
        (torch.ones(9, 4, dtype=torch.int64), ("int64", "floats")),
        (torch.ones(9, 4), ("9 descriptors", "all the same")),
        (torch.full((9, 4), math.nan), ("NaN",)),
    ],
)
def test_what_is_no_route_is_refused(descriptors, words):
    with refused(*words):
        SpectralMapper()(descriptors)


def test_what_does_not_fit_a_map_is_refused():
    learned, other = SpectralMapper(chunk=50)(route(60, 5)), SpectralMapper(chunk=50).empty()
    with refused("(3, 4)", "(Q, 5)"):
        learned.scores(torch.rand(3, 4))
    with refused("(50, 12)", "(N, 5)"):
        grow(learned, route())
    altered = learned.coded()[0]
    altered.stream.bytes[9] ^= 1
    with refused("truncated or altered"):
        learned.extend([altered])
    assert (learned.places, len(learned.chunks)) == (60, 2)
    tensors = learned.packed()
    for name, damaged, words in (
        ("streams", tensors["streams"][:-9], ("bytes", "claims")),
        ("streams", altered.stream.bytes, ("bytes", "claims")),
        ("stream_table", tensors["stream_table"] + torch.tensor([0, 1]), ("altered", "expected")),
        ("means", tensors["means"][:, :-1], ("expected",)),
    ):
        with refused(*words):
            other.load_packed(tensors | {name: damaged}, learned.get_extra_state())
    assert other.places == 0


def test_a_map_is_that_of_its_chunks_coded_one_by_one():
    for settings in (("cosine", "dft", 64, 0.0), ("l2", "dct", 64, 8.0)):
        features = route(200) * torch.tensor([50.0, *[1.0] * 11])
        metric, transform, chunk, resolution = settings
        learned = SpectralMapper(None, 0.002, chunk, transform, metric, resolution)(features)
        coding = learned.means[0], learned.step, transform, resolution
        alone = [encode_chunk(part, *coding) for part in features.split(64)]
        for made in (learned.of_chunks(alone), learned.of_chunks(learned.coded())):
            for name, tensor in learned.packed().items():
                assert torch.equal(made.packed()[name], tensor)
            assert torch.equal(made.scores(features[:5]), learned.scores(features[:5]))
        assert learned.level.abs().max() > 127


def test_a_copy_and_other_precisions_score_alike():
    for settings in SETTINGS[::4]:
        learned = SpectralMapper(**settings)(route(170))
        queries, expected = route(20, seed=1), learned.scores(route(20, seed=1))
        assert torch.equal(copy.deepcopy(learned).scores(queries), expected)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(learned.scores(queries), expected)
        assert torch.allclose(learned.scores(queries.half()), expected, atol=1e-2)
        compiled = torch.compile(learned.scores, fullgraph=True, backend="eager")
        assert torch.allclose(compiled(queries), expected, atol=1e-5)


@pytest.mark.slow
def test_nothing_is_written_to_stderr_when_a_map_scores():
    program = "import torch; from dejavu_torch import SpectralMapper; w = torch.rand(90, 5).cumsum(0); "
    program += "SpectralMapper()(w).scores(w[:3])"
    assert python(program).stderr == ""
