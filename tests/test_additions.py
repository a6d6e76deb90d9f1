"""What can be added from outside, each in at most 25 lines: a map (test_seam.py), a way, a layout, a baseline
a wrapper of scores and a motion."""

from __future__ import annotations

import inspect

import pytest
import torch

from dejavu_torch import DejaVu, Layout, PlaceFilter, PlaceSmoother, SpectralMapper, compare
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.matches import read_matches, write_matches
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.places.layout import KINDS
from dejavu_torch.recognition.engine import Motion
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.scorer import Earlier, OfMap, Reordered, Scorer, Wrapped
from dejavu_torch.types import InputError, SequenceModel

LINES = 25


def waves(visit, places=120):
    """Descriptors of a route, seen once more at each visit."""
    route = torch.randn(places + 3, 16, generator=torch.Generator().manual_seed(0))
    route = torch.nn.functional.avg_pool1d(route.T[None], 4, 1)[0].T
    noise = torch.randn(places, 16, generator=torch.Generator().manual_seed(1 + visit))
    return ArrayTraverse(route + 0.1 * noise, f"visit {visit}")


def model():
    return DejaVu(None, "none", mapper=SpectralMapper(24.0))


class Doubled(SequenceModel):
    """A way: the mean of the scores of this query and the one before, a place earlier."""

    def start(self, places, fixed=False):
        return torch.full((int(fixed), places), torch.nan)

    def step(self, scores, state, route_starts=(0,)):
        before = torch.cat([state, scores])[-len(scores) - 1 : -1]
        before = torch.cat([scores.new_full((len(scores) - len(before), scores.shape[1]), torch.nan), before])
        before = before.roll(1, 1).index_fill(1, torch.tensor(route_starts), torch.nan)
        return torch.where(before.isfinite(), (scores + before) / 2, scores), scores[-1:]

    def check(self, queries, places):
        pass


def test_a_way(tmp_path):
    found = compare(waves(0), waves(1), "0", model(), querying=Querying(match=Doubled()))
    report = found.report.as_json()
    assert report["recall_at_1"] > 0.95
    assert report["answers"] == "sequence"
    single = compare(waves(0), waves(1), "0", model(), querying=Querying(match="single")).report
    assert report["recall_at_1"] >= single.as_json()["recall_at_1"]
    one_by_one = model().learn(waves(0)).localize(waves(1), sequence=Doubled())
    assert torch.equal(one_by_one.index, found.run.match.index)


class Ring(Layout):
    """Places around a square, whose last is beside the first."""

    def distance(self, one, other):
        far = (one - other).abs()
        return torch.minimum(far, self.places - far)

    def neighbours(self, places, radius):
        return (places[:, None] + torch.arange(-radius, radius + 1)) % self.places

    @property
    def joins(self):
        return ((self.places - 1, 0, 1.0),)


def test_a_layout(tmp_path, monkeypatch):
    monkeypatch.setitem(KINDS, "Ring", Ring)  # that files may name
    square, seen = waves(0), waves(1)
    square.layout = Ring(120)
    found = compare(square, seen, "0", model(), tolerance=5, querying=Querying(top=3, match="single"))
    assert found.report.as_json()["recall_at_1"] > 0.95
    model().learn(square).save(tmp_path / "map.safetensors")
    loaded = DejaVu.load(tmp_path / "map.safetensors")
    assert loaded.map.layout == Ring(120)
    matches = loaded.candidates(seen, 3, sequence=None)
    assert torch.equal(matches.index, found.candidates.index[:, :3])
    apart = loaded.map.layout.distance(matches.index[:, :, None], matches.index[:, None])
    assert int(apart[:, ~torch.eye(3, dtype=torch.bool)].min()) > 5
    write_matches(tmp_path / "matches.csv", [matches.map(torch.flatten)], None, loaded.map.table, ranks=3)
    assert torch.equal(read_matches(tmp_path / "matches.csv").candidates, matches.index)
    rounds = torch.cat([seen[90:], seen[:30]])  # a drive through the seam
    assert loaded.localize(rounds, sequence=PlaceSmoother()).index.tolist() == [*range(90, 120), *range(30)]


class Signs(Scorer):
    """The signs of all descriptors: a bit for each number."""

    def __init__(self, frames, queries):
        self.layout, self.descriptors = frames.layout, queries[:]
        self.kept, self.asked = frames[:].sign(), queries[:].sign()

    def rows(self, queries):
        return (self.asked[queries][:, None] - self.kept).abs().sum(2)


