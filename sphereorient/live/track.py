"""The frames of `live` as a track, block by block."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from sphereorient.errors import Flag, Reason
from sphereorient.experiment import input_files
from sphereorient.experiment.recording import Recording
from sphereorient.files.provenance import provenance
from sphereorient.live.live import LiveTracker, Measured
from sphereorient.methods.results import measured_track, with_errors
from sphereorient.methods.settings import Settings, settings_yaml
from sphereorient.pose.poses import Poses, no_pose, pose_table
from sphereorient.trajectory import Trajectory

MOST_MISSING = 100_000  # frames between two that are written as missing
REMARK = "measured frame by frame by `sphereorient live`: no smoother ran, so no smooth poses and no velocities"


@dataclass(eq=False)
class TrackBlocks:
    """Makes a track of each block of frames, in order; frames that were dropped are missing in it."""

    recording: Recording
    tracker: LiveTracker  # whose appearance is that of the frames
    even: bool  # whether the frames come at the experiment's rate
    settings: Settings
    command: str  # as it was typed
    _last: Measured | None = None
    _segment: int = -1  # of the last frame with a pose

    def head(self) -> Trajectory:
        """Return a track without frames that has the attributes of all."""
        recording, experiment = self.recording, self.recording.experiment
        origin = provenance(input_files(experiment, list(recording.cameras)), experiment.folder, self.command)
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
        """Return the next frames, and those missing before them, as a track."""
        time_s: list[float] = []
        poses: list[Poses] = []
        marks: list[tuple[int, int]] = []  # segment, flags
        cameras = len(self.recording.cameras)
        for now in frames:
            if self._last is not None and (missing := min(now.dropped, MOST_MISSING)):
                time_s += np.linspace(self._last.time_s, now.time_s, missing + 2)[1:-1].tolist()
                poses += [no_pose(cameras, (Reason.MISSING,) * cameras)] * missing
                marks += [(-1, 0)] * missing
            after = self._last is not None and self._last.valid and not now.dropped
            flags = 0
            if now.valid and (now.found or not after):
                self._segment += 1
                flags = 0 if self._last is None else int(Flag.SPIKE if after else Flag.RECOVERED)
            time_s.append(now.time_s)
            poses.append(now.poses if now.valid else no_pose(cameras, now.reason, now.poses.use))
            marks.append((self._segment if now.valid else -1, flags))
            self._last = now
        return self._of(time_s, poses, marks)

    def _of(self, time_s: list[float], poses: list[Poses], marks: list[tuple[int, int]]) -> Trajectory:
        experiment, cameras = self.recording.experiment, self.recording.cameras
        table = pose_table(poses, len(cameras))
        choice = torch.where(table.mask.any(1), 0, -1)
        clock = torch.tensor(time_s, dtype=torch.float64)
        learnt = self.tracker.appearance
        track = measured_track(experiment, clock, table, choice, learnt)
        track, _ = with_errors(track, self.recording, learnt.lasting, compared=False)
        segment, flags = np.array(marks, np.int64).T
        return replace(track, segment=segment, flags=track.flags | flags.astype(np.uint32))
