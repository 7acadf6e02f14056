"""What the loop of `live` counts and keeps of its frames, for the summary and the page."""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event

import numpy as np
from numpy.typing import NDArray

from sphereorient.live.feed import Arrival, Feed, Tell
from sphereorient.live.live import Measured

KEPT = 1000  # latencies
LOST_S = 0.5  # without a pose: then it is told
MOST_STEPS = 20_000  # of the path
PATH, HEADING = slice(14, 16), 16  # places in FicTrac's columns


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """The newest frame."""

    arrival: Arrival
    now: Measured
    heading_rad: float


class Monitor:
    """Hands on the frames of a feed, waiting while it is stopped, and takes what was measured: a few references."""

    def __init__(self, feed: Feed, tell: Tell = lambda line: None) -> None:
        self.count = self.lost = 0
        self.newest: Seen | None = None
        self.latency_ms: deque[float] = deque(maxlen=KEPT)
        self.told_s: deque[float] = deque(maxlen=KEPT)  # when a frame was measured, by the clock of time.perf_counter
        self.path: deque[tuple[float, float]] = deque(maxlen=MOST_STEPS)
        self.running = Event()
        self.running.set()
        self._feed, self._tell = feed, tell
        self._lost_s: float | None = None  # since when, of the source, the ball is not found
        self._told = False
        self._arrival: Arrival | None = None

    @property
    def dropped(self) -> int:
        """Frames that came too late."""
        return self._feed.dropped

    def __iter__(self) -> Iterator[Arrival]:
        for arrival in self._feed:
            self.running.wait()
            self._arrival = arrival
            yield arrival

    def saw(self, now: Measured, columns: NDArray[np.float64] | None) -> None:
        """Take what was measured of the last frame, with FicTrac's columns (25,) where they are known."""
        assert self._arrival is not None  # it was yielded before
        self.count, self.lost = self.count + 1, self.lost + (not now.valid)
        self.latency_ms.append(1e3 * now.latency_s)
        self.told_s.append(time.perf_counter())
        self._watch(now)
        heading_rad = float("nan")
        if columns is not None:
            x, y = columns[PATH].tolist()
            self.path.append((x, y))
            heading_rad = float(columns[HEADING])
        self.newest = Seen(arrival=self._arrival, now=now, heading_rad=heading_rad)

    def _watch(self, now: Measured) -> None:
        """Tell a ball that is not found for a while, and that it is found again."""
        if now.valid:
            if self._told:
                self._tell(f"frame {now.number}: the ball is found again.")
            self._lost_s, self._told = None, False
            return
        self._lost_s = now.time_s if self._lost_s is None else self._lost_s
        if not self._told and now.time_s - self._lost_s >= LOST_S:
            why = ", ".join(sorted({str(reason) for reason in now.reason}))
            hint = "it is hidden, or this is another ball or the map of another one"
            self._tell(f"frame {now.number}: the ball is not found for {LOST_S:g} s ({why}): {hint}; tracking goes on.")
            self._told = True

    def summary(self) -> list[str]:
        """Return the counts and latencies in words."""
        latency = np.array(self.latency_ms or [0.0])
        middle, slow = np.quantile(latency, (0.5, 0.99))
        return [
            f"{self.count} frames, {self.lost} without a pose, {self.dropped} dropped",
            f"latency of the last {len(latency)}: {middle:.1f} ms (median), {slow:.1f} ms (99 %)",
        ]
