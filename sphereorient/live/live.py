"""Estimate the pose of each frame of a feed from earlier frames; write these frames as a track, in blocks."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Union

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import Flag, Reason
from sphereorient.experiment import input_files
from sphereorient.experiment.recording import Recording
from sphereorient.files.provenance import provenance
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.chunk import Ahead, Chunk
from sphereorient.follow.tracker import Tracker
from sphereorient.live.feed import Arrival
from sphereorient.locate import Frame, screened
from sphereorient.methods.results import fit_flags, measured_track, missed_by, with_errors
from sphereorient.methods.settings import Settings, settings_yaml
from sphereorient.pose import CameraView
from sphereorient.pose.poses import Poses, no_pose, pose_table, supported
from sphereorient.trajectory import Trajectory

if TYPE_CHECKING:
    from sphereorient.live.learning import LearningTracker

Floats = NDArray[np.float64]
LiveTracker = Union["OnlineTracker", "LearningTracker"]

SEARCH_S = 1.0  # between long searches: other frames must not wait for them
MOST_MISSING = 100_000  # missing frames that are written between two frames
REMARK = "measured frame by frame by `sphereorient live`: no smoother ran, so no smooth poses and no velocities"


class OnlineTracker:
    """Tracks balls frame by frame: each pose from earlier frames, else from a search without history. Balls of
    `tracker` have one chunk at a time (setting `refine.chunks`). Memory does not grow.
    """

    number = 1  # of the map in use

    def __init__(self, balls: Mapping[str, BallTracker], appearances: Mapping[str, Appearance]) -> None:
        self.appearances = appearances
        self._tracker = Tracker(balls)
        self._look, self._tracker.start = self._tracker.start, self._searched
        self._time_s: dict[int, float] = {}  # of the last frames
        self._chunks = {name: Chunk(0, self._time_s) for name in balls}
        self._number = 0
        self._last: dict[str, Poses] = {}  # of the last frame, before it enters the history
        self._lost: list[str] = []  # balls searched for in the last frame
        self._searched_s = math.nan  # time of the last long search

    def next(self, time_s: float, frames: Sequence[Frame]) -> dict[str, tuple[Poses, bool]]:
        """Return the poses of each ball in a frame, and whether it was searched for (no prediction, or a wrong one).
        `frames`: a frame of each view. If time does not increase, the history is dropped.
        """
        self.between()
        if not time_s > self._time_s.get(self._number - 1, -math.inf):
            for chunk in self._chunks.values():
                chunk.forget()
        self._time_s[self._number], self._lost = time_s, []
        self._last = self._step(frames)
        for name in self._lost:
            if supported(self._last[name]):
                self._chunks[name].forget()  # the history does not predict the motion from here
        return {name: (poses, name in self._lost) for name, poses in self._last.items()}

    def _step(self, frames: Sequence[Frame]) -> dict[str, Poses]:
        if len(self._chunks) > 1:
            return self._tracker.step({one: [chunk] for one, chunk in self._chunks.items()}, self._number, [frames])[0]
        (name,) = self._chunks
        ball = self._tracker.balls[name]
        ahead = ball.ahead(self._chunks[name], self._number)
        poses = None if ahead is None else ball.followed(ahead, frames)
        return self._searched(frames, [name], {}, {}) if poses is None else {name: poses}

    def _searched(
        self, frames: Sequence[Frame], names: Sequence[str], known: Mapping[str, Tensor], past: Mapping[str, Ahead]
    ) -> dict[str, Poses]:
        """Find balls, as `Tracker.start`: a single ball by its blob; the long search only each `SEARCH_S`."""
        time_s, self._lost = self._time_s[self._number], list(names)
        if len(self._tracker.balls) == 1:
            found = {name: self._tracker.balls[name].spotted(frames) for name in names}
        else:
            reason = [Reason.NOT_FOUND if shot.usable else shot.reason for shot in frames]
            found = {name: no_pose(len(frames), reason) for name in names}
        if any(supported(poses) for poses in found.values()) or abs(time_s - self._searched_s) < SEARCH_S:
            return found
        self._searched_s = time_s
        return self._look(frames, names, known, past)

    def between(self) -> None:
        """Update the motion history; deferred until the pose has been sent."""
        for name, poses in self._last.items():
            chunk = self._chunks[name]
            chunk.saw(self._number, poses, self._tracker.balls[name].turns([chunk], [poses])[0])
        if self._last:
            self._number, self._last = self._number + 1, {}
            known = {number for chunk in self._chunks.values() for number, _ in chunk.past}
            for number in [k for k in self._time_s if k < self._number - 1 and k not in known]:
                del self._time_s[number]


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """Pose of one ball in one frame, measured without later frames; NaN: no pose."""

    ball: str  # its name; "": the only one
    number: int  # of the source, dropped frames included
    time_s: float
    position_lab_mm: Floats  # (3,)
    R_lab_body: Floats  # (3, 3)
    covariance: Floats  # (6, 6), of delta (rad, lab) and position (mm): independent part
    lasting: Floats  # (6, 6), likewise: part common to all frames
    reason: tuple[Reason, ...]  # of each camera, `OK` if it is used
    poses: Poses  # full result of the fit
    map_number: int  # of the map used
    flags: int  # bits of `Flag` of its fit
    found: bool  # whether it was searched for: at the start, after a loss, or not found at its prediction
    dropped: int  # frames dropped since the one before
    latency_s: float  # from the picture's arrival to here

    @property
    def valid(self) -> bool:
        """Whether there is a pose."""
        return math.isfinite(self.position_lab_mm[0])

    @property
    def error_rad(self) -> float:
        """Stated error of the orientation, root of the summed variances, rad."""
        return float(np.sqrt(np.trace((self.covariance + self.lasting)[:3, :3])))


def measured(tracker: LiveTracker, views: Sequence[CameraView], frames: Iterable[Arrival]) -> Iterator[Measured]:
    """Yield the pose of each ball in each frame; frames of one source, in order."""
    before: Sequence[Frame] | None = None
    number: int | None = None  # of the frame before
    for arrival in frames:
        dropped = 0 if number is None else arrival.number - number - 1
        frame = []
        for c, (picture, view) in enumerate(zip(arrival.pictures, views, strict=True)):
            if picture is None:
                nothing = np.zeros(view.camera.image_size[::-1], np.uint8)
                frame.append(Frame(shown=nothing, read=Reason.UNDECODABLE))
            else:
                frame.append(screened(picture, None if before is None else before[c].shown, view.background))
        for ball, (poses, searched) in tracker.next(arrival.time_s, frame).items():
            there, appearance = supported(poses), tracker.appearances[ball]
            yield Measured(
                ball=ball,
                number=arrival.number,
                time_s=arrival.time_s,
                position_lab_mm=poses.position_lab_mm[0].numpy() if there else np.full(3, np.nan),
                R_lab_body=poses.R_lab_body[0].numpy() if there else np.full((3, 3), np.nan),
                covariance=poses.covariance[0].numpy() if there else np.full((6, 6), np.nan),
                lasting=appearance.lasting.of_use(poses.use).numpy(),
                reason=poses.reason,
                poses=poses,
                map_number=tracker.number,
                flags=_flags(poses, appearance) if there else 0,
                found=searched and there,
                dropped=dropped,
                latency_s=time.perf_counter() - arrival.arrived_s,
            )
        tracker.between()
        before, number = frame, arrival.number


def _flags(poses: Poses, learnt: Appearance) -> int:
    X, radius_mm = poses.position_lab_mm[:1], learnt.fitter.radius_mm
    unseen = ((view, why) for view, why in zip(learnt.fitter.views, poses.reason, strict=True) if why is not Reason.OK)
    missed = sum(missed_by(view, [why], view.camera.project(X), view.radius_px(X, radius_mm)) for view, why in unseen)
    return int(fit_flags(learnt, poses.use[None], poses.score[:1], poses.excess[:1], np.asarray(missed))[0])


@dataclass(eq=False)
class TrackBlocks:
    """Makes a track of each block of frames of a single ball, in order; dropped frames become missing ones."""

    recording: Recording
    tracker: LiveTracker  # whose appearance is that of the frames
    even: bool  # whether the frames come at the experiment's rate
    settings: Settings
    command: str  # as typed
    _last: Measured | None = None
    _segment: int = -1  # of the last frame with a pose

    def head(self) -> Trajectory:
        """Return a track without frames, with the common attributes."""
        recording, experiment = self.recording, self.recording.experiment
        used = experiment.with_sphere(texture_path=None) if experiment.mapless else experiment  # it may be named
        origin = provenance(input_files(used, list(recording.cameras)), experiment.folder, self.command)
        return Trajectory.empty(
            np.zeros(0),
            cameras=tuple(recording.cameras),
            frame_rate=experiment.frame_rate_hz if self.even else np.nan,
            method="precise",
            settings=settings_yaml(self.settings),
            experiment=experiment.name,
            provenance=origin | {"remarks": [*recording.remarks, REMARK]},
            length_unit=experiment.length_unit,
        )

    def block(self, frames: Sequence[Measured]) -> Trajectory:
        """Return the next frames, with the missing ones before them, as a track."""
        time_s: list[float] = []
        poses: list[Poses] = []
        lasting: list[Floats] = []  # (6, 6), of the appearance at that frame
        marks: list[tuple[int, int]] = []  # segment, flags
        cameras = len(self.recording.cameras)
        for now in frames:
            if self._last is not None and (missing := min(now.dropped, MOST_MISSING)):
                time_s += np.linspace(self._last.time_s, now.time_s, missing + 2)[1:-1].tolist()
                poses += [no_pose(cameras, (Reason.MISSING,) * cameras)] * missing
                lasting += [np.zeros((6, 6))] * missing
                marks += [(-1, 0)] * missing
            after = self._last is not None and self._last.valid and not now.dropped
            flags = 0
            if now.valid and (now.found or not after):
                self._segment += 1
                flags = 0 if self._last is None else int(Flag.SPIKE if after else Flag.RECOVERED)
            time_s.append(now.time_s)
            poses.append(now.poses if now.valid else no_pose(cameras, now.reason, now.poses.use))
            lasting.append(now.lasting)
            marks.append((self._segment if now.valid else -1, flags))
            self._last = now
        table = pose_table(poses, cameras)
        choice = torch.where(table.mask.any(1), 0, -1)
        clock = torch.tensor(time_s, dtype=torch.float64)
        (learnt,) = self.tracker.appearances.values()
        track = measured_track(self.recording.experiment, clock, table, choice, learnt)
        track, _ = with_errors(track, self.recording, None, compared=False)
        errors, (segment, more) = np.stack(lasting), np.array(marks, np.int64).T
        return replace(
            track,
            position_cov=track.position_cov + errors[:, 3:, 3:],
            orientation_cov=track.orientation_cov + errors[:, :3, :3],
            segment=segment,
            flags=track.flags | more.astype(np.uint32),
        )
