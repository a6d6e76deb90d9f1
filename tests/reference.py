"""The paper's equations as slow literal loops: the oracle the package is held against.

Plain Python numbers throughout. Of the package only the data of `FrequencyLayer` is read, none of
its methods. Letters: i frame, k phase, j feature, H a query, mu a layer's templates as rows of phases.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise, product
from typing import NamedTuple

import torch
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.types import FrequencyLayer, Plan

Row = Sequence[float]
Table = Sequence[Row]


def phase(i, layer):
    """floor((i mod tau) * P / tau), exact, counted from absolute frame 0."""
    return math.floor(Fraction(i) % layer.period * layer.phases / layer.period)


def mask(i, k, layer):
    """M(i, tau, k), eq. 2: 1 where frame i of the layer's chunk has phase k."""
    return int(layer.start <= i < layer.stop and phase(i, layer) == k)


def template(values, j, k, layer):
    """mu(H, tau, k) of one feature, eq. 1; 0 for a phase that no frame of the chunk has."""
    total, count = 0.0, 0
    for i in range(len(values)):
        total += mask(i, k, layer) * values[i][j]
        count += mask(i, k, layer)
    return total / count if count else 0.0


def templates(values, layer):
    """All templates of a layer, P rows of F numbers."""
    return [[template(values, j, k, layer) for j in layer.features] for k in range(layer.phases)]


def phase_distance(query, mu, k, layer):
    """s(tau, k), eq. 3: the sum over the layer's features of |H - mu|."""
    return sum(abs(query[j] - mu[k][column]) for column, j in enumerate(layer.features))


def score(query, i, plan, mus, reduction="sum"):
    """S(i), eq. 4: over the layers that cover i; +inf where none does.

    "sum" is the letter, "mean" divides it by the number of features that were summed over.
    """
    total, summed = 0.0, 0
    for layer, mu in zip(plan, mus, strict=True):
        if layer.start <= i < layer.stop:
            total += sum(phase_distance(query, mu, k, layer) * mask(i, k, layer) for k in range(layer.phases))
            summed += len(layer.features)
    if summed == 0:
        return math.inf
    return total / summed if reduction == "mean" else total


def scores(query, places, plan, mus, reduction="sum"):
    """S(i) of all places."""
    return [score(query, i, plan, mus, reduction) for i in range(places)]


def best(row):
    """b = argmin S(i), eq. 5: of equal scores the lowest place; -1 where all are +inf."""
    found, least = -1, math.inf
    for i, value in enumerate(row):
        if value < least:
            found, least = i, value
    return found


def accepted(row, threshold):
    """Eq. 6 as the text of section III-C has it: accept when the best score is below the threshold."""
    return best(row) >= 0 and row[best(row)] < threshold


def candidates(row, k, apart):
    """The best place, then the best further than `apart` from all before; -1 where none is left."""
    found = []
    for _ in range(k):
        far = [
            value if all(abs(i - other) > apart for other in found if other >= 0) else math.inf
            for i, value in enumerate(row)
        ]
        found.append(best(far))
    return found


class Point(NamedTuple):
    """Precision and recall when every query with score <= threshold reports its place."""

    threshold: float
    precision: float
    recall: float


def precision_recall(score, right, answerable, recall="all"):
    """A point for every distinct finite score, by counting.

    recall: "all" is TP / all queries with a right answer; "reported" is TP / (TP + FN), where only a
    query that has a right answer and reports nothing is a false negative. 0 where it would be 0 / 0.
    """
    points = []
    for threshold in sorted({value for value in score if value < math.inf}):
        true_positives = false_positives = silent = 0
        for value, is_right, has_answer in zip(score, right, answerable, strict=True):
            if value <= threshold and is_right:
                true_positives += 1
            elif value <= threshold:
                false_positives += 1
            elif has_answer:
                silent += 1
        relevant = sum(answerable) if recall == "all" else true_positives + silent
        points.append(
            Point(
                threshold,
                true_positives / (true_positives + false_positives),
                true_positives / relevant if relevant else 0.0,
            )
        )
    return points


