"""The whole drive as the query: motion, evidence by rank, forward-backward, and what is learned from it."""

from __future__ import annotations

import itertools
import math

import pytest
import reference
import torch
from helpers import refused
from torch import Tensor

from dejavu_torch import PlaceFilter, PlaceSmoother
from dejavu_torch.recognition import smoother as smoothing
from dejavu_torch.recognition.centring import PRIOR, centred
from dejavu_torch.recognition.drive import doubt, localize_drive
from dejavu_torch.recognition.evidence import (
    LOWEST,
    PER_DEVIATION,
    RankTable,
    correlation_time,
    place_means,
    spacing_of,
    standardised,
)
from dejavu_torch.recognition.motion import Layout, Motion, Rates
from dejavu_torch.recognition.smoother import Block, near_mass, sweep

LAYOUTS = [
    Layout(5),
    Layout(5, 2, turn=0.1),
    Layout(7, 2, (0, 3), turn=0.1),
    Layout(6, 2, (0,), ((5, 0, 1.0),), 0.1),
    Layout(7, 2, (0, 4), ((2, 5, 0.3), (2, 0, 0.5), (6, 0, 0.9)), 0.2),
]


def rates(dtype: torch.dtype = torch.float64) -> Rates:
    moves = torch.tensor([0.2, 0.4, 0.25, 0.15], dtype=dtype)
    return Rates(moves, *(moves.new_tensor(rate) for rate in (0.05, 0.03, 0.2)))


def explicit(layout: Layout) -> tuple[Motion, Tensor]:
    return Motion(layout, rates()), torch.tensor(reference.transitions(layout, rates()), dtype=torch.float64)


