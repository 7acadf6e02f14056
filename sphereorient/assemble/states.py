"""Records of the beam search: candidates as rows, ends of histories, and the edges that lead to them."""

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

# The sweep is sequential, each step a hundred operations on few numbers: numpy's cost a quarter of torch's.
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

NOT_YET, LOST = -1, -2  # in place of the frame of the last orientation
SMALL = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class CandidateRows:
    """Candidates of the F frames that have any, as rows; made by `physical_path`."""

    R_lab_body: Floats  # (M, 3, 3)
    variance: Floats  # (M,), rad^2 per axis
    log_weight: Floats  # (M,), of the candidate among those of its frame, by the pictures alone
    offset: Ints  # (F + 1,), rows of each frame
    time_s: Floats  # (F,)
    frame_s: float  # usual time between frames of the movie

    @property
    def frame(self) -> Ints:
        """Frame of each row, (M,)."""
        return np.repeat(np.arange(len(self.time_s)), np.diff(self.offset))

    def part(self, first: int, last: int) -> "CandidateRows":
        """Return the frames first .. last - 1."""
        rows = slice(self.offset[first], self.offset[last])
        parts = {name: getattr(self, name)[rows] for name in ("R_lab_body", "variance", "log_weight")}
        offset = self.offset[first : last + 1] - self.offset[first]
        return replace(self, **parts, offset=offset, time_s=self.time_s[first:last])

    def zones(self, dt_s: Floats) -> Ints:
        """Return the number of possible rotations over a time: below half a turn in each frame interval."""
        return np.maximum(np.rint(dt_s / self.frame_s).astype(np.int64), 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PathStates:
    """Ends of histories at one frame, S of them."""

    frame: Ints  # of the last orientation; LOST or NOT_YET without one to continue from
    row: Ints  # of the last orientation
    turn: Floats  # (S, 3), rad, over the span
    span: Floats  # s, between the last two orientations; 0 where a motion begins
    before: Floats  # rad^2 per axis, of the last but one

    @classmethod
    def begin(cls, frame: int, row: Ints) -> "PathStates":
        """Return states without a motion."""
        nothing, at = np.zeros(len(row)), np.full(len(row), frame)
        return cls(frame=at, row=row, turn=np.zeros((len(row), 3)), span=nothing, before=nothing)

    def take(self, which: Ints) -> "PathStates":
        """Return some of the states."""
        return PathStates(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})


@dataclass(frozen=True, kw_only=True, eq=False)
class BeamStep:
    """One frame of the sweep: its states and the edges that lead to them."""

    frame: int
    states: PathStates
    source: Ints  # (E,), among the states of the step before
    target: Ints  # (E,), among these
    cost: Floats  # (E,)
    best: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (S,), edge of the cheapest history


def merge_equal(step: BeamStep, least: Floats) -> BeamStep:
    """Merge states of equal key, which stands in `target`; the cheapest way gives the state."""
    order = np.argsort(least[step.source] + step.cost, kind="stable")  # so that the first of equal keys is the cheapest
    _, first, target = np.unique(step.target[order], return_index=True, return_inverse=True)
    states = step.states.take(order[first])
    return replace(step, states=states, source=step.source[order], target=target, cost=step.cost[order])


def concatenated(ways: list[BeamStep], *, shared_targets: bool = False) -> BeamStep:
    """Put several ways side by side; renumber their targets unless they are shared keys."""
    sizes = np.cumsum([0, *(0 if shared_targets else len(way.states.row) for way in ways)])
    parts = {e.name: np.concatenate([getattr(way.states, e.name) for way in ways]) for e in fields(PathStates)}
    source, cost = (np.concatenate([getattr(way, name) for way in ways]) for name in ("source", "cost"))
    target = np.concatenate([way.target + size for way, size in zip(ways, sizes[:-1], strict=True)])
    return BeamStep(frame=ways[0].frame, states=PathStates(**parts), source=source, target=target, cost=cost)


def soft_min(values: Floats, group: Ints, size: int) -> Floats:
    """Return -log sum exp(-values) of each group, (size,); inf where it is empty."""
    low = np.full(size, np.inf)
    np.minimum.at(low, group, values)
    finite = np.isfinite(values)
    share = np.bincount(group[finite], np.exp(low[group[finite]] - values[finite]), size)
    return np.where(share > 0, low - np.log(np.maximum(share, 1e-300)), np.inf)


def rotation_between(R_from: Floats, R_to: Floats) -> tuple[Floats, Floats]:
    """Return angle (...), rad, 0 .. pi, and lab axis (..., 3), 0 without rotation, from R_from to R_to (..., 3, 3)."""
    turn = R_to @ np.swapaxes(R_from, -1, -2)
    twice = np.stack([turn[..., j, i] - turn[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
    sine = np.sqrt((twice**2).sum(-1)) / 2
    cosine = (turn[..., 0, 0] + turn[..., 1, 1] + turn[..., 2, 2] - 1) / 2
    return np.arctan2(sine, cosine), twice / np.maximum(2 * sine, SMALL)[..., None]


def rotated(R: Floats, rotvec: Floats) -> Floats:
    """Return orientations (..., 3, 3) after rotations by lab vectors (..., 3), rad (Rodrigues' formula)."""
    angle = np.sqrt((rotvec**2).sum(-1))[..., None]
    axis = rotvec / np.maximum(angle, SMALL)
    along = (axis[..., None, :] @ R)[..., 0, :]  # axis . column, of the three columns
    x, y, z = (axis[..., i, None] for i in range(3))
    a, b, c = R[..., 0, :], R[..., 1, :], R[..., 2, :]
    across = np.stack([y * c - z * b, z * a - x * c, x * b - y * a], -2)
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    result: Floats = R * cosine + across * sine + axis[..., None] * along[..., None, :] * (1 - cosine)
    return result
