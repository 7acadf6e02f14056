"""Live tracking without a map: the map grows with each frame; a separate process adjusts position and map."""

import multiprocessing
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.experiment.recording import TextureMap
from sphereorient.files.threads import limit_cores
from sphereorient.follow.appearance import Appearance
from sphereorient.locate import Frame
from sphereorient.mapping.adjustment import adjusted
from sphereorient.mapping.disks import Crop, Crops
from sphereorient.mapping.first_pass import (
    ADJUSTED_ERROR,
    OUTLINE_ERROR,
    TURNED_RAD,
    CoarserPictures,
    FirstPass,
    KeptFrames,
)
from sphereorient.pose.camera_view import FIRST_BLUR_PX
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.lasting import Lasting
from sphereorient.pose.poses import Poses, supported

Array = NDArray[Any]
FIRST, MORE = 24, 1.5  # frames of the first adjustment; factor from one to the next
DRIFT_LEFT = 1 / 3  # of the rotation error at the first position, in frames not yet adjusted
SINCE = 16  # of the frames that came during an adjustment, evenly spread, so many enter its map: adding must be quick


class LearningTracker:
    """Tracks a ball by a map that grows with each frame. The body frame is the lab at the first frame. A separate
    process adjusts position and map; `number` of the map changes with each adjustment.
    """

    def __init__(self, place: Crops) -> None:
        self.number = 1
        self._coarse = CoarserPictures.of(place)
        # Sending moves tensors to other memory, so it precedes fits, which hold addresses. Later only arrays are sent.
        spawn, begin = multiprocessing.get_context("spawn"), (self._coarse.place,)
        self._aside = ProcessPoolExecutor(1, mp_context=spawn, initializer=_begin, initargs=begin)
        self._aside.submit(int)  # starts the process
        self._pass, self._kept = FirstPass(self._coarse.place), KeptFrames(self._coarse.place)
        fitter = first_fitter(place.views, place.radius_mm, self._pass.cells.table, FIRST_BLUR_PX)
        lasting = Lasting.none(len(place.views))
        self._known = Appearance(fitter=fitter, still=fitter, lasting=lasting, score_min=0.0, right_score=1.0)
        self.appearances: Mapping[str, Appearance] = {"": self._known}
        self._error = OUTLINE_ERROR  # of the position, radii in pictures
        self._away_rad = 0.0  # largest rotation from the first frame
        self._drift_rad = 0.0  # of the frames that came during the adjustment
        self._now: tuple[Sequence[Frame], Poses] | None = None
        self._due = float(FIRST)
        self._adjusting: tuple[KeptFrames, Future[tuple[Array, ...]]] | None = None
        self._adjusted_by_rad = 0.0  # rotation within the adjusted frames

    def next(self, time_s: float, frames: Sequence[Frame]) -> dict[str, tuple[Poses, bool]]:
        """Return the poses of a frame, and whether they were searched for, see `OnlineTracker`."""
        coarse = self._coarse.frames(frames)
        poses, searched = self._pass.next(time_s, coarse)
        self._now = (coarse, poses) if supported(poses) else None
        if self._now is not None:
            self.appearances = {"": replace(self._known, lasting=self._known.lasting.with_place(self._turned(poses)))}
        return {"": (poses, searched)}

    def _turned(self, poses: Poses) -> Tensor:
        """Return the covariance (6, 6) of the rotation since the first frame: a wrong position scales all rotations."""
        self._away_rad = max(self._away_rad, float(so3.log(poses.R_lab_body[0]).norm()))
        variance = (self._error * self._away_rad) ** 2 + self._drift_rad**2
        return torch.diag(torch.tensor([variance] * 3 + [0.0] * 3, dtype=torch.float64))

    def between(self) -> None:
        """Keep the frame, and adopt a finished adjustment."""
        if self._now is not None:
            self._kept.add(*self._now)
        if self._adjusting is not None and self._adjusting[1].done():
            R_lab_body, X, mean, weight = (torch.from_numpy(part) for part in self._adjusting[1].result())
            moved = FirstPass(replace(self._coarse.place, position_lab_mm=X), ADJUSTED_ERROR)
            moved.cells.set(mean, weight)
            correction, since = self._kept.corrected(self._adjusting[0], R_lab_body)
            moved.shown(*since.crops(SINCE)).follow(self._pass, correction)
            self._pass, self._adjusting, self.number = moved, None, self.number + 1
            # Views farther apart determine the position better.
            self._error = OUTLINE_ERROR * min(1.0, TURNED_RAD / self._adjusted_by_rad)
            self._drift_rad = OUTLINE_ERROR * DRIFT_LEFT * since.path_rad
        if self._adjusting is None and self._kept.count >= self._due and self._kept.turned_rad > TURNED_RAD:
            self._due, frames = MORE * self._kept.count, self._kept.so_far()
            self._adjusted_by_rad = self._kept.turned_rad
            self._adjusting = frames, self._aside.submit(_adjusted, *frames.arrays())

    def texture(self) -> TextureMap:
        """Return the map of the frames so far (takes seconds). Raises PaintError: the ball has not rotated."""
        return self._kept.adjusted().texture()

    def close(self) -> None:
        """End the process."""
        for process in tuple(self._aside._processes.values()):
            process.terminate()
        self._aside.shutdown(wait=False, cancel_futures=True)


_PLACE: list[Crops] = []  # of the adjusting process: the initial one


def _begin(place: Crops) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tracking
    torch.set_num_threads(1)
    limit_cores(1)
    _PLACE.append(place)


def _adjusted(crops: list[list[Crop]], use: Array, R_lab_body: Array) -> tuple[Array, ...]:
    """Return orientations (N, 3, 3), position (1, 3), mm, and the map's mean and weight of each cell."""
    seen = _PLACE[0].holding(crops, torch.from_numpy(use))
    found = adjusted(seen, torch.from_numpy(R_lab_body))
    cells = FirstPass(found.crops).shown(found.crops, found.R_lab_body).cells
    parts = found.R_lab_body, found.crops.position_lab_mm[:1], cells.mean, cells.weight
    return tuple(part.numpy() for part in parts)
