import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from sphereorient.cameras import Camera, ParameterCovariance, load_cameras, load_covariance
from sphereorient.cameras.checks import check_known
from sphereorient.cameras.response import Response
from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.files.hdf5 import UNNAMED, names_a_group
from sphereorient.files.yaml_file import read_document, short, validated
from sphereorient.movies import Movie, flipped, is_movie, movie_files, open_movie
from sphereorient.sphere import seen_path

SCHEMA = "sphereorient-experiment/1"
MAX_CAMERAS = 8  # of an experiment, as all subsets may be tried
MOVIES_OWN = "movies"  # value of `times`
Positive = Annotated[FiniteFloat, Field(gt=0)]
FrameNumber = Annotated[int, Field(ge=0)]
MAP = "texture.png"  # default map of an experiment


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """One sphere of an experiment."""

    name: str = UNNAMED
    diameter_mm: float | None = None  # None: unknown, lengths are in radii
    texture_path: Path | None = None  # None: to be estimated
    fixed: bool = False  # whether the centre is fixed
    sways: bool = False  # whether it moves little or slowly, in a holder

    @property
    def in_place(self) -> bool:
        """Whether it stays in its place and is found by the pixels that change."""
        return self.fixed or self.sways


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """Content of experiment.yaml."""

    name: str
    path: Path
    frame_rate_hz: float  # NaN if times are given instead
    cameras_path: Path
    cameras: dict[str, Camera]  # of the movies, in their order
    movie_paths: dict[str, Path]
    exposure_s: float | None = None
    spheres: tuple[Sphere, ...] = (Sphere(),)
    mask_paths: dict[str, Path] = field(default_factory=dict)  # black where a static object hides the sphere
    background_paths: dict[str, Path] = field(default_factory=dict)  # scene without the sphere
    circles: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # of a fixed ball: u, v, radius, px
    times: str | None = None  # path of a table, or "movies" for their time stamps; None: constant frame rate
    time_unit: str = ""  # of times without a stated unit, see movies.stamps.UNITS; empty: s, unless doubtful
    start: dict[str, int] = field(default_factory=dict)  # frame of each movie that is the experiment's frame 0
    start_given: bool = False  # whether the file has `start`, at which time stamps then begin
    flip: dict[str, str] = field(default_factory=dict)  # mirrored movies, see movies.flipped
    response: dict[str, Response] = field(default_factory=dict)  # of the cameras with a given response
    frames: tuple[int, int] | None = None  # first, last + 1; None: all
    flow: dict[str, float] = field(default_factory=dict)  # SI
    devices: dict[str, "DeviceKeys"] = field(default_factory=dict)  # of the cameras with a key `camera`
    camera_covariance: ParameterCovariance | None = None  # parameters are named camera.parameter

    @property
    def folder(self) -> Path:
        """Folder of experiment.yaml; its paths are relative to it."""
        return self.path.parent

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the spheres; (UNNAMED,) if the file has `sphere:`."""
        return tuple(sphere.name for sphere in self.spheres)

    @property
    def alone(self) -> bool:
        """Whether there is one sphere only, so that no other can hide it or be confused with it."""
        return len(self.spheres) == 1

    def of(self, name: str) -> "Experiment":
        """Return the experiment with one of its spheres; ExperimentError if there is none of this name."""
        if name == UNNAMED:
            return replace(self, spheres=(self.sphere,))
        if self.names == (UNNAMED,):
            do = "name the experiment of the track"
            raise input_error(f"{self.path}, spheres", f"a ball {name}", "one without name", do)
        check_known([name], self.names, f"{self.path}, spheres", ExperimentError)
        return replace(self, spheres=(self.spheres[self.names.index(name)],))

    def with_sphere(self, **changes: Any) -> "Experiment":
        """Return the experiment with other fields of its only sphere; ExperimentError if it has several."""
        return replace(self, spheres=(replace(self.sphere, **changes),))

    @property
    def sphere(self) -> Sphere:
        """The only sphere; ExperimentError if there are several."""
        if not self.alone:
            do = "name a file with one of them under `sphere`, or take experiment.of(NAME) in Python"
            raise input_error(f"{self.path}, spheres", "one ball", ", ".join(self.names), do)
        return self.spheres[0]

    @property
    def diameter_mm(self) -> float | None:
        """Diameter of the only sphere; None: unknown."""
        return self.sphere.diameter_mm

    @property
    def texture_path(self) -> Path | None:
        """Texture map of the only sphere; None: to be estimated."""
        return self.sphere.texture_path

    @property
    def fixed(self) -> bool:
        """Whether the centre of the only sphere is fixed."""
        return self.sphere.fixed

    @property
    def mapless(self) -> bool:
        """Whether the only sphere has no texture map, which is then learnt from the movies."""
        return self.alone and (self.texture_path is None or not self.texture_path.exists())

    def new_map_path(self) -> Path:
        """Return the path for a learnt map: as named, or beside the experiment. Raises ExperimentError: a file exists
        that the experiment does not name.
        """
        path = self.texture_path or self.folder / MAP
        if path.exists():
            raise input_error(str(path), "no map there yet", "a file", "write it under sphere: texture:, or rename it")
        return path

    @property
    def length_unit(self) -> str:
        """Unit of all lengths of a track: mm, or radii for an only sphere of unknown diameter."""
        return "radii" if any(sphere.diameter_mm is None for sphere in self.spheres) else "mm"

    @property
    def radius_mm(self) -> float:
        """Radius of the only sphere; 1 if its diameter is unknown and lengths are in radii."""
        return 1.0 if self.diameter_mm is None else self.diameter_mm / 2


def input_error(name: str, expected: str, got: str, do: str) -> ExperimentError:
    """Return an ExperimentError worded by `refusal`."""
    return ExperimentError(refusal(name, expected=expected, got=got, do=do))


class SphereKeys(BaseModel, frozen=True, extra="forbid"):
    """The key `sphere`, and each sphere of `spheres`."""

    diameter: Positive | None
    texture: str | None = None
    fixed: Literal[True, False, "sways"] = False


class FlowKeys(BaseModel, frozen=True, extra="forbid"):
    """The key `flow`, SI."""

    viscosity: Positive | None = None
    dissipation: Positive | None = None
    u_rms: Positive | None = None
    integral_length: Positive | None = None
    integral_time: Positive | None = None


class DeviceKeys(BaseModel, frozen=True, extra="forbid"):
    """The key `camera` of a camera: settings of its device for `live`, beside the picture size; None: not set."""

    trigger: str | None = None  # the device's name of the line; none: free running
    exposure_ms: Positive | None = None
    rate_hz: Positive | None = None
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"] | None = None
    offset: tuple[FrameNumber, FrameNumber] | None = None  # px, of the picture's first pixel on the sensor


class ExperimentKeys(BaseModel, frozen=True, extra="forbid"):
    """The keys of experiment.yaml (docs/data-format.md)."""

    name: str | None = None
    frame_rate: Positive | None = None
    times: str | None = None
    time_unit: Literal["", "s", "ms", "us", "ns"] = ""
    exposure: Positive | None = None
    sphere: SphereKeys | None = None
    spheres: dict[str, SphereKeys] = Field(default_factory=dict, min_length=1)
    masks: dict[str, str] = Field(default_factory=dict)
    backgrounds: dict[str, str] = Field(default_factory=dict)
    circles: dict[str, tuple[FiniteFloat, FiniteFloat, Positive]] = Field(default_factory=dict)
    cameras: str
    movies: dict[str, str] = Field(min_length=1, max_length=MAX_CAMERAS)
    start: dict[str, FrameNumber] = Field(default_factory=dict)
    frames: tuple[FrameNumber, FrameNumber] | None = None
    flip: dict[str, Literal["none", "vertical", "horizontal", "both", "transpose"]] = Field(default_factory=dict)
    response: Any = None
    flow: FlowKeys = FlowKeys()
    camera: dict[str, DeviceKeys] = Field(default_factory=dict)


def load_experiment(source: Experiment | Path | str) -> Experiment:
    """Read experiment.yaml and its cameras, unless already read; movies and pictures are not opened.
    Raises ExperimentError (missing, malformed or inconsistent file), CameraError (the same for its cameras).
    """
    if isinstance(source, Experiment):
        return source
    path = Path(source)
    if is_movie(path):
        do = f"write its experiment.yaml first: `sphereorient init {path}`"
        raise input_error(str(path), "an experiment.yaml", "a movie", do)
    do = "write one with `sphereorient init MOVIE`, or correct the path"
    document = read_document(path, SCHEMA, ExperimentError, do)
    needed = (("frame_rate", "times"), ("sphere", "spheres"))
    missing = [" or ".join(either) for either in needed if not document.keys() & set(either)]
    keys = validated(ExperimentKeys, document, str(path), ExperimentError, missing)
    for key in ("masks", "backgrounds", "circles", "start", "flip", "camera"):
        check_known(getattr(keys, key), keys.movies, f"{path}, {key}", ExperimentError)
    _check_numbers(path, keys)
    _check_spheres(path, keys)
    cameras_path = path.parent / keys.cameras
    known = load_cameras(cameras_path)
    for name in keys.movies:
        check_known([name], known, f"{cameras_path}, camera of movie {name}", ExperimentError)
    cameras = {name: known[name] for name in keys.movies}

    def at(files: Mapping[str, str]) -> dict[str, Path]:
        return {name: path.parent / file for name, file in files.items()}

    def sphere(name: str, one: SphereKeys) -> Sphere:
        texture = None if one.texture is None else path.parent / one.texture
        return Sphere(
            name=name,
            diameter_mm=one.diameter,
            texture_path=texture,
            fixed=one.fixed is True,
            sways=one.fixed == "sways",
        )

    spheres = keys.spheres if keys.sphere is None else {UNNAMED: keys.sphere}
    return Experiment(
        name=path.stem if keys.name is None else keys.name,
        path=path,
        frame_rate_hz=float("nan") if keys.frame_rate is None else keys.frame_rate,
        cameras_path=cameras_path,
        cameras=cameras,
        camera_covariance=load_covariance(cameras_path, cameras),
        movie_paths=at(keys.movies),
        exposure_s=keys.exposure,
        spheres=tuple(sphere(name, one) for name, one in spheres.items()),
        mask_paths=at(keys.masks),
        background_paths=at(keys.backgrounds),
        circles=dict(keys.circles),
        times=keys.times if keys.times in (None, MOVIES_OWN) else str(path.parent / str(keys.times)),
        time_unit=keys.time_unit,
        start={name: keys.start.get(name, 0) for name in keys.movies},
        start_given=bool(keys.start),
        flip=dict(keys.flip),
        response=_responses(f"{path}, response", keys.response, list(keys.movies)),
        frames=keys.frames,
        flow=keys.flow.model_dump(exclude_none=True),
        devices=dict(keys.camera),
    )


def open_movies(experiment: Experiment, names: Sequence[str] | None = None) -> dict[str, Movie]:
    """Open the movies of the named cameras (None: all) and check their picture sizes.
    Raises ExperimentError (unknown camera name), MovieError (missing, unreadable, or of another size than the camera).
    """
    movies: dict[str, Movie] = {}
    for name in experiment.movie_paths if names is None else names:
        check_known([name], experiment.movie_paths, f"{experiment.path}, movies", ExperimentError)
        movie = flipped(open_movie(experiment.movie_paths[name]), experiment.flip.get(name, "none"))
        (width, height), (rows, columns) = experiment.cameras[name].image_size, movie.frame_shape
        if (rows, columns) != (height, width):
            expected = f"{width} x {height} px as camera {name} in {experiment.cameras_path}"
            got, do = f"{columns} x {rows}", "calibrate the camera with this movie's picture size"
            if (columns, rows) == (height, width):
                do = f"{do}, or write flip: {{{name}: transpose}} if rows are columns, as in files written by MATLAB"
            raise MovieError(refusal(str(movie.path), expected=expected, got=got, do=do))
        movies[name] = movie
    return movies


def input_files(experiment: Experiment, names: Sequence[str] | None = None) -> dict[Path, list[Path]]:
    """Return the input paths for the named cameras (None: all), each with its files."""
    used = list(experiment.movie_paths) if names is None else list(names)
    single = [experiment.path, experiment.cameras_path]
    for paths in (experiment.background_paths, experiment.mask_paths):
        single += [paths[name] for name in used if name in paths]
    for texture in (sphere.texture_path for sphere in experiment.spheres):
        if texture is not None:
            single += [texture, *(counts for counts in [seen_path(texture)] if counts.is_file())]
    if experiment.times not in (None, MOVIES_OWN):
        single.append(Path(str(experiment.times)))
    movies = [experiment.movie_paths[name] for name in used if name in experiment.movie_paths]
    return {path: [path] for path in single} | {path: movie_files(path) for path in movies}


def outside_paths(experiment: Experiment) -> list[Path]:
    """Return the inputs outside the experiment's folder."""
    folder = Path(os.path.realpath(experiment.folder))
    return [path for path in input_files(experiment) if not Path(os.path.realpath(path)).is_relative_to(folder)]


