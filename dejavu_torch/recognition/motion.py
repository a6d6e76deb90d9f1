"""How a camera moves from one query to the next: the transitions of the filter and of the smoother."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.compiling import Floats, Kernel, floats_of
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen, loops
from dejavu_torch.recognition.engine import MIN_PROBABILITY, Block, Counts, Motion, Rates
from dejavu_torch.recognition.evidence import LOWEST, PER_DEVIATION, RankTable, Standardised
from dejavu_torch.recognition.loops import Route
from dejavu_torch.recognition.speeds import FREE, Speeds
from dejavu_torch.types import InputError


class AlongRoute(Motion):
    """A step along routes, in one or two directions of travel.

    A camera at a place moves on by 0 to V places, with turning round before, jumps to any place, or leaves
    the map; moving past the end of a route leaves it too. Off the map, it enters at any place.

    Beside this free motion there may be steady `Speeds`, whose chains have states of their own: (M,D,N), the
    free ones last, then being off the map.

    Rates of several drives (C,) go with beliefs (C,S); `best_moved` and `counts` take those of one, and
    `counts` those without speeds.
    """

    directions = 2

    def __init__(self, states: States, rates: Rates, speeds: Speeds = FREE) -> None:
        super().__init__(states, rates)
        _, jump, leave, enter = rates
        self.speeds = speeds
        self.change, self.chains = speeds.change.to(rates.moves), len(speeds.change)
        if self.chains > 1 or self._prefers:
            back = torch.tensor([1 - states.back, states.back] if states.directions == 2 else [1.0]).double()
            shares = speeds.enter[:, None] * (states.share / max(1, states.places) * back)
            self.each = shares.flatten().repeat_interleave(states.places).to(rates.moves)
        moves = speeds.beside(rates.moves) * (1 - jump - leave)[..., None, None]
        self.moves = moves[..., None, None].unbind(-3)
        last, taken = states.places - 1, rates.moves.new_zeros(states.directions, states.places)
        ways: list[tuple[int, int, int, float]] = []
        for first, second, share in states.links:
            both = [(first, second), (last - second, last - first)][: states.directions]
            ways += [(row, at, to, share) for row, (at, to) in enumerate(both)]
        for row, at, _, share in ways:
            taken[row, at] += share
        self.linked = [(row, at, to, share / max(1.0, float(taken[row, at]))) for row, at, to, share in ways]
        keep = 1 - F.pad(taken[:, :-1].clamp(max=1), (1, 0))
        for start in states.route_starts[1:]:
            keep[0, start] = 0
            keep[1:, last + 1 - start] = 0
        plain = len(states.route_starts) == 1 and not states.links
        self.keep = None if plain else keep  # the share of a place's mass that moves on to the next one
        # the share of a move by 0, 1, .. V places that stays on the route
        self.reach = [*self._shifts(torch.ones_like(keep), back=True)]
        self.lost = (torch.stack(self.moves, -3) * (1 - torch.stack(self.reach))).sum(-3)
        # the shares of a state's mass (S,) that go anywhere, and off the map
        jump, leave, enter = (rate[..., None] for rate in (jump, leave, enter))
        self.free = torch.cat([jump.expand(*jump.shape[:-1], self.chains * keep.numel()), enter], -1)
        left = torch.cat([self._began(self.lost).flatten(-3) + leave, 1 - enter], -1)
        self.gone = left + (1 - states.share) * self.free

    def _shifted(self, on: Tensor) -> Tensor:
        """Mass (..., D, N) one place further."""
        moved = F.pad(on[..., :-1], (1, 0))
        if self.keep is None:
            return moved
        moved = moved * self.keep
        for row, at, to, share in self.linked:
            moved[..., row, to] += share * on[..., row, at]
        return moved

    def _shifted_back(self, message: Tensor) -> Tensor:
        """The transpose of `_shifted`."""
        if self.keep is None:
            return F.pad(message[..., 1:], (0, 1))
        moved = F.pad((message * self.keep)[..., 1:], (0, 1))
        for row, at, to, share in self.linked:
            moved[..., row, at] += share * message[..., row, to]
        return moved

    def _shifts(self, on: Tensor, back: bool) -> Iterator[Tensor]:
        """Mass (..., D, N) moved by 0, 1, .. V places."""
        last, n = len(self.moves) - 1, on.shape[-1]
        if self.keep is not None:
            shifted = self._shifted_back if back else self._shifted
            yield on
            for _ in range(last):
                yield (on := shifted(on))
            return
        beyond = on.new_zeros(*on.shape[:-1], last)
        shifts = torch.cat([on, beyond] if back else [beyond, on], -1).unfold(-1, n, 1).unbind(-2)
        yield from shifts if back else shifts[::-1]

    def _by_all_moves(self, on: Tensor, back: bool) -> Tensor:
        """The sum of mass (..., D, N) moved by 0 to V places, each times its probability."""
        first, *others = self.moves
        shifts = self._shifts(on, back)
        moved = first * next(shifts)
        for move, shifted in zip(others, shifts, strict=True):
            moved.addcmul_(move, shifted)
        return moved

    def _turned(self, on: Tensor) -> Tensor:
        """Mass (..., D, N), some of it in the other direction; its own transpose."""
        if self.states.directions == 1:
            return on
        return torch.lerp(on, on.flip(-1, -2), self.states.turn)

    def _changed(self, on: Tensor, change: Tensor) -> Tensor:
        """Mass (..., M, D, N), of which shares go on as other chains."""
        return on if self.chains == 1 else (change @ on.flatten(-2)).view(on.shape)

    def _began(self, message: Tensor) -> Tensor:
        """What a message after turning, and changing the chain, says of before."""
        return self._turned(self._changed(message, self.change))

    def _split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """The places (..., M, D, N), and being off the map (..., 1)."""
        return state[..., :-1].unflatten(-1, (self.chains, self.states.directions, -1)), state[..., -1:]

    def wide(self, places: Tensor, off: float | Tensor) -> Tensor:
        wide = super().wide(places, off)
        return wide if self.chains == 1 else torch.cat([*[wide[..., :-1]] * self.chains, wide[..., -1:]], -1)

    def unfolded(self, posterior: Tensor) -> Tensor:
        """A belief in all states by one in the places and in being off the map, (N+1,) -> (S,)."""
        shares = torch.as_tensor(self.each, dtype=posterior.dtype, device=posterior.device)
        wide = self.wide(posterior[:-1], posterior[-1:])
        shares = shares.expand(len(wide) - 1) * (self.states.places / self.states.share)
        return torch.cat([wide[:-1] * shares, wide[-1:]])

    def folded(self, mass: Tensor) -> Tensor:
        if self.chains > 1:
            on, off = self._split(mass)
            mass = torch.cat([on.sum(-3).flatten(-2), off], -1)
        return super().folded(mass)

    @staticmethod
    def _share(belief: Tensor, goes: Tensor) -> Tensor:
        """The mass (...) of a belief (..., S) of which shares (S,), or (..., S), go."""
        return belief @ goes if goes.ndim == 1 else torch.linalg.vecdot(belief, goes)

    def moved(self, belief: Tensor) -> Tensor:
        on, _ = self._split(belief)
        on = self._changed(self._turned(on), self.change.mT)
        moved = self._by_all_moves(on, back=False).flatten(-3)
        anywhere, off = (self._share(belief, goes)[..., None] for goes in (self.free, self.gone))
        return torch.cat([moved + anywhere * self.each, off], -1)

    def expected(self, message: Tensor) -> Tensor:
        on, off = self._split(message)
        moved = self._began(self._by_all_moves(on, back=True)).flatten(-3)
        anywhere = (self.each * message[..., :-1]).sum(-1, keepdim=True)
        return F.pad(moved, (0, 1)) + (anywhere * self.free + off * self.gone)

    def ahead(self, belief: Tensor, likelihood: Tensor, still: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = self._run(loops.ahead, belief, likelihood, still)
        if found is None:
            return super().ahead(belief, likelihood, still)
        before, totals, belief = found
        return before, totals.log(), belief

    def behind(self, message: Tensor, likelihood: Tensor, still: Tensor) -> tuple[Tensor, Tensor]:
        found = self._run(loops.behind, message, likelihood, still)
        return super().behind(message, likelihood, still) if found is None else (found[0], found[2])

    def told(
        self, block: Block, std: Standardised, normal: Tensor, shares: Tensor, table: RankTable
    ) -> Tensor:
        if block.before.numel() >= loops.WORTH_COMPILING and std.valid is None and not self._differs:
            given = block.before, block.likelihood, block.after, std.z, normal
            found = [floats_of(one.reshape(-1, one.shape[-1])) for one in given]
            found.append(floats_of(shares.flatten()))
            if all(one is not None for one in found) and (kernel := loops.told()) is not None:
                sums = torch.zeros(2, dtype=torch.float64)
                binned = LOWEST, PER_DEVIATION, chosen.RADIUS
                kernel((*found[:3],), (*found[3:],), binned, table.counts.numpy(), sums.numpy())
                return sums.to(normal)
        return super().told(block, std, normal, shares, table)

    def _run(
        self, loop: Callable[[], Kernel | None], start: Tensor, likelihood: Tensor, still: Tensor
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """What a loop finds, (..., B, S), (..., B) and (..., S); None if torch has to compute it."""
        *drives, queries, states = likelihood.shape
        if likelihood.numel() < loops.WORTH_COMPILING or self._differs:
            return None
        count = math.prod(drives)
        moves = torch.stack(self.moves, -3)[..., 0, 0]
        goes = (one.reshape(-1, one.shape[-1]) for one in (self.free, self.gone))
        moves = moves.reshape(-1, *moves.shape[-2:])
        rates = (one.expand(count, *one.shape[1:]) for one in (moves, *goes))
        places = self.states.directions * self.states.places
        each = torch.as_tensor(self.each, dtype=start.dtype).expand(self.chains * places)[::places]
        start = start.expand(*drives, states).reshape(count, states).clone()
        seen = likelihood.reshape(count, queries, states)
        arrays = self._readable(start, seen, *rates, each.contiguous(), self.change)
        if arrays is None or (kernel := loop()) is None:
            return None
        (own, like, *motion), route = arrays
        out, totals = np.empty_like(like), np.empty(like.shape[:2], np.float32)
        rests = still.reshape(count, queries).contiguous().numpy()
        kernel(own, like, rests, (*motion,), route, out, totals)
        shapes = ((out, likelihood.shape), (totals, still.shape), (own, (*drives, states)))
        before, log, last = (torch.from_numpy(one).view(shape) for one, shape in shapes)
        return before, log, last

    @property
    def _differs(self) -> bool:
        """Whether it is of a kind of motion that changes what the loops compute."""
        steps = "moved", "expected", "near", "wide", "folded"
        own = any(getattr(type(self), one) is not getattr(AlongRoute, one) for one in steps)
        return own or self._prefers

    @property
    def _prefers(self) -> bool:
        """Whether one direction of travel is likelier than the other."""
        return self.states.directions == 2 and self.states.back != 0.5

    def _readable(self, *tensors: Tensor) -> tuple[list[Floats], Route] | None:
        """The data of tensors, and what the loops read of the route; None if torch has to compute."""
        keep = tensors[0].new_ones(self.lost.shape[-2:]) if self.keep is None else self.keep
        links = [link[:3] for link in self.linked]
        shares = keep.new_tensor([link[3] for link in self.linked])
        found = [floats_of(one) for one in (*tensors, keep, shares)]
        known = [one for one in found if one is not None]
        if len(known) < len(found):
            return None
        linked = np.array(links, np.int64).reshape(-1, 3)
        return known[:-2], (known[-2], linked, known[-1], self.states.turn, self.keep is None)

    def best_moved(self, log: Tensor) -> Tensor:
        """Log probabilities of the best way to each state in a step, from those before it (Viterbi)."""
        on, off = self._split(log)
        _, jump, _, enter = self.rates
        each = torch.as_tensor(self.each, dtype=log.dtype, device=log.device).expand(on.numel()).view_as(on)
        anywhere, highest = jump * each, on.amax()
        if self.chains > 1:
            on = (on[:, None] + self.change.log()[..., None, None]).amax(0)
        turn = self.states.turn if self.states.directions == 2 else 0.0
        best = torch.full_like(on, -math.inf)
        for move in self.moves[::-1]:
            best = self._best_shifted(best)
            best = torch.maximum(best, on + (move * (1 - turn) + anywhere).log())
            if turn:
                turned = on.flip(-1, -2) + (move * turn + anywhere).log()
                best = torch.maximum(best, turned)
        jumped = torch.maximum(highest + anywhere.log(), off + (enter * each).log())
        left = log + self.gone.log()
        return torch.cat([best.maximum(jumped).flatten(), left.amax()[None]])

    def _best_shifted(self, on: Tensor) -> Tensor:
        moved = F.pad(on[..., :-1], (1, 0), value=-math.inf)
        if self.keep is None:
            return moved
        moved = moved + self.keep.log()
        for row, at, to, share in self.linked:
            linked = on[..., row, at] + math.log(max(share, MIN_PROBABILITY))
            moved[..., row, to] = torch.maximum(moved[..., row, to], linked)
        return moved

    def counts(self, before: Tensor, after: Tensor) -> Counts:
        (on, off), (on_after, off_after) = self._split(before), self._split(after)
        start, off, off_after = self._turned(on)[..., 0, :, :], off[..., 0], off_after[..., 0]
        total = before[..., :-1].sum(-1)
        mean = (self.each * after[..., :-1]).sum(-1) + (1 - self.states.share) * off_after
        _, jump, leave, enter = self.rates
        lost, kinds = torch.stack([(1 - reach).flatten() for reach in self.reach]), []
        if (found := self._counted(before, after, lost)) is not None:
            kinds = [move[0, 0, 0] * one for move, one in zip(self.moves, found.unbind(-1), strict=True)]
        else:
            shifts = self._shifts(on_after[..., 0, :, :], back=True)
            for move, gone, shifted in zip(self.moves, lost, shifts, strict=True):
                gone = off_after * (start.flatten(-2) @ gone)
                kinds.append(move[0, 0, 0] * ((start * shifted).sum((-1, -2)) + gone))
        kinds += [jump * total * mean, leave * total * off_after]
        kinds += [enter * off * mean, (1 - enter) * off * off_after]
        each = torch.stack(kinds, -1).flatten(0, -2)
        total = each.sum(-1, keepdim=True)
        counts = torch.where(total > 0, each / total.clamp(min=MIN_PROBABILITY), 0).sum(0)
        return Counts(counts[:-4], *counts[-4:])

    def changes(self, before: Tensor, after: Tensor) -> Tensor:
        """Expected numbers of changes of the chain in some steps, (B,S) as in `counts` -> (M,M)."""
        (on, off), (on_after, off_after) = self._split(before), self._split(after)
        back = self._by_all_moves(on_after, back=True) + self.lost * off_after[..., None, None]
        joint = self.change * (self._turned(on).flatten(-2) @ back.flatten(-2).mT)
        _, jump, leave, enter = (rate[..., None] for rate in self.rates)
        anywhere = (self.each * after[..., :-1]).sum(-1, keepdim=True)
        others = before[..., :-1].sum(-1, keepdim=True) * (jump * anywhere + leave * off_after)
        others = others + off * (enter * anywhere + (1 - enter) * off_after)
        total = joint.sum((-1, -2), keepdim=True) + others[..., None]
        return torch.where(total > 0, joint / total.clamp(min=MIN_PROBABILITY), 0).flatten(0, -3).sum(0)

    def _counted(self, before: Tensor, after: Tensor, lost: Tensor) -> Tensor | None:
        """The weight of each move without its probability, (..., V+1), by a loop of `loops`."""
        if before.numel() < loops.WORTH_COMPILING or self._differs:
            return None
        rows = (one.reshape(-1, one.shape[-1]) for one in (before, after))
        arrays = self._readable(*rows, lost)
        if arrays is None or (kernel := loops.counted()) is None:
            return None
        (own, later, away), route = arrays
        out = np.empty((len(own), len(away)), np.float32)
        kernel(own, later, away, route, out)
        return torch.from_numpy(out).view(*before.shape[:-1], -1)


def logits(*probabilities: float) -> Tensor:
    """Logarithms, finite for a probability of 0."""
    return torch.tensor(probabilities, dtype=torch.float32).clamp(min=MIN_PROBABILITY).log()


def checked_rates(moves: Sequence[float], jump: float, leave: float, enter: float) -> tuple[float, ...]:
    """The moves, if these are probabilities of a step; else an InputError."""
    moves = tuple(float(move) for move in moves)
    if not all(0 <= rate <= 1 for rate in (jump, leave, enter)) or jump + leave > 1:
        seen = f"jump {jump}, leave {leave}, enter {enter}"
        raise InputError(f"{seen}; expected probabilities, jump + leave at most 1")
    if not all(move >= 0 for move in moves) or not abs(sum(moves) - 1) < 1e-6:
        raise InputError(f"the moves are {[*moves]}; expected probabilities that add up to 1")
    return moves
