"""Beam search over the histories of a movie, forward and backward: the best history, and each candidate's probability.

A history names the right candidate of each frame, or none, and the breaks of the motion. A state is the last two frames
with an orientation: the next candidate is compared with the omega between them.
"""

import math
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from sphereorient.assemble.second_order_cost import VARIANCE_MAX, Floats, SecondOrderCost
from sphereorient.trajectory import runs_of

# The sweep is sequential, with a hundred operations on few numbers per step: numpy takes a quarter of torch's time.
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

NOT_YET, LOST = -1, -2  # instead of the frame of the last orientation
SMALL = 1e-12  # rad; keeps quotients by a zero rotation finite
BEAM_NATS = 30.0  # more than the cost of a break and a new start
STATES_MAX = 256  # most histories kept per frame, to bound time and memory
STUCK_FRAMES = 3  # a stuck candidate may be absent for one frame less than this
PIN_NATS = 6.0  # least gain by the motion in every frame of a run without search
PIN_ALONE_NATS = 12.0  # least extra cost of every other candidate of such a frame
PIN_MARGIN = 3  # searched frames at either end of such a run
NEAR_WHOLE_TURN = 1.0  # rad; nearer to a whole turn, the axis of a rotation is undetermined
REST_SHARE = 0.5  # prior share of motions that begin with an omega as small as its changes


