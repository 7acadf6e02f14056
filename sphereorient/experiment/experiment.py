"""The input of a measurement: an experiment, its cameras and its movies, read from experiment.yaml."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StrictBool

from sphereorient.cameras import Camera, ParameterCovariance, load_cameras, load_covariance
from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.files.yaml_file import read_document, refuse_unknown, validated, write_document
from sphereorient.movies import Movie, flipped, movie_files, open_movie

SCHEMA = "sphereorient-experiment/1"
MAX_CAMERAS = 2
MOVIES_OWN = "movies"  # value of `times`
Positive = Annotated[FiniteFloat, Field(gt=0)]
FrameNumber = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """The content of experiment.yaml; made by `load_experiment` or synth, read by everyone who opens movies."""

    name: str
    path: Path  # of experiment.yaml
    frame_rate_hz: float  # NaN where times are given instead
    cameras_path: Path
    cameras: dict[str, Camera]  # of the movies, in their order
    movie_paths: dict[str, Path]
    exposure_s: float | None = None
    diameter_mm: float | None = None  # None: not known, lengths are in radii
    texture_path: Path | None = None  # None: to be learnt
    fixed: bool = False  # whether the ball does not move
    mask_paths: dict[str, Path] = field(default_factory=dict)  # black where something that does not move hides the ball
    background_paths: dict[str, Path] = field(default_factory=dict)  # the scene without the ball
    times: str | None = None  # path of a table of times, or "movies": their own stamps; None: evenly spaced frames
    start: dict[str, int] = field(default_factory=dict)  # frame of each movie that is the experiment's frame 0
    start_given: bool = False  # whether the file says so; with stamps each camera's clock then begins there
    flip: dict[str, str] = field(default_factory=dict)  # movies seen through a mirror: see movies.flipped
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
    """The keys of experiment.yaml (docs/data-format.md)."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    name: str | None = None
    frame_rate: Positive | None = None
    times: str | None = None
    exposure: Positive | None = None
    sphere: SphereKeys
    masks: dict[str, str] = Field(default_factory=dict)
    backgrounds: dict[str, str] = Field(default_factory=dict)
    cameras: str
    movies: dict[str, str] = Field(min_length=1, max_length=MAX_CAMERAS)
    start: dict[str, FrameNumber] = Field(default_factory=dict)
    frames: tuple[FrameNumber, FrameNumber] | None = None
    flip: dict[str, Literal["none", "vertical", "horizontal", "both"]] = Field(default_factory=dict)
    flow: FlowKeys = FlowKeys()


def load_experiment(path: Path | str) -> Experiment:
    """Read experiment.yaml, with paths relative to its folder, and its cameras; movies and pictures are not opened.

    Raises:
        ExperimentError: missing, malformed or inconsistent.
        CameraError: the cameras' file is missing or malformed.
    """
    path = Path(path)
    document = read_document(path, SCHEMA, ExperimentError)
    keys = validated(ExperimentKeys, document, str(path), ExperimentError)
    _check_names(path, keys)
    _check_numbers(path, keys)
    cameras_path = path.parent / keys.cameras
    known = load_cameras(cameras_path)
    for name in keys.movies:
        if name not in known:
            raise ExperimentError(refuse_unknown(name, known, f"{cameras_path}, camera of movie {name}"))
    cameras = {name: known[name] for name in keys.movies}
    return Experiment(
        name=path.stem if keys.name is None else keys.name,
        path=path,
        frame_rate_hz=float("nan") if keys.frame_rate is None else keys.frame_rate,
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
        times=keys.times if keys.times in (None, MOVIES_OWN) else str(path.parent / str(keys.times)),
        start={name: keys.start.get(name, 0) for name in keys.movies},
        start_given=bool(keys.start),
        flip=dict(keys.flip),
        frames=keys.frames,
        flow=keys.flow.model_dump(exclude_none=True),
    )


