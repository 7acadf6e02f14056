"""Pairs of samples of one segment that lie a lag apart; gaps are honoured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.segments import Ensemble

Rows = NDArray[np.int64]


class Pairs:
    """Finds pairs of rows; made once for an ensemble, asked for many lags."""

    def __init__(self, ensemble: Ensemble) -> None:
        """Give every frame between a segment's first and last a place, empty where there is no sample."""
        frames = np.maximum.reduceat(ensemble.frame, ensemble.starts[:-1]) + 1
        self.longest = int(frames.max()) - 1  # lag, frames
        begin = np.concatenate([[0], np.cumsum(frames)[:-1]])
        self._segment = ensemble.segment
        self._place = begin[ensemble.segment] + ensemble.frame
        self._row = np.full(int(frames.sum()) + self.longest, -1, dtype=np.int64)
        self._row[self._place] = np.arange(len(self._place))

    def at(self, lag: int) -> tuple[Rows, Rows]:
        """Return the rows of all pairs (earlier, later) that are `lag` frames apart, sorted by segment."""
        if lag > self.longest:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        later = self._row[self._place + lag]
        there = (later >= 0) & (self._segment[later] == self._segment)
        return np.flatnonzero(there), later[there]
