"""The noun that goes in: an experiment, its cameras, its movies, and which frame is when."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictBool

from sphereorient.cameras import Camera, ParameterCovariance, load_cameras, load_covariance
from sphereorient.cameras.yaml_file import read_document, refuse_unknown, validated, write_document
from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.movies import Movie, open_movie

SCHEMA = "sphereorient-experiment/1"
MAX_CAMERAS = 2
Positive = Annotated[FiniteFloat, Field(gt=0)]
FrameNumber = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """What experiment.yaml says; made by `load_experiment` or synth, read by everyone who opens movies."""

    name: str
    path: Path  # of experiment.yaml
    frame_rate_hz: float
    cameras_path: Path
    cameras: dict[str, Camera]  # of the movies, in their order
    movie_paths: dict[str, Path]
    exposure_s: float | None = None
    diameter_mm: float | None = None  # None: not known, lengths are in radii
    texture_path: Path | None = None  # None: to be learnt
    fixed: bool = False  # whether the ball does not move
    mask_paths: dict[str, Path] = field(default_factory=dict)  # black where something that does not move hides the ball
    background_paths: dict[str, Path] = field(default_factory=dict)  # the scene without the ball
    start: dict[str, int] = field(default_factory=dict)  # frame of each movie that is the experiment's frame 0
    frames: tuple[int, int] | None = None  # first, last + 1 of the experiment; None: all
    flow: dict[str, float] = field(default_factory=dict)  # SI
    camera_covariance: ParameterCovariance | None = None  # of the cameras' parameters, named camera.parameter

    @property
    def folder(self) -> Path:
        """The folder that paths in the file are relative to."""
        return self.path.parent


class SphereKeys(BaseModel):
    """The key `sphere`."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    diameter: Positive | None
    texture: str | None = None
    fixed: StrictBool = False


class FlowKeys(BaseModel):
    """The key `flow`, SI."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    viscosity: Positive | None = None
    dissipation: Positive | None = None
    u_rms: Positive | None = None
    integral_length: Positive | None = None


class ExperimentKeys(BaseModel):
    """The keys of experiment.yaml (DESIGN section 2)."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    name: str | None = None
    frame_rate: Positive
    exposure: Positive | None = None
    sphere: SphereKeys
    masks: dict[str, str] = Field(default_factory=dict)
    backgrounds: dict[str, str] = Field(default_factory=dict)
    cameras: str
    movies: dict[str, str] = Field(min_length=1, max_length=MAX_CAMERAS)
    start: dict[str, FrameNumber] = Field(default_factory=dict)
    frames: tuple[FrameNumber, FrameNumber] | None = None
    flow: FlowKeys = FlowKeys()
    times: Any = None  # known, so that it is refused as what it is and not as a mistyped key


def load_experiment(path: Path | str) -> Experiment:
    """Read experiment.yaml and the cameras that it names; movies, masks and texture are opened by who needs them.

    Args:
        path: the YAML file; paths in it are relative to its folder.

    Raises:
        ExperimentError: missing, malformed or inconsistent.
        CameraError: the cameras' file is missing or malformed.

    Source: DESIGN section 2.
    """
    path = Path(path)
    document = read_document(path, SCHEMA, ExperimentError)
    _refuse_times(path, document)
    keys = validated(ExperimentKeys, document, str(path), ExperimentError)
    _check_names(path, keys)
    _check_numbers(path, keys)
    cameras_path = path.parent / keys.cameras
    cameras = _cameras_of(cameras_path, keys.movies)
    return Experiment(
        name=path.stem if keys.name is None else keys.name,
        path=path,
        frame_rate_hz=keys.frame_rate,
        cameras_path=cameras_path,
        cameras=cameras,
        camera_covariance=load_covariance(cameras_path, cameras),
        movie_paths={name: path.parent / movie for name, movie in keys.movies.items()},
        exposure_s=keys.exposure,
        diameter_mm=keys.sphere.diameter,
        texture_path=None if keys.sphere.texture is None else path.parent / keys.sphere.texture,
        fixed=keys.sphere.fixed,
        mask_paths={name: path.parent / mask for name, mask in keys.masks.items()},
        background_paths={name: path.parent / picture for name, picture in keys.backgrounds.items()},
        start={name: keys.start.get(name, 0) for name in keys.movies},
        frames=keys.frames,
        flow=keys.flow.model_dump(exclude_none=True),
    )


def write_experiment(experiment: Experiment, comment: str = "") -> Path:
    """Write an experiment to its `path`, with paths relative to it, and return the path.

    The cameras' file is not written: `save_cameras(experiment.cameras_path, experiment.cameras)` does that.

    Args:
        experiment: what to write.
        comment: lines for the top of the file.

    Raises:
        OutputError: the file cannot be written.
    """

    def relative(path: Path) -> str:
        return Path(os.path.relpath(path, experiment.folder)).as_posix()

    sphere: dict[str, Any] = {"diameter": experiment.diameter_mm}
    if experiment.texture_path is not None:
        sphere["texture"] = relative(experiment.texture_path)
    if experiment.fixed:
        sphere["fixed"] = True
    optional: dict[str, Any] = {
        "masks": {name: relative(path) for name, path in experiment.mask_paths.items()},
        "backgrounds": {name: relative(path) for name, path in experiment.background_paths.items()},
        "start": {name: number for name, number in experiment.start.items() if number},
        "frames": None if experiment.frames is None else list(experiment.frames),
        "flow": dict(experiment.flow),
    }
    document = {
        "name": experiment.name,
        "frame_rate": float(experiment.frame_rate_hz),
        **({} if experiment.exposure_s is None else {"exposure": float(experiment.exposure_s)}),
        "sphere": sphere,
        "cameras": relative(experiment.cameras_path),
        "movies": {name: relative(path) for name, path in experiment.movie_paths.items()},
        **{key: value for key, value in optional.items() if value},
    }
    write_document(experiment.path, SCHEMA, document, comment)
    return experiment.path