def trapezoid(points):
    """Area under precision over recall between the points themselves."""
    area = 0.0
    for a, b in pairwise(points):
        area += (b.recall - a.recall) * (a.precision + b.precision) / 2
    return area


class Route(NamedTuple):
    """A traverse of random features and a plan over it."""

    values: Tensor
    plan: Plan


@st.composite
def routes(draw, most_layers=4):
    """Small routes whose layers overlap, leave gaps, and have whole and rational periods.

    Feature values are multiples of 1/8: sums of them are exact.
    """
    frames = draw(st.integers(4, 24))
    dimension = draw(st.integers(1, 5))
    plan = []
    for _ in range(draw(st.integers(1, most_layers))):
        start = draw(st.integers(0, frames - 1))
        stop = draw(st.integers(start + 1, frames))
        period = Fraction(draw(st.integers(2, 20)), draw(st.integers(1, 3)))
        phases = draw(st.integers(1, 9)) if period.denominator > 1 or draw(st.booleans()) else int(period)
        features = draw(st.sets(st.integers(0, dimension - 1), min_size=1))
        plan.append(FrequencyLayer(period, phases, start, stop, tuple(sorted(features))))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**16)))
    values = torch.randint(-16, 17, (frames, dimension), generator=generator).double() / 8
    return Route(values, tuple(plan))


def joined_rows(places, queries, kept, level):
    """Cosines (Q,N) of queries and places from their whitened members: side by side, each of length 1, turned
    to the `kept` directions with the largest mean square over the places, and each number divided by that
    power of its root mean square."""

    def side_by_side(members):
        rows = []
        for parts in zip(*members, strict=True):
            row = []
            for part in parts:
                length = math.sqrt(sum(number**2 for number in part))
                row += [number / length for number in part]
            rows.append(row)
        return rows

    own, asked = (torch.tensor(side_by_side(one), dtype=torch.float64) for one in (places, queries))
    directions = torch.linalg.eigh(own.T @ own / len(own)).eigenvectors.flip(1)[:, :kept]
    sizes = (own @ directions).square().mean(0).sqrt() ** level
    ours, theirs = (rows @ directions / sizes for rows in (own, asked))
    lengths = theirs.norm(dim=1)[:, None] * ours.norm(dim=1)
    return (theirs @ ours.T / lengths).float()


def transitions(states, rates):
    """Probability of each step from one state to another, by walking; see `States`."""
    n, moves = states.places, rates.moves.tolist()
    jump, leave, enter = (float(rate) for rate in rates[1:])
    count = states.directions * n
    matrix = [[0.0] * (count + 1) for _ in range(count + 1)]

    def number(direction, place):
        return place if direction == 0 else 2 * n - 1 - place

    def walks(direction, place):
        """Where one step leads; what is missing leaves the route."""
        ways = [(a, b, s) if direction == 0 else (b, a, s) for a, b, s in states.links]
        linked = [(b, s) for a, b, s in ways if a == place]
        total = sum(s for _, s in linked)
        found = [(b, s / max(1.0, total)) for b, s in linked]
        following = place + 1 if direction == 0 else place - 1
        border = max(place, following)
        if 0 <= following < n and border not in states.route_starts[1:]:
            found.append((following, max(0.0, 1 - total)))
        return found

    for direction in range(states.directions):
        for place in range(n):
            row = matrix[number(direction, place)]
            turned = [(direction, 1 - states.turn), (1 - direction, states.turn)][: states.directions]
            turned = turned if states.directions == 2 else [(direction, 1.0)]
            for way, share in turned:
                mass = {place: share}
                for v, move in enumerate(moves):
                    if v:
                        after = {}
                        for at, amount in mass.items():
                            for to, part in walks(way, at):
                                after[to] = after.get(to, 0.0) + amount * part
                        mass = after
                    stay = (1 - jump - leave) * move
                    for at, amount in mass.items():
                        row[number(way, at)] += stay * amount
                    row[count] += stay * (share - sum(mass.values()))
            for j in range(count):
                row[j] += jump / count
            row[count] += leave
    for j in range(count):
        matrix[count][j] = enter / count
    matrix[count][count] = 1 - enter
    return matrix


