"""Delay of live tracking: from a picture in memory to the line on a socket, through two programs."""

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import SphereOrientError, refusal
from sphereorient.experiment.recording import Progress, open_recording, silent
from sphereorient.live.feed import movie_frames
from sphereorient.live.outputs import HOST
from sphereorient.live.shared import SharedFrames

BEGIN_S = 120.0  # until the tracker's first line
QUIET_S = 2.0  # without a line: the end
FIRST = 50  # lines that do not count: caches fill
TIME, NUMBER = 22, 1  # places in FicTrac's line: time of the frame, ms; its number


@dataclass(frozen=True, kw_only=True, eq=False)
class Delays:
    """What came of the frames that were written."""

    written: int
    delay_s: NDArray[np.float64]  # (n,), of the lines that came, in order
    lost: int  # of these, lines without a pose

    def at(self, share: float) -> float:
        """Return the delay, s, that this share of the lines keeps."""
        return float(np.quantile(self.delay_s, share)) if len(self.delay_s) else float("nan")


def delays(
    experiment: Path,
    rate_hz: float,
    seconds: float,
    options: Sequence[str] = (),
    cameras: Sequence[str] | None = None,
    progress: Progress = silent,
) -> Delays:
    """Write an experiment's pictures, there and back again, into memory at a rate, and time the lines of `live`.

    Raises:
        SphereOrientError: the tracker ends before its first line; or as `open_recording` does.
    """
    with open_recording(experiment, cameras) as recording:
        pictures = [one.pictures for one in movie_frames(recording, paced=False)]
    size = sum(picture.nbytes for picture in pictures[0] if picture is not None)
    order = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lines:
        lines.bind((HOST, 0))
        lines.settimeout(QUIET_S)
        path, ended, begun = Path(folder) / "ring", Event(), Event()
        words = ["live", str(experiment), "--source", f"shared:{path}", "--to", f"udp:{lines.getsockname()[1]}", "-q"]
        named = [word for name in cameras or () for word in ("--cameras", name)]

        def write(ring: SharedFrames) -> None:
            first_s, number, left = time.perf_counter(), 0, FIRST + round(seconds * rate_hz)
            while left > 0 and not ended.is_set():
                row = pictures[order[number % len(order)]]
                ring.write(time.perf_counter(), [part for part in row if part is not None])
                number, left = number + 1, left - begun.is_set()
                time.sleep(max(0.0, first_s + number / rate_hz - time.perf_counter()))

        with SharedFrames(path, size) as ring:
            command = [sys.executable, "-m", "sphereorient.cli", *words, *named, *options]
            tracker = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
            writer = Thread(target=write, args=(ring,), daemon=True)
            writer.start()
            try:
                found = _received(lines, tracker, begun, progress)
            finally:
                ended.set()
                writer.join()
        if tracker.wait(BEGIN_S) and not len(found):
            said = (tracker.stderr.read() if tracker.stderr else "").strip().splitlines()
            got = said[-1] if said else f"status {tracker.returncode}"
            raise SphereOrientError(refusal("live", expected="a line a frame", got=got, do="correct that"))
    table = np.array(found).reshape(-1, 3)[FIRST:]
    count = int(table[-1, 0] - table[0, 0]) + 1 if len(table) else 0
    return Delays(written=count, delay_s=table[:, 1], lost=int(table[:, 2].sum()))


def _received(
    lines: socket.socket, tracker: "subprocess.Popen[str]", begun: Event, progress: Progress
) -> list[tuple[float, float, float]]:
    """Return number, delay (s) and whether there is no pose, of each line until none comes any more."""
    found: list[tuple[float, float, float]] = []
    begin = time.monotonic()
    while True:
        try:
            parts = lines.recv(4096).decode().split(", ")
        except TimeoutError:
            if found or tracker.poll() is not None or time.monotonic() - begin > BEGIN_S:
                return found
            continue
        now = time.perf_counter()
        begun.set()
        found.append((float(parts[NUMBER]), now - float(parts[TIME]) / 1e3, float(parts[2] == "nan")))
        progress("live", len(found), len(found))
