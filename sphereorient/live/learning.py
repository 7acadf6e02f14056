"""No map at the start: relative orientations, a map learnt meanwhile in a second process, then orientations by it."""

import math
import multiprocessing
import signal
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.queues import Queue, SimpleQueue
from queue import Empty
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.files.threads import limit_cores
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.initialise import Initialiser
from sphereorient.live.live import OnlineTracker
from sphereorient.locate import Frame
from sphereorient.mapping.chain import RelativeTracker
from sphereorient.mapping.disks import Crop, Crops, cut_out
from sphereorient.mapping.grid import ROUGH_SIDE, map_table
from sphereorient.mapping.growing import GrowingMap, LiveMap
from sphereorient.mapping.settings import MapSettings
from sphereorient.methods.settings import Settings
from sphereorient.pose.camera_view import FIRST_BLUR_PX, widest_px
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.lasting import Lasting
from sphereorient.pose.poses import Poses, supported

HANDED_RAD = 0.025  # turn from one frame that is handed over to the next
HANDED = 400  # frames that are handed over at most; the ball has shown its sides by then
LAST = 3  # poses from which following goes on with another map
FEWEST = 6  # iterations of a map that is kept
IDLE_S = 0.3  # without a frame: the ball shows nothing new
SAVED_S = 120.0  # in which a map is finished


_Handed = tuple[Sequence[Crop], NDArray[np.float64]]  # one crop of each camera, R_lab_body (3, 3)


class MapLearner:
    """Learns the map of the frames handed over, in a process of its own; `newest` is its last one, None: none yet."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.newest: LiveMap | None = None
        self._place: Crops | None = None
        self._last: Tensor | None = None
        self._count = 0
        self._frames: Queue[Any] = context.Queue()
        self._maps: SimpleQueue[Any] = context.SimpleQueue()  # a map goes whole before it is extended
        self._process = context.Process(target=_learn, args=(self._frames, self._maps), daemon=True)
        self._process.start()
        self._frames.cancel_join_thread()  # what a process that has ended does not take must hold nobody up
        self._paint: tuple[Tensor, Tensor] | None = None
        self._painted = threading.Event()
        threading.Thread(target=self._receive, name="maps", daemon=True).start()

    def begin(self, place: Crops, settings: MapSettings) -> None:
        """Tell the place of the ball, an empty record of crops with views and one position; frames come after it."""
        self._place = place
        self._frames.put((place, settings))

    def hand(self, shots: Sequence[Frame], R_lab_body: Tensor) -> None:
        """Hand over a frame, with its orientation, where all cameras see a ball that has turned."""
        trace = 0.0 if self._last is None else float((self._last * R_lab_body).sum())  # of the turn since that one
        still = trace > 1 + 2 * math.cos(HANDED_RAD)
        if self._place is None or still or self._count >= HANDED or not all(shot.usable for shot in shots):
            return
        self._last, self._count = R_lab_body, self._count + 1
        self._frames.put((cut_out(self._place, [shot.picture for shot in shots]), R_lab_body.numpy()))

    def paint(self) -> tuple[Tensor, Tensor]:
        """Return the map without the blur of the pictures, NaN where unknown, and its counts, (H, 2 H); the body frame
        is that of the orientations handed over. This takes some seconds. PaintError without a map.
        """
        self._painted.clear()
        self._frames.put(None)
        end_s = time.monotonic() + SAVED_S
        while not self._painted.wait(IDLE_S) and self._process.is_alive() and time.monotonic() < end_s:
            pass
        if self._paint is None:
            do = "let the ball turn longer, or learn it with `sphereorient map`"
            raise PaintError(refusal("map", expected="one learnt meanwhile", got="none yet", do=do))
        return self._paint

    def close(self) -> None:
        """End the process."""
        self._process.terminate()

    def _receive(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                found = self._maps.get()
                if isinstance(found, LiveMap):
                    self.newest = found
                else:
                    self._paint = found
                    self._painted.set()


def _learn(frames: "Queue[Any]", maps: "SimpleQueue[Any]") -> None:
    """Take frames and give maps; for None instead of a frame, give the paint."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tracking, which then asks for the paint
    torch.set_num_threads(1)
    limit_cores(1)
    growing = GrowingMap(*frames.get())
    while True:
        waiting = _waiting(frames)
        for one in waiting:
            if one is None:
                while growing.ready() and not growing.arrived and not (growing.done >= FEWEST and growing.whole):
                    growing.iterate()
                maps.put(growing.paint() if growing.done else None)
            else:
                growing.add(one[0], torch.from_numpy(one[1]))
        found = growing.grown(idle=not waiting)
        if found is not None:
            maps.put(found)


