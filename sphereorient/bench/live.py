"""Latency and error of live tracking, from a picture in memory to the line on a socket, between two programs."""

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread

import numpy as np
import psutil
from numpy.typing import NDArray

from sphereorient.bench.score import Floats, orientations_at
from sphereorient.errors import SphereOrientError, refusal
from sphereorient.experiment.recording import open_recording
from sphereorient.files.page_server import HOST
from sphereorient.files.threads import Progress, silent
from sphereorient.live.shared import SharedFrames
from sphereorient.live.sources import movie_frames
from sphereorient.trajectory.rotations import distance_deg, rotations
from sphereorient.trajectory.walk import FICTRAC

BEGIN_S = 120.0  # for the tracker's first line
QUIET_S = 2.0  # without a line, until the end
FIRST = 50  # lines left out, while caches fill
RIGHT_DEG = 1.0  # largest error of a right rotation
EVERY = 1000  # lines between measurements of memory
DARK_EVERY_S, DARK_S, STALL_S = 5.0, 0.5, 1.0  # of faults: black pictures, and one stop of the tracker
# Blurs and compresses pictures on one core until its parent ends, like a program that records another camera.
NEIGHBOUR = """
import os, sys, cv2, numpy
cv2.setNumThreads(1)
picture = numpy.random.default_rng(0).integers(0, 255, (1024, 1280), "uint8")
while os.getppid() == int(sys.argv[1]):
    cv2.imencode(".jpg", cv2.GaussianBlur(picture, (0, 0), 2))
"""


@dataclass(frozen=True, kw_only=True)
class LiveTiming:
    """Rate and duration of the pictures, and options of `live`."""

    experiment: Path
    rate_hz: float
    seconds: float
    options: Sequence[str] = ()
    cameras: Sequence[str] | None = None
    loop: bool = False  # restart the movie at its end; else play it forwards and backwards
    faults: bool = False  # half a second of black pictures every 5 s, and one stop of the tracker for a second

    @property
    def frames(self) -> int:
        """Number of frames in use."""
        return round(self.seconds * self.rate_hz)

    def dark(self, number: int) -> bool:
        """Return whether a picture is black."""
        return self.faults and number / self.rate_hz % DARK_EVERY_S >= DARK_EVERY_S - DARK_S

    def command(self, ring: Path, port: int) -> list[str]:
        """Return the command that tracks the pictures of a ring and sends lines to a port."""
        words = ["live", str(self.experiment), "--source", f"shared:{ring}", "--to", f"udp:{port}", "-q"]
        named = [] if self.cameras is None else ["--cameras", ",".join(self.cameras)]
        return [sys.executable, "-m", "sphereorient.cli", *words, *named, *self.options]