def open_movies(experiment: Experiment, names: Sequence[str] | None = None) -> dict[str, Movie]:
    """Open the movies of an experiment and check that they fit the cameras and each other.

    Args:
        experiment: which movies.
        names: of the cameras wanted; all if None.

    Returns:
        Name -> movie; close them when done.

    Raises:
        ExperimentError: a name that the experiment does not have.
        MovieError: a movie is missing or unreadable, of another size than its camera's picture, too short for
            `frames`, or, without `frames`, of another length than the other one.
    """
    movies: dict[str, Movie] = {}
    try:
        for name in experiment.movie_paths if names is None else names:
            if name not in experiment.movie_paths:
                raise ExperimentError(refuse_unknown(name, experiment.movie_paths, f"{experiment.path}, movies"))
            movies[name] = open_movie(experiment.movie_paths[name])
            _check_size(experiment, name, movies[name])
        _check_lengths(experiment, movies)
    except BaseException:
        for movie in movies.values():
            movie.close()
        raise
    return movies


def frame_numbers(experiment: Experiment, movies: Mapping[str, Movie]) -> range:
    """Return the numbers of the experiment's frames: those of `frames`, or all that every movie has.

    Args:
        experiment: the experiment.
        movies: its movies, as `open_movies` returns them.
    """
    if experiment.frames is not None:
        return range(*experiment.frames)
    return range(min(_available(experiment, movies).values(), default=0))


def movie_span(experiment: Experiment, name: str, numbers: range) -> tuple[int, int]:
    """Return first and last + 1 of a movie's own frames, for `Movie.frames`, that are these of the experiment.

    Args:
        experiment: the experiment.
        name: of the camera.
        numbers: consecutive frame numbers of the experiment, not empty.
    """
    start = experiment.start.get(name, 0)
    return numbers.start + start, numbers.stop + start


def time_s(experiment: Experiment, numbers: Sequence[int]) -> NDArray[np.float64]:
    """Return the times of frames of the experiment, (N,), s: the middle of their exposures.

    Args:
        experiment: gives the frame rate.
        numbers: of the experiment's frames; time does not restart where `frames` cuts.

    Source: DESIGN section 2 (Time). The stamps of the movie file take no part: MKV rounds them to 1 ms.
    """
    return np.asarray(numbers, dtype=np.float64) / experiment.frame_rate_hz


def _refuse_times(path: Path, document: Mapping[str, Any]) -> None:
    if document.get("times") is not None:
        do = "write frame_rate: in Hz"
        got = "a table of times, which this version cannot use"
        raise ExperimentError(refusal(f"{path}, times", expected="evenly spaced frames", got=got, do=do))


def _check_names(path: Path, keys: ExperimentKeys) -> None:
    for key, named in (("masks", keys.masks), ("backgrounds", keys.backgrounds), ("start", keys.start)):
        for name in named:
            if name not in keys.movies:
                raise ExperimentError(refuse_unknown(name, keys.movies, f"{path}, {key}"))


def _check_numbers(path: Path, keys: ExperimentKeys) -> None:
    if keys.frames is not None and keys.frames[0] >= keys.frames[1]:
        do = "write first and last + 1"
        raise ExperimentError(refusal(f"{path}, frames", expected="first below last", got=str(keys.frames), do=do))
    if keys.exposure is not None and keys.exposure > 1 / keys.frame_rate:
        expected, do = f"at most the time between frames, {1 / keys.frame_rate:.4g} s", "write it in seconds"
        raise ExperimentError(refusal(f"{path}, exposure", expected=expected, got=f"{keys.exposure:g}", do=do))


def _cameras_of(cameras_path: Path, movies: Mapping[str, str]) -> dict[str, Camera]:
    known = load_cameras(cameras_path)
    for name in movies:
        if name not in known:
            raise ExperimentError(refuse_unknown(name, known, f"{cameras_path}, camera of movie {name}"))
    return {name: known[name] for name in movies}


def _check_size(experiment: Experiment, name: str, movie: Movie) -> None:
    width, height = experiment.cameras[name].image_size
    if movie.frame_shape != (height, width):
        expected = f"{width} x {height} px as camera {name} in {experiment.cameras_path}"
        got = f"{movie.frame_shape[1]} x {movie.frame_shape[0]}"
        do = "calibrate the camera with this movie's picture size"
        raise MovieError(refusal(str(movie.path), expected=expected, got=got, do=do))


def _available(experiment: Experiment, movies: Mapping[str, Movie]) -> dict[str, int]:
    """Return how many frames of the experiment each movie has, counted from the experiment's frame 0."""
    return {name: len(movie) - experiment.start.get(name, 0) for name, movie in movies.items()}


def _check_lengths(experiment: Experiment, movies: Mapping[str, Movie]) -> None:
    available = _available(experiment, movies)
    got = " and ".join(f"{count} ({name})" for name, count in available.items())
    subject = f"{experiment.path}, movies"
    if experiment.frames is not None:
        if min(available.values()) < experiment.frames[1]:
            expected, do = f"{experiment.frames[1]} frames as frames: says", "lower the end of frames:"
            raise MovieError(refusal(subject, expected=expected, got=f"{got} after start", do=do))
    elif min(available.values()) <= 0:
        raise MovieError(refusal(subject, expected="frames after start", got=got, do="correct start:"))
    elif len(set(available.values())) > 1:
        do = f"check start:, then set frames: [0, {min(available.values())}]"
        raise MovieError(refusal(subject, expected="equal frame counts", got=f"{got} after start", do=do))
