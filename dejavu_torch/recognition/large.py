"""The smoother on large maps, coarse to fine: single places only where a pass over groups leaves mass."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import Evidence, FittedPart, explained
from dejavu_torch.recognition.evidence import (
    MIN_SHARE,
    RankTable,
    Standardised,
    spacing_of,
)
from dejavu_torch.recognition.scorer import Scorer
from dejavu_torch.recognition.smoother import (
    PlaceSmoother,
)
from dejavu_torch.text import progress_of

LARGE, LARGE_MAP = 2**25, 2**13  # queries x places, and places, above which a drive is matched coarse to fine
GROUP = 16  # consecutive places that are one in the coarse pass; more if more than `HELD` scores were held
HELD = 2**27
LIKELY = 1e-4  # least coarse probability of a group whose places are looked at
LOOKED = 2**12  # places of a window that are looked at, at most, and those beside them
WINDOW, MARGIN = 400, 100  # queries that are smoothed at a time, and those on both sides that they depend on
MEANS = 256  # queries whose mean score of a place is taken
TILE = 2**22  # numbers at a time


def is_large(queries: int, places: int) -> bool:
    """Whether a drive goes coarse to fine."""
    return queries > chosen.FEWEST_FITTED and (places > LARGE_MAP or queries * places > LARGE)


class Window(NamedTuple):
    """Queries [first, last) beside others [start, stop), and z at the places (n,) that they may be at."""

    first: int
    last: int
    start: int
    stop: int
    places: Tensor
    z: Tensor  # (stop - start, n) float16, -inf where a place has no score


class LargeDrive:
    """A drive on a large map, whose scores are never held.

    First, a smoother of groups of places, each by its best score. Then, window by window, one of the places
    in groups with a mass above `LIKELY`, and in those beside them; all others are off the map.

    Args:
        scorer: of all queries. candidates, radius: as in `best_candidates`.
    """

    @torch.no_grad()
    def __init__(
        self,
        scorer: Scorer,
        smoother: PlaceSmoother,
        candidates: int = 2,
        radius: int = 5,
        progress: bool = False,
    ) -> None:
        self.scorer, self.smoother, self.progress = scorer, smoother, progress
        self.places, self.queries = scorer.layout.places, len(scorer)
        self.parts = torch.arange(self.queries).split(max(16, TILE // scorer.width))
        self.spacing = spacing_of(scorer.descriptors)
        self.group = GROUP
        while self.queries * self.places > self.group * HELD:
            self.group *= 2
        self.states = smoother.states(self.places, scorer.layout.starts)
        self.means = self._means()
        self.mean, self.spread, self.speaks, self.best = torch.zeros(4, self.queries)
        best = self._pooled()
        self.windows = self._windows(best, candidates * (1 + math.ceil(radius / self.group)))
        del best
        self.smoother = self._fitted_by(self._scored())  # to the drive

    def _means(self) -> Tensor:
        """The mean score of each place over some of the queries, (N,)."""
        numbers = torch.linspace(0, self.queries - 1, min(self.queries, MEANS)).round().long()
        total, share = torch.zeros(2, self.places)
        for part in numbers.split(len(self.parts[0])):
            weight = self.spacing.weight[part].float()
            for start, scores in self.scorer.blocks(part):
                some, scores = slice(start, start + scores.shape[1]), scores.cpu().float()
                valid = scores.isfinite()
                total[some] += weight @ scores.where(valid, 0)
                share[some] += weight @ valid.float()
        means: Tensor = self.smoother.removed * total / share.clamp(min=MIN_SHARE)
        return means.where(share > 0, math.inf)

    def _scores(self, verb: str) -> Iterator[tuple[Tensor, Iterator[tuple[int, Tensor]]]]:
        """Numbers of queries, and blocks of their scores."""
        with progress_of(verb, self.queries, self.progress, "query") as update:
            for part in self.parts:
                yield part, ((start, scores.cpu().float()) for start, scores in self.scorer.blocks(part))
                update(len(part))

    def _pooled(self) -> Tensor:
        """The best score of each group, without the means of the places, (Q,C) float16, in any unit; and mean
        and spread of all scores of each query."""
        size, unit = self.group, 0.0
        best = torch.full((self.queries, -(-self.places // size)), math.inf, dtype=torch.float16)
        for part, blocks in self._scores("scoring"):
            count, total, squares = torch.zeros(3, len(part), dtype=torch.float64)
            low, high = torch.full((len(part),), math.inf), torch.full((len(part),), -math.inf)
            for start, scores in blocks:
                stop = start + scores.shape[1]
                least, most = scores.aminmax(dim=1)
                means = self.means[start:stop]
                known = worse = scores - means.where(means.isfinite(), 0)
                count += scores.shape[1]
                if not bool((most - least).isfinite().all()):  # seldom, and slower
                    valid = scores.isfinite()
                    least = scores.where(valid, math.inf).amin(1)
                    most = scores.where(valid, -math.inf).amax(1)
                    most[scores.isnan().any(1)] = math.nan  # such a query says nothing
                    count -= (~valid).sum(1)
                    known, worse = worse.where(valid, 0), worse.where(valid, math.inf)
                low, high = torch.minimum(low, least), torch.maximum(high, most)
                total += known.sum(1)
                squares += torch.linalg.vector_norm(known, dim=1).double().square()
                unit = unit or float(known.std()) or 1.0
                ends = start % size, -stop % size
                worse = F.pad(worse, ends, value=math.inf) if any(ends) else worse
                groups = worse.unflatten(1, (-1, size)).amin(2).div_(unit).half()
                some = best[part[0] : part[-1] + 1, start // size : start // size + groups.shape[1]]
                torch.minimum(some, groups, out=some)  # a group may begin in the block before
            mean = total / count.clamp(min=1)
            spread = (squares / count.clamp(min=1) - mean.square()).clamp(min=0).sqrt()
            speaks = (high > low) & (spread > MIN_SHARE)
            self.mean[part], self.spread[part] = mean.float(), torch.where(speaks, spread, 1).float()
            self.speaks[part], self.best[part] = speaks.float(), low
            best[part[~speaks]] = 0
        return best

    def _windows(self, best: Tensor, candidates: int) -> list[Window]:
        """The windows of a drive, with the places that a smoother of groups leaves."""
        size, fine = self.group, self.smoother
        speed = sum(move * share for move, share in enumerate(fine.prior)) / size
        links = [(one // size, two // size, share / 2) for one, two, share in self.states.links]
        moves = [max(0.0, 1 - abs(speed - move)) for move in range(math.ceil(speed) + 2)]
        coarse = PlaceSmoother(moves, turn=fine.turn, links=links)
        starts = sorted({start // size for start in self.scorer.layout.starts})

        def rows(numbers: Tensor) -> Tensor:
            return best[numbers].float()

        coarse = coarse.fit(rows, self.scorer.descriptors, starts)
        count = max(1, round(self.queries / WINDOW))
        ends = torch.linspace(0, self.queries, count + 1).round().int().tolist()
        around = [(max(0, a - MARGIN), min(self.queries, b + MARGIN)) for a, b in pairwise(ends)]
        top = torch.zeros(count, best.shape[1])
        with progress_of("searching", self.queries, self.progress, "query") as update:
            for block in coarse.blocks(coarse.drive(rows, self.scorer.descriptors), starts):
                mass = block.motion.folded(block.posterior)[:, :-1]
                for looked, (start, stop) in zip(top, around, strict=True):
                    some = slice(max(0, start - block.first), max(0, stop - block.first))
                    if len(mass[some]):
                        torch.maximum(looked, mass[some].amax(0), out=looked)
                update(len(mass))
        reach, windows = 1 + fine.within // size, []
        for looked, first, last, (start, stop) in zip(top, ends, ends[1:], around, strict=False):
            most, groups = looked.topk(min(LOOKED // size, len(looked)))
            groups = groups[(most >= LIKELY) | (torch.arange(len(most)) < candidates)]
            chosen = torch.zeros(1, len(looked)).index_fill(1, groups, 1)
            near = F.max_pool1d(chosen, 2 * reach + 1, 1, reach)[0] > 0
            places = near.repeat_interleave(size)[: self.places].nonzero()[:, 0]
            z = torch.zeros(stop - start, len(places), dtype=torch.float16)
            windows.append(Window(first, last, start, stop, places, z))
        return windows

    def _scored(self) -> RankTable:
        """Fill the windows; the ranks of a sample of the scores at other places, where it is fitted."""
        ranks, fitted = RankTable(), self._fitted()
        for part, blocks in self._scores("scoring"):
            begin, end = int(part[0]), int(part[-1]) + 1
            for at, scores in blocks:
                ends = torch.tensor([at, at + scores.shape[1]])
                for i, window in enumerate(self.windows):
                    first, last = max(begin, window.start), min(end, window.stop)
                    if first >= last:
                        continue
                    some = slice(*torch.searchsorted(window.places, ends).tolist())
                    known = window.places[some]
                    found = self._z(scores, begin, at, slice(first, last), known)
                    window.z[first - window.start : last - window.start, some] = found
                    first, last = max(first, window.first), min(last, window.first + fitted.get(i, 0))
                    if first < last:
                        others = torch.arange(at, at + scores.shape[1], self.group)
                        others = others[~torch.isin(others, known)]
                        found = self._z(scores, begin, at, slice(first, last), others)
                        weight = self.group * (self.spacing.weight * self.speaks)[first:last, None]
                        ranks.add(found.where(found.isfinite(), 0), weight * found.isfinite())
        return ranks

    def _z(self, scores: Tensor, begin: int, at: int, some: slice, places: Tensor) -> Tensor:
        """z of some queries at some places; scores are those from query `begin` and place `at` on."""
        own = scores[some.start - begin : some.stop - begin, places - at]
        means = self.means[places]
        better = means.where(means.isfinite(), 0) - own + self.mean[some, None]
        z: Tensor = better / self.spread[some, None]
        return z

    def _fitted(self) -> dict[int, int]:
        """The windows that are fitted to, and how many of their queries."""
        length, windows = math.ceil(chosen.CORRELATED * self.spacing.correlation), self.windows
        count = max(1, min(chosen.STRETCHES, chosen.FITTED // max(chosen.STRETCH, length), len(windows)))
        some = torch.linspace(0, len(windows) - 1, count).round().int().tolist()
        share = chosen.SAMPLED // count
        most = [max(chosen.FEWEST_FITTED, share // max(1, len(windows[i].places))) for i in some]
        lengths = [min(chosen.FITTED // count, windows[i].last - windows[i].first) for i in some]
        return {i: min(pair) for i, *pair in zip(some, most, lengths, strict=True)}

    def _fitted_by(self, ranks: RankTable) -> PlaceSmoother:
        samples = []
        for i, length in self._fitted().items():
            window = self.windows[i]
            sample = self._sample(window, slice(window.first, window.first + length), self.smoother)
            std = sample.std
            ranks.add(std.z, std.only((sample.weight * std.speaks)[:, None].expand_as(std.z), 0))
            samples.append(sample)
        return self.smoother.taught(samples, ranks, self.spacing, self.means)

    def _sample(self, window: Window, some: slice, smoother: PlaceSmoother) -> FittedPart:
        z = window.z[some.start - window.start : some.stop - window.start].float()
        speaks, states = self.speaks[some] > 0, self.states.of(window.places)
        singly = smoother.singly
        absent = singly and singly.presence and singly.presence.absent(self.best[some])
        holes = self.means[window.places].isinf() & ~z.isfinite()
        valid = z.isfinite() | ~speaks[:, None]
        std = Standardised(z.nan_to_num(0, 0, 0), speaks, valid, absent, holes if holes.any() else None)
        over = partial(smoother.motion, states)
        return FittedPart(std, self.spacing.weight[some], self.spacing.stopped[some], over)

    @torch.no_grad()
    def masses(self, smoother: PlaceSmoother) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """The first query of each window, the last window first; mass and scores (B,n) of some places (n,).

        Args:
            smoother: that of the drive, which may know what single images say.
        """
        rates = smoother.rates(self.means)
        for window in self.windows[::-1]:
            sample = self._sample(window, slice(window.start, window.stop), smoother)
            evidence = Evidence(smoother.values, smoother.separation, smoother.tempering)
            motion = smoother.over_states(self.states.of(window.places), rates)
            mass = torch.cat([block.by_place for block in explained(sample, evidence, motion)][::-1])
            own = slice(window.first - window.start, window.last - window.start)
            z = window.z[own].float() * self.spread[window.first : window.last, None]
            scores = self.means[window.places] - z + self.mean[window.first : window.last, None]
            yield window.first, mass[own], scores, window.places
