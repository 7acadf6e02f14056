"""A track as a Rerun recording: cameras, pictures, the sphere on its way, and time series (docs/export.md)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import OutputError, refusal
from sphereorient.experiment import Experiment
from sphereorient.report.export_columns import package
from sphereorient.report.overlay_model import finite_rows, path_of, radius_of
from sphereorient.report.recording_scene import log_cameras, log_pictures, log_sphere
from sphereorient.report.recording_series import PLOTS, log_series
from sphereorient.trajectory import Trajectory

TIME, FRAME = "time", "row"  # timelines: seconds, and the rows of the track
PLAIN_RADIUS_MM = 9.0  # of the sphere where no experiment says it
Advance = Callable[[int, int], None]


def view_track(
    track: Trajectory,
    *,
    experiment: Experiment | None = None,
    save: Path | None = None,
    every: int = 1,
    pictures: bool = True,
    progress: Advance = lambda done, total: None,
) -> None:
    """Show a track in Rerun's viewer, or write what it would show.

    Args:
        track: what was measured.
        experiment: what it was measured from, for cameras, paint and pictures; None: the track alone.
        save: .rrd to write, without a window; None: the viewer is opened.
        every: of so many frames the pictures of one are put in.
        pictures: whether pictures are put in at all.
        progress: called with pictures done and all pictures.

    Raises:
        OutputError: rerun-sdk is not installed, another suffix, or the file cannot be written.
        TrackError: the track is of another experiment.
    """
    package("rerun", "view")
    import rerun as rr

    if save is not None and save.suffix.lower() != ".rrd":
        do = "end the name in .rrd"
        raise OutputError(refusal(f"--save {save}", expected=".rrd", got=f"'{save.suffix}'", do=do))
    recording: Any = rr.RecordingStream("sphereorient", recording_id=None)
    layout = _layout(track, experiment)
    if save is None:
        recording.spawn(default_blueprint=layout)
    else:
        _open(recording, save, layout)
    try:
        _log(recording, track, experiment, every if pictures else 0, progress)
    finally:
        recording.flush()
        recording.disconnect()


def _open(recording: Any, save: Path, layout: Any) -> None:
    try:
        recording.save(save, default_blueprint=layout)
    except (OSError, RuntimeError) as error:
        got, do = f"'{str(error).splitlines()[0]}'", "choose a folder that exists and may be written"
        raise OutputError(refusal(str(save), expected="a file that can be written", got=got, do=do)) from error


def _log(recording: Any, track: Trajectory, experiment: Experiment | None, every: int, progress: Advance) -> None:
    """Fill the recording."""
    import rerun as rr

    def when(rows: NDArray[np.int64]) -> list[Any]:
        return [rr.TimeColumn(TIME, duration=track.time[rows]), rr.TimeColumn(FRAME, sequence=rows)]

    def set_time(k: int) -> None:
        recording.set_time(TIME, duration=float(track.time[k]))
        recording.set_time(FRAME, sequence=k)

    path = path_of(track, PLAIN_RADIUS_MM if experiment is None else radius_of(experiment))
    recording.log("lab", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if experiment is not None:
        there = path.position_mm[finite_rows(path.position_mm)]
        near = there.mean(0) if len(there) else np.zeros(3)
        cameras = {name: camera for name, camera in experiment.cameras.items() if name in track.cameras}
        log_cameras(recording, cameras, near)
    log_sphere(recording, track, path, experiment, when)
    log_series(recording, track, when)
    if experiment is not None and every:
        log_pictures(recording, track, experiment, np.arange(0, len(track), every), set_time, progress)


def _layout(track: Trajectory, experiment: Experiment | None) -> Any:
    """The windows: space, one a camera, the series as tabs, the doubts."""
    import rerun as rr
    import rerun.blueprint as rrb

    space = rrb.Spatial3DView(origin="lab", name="lab")
    names = [] if experiment is None else [name for name in experiment.cameras if name in track.cameras]
    shown = [rrb.Spatial2DView(origin=f"lab/{name}/picture", name=name) for name in names]
    plots = [rrb.TimeSeriesView(origin=rr.new_entity_path(["plots", name]), name=name) for name in PLOTS]
    log = rrb.TextLogView(origin="doubts", name="doubts")
    above = rrb.Horizontal(space, rrb.Vertical(*shown), column_shares=[2, 1]) if shown else space
    return rrb.Blueprint(rrb.Vertical(above, rrb.Tabs(*plots, log), row_shares=[2, 1]), collapse_panels=True)