def _waiting(frames: "Queue[Any]") -> list[_Handed | None]:
    """Return what waits; wait a little for the first, and for what does not fit into the pipe with it."""
    found: list[_Handed | None] = []
    with suppress(Empty):
        found.append(frames.get(timeout=IDLE_S))
        while True:
            found.append(frames.get(timeout=0.004))  # a full pipe is filled again by then
    return found


class LearningTracker:
    """Follows a ball without a map: relative orientations at first, then by the newest map that is learnt meanwhile.

    `number` is that of the map by which the last frame was measured, 0: none, its orientation is relative to the one
    before: the ball shows paint that is not in the map yet. The body frame goes on: where another map begins, the
    orientation of the frame is that without it.
    """

    def __init__(self, place: Crops, settings: Settings, learner: MapLearner) -> None:
        self.number = 0
        self.appearance = _unknown(place)
        self._settings, self._learner = settings, learner
        self._relative = RelativeTracker(place, settings.paint)
        self._map: LiveMap | None = None
        self._online: OnlineTracker | None = None
        self._R_map_first = torch.eye(3, dtype=torch.float64)  # the learner's body frame to that of the orientations
        self._R_map_body = torch.eye(3, dtype=torch.float64)
        self._tried = 0
        self._past: deque[tuple[float, Poses]] = deque(maxlen=LAST)  # in the body frame

    def between(self) -> None:
        """Do what can wait until the last frame was told."""
        if self._online is not None:
            self._online.between()

    def next(self, time_s: float, shots: Sequence[Frame]) -> tuple[Poses, bool]:
        """Return the poses of a frame, in the body frame, and whether they were searched for; see `OnlineTracker`."""
        poses, searched = self._measured(time_s, shots)
        found = self._learner.newest
        if found is not None and found.number > self._tried and len(self._past) == LAST and supported(poses):
            self._tried = found.number
            poses = self._changed(found, time_s, shots, poses)
        if supported(poses):
            self._past.append((time_s, poses))
            self._learner.hand(shots, poses.R_lab_body[0])
            if self.number:
                self._relative.know(time_s, shots, poses.R_lab_body[0])
        else:
            self._past.clear()
        return poses, searched

    def _measured(self, time_s: float, shots: Sequence[Frame]) -> tuple[Poses, bool]:
        if self._online is None or self._map is None:
            return self._relative.next(time_s, shots)
        followed = self._online.followed(time_s, shots)
        if followed is not None:
            self.number = self._map.number
            return _turned(followed, self._R_map_body), False
        poses, searched = self._relative.next(time_s, shots)
        if supported(poses):
            self.number = 0
            self._online.resume([(time_s, _turned(poses, self._R_map_body.mT))])
        elif self._map.search is not None and any(shot.usable for shot in shots):
            poses, searched = self._online.next(time_s, shots)
            self.number = self._map.number
            poses = _turned(poses, self._R_map_body)
        return poses, searched

    def _changed(self, found: LiveMap, time_s: float, shots: Sequence[Frame], now: Poses) -> Poses:
        """Go over to another map where the ball is found with it near `now`; return the poses of the frame."""
        online = _follower(found, self._settings)
        R_map_body = found.R_map_body @ self._R_map_first
        online.resume([(then, _turned(poses, found.R_recent_map)) for then, poses in self._past])
        poses = online.followed(time_s, shots)
        if poses is None or not supported(poses):
            return now
        if self._map is None:
            self._relative.forget()
            R_map_body = poses.R_lab_body[0].mT @ now.R_lab_body[0]
            self._R_map_first = found.R_map_body.mT @ R_map_body
        self._map, self._online, self.number, self.appearance = found, online, found.number, found.appearance
        self._R_map_body = R_map_body
        return _turned(poses, self._R_map_body)


def _turned(poses: Poses, R: Tensor) -> Poses:
    """Return poses whose body frame is turned: R_lab_body times R (3, 3)."""
    return replace(poses, R_lab_body=poses.R_lab_body @ R)


def _follower(found: LiveMap, settings: Settings) -> OnlineTracker:
    names = [view.name for view in found.appearance.fitter.views]
    begin = Initialiser(
        fitter=found.appearance.still,
        proposers={} if found.search is None else dict.fromkeys(names, found.search),
        locating=settings.locate,
        candidates=settings.refine.candidates,
    )
    refine = settings.refine.model_copy(update={"chunks": 1})
    return OnlineTracker(BallTracker(found.appearance, begin, refine, centre=found.centre), found.appearance)


def _unknown(place: Crops) -> Appearance:
    """Return what is known of a ball without a map: where it is seen."""
    table = map_table(torch.full((8, 16), 0.5), FIRST_BLUR_PX / widest_px(place.views), ROUGH_SIDE)
    fitter = first_fitter(place.views, place.radius_mm, table, FIRST_BLUR_PX)
    return Appearance(
        fitter=fitter, still=fitter, lasting=Lasting.none(len(place.views)), score_min=0.0, right_score=1.0
    )