def _responses(where: str, given: Any, cameras: Sequence[str]) -> dict[str, Response]:
    """Return the response of each camera with a given one; a single response is for all."""
    if given is None:
        return {}
    if not isinstance(given, dict) or given.keys() == {"gamma"}:
        return dict.fromkeys(cameras, response_of(where, given))
    check_known(given, cameras, where, ExperimentError)
    return {name: response_of(f"{where}.{name}", one) for name, one in given.items()}


def response_of(where: str, given: Any) -> Response:
    """Return the response described by a value of the key `response`; ExperimentError, with `where`, if invalid."""
    with suppress(ValueError, TypeError, AttributeError):
        if given in ("linear", "srgb"):
            return Response(srgb=given == "srgb")
        if isinstance(given, dict) and given.keys() == {"gamma"} and 0.1 <= float(given["gamma"]) <= 10.0:
            return Response(gamma=float(given["gamma"]))
        table = np.array(given, np.float64)
        increasing = len(table) > 1 and bool((np.diff(table, axis=0) > 0).all()) and np.isfinite(table).all()
        if table.shape == (len(table), 2) and not table[0].any() and increasing:
            return Response(table=tuple(map(tuple, table / table[-1])))
    expected = "linear, srgb, {gamma: NUMBER}, or a table [[0, 0], ...] of grey level and light, both increasing"
    raise input_error(where, expected, short(given), "write one of these, or remove the key: it is then learnt")