def test_a_baseline():
    reference, query = waves(0), waves(1)
    bits = Signs(reference, query)
    contenders = {"signs": ("signs", 120 * 2, bits)}
    found = compare(
        reference,
        query,
        "0",
        model(),
        querying=Querying(ordered=True),
        reporting=Reporting(contenders=contenders, drives="all"),
    )
    report = found.report.as_json()["signs"]
    assert report["recall_at_1"] > 0.8
    assert report["bytes"] == 240
    assert report["sequences"]["smoother"]["recall_at_1"] >= report["recall_at_1"]
    assert "signs" in str(found.report)


@pytest.mark.parametrize(
    ("key", "queries", "truth", "line"),
    [
        ("null", 120, "0", "the contender 'null'; expected a key that is not taken"),
        (
            "signs",
            60,
            "0",
            "the contender 'signs' scores 60 queries at 120 places; expected 120 queries",
        ),
        ("signs", 120, None, "there is none to judge contenders by; expected a truth"),
    ],
)
def test_a_baseline_of_other_queries_is_refused_before_anything_is_learned(key, queries, truth, line):
    reference, query, learned = waves(0), waves(1), model()
    scorer = Signs(reference, ArrayTraverse(query[:queries]))
    with pytest.raises(InputError, match=line):
        compare(
            reference,
            query,
            truth,
            learned,
            querying=Querying(ordered=True),
            reporting=Reporting(contenders={key: ("signs", 240, scorer)}),
        )
    assert learned.map.places == 0


class Without(Wrapped):
    """Scores without some of the places."""

    def __init__(self, scorer, closed):
        super().__init__(scorer)
        self.closed = closed

    def changed(self, scores, queries):
        return scores.index_fill(1, self.closed, torch.inf)


def test_a_wrapper():
    learned, closed, seen = model().learn(waves(0)), torch.arange(20, 40), waves(1)[:]
    for sequence in (None, PlaceFilter(), PlaceSmoother()):
        match = learned.localize_descriptors(seen, sequence, lambda scorer: Without(scorer, closed))
        assert not torch.isin(match.index, closed).any()
        open_ones = ~torch.isin(torch.arange(120), closed)
        assert float((match.index == torch.arange(120))[open_ones].double().mean()) > 0.8
    # as of the rows of a shuffled route, asked for loops: wrappers of wrappers
    order = torch.randperm(120, generator=torch.Generator().manual_seed(0))
    scorer = Earlier(Reordered(OfMap(learned.map, seen), order), 30)
    places = scorer.rows(torch.tensor([50, 100])).isfinite().sum(1)
    assert places.tolist() == [20, 70]


class Forwards(Motion):
    """A camera on a ring that only goes forwards, a place or two, and now and then is lost or found."""

    lost = 0.01

    def moved(self, belief):
        on, off = belief[..., :-1], belief[..., -1:]
        ahead = (1 - self.lost) * (on.roll(1, -1) + on.roll(2, -1)) / 2
        off, gone = (1 - self.lost) * off, self.lost * off
        return torch.cat([ahead + gone * self.each, off + self.lost * on.sum(-1, keepdim=True)], -1)

    def expected(self, message):
        on, off = message[..., :-1], message[..., -1:]
        back = (1 - self.lost) * (on.roll(-1, -1) + on.roll(-2, -1)) / 2 + self.lost * off
        found = self.lost * self.each * on.sum(-1, keepdim=True)
        return torch.cat([back, (1 - self.lost) * off + found], -1)


def test_a_motion():
    round_it = [*range(60, 120), *range(60)]  # through the seam
    learned, rounds = model().learn(waves(0)), ArrayTraverse(waves(1)[:][round_it], "round")
    way = PlaceSmoother(motion=Forwards)
    match = learned.localize(rounds, sequence=way)
    assert match.is_drive
    assert float((match.index == torch.tensor(round_it)).double().mean()) > 0.98
    assert not learned.localize(ArrayTraverse(rounds[:].flip(0), "backwards"), sequence=way).is_drive
    found = compare(waves(0), rounds, [[place] for place in round_it], model(), querying=Querying(match=way))
    assert found.report.as_json()["auc"] > 0.98
    several = learned.localize_descriptors(rounds[:], learned.matching(way))
    assert torch.equal(several.index, match.index)


@pytest.mark.parametrize(
    "added", [Doubled, Ring, test_a_layout, test_a_baseline, test_a_wrapper, Forwards, test_a_motion]
)
def test_an_addition_is_short(added):
    lines = [line for line in inspect.getsource(added).splitlines() if line.strip()]
    assert len(lines) <= LINES
