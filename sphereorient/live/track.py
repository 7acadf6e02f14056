"""The frames of `live` as a track: rows in a journal while it runs, a whole track.h5 at its end."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from sphereorient.calibration.systematic import with_systematic_errors
from sphereorient.errors import OutputError, SphereOrientError, error_words, refusal
from sphereorient.experiment import input_files
from sphereorient.experiment.recording import Recording
from sphereorient.files.provenance import provenance
from sphereorient.follow.poses import Poses, no_pose, pose_table
from sphereorient.live.feed import Tell
from sphereorient.live.live import LiveTracker, Measured
from sphereorient.live.outputs import DISK_S, MOST_ROWS, Spool, check_new
from sphereorient.methods.results import measured_track
from sphereorient.methods.settings import Settings, settings_yaml
from sphereorient.pose.lasting import with_lasting_errors
from sphereorient.trajectory import CameraTrack, Flag, Reason, Trajectory, journal

BLOCK_S = 0.5  # from one write to the next
MOST_MISSING = 100_000  # frames between two that are written as missing
REMARK = "measured frame by frame by `sphereorient live`: no smoother ran, so no smooth poses and no velocities"


@dataclass(eq=False)
class TrackBlocks:
    """Makes a track of each block of frames, in order; frames that were dropped are missing in it."""

    recording: Recording
    tracker: LiveTracker  # whose appearance is that of the frames
    even: bool  # whether the frames come at the experiment's rate
    _last: Measured | None = None
    _segment: int = -1  # of the last frame with a pose

    def head(self, settings: Settings, command: str) -> Trajectory:
        """Return a track without frames that has the attributes of all."""
        recording, experiment = self.recording, self.recording.experiment
        origin = provenance(input_files(experiment, list(recording.cameras)), experiment.folder, command)
        return Trajectory.empty(
            np.zeros(0),
            cameras=tuple(recording.cameras),
            frame_rate=experiment.frame_rate_hz if self.even else np.nan,
            method="precise",
            settings=settings_yaml(settings),
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
        table = pose_table([poses], len(cameras))
        choice = torch.where(table.mask.any(1), 0, -1)
        clock = torch.tensor(time_s, dtype=torch.float64)
        learnt = self.tracker.appearance
        track = measured_track(experiment, clock, table, choice, learnt)
        track = with_systematic_errors(track, cameras, self.recording.covariance, experiment.radius_mm)
        track = with_lasting_errors(track, learnt.lasting)
        segment, flags = np.array(marks, np.int64).T
        return replace(track, segment=segment, flags=track.flags | flags.astype(np.uint32))


class TrackOutput:
    """A new track.h5 (docs/data-format.md): rows in a journal beside it until it is written whole at the end.
    `tell` gets one line where the disk takes no more; the frames go on.

    Raises:
        OutputError: there is such a file or journal, or no folder for it.
    """

    def __init__(self, path: Path, tell: Tell) -> None:
        self._path, self._tell, self._journal = path, tell, journal.journal_path(path)
        check_new(path)
        check_new(self._journal)
        self._file: BinaryIO | None = None
        self._spool: Spool | None = None

    def begin(self, blocks: TrackBlocks, head: Trajectory) -> None:
        """Begin the journal; raise OutputError if it cannot be written."""
        try:
            self._file = self._journal.open("xb")
            self._file.write(journal.head(head))
            self._file.flush()
        except OSError as error:
            raise OutputError(self._full(error)) from None

        def write(frames: list[Measured]) -> None:
            assert self._file is not None
            self._file.write(journal.rows(blocks.block(frames)))
            self._file.flush()
            os.fsync(self._file.fileno())  # also a power cut leaves what is older than a second

        self._spool = Spool(write, lambda error: self._tell(self._full(error)), MOST_ROWS, BLOCK_S)

    def send(self, now: Measured) -> None:
        """Take a frame; after a fault nothing more is written."""
        if self._spool is not None:
            self._spool.send(now)

    def close(self) -> None:
        """Write the track, and remove the journal; where that fails, tell it and keep the journal."""
        if self._spool is None or self._file is None:
            return
        self._spool.close(DISK_S)
        if self._spool.lost and not self._spool.gone:
            self._tell(f"{self._path}: the disk was too slow for {self._spool.lost} frames; they are missing.")
        with suppress(OSError):
            self._file.close()
        try:
            whole_track(self._journal).save(self._path)
            self._journal.unlink()
        except (SphereOrientError, OSError) as error:
            self._tell(f"{error} What was measured is in {self._journal}.")

    def _full(self, error: OSError) -> str:
        do, got = "make room; tracking goes on without this file", error_words(error)
        return refusal(str(self._journal), expected="a disk with room", got=got, do=do)


def whole_track(path: Path) -> Trajectory:
    """Return the track of a journal; what is not in it takes no memory."""
    with path.open("rb") as file:
        return Trajectory(**journal.read_journal(file, Trajectory, CameraTrack, journal.nothing))
