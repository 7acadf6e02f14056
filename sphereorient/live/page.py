"""Frame counts of `live` for the summary, and its page in the browser. A separate process serves the page; the loop
writes poses, and some of the pictures, into shared memory.
"""

import base64
import json
import multiprocessing
import os
import shutil
import signal
import socket
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Lock, Thread
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import MovieError, OutputError, Reason, SphereOrientError, refusal
from sphereorient.experiment.recording import Recording, open_recording
from sphereorient.files.page_server import Answer, Json, PageServer, address, listen, new_token
from sphereorient.files.picture import eight_bits
from sphereorient.files.provenance import without_nan
from sphereorient.files.threads import limit_cores
from sphereorient.live.feed import Arrival, Feed, FrameBytes, Log
from sphereorient.live.lines import FicTracLines
from sphereorient.live.live import Measured
from sphereorient.live.shared import POSES, WORD, SharedFrames, SlotReader
from sphereorient.preflight.mark_masks import MaskMarking
from sphereorient.report.overlay_model import Path3D, axes_px, outline_px
from sphereorient.trajectory.walk import FICTRAC, FicTracAxes

KEPT = 1000  # latencies
LOST_S = 0.5  # without a pose before a note
CONFIRMED = 2  # poses in a row; a single one may be a chance match
MOSTLY = 0.8  # share of frames without a pose from which the ball counts as never explained
# Likely causes of a lost ball, by reason, the most specific first.
CAUSES = {
    Reason.LOW_SCORE: "its outline is found, but no orientation explains its paint: it is partly hidden, the light or "
    "the focus has changed, or this is another ball",
    Reason.OUTLINE: "a blob is found, but no outline of the ball's size: it is partly hidden, or sphere.diameter or "
    "the camera's position is wrong",
    Reason.NOT_FOUND: "nothing of its size differs from the empty scene: it is hidden or gone",
    Reason.UNSEEN: "it shows paint that the map lacks",
    Reason.CONTRADICTS: "the cameras contradict each other: their pictures differ in time, or one was moved",
    Reason.DARK: "the picture is dark: the lamp is off, or something covers the lens",
    Reason.SATURATED: "the picture is white: reduce the light or the exposure",
    Reason.REPEATED: "the camera sends the same picture again",
}
NOT_EXPLAINED = (
    "its outline is found, but no orientation explains its paint: this is another ball, or the map of another one, or "
    "light or focus have changed since they were learnt"
)
PAGE = Path(__file__).with_name("page.html")
WIDEST = 640  # px, of a sent picture
PICTURES_HZ = 30.0  # at most, for the page
TAKE_S = 0.1  # between polls for new poses
ROW = 5 + 3 + 9  # of a frame: number, time (s), latency (ms), dropped, error (rad), position (mm), R_lab_body
REASONS = list(Reason)


@dataclass(eq=False)
class _Absence:
    lost: tuple[float, Measured] | None = None  # time of the source, s, and the last frame without a pose
    logged: bool = False
    in_a_row: int = 0  # frames with a pose


