"""Identities of several balls that look alike over the whole movie: from their motion alone, as one assignment."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from sphereorient import so3
from sphereorient.assemble.beam import Bools, Floats, Ints
from sphereorient.trajectory import runs_of

FITTED = 6  # frames from which a motion is extrapolated
ORDER = 2  # of its polynomial
JUMP = 12.0  # times the usual error of an extrapolation to the next frame, from which a piece may end
SAMPLES = 200  # windows for the errors of one gap
SHARE, OF_CHI = 90.0, 2.5  # percentile of an error's length, and its value for three normal components
NO_LINK = 60.0  # chi2 of a piece without predecessor
FARTHEST = 256  # longest gap between linked pieces, frames
CERTAIN = 0.9999  # probability from which a name is certain


@dataclass(frozen=True, eq=False)
class _Piece:
    """Frames in which one row follows one ball without a break."""

    row: int
    first: int
    last: int  # + 1


@dataclass(frozen=True, eq=False)
class _Motions:
    """Poses of K rows in N frames, and the errors of their extrapolation."""

    position_lab_mm: Floats  # (K, N, 3)
    R_lab_body: Floats  # (K, N, 3, 3)
    time_s: Floats  # (N,)

    def away(self, frames: Ints, row: int, to_row: int, to: int) -> Floats:
        """Return the deviation, mm and rad, (2,), of a row's pose from its prediction by frames, nearest first."""
        t = self.time_s[frames] - self.time_s[frames[0]]
        scale = np.abs(t).max() or 1.0
        R0 = self.R_lab_body[row, frames[0]]
        turn = so3.log(torch.from_numpy(self.R_lab_body[row, frames] @ R0.T)).numpy()
        path = np.concatenate([self.position_lab_mm[row, frames], turn], axis=1)
        degree = min(ORDER, len(frames) - 1)
        powers = (t[:, None] / scale) ** np.arange(degree + 1)
        at = ((self.time_s[to] - self.time_s[frames[0]]) / scale) ** np.arange(degree + 1)
        there = at @ np.linalg.lstsq(powers, path, rcond=None)[0]
        R = so3.exp(torch.from_numpy(there[3:])) @ torch.from_numpy(R0)
        off = so3.geodesic_distance(R, torch.from_numpy(self.R_lab_body[to_row, to]))
        return np.array([np.linalg.norm(there[:3] - self.position_lab_mm[to_row, to]), float(off)])


def same_balls(
    position_lab_mm: Floats, R_lab_body: Floats, seen: Bools, time_s: Floats, breaks: Sequence[int]
) -> tuple[Ints, Floats]:
    """Return which row is which ball, (K, N), for each ball in each frame, and the probability that the ball has kept
    its name, (K, N), NaN where it was certain.
    Rows are cut into pieces where a row may have changed to another ball. Pieces are linked by the errors of
    extrapolating position and rotation of each to the other, over the errors of such extrapolations within pieces.

    Args:
        position_lab_mm: (K, N, 3), of K rows in N frames.
        R_lab_body: (K, N, 3, 3).
        seen: (K, N) bool, where the rows have a pose.
        time_s: (N,), s.
        breaks: frames before which all rows may have changed.
    """
    rows, frames = seen.shape
    motions = _Motions(position_lab_mm, R_lab_body, time_s)
    pieces = _unbroken(seen, breaks)
    scale = _scale(motions, pieces)
    pieces = [part for piece in pieces for part in _without_jumps(motions, piece, scale)]
    pieces.sort(key=lambda piece: (piece.first, piece.row))
    links = _links(motions, pieces, scale)
    after = _linked(len(pieces), links)
    sure = {end: _sure(end, after, links) for end in after}
    order = np.tile(np.arange(rows)[:, None], (1, frames))
    probability = np.ones((rows, frames))
    taken = np.zeros((rows, frames), bool)
    for start in sorted(set(range(len(pieces))) - set(after.values())):
        chain, likely, own = [start], [1.0], pieces[start].row
        while chain[-1] in after:
            likely.append(likely[-1] * sure[chain[-1]])
            chain.append(after[chain[-1]])
        spans = [slice(pieces[k].first, pieces[k].last) for k in chain]
        free = [ball for ball in range(rows) if not any(taken[ball, span].any() for span in spans)]
        free = free or [own]  # more pieces at a time than balls: the last one keeps its row
        ball = own if own in free else free[0]
        # A piece without predecessor may be any ball without successor.
        first = 1.0 if pieces[start].first == 0 or len(free) == 1 else 1.0 / len(free)
        for k, span, share in zip(chain, spans, likely, strict=True):
            order[ball, span], taken[ball, span] = pieces[k].row, True
            probability[ball, span] = first * share
    return _whole(order, taken), np.where(probability < CERTAIN, probability, np.nan)