@dataclass(frozen=True, kw_only=True, eq=False)
class Delays:
    """Results of the written frames."""

    written: int
    delay_s: Floats  # (n,), of the received lines, in order
    lost: int  # lines without a pose
    error_deg: Floats  # (n,), of the rotation since the start of the stretch; NaN without pose or truth
    memory_mb: Floats  # of the tracker, each `EVERY` lines
    back_s: Floats  # (m,), from the end of each fault to the first right pose; inf: none
    wrong: int  # wrong poses

    def delays_ms(self) -> list[str]:
        """Return the 50, 99 and 99.9 % quantiles of the latency, ms, as text."""
        shares = (0.5, 0.99, 0.999)
        return [f"{1e3 * np.quantile(self.delay_s, share):.1f}" if len(self.delay_s) else "nan" for share in shares]

    def row(self) -> list[str]:
        """Return the values of `COLUMNS`."""
        counts = [self.written, self.written - len(self.delay_s), self.lost]
        known = np.isfinite(self.error_deg).any()
        error = f"{np.nanmedian(self.error_deg):.3f}, {np.nanmax(self.error_deg):.3f}" if known else ""
        memory = f"{self.memory_mb[-1]:.0f}" if len(self.memory_mb) else ""
        return [*map(str, counts), *self.delays_ms(), error, memory]

    def summary(self) -> list[str]:
        """Return the results as text."""
        came = len(self.delay_s)
        middle, slow, slowest = self.delays_ms()
        words = [f"{came} lines of {self.written} frames, {self.written - came} dropped, {self.lost} without a pose"]
        words.append(f"delay: {middle} ms (median), {slow} ms (99 %), {slowest} ms (99.9 %)")
        if np.isfinite(self.error_deg).any():
            first, *_, last = (float(np.nanmedian(part)) for part in np.array_split(self.error_deg, 10))
            worst = float(np.nanmax(self.error_deg))
            said = f"{first:.3f}° in the first tenth (median), {last:.3f}° in the last, {worst:.3f}° at most"
            words.append(f"error of the rotation since the first frame: {said}")
            right = 100 * float((self.error_deg < RIGHT_DEG).sum()) / max(self.written, 1)
            words.append(f"right to {RIGHT_DEG:g}°: {right:.1f} % of the frames that were written")
            words.append(f"wrong: {self.wrong} poses")
        if len(self.back_s):
            back = f"{1e3 * np.median(self.back_s):.0f} ms (median), {1e3 * self.back_s.max():.0f} ms at most"
            words.append(f"right again after {len(self.back_s)} faults: {back}")
        if len(self.memory_mb):
            first, last = self.memory_mb[0], self.memory_mb[-1]
            words.append(f"memory of the tracker: {first:.0f} MB at first, {last:.0f} MB at the end")
        return words


COLUMNS = ("frames", "dropped", "no pose", "median (ms)", "99 %", "99.9 %", "error (\u00b0): median, largest", "MB")


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """Keep this many cores busy with other programs."""
    command = [sys.executable, "-c", NEIGHBOUR, str(os.getpid())]
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


class _Writer(Thread):
    """Writes pictures repeatedly into a ring at a rate, until a time after the first line."""

    def __init__(self, ring: SharedFrames, pictures: Sequence[Sequence[NDArray[np.generic]]], timing: LiveTiming):
        super().__init__(daemon=True)
        self.written_s: list[float] = []  # by the clock of time.perf_counter
        self.begun, self.ended = Event(), Event()
        self._ring, self._pictures, self._timing = ring, pictures, timing
        self._black = [np.zeros_like(picture) for picture in pictures[0]]

    def run(self) -> None:
        rate_hz, pictures = self._timing.rate_hz, self._pictures
        first_s, number, left = time.perf_counter(), 0, FIRST + self._timing.frames
        while left > 0 and not self.ended.is_set():
            self.written_s.append(time.perf_counter())
            shown = self._black if self._timing.dark(number) else pictures[number % len(pictures)]
            # The time by an ideal camera's clock; this program may be late.
            self._ring.write(first_s + number / rate_hz, shown)
            number, left = number + 1, left - self.begun.is_set()
            time.sleep(max(0.0, first_s + number / rate_hz - time.perf_counter()))