class Monitor:
    """Yields the frames of a feed unless stopped, and counts them; a frame is lost if any ball is."""

    def __init__(self, feed: Feed, log: Log = lambda line: None) -> None:
        self.count = self.lost = 0
        self.latency_ms: deque[float] = deque(maxlen=KEPT)
        self.running = Event()
        self.running.set()
        self._feed, self._log = feed, log
        self._absence: defaultdict[str, _Absence] = defaultdict(_Absence)  # of each ball
        self._counted = self._counted_lost = -1  # numbers of the last frames
        self.arrival: Arrival  # the last frame

    def __iter__(self) -> Iterator[Arrival]:
        for arrival in self._feed:
            self.running.wait()
            for absence in self._absence.values():  # before the search in this frame, which takes long
                self._log_lost(absence, max(arrival.time_s, self._feed.newest_s))
            self.arrival = arrival
            yield arrival

    def saw(self, now: Measured) -> None:
        """Store the measurement of a ball in the last frame."""
        if now.number != self._counted:
            self.count, self._counted = self.count + 1, now.number
            self.latency_ms.append(1e3 * now.latency_s)
        if not now.valid and now.number != self._counted_lost:
            self.lost, self._counted_lost = self.lost + 1, now.number
        self._watch(self._absence[now.ball], now)

    def _watch(self, of: _Absence, now: Measured) -> None:
        of.in_a_row = of.in_a_row + 1 if now.valid else 0
        if now.valid:
            if of.in_a_row >= CONFIRMED:
                if of.logged:
                    self._log(f"frame {now.number}: {_called(now)} is found again.")
                of.lost, of.logged = None, False
            return
        of.lost = now.time_s if of.lost is None else of.lost[0], now
        self._log_lost(of, now.time_s)

    def _log_lost(self, of: _Absence, time_s: float) -> None:
        """Report once, with the likely cause, a ball that is lost for a while at a time of the source."""
        if of.lost is None or of.logged or time_s - of.lost[0] < LOST_S:
            return
        now, of.logged = of.lost[1], True
        why = ", ".join(sorted({str(reason) for reason in now.reason}))
        cause = next((words for reason, words in CAUSES.items() if reason in now.reason), "no picture is usable")
        if Reason.LOW_SCORE in now.reason and self.lost > MOSTLY * self.count:
            cause = NOT_EXPLAINED
        lost = f"{_called(now)} is not found for {LOST_S:g} s ({why})"
        self._log(f"frame {now.number}: {lost}: {cause}; tracking goes on.")

    def summary(self) -> list[str]:
        """Return counts and latencies as text."""
        latency = np.array(self.latency_ms or [0.0])
        middle, slow = np.quantile(latency, (0.5, 0.99))
        return [
            f"{self.count} frames, {self.lost} without a pose, {self._feed.dropped} dropped",
            f"latency of the last {len(latency)}: {middle:.1f} ms (median), {slow:.1f} ms (99 %)",
        ]


def _called(now: Measured) -> str:
    return f"ball {now.ball}" if now.ball else "the ball"


class PageWriter:
    """The loop's side of the page: copies a row per frame, and pictures at most at `PICTURES_HZ`, into rings in a
    folder, and executes commands. `log` gets a line when the page has ended.
    """

    def __init__(self, folder: Path, commands: Connection, log: Log) -> None:
        self.folder, self._commands, self._log = folder, commands, log
        self._closing, self._next_s = False, 0.0
        self._rings: tuple[SharedFrames, SharedFrames] | None = None

    def begin(self, recording: Recording, running: Event, save_map: Callable[[], str] | None) -> None:
        """Begin with a recording; the page sets `running`; `save_map` writes a learnt map (None: no button)."""
        poses = SharedFrames(self.folder / "poses", WORD * ROW, POSES)
        self._rings = poses, SharedFrames(self.folder / "pictures", _shown_bytes(recording), 4)
        self._blank = [np.zeros(stream.movie.frame_shape, stream.movie.dtype) for stream in recording.streams]
        self._learns = save_map is not None
        Thread(target=self._listen, args=(running, save_map), name="page", daemon=True).start()

    def saw(self, arrival: Arrival, now: Measured) -> None:
        """Take a frame and its measurement."""
        assert self._rings is not None  # it has begun
        numbers = [now.number, now.time_s, 1e3 * now.latency_s, now.dropped, now.error_rad]
        row = np.concatenate([numbers, now.position_lab_mm, now.R_lab_body.ravel()])
        now_s, (poses, pictures) = time.perf_counter(), self._rings
        poses.write(now_s, [row])
        if now_s >= self._next_s:
            self._next_s = now_s + 1 / PICTURES_HZ
            shown = [blank if one is None else one for one, blank in zip(arrival.pictures, self._blank, strict=True)]
            words = np.array([*map(REASONS.index, now.reason), self._learns], np.float64)
            pictures.write(now.time_s, [*shown, words, row])

    def _listen(self, running: Event, save_map: Callable[[], str] | None) -> None:
        with suppress(EOFError, OSError):
            while True:
                word = self._commands.recv_bytes().decode()
                try:
                    said = {"said": _obeyed(word, running, save_map)}
                except SphereOrientError as error:
                    said = {"error": str(error)}
                self._commands.send_bytes(json.dumps(said).encode())
        if not self._closing:
            running.set()  # else it could not be started again
            self._log("page: its process has ended; tracking goes on without the page.")

    def close(self) -> None:
        """Remove the rings."""
        self._closing = True
        for ring in self._rings or ():
            ring.close()


def _shown_bytes(recording: Recording) -> int:
    """Return the bytes of a slot: pictures, reason of each camera, whether a map is learnt, and a row."""
    return FrameBytes(recording.streams).size + WORD * (len(recording.streams) + 1 + ROW)


