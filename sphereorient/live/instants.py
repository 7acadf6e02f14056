"""Groups the pictures of several cameras by instant, by time stamps of their devices."""

import math
import statistics
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.live.feed import Arrival, Log, Picture

JOINING, SURE = 16, 256  # pictures after which a camera is synchronised; after which it is in any case
NEAR = 0.25  # of the shortest recent interval: pictures of one instant are nearer
SHORTEST = 4  # agreeing delays of a camera: these pictures were not held up
DRIFT = 1e-4  # largest, between two devices' clocks
FOLLOW = 0.125  # share of the drift applied per instant, since stamps scatter
LATE_S = 0.01, 0.1  # limits of the wait for the last picture, one usual interval
SILENT = 3  # usual intervals without a picture after which no instant waits for the camera
SILENT_S = 1.0  # at least, after which another camera gives the time
JUMP_S = 1.0  # a clock that goes back further was reset
LOG_EVERY_S = 10.0  # between notes on missing pictures


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPicture:
    """A picture from a device."""

    picture: Picture | None  # None: incomplete
    arrived_s: float  # by the clock of time.perf_counter
    stamp_s: float | None = None  # by the device's clock, from any zero; None: no clock
    counter: int | None = None  # of all pictures taken by the device; None: no counter


@dataclass(eq=False)
class _Clock:
    """Clock and counter of a device, and its offset to the common time."""

    name: str
    offset_s: float | None = None  # stamp + offset is the common time; None: not synchronised
    counter: int | None = None
    last: int = 0  # of the finished instants, the last with a picture of it
    stamps: deque[float] = field(default_factory=lambda: deque(maxlen=SURE))
    lags: deque[float] = field(default_factory=lambda: deque(maxlen=SURE))  # arrival - stamp

    def forget(self) -> None:
        self.offset_s = self.counter = None
        self.stamps.clear()
        self.lags.clear()


@dataclass(eq=False)
class _Instant:
    time_s: float
    arrived_s: float  # of its first picture
    pictures: list[Picture | None]
    steps: dict[int, int] = field(default_factory=dict)  # of the counters of cameras with a picture