def delays(timing: LiveTiming, progress: Progress = silent) -> Delays:
    """Write an experiment's pictures into memory at a rate, and time the lines of `live`; errors by a truth.h5 beside
    it. Raises SphereOrientError: the tracker ends before its first line; or as `open_recording`.
    """
    with open_recording(timing.experiment, timing.cameras) as recording:
        pictures = [[part for part in one.pictures if part is not None] for one in movie_frames(recording, paced=False)]
        R_cam_lab = recording.streams[0].camera.R_cam_lab.numpy()
    order = [*range(len(pictures)), *(() if timing.loop else range(len(pictures) - 2, 0, -1))]
    memory_mb: list[float] = []
    ends_s: list[float] = []  # of faults
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lines:
        lines.bind((HOST, 0))
        lines.settimeout(QUIET_S)
        path = Path(folder) / "ring"
        with SharedFrames(path, sum(picture.nbytes for picture in pictures[0])) as ring:
            command = timing.command(path, lines.getsockname()[1])
            tracker = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
            process = psutil.Process(tracker.pid)
            writer = _Writer(ring, [pictures[k] for k in order], timing)
            writer.start()

            def saw(count: int) -> None:
                writer.begun.set()
                if count % EVERY == 0:
                    with suppress(psutil.Error):  # it has ended
                        memory_mb.append(process.memory_info().rss / 2**20)
                if timing.faults and count == timing.frames // 2:
                    Thread(target=_stall, args=(process, ends_s), daemon=True).start()
                progress("live", count, timing.frames)

            try:
                table = _received(lines, tracker, saw)
            finally:
                writer.ended.set()
                writer.join()
        if tracker.wait(BEGIN_S) and not len(table):
            said = (tracker.stderr.read() if tracker.stderr else "").strip().splitlines()
            got = said[-1] if said else f"status {tracker.returncode}"
            raise SphereOrientError(refusal("live", expected="a line per frame", got=got, do="correct that"))
    error_deg = _errors_deg(table, order, R_cam_lab, timing.experiment.parent / "truth.h5")[FIRST:]
    number, came_s, *_ = table = table[FIRST:].T
    at, written_s = number.astype(int), np.array(writer.written_s)
    shown = [k for k in range(at[0], at[-1] + 1) if not timing.dark(k)] if len(at) else []
    lit = np.isin(at, shown)
    ends_s += [written_s[k] for k in shown if timing.dark(k - 1)]
    right_s = came_s[error_deg < RIGHT_DEG]
    return Delays(
        written=len(shown),
        delay_s=(came_s - written_s[at])[lit],
        lost=int(np.isnan(table[2][lit]).sum()),
        error_deg=error_deg,
        memory_mb=np.array(memory_mb),
        back_s=np.array([min((s - end_s for s in right_s if s > end_s), default=np.inf) for end_s in ends_s]),
        wrong=int((error_deg >= RIGHT_DEG).sum()),
    )


def _stall(tracker: psutil.Process, ends_s: list[float]) -> None:
    """Stop a process for a while, as a busy machine does, and record the end."""
    tracker.suspend()
    time.sleep(STALL_S)
    ends_s.append(time.perf_counter())
    tracker.resume()


def _received(lines: socket.socket, tracker: "subprocess.Popen[str]", saw: Callable[[int], None]) -> Floats:
    """Return (n, 6) of the lines: number, time (s), rotation (3) since the start of a stretch, rad, camera axes; index
    in the stretch.
    """
    found: list[tuple[float, ...]] = []
    begin = time.monotonic()
    while True:
        try:
            parts = lines.recv(4096).decode().split(", ")
        except TimeoutError:
            if found or tracker.poll() is not None or time.monotonic() - begin > BEGIN_S:
                return np.array(found).reshape(-1, 6)
            continue
        now = time.perf_counter()
        row = list(map(float, parts[1:]))  # behind "FT"
        found.append((row[0], now, *row[FICTRAC["rotation_cam"]], *row[FICTRAC["sequence"]]))
        saw(len(found))


def _errors_deg(table: Floats, order: Sequence[int], R_cam_lab: Floats, truth: Path) -> Floats:
    """Return the error of the rotation since the start of the stretch, (n,), degrees; NaN: unknown."""
    if not truth.is_file() or not len(table):
        return np.full(len(table), np.nan)
    R = orientations_at(truth, np.array(order)[table[:, 0].astype(int) % len(order)])
    begins = np.maximum.accumulate(np.where(table[:, 5] == 0, np.arange(len(table)), 0))
    true = R_cam_lab @ R @ R[begins].transpose(0, 2, 1) @ R_cam_lab.T
    return distance_deg(rotations(table[:, 2:5]), true)