def smoothed(matrix, first, likelihood):
    """Forward and backward (Rabiner, 1989): posteriors (Q,S) and the log likelihood, for S states."""
    forward, backward = [first * likelihood[0]], [torch.ones_like(first)]
    for row in likelihood[1:]:
        forward.append((forward[-1] @ matrix) * row)
    for row in likelihood.flip(0)[:-1]:
        backward.append(matrix @ (row * backward[-1]))
    joint = torch.stack(forward) * torch.stack(backward[::-1])
    return joint / joint.sum(1, keepdim=True), float(joint[0].sum().log())


class Steps(NamedTuple):
    """How a camera moves: see `PlaceSmoother`. Two directions; state i is place i on the way there, state
    2N - 1 - i on the way back, state 2N off the map. With one direction state N is off the map."""

    places: int
    moves: Row
    jump: float = 0.0
    leave: float = 0.0
    enter: float = 0.0
    turn: float = 0.0
    directions: int = 2
    starts: Sequence[int] = (0,)  # the first place of each route
    links: Sequence[tuple[int, int, float]] = ()
    back: float = 0.5  # share of what comes from elsewhere that travels in the second direction

    def elsewhere(self):
        """How much of what comes from elsewhere each state of a place gets."""
        ways = [1 - self.back, self.back] if self.directions == 2 else [1.0]
        return [way / self.places for way in ways for _ in range(self.places)]

    def onward(self, place, way):
        """Where a move by one place leads to, with probabilities; None is off the map."""
        pairs = [(a, b, share) if way == 0 else (b, a, share) for a, b, share in self.links]
        linked = [(to, share) for at, to, share in pairs if at == place]
        taken = sum(share for _, share in linked)
        following = place + 1 if way == 0 else place - 1
        route = sum(start <= place for start in self.starts)
        on_route = 0 <= following < self.places and sum(start <= following for start in self.starts) == route
        led = {following if on_route else None: max(0.0, 1 - taken)}
        for to, share in linked:
            led[to] = led.get(to, 0.0) + share / max(1.0, taken)
        return led

    def state(self, place, way):
        if place is None:
            return self.places * self.directions
        return place if way == 0 else 2 * self.places - 1 - place

    def transitions(self):
        """Probabilities of each state, row by row the one before it."""
        off = self.places * self.directions
        matrix = [[0.0] * (off + 1) for _ in range(off + 1)]
        stay = 1 - self.jump - self.leave
        for way in range(self.directions):
            for place in range(self.places):
                row = matrix[self.state(place, way)]
                for now in range(self.directions):
                    turned = self.turn if now != way else 1 - self.turn * (self.directions - 1)
                    at = {place: 1.0}
                    for move in self.moves:
                        for reached, share in at.items():
                            row[self.state(reached, now)] += stay * turned * move * share
                        moved = {}
                        for reached, share in at.items():
                            onward = {None: 1.0} if reached is None else self.onward(reached, now)
                            for to, part in onward.items():
                                moved[to] = moved.get(to, 0.0) + share * part
                        at = moved
                for state, each in enumerate(self.elsewhere()):
                    row[state] += self.jump * each
                row[off] += self.leave
        matrix[off] = [*(self.enter * each for each in self.elsewhere()), 1 - self.enter]
        return matrix

    def start(self):
        share = min(0.5, self.leave / (self.leave + self.enter))
        return [*((1 - share) * each for each in self.elsewhere()), share]