def write_experiment(experiment: Experiment, comment: str = "") -> Path:
    """Write an experiment to its `path`, with `comment` at the top, and return the path.

    The cameras' file is not written: see `save_cameras`.

    Raises:
        OutputError: the file cannot be written.
    """

    def relative(path: Path) -> str:
        return Path(os.path.relpath(path, experiment.folder)).as_posix()

    timed, texture = experiment.times is not None, experiment.texture_path
    table = MOVIES_OWN if experiment.times == MOVIES_OWN else relative(Path(str(experiment.times)))
    sphere: dict[str, Any] = {"diameter": experiment.diameter_mm}
    sphere |= {} if texture is None else {"texture": relative(texture)}
    sphere |= {"fixed": True} if experiment.fixed else {}
    document: dict[str, Any] = {
        "name": experiment.name,
        "frame_rate": None if timed else float(experiment.frame_rate_hz),
        "times": table if timed else None,
        "exposure": None if experiment.exposure_s is None else float(experiment.exposure_s),
        "sphere": sphere,
        "cameras": relative(experiment.cameras_path),
        "movies": {name: relative(path) for name, path in experiment.movie_paths.items()},
        "masks": {name: relative(path) for name, path in experiment.mask_paths.items()},
        "backgrounds": {name: relative(path) for name, path in experiment.background_paths.items()},
        "start": {name: number for name, number in experiment.start.items() if number},
        "frames": None if experiment.frames is None else list(experiment.frames),
        "flip": dict(experiment.flip),
        "flow": dict(experiment.flow),
    }
    document = {key: value for key, value in document.items() if value not in (None, {})}
    write_document(experiment.path, SCHEMA, document, comment)
    return experiment.path


def open_movies(experiment: Experiment, names: Sequence[str] | None = None) -> dict[str, Movie]:
    """Open the movies of an experiment, all or those of the named cameras, and check that they fit the cameras.

    Raises:
        ExperimentError: a name that the experiment does not have.
        MovieError: a movie is missing or unreadable, or of another size than its camera's picture.
    """
    movies: dict[str, Movie] = {}
    for name in experiment.movie_paths if names is None else names:
        if name not in experiment.movie_paths:
            raise ExperimentError(refuse_unknown(name, experiment.movie_paths, f"{experiment.path}, movies"))
        movie = flipped(open_movie(experiment.movie_paths[name]), experiment.flip.get(name, "none"))
        width, height = experiment.cameras[name].image_size
        if movie.frame_shape != (height, width):
            expected = f"{width} x {height} px as camera {name} in {experiment.cameras_path}"
            got = f"{movie.frame_shape[1]} x {movie.frame_shape[0]}"
            do = "calibrate the camera with this movie's picture size"
            raise MovieError(refusal(str(movie.path), expected=expected, got=got, do=do))
        movies[name] = movie
    return movies


def input_files(experiment: Experiment, names: Sequence[str] | None = None) -> dict[Path, list[Path]]:
    """Return the inputs of an experiment for the named cameras or all, each with its files: itself, or its pictures."""
    used = list(experiment.movie_paths) if names is None else list(names)
    single = [experiment.path, experiment.cameras_path]
    for paths in (experiment.background_paths, experiment.mask_paths):
        single += [paths[name] for name in used if name in paths]
    if experiment.texture_path is not None:
        single.append(experiment.texture_path)
    if experiment.times not in (None, MOVIES_OWN):
        single.append(Path(str(experiment.times)))
    movies = [experiment.movie_paths[name] for name in used if name in experiment.movie_paths]
    return {path: [path] for path in single} | {path: movie_files(path) for path in movies}


def outside_paths(experiment: Experiment) -> list[Path]:
    """Return the inputs of an experiment that lie outside of its own folder."""
    folder = Path(os.path.realpath(experiment.folder))
    return [path for path in input_files(experiment) if not Path(os.path.realpath(path)).is_relative_to(folder)]


def _check_names(path: Path, keys: ExperimentKeys) -> None:
    for key in ("masks", "backgrounds", "start", "flip"):
        for name in getattr(keys, key):
            if name not in keys.movies:
                raise ExperimentError(refuse_unknown(name, keys.movies, f"{path}, {key}"))


def _check_numbers(path: Path, keys: ExperimentKeys) -> None:
    if (keys.frame_rate is None) == (keys.times is None):
        got, do = "neither" if keys.times is None else "both", "write frame_rate: in Hz, or times: with a file"
        raise ExperimentError(refusal(str(path), expected="either frame_rate or times", got=got, do=do))
    if keys.frames is not None and keys.frames[0] >= keys.frames[1]:
        do = "write first and last + 1"
        raise ExperimentError(refusal(f"{path}, frames", expected="first below last", got=str(keys.frames), do=do))
    if keys.exposure is not None and keys.frame_rate is not None and keys.exposure > 1 / keys.frame_rate:
        expected, do = f"at most the time between frames, {1 / keys.frame_rate:.4g} s", "write it in seconds"
        raise ExperimentError(refusal(f"{path}, exposure", expected=expected, got=f"{keys.exposure:g}", do=do))
