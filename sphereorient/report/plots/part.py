"""Which part of a track is drawn, and where its lines break."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]

MOST_FRAMES = 2000  # more cannot be told apart on a page
GAP = 1.5  # typical steps: a longer one is a gap


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Frames of a track that are drawn; made by `shown_part`."""

    track: Trajectory  # these frames alone
    words: str  # which part it is; empty where it is the whole
    broken: NDArray[np.bool_]  # (n - 1,), whether no line may go from a frame to the next


def shown_part(track: Trajectory, most: int = MOST_FRAMES) -> Part:
    """Return what of a track is drawn: all of it, or of a long one the best part of its longest segment.

    Args:
        track: the track.
        most: frames that are drawn.
    """
    rows, words = np.arange(len(track)), ""
    if len(track) > most:
        rows = _longest(track)
        whole = len(rows)
        rows = rows[_best(track.valid[rows], most)]
        which = "the longest segment" if whole <= most else f"the best {most:,} frames of the longest segment"
        which = which if (track.segment >= 0).any() else "none of them in a segment"
        words = f"shown: frames {rows[0]:,} to {rows[-1]:,} of {len(track):,}, {which}"
    part = track.at(rows)
    return Part(track=part, words=words, broken=_broken(track, part))


def _longest(track: Trajectory) -> NDArray[np.int64]:
    """Return the rows of the longest segment; all rows where there is no segment."""
    inside = np.flatnonzero(track.segment >= 0)
    if not len(inside):
        return np.arange(len(track))
    labels, counts = np.unique(track.segment[inside], return_counts=True)
    return np.flatnonzero(track.segment == labels[counts.argmax()])


def _best(valid: NDArray[np.bool_], most: int) -> slice:
    """Return the window with the most valid frames, the first of equal ones."""
    if len(valid) <= most:
        return slice(None)
    total = np.concatenate([[0], np.cumsum(valid)])
    start = int((total[most:] - total[:-most]).argmax())
    return slice(start, start + most)


def _broken(track: Trajectory, part: Trajectory) -> NDArray[np.bool_]:
    steps = np.diff(track.time)
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    return np.asarray((np.diff(part.time) > GAP * typical) | (np.diff(part.segment) != 0))


def cut(values: Floats, broken: NDArray[np.bool_]) -> Floats:
    """Return values (N, ...) with a row of NaN put in after each place (N - 1,) where a line is to break."""
    return np.insert(values, np.flatnonzero(broken) + 1, np.nan, axis=0)