class PageProcess(PageWriter):
    """A page in the browser, served by a separate process; port 0: any free one. Raises OutputError: port in use."""

    def __init__(self, experiment: Path, cameras: Sequence[str] | None, port: int, log: Log) -> None:
        door, token = listen(port, "--page", OutputError), new_token()
        memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
        folder = Path(tempfile.mkdtemp(prefix="sphereorient-", dir=memory))
        spawn = multiprocessing.get_context("spawn")
        commands, theirs = spawn.Pipe()
        given = experiment, cameras, folder, token, door, theirs
        self.process = spawn.Process(target=_serve, args=given, name="page", daemon=True)
        self.process.start()
        self.address = address(door, token)
        door.close()
        theirs.close()
        super().__init__(folder, commands, log)

    def close(self) -> None:
        """End the process."""
        self._closing = True
        self.process.terminate()
        self.process.join()
        super().close()
        shutil.rmtree(self.folder, ignore_errors=True)


def _obeyed(word: str, running: Event, save_map: Callable[[], str] | None) -> str:
    if word == "start":
        running.set()
        return "Tracking goes on."
    if word == "stop":
        running.clear()
        return "Tracking is stopped."
    if save_map is None:
        do = "start without a map"
        raise OutputError(refusal("map", expected="one that is learnt live", got="none", do=do))
    return save_map()


