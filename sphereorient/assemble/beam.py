"""Forward and backward over all histories of a movie: the best one, and how probable each candidate is.

A history says of each frame which candidate is right, or that none is, and where the motion broke. What the next
candidate must fit is the omega between the last two frames with an orientation, however far back: these two are the
state. States far worse than the best are dropped on the way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sphereorient.assemble.continuity import REST_SHARE, VARIANCE_MAX, Bools, Floats, Ints, Motion, turn_between, turned
from sphereorient.assemble.settings import PathSettings
from sphereorient.assemble.ways import NOT_YET, States, Step, join, lose, merge, soft_min, stay

BEAM_NATS = 30.0  # a break and a new beginning cost less: no true history stays further behind for long
STATES_MAX = 256
STUCK_FRAMES = 3  # a stuck candidate may be away for this many frames, less one
PIN_NATS = 6.0  # what following the motion must gain in every frame of a run that needs no search
PIN_MARGIN = 3  # frames at either end of such a run that are searched all the same

NEAR_WHOLE_TURN = 1.0  # rad; nearer, two orientations do not tell the axis of the turn between them


@dataclass(frozen=True, kw_only=True, eq=False)
class Movie:
    """Candidates of the F frames that have any, as rows; made by second_order."""

    R_lab_body: Floats  # (M, 3, 3)
    variance: Floats  # (M,), rad^2 per axis
    log_weight: Floats  # (M,), of the candidate among those of its frame, by the pictures alone
    offset: Ints  # (F + 1,), rows of each frame
    time_s: Floats  # (F,)

    @property
    def frame(self) -> Ints:
        """Frame of each row, (M,)."""
        return np.repeat(np.arange(len(self.time_s)), np.diff(self.offset))

    def part(self, first: int, last: int) -> Movie:
        """Return some frames in a row."""
        rows = slice(self.offset[first], self.offset[last])
        return Movie(
            R_lab_body=self.R_lab_body[rows],
            variance=self.variance[rows],
            log_weight=self.log_weight[rows],
            offset=self.offset[first : last + 1] - self.offset[first],
            time_s=self.time_s[first:last],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Histories:
    """What `search` found, F frames and M rows; read by second_order."""

    row: Ints  # (F,), row chosen, -1 none
    begins: Bools  # (F,), the frame's orientation begins a motion
    breaks: Bools  # (F,), it does although the motion before could have gone on
    turn_rad: Floats  # (F, 3), from the orientation before, as many turns as the motion says; NaN where it begins
    posterior: Floats  # (M,), probability of each row
    evidence: float  # log of how much more probable the movie is with a motion in it than without


def search(movie: Movie, motion: Motion, settings: PathSettings) -> Histories:
    """Find the most probable history of a movie, and the share of each candidate in all of them.

    Args:
        movie: at least one frame.
        motion: how omega changes.
        settings: of the path.

    Source: Viterbi 1967; Baum and others 1970 (forward-backward); pruned as in a beam search.
    """
    return _Search(movie, motion, settings).run()


class _Search:
    """The sweep over one movie; costs are negative logarithms, nats."""

    def __init__(self, movie: Movie, motion: Motion, settings: PathSettings) -> None:
        self.movie, self.motion = movie, motion
        self.time, self.offset = movie.time_s, movie.offset
        stuck, follow = settings.stuck_probability, settings.follow_probability
        self.log_anywhere, self.log_stuck, self.log_follow = np.log([1 - stuck - follow, stuck, follow])
        self.still = still_log_ratio(movie, motion)
        self.hole_s = (settings.gap_frames_max + 1.5) * motion.frame_s  # half a frame for uneven times
        self.miss = -np.log([settings.miss_again_probability, settings.miss_probability])  # index: fresh
        self.hit = -np.log1p([-settings.miss_again_probability, -settings.miss_probability])
        self.breaks, self.goes_on = -math.log(settings.break_probability), -math.log1p(-settings.break_probability)
        self.chain_cost, self.chain_turn, self.first_pin, self.last_pin = self._pins(settings.gap_frames_max + 2)

    def run(self) -> Histories:
        """Sweep forward, then backward."""
        nothing = np.zeros(1)
        start = np.full(1, NOT_YET, dtype=np.int64)
        vectors = np.zeros((1, 3))
        states = States(frame=start, row=start, omega=vectors, turn=vectors, span=nothing, before=nothing)
        least, total = np.zeros(1), np.zeros(1)
        steps: list[Step] = []
        totals: list[Floats] = []
        f = 0
        while f < len(self.time):
            step, least, total = self._arrive(self._step(states, least, f), least, total)
            steps.append(step)
            totals.append(total)
            last = self.last_pin[f]
            if last > f:  # only one state is left: no search until the run's end
                step, cost = self._jump(step, last)
                least, total = least + cost, total + cost
                steps.append(step)
                totals.append(total)
            states, f = step.states, step.frame + 1
        return self._read(steps, totals, int(least.argmin()))

    def _step(self, states: States, least: Floats, f: int) -> Step:
        """All ways on from some states to frame f: begin at a candidate, go on to one, or to none."""
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
        visits += [merge(onward, least)] if onward else []
        if f and self.first_pin[f - 1]:
            visits = visits[1:]
        step = join(f, visits)
        if self.first_pin[f] or (f and self.first_pin[f - 1]):
            return step
        return join(f, [step, stay(states, every[alive], miss[alive]), lose(every[~alive], miss[~alive])])

    def _alive(self, states: States, f: int) -> tuple[Floats, Bools]:
        """Time since the last orientation, and whether the motion can be followed so far: omega foretells the turn."""
        tracked = states.row >= 0
        dt = np.where(tracked, self.time[f] - self.time[states.frame], 0.0)
        span = np.where(states.span > 0, states.span, self.motion.frame_s)
        here = self.movie.variance[states.row]
        foretold = self.motion.predicted_variance(dt, span, states.before, here, 0.0)
        return dt, tracked & (dt <= self.hole_s) & ((states.span == 0) | (foretold <= VARIANCE_MAX))

    def _cost(self, rows: Ints | slice, log_ratio: Floats | float) -> Floats:
        """Cost of candidates: the pictures, and how much more likely each is where it stands if right than if false.

        A false candidate stands anywhere; or where one stood before; or it follows the motion as the right one does,
        so that following proves no more than that is rare, and two tracks that are both smooth stay even. Standing
        still is never the better explanation of what the motion explains: else noise would lose a sphere at rest.

        Args:
            rows: (...) of the candidates.
            log_ratio: (...), of the density there by the motion to the uniform one.
        """
        stuck = self.log_stuck + np.minimum(self.still[rows], log_ratio)
        false: Floats = np.logaddexp(np.logaddexp(self.log_anywhere, stuck), self.log_follow + log_ratio)
        return false - log_ratio - self.movie.log_weight[rows]

    def _begin(self, source: Ints, cost: Floats, f: int) -> Step:
        """Begin a motion at each candidate: it may point anywhere, so its ratio to the uniform density is 1."""
        rows = np.arange(self.offset[f], self.offset[f + 1])
        nothing, vectors = np.zeros(len(rows)), np.zeros((len(rows), 3))
        states = States(
            frame=np.full(len(rows), f), row=rows, omega=vectors, turn=vectors, span=nothing, before=nothing
        )
        return Step(
            frame=f,
            states=states,
            source=np.repeat(source, len(rows)),
            target=np.tile(np.arange(len(rows)), len(source)),
            cost=(cost[:, None] + self._cost(rows, 0.0)).ravel(),
            best=rows[:0],
        )

    def _go_on(self, states: States, source: Ints, dt: Floats, cost: Floats, f: int) -> Step:
        """Go on from states whose omega is known; the turn is the one nearest to what omega predicts."""
        rows = np.arange(self.offset[f], self.offset[f + 1])
        R, R_before = self.movie.R_lab_body[rows], self.movie.R_lab_body[states.row]
        expected = states.omega * dt[:, None]
        off, axis_off = turn_between(turned(R_before, expected)[:, None], R)
        variance = self.motion.predicted_variance(
            dt[:, None],
            states.span[:, None],
            states.before[:, None],
            self.movie.variance[states.row, None],
            self.movie.variance[rows],
        )
        angle, axis = turn_between(R_before[:, None], R)
        zones = self.motion.zones(dt)[:, None]
        around = np.rint(((expected[:, None] * axis).sum(-1) - angle) / (2 * math.pi)).astype(np.int64)
        length = np.sqrt((expected**2).sum(-1))[:, None]
        whole = (angle < NEAR_WHOLE_TURN) & (length > math.pi)
        around = np.where(whole, np.rint(length / (2 * math.pi)).astype(np.int64), around)
        around = np.clip(around, -(zones // 2), (zones - 1) // 2)
        turn = (angle + 2 * math.pi * around)[..., None] * axis
        if whole.any():
            # The axis of the little that is missing or too much is not omega's: that is kept, the turn lengthened.
            ahead = expected[:, None] / np.maximum(length, 1e-300)[..., None]
            longer = length + (off[..., None] * axis_off * ahead).sum(-1)
            turn = np.where(whole[..., None], ahead * longer[..., None], turn)
        return self._onward(
            f,
            source=np.repeat(source, len(rows)),
            before=np.repeat(states.row, len(rows)),
            row=np.tile(rows, len(source)),
            dt=np.repeat(dt, len(rows)),
            around=around.ravel(),
            turn=turn.reshape(-1, 3),
            cost=(cost[:, None] + self._cost(rows, self.motion.log_ratio(off, variance))).ravel(),
        )

    def _second(self, states: States, source: Ints, dt: Floats, cost: Floats, f: int) -> Step:
        """Go on from where a motion began: slowly, or by any turn there is time for."""
        rows = np.arange(self.offset[f], self.offset[f + 1])
        angle, axis = turn_between(self.movie.R_lab_body[states.row][:, None], self.movie.R_lab_body[rows])
        zones = self.motion.zones(dt)
        around = np.arange(-(zones.max() // 2), (zones.max() - 1) // 2 + 1)
        here, after = self.movie.variance[states.row, None], self.movie.variance[rows]
        slow = self.motion.log_ratio(angle, self.motion.rest_variance(dt[:, None], here, after))
        anyhow = (1 - REST_SHARE) / zones[:, None, None]
        ratio = np.log(anyhow + REST_SHARE * np.where(around == 0, np.exp(slow)[..., None], 0.0))
        possible = (around >= -(zones // 2)[:, None]) & (around <= ((zones - 1) // 2)[:, None])
        of_source, of_row, of_turn = np.nonzero(np.broadcast_to(possible[:, None], ratio.shape))
        turn = (angle[of_source, of_row] + 2 * math.pi * around[of_turn])[:, None] * axis[of_source, of_row]
        return self._onward(
            f,
            source=source[of_source],
            before=states.row[of_source],
            row=rows[of_row],
            dt=dt[of_source],
            around=around[of_turn],
            turn=turn,
            cost=cost[of_source] + self._cost(rows[of_row], ratio[of_source, of_row, of_turn]),
        )

    def _onward(
        self, f: int, *, source: Ints, before: Ints, row: Ints, dt: Floats, around: Ints, turn: Floats, cost: Floats
    ) -> Step:
        """Edges to states of two orientations, each to a state of its own; `merge` finds the equal ones."""
        key = (before * (self.offset[f + 1] - self.offset[f]) + row - self.offset[f]) * (1 << 20) + around
        states = States(
            frame=np.full(len(row), f),
            row=row,
            omega=turn / dt[:, None],
            turn=turn,
            span=dt,
            before=self.movie.variance[before],
        )
        return Step(frame=f, states=states, source=source, target=key, cost=cost, best=key[:0])

    def _arrive(self, step: Step, least: Floats, total: Floats) -> tuple[Step, Floats, Floats]:
        """Reduce the edges to the best and to the sum of each state; drop the states far behind."""
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
        renumbered = np.cumsum(kept) - 1
        pruned = Step(
            frame=step.frame,
            states=step.states.take(near),
            source=step.source[kept],
            target=place[step.target[kept]],
            cost=step.cost[kept],
            best=renumbered[first[near]],
        )
        return pruned, new_least[near], new_total[near]

    def _pins(self, length: int) -> tuple[Floats, Floats, Bools, Ints]:
        """Find runs of frames with one candidate each, all of which follow the motion: no search is needed inside.

        A run that no hole can bridge must be visited, and leaving out a frame of it gains nothing: all histories worth
        the name go through it in one way. At its ends the search goes on for a while, for there may be another.

        Returns:
            Cost (F,) and turn (F, 3) of going on from the two frames before; the first frame of each run but its
            margins (F,) bool; at the second frame of each run the last one (F,), elsewhere -1.
        """
        frames = len(self.time)
        cost, turn = np.zeros(frames), np.zeros((frames, 3))
        first, last = np.zeros(frames, dtype=np.bool_), np.full(frames, -1)
        if frames < 3:
            return cost, turn, first, last
        single, dt = np.diff(self.offset) == 1, np.diff(self.time)
        close = (dt <= self.hole_s) & (self.motion.zones(dt) == 1)
        R, variance = self.movie.R_lab_body[self.offset[:-1]], self.movie.variance[self.offset[:-1]]
        angle, axis = turn_between(R[:-1], R[1:])
        turn[1:] = angle[:, None] * axis
        off, _ = turn_between(turned(R[1:-1], turn[1:-1] * (dt[1:] / dt[:-1])[:, None]), R[2:])
        spread = self.motion.predicted_variance(dt[1:], dt[:-1], variance[:-2], variance[1:-1], variance[2:])
        row = self.offset[2:-1]
        ratio = self.motion.log_ratio(off, spread)
        cost[2:] = self.hit[1] + self.goes_on + self._cost(row, ratio)
        follows = single[2:] & single[1:-1] & single[:-2] & close[1:] & close[:-1]
        follows &= ratio - np.maximum(self.still[row] + self.log_stuck, 0.0) >= PIN_NATS
        edge = np.diff(np.concatenate([[0], follows.astype(np.int64), [0]]))
        for begin, end in zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) + 1, strict=True):
            # Frames begin .. end, both included: the first to follow is begin + 2.
            if end - begin + 1 >= max(length, 2 * PIN_MARGIN + 4):
                first[begin + PIN_MARGIN] = True
                last[begin + PIN_MARGIN + 1] = end - PIN_MARGIN
        return cost, turn, first, last

    def _jump(self, step: Step, last: int) -> tuple[Step, float]:
        """Go through a pinned run, from its second frame to its last."""
        span = self.time[last] - self.time[last - 1]
        row = int(self.offset[last])
        states = States(
            frame=np.array([last]),
            row=np.array([row]),
            omega=self.chain_turn[None, last] / span,
            turn=self.chain_turn[None, last],
            span=np.array([span]),
            before=self.movie.variance[None, self.offset[last - 1]],
        )
        cost = float(self.chain_cost[step.frame + 1 : last + 1].sum())
        none = np.zeros(1, dtype=np.int64)
        return Step(frame=last, states=states, source=none, target=none, cost=np.array([cost]), best=none), cost

    def _read(self, steps: list[Step], totals: list[Floats], end: int) -> Histories:
        """Walk back from the end: the best history, and the sums over all of them."""
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
            row[inside], turn[inside] = self.offset[inside], self.chain_turn[inside]
            posterior[self.offset[inside]] = 1.0
            end = int(step.source[step.best[end]])
            if begins[f] and place:
                breaks[f] = self._alive(steps[place - 1].states, f)[1][end]
            ahead = soft_min(step.cost + ahead[step.target], step.source, len(totals[place - 1]) if place else 1)
        return Histories(
            row=row, begins=begins, breaks=breaks, turn_rad=turn, posterior=posterior, evidence=-everything
        )


def still_log_ratio(movie: Movie, motion: Motion) -> Floats:
    """Return how likely each candidate is where it stands if one of the last frames' stays, log of ratio to uniform.

    False candidates do: glare and dirt stay. A motionless candidate thus proves little by following a motion.

    Args:
        movie: candidates.
        motion: its acceleration says what is as good as still.

    Returns:
        (M,), of each row; -inf where there is no frame before.
    """
    best = np.full(len(movie.variance), -np.inf)
    for lag in range(1, min(STUCK_FRAMES, len(movie.time_s) - 1) + 1):
        before, after = _row_pairs(movie.offset, lag)
        dt = (movie.time_s[lag:] - movie.time_s[:-lag])[movie.frame[after] - lag]
        cosine = ((movie.R_lab_body[before] * movie.R_lab_body[after]).sum((-2, -1)) - 1) / 2
        variance = motion.rest_variance(dt, movie.variance[before], movie.variance[after])
        np.maximum.at(best, after, motion.log_ratio(np.arccos(np.clip(cosine, -1.0, 1.0)), variance))
    return best


def _row_pairs(offset: Ints, lag: int) -> tuple[Ints, Ints]:
    """All pairs of a candidate and one `lag` frames later, as rows."""
    counts = np.diff(offset)
    before, after = counts[:-lag], counts[lag:]
    pairs = before * after
    frame = np.repeat(np.arange(len(pairs)), pairs)
    within = np.arange(len(frame)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    return offset[frame] + within // after[frame], offset[frame + lag] + within % after[frame]
