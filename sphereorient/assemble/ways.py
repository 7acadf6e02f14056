"""Ends of histories at one frame, the ways that lead to them, and how ways are put together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sphereorient.assemble.continuity import Floats, Ints

NOT_YET, LOST = -1, -2  # in place of the frame of the last orientation


@dataclass(frozen=True, kw_only=True, eq=False)
class States:
    """Ends of histories at one frame, S of them."""

    frame: Ints  # of the last orientation; LOST or NOT_YET where there is none to go on from
    row: Ints  # of the last orientation
    omega: Floats  # (S, 3), rad/s, mean over the span
    turn: Floats  # (S, 3), rad, over the span
    span: Floats  # s, between the last two orientations; 0 where a motion begins
    before: Floats  # rad^2 per axis, of the last but one

    def take(self, which: Ints) -> States:
        """Some of the states."""
        return States(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """One frame of the sweep: its states and the edges that lead to them."""

    frame: int
    states: States
    source: Ints  # (E,), among the states of the step before
    target: Ints  # (E,), among these
    cost: Floats  # (E,)
    best: Ints  # (S,), edge by which the cheapest history comes


def merge(ways: list[Step], least: Floats) -> Step:
    """Join edges that lead to the same two orientations by the same number of turns; the cheapest gives the state."""
    source, key, cost = (np.concatenate([getattr(way, name) for way in ways]) for name in ("source", "target", "cost"))
    order = np.argsort(least[source] + cost, kind="stable")  # so that the first of equal keys is the cheapest
    _, first, target = np.unique(key[order], return_index=True, return_inverse=True)
    return Step(
        frame=ways[0].frame,
        states=_side_by_side(ways).take(order[first]),
        source=source[order],
        target=target,
        cost=cost[order],
        best=first[:0],
    )


def _side_by_side(ways: list[Step]) -> States:
    """The states of several ways on."""
    return States(
        **{name: np.concatenate([getattr(way.states, name) for way in ways]) for name in States.__dataclass_fields__}
    )


def stay(states: States, alive: Ints, cost: Floats) -> Step:
    """No candidate is right: the motion waits."""
    target = np.arange(len(alive))
    return Step(frame=-1, states=states.take(alive), source=alive, target=target, cost=cost, best=target[:0])


def lose(source: Ints, cost: Floats) -> Step:
    """No candidate is right, and nothing is left to go on from."""
    size = min(len(source), 1)
    lost, nothing, vectors = np.full(size, LOST), np.zeros(size), np.zeros((size, 3))
    states = States(frame=lost, row=np.full(size, -1), omega=vectors, turn=vectors, span=nothing, before=nothing)
    target = np.zeros(len(source), dtype=np.int64)
    return Step(frame=-1, states=states, source=source, target=target, cost=cost, best=target[:0])


def join(frame: int, ways: list[Step]) -> Step:
    """Put several ways on side by side."""
    sizes = np.cumsum([0, *(len(way.states.row) for way in ways)])
    return Step(
        frame=frame,
        states=_side_by_side(ways),
        source=np.concatenate([way.source for way in ways]),
        target=np.concatenate([way.target + size for way, size in zip(ways, sizes[:-1], strict=True)]),
        cost=np.concatenate([way.cost for way in ways]),
        best=ways[0].best[:0],
    )


def soft_min(values: Floats, group: Ints, size: int) -> Floats:
    """Return -log sum exp(-values) of each group, (size,); inf where it is empty."""
    low = np.full(size, np.inf)
    np.minimum.at(low, group, values)
    finite = np.isfinite(values)
    share = np.bincount(group[finite], np.exp(low[group[finite]] - values[finite]), size)
    return np.where(share > 0, low - np.log(np.maximum(share, 1e-300)), np.inf)