def _whole(order: Ints, taken: Bools) -> Ints:
    """Return an order in which rows without a ball get the balls without a row."""
    for frame in np.flatnonzero(~taken.all(0)):
        balls = np.flatnonzero(~taken[:, frame])
        left = sorted(set(range(len(order))) - set(order[taken[:, frame], frame].tolist()))
        order[balls, frame] = left[: len(balls)]
    return order


def _unbroken(seen: Bools, breaks: Sequence[int]) -> list[_Piece]:
    """Return the pieces between breaks in which a row has poses."""
    spans = list(pairwise(sorted({0, *breaks, seen.shape[1]})))
    return [
        _Piece(row, first + a, first + b)
        for row, there in enumerate(seen)
        for first, last in spans
        for a, b in runs_of(there[first:last])
    ]


def _before(piece: _Piece, frame: int) -> Ints:
    return np.arange(frame - 1, max(piece.first, frame - FITTED) - 1, -1)


def _scale(motions: _Motions, pieces: Sequence[_Piece]) -> Floats:
    """Return gaps and the errors of extrapolations over them, per component, (n, 3): frames, mm, rad."""
    found = []
    for gap in (2**k for k in range(FARTHEST.bit_length())):
        windows = [(piece, frame) for piece in pieces for frame in range(piece.first + FITTED, piece.last - gap + 1)]
        if not windows:
            break
        some = [windows[k] for k in np.unique(np.linspace(0, len(windows) - 1, SAMPLES).astype(int))]
        away = [motions.away(_before(piece, frame), piece.row, piece.row, frame - 1 + gap) for piece, frame in some]
        found.append([gap, *(np.percentile(away, SHARE, axis=0) / OF_CHI)])
    return np.array(found) if found else np.array([[1.0, np.inf, np.inf]])


def _error(scale: Floats, gap: int) -> Floats:
    """Return the error of an extrapolation over a gap, (2,): mm and rad; quadratic beyond the known gaps."""
    at = min(gap, scale[-1, 0])
    known = np.array([np.exp(np.interp(np.log(at), np.log(scale[:, 0]), np.log(part))) for part in scale[:, 1:].T])
    return np.asarray(known * (gap / at) ** 2)


def _without_jumps(motions: _Motions, piece: _Piece, scale: Floats) -> Iterator[_Piece]:
    """Yield the parts of a piece between jumps."""
    first = piece.first
    for frame in range(piece.first + FITTED, piece.last):
        if frame - first < FITTED:
            continue
        away = motions.away(_before(_Piece(piece.row, first, frame), frame), piece.row, piece.row, frame)
        if (away > JUMP * _error(scale, 1)).any():
            yield _Piece(piece.row, first, frame)
            first = frame
    yield _Piece(piece.row, first, piece.last)


def _links(motions: _Motions, pieces: Sequence[_Piece], scale: Floats) -> dict[tuple[int, int], float]:
    """Return chi2 of each pair of pieces in which one may follow the other."""
    links = {}
    for j, later in enumerate(pieces):
        ahead = np.arange(later.first, min(later.last, later.first + FITTED))
        for i, early in enumerate(pieces):
            gap = later.first - early.last + 1
            if not 0 < gap <= FARTHEST:
                continue
            onward = motions.away(_before(early, early.last), early.row, later.row, later.first)
            back = motions.away(ahead, later.row, early.row, early.last - 1)
            links[i, j] = float(np.mean([((off / _error(scale, gap)) ** 2).sum() for off in (onward, back)]))
    return links


def _linked(count: int, links: dict[tuple[int, int], float]) -> dict[int, int]:
    """Return the successor of each piece that has one: the assignment with the least sum of chi2."""
    ends, begins = np.array(list(links), dtype=np.int64).reshape(-1, 2).T
    every = np.arange(count)
    # Pieces without successor or predecessor are linked to dummy places.
    row = np.concatenate([ends, every, count + every, count + begins])
    column = np.concatenate([begins, count + every, every, count + ends])
    tiny = 1e-9  # 0 means no link
    chi2 = np.minimum(np.array(list(links.values())), 1e9) + tiny
    weight = np.concatenate([chi2, np.full(2 * count, NO_LINK / 2), np.full(len(links), tiny)])
    matrix = coo_array((weight, (row, column)), shape=(2 * count, 2 * count)).tocsr()
    chosen = zip(*min_weight_full_bipartite_matching(matrix), strict=True)
    return {int(i): int(j) for i, j in chosen if i < count and j < count}


def _sure(end: int, after: dict[int, int], links: dict[tuple[int, int], float]) -> float:
    """Return the probability of a link among the exchanges with one other link."""
    begin, odds = after[end], 0.0
    for other_end, other_begin in after.items():
        exchanged = [links.get(pair) for pair in ((end, other_begin), (other_end, begin))]
        if other_end != end and exchanged[0] is not None and exchanged[1] is not None:
            more = exchanged[0] + exchanged[1] - links[end, begin] - links[other_end, other_begin]
            odds += np.exp(-0.5 * min(max(more, -100.0), 200.0))
    return 1.0 / (1.0 + odds)
