"""An experiment opened: its frames, its cameras' pictures, the paint. What the stages of a method work on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import locate
from sphereorient.cameras import Camera, ParameterCovariance
from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment import Experiment, load_experiment, open_movies, outside_paths
from sphereorient.movies import flipped_picture
from sphereorient.reel import Reel
from sphereorient.settings import Settings
from sphereorient.sphere import load_texture
from sphereorient.timeline import Rows, Timeline, timeline

Progress = Callable[[str, int, int], None]  # (stage, frames done, frames in all); the command line draws a bar


def silent(stage: str, done: int, total: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """An experiment whose movies are open; made by `open_recording`, read by the methods."""

    experiment: Experiment
    reels: Sequence[Reel]
    timeline: Timeline
    texture: Tensor
    remarks: tuple[str, ...]  # what a user should know of the inputs

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras in use."""
        return {reel.name: reel.camera for reel in self.reels}

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

    def diameter_px(self, name: str, settings: Settings) -> float:
        """Return the expected diameter of the sphere's picture in one camera."""
        given = settings.locate.diameter_px
        return given or locate.expected_diameter_px(name, self.cameras, self.experiment.diameter_mm)

    def empty_scene(self, reel: Reel, count: int, settings: Settings) -> locate.Background:
        """Learn what one camera shows without the ball, from `count` frames or the experiment's own picture."""
        empty = given_scene(self.experiment, reel.name, reel.movie.frame_shape)
        diameter_px = self.diameter_px(reel.name, settings)
        return locate.learn_background(reel.spread(count), diameter_px, settings.locate, empty)

    def gridded(self) -> tuple[Recording, Rows]:
        """Return the recording on an even grid of times, and the places of its frames in it; see `Timeline`."""
        grid, place = self.timeline.gridded()
        reels = [replace(reel, rows=grid.rows[reel.name]) for reel in self.reels]
        return replace(self, timeline=grid, reels=reels), place


def given_scene(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return the experiment's own picture of a camera's scene without the ball, None where it gives none."""
    path = experiment.background_paths.get(name)
    if path is None:
        return None
    # It is a frame of the movie as its file holds it.
    return flipped_picture(locate.load_background(path, frame_shape), experiment.flip.get(name, "none"))


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
    names = _chosen(experiment, cameras)
    texture = load_texture(_texture_path(experiment))
    _refuse_unsupported(experiment, names)
    movies = open_movies(experiment, names)
    try:
        frames = timeline(experiment, movies)
        reels = [
            Reel(name=name, camera=experiment.cameras[name], movie=movies[name], rows=frames.rows[name])
            for name in names
        ]
        outside = outside_paths(experiment)
        remarks = [f"{experiment.path}: reads outside of its folder: {path}" for path in outside]
        remarks += [f"{movie.path}: {remark}" for movie in movies.values() for remark in movie.remarks]
        yield Recording(
            experiment=experiment,
            reels=reels,
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
        do = "give sphere.texture; learning it from the movie is not part of this version"
        raise ExperimentError(refusal(str(experiment.path), expected="a texture", got="none", do=do))
    return experiment.texture_path


def _refuse_unsupported(experiment: Experiment, names: Sequence[str]) -> None:
    """Refuse what the file may say and this version would ignore: a wrong result is worse than none."""
    if any(name in experiment.mask_paths for name in names):
        do = "remove masks: and see how far the method gets without them"
        raise ExperimentError(refusal(f"{experiment.path}, masks", expected="none", got="masks", do=do))
    if experiment.fixed and not all(name in experiment.background_paths for name in names):
        do = "give backgrounds: pictures of the scene without the ball; a ball at rest is part of the movie's own"
        got = "a fixed ball without them"
        raise ExperimentError(refusal(f"{experiment.path}", expected="backgrounds of all cameras", got=got, do=do))
