"""What `live` counts and keeps of its frames, for the summary and for the page that shows it while it runs; the page
draws the newest frame when asked, in threads of its own.
"""

import base64
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from itertools import islice
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import OutputError, Reason, refusal
from sphereorient.files.page_server import PageHandler, PageServer, new_token
from sphereorient.files.picture import eight_bits
from sphereorient.files.provenance import without_nan
from sphereorient.live.feed import Arrival, Feed, Tell
from sphereorient.live.live import Measured
from sphereorient.pose import CameraView
from sphereorient.report.overlay_model import Path3D, axes_px, outline_px
from sphereorient.trajectory.walk import FICTRAC

KEPT = 1000  # latencies
LOST_S = 0.5  # without a pose: then it is told
CONFIRMED = 2  # poses in a row: one alone may be a chance match
MOSTLY = 0.8  # of all frames without a pose: the ball was not explained before
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
PAGE = Path(__file__).with_name("page.html")
WIDEST = 640  # px, of a picture that is sent
Json = dict[str, Any]


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
        self.path: deque[tuple[float, float]] = deque(maxlen=20_000)
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


@dataclass(eq=False)
class LivePage:
    """What the page shows and does. `save_map` writes a map that is learnt meanwhile and says so; None: no button."""

    token: str = field(default_factory=new_token)
    monitor: Monitor | None = None  # None: not begun yet
    views: Sequence[CameraView] = ()
    radius_mm: float = 1.0
    save_map: Callable[[], str] | None = None

    def look(self) -> Json:
        """Return what is known now: counts, latencies, path, and each camera's newest picture with what is drawn."""
        monitor = self.monitor
        if monitor is None or monitor.newest is None:
            return {"begun": monitor is not None}
        seen, now = monitor.newest, monitor.newest.now
        latency = np.array(monitor.latency_ms.copy())
        told_s = monitor.told_s.copy()
        counts, edges = np.histogram(latency, 40, (0.0, max(float(np.quantile(latency, 0.99)) * 1.2, 1.0)))
        middle, slow = np.quantile(latency, (0.5, 0.99))
        steps = monitor.path.copy()
        path = list(islice(steps, 0, None, max(1, len(steps) // 1000)))  # of the path
        return {
            "begun": True,
            "running": monitor.running.is_set(),
            "count": monitor.count,
            "lost": monitor.lost,
            "dropped": monitor.dropped,
            "rate_hz": (len(told_s) - 1) / (told_s[-1] - told_s[0]) if len(told_s) > 1 else None,
            "frame": now.number,
            "time_s": now.time_s,
            "valid": now.valid,
            "reason": [str(why) for why in now.reason],
            "error_deg": without_nan(float(np.degrees(now.error_rad))),
            "latency": {"counts": counts.tolist(), "last_ms": float(edges[-1]), "median_ms": middle, "p99_ms": slow},
            "path": without_nan([list(step) for step in path]),
            "heading_rad": without_nan(seen.heading_rad),
            "cameras": [self._camera(c, seen) for c in range(len(self.views))],
            "map": self.save_map is not None,
        }

    def _camera(self, c: int, seen: Seen) -> Json:
        view, now, picture = self.views[c], seen.now, seen.arrival.pictures[c]
        width, height = view.camera.image_size
        found: Json = {"name": view.name, "width": width, "height": height, "picture": _jpeg(picture)}
        if now.valid:
            here = Path3D(
                position_mm=now.position_lab_mm[None],
                R_lab_body=now.R_lab_body[None],
                smoothed=np.zeros(1, bool),
                radius_mm=self.radius_mm,
            )
            tips, near = axes_px(view.camera, here, 0)
            drawn = {"outline": outline_px(view.camera, here, 0), "tips": tips}
            drawn["centre"] = view.camera.project(torch.from_numpy(now.position_lab_mm)).numpy()
            found |= {name: without_nan(points.tolist()) for name, points in drawn.items()} | {"near": near.tolist()}
        return found

    def go(self, running: bool) -> Json:
        """Start or stop measuring; what comes while it is stopped is not measured."""
        if self.monitor is not None:
            (self.monitor.running.set if running else self.monitor.running.clear)()
        return {"said": "Tracking goes on." if running else "Tracking is stopped: no frame is measured."}

    def saved(self) -> Json:
        """Write the map; raise OutputError where none is learnt."""
        if self.save_map is None:
            do = "begin without a map"
            raise OutputError(refusal("map", expected="one that is learnt meanwhile", got="none", do=do))
        return {"said": self.save_map()}


def _jpeg(picture: NDArray[Any] | None) -> str | None:
    if picture is None:
        return None
    picture = picture if picture.dtype == np.uint8 else eight_bits(picture)
    if (width := picture.shape[1]) > WIDEST:
        size = WIDEST, round(picture.shape[0] * WIDEST / width)
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode()}"


def open_page(page: LivePage, port: int) -> PageServer:
    """Serve a page on this machine in threads; raise OutputError for a port in use. Port 0: any free one."""

    class Handler(PageHandler):
        token = page.token

        def do_GET(self) -> None:
            match self._steps():
                case [""]:
                    self._send(PAGE.read_bytes(), "text/html; charset=utf-8")
                case ["look"]:
                    self._answer(page.look)
                case _:
                    self.send_error(HTTPStatus.NOT_FOUND)

        def do_POST(self) -> None:
            self.close_connection = True  # whatever was sent with it is not read
            match self._steps():
                case ["start" | "stop" as word]:
                    self._answer(lambda: page.go(word == "start"))
                case ["save"]:
                    self._answer(page.saved)
                case _:
                    self.send_error(HTTPStatus.NOT_FOUND)

    server = PageServer(Handler, port, "--page", OutputError)
    Thread(target=server.serve_forever, name="page", daemon=True).start()
    return server
