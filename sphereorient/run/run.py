"""One experiment from the first frame to the last, its parts kept on the way; and its stages for workers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from sphereorient.errors import OutputError, TrackError, refusal
from sphereorient.experiment.recording import Progress, Recording, open_recording, silent
from sphereorient.follow import PoseTable, joined_tables, pose_table
from sphereorient.methods.learnt import Learnt
from sphereorient.methods.paper import track_paper
from sphereorient.methods.precise import Follower, Window, follow, follower, follower_of, join, learn
from sphereorient.run.parts import Parts
from sphereorient.run.request import Request
from sphereorient.run.track import check_method, finished, one_thread, torch_device
from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A request at work: its inputs open; made by `opened`, read by the stages."""

    request: Request
    recording: Recording
    given: Learnt | None  # from another run
    parts: Parts

    def follower(self, progress: Progress = silent) -> Follower:
        """Return what measures frames: with what is known already, or learnt now and kept."""
        device = torch_device(self.request.device)
        known = self.given or self.parts.known()
        if known is not None:
            return follower_of(self.recording, known, self.request.settings, device)
        study, proposers = learn(self.recording, self.request.settings, progress)
        Learnt.of(study).save(self.parts.learnt)
        return follower(self.recording, study, proposers, self.request.settings, device)

    def measure(self, seeing: Follower, windows: Sequence[Window]) -> Iterator[Window]:
        """Measure those of the windows that are not there yet, keep them, and yield each when it is done."""
        for stretch in _consecutive(self.parts.missing(windows)):
            for window, poses in follow(seeing, stretch):
                self.parts.write(window, poses)
                yield window

    def join(self, seeing: Follower, progress: Progress = silent) -> Trajectory:
        """Put the measured windows together, and write the track."""
        progress("join", 0, 1)
        tables: list[PoseTable] = []
        for window in seeing.windows:
            found = self.parts.read(window)
            if found is None:
                path = self.parts.poses(window)
                path.unlink(missing_ok=True)
                do = "run again with --resume; only this part is measured again"
                raise TrackError(refusal(str(path), expected="the poses of a window", got="a damaged file", do=do))
            tables.append(pose_table(found, len(self.recording.streams)))
        track, learnt = join(self.recording, seeing.study, joined_tables(tables), self.request.settings, self.given)
        if self.request.save_learnt is not None:
            learnt.save(self.request.save_learnt)
        return self.written(track, progress)

    def written(self, track: Trajectory, progress: Progress = silent) -> Trajectory:
        """Write a track under its name; only then its parts go."""
        request = self.request
        track = finished(track, self.recording, request.method, request.settings, request.command)
        track.save(request.out)
        self.parts.remove()
        progress("join", 1, 1)
        return track


@contextmanager
def opened(request: Request) -> Iterator[Run]:
    """Open the inputs of a request; its parts are there already."""
    check_method(request.method, request.learnt is not None)
    given = None if request.learnt is None else Learnt.load(request.learnt)
    with open_recording(request.experiment, request.cameras) as recording, one_thread():
        yield Run(request=request, recording=recording, given=given, parts=Parts(request.parts))


def track_kept(request: Request, *, resume: bool = False, progress: Progress = silent) -> Trajectory:
    """Track one experiment in this process, keeping what is done beside the track until that is whole.

    A run that was cut off at any moment is continued with `resume`: the track is then the same, to the last bit.

    Args:
        request: what to do.
        resume: go on with the parts of a run that was cut off.
        progress: told how far each stage is.

    Raises:
        SphereOrientError: inputs that are missing, unreadable or do not fit together; parts of another run; a track
            that cannot be written, and then the parts stay.
    """
    check_out(request)
    with opened(request) as run:
        if request.method == "paper":  # its stages look at the whole movie: nothing to keep
            return run.written(track_paper(run.recording, request.settings, progress), progress)
        with run.parts.held(request, resume=resume):
            seeing = run.follower(progress)
            total = len(run.recording.timeline)
            done = total - sum(window.last - window.first for window in run.parts.missing(seeing.windows))
            progress("track", done, total)
            for window in run.measure(seeing, seeing.windows):
                done += window.last - window.first
                progress("track", done, total)
            return run.join(seeing, progress)


def check_out(request: Request) -> None:
    """Refuse a place for the track that is none, before hours of work."""
    if not request.out.parent.is_dir():
        expected, do = f"an existing folder {request.out.parent}", "make it first"
        raise OutputError(refusal(str(request.out), expected=expected, got="none", do=do))


def _consecutive(windows: Sequence[Window]) -> Iterator[list[Window]]:
    """Cut windows where frames between them are missing."""
    stretch: list[Window] = []
    for window in windows:
        if stretch and stretch[-1].last != window.first:
            yield stretch
            stretch = []
        stretch.append(window)
    if stretch:
        yield stretch