def made(places: Tensor, count: int = 90, noise: float = 0.4, seed: int = 0) -> Tensor:
    """Scores (Q,N) of queries at these places, -1 off the map, of features that change along the map."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(count, 24, generator=generator)
    queries = torch.where(places[:, None] >= 0, features[places.clamp(min=0)], 0)
    queries = queries + (noise + (places < 0)[:, None]) * torch.randn(len(places), 24, generator=generator)
    return 1 - torch.nn.functional.cosine_similarity(queries[:, None], features[None], dim=2)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_step_is_that_of_the_explicit_matrix(layout: Layout) -> None:
    motion, matrix = explicit(layout)
    belief, message = torch.rand(3, len(matrix)).double(), torch.rand(3, len(matrix)).double()
    torch.testing.assert_close(matrix.sum(1), torch.ones(len(matrix)).double())
    torch.testing.assert_close(motion.moved(belief), belief @ matrix)
    torch.testing.assert_close(motion.expected(message), message @ matrix.T)
    best = (belief[0].log()[:, None] + matrix.log()).amax(0)
    if not layout.links:  # several ways between two places are one here
        torch.testing.assert_close(motion.best_moved(belief[0].log()), best)
    counts = motion.counts(belief, message)
    joint = belief[:, :, None] * matrix * message[:, None, :]
    joint = joint / joint.sum((1, 2), keepdim=True)
    torch.testing.assert_close(counts.enter + counts.absent, joint[:, -1].sum())
    torch.testing.assert_close(counts.absent, joint[:, -1, -1].sum())
    torch.testing.assert_close(counts.moves.sum() + counts.jump + counts.leave, joint[:, :-1].sum())


def test_no_move_crosses_into_the_next_route_and_a_loop_closes() -> None:
    still = Rates(torch.tensor([0.0, 1.0]), *(torch.zeros(3).unbind()))
    on = torch.eye(11)[2]  # the third of five places
    parted = Motion(Layout(5, 2, (0, 3)), still).moved(on)
    assert parted.nonzero().tolist() == [[10]]  # off the map
    closed = Motion(PlaceSmoother(loop=True).layout(5), still)
    assert closed.moved(torch.eye(11)[4]).argmax() == 0
    assert closed.moved(torch.eye(11)[9]).argmax() == 5  # backwards from place 0 to place 4


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", [1, 4, 20])
def test_blocks_of_any_size_give_the_explicit_posterior(layout: Layout, size: int) -> None:
    motion, matrix = explicit(layout)
    likelihood = torch.rand(9, len(matrix)).double() * 3
    likelihood[:, -1] = 1
    still = torch.zeros(9, dtype=torch.bool)
    blocks = [*sweep(motion, lambda first, last: likelihood[first:last], 9, still, size)]
    assert [block.first for block in blocks] == [*range(0, 9, size)][::-1]
    expected, log = reference.smoothed(matrix, motion.anywhere(), likelihood)
    torch.testing.assert_close(torch.cat([block.posterior for block in blocks[::-1]]), expected)
    assert float(sum(block.log.sum() for block in blocks)) == pytest.approx(log)


def test_the_posterior_and_the_likelihood_are_those_of_the_explicit_chain() -> None:
    scores = torch.rand(8, 6).double()
    smoother = PlaceSmoother(tempering=2.0, separation=1.0, within=0, turn=0.05)
    drive = smoother.drive(scores)
    log = torch.nn.functional.pad(smoother.wide(drive.log_likelihood(torch.arange(8)), 0.0), (0, 0))
    motion = smoother.motion(6, (0,), scores)
    matrix = torch.tensor(reference.transitions(motion.layout, motion.rates), dtype=torch.float64)
    expected, total = reference.smoothed(matrix, motion.anywhere(), log.exp())
    places = expected[:, :6] + expected[:, 6:12].flip(1)
    posterior = smoother.posterior(scores)
    torch.testing.assert_close(posterior, torch.cat([places, expected[:, 12:]], 1))
    assert float(smoother.log_evidence(scores)) == pytest.approx(total)
    torch.testing.assert_close((-smoother(scores)).exp(), places)


def test_the_path_is_the_best_of_all() -> None:
    scores = torch.rand(4, 3, generator=torch.Generator().manual_seed(3)).double()
    smoother = PlaceSmoother(separation=2.0, turn=0.05, jump=0.05, leave=0.1, enter=0.3)
    motion = smoother.motion(3, (0,), scores)
    matrix = torch.tensor(reference.transitions(motion.layout, motion.rates), dtype=torch.float64).log()
    log = smoother.wide(smoother.drive(scores).log_likelihood(torch.arange(4)), 0.0)
    first = motion.anywhere().log()

    def worth(path: tuple[int, ...]) -> float:
        steps = sum(float(matrix[i, j]) for i, j in itertools.pairwise(path))
        return float(first[path[0]]) + steps + sum(float(log[t, i]) for t, i in enumerate(path))

    best = max(itertools.product(range(7), repeat=4), key=worth)
    assert smoother.path(scores).tolist() == [-1 if i == 6 else i if i < 3 else 5 - i for i in best]
    assert smoother.path(scores[:0]).tolist() == []


def test_rates_have_gradients_and_tempering_none() -> None:
    scores = torch.rand(6, 5).double()
    smoother = PlaceSmoother(moves=(0.3, 0.5, 0.2), turn=0.1).double()
    names = ("move_logits", "rate_logits", "enter_logit")
    given = [getattr(smoother, name).detach().clone().requires_grad_() for name in names]

    def log(*values: Tensor) -> Tensor:
        called = torch.func.functional_call
        return called(
            _Log(smoother), dict(zip((f"of.{name}" for name in names), values, strict=True)), scores
        )

    assert torch.autograd.gradcheck(log, given)
    assert {name for name, _ in smoother.named_parameters()} == set(names)


class _Log(torch.nn.Module):
    def __init__(self, of: PlaceSmoother) -> None:
        super().__init__()
        self.of = of

    def forward(self, scores: Tensor) -> Tensor:
        return self.of.log_evidence(scores)


def test_expectation_maximisation_and_gradient_ascent_find_the_same_moves() -> None:
    scores = made(torch.arange(60) + 10, noise=0.8).double()
    smoother = PlaceSmoother().fit(scores).double()
    drive = smoother.drive(scores)
    like = smoother.wide(drive.log_likelihood(torch.arange(60)), 0.0).exp()
    layout, still = smoother.layout(90), torch.zeros(60, dtype=torch.bool)
    prior = torch.tensor(smoothing.MOVES, dtype=torch.float64) * smoothing.MOVE_SHARE * 60
    found = Rates(prior / prior.sum(), *(prior.new_tensor(rate) for rate in smoothing.RATES))

    def swept(given: Rates) -> tuple[Motion, Block]:
        motion = Motion(layout, given)
        (block,) = sweep(motion, lambda *_: like, 60, still, 60)
        return motion, block

    for _ in range(200):
        motion, block = swept(found)
        belief = smoothing.normalised(block.before * block.likelihood)
        counts = motion.counts(belief[:-1], (block.likelihood * block.after)[1:])
        found = smoothing.updated_rates(counts, prior)
    logits = [one.log().clone().requires_grad_() for one in (found.moves * 0 + 1 / 7,)]
    others = torch.tensor([math.log(0.998), math.log(1e-3), math.log(1e-3)], dtype=torch.float64)
    others = others.requires_grad_()
    enter = torch.tensor(math.log(0.01 / 0.99), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([*logits, others, enter], max_iter=200, line_search_fn="strong_wolfe")
    counted = smoothing.RATE_COUNTS, smoothing.ENTER_COUNTS

    def loss() -> Tensor:
        optimiser.zero_grad()
        moves, (stay, jump, leave) = logits[0].softmax(0), others.softmax(0)
        one = Rates(moves, jump, leave, enter.sigmoid())
        log = swept(one)[1].log.sum() + (prior * moves.log()).sum() + prior.sum() * stay.log()
        log = log + counted[0] * (0.001 * jump.log() + 0.001 * leave.log())
        log = log + (counted[0] * 0.998 - prior.sum()) * stay.log()
        log = log + counted[1] * (0.01 * one.enter.log() + 0.99 * (1 - one.enter).log())
        (-log).backward()
        return -log

    optimiser.step(loss)
    torch.testing.assert_close(logits[0].softmax(0).detach(), found.moves, rtol=0, atol=2e-3)


def test_queries_that_say_nothing_change_nothing() -> None:
    scores = made(torch.arange(40))
    smoother = PlaceSmoother().fit(scores)
    for silent in (1.0, math.nan, math.inf):
        odd = scores.clone()
        odd[20] = silent
        log = smoother.drive(odd).log_likelihood(torch.tensor([20]))
        assert log.unique().tolist() == [0.0]
        assert smoother.posterior(odd)[:, :-1].argmax(1)[[19, 21]].tolist() == [19, 21]
        best = smoother(odd)[20].isfinite().any()
        assert bool(best) == (silent == 1.0)
    odd = scores.clone()
    odd[:, 7] = math.inf
    assert smoother(odd)[:, 7].isinf().all()


DRIVES = {
    "forwards": torch.arange(80),
    "backwards": torch.arange(80).flip(0),
    "there and back": torch.cat([torch.arange(60), torch.arange(60).flip(0)]),
    "a third of the speed": torch.arange(5, 65).repeat_interleave(3),
    "three times the speed": torch.arange(0, 90, 3).repeat(2),
    "off the map in between": torch.cat([torch.arange(30), torch.full((40,), -1), torch.arange(40, 80)]),
    "a jump": torch.cat([torch.arange(30), torch.arange(60, 90)]),
}


@pytest.mark.parametrize("name", DRIVES)
def test_drives_of_every_kind_are_followed(name: str) -> None:
    truth = DRIVES[name]
    scores = made(truth, noise=1.0)
    smoother = PlaceSmoother(within=1)
    match = localize_drive(lambda numbers: scores[numbers], scores, smoother, radius=2)
    on, near = truth >= 0, (match.index[:, 0] - truth).abs() <= 1
    assert smoother.is_drive
    assert near[on].double().mean() >= (near & on).sum() / on.sum() > 0.93
    assert near[on].sum() > ((scores.argmin(1) - truth).abs() <= 1)[on].sum()
    assert match.probability is not None
    assert (match.probability[~on, 0] < 0.5).double().mean() > 0.8 or on.all()


def test_a_long_stop_counts_once_and_is_followed() -> None:
    truth = torch.cat([torch.arange(30), torch.full((150,), 30), torch.arange(31, 70)])
    scores = made(truth, noise=1.0)
    scores[30:180] = scores[30]
    spacing = spacing_of(scores)
    assert spacing.weight[100] == pytest.approx(1 / 150)
    assert spacing.still.nonzero()[:, 0].tolist() == [*range(31, 180)]
    found = PlaceSmoother(within=1).fit(scores)(scores).argmin(1)
    assert ((found - truth).abs() <= 1).double().mean() > 0.95
    assert set(PlaceSmoother().fit(scores).path(scores)[30:180].tolist()) == {30}


@pytest.mark.parametrize("seed", range(3))
def test_queries_of_another_route_are_no_drive_and_are_answered_one_by_one(seed: int) -> None:
    scores = made(torch.full((200,), -1), seed=seed)
    smoother = PlaceSmoother()
    match = localize_drive(lambda numbers: scores[numbers], scores, smoother)
    assert not smoother.is_drive
    assert match.index[:, 0].tolist() == scores.argmin(1).tolist()
    torch.testing.assert_close(match.score[:, 0], scores.amin(1))
    assert match.probability is not None
    assert float(match.probability.max()) < 0.5


def test_what_a_match_of_a_drive_says() -> None:
    scores = made(torch.arange(60), noise=1.0)
    smoother = PlaceSmoother(within=2)
    match = localize_drive(lambda numbers: scores[numbers], scores, smoother, k=3, radius=4)
    posterior, near = smoother.posterior(scores)[:, :-1], smoother(scores)
    assert match.probability is not None
    assert match.confidence is not None
    assert match.index[:, 0].tolist() == near.argmin(1).tolist()
    assert all((a - b).abs().min() > 4 for a, b in itertools.combinations(match.index.unbind(1), 2))
    for t in (0, 30, 59):
        at = int(match.index[t, 0])
        mass = posterior[t, max(0, at - 2) : at + 3].sum()
        assert float(match.probability[t, 0]) == pytest.approx(float(mass), abs=1e-5)
        elsewhere = near[t].clone()
        elsewhere[max(0, at - 4) : at + 5] = math.inf
        margin = float(elsewhere.min() - near[t, at])
        assert float(match.confidence[t, 0]) == pytest.approx(margin, rel=1e-4)
    assert match.probability[:, 1:].isnan().all()
    assert ((-match.score[:, 0]).exp() <= match.probability[:, 0] + 1e-6).all()
    own = scores.gather(1, match.index[:, :1])[:, 0]
    torch.testing.assert_close(match.score[:, 0], near.amin(1) + doubt(own), rtol=1e-4, atol=1e-5)


def test_doubt_is_a_tenth_of_the_deviations_by_which_an_own_score_is_worse() -> None:
    own = torch.tensor([1.0, 2, 3, 4, 5, 13, math.inf])
    median = 3.0
    spread = 1.4826 * float((own[:6] - median).abs().median())
    expected = [0.1 * max(0.0, float(one - median)) / spread for one in own[:6]]
    torch.testing.assert_close(doubt(own)[:6], torch.tensor(expected))
    assert doubt(own[:0]).tolist() == []


@pytest.mark.parametrize("shape", [(0, 5), (1, 5), (2, 1), (1, 1), (40, 1)])
def test_few_queries_and_a_map_of_one_place_are_answered_by_themselves(shape: tuple[int, int]) -> None:
    scores = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    smoother = PlaceSmoother()
    match = localize_drive(lambda numbers: scores[numbers], scores, smoother)
    assert not smoother.is_drive
    assert match.index[:, 0].tolist() == scores.argmin(1).tolist()


def test_leading_dimensions_and_other_types() -> None:
    scores = torch.stack([made(torch.arange(30), 40, seed=seed) for seed in range(2)])
    smoother = PlaceSmoother()
    each = torch.stack([smoother(one) for one in scores])
    torch.testing.assert_close(smoother(scores), each)
    assert smoother(scores.double()).dtype == torch.float64
    assert smoother(scores[:, :0]).shape == (2, 0, 40)


def test_the_rank_of_a_score_is_its_evidence() -> None:
    z = torch.randn(20_000, generator=torch.Generator().manual_seed(0))
    table = RankTable()
    table.add(z, torch.ones_like(z))
    at = torch.linspace(-2.5, 2.5, 11)
    exact = [-float(torch.special.ndtri((z >= one).double().mean())) for one in at]
    found = RankTable.look_up(table.values, at)
    torch.testing.assert_close(found, torch.tensor(exact).float(), rtol=0, atol=2 / PER_DEVIATION)
    assert (RankTable.look_up(table.values, torch.linspace(LOWEST, 60, 999)).diff() >= 0).all()
    given = torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda one: RankTable.look_up(table.values.double(), one), [given])


def test_a_constant_of_a_query_or_a_place_and_the_scale_say_nothing() -> None:
    scores = torch.rand(9, 7).double()
    weight = torch.ones(9)
    plain = standardised(scores, place_means(scores, weight)).z
    moved = 3 * (scores + torch.rand(9, 1) + torch.rand(1, 7))
    torch.testing.assert_close(standardised(moved, place_means(moved, weight)).z, plain)


def test_correlation_times() -> None:
    generator = torch.Generator().manual_seed(0)
    white = torch.randn(4000, 20, generator=generator)
    assert correlation_time(white) == pytest.approx(1.0, abs=0.02)
    rows = [white[0]]
    for row in white[1:]:
        rows.append(0.8 * rows[-1] + 0.6 * row)  # of lag l: .8^l
    assert correlation_time(torch.stack(rows)) == pytest.approx(1.8 / 0.2, rel=0.15)
    slow = torch.stack(rows) + 3 * torch.sin(torch.arange(4000) / 300)[:, None]
    spacing = spacing_of(slow)
    assert spacing.correlation > 2 * spacing.detrended


def test_queries_are_centred_with_a_prior() -> None:
    from dejavu_torch import SpectralMapper, TemplateMapper

    places = torch.nn.functional.normalize(torch.randn(60, 8, generator=torch.Generator().manual_seed(0)))
    learned = SpectralMapper()(places)
    queries = torch.nn.functional.normalize(places[:40] + 0.5)
    shift = (queries - learned.mean).sum(0) / (40 + PRIOR)
    expected = torch.nn.functional.normalize(queries - shift)
    torch.testing.assert_close(centred(learned, queries), expected)
    assert centred(TemplateMapper()(places), queries) is queries


def test_settings_and_scores_out_of_range_are_told() -> None:
    for settings, told in (
        ({"moves": (0.5, 0.4)}, "add up to 1"),
        ({"jump": 0.6, "leave": 0.6}, "at most 1"),
        ({"turn": 2.0}, "turn is 2.0; expected a probability"),
        ({"separation": 0.0}, "separation 0.0"),
        ({"tempering": 0.5}, "at least 1"),
        ({"within": -1}, "within is -1"),
        ({"threshold": math.nan}, "the threshold is NaN"),
    ):
        with refused(told):
            PlaceSmoother(**settings)  # type: ignore[arg-type]
    with refused("expected floats (Q,N)"):
        PlaceSmoother()(torch.ones(3, 4, dtype=torch.int64))
    with refused("the link (0, 9, 0.5) on 4 places", "expected two of these places"):
        PlaceSmoother(links=((0, 9, 0.5),))(torch.rand(3, 4))
    with refused("the whole drive"):
        PlaceSmoother().step(torch.rand(3, 4), torch.zeros(5))


def test_a_filter_moves_as_the_smoother_does() -> None:
    scores = torch.rand(5, 6)
    one, two = PlaceFilter(moves=(0.2, 0.8)).motion(scores), PlaceSmoother(moves=(0.2, 0.8), turn=0.0)
    belief = torch.rand(6)
    ways = torch.cat([belief, torch.zeros(6), torch.ones(1)])
    both = two.folded(two.motion(6, (0,), scores).moved(ways))
    torch.testing.assert_close(both, one.moved(torch.cat([belief, torch.ones(1)])))


def test_near_mass_is_the_plain_sum() -> None:
    mass = torch.rand(4, 9)
    expected = torch.stack([mass[:, max(0, i - 2) : i + 3].sum(1) for i in range(9)], 1).clamp(0, 1)
    torch.testing.assert_close(near_mass(mass, 2), expected)