def check_exposure(path: Path, exposure_s: float | None, frame_s: float, tolerance: float = 0.0) -> None:
    """Refuse an exposure longer than the time between frames, by more than a relative tolerance (ExperimentError)."""
    if exposure_s is not None and exposure_s > frame_s * (1 + tolerance):
        expected = f"at most the time between frames, {frame_s:.4g} s"
        raise input_error(f"{path}, exposure", expected, f"{exposure_s:g}", "write it in seconds")


def _check_numbers(path: Path, keys: ExperimentKeys) -> None:
    if (keys.frame_rate is None) == (keys.times is None):
        got, do = "neither" if keys.times is None else "both", "write frame_rate: in Hz, or times: with a file"
        raise input_error(str(path), "either frame_rate or times", got, do)
    if keys.frames is not None and keys.frames[0] >= keys.frames[1]:
        raise input_error(f"{path}, frames", "first below last", str(keys.frames), "write first and last + 1")
    if keys.frame_rate is not None:
        check_exposure(path, keys.exposure, 1 / keys.frame_rate)
    for name, device in keys.camera.items():
        if device.exposure_ms and device.rate_hz and device.exposure_ms > 1e3 / device.rate_hz:
            where, expected = f"{path}, camera.{name}.exposure_ms", f"at most {1e3 / device.rate_hz:.4g} ms, by rate_hz"
            raise input_error(where, expected, f"{device.exposure_ms:g}", "shorten the exposure, or lower the rate")


def _check_spheres(path: Path, keys: ExperimentKeys) -> None:
    where = f"{path}, spheres"
    if keys.sphere is None and not keys.spheres:
        raise input_error(f"{path}, sphere", "a value", "none", "add the key, or `spheres` with a name for each ball")
    if keys.sphere is not None and keys.spheres:
        do = "write `sphere` for one ball, else `spheres`"
        raise input_error(f"{path}, sphere", "either sphere or spheres", "both", do)
    for name, sphere in keys.spheres.items():
        if not names_a_group(name):
            raise input_error(where, "names without '/'", short(name), "give each ball a name, such as a")
        if sphere.diameter is None and len(keys.spheres) > 1:
            do = "measure it: lengths of several balls are in mm"
            raise input_error(f"{where}.{name}.diameter", "a number (mm)", "none", do)