class Instants:
    """Groups the pictures of several cameras by instant. The first camera gives the time; another is synchronised by
    the shortest delays of its first 16 pictures, then by its time stamps and the drift of its clock. A missing, late or
    incomplete picture is None; `log` gets the counts.
    """

    def __init__(self, names: Sequence[str], log: Log) -> None:
        self._clocks = [_Clock(name) for name in names]
        self._log, self._begun_s = log, math.nan  # arrival of the first picture
        self._steps: deque[float] = deque(maxlen=32)  # between pictures of a camera
        self._open: list[_Instant] = []  # in order of time
        self._times: deque[float] = deque(maxlen=2 * JOINING)  # of finished instants
        self._number, self._count = -1, 0  # of the last instant, lost ones included; of finished instants
        self._lacks, self._logged, self._log_s = Counter[str](), 0, -math.inf

    @property
    def _usual_s(self) -> float:
        return statistics.median(self._steps) if len(self._steps) >= 8 else min(self._steps, default=0.0)

    def restart(self, camera: int) -> None:
        """Forget a camera's clock: its device was opened."""
        self._clocks[camera].forget()

    def take(self, camera: int, shot: RawPicture) -> None:
        """Take a picture of a camera. Raises MovieError: several cameras, and this device has no clock."""
        clock, several = self._clocks[camera], len(self._clocks) > 1
        if several and shot.stamp_s is None:
            self._lacks[untimed := f"{clock.name} without a time stamp"] += 1
            if self._lacks[untimed] > 1:  # a clock may begin at 0, which for others means none
                do = "choose one camera with --cameras"
                raise MovieError(refusal(clock.name, expected="time stamps of the device", got="none", do=do))
            return
        stamp_s = shot.arrived_s if shot.stamp_s is None else shot.stamp_s
        near_s = NEAR * min(self._steps, default=0.0) if several else 0.0
        step = 1 if shot.counter is None or clock.counter is None else max(1, shot.counter - clock.counter)
        clock.counter = shot.counter
        if clock.stamps:
            step_s = stamp_s - clock.stamps[-1]
            if -JUMP_S <= step_s <= near_s:
                self._lacks[f"{clock.name} doubled"] += 1
                return
            if step_s < 0 or step_s * DRIFT > near_s > 0:
                clock.forget()  # its drift is unknown
            else:
                self._steps.append(step_s)
        clock.stamps.append(stamp_s)
        clock.lags.append(shot.arrived_s - stamp_s)
        self._begun_s = shot.arrived_s if math.isnan(self._begun_s) else self._begun_s
        in_step = clock.offset_s is not None
        clock.offset_s = clock.offset_s if in_step else self._offset_s(clock)
        if clock.offset_s is None:
            return
        if self._times and stamp_s + clock.offset_s < self._times[-1] + near_s:
            self._lacks[f"{clock.name} late"] += in_step
            return
        self._put(camera, stamp_s + clock.offset_s, shot, step, near_s)

    def _offset_s(self, clock: _Clock) -> float | None:
        """Return stamp + offset by the shortest delays, then by the nearest instants; None: not known yet."""
        since_s = clock.stamps[-1] + clock.lags[-1] - max(SILENT_S, SILENT * self._usual_s)
        in_step = [one for one in self._clocks if one.offset_s is not None]
        lead = next((one for one in in_step if one.stamps[-1] + one.lags[-1] > since_s), None)
        if lead is None or lead.offset_s is None:
            for one in in_step:  # they have stopped
                one.forget()
            return clock.lags[-1] - self._begun_s
        if len(clock.lags) % JOINING or len(lead.lags) < SHORTEST:
            return None
        own, of_lead = (np.sort(one.lags)[:SHORTEST] for one in (clock, lead))
        offset_s = float(lead.offset_s + own[0] - of_lead[0])
        times = np.array([*self._times, *(one.time_s for one in self._open)])
        away = times[None] - (np.array(clock.stamps)[-JOINING:, None] + offset_s)
        nearest = np.take_along_axis(away, abs(away).argmin(1)[:, None], 1)
        middle, within_s = float(np.median(nearest)), NEAR * self._usual_s
        agree = max(np.ptp(own), np.ptp(of_lead), 2 * np.median(abs(nearest - middle))) < within_s
        return offset_s + middle if agree and (abs(middle) < within_s or len(clock.lags) == SURE) else None

    def _put(self, camera: int, time_s: float, shot: RawPicture, step: int, near_s: float) -> None:
        clock = self._clocks[camera]
        found = next((one for one in self._open if abs(one.time_s - time_s) < near_s), None)
        if found is None:
            found = _Instant(time_s, shot.arrived_s, [None] * len(self._clocks))
            self._open = sorted([*self._open, found], key=lambda one: one.time_s)
        elif clock.offset_s is not None:
            clock.offset_s += FOLLOW * (found.time_s - time_s)
        found.pictures[camera], found.steps[camera] = shot.picture, step
        self._lacks[f"{clock.name} incomplete"] += shot.picture is None

    @property
    def due_s(self) -> float:
        """Time at which the next instant stops waiting, by the clock of time.perf_counter."""
        return self._open[0].arrived_s + min(max(self._usual_s, LATE_S[0]), LATE_S[1]) if self._open else math.inf

    def ready(self, now_s: float) -> Iterator[Arrival]:
        """Yield the instants that no longer wait, in order."""
        while self._open and (self.due_s <= now_s or not self._awaited(self._open[0])):
            yield self._arrival(self._open.pop(0))
        if now_s > self._log_s and (count := self._lacks.total()) > self._logged:
            self._logged, self._log_s = count, now_s + LOG_EVERY_S
            lacks = ", ".join(f"{what} {count}" for what, count in self._lacks.items() if count)
            self._log(f"pictures unused or missing so far: {lacks}; tracking goes on without them.")

    def _awaited(self, instant: _Instant) -> bool:
        """Return whether a camera's picture of an instant may still come."""
        earliest_s = instant.time_s - SILENT * self._usual_s
        return any(
            clock.offset_s is not None and earliest_s < clock.stamps[-1] + clock.offset_s < instant.time_s
            for camera, clock in enumerate(self._clocks)
            if camera not in instant.steps
        )

    def _arrival(self, instant: _Instant) -> Arrival:
        self._count += 1
        # By all: an instant that another camera has was not lost.
        lost = max(0, min(step - (self._count - self._clocks[k].last) for k, step in instant.steps.items()))
        for camera in instant.steps:
            self._clocks[camera].last = self._count
        for camera, clock in enumerate(self._clocks):
            missing = camera not in instant.steps and clock.offset_s is not None
            self._lacks[f"{clock.name} missing"] += lost + missing
        self._number += 1 + lost
        self._times.append(instant.time_s)
        pictures, arrived_s = instant.pictures, instant.arrived_s
        return Arrival(number=self._number, time_s=instant.time_s, pictures=pictures, arrived_s=arrived_s)
