"""A page that shows `live` while it runs: it draws the newest frame when asked, in threads of its own."""

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from itertools import islice
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import OutputError, refusal
from sphereorient.files.page_server import PageHandler, PageServer, new_token
from sphereorient.files.picture import eight_bits
from sphereorient.live.lines import without_nan
from sphereorient.live.monitor import Monitor, Seen
from sphereorient.pose import CameraView
from sphereorient.report.overlay_model import Path3D, axes_px, outline_px

PAGE = Path(__file__).with_name("page.html")
WIDEST = 640  # px, of a picture that is sent
STEPS = 1000  # of the path
Json = dict[str, Any]


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
        path = list(islice(steps, 0, None, max(1, len(steps) // STEPS)))
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
            "map_number": now.map_number,
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