@dataclass(frozen=True, kw_only=True, eq=False)
class CandidateRows:
    """Candidates of the F frames with candidates, as rows."""

    R_lab_body: Floats  # (M, 3, 3)
    variance: Floats  # (M,), rad^2 per axis
    log_weight: Floats  # (M,), of the candidate within its frame, by the pictures alone
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
        """Return the number of possible rotations over a time, each below half a turn per frame interval."""
        return np.maximum(np.rint(dt_s / self.frame_s).astype(np.int64), 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PathStates:
    """Ends of histories at one frame, S of them."""

    frame: Ints  # of the last orientation; LOST or NOT_YET if there is none to continue
    row: Ints  # of the last orientation
    turn: Floats  # (S, 3), rad, over the span
    span: Floats  # s, between the last two orientations; 0 at the start of a motion
    before: Floats  # rad^2 per axis, of the last orientation but one

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
    source: Ints  # (E,), index of a state of the previous step
    target: Ints  # (E,), index of a state of this step
    cost: Floats  # (E,)
    best: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (S,), edge of the cheapest history


@dataclass(frozen=True, kw_only=True, eq=False)
class Histories:
    """Result of a `BeamSearch`, F frames and M rows."""

    row: Ints  # (F,), chosen row; -1: none
    begins: Bools  # (F,), a motion begins at the frame
    breaks: Bools  # (F,), a motion begins although the previous one could have continued
    turn_rad: Floats  # (F, 3), from the previous orientation, with whole turns; NaN where a motion begins
    posterior: Floats  # (M,), probability of each row
    evidence: float  # log of the ratio of the movie's probability with a motion to that without


class BeamSearch:
    """Search of a movie's candidates by a cost; gaps inside a motion have at most `gap_frames_max` frame intervals."""

    def __init__(self, rows: CandidateRows, cost: SecondOrderCost, gap_frames_max: int) -> None:
        self.rows, self.cost = rows, cost
        self.time, self.offset = rows.time_s, rows.offset
        self.still, self.log_stuck = still_log_ratio(rows, cost), np.log(float(cost.stuck_probability))
        self.hole_s = (gap_frames_max + 1.5) * rows.frame_s  # half a frame more, for uneven times
        self.hit, self.miss = (np.array(each) for each in cost.presence())  # index: the previous frame was a hit
        self.breaks, self.goes_on = -math.log(cost.break_probability), -math.log1p(-cost.break_probability)
        self.main = np.lexsort((-rows.log_weight, rows.frame))[rows.offset[:-1]]  # (F,), likeliest row by the pictures
        self.chain_cost, self.chain_turn, self.last_pin = self._pins(gap_frames_max + 2)

    def run(self) -> Histories:
        """Find the most probable history of the movie, and each candidate's probability.
        Source: Viterbi 1967; Baum and others 1970 (forward-backward); pruned as in a beam search.
        """
        states = PathStates.begin(NOT_YET, np.full(1, NOT_YET, dtype=np.int64))
        least, total = np.zeros(1), np.zeros(1)
        steps: list[BeamStep] = []
        totals: list[Floats] = []
        f = 0
        while f < len(self.time):
            step, least, total = self._arrive(self._step(states, least, f), least, total)
            steps.append(step)
            totals.append(total)
            if self.last_pin[f] > f:  # only one state: no search until the run's end
                step = self._jump(step, self.last_pin[f])
                least, total = least + step.cost, total + step.cost
                steps.append(step)
                totals.append(total)
            states, f = step.states, step.frame + 1
        return self._read(steps, totals, int(least.argmin()))

    def _step(self, states: PathStates, least: Floats, f: int) -> BeamStep:
        """Return all edges from states to frame f: begin at a candidate, continue to one, or to none."""
        dt, alive = self._alive(states, f)
        fresh = (states.frame == f - 1).astype(np.int64)
        hit, miss = self.hit[fresh], self.miss[fresh]
        every = np.arange(len(fresh))
        pair, single = np.flatnonzero(alive & (states.span > 0)), np.flatnonzero(alive & (states.span == 0))
        goes_on, onward = hit + self.goes_on, []
        if len(pair):
            onward.append(self._go_on(states.take(pair), pair, dt[pair], goes_on[pair], f))
        if len(single):
            onward.append(self._second(states.take(single), single, dt[single], goes_on[single], f))
        visits = [self._begin(every, hit + np.where(alive, self.breaks, 0.0), f)]
        visits += [merge_equal(concatenated(onward, shared_targets=True), least)] if onward else []
        if self.last_pin[f] >= 0:
            visits = visits[1:]
        elif self.last_pin[f + 1] < 0:
            stays, ends = np.flatnonzero(alive), np.flatnonzero(~alive)
            here, lost = states.take(stays), PathStates.begin(LOST, np.full(min(len(ends), 1), -1))
            visits += [
                BeamStep(frame=f, states=here, source=stays, target=np.arange(len(stays)), cost=miss[stays]),
                BeamStep(frame=f, states=lost, source=ends, target=np.zeros_like(ends), cost=miss[ends]),
            ]
        return concatenated(visits)

    def _alive(self, states: PathStates, f: int) -> tuple[Floats, Bools]:
        """Return the time since the last orientation, and whether omega still predicts the rotation over it."""
        tracked = states.row >= 0
        dt = np.where(tracked, self.time[f] - self.time[states.frame], 0.0)
        span = np.where(states.span > 0, states.span, self.rows.frame_s)
        here = self.rows.variance[states.row]
        predicted = self.cost.predicted_variance(dt, span, states.before, here, 0.0)
        return dt, tracked & (dt <= self.hole_s) & ((states.span == 0) | (predicted <= VARIANCE_MAX))

    def _candidate_cost(self, rows: Ints | slice, log_ratio: Floats) -> Floats:
        """Return the cost of candidates by pictures and motion; `log_ratio`: of the density by the motion."""
        return self.cost.candidate(log_ratio, self.still[rows]) - self.rows.log_weight[rows]

    def _begin(self, source: Ints, cost: Floats, f: int) -> BeamStep:
        """Begin a motion at each candidate: any orientation is possible, so its ratio to the uniform density is 1."""
        rows = np.arange(self.offset[f], self.offset[f + 1])
        source, target = np.repeat(source, len(rows)), np.tile(np.arange(len(rows)), len(source))
        total = (cost[:, None] + self._candidate_cost(rows, np.zeros(len(rows)))).ravel()
        return BeamStep(frame=f, states=PathStates.begin(f, rows), source=source, target=target, cost=total)

    def _go_on(self, states: PathStates, source: Ints, dt: Floats, cost: Floats, f: int) -> BeamStep:
        """Continue states with an omega, by the rotation nearest to its prediction."""
        rows = np.arange(self.offset[f], self.offset[f + 1])
        R, R_before = self.rows.R_lab_body[rows], self.rows.R_lab_body[states.row]
        expected = states.turn / states.span[:, None] * dt[:, None]
        off, axis_off = rotation_between(rotated(R_before, expected)[:, None], R)
        here, after = self.rows.variance[states.row, None], self.rows.variance[rows]
        span, before = states.span[:, None], states.before[:, None]
        variance = self.cost.predicted_variance(dt[:, None], span, before, here, after)
        angle, axis = rotation_between(R_before[:, None], R)
        zones = self.rows.zones(dt)[:, None]
        around = np.rint(((expected[:, None] * axis).sum(-1) - angle) / (2 * math.pi)).astype(np.int64)
        length = np.sqrt((expected**2).sum(-1))[:, None]
        whole = (angle < NEAR_WHOLE_TURN) & (length > math.pi)
        around = np.where(whole, np.rint(length / (2 * math.pi)).astype(np.int64), around)
        around = np.clip(around, -(zones // 2), (zones - 1) // 2)
        turn = (angle + 2 * math.pi * around)[..., None] * axis
        if whole.any():
            # Keep the axis of omega and lengthen the rotation; the axis of the small difference is another one.
            ahead = expected[:, None] / np.maximum(length, 1e-300)[..., None]
            longer = length + (off[..., None] * axis_off * ahead).sum(-1)
            turn = np.where(whole[..., None], ahead * longer[..., None], turn)
        of_state, row = np.repeat(np.arange(len(source)), len(rows)), np.tile(rows, len(source))
        step = self._onward(f, states, of_state, row, turn.reshape(-1, 3), around.ravel())
        total = cost[:, None] + self._candidate_cost(rows, self.cost.log_ratio(off**2, variance))
        return replace(step, source=source[of_state], cost=total.ravel())

    def _second(self, states: PathStates, source: Ints, dt: Floats, cost: Floats, f: int) -> BeamStep:
        """Continue from the first frame of a motion: slowly, or by any rotation possible in the time."""
        rows = np.arange(self.offset[f], self.offset[f + 1])
        angle, axis = rotation_between(self.rows.R_lab_body[states.row][:, None], self.rows.R_lab_body[rows])
        zones = self.rows.zones(dt)
        around = np.arange(-(zones.max() // 2), (zones.max() - 1) // 2 + 1)
        here, after = self.rows.variance[states.row, None], self.rows.variance[rows]
        slow = self.cost.log_ratio(angle**2, self.cost.rest_variance(dt[:, None], here, after))
        anyhow = (1 - REST_SHARE) / zones[:, None, None]
        ratio = np.log(anyhow + REST_SHARE * np.where(around == 0, np.exp(slow)[..., None], 0.0))
        possible = (around >= -(zones // 2)[:, None]) & (around <= ((zones - 1) // 2)[:, None])
        of_source, of_row, of_turn = np.nonzero(np.broadcast_to(possible[:, None], ratio.shape))
        turn = (angle[of_source, of_row] + 2 * math.pi * around[of_turn])[:, None] * axis[of_source, of_row]
        step = self._onward(f, states, of_source, rows[of_row], turn, around[of_turn])
        total = cost[of_source] + self._candidate_cost(rows[of_row], ratio[of_source, of_row, of_turn])
        return replace(step, source=source[of_source], cost=total)

    def _onward(self, f: int, states: PathStates, of_state: Ints, row: Ints, turn: Floats, around: Ints) -> BeamStep:
        """Return one edge and one state for each continuation; `merge_equal` merges states of equal key (`target`)."""
        before, dt = states.row[of_state], self.time[f] - self.time[states.frame[of_state]]
        key = (before * (self.offset[f + 1] - self.offset[f]) + row - self.offset[f]) * (1 << 20) + around
        at = np.full(len(row), f)
        onward = PathStates(frame=at, row=row, turn=turn, span=dt, before=self.rows.variance[before])
        return BeamStep(frame=f, states=onward, source=of_state, target=key, cost=np.zeros(len(row)))

    def _arrive(self, step: BeamStep, least: Floats, total: Floats) -> tuple[BeamStep, Floats, Floats]:
        """Reduce the edges to the best and to the sum of each state; drop states far behind."""
        size = len(step.states.row)
        arriving = least[step.source] + step.cost
        order = np.lexsort((arriving, step.target))
        first = order[np.searchsorted(step.target[order], np.arange(size))]
        new_least = arriving[first]
        new_total = soft_min(total[step.source] + step.cost, step.target, size)
        near = np.flatnonzero(new_least <= new_least.min() + BEAM_NATS)
        if len(near) > STATES_MAX:
            near = np.sort(near[np.argsort(new_least[near], kind="stable")[:STATES_MAX]])
        place = np.full(size, -1)
        place[near] = np.arange(len(near))
        kept = place[step.target] >= 0
        states, source, target, cost = step.states.take(near), step.source[kept], step.target[kept], step.cost[kept]
        best = (np.cumsum(kept) - 1)[first[near]]
        pruned = replace(step, states=states, source=source, target=place[target], cost=cost, best=best)
        return pruned, new_least[near], new_total[near]

    def _pins(self, length: int) -> tuple[Floats, Floats, Ints]:
        """Find runs of frames in which only the likeliest candidates follow the motion: all good histories contain
        them. Return, per frame, cost and rotation from the previous two frames. Return also, with one more frame at the
        end, the last frame of a run inside its margins at the second of two frames with one candidate each, else -1.
        """
        frames, main = len(self.time), self.main
        cost, turn, last = np.zeros(frames), np.zeros((frames, 3)), np.full(frames + 1, -1)
        single, dt = np.diff(self.offset) == 1, np.diff(self.time)
        close = (dt <= self.hole_s) & (self.rows.zones(dt) == 1)
        R, variance = self.rows.R_lab_body[main], self.rows.variance[main]
        angle, axis = rotation_between(R[:-1], R[1:])
        turn[1:] = angle[:, None] * axis
        alone = single.copy()
        follows = np.zeros(max(frames - 2, 0), dtype=np.bool_)
        if frames > 2:
            predicted = rotated(R[1:-1], turn[1:-1] * (dt[1:] / dt[:-1])[:, None])
            row = np.arange(self.offset[2], self.offset[-1])
            k = self.rows.frame[row] - 2
            off, _ = rotation_between(predicted[k], self.rows.R_lab_body[row])
            spread = self.cost.predicted_variance(
                dt[1:][k], dt[:-1][k], variance[:-2][k], variance[1:-1][k], self.rows.variance[row]
            )
            ratio = self.cost.log_ratio(off**2, spread)
            each = self._candidate_cost(row, ratio)
            here = main[2:] - self.offset[2]
            others = each.copy()
            others[here] = np.inf
            cost[2:] = self.hit[1] + self.goes_on + each[here]
            alone[2:] |= np.minimum.reduceat(others, self.offset[2:-1] - self.offset[2]) - each[here] >= PIN_ALONE_NATS
            follows = alone[2:] & alone[1:-1] & alone[:-2] & close[1:] & close[:-1]
            follows &= ratio[here] - np.maximum(self.still[main[2:]] + self.log_stuck, 0.0) >= PIN_NATS
        for begin, end in runs_of(follows):
            if end - begin + 2 < max(length, 2 * PIN_MARGIN + 4):
                continue
            first, stop = begin + PIN_MARGIN + 1, end + 1 - PIN_MARGIN
            # Only one state is left there.
            starts = first + np.flatnonzero(single[first:stop] & single[first - 1 : stop - 1])
            if len(starts):
                last[starts[0]] = stop
        return cost, turn, last

    def _jump(self, step: BeamStep, last: int) -> BeamStep:
        """Return the step to the last frame of a run, whose only state follows from the run's second frame."""
        at, back = np.array([last]), np.array([last - 1])
        span, before = self.time[at] - self.time[back], self.rows.variance[self.main[back]]
        states = PathStates(frame=at, row=self.main[at], turn=self.chain_turn[at], span=span, before=before)
        cost, none = self.chain_cost[step.frame + 1 : last + 1].sum(keepdims=True), np.zeros(1, dtype=np.int64)
        return BeamStep(frame=last, states=states, source=none, target=none, cost=cost, best=none)

    def _read(self, steps: list[BeamStep], totals: list[Floats], end: int) -> Histories:
        frames = len(self.time)
        row, begins, breaks = np.full(frames, -1), np.zeros(frames, dtype=np.bool_), np.zeros(frames, dtype=np.bool_)
        turn, posterior = np.full((frames, 3), np.nan), np.zeros(len(self.still))
        everything = float(soft_min(totals[-1], np.zeros(len(totals[-1]), dtype=np.int64), 1)[0])
        ahead = np.zeros(len(totals[-1]))
        for place in range(len(steps) - 1, -1, -1):
            step, total = steps[place], totals[place]
            f, states, previous = step.frame, step.states, steps[place - 1].frame if place else -1
            here = np.flatnonzero(states.frame == f)
            np.add.at(posterior, states.row[here], np.exp(everything - (total + ahead)[here]))
            if states.frame[end] == f:
                row[f], begins[f] = states.row[end], states.span[end] == 0
                turn[f] = states.turn[end] if states.span[end] > 0 else np.nan
            inside = np.arange(previous + 1, f)  # of a pinned run
            row[inside], turn[inside] = self.main[inside], self.chain_turn[inside]
            posterior[self.main[inside]] = 1.0
            end = int(step.source[step.best[end]])
            if begins[f] and place:
                breaks[f] = self._alive(steps[place - 1].states, f)[1][end]
            ahead = soft_min(step.cost + ahead[step.target], step.source, len(totals[place - 1]) if place else 1)
        log = -everything
        return Histories(row=row, begins=begins, breaks=breaks, turn_rad=turn, posterior=posterior, evidence=log)


def still_log_ratio(rows: CandidateRows, cost: SecondOrderCost) -> Floats:
    """Return the log density ratio (M,) of each row if a candidate of the last frames stays; -inf in the first frame.
    False candidates (glare, dirt) stay, so that following the motion proves little for a candidate at rest.
    """
    best, counts = np.full(len(rows.variance), -np.inf), np.diff(rows.offset)
    for lag in range(1, min(STUCK_FRAMES, len(rows.time_s) - 1) + 1):
        pairs = counts[:-lag] * counts[lag:]
        frame = np.repeat(np.arange(len(pairs)), pairs)
        within = np.arange(len(frame)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
        before, after = (rows.offset[frame + k] for k in (0, lag))
        before, after = before + within // counts[frame + lag], after + within % counts[frame + lag]
        dt = rows.time_s[frame + lag] - rows.time_s[frame]
        cosine = ((rows.R_lab_body[before] * rows.R_lab_body[after]).sum((-2, -1)) - 1) / 2
        variance = cost.rest_variance(dt, rows.variance[before], rows.variance[after])
        np.maximum.at(best, after, cost.log_ratio(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2, variance))
    return best


def merge_equal(step: BeamStep, least: Floats) -> BeamStep:
    """Merge states with equal keys, which are in `target`; the cheapest edge gives the state."""
    order = np.argsort(least[step.source] + step.cost, kind="stable")  # the first of equal keys is the cheapest
    _, first, target = np.unique(step.target[order], return_index=True, return_inverse=True)
    states = step.states.take(order[first])
    return replace(step, states=states, source=step.source[order], target=target, cost=step.cost[order])


def concatenated(ways: list[BeamStep], *, shared_targets: bool = False) -> BeamStep:
    """Join several sets of edges; renumber their targets unless they are shared keys."""
    sizes = np.cumsum([0, *(0 if shared_targets else len(way.states.row) for way in ways)])
    parts = {e.name: np.concatenate([getattr(way.states, e.name) for way in ways]) for e in fields(PathStates)}
    source, cost = (np.concatenate([getattr(way, name) for way in ways]) for name in ("source", "cost"))
    target = np.concatenate([way.target + size for way, size in zip(ways, sizes[:-1], strict=True)])
    return BeamStep(frame=ways[0].frame, states=PathStates(**parts), source=source, target=target, cost=cost)


def soft_min(values: Floats, group: Ints, size: int) -> Floats:
    """Return -log sum exp(-values) of each group, (size,); inf if empty."""
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
