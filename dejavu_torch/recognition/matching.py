"""What is made of the scores of queries, which pass by once: their places, and those by other sequences."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dejavu_torch.recognition.calibration import TOLERANCE, Platt, Track, evidence, evidence_of
from dejavu_torch.recognition.candidates import Candidates, best_candidates
from dejavu_torch.recognition.search import LISTED, SCORES_AT_ONCE, Search, Searcher, enough
from dejavu_torch.recognition.select import Acceptance, best_match
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match, SequenceModel

EVERY = Acceptance()  # of finite scores
LENGTHS = (1, 5, 11, 21)  # queries of the sequences that a report sets side by side
AT_ONCE = 2**20  # scores summed at a time: they stay in the processor's cache


class Found(NamedTuple):
    """Places of queries.

    candidates: (Q,k), the best places of each. sequences: by T, (Q,) the best by a sequence of T queries.
    probability: (Q,) float64 of the first candidate being right, None where that is not known.
    """

    candidates: Candidates
    sequences: Mapping[int, Match] = MappingProxyType({})
    probability: Tensor | None = None

    def match(self, rule: Acceptance = EVERY) -> Match:
        """The first candidate of each query."""
        return self.first(1).ranked(rule)

    def ranked(self, rule: Acceptance = EVERY) -> Match:
        """Every candidate as a match of its own: (Q * k,), the k of a query together, best first.

        Convention: a probability is that of the first candidate; the others have NaN, and where it decides,
        none of these is accepted.
        """
        match = self.candidates.as_match(rule.threshold)
        if self.probability is None:
            return match
        others = self.candidates.index.shape[1] - 1
        probability = pad(self.probability[:, None], (0, others), value=math.nan).flatten()
        accepted = match.accepted if rule.precision is None else probability >= rule.precision
        return match._replace(accepted=accepted).with_probability(probability)

    def first(self, ranks: int) -> Found:
        """The same with at most so many candidates of each query."""
        return self._replace(candidates=Candidates(*(column[:, :ranks] for column in self.candidates)))

    def moved(self, place: Callable[[Tensor], Tensor]) -> Found:
        """The same with other numbers of the places; -1, where none is found, must stay."""
        return self._replace(
            candidates=self.candidates._replace(index=place(self.candidates.index)),
            sequences={
                length: match._replace(index=place(match.index)) for length, match in self.sequences.items()
            },
        )


class Matching(NamedTuple):
    """How queries are matched.

    sequence: scores consecutive queries together; None takes each by itself.
    lengths: each T that is matched beside that by a `SequenceMatcher`, at the speeds of `sequence` if that is
        one; only where there is a sequence.
    ranks: candidates of a query. apart: places, any two of them differ by more.
    platt: makes probabilities of how single queries stand out, or the track of a filter; None makes none.
    look: is given the scores (B,N) that places are found by, as for a picture.
    search: how the best places are searched for where single queries want no more than some of them; see
        `Searcher`.
    """

    sequence: SequenceModel | None = None
    lengths: tuple[int, ...] = ()
    ranks: int = 1
    apart: int = 0
    platt: Platt | None = None
    look: Callable[[Tensor], None] | None = None
    search: Search = "auto"

    @property
    def single(self) -> bool:
        """Whether each query is matched by itself."""
        return self.sequence is None or (
            isinstance(self.sequence, SequenceMatcher) and self.sequence.length == 1
        )

    @property
    def searches(self) -> bool:
        """Whether some of the best places of each query are all that is wanted."""
        return self.sequence is None and self.look is None

    @torch.no_grad()
    def search_for(self, queries: Tensor, searcher: Searcher) -> Found:
        """What is found of descriptors (B,K) by a search, on the CPU: what `found` finds of all scores."""
        route, wanted = searcher.route, [(self.ranks, self.apart)]
        if self.platt is not None:
            wanted.append((min(2, route.places), TOLERANCE))
        n = min(route.places, max(enough(*one) for one in wanted))
        if not searcher.pays(n):
            return self.found(map(route.scores, queries.split(max(1, SCORES_AT_ONCE // route.places))))
        parts = []
        for some in queries.split(max(1, SCORES_AT_ONCE // (LISTED * n))):
            best = searcher(some, n)
            candidates, *beside = (Candidates(*(c.cpu() for c in best.candidates(*one))) for one in wanted)
            probability = self.platt and self.platt.probability(evidence(*beside))
            parts.append(Found(candidates, probability=probability))
        return joined(parts)

    def found(self, batches: Iterable[Tensor]) -> Found:
        """What is found by scores (B,N) of single queries, batches one behind the other.

        Memory holds a batch of scores, whatever the number of queries.
        """
        return joined(self.stream(batches))

    @torch.no_grad()
    def stream(self, batches: Iterable[Tensor]) -> Iterator[Found]:
        """As `found`, a part of the queries at a time, on the CPU and without gradients."""
        for scores, sums, stood_out in self._parts(batches):
            if self.look is not None:
                self.look(scores)
            candidates = best_candidates(scores, self.ranks, self.apart)
            yield Found(
                Candidates(*(column.cpu() for column in candidates)),
                {length: best_match(part).map(Tensor.cpu) for length, part in sums.items()},
                None if self.platt is None or stood_out is None else self.platt.probability(stood_out),
            )

    def _parts(self, batches: Iterable[Tensor]) -> Iterator[tuple[Tensor, dict[int, Tensor], Tensor | None]]:
        """The scores to match by, those by other sequences, and how much each query stands out."""
        if self.sequence is None:
            for scores in batches:
                yield scores, {}, None if self.platt is None else evidence_of(scores)
            return
        small: Iterator[Tensor] = (
            part for scores in batches for part in scores.split(max(1, AT_ONCE // scores.shape[1]))
        )
        single: Iterator[Tensor | None] = itertools.repeat(None)
        if self.platt is not None:
            small, single = itertools.tee(small)  # in step: one batch is held
        track = Track()
        for (scores, sums), own in zip(
            _beside(self.sequence, small, sorted(self.lengths)), single, strict=False
        ):
            yield scores, sums, None if own is None else track(scores, own)


def joined(parts: Iterable[Found]) -> Found:
    """What was found of all queries, from what was found of some at a time."""
    candidates, sequences, probability = zip(*parts, strict=True)
    together = {length: Match.joined(part[length] for part in sequences) for length in sequences[0]}
    return Found(
        Candidates(*map(torch.cat, zip(*candidates, strict=True))),
        together,
        None if probability[0] is None else torch.cat(probability),
    )


def _beside(
    sequence: SequenceModel, batches: Iterable[Tensor], lengths: list[int]
) -> Iterator[tuple[Tensor, dict[int, Tensor]]]:
    """The scores that a sequence model makes of batches, and beside them for each T those of a sum."""
    own = sequence if isinstance(sequence, SequenceMatcher) else None
    if not lengths:
        yield from ((scores, {}) for scores in sequence.stream(batches))
    elif own is not None:  # all out of one pass
        every = sorted({own.length, *lengths})
        for sums in own.stream_sums(batches, every):
            found = dict(zip(every, sums, strict=True))
            yield found[own.length], {length: found[length] for length in lengths}
    else:
        single, again = itertools.tee(batches)  # in step: one batch is held
        beside = SequenceMatcher(lengths[-1]).stream_sums(again, lengths)
        for scores, sums in zip(sequence.stream(single), beside, strict=True):
            yield scores, dict(zip(lengths, sums, strict=True))


SINGLE = Matching()  # each query by itself


def lengths_beside(sequence: SequenceModel | None, queries: int, places: int) -> tuple[int, ...]:
    """The T to set beside a sequence, its own among them, that so many queries and places have room for.

    Example:
        >>> lengths_beside(SequenceMatcher(7), queries=100, places=12)
        (1, 5, 7, 11)
    """
    if sequence is None:
        return ()
    own = {sequence.length} if isinstance(sequence, SequenceMatcher) else set()
    return tuple(length for length in sorted({*LENGTHS, *own}) if length <= min(queries, places))
