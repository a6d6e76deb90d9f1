"""What a filter learns on the way of how near queries come to the map, by counts of one size."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import PlaceFilter
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.evidence import presence_of
from dejavu_torch.recognition.online import UNKNOWN, Nearness

NULL = Nearness(0.7, 0.05, chosen.BINS)


def drive(near=60, far=40, seed=0):
    """Scores (Q,N): near the map, then off it."""
    draw = torch.Generator().manual_seed(seed)
    best = torch.cat([0.3 + 0.05 * torch.randn(near, generator=draw), torch.full((far,), 0.68)])
    scores = 0.8 + 0.1 * torch.rand(len(best), 30, generator=draw)
    scores[torch.arange(len(best)), torch.arange(len(best)) % 30] = best
    return scores


def told(nearness, scores, size=1000):
    """Nats, batch by batch, and the counts at the end."""
    counts, nats = torch.zeros(nearness.bins), []
    for part in scores.split(size):
        some, counts = nearness.after(part, part.amax(1) > part.amin(1), counts)
        nats.append(some)
    return torch.cat(nats), counts


@given(st.integers(0, 99), st.sampled_from([1e-2, 1.0, 300.0]))
def test_it_is_presence_but_for_the_width_of_bins(seed, scale):
    """In any unit of scores."""
    scores = scale * drive(300, 100, seed)
    nats, _ = told(Nearness(scale * NULL.off, scale * NULL.spread, NULL.bins), scores)
    best = scores.amin(1)
    for t in range(200, len(best), 9):
        presence = presence_of(best[: t + 1], torch.full((2,), scale * NULL.off))
        assert presence is not None
        presence = presence._replace(spread=scale * NULL.spread)
        expected = float(presence.absent(best[t])) / chosen.FILTERED
        assert float(nats[t]) == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize("size", [1, 7, 100])
def test_batches_change_nothing(size):
    (whole, counts), (parts, after) = told(NULL, drive()), told(NULL, drive(), size)
    torch.testing.assert_close(parts, whole)
    assert torch.equal(after, counts)
    assert counts.sum() == 100
    nothing, same = NULL.after(drive()[:0], torch.zeros(0, dtype=torch.bool), counts)
    assert (len(nothing), same is counts) == (0, True)


def test_it_speaks_for_being_off_the_map_where_queries_come_no_nearer():
    nats, _ = told(NULL, drive())
    assert not nats[: chosen.KNOWN - 1].any()
    assert float(nats[chosen.KNOWN : 60].mean()) < -0.1
    assert float(nats[60:].min()) > 1


def test_it_says_nothing_where_the_map_is_not_told_from_other_ground():
    """Queries of the map come hardly nearer than those that show nothing of it."""
    for near, speaks in ((0.55, True), (0.7, False), (0.75, False)):
        assert bool(told(NULL, drive() + near - 0.3)[0].any()) is speaks


def test_queries_that_show_nothing_do_not_count():
    scores = drive()
    blank = torch.full((25, 30), 1.0)
    nats, counts = told(NULL, torch.cat([scores[:30], blank, scores[30:]]))
    alone, same = told(NULL, scores)
    assert torch.equal(counts, same)
    torch.testing.assert_close(torch.cat([nats[:30], nats[55:]]), alone)
    lost = torch.cat([scores[:30], torch.full((2, 30), math.nan), scores[30:]])
    nats, counts = told(NULL, lost)
    assert torch.equal(counts, same)
    assert nats.isfinite().all()


def test_a_filter_adds_what_it_says_and_counts_in_its_state():
    scores, plain = drive(), PlaceFilter()
    nats, counts = told(NULL, scores)
    expected, _ = plain.step(scores, plain.start(30), absent=nats)
    for lag in (0, 3):  # with a lag, queries that wait do not count again
        model = PlaceFilter(lag=lag).having(nearness=NULL)
        state, found = model.start(30), []
        for part in scores.split(9):
            some, state = model.step(part, state)
            found.append(some)
        assert torch.equal(state.counts, counts)
        if not lag:
            torch.testing.assert_close(torch.cat(found), expected)
            packed = model.packed(state)
            assert len(packed) == model.counted + len(state.belief)
            assert torch.equal(packed[-1], state.posterior[-1])
            assert all(map(torch.equal, model.unpacked(packed)[::7], state[::7]))
    silent = PlaceFilter(learns=True).having(nearness=NULL)
    assert silent.counted == 0 == plain.counted
    assert plain.nearness is UNKNOWN
    learns = PlaceFilter(learns=True)
    assert torch.equal(silent.step(scores, silent.start(30))[0], learns.step(scores, learns.start(30))[0])
