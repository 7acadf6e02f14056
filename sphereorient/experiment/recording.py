"""An experiment opened: its frames, its cameras' pictures, the paint. What the stages of a method work on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sphereorient.cameras import Camera, ParameterCovariance
from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment.experiment import Experiment, load_experiment, open_movies, outside_paths
from sphereorient.experiment.given import given_mask
from sphereorient.experiment.stream import CameraStream
from sphereorient.experiment.timeline import Rows, Timeline, timeline
from sphereorient.sphere import load_texture

Progress = Callable[[str, int, int], None]  # (stage, frames done, frames in all); the command line draws a bar


def silent(stage: str, done: int, total: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """An experiment whose movies are open; made by `open_recording`, read by the methods."""

    experiment: Experiment
    streams: Sequence[CameraStream]
    timeline: Timeline
    texture: Tensor  # (H, 2 H); (0, 0) where it is to be learnt
    remarks: tuple[str, ...]  # what a user should know of the inputs

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras in use."""
        return {stream.name: stream.camera for stream in self.streams}

    @property
    def frames(self) -> range:
        """Numbers of the experiment's frames."""
        number = self.timeline.number
        return range(int(number[0]), int(number[-1]) + 1)

    @property
    def clock(self) -> Tensor:
        """Times of the frames, (N,), s."""
        return torch.from_numpy(self.timeline.time_s)

    @property
    def radius_mm(self) -> float:
        """Radius of the sphere; 1 where lengths are in radii."""
        return 1.0 if self.experiment.diameter_mm is None else self.experiment.diameter_mm / 2

    @property
    def covariance(self) -> ParameterCovariance | None:
        """Covariance of the parameters of the cameras in use."""
        whole = self.experiment.camera_covariance
        return None if whole is None else whole.of(list(self.cameras))

    def gridded(self) -> tuple[Recording, Rows]:
        """Return the recording on an even grid of times, and the places of its frames in it; see `Timeline`."""
        grid, place = self.timeline.gridded()
        streams = [replace(stream, rows=grid.rows[stream.name]) for stream in self.streams]
        return replace(self, timeline=grid, streams=streams), place


@contextmanager
def open_recording(source: Experiment | str | Path, cameras: Sequence[str] | None = None) -> Iterator[Recording]:
    """Open an experiment for tracking, and close its movies at the end.

    Args:
        source: the experiment as loaded, or the path of its experiment.yaml.
        cameras: names of those to use; None: all.

    Raises:
        SphereOrientError: inputs that are missing, unreadable or do not fit together.
    """
    experiment = source if isinstance(source, Experiment) else load_experiment(Path(source))
    texture = load_texture(_texture_path(experiment))
    with _opened(experiment, cameras, texture) as recording:
        yield recording


@contextmanager
def open_unpainted(source: Experiment | str | Path, cameras: Sequence[str] | None = None) -> Iterator[Recording]:
    """Open an experiment whose map is to be learnt; its `texture`, if any, is not looked at.

    Args:
        source: the experiment as loaded, or the path of its experiment.yaml.
        cameras: names of those to use; None: all.

    Raises:
        SphereOrientError: inputs that are missing, unreadable or do not fit together.
    """
    experiment = source if isinstance(source, Experiment) else load_experiment(Path(source))
    with _opened(experiment, cameras, torch.empty(0, 0)) as recording:
        yield recording


@contextmanager
def _opened(experiment: Experiment, cameras: Sequence[str] | None, texture: Tensor) -> Iterator[Recording]:
    names = _chosen(experiment, cameras)
    movies = open_movies(experiment, names)
    try:
        frames = timeline(experiment, movies)
        streams = [
            CameraStream(
                name=name,
                camera=experiment.cameras[name],
                movie=movies[name],
                rows=frames.rows[name],
                shown=given_mask(experiment, name, movies[name].frame_shape),
            )
            for name in names
        ]
        outside = outside_paths(experiment)
        remarks = [f"{experiment.path}: reads outside of its folder: {path}" for path in outside]
        remarks += [f"{movie.path}: {remark}" for movie in movies.values() for remark in movie.remarks]
        yield Recording(
            experiment=experiment,
            streams=streams,
            timeline=frames,
            texture=texture,
            remarks=(*remarks, *frames.remarks),
        )
    finally:
        for movie in movies.values():
            movie.close()


def _chosen(experiment: Experiment, cameras: Sequence[str] | None) -> list[str]:
    """Names of the cameras to use, in the experiment's order."""
    known = list(experiment.movie_paths)
    wanted = known if cameras is None else list(cameras)
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        got = ", ".join(unknown) or "none"
        raise ExperimentError(
            refusal("cameras", expected=" or ".join(known), got=got, do="name cameras of the experiment")
        )
    return [name for name in known if name in wanted]


def _texture_path(experiment: Experiment) -> Path:
    if experiment.texture_path is None:
        do = "learn it with `sphereorient map`, then write sphere.texture: the file that this gives"
        raise ExperimentError(refusal(str(experiment.path), expected="a texture", got="none", do=do))
    return experiment.texture_path