class Chained(NamedTuple):
    """`Steps`, beside which a camera keeps one of some speeds p / q places a query: a cycle of q chains, each
    with all states but that off the map. The free motion is the last chain.

    shares: of each speed, and of the free motion, that go on as each. slip: of the moves off by a place.
    """

    steps: Steps
    speeds: Sequence[tuple[int, int]]
    shares: Sequence[Row]
    slip: float
    first: Row  # shares of what comes from elsewhere

    @property
    def places(self):
        return self.steps.places

    @property
    def directions(self):
        return self.steps.directions

    def chains(self):
        """Speed, phase, and moves of each chain, and how many its speed has."""
        found = []
        for i, (p, q) in enumerate(self.speeds):
            for phase in range(q):
                move = (phase + 1) * p // q - phase * p // q
                moves = [0.0] * (move + 2)
                moves[move + 1] += self.slip / 2
                moves[move] += 1 - self.slip
                moves[max(0, move - 1)] += self.slip / 2
                found.append((i, phase, moves, q))
        return [*found, (len(self.speeds), 0, self.steps.moves, 1)]

    def enters(self):
        """How much of what comes from elsewhere each chain gets."""
        return [self.first[i] / q for i, _, _, q in self.chains()]

    def transitions(self):
        chains, size = self.chains(), self.places * self.directions
        off = len(chains) * size
        matrix = [[0.0] * (off + 1) for _ in range(off + 1)]
        for c, (i, phase, _, q) in enumerate(chains):
            for d, (j, later, moves, r) in enumerate(chains):
                share = self.shares[i][j] / r
                if i == j:
                    share = self.shares[i][i] if later == (phase + 1) % q else 0.0
                alone = self.steps._replace(moves=moves)
                alone = alone._replace(jump=0.0, leave=0.0).transitions()
                stay = share * (1 - self.steps.jump - self.steps.leave)
                for a in range(size):
                    for b in range(size):
                        matrix[c * size + a][d * size + b] += stay * alone[a][b]
                    matrix[c * size + a][off] += stay * alone[a][size]
        for c in range(off + 1):
            rate = self.steps.enter if c == off else self.steps.jump
            for d, enters in enumerate(self.enters()):
                for b, each in enumerate(self.steps.elsewhere()):
                    matrix[c][d * size + b] += rate * enters * each
            matrix[c][off] += 1 - self.steps.enter if c == off else self.steps.leave
        return matrix

    def start(self):
        *on, off = self.steps.start()
        return [*(enters * one for enters in self.enters() for one in on), off]


def forward_backward(steps, evidence, still):
    """Probability of each state for each query, and the log likelihood of all queries, from the log evidence
    of each place, (Q,N), relative to being off the map; a query that stands still has the state before it."""
    matrix = steps.transitions()
    states, likelihood = range(len(matrix)), []
    for row in evidence:
        ways = [*row, *reversed(row)] if steps.directions == 2 else [*row]
        ways = ways * ((len(matrix) - 1) // len(ways))
        likelihood.append([*(math.exp(one) for one in ways), 1.0])
    before = [steps.start()]
    for t in range(1, len(evidence)):
        at = [before[-1][i] * likelihood[t - 1][i] for i in states]
        moved = [sum(at[i] * matrix[i][j] for i in states) for j in states]
        before.append(at if still[t] else moved)
    after = [[1.0 for _ in states]]
    for t in range(len(evidence) - 1, 0, -1):
        seen = [after[0][j] * likelihood[t][j] for j in states]
        before_it = [sum(matrix[i][j] * seen[j] for j in states) for i in states]
        after.insert(0, seen if still[t] else before_it)
    found, total = [], 1.0
    for t in range(len(evidence)):
        joint = [before[t][i] * likelihood[t][i] * after[t][i] for i in states]
        total = sum(joint)
        found.append([one / total for one in joint])
    return found, math.log(total)


def all_paths(steps, evidence, still):
    """Every sequence of states with its probability times likelihood, as in `forward_backward`."""
    matrix, found = steps.transitions(), {}
    states = range(len(matrix))
    for path in product(states, repeat=len(evidence)):
        value = steps.start()[path[0]]
        for t, state in enumerate(path):
            ways = [*evidence[t], *reversed(evidence[t])]
            ways = [*ways * ((len(matrix) - 1) // len(ways)), 0.0]
            if t and not still[t]:
                value *= matrix[path[t - 1]][state]
            elif t:
                value *= path[t - 1] == state
            value *= math.exp(ways[state])
        found[path] = value
    return found
