"""What the loop of `live` counts and keeps of its frames, for the summary and the page."""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event

import numpy as np
from numpy.typing import NDArray

from sphereorient.live.feed import Arrival, Feed
from sphereorient.live.live import Measured

KEPT = 1000  # latencies
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

    def __init__(self, feed: Feed) -> None:
        self.count = self.lost = 0
        self.newest: Seen | None = None
        self.latency_ms: deque[float] = deque(maxlen=KEPT)
        self.told_s: deque[float] = deque(maxlen=KEPT)  # when a frame was measured, by the clock of time.perf_counter
        self.path: deque[tuple[float, float]] = deque(maxlen=MOST_STEPS)
        self.running = Event()
        self.running.set()
        self._feed = feed
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
        heading_rad = float("nan")
        if columns is not None:
            x, y = columns[PATH].tolist()
            self.path.append((x, y))
            heading_rad = float(columns[HEADING])
        self.newest = Seen(arrival=self._arrival, now=now, heading_rad=heading_rad)

    def summary(self) -> list[str]:
        """Return the counts and latencies in words."""
        latency = np.array(self.latency_ms or [0.0])
        middle, slow = np.quantile(latency, (0.5, 0.99))
        return [
            f"{self.count} frames, {self.lost} without a pose, {self.dropped} dropped",
            f"latency of the last {len(latency)}: {middle:.1f} ms (median), {slow:.1f} ms (99 %)",
        ]