def _serve(
    experiment: Path, cameras: Sequence[str] | None, folder: Path, token: str, door: socket.socket, commands: Connection
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tracking
    if hasattr(os, "nice"):
        os.nice(10)  # tracking has priority
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    limit_cores(1)
    # The loop opens the same files and reports their faults.
    with suppress(SphereOrientError), open_recording(experiment, cameras, textured=False) as recording:
        page = LivePage(recording, folder, commands)
        Thread(target=PageServer(page, door, token).serve_forever, name="page", daemon=True).start()
        page.follow()
    shutil.rmtree(folder, ignore_errors=True)  # if the loop was killed


class LivePage:
    """The page, in its process: reads the rings in a folder, and sends commands to the loop."""

    def __init__(self, recording: Recording, folder: Path, commands: Connection) -> None:
        self._recording, self._folder, self._commands = recording, folder, commands
        self._layout = FrameBytes(recording.streams)
        self._lines = FicTracLines(FicTracAxes.of_lab(next(iter(recording.cameras.values())).R_cam_lab.numpy()))
        self._rings: tuple[SlotReader, SlotReader] | None = None  # None: not begun yet
        self._replies: SimpleQueue[Json] = SimpleQueue()
        self._lock, self._asking, self._running = Lock(), Lock(), True
        self._count = self._lost = self._dropped = 0
        self._heading_rad = float("nan")
        self._latency_ms: deque[float] = deque(maxlen=KEPT)
        self._measured_s: deque[float] = deque(maxlen=KEPT)  # when a frame was measured
        self._path: deque[tuple[float, float]] = deque(maxlen=20_000)

    @cached_property
    def _setup(self) -> MaskMarking:
        return MaskMarking(self._recording.experiment.path)

    def follow(self) -> None:
        """Read poses and answers of the loop until its process ends."""
        with suppress(EOFError, OSError):
            while True:
                if self._commands.poll(TAKE_S):
                    self._replies.put(json.loads(self._commands.recv_bytes()))
                self.take()

    def take(self) -> None:
        """Read the new poses."""
        if self._rings is None:
            try:
                pictures = SlotReader(self._folder / "pictures", _shown_bytes(self._recording))
                self._rings = SlotReader(self._folder / "poses", WORD * ROW), pictures
            except MovieError:  # not begun yet
                return
        poses, _ = self._rings
        with self._lock:
            written = poses.written
            for number in range(poses.oldest(self._count) if written > self._count else written, written):
                self._count = number + 1
                if (slot := poses.read(number)) is not None:
                    self._add(slot[1], np.frombuffer(slot[2]))

    def _add(self, measured_s: float, row: NDArray[np.float64]) -> None:
        number, time_s, latency_ms, dropped, error_rad = row[:5].tolist()
        R = row[8:].reshape(3, 3)
        self._lost, self._dropped = self._lost + bool(np.isnan(R[0, 0])), self._dropped + int(dropped)
        self._latency_ms.append(latency_ms)
        self._measured_s.append(measured_s)
        columns = self._lines.columns(int(number), time_s, R, error_rad)
        x, y = columns[FICTRAC["path"]].tolist()
        self._path.append((x, y))
        self._heading_rad = float(columns[FICTRAC["heading"]][0])

    def shown(self, steps: Sequence[str]) -> Answer:
        """Return the page, or its present data."""
        match steps:
            case [""]:
                return PAGE
            case ["look"]:
                return self.look()
            case ["setup", *rest]:
                return self._setup.shown(rest)
        return None

    def done(self, steps: Sequence[str], asked: Mapping[str, Any]) -> Answer:
        """Start or stop measuring, or save the map, by the loop. Raises OutputError if it cannot."""
        self.take()
        match steps:
            case ["setup", *rest]:
                return self._setup.done(rest, asked)
            case ["start" | "stop" | "save" as word] if self._rings is not None:
                with self._asking:
                    self._commands.send_bytes(word.encode())
                    said = self._replies.get()
                if "error" in said:
                    raise OutputError(said["error"])
                self._running = {"start": True, "stop": False}.get(word, self._running)
                return said
            case ["start" | "stop" | "save"]:
                return {"said": "The set-up is being examined; no frame is measured yet."}
        return None

    def look(self) -> Json:
        """Return the present data: counts, latencies, path, and each camera's newest picture with its drawing."""
        self.take()
        if self._rings is None or not (count := self._rings[1].written):
            return {"begun": self._rings is not None}
        slot = self._rings[1].read(count - 1)
        if slot is None or not self._count:
            return {"begun": True}
        cameras = len(self._recording.streams)
        pictures = self._layout.pictures(slot[2])
        words, row = np.split(np.frombuffer(slot[2], np.float64, offset=self._layout.size).copy(), [cameras + 1])
        R, valid = row[8:].reshape(3, 3), bool(np.isfinite(row[8]))
        with self._lock:
            latency, measured_s = np.array(self._latency_ms), self._measured_s.copy()
            path = list(islice(self._path, 0, None, max(1, len(self._path) // 1000)))  # of the path
        counts, edges = np.histogram(latency, 40, (0.0, max(float(np.quantile(latency, 0.99)) * 1.2, 1.0)))
        middle, slow = np.quantile(latency, (0.5, 0.99))
        return {
            "begun": True,
            "running": self._running,
            "count": self._count,
            "lost": self._lost,
            "dropped": self._dropped,
            "rate_hz": (len(measured_s) - 1) / (measured_s[-1] - measured_s[0]) if len(measured_s) > 1 else None,
            "frame": int(row[0]),
            "time_s": row[1],
            "valid": valid,
            "reason": [str(REASONS[int(k)]) for k in words[:-1]],
            "error_deg": without_nan(float(np.degrees(row[4]))),
            "latency": {"counts": counts.tolist(), "last_ms": float(edges[-1]), "median_ms": middle, "p99_ms": slow},
            "path": without_nan([list(step) for step in path]),
            "heading_rad": without_nan(self._heading_rad),
            "cameras": [self._camera(c, pictures[c], row[5:8], R if valid else None) for c in range(cameras)],
            "map": bool(words[-1]),
        }

    def _camera(self, c: int, picture: NDArray[Any], X: NDArray[np.float64], R: NDArray[np.float64] | None) -> Json:
        stream = self._recording.streams[c]
        width, height = stream.camera.image_size
        found: Json = {"name": stream.name, "width": width, "height": height, "picture": _jpeg(picture)}
        if R is not None:
            radius_mm = self._recording.experiment.radius_mm
            here = Path3D(position_mm=X[None], R_lab_body=R[None], smoothed=np.zeros(1, bool), radius_mm=radius_mm)
            (tips, near), centre = axes_px(stream.camera, here, 0), stream.camera.project(torch.from_numpy(X)).numpy()
            drawn = {"outline": outline_px(stream.camera, here, 0), "tips": tips, "centre": centre}
            found |= {name: without_nan(points.tolist()) for name, points in drawn.items()} | {"near": near.tolist()}
        return found


def _jpeg(picture: NDArray[Any]) -> str:
    picture = picture if picture.dtype == np.uint8 else eight_bits(picture)
    if (width := picture.shape[1]) > WIDEST:
        size = WIDEST, round(picture.shape[0] * WIDEST / width)
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode()}"
