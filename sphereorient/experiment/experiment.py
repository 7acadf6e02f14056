import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, FiniteFloat, StrictBool

from sphereorient.cameras import Camera, ParameterCovariance, load_cameras, load_covariance
from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.files.whole_file import relative_path
from sphereorient.files.yaml_file import read_document, refuse_unknown, validated, write_document
from sphereorient.movies import Movie, flipped, is_movie, movie_files, open_movie
from sphereorient.sphere import seen_path

SCHEMA = "sphereorient-experiment/1"
MAX_CAMERAS = 8
MOVIES_OWN = "movies"  # value of `times`
Positive = Annotated[FiniteFloat, Field(gt=0)]
FrameNumber = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """Content of experiment.yaml; made by `load_experiment` or synth."""

    name: str
    path: Path
    frame_rate_hz: float  # NaN if times are given instead
    cameras_path: Path
    cameras: dict[str, Camera]  # of the movies, in their order
    movie_paths: dict[str, Path]
    exposure_s: float | None = None
    diameter_mm: float | None = None  # None: unknown, lengths are in radii
    texture_path: Path | None = None  # None: to be estimated
    fixed: bool = False  # whether the centre is fixed
    mask_paths: dict[str, Path] = field(default_factory=dict)  # black where something static hides the sphere
    background_paths: dict[str, Path] = field(default_factory=dict)  # scene without the sphere
    times: str | None = None  # path of a table, or "movies": their time stamps; None: constant frame rate
    start: dict[str, int] = field(default_factory=dict)  # frame of each movie that is the experiment's frame 0
    start_given: bool = False  # whether the file has `start`; time stamps then begin there
    flip: dict[str, str] = field(default_factory=dict)  # mirrored movies, see movies.flipped
    frames: tuple[int, int] | None = None  # first, last + 1; None: all
    flow: dict[str, float] = field(default_factory=dict)  # SI
    camera_covariance: ParameterCovariance | None = None  # parameters are named camera.parameter

    @property
    def folder(self) -> Path:
        """Folder of experiment.yaml; its paths are relative to it."""
        return self.path.parent

    @property
    def length_unit(self) -> str:
        """Unit of all lengths of a track: mm, or radii of a sphere of unknown diameter."""
        return "radii" if self.diameter_mm is None else "mm"

    @property
    def radius_mm(self) -> float:
        """Radius of the sphere; 1 if its diameter is unknown and lengths are in radii."""
        return 1.0 if self.diameter_mm is None else self.diameter_mm / 2


class SphereKeys(BaseModel, frozen=True, extra="forbid"):
    """The key `sphere`."""

    diameter: Positive | None
    texture: str | None = None
    fixed: StrictBool = False


class FlowKeys(BaseModel, frozen=True, extra="forbid"):
    """The key `flow`, SI."""

    viscosity: Positive | None = None
    dissipation: Positive | None = None
    u_rms: Positive | None = None
    integral_length: Positive | None = None
    integral_time: Positive | None = None


class ExperimentKeys(BaseModel, frozen=True, extra="forbid"):
    """The keys of experiment.yaml (docs/data-format.md)."""

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
    """Read experiment.yaml and its cameras; movies and pictures are not opened.

    Raises:
        ExperimentError: missing, malformed or inconsistent file.
        CameraError: missing or malformed cameras file.
    """
    path = Path(path)
    if is_movie(path):
        do = f"write its experiment.yaml first: `sphereorient init {path}`"
        raise ExperimentError(refusal(str(path), expected="an experiment.yaml", got="a movie", do=do))
    do = "write one with `sphereorient init MOVIE`, or correct the path"
    document = read_document(path, SCHEMA, ExperimentError, do)
    untimed = () if {"frame_rate", "times"} & document.keys() else ("frame_rate or times",)
    keys = validated(ExperimentKeys, document, str(path), ExperimentError, untimed)
    for key in ("masks", "backgrounds", "start", "flip"):
        for name in getattr(keys, key):
            if name not in keys.movies:
                raise ExperimentError(refuse_unknown(name, keys.movies, f"{path}, {key}"))
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
    """Write an experiment, without its cameras, to its `path`, and return the path; `comment` stands at the top.

    Raises:
        OutputError: file not writable.
    """

    def relative(path: Path | str) -> str:
        return relative_path(path, experiment.folder)

    times, texture = experiment.times, experiment.texture_path
    sphere: dict[str, Any] = {"diameter": experiment.diameter_mm}
    sphere |= {} if texture is None else {"texture": relative(texture)}
    sphere |= {"fixed": True} if experiment.fixed else {}
    document: dict[str, Any] = {
        "name": experiment.name,
        "frame_rate": float(experiment.frame_rate_hz) if times is None else None,
        "times": times if times in (None, MOVIES_OWN) else relative(str(times)),
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
    """Open the movies of the named cameras (None: all) and check their picture sizes.

    Raises:
        ExperimentError: unknown camera name.
        MovieError: missing, unreadable, or of another size than the camera.
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
    """Return the input paths for the named cameras (None: all), each with its files."""
    used = list(experiment.movie_paths) if names is None else list(names)
    single = [experiment.path, experiment.cameras_path]
    for paths in (experiment.background_paths, experiment.mask_paths):
        single += [paths[name] for name in used if name in paths]
    if experiment.texture_path is not None:
        counts = seen_path(experiment.texture_path)
        single += [experiment.texture_path, *([counts] if counts.is_file() else [])]
    if experiment.times not in (None, MOVIES_OWN):
        single.append(Path(str(experiment.times)))
    movies = [experiment.movie_paths[name] for name in used if name in experiment.movie_paths]
    return {path: [path] for path in single} | {path: movie_files(path) for path in movies}


def outside_paths(experiment: Experiment) -> list[Path]:
    """Return the inputs outside the experiment's folder."""
    folder = Path(os.path.realpath(experiment.folder))
    return [path for path in input_files(experiment) if not Path(os.path.realpath(path)).is_relative_to(folder)]


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
