"""The track of a perfect tracker for the excerpt, for figures of tracks."""

import sys
from dataclasses import replace
from functools import cache

import h5py
import numpy as np
import pytest
import torch
from conftest import REPO

from sphereorient import cli
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.trajectory import CameraTrack, Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt"
RADIUS_MM = 9.0


@cache
def excerpt() -> Experiment:
    return load_experiment(EXCERPT / "experiment.yaml")


def true_track(names: tuple[str, ...] = ("cam1", "cam2"), first: int = 0, last: int = 40) -> Trajectory:
    with h5py.File(EXCERPT / "truth.h5") as file:
        keys = ("time", "position", "orientation", "velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab")
        true = {key: file[key][first:last] for key in keys}
        centres = {name: file[name]["centre_px"][first:last] for name in names}
    frames = len(true["time"])
    position = torch.from_numpy(true["position"])
    seen = {}
    for name in names:
        camera = excerpt().cameras[name]
        side = position + RADIUS_MM * camera.R_cam_lab[0]
        seen[name] = replace(
            CameraTrack.empty(frames),
            centre_px=centres[name],
            radius_px=(camera.project(side) - camera.project(position)).norm(dim=1).numpy(),
            orientation=true["orientation"],
            score=np.full(frames, 0.95) + 1e-4 * np.arange(frames),
            reason=("ok",) * frames,
        )
    track = Trajectory.empty(true["time"], cameras=names, frame_rate=600.0, method="precise", experiment="excerpt")
    more = {"valid": np.ones(frames, bool), "segment": np.zeros(frames, np.int64)}
    smooth = {"position_smooth": true["position"], "orientation_smooth": true["orientation"]}
    return replace(track, **true, **more, **smooth, cameras=seen)


def changed(track: Trajectory, rows: slice | int, **values: object) -> Trajectory:
    """The same track with other values in some frames."""
    parts = {name: np.array(getattr(track, name)) for name in values}
    for name, value in values.items():
        parts[name][rows] = value
    return replace(track, **parts)


def camera_changed(track: Trajectory, name: str, rows: slice | int, reason: str | None = None, **values: object):
    """The same track with other values of one camera in some frames."""
    camera = track.cameras[name]
    parts: dict[str, object] = {}
    for key, value in values.items():
        parts[key] = np.array(getattr(camera, key))
        parts[key][rows] = value
    if reason is not None:
        reasons = np.array(camera.reason, dtype=object)
        reasons[rows] = reason
        parts["reason"] = tuple(reasons)
    return replace(track, cameras=dict(track.cameras) | {name: replace(camera, **parts)})


def command(monkeypatch, capsys, *arguments: object) -> tuple[int, str, str]:
    """Run the command line in this process: exit code, output, errors."""
    monkeypatch.setattr(sys, "argv", ["sphereorient", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    printed = capsys.readouterr()
    return int(stop.value.code or 0), printed.out, printed.err
