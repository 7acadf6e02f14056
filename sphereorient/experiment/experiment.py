import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, FiniteFloat, StrictBool

from sphereorient.cameras import Camera, ParameterCovariance, load_cameras, load_covariance
from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.files.whole_file import relative_path
from sphereorient.files.yaml_file import read_document, refuse_unknown, short, validated, write_document
from sphereorient.movies import Movie, flipped, is_movie, movie_files, open_movie
from sphereorient.sphere import seen_path

SCHEMA = "sphereorient-experiment/1"
MAX_CAMERAS = 8
MOVIES_OWN = "movies"  # value of `times`
Positive = Annotated[FiniteFloat, Field(gt=0)]
FrameNumber = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, kw_only=True)
class Sphere:
    """One sphere of an experiment."""

    name: str = ""  # empty: the only one, written as `sphere:`
    diameter_mm: float | None = None  # None: unknown, lengths are in radii
    texture_path: Path | None = None  # None: to be estimated
    fixed: bool = False  # whether the centre is fixed


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
    spheres: tuple[Sphere, ...] = (Sphere(),)
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
    def names(self) -> tuple[str, ...]:
        """Names of the spheres; ("",) if the file has `sphere:`."""
        return tuple(sphere.name for sphere in self.spheres)

    def of(self, name: str) -> "Experiment":
        """Return the experiment of one sphere alone; ExperimentError if it has none of this name."""
        if name == "":
            return replace(self, spheres=(self.sphere,))
        if self.names == ("",):
            got, do = "one without name", "name the experiment of the track"
            raise ExperimentError(refusal(f"{self.path}, spheres", expected=f"a ball {name}", got=got, do=do))
        if name not in self.names:
            raise ExperimentError(refuse_unknown(name, self.names, f"{self.path}, spheres"))
        return replace(self, spheres=(self.spheres[self.names.index(name)],))

    def with_sphere(self, **changes: Any) -> "Experiment":
        """Return the experiment with other fields of its only sphere; ExperimentError if it has several."""
        return replace(self, spheres=(replace(self.sphere, **changes),))

    @property
    def sphere(self) -> Sphere:
        """The only sphere; ExperimentError if there are several."""
        if len(self.spheres) > 1:
            do = "name a file with one of them under `sphere`, or take experiment.of(NAME) in Python"
            got = ", ".join(self.names)
            raise ExperimentError(refusal(f"{self.path}, spheres", expected="one ball", got=got, do=do))
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
    def length_unit(self) -> str:
        """Unit of all lengths of a track: mm, or radii of an only sphere of unknown diameter."""
        return "radii" if any(sphere.diameter_mm is None for sphere in self.spheres) else "mm"

    @property
    def radius_mm(self) -> float:
        """Radius of the only sphere; 1 if its diameter is unknown and lengths are in radii."""
        return 1.0 if self.diameter_mm is None else self.diameter_mm / 2


class SphereKeys(BaseModel, frozen=True, extra="forbid"):
    """The key `sphere`, and each sphere of `spheres`."""

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
    sphere: SphereKeys | None = None
    spheres: dict[str, SphereKeys] = Field(default_factory=dict, min_length=1)
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
    needed = (("frame_rate", "times"), ("sphere", "spheres"))
    missing = [" or ".join(either) for either in needed if not document.keys() & set(either)]
    keys = validated(ExperimentKeys, document, str(path), ExperimentError, missing)
    for key in ("masks", "backgrounds", "start", "flip"):
        for name in getattr(keys, key):
            if name not in keys.movies:
                raise ExperimentError(refuse_unknown(name, keys.movies, f"{path}, {key}"))
    _check_numbers(path, keys)
    _check_spheres(path, keys)
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
        spheres=tuple(
            Sphere(
                name=name,
                diameter_mm=sphere.diameter,
                texture_path=None if sphere.texture is None else path.parent / sphere.texture,
                fixed=sphere.fixed,
            )
            for name, sphere in (keys.spheres if keys.sphere is None else {"": keys.sphere}).items()
        ),
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

    def keys_of(sphere: Sphere) -> dict[str, Any]:
        keys: dict[str, Any] = {"diameter": sphere.diameter_mm}
        keys |= {} if sphere.texture_path is None else {"texture": relative(sphere.texture_path)}
        return keys | ({"fixed": True} if sphere.fixed else {})

    times, spheres = experiment.times, {sphere.name: keys_of(sphere) for sphere in experiment.spheres}
    document: dict[str, Any] = {
        "name": experiment.name,
        "frame_rate": float(experiment.frame_rate_hz) if times is None else None,
        "times": times if times in (None, MOVIES_OWN) else relative(str(times)),
        "exposure": None if experiment.exposure_s is None else float(experiment.exposure_s),
        **({"sphere": spheres[""]} if "" in spheres else {"spheres": spheres}),
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
    for texture in (sphere.texture_path for sphere in experiment.spheres):
        if texture is not None:
            single += [texture, *([counts] if (counts := seen_path(texture)).is_file() else [])]
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


def _check_spheres(path: Path, keys: ExperimentKeys) -> None:
    def refused(where: str, expected: str, got: str, do: str) -> ExperimentError:
        return ExperimentError(refusal(f"{path}, {where}", expected=expected, got=got, do=do))

    if keys.sphere is None and not keys.spheres:
        raise refused("sphere", "a value", "none", "add the key, or `spheres` with a name for each ball")
    if keys.sphere is not None and keys.spheres:
        raise refused("sphere", "either sphere or spheres", "both", "write `sphere` for one ball, else `spheres`")
    for name, sphere in keys.spheres.items():
        if not name.strip() or "/" in name or name == ".":
            raise refused("spheres", "names without '/'", short(name), "give each ball a name, such as a")
        if sphere.diameter is None and len(keys.spheres) > 1:
            got, do = "none", "measure it: lengths of several balls are in mm"
            raise refused(f"spheres.{name}.diameter", "a number (mm)", got, do)
