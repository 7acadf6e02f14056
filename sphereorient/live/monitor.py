"""What the loop of `live` counts and keeps of its frames, for the summary and the page."""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Reason
from sphereorient.live.feed import Arrival, Feed, Tell
from sphereorient.live.live import Measured
from sphereorient.trajectory.walk import FICTRAC

KEPT = 1000  # latencies
LOST_S = 0.5  # without a pose: then it is told
CONFIRMED = 2  # poses in a row: one alone may be a chance match
MOSTLY = 0.8  # of all frames without a pose: the ball was not explained before
MOST_STEPS = 20_000  # of the path
# Likely causes of a ball that is not found, by the reason that says most.
CAUSES = {
    Reason.LOW_SCORE: "its outline is seen, but no orientation explains its paint: it is partly hidden, the light or "
    "the focus has changed, or this is another ball",
    Reason.OUTLINE: "something is seen, but no outline of the ball's size: it is partly hidden, or sphere.diameter or "
    "the place of the camera is wrong",
    Reason.NOT_FOUND: "nothing of its size stands out from the empty scene: it is hidden or gone",
    Reason.UNSEEN: "it shows paint that the map does not know",
    Reason.CONTRADICTS: "the cameras contradict each other: their pictures are of different times, or one was moved",
    Reason.DARK: "the picture is dark: the lamp is off, or something covers the lens",
    Reason.SATURATED: "the picture is white: less light, or a shorter exposure",
    Reason.REPEATED: "the camera sends the same picture again",
}
NOT_EXPLAINED = (
    "its outline is seen, but no orientation explains its paint: this is another ball, or the map of another one, or "
    "light or focus are others than when they were studied"
)


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
        self._lost: tuple[float, Measured] | None = None  # since when, of the source, and the last frame without a pose
        self._told = False
        self._in_a_row = 0  # frames with a pose
        self._arrival: Arrival | None = None

    @property
    def dropped(self) -> int:
        """Frames that came too late."""
        return self._feed.dropped

    def __iter__(self) -> Iterator[Arrival]:
        for arrival in self._feed:
            self.running.wait()
            self._tell_lost(max(arrival.time_s, self._feed.newest_s))  # before this one is searched: that takes long
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
            x, y = columns[FICTRAC["path"]].tolist()
            self.path.append((x, y))
            heading_rad = float(columns[FICTRAC["heading"]][0])
        self.newest = Seen(arrival=self._arrival, now=now, heading_rad=heading_rad)

    def _watch(self, now: Measured) -> None:
        """Tell a ball that is not found for a while, and that it is found again."""
        self._in_a_row = self._in_a_row + 1 if now.valid else 0
        if now.valid:
            if self._in_a_row >= CONFIRMED:
                if self._told:
                    self._tell(f"frame {now.number}: the ball is found again.")
                self._lost, self._told = None, False
            return
        self._lost = now.time_s if self._lost is None else self._lost[0], now
        self._tell_lost(now.time_s)

    def _tell_lost(self, time_s: float) -> None:
        """Tell a ball that is not found for a while at a time of the source, once, with the likely cause."""
        if self._lost is None or self._told or time_s - self._lost[0] < LOST_S:
            return
        now, self._told = self._lost[1], True
        why = ", ".join(sorted({str(reason) for reason in now.reason}))
        cause = next((words for reason, words in CAUSES.items() if reason in now.reason), "no picture can be used")
        if Reason.LOW_SCORE in now.reason and self.lost > MOSTLY * self.count:
            cause = NOT_EXPLAINED
        self._tell(f"frame {now.number}: the ball is not found for {LOST_S:g} s ({why}): {cause}; tracking goes on.")

    def summary(self) -> list[str]:
        """Return the counts and latencies in words."""
        latency = np.array(self.latency_ms or [0.0])
        middle, slow = np.quantile(latency, (0.5, 0.99))
        return [
            f"{self.count} frames, {self.lost} without a pose, {self.dropped} dropped",
            f"latency of the last {len(latency)}: {middle:.1f} ms (median), {slow:.1f} ms (99 %)",
        ]
