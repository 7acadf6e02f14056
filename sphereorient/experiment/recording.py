"""Experiments with open movies: a camera with its pictures (movie, scene, mask), and the recording of all cameras."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, ParameterCovariance
from sphereorient.cameras.response import SRGB, Response
from sphereorient.errors import ExperimentError, MovieError, Reason, refusal
from sphereorient.experiment.experiment import (
    Experiment,
    Sphere,
    input_error,
    load_experiment,
    open_movies,
    outside_paths,
)
from sphereorient.experiment.timeline import NONE, Rows, Timeline, timeline
from sphereorient.files.picture import OnDemand, claimed_pixels, decoded_grey
from sphereorient.files.whole_file import read_whole
from sphereorient.movies import Grey, Movie, flipped_picture, flipped_shape
from sphereorient.sphere import load_texture, load_unseen, unseen_share

Shown = Grey | OnDemand  # a picture, decoded whole or on demand
Read = TypeVar("Read", bound=Shown)

BYTES_A_PIXEL, HEADER_BYTES = 8, 1_000_000  # of a given picture, uncompressed; of its header
EVERY = 4  # tested rows and columns: faults of whole pictures show in every fourth one
GLARE_SHARE = 0.5  # share of saturated pixels from which a picture is not used for the background
UNKNOWN = 0.5  # grey of texels without paint, in searches


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraStream:
    """A camera, its movie, and the picture of each frame."""

    name: str
    camera: Camera
    movie: Movie
    rows: NDArray[np.int64]  # (N,), number in the movie, or NONE
    shown: NDArray[np.bool_] | None = None  # (H, W), False where something hides the sphere; None: nowhere
    response: Response | None = None  # of the camera; None: not given

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def photograph(self) -> bool:
        """Whether it is one picture."""
        return len(self) == 1

    def pictures(self, first: int = 0, last: int | None = None) -> Iterator[tuple[Grey | None, Reason]]:
        """Yield the pictures of frames first .. last - 1, from the first frame in use, or None, with the reason."""
        return self._with_reasons(self.movie.readable, first, last)

    def on_demand(
        self, pool: Executor, first: int = 0, last: int | None = None
    ) -> Iterator[tuple[Grey | OnDemand | None, Reason]]:
        """Yield the same, decoded in `pool` part by part for movies that allow it."""
        return self._with_reasons(partial(self.movie.on_demand, pool), first, last)

    def _with_reasons(
        self, read: Callable[[int, int], Iterator[Read | None]], first: int, last: int | None
    ) -> Iterator[tuple[Read | None, Reason]]:
        rows = self.rows[first:last]
        for row, picture in zip(rows.tolist(), _of_rows(read, rows), strict=True):
            why = Reason.MISSING if row == NONE else Reason.UNDECODABLE
            yield picture, why if picture is None else Reason.OK

    def spread(self, count: int) -> Grey:
        """Return at most `count` evenly spread readable pictures, (n, H, W); raise MovieError if there are none."""
        numbers = self.rows[self.rows != NONE].tolist()
        wanted = [numbers[k] for k in spread_frames(range(len(numbers)), count)]
        try:
            pictures = list(self.movie.sample(wanted))
        except MovieError:
            pictures = [picture for picture in _read(self.movie.readable, wanted) if picture is not None]
        good = [picture for picture in pictures if not (uniform(picture) or _glares(picture))]
        if not good:
            got, do = "none (black, white or damaged ones)", "check the movie with `sphereorient movie`"
            raise MovieError(refusal(str(self.movie.path), expected="readable pictures", got=got, do=do))
        return np.stack(good)


def spread_frames(frames: range, count: int) -> list[int]:
    """Return at most `count` evenly spread frame numbers of a range, ends included."""
    if len(frames) <= count:
        return list(frames)
    return [frames[int(i)] for i in np.linspace(0, len(frames) - 1, count).round()]


def uniform(picture: Grey) -> bool:
    """Return whether a picture has only one grey level."""
    some = picture[::EVERY, ::EVERY]
    return bool(some.min() == some.max())


def whole(shown: Shown) -> Grey:
    """Return a whole picture (H, W)."""
    if not isinstance(shown, OnDemand):
        return shown
    height, width = shown.shape
    return shown.part(0, 0, width - 1, height - 1)


def equal(shown: Shown, before: Shown | None) -> bool:
    """Return whether a picture repeats the previous one."""
    if isinstance(shown, OnDemand) or isinstance(before, OnDemand) or before is None:
        return isinstance(shown, OnDemand) and shown.equals(before)
    some = np.s_[:: EVERY**2]
    return np.array_equal(shown[some], before[some]) and np.array_equal(shown, before)


def pictures_of(movie: Movie, rows: NDArray[np.int64]) -> Iterator[Grey | None]:
    """Yield a movie's pictures by number (N,); None for NONE and undecodable pictures."""
    return _of_rows(movie.readable, rows)


def parts_of(pool: Executor, movie: Movie, rows: NDArray[np.int64]) -> Iterator[Shown | None]:
    """Yield the same, decoded in `pool` part by part for movies that allow it."""
    return _of_rows(partial(movie.on_demand, pool), rows)


def _of_rows(read: Callable[[int, int], Iterator[Read | None]], rows: NDArray[np.int64]) -> Iterator[Read | None]:
    found = _read(read, rows[rows != NONE].tolist())
    for row in rows.tolist():
        yield None if row == NONE else next(found)


def _read(read: Callable[[int, int], Iterator[Read | None]], numbers: Sequence[int]) -> Iterator[Read | None]:
    """Yield pictures by number, consecutive ones in one pass."""
    for run in np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1):
        if len(run):
            yield from read(int(run[0]), int(run[-1]) + 1)


def _glares(picture: Grey) -> bool:
    return float(np.mean(picture[::EVERY, ::EVERY] == np.iinfo(picture.dtype).max)) > GLARE_SHARE


def given_scene(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return a camera's background, (H, W) grey levels, flipped as its movie; None if not given."""
    path, flip = experiment.background_paths.get(name), experiment.flip.get(name, "none")
    return None if path is None else flipped_picture(load_background(path, flipped_shape(frame_shape, flip)), flip)


def given_mask(experiment: Experiment, name: str, frame_shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Return a camera's mask, (H, W), False where the sphere is hidden, flipped as its movie; None if not given."""
    path, flip = experiment.mask_paths.get(name), experiment.flip.get(name, "none")
    return None if path is None else flipped_picture(load_mask(path, flipped_shape(frame_shape, flip)), flip)


def load_background(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Read a background, (H, W), grey levels; raise ExperimentError unless it is a picture of the movie's size."""
    do = "save a frame without the ball as PNG, in the movie's own grey levels"
    return np.asarray(_picture(path, f"background {path}", frame_shape, do), np.float32)


def load_mask(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask, (H, W), True (white) where the sphere is visible, False (black) where something hides it.
    Raises ExperimentError (missing, not a picture, not of the movie's size, or all black).
    """
    name, do = f"mask {path}", "paint a frame of the movie black where something hides the ball, white elsewhere"
    picture = _picture(path, name, frame_shape, do)
    shown = np.asarray(picture > np.iinfo(picture.dtype).max // 2)
    if not shown.any():
        raise input_error(name, "white where the ball is visible", "black only", do)
    return shown


def _picture(path: Path, name: str, frame_shape: tuple[int, int], do: str) -> NDArray[Any]:
    height, width = frame_shape
    content = read_whole(path, BYTES_A_PIXEL * height * width + HEADER_BYTES, "a picture", ExperimentError, do)
    claimed, expected = claimed_pixels(content), f"{width} x {height} px as the movie"
    if claimed is not None and claimed > height * width:  # before allocating memory
        raise input_error(name, expected, f"{claimed} px", do)
    picture = None if claimed is None else decoded_grey(content)
    if picture is None:
        raise input_error(name, "a picture", "a file that cannot be decoded", do)
    if picture.shape != frame_shape:
        raise input_error(name, expected, f"{picture.shape[1]} x {picture.shape[0]} px", do)
    return picture


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureMap:
    """The texture map of a sphere, from its file."""

    grey: Tensor  # (H, 2 H); (0, 0) if it is to be estimated
    unseen: Tensor | None = None  # (H, 2 H) bool, texels without paint; None: none


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Experiment with open movies."""

    experiment: Experiment
    streams: Sequence[CameraStream]
    timeline: Timeline
    maps: Mapping[str, TextureMap]  # of each sphere, by name; one object for spheres of one file
    remarks: tuple[str, ...]

    def of(self, name: str) -> "Recording":
        """Return the recording of one sphere alone, with the same movies; ExperimentError for an unknown name."""
        alone = self.experiment.of(name)
        return replace(self, experiment=alone, maps={alone.sphere.name: self.maps[alone.sphere.name]})

    @property
    def texture(self) -> Tensor:
        """Texture map of the only sphere, (H, 2 H); (0, 0) if it is to be estimated."""
        return self.maps[self.experiment.sphere.name].grey

    @property
    def unseen(self) -> Tensor | None:
        """Texels of this map without paint, (H, 2 H) bool; None: all are paint."""
        return self.maps[self.experiment.sphere.name].unseen

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras in use."""
        return {stream.name: stream.camera for stream in self.streams}

    @property
    def photograph(self) -> bool:
        """Whether the recording is one picture of one camera."""
        return len(self.streams) == 1 and self.streams[0].photograph

    @property
    def frames(self) -> range:
        """Frame numbers of the experiment."""
        number = self.timeline.number
        return range(int(number[0]), int(number[-1]) + 1)

    @property
    def clock(self) -> Tensor:
        """Frame times, (N,), s."""
        return torch.from_numpy(self.timeline.time_s)

    @property
    def covariance(self) -> ParameterCovariance | None:
        """Parameter covariance of the cameras in use."""
        whole = self.experiment.camera_covariance
        return None if whole is None else whole.of(list(self.cameras))

    def gridded(self) -> "tuple[Recording, Rows]":
        """Return the recording on a regular time grid, and its frames' indices in it; see `Timeline`."""
        grid, place = self.timeline.gridded()
        streams = [replace(stream, rows=grid.rows[stream.name]) for stream in self.streams]
        return replace(self, timeline=grid, streams=streams), place


TAKEN_FOR_CODED = "a photograph, assumed gamma-coded; write response: linear if grey levels are proportional to light"
NO_MAP = TextureMap(grey=torch.empty(0, 0))


@contextmanager
def open_recording(
    source: Experiment | str | Path, cameras: Sequence[str] | None = None, *, textured: bool = True
) -> Iterator[Recording]:
    """Open an experiment, or its path, with the named cameras (None: all); without `textured`, no texture map is read.
    Raises SphereOrientError (inputs missing, unreadable or inconsistent; with `textured`, no texture map).
    """
    experiment = load_experiment(source)
    paths = {sphere.name: _texture_path(experiment, sphere) for sphere in experiment.spheres} if textured else {}
    loaded = {path: load_map(path) for path in dict.fromkeys(paths.values())}
    movies = open_movies(experiment, _chosen(experiment, cameras))
    frames = timeline(experiment, movies)
    photographs = [name for name, movie in movies.items() if movie.photographs and len(movie) == 1]
    coded = [name for name in photographs if name not in experiment.response]
    experiment = replace(experiment, response=dict.fromkeys(coded, SRGB) | experiment.response)
    streams = []
    for name, movie in movies.items():
        shown = given_mask(experiment, name, movie.frame_shape)
        camera, rows = experiment.cameras[name], frames.rows[name]
        response = experiment.response.get(name)
        streams.append(CameraStream(name=name, camera=camera, movie=movie, rows=rows, shown=shown, response=response))
    remarks = [f"{experiment.path}: reads a file outside its folder: {path}" for path in outside_paths(experiment)]
    remarks += [
        f"{path}: {100 * unseen_share(one.unseen):.0f} % of the ball has unseen paint"
        for path, one in loaded.items()
        if one.unseen is not None
    ]
    remarks += [f"{movie.path}: {remark}" for movie in movies.values() for remark in movie.remarks]
    remarks += [f"{movies[name].path}: {TAKEN_FOR_CODED}" for name in coded]
    yield Recording(
        experiment=experiment,
        streams=streams,
        timeline=frames,
        maps={name: loaded[paths[name]] if textured else NO_MAP for name in experiment.names},
        remarks=(*remarks, *frames.remarks),
    )


def _texture_path(experiment: Experiment, sphere: Sphere) -> Path:
    if sphere.texture_path is not None:
        return sphere.texture_path
    key, name = (f"spheres.{sphere.name}", f", ball {sphere.name}") if sphere.name else ("sphere", "")
    do = f"learn it with `sphereorient map`, then write its file as {key}.texture"
    raise input_error(f"{experiment.path}{name}", "a texture", "none", do)


def load_map(path: Path) -> TextureMap:
    """Read a texture map, with its texels without paint; TextureError for another file."""
    grey, unseen = load_texture(path), load_unseen(path)
    return TextureMap(grey=grey if unseen is None else grey.masked_fill(unseen, UNKNOWN), unseen=unseen)


def _chosen(experiment: Experiment, cameras: Sequence[str] | None) -> list[str]:
    known = list(experiment.movie_paths)
    wanted = known if cameras is None else list(cameras)
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        raise input_error("cameras", " or ".join(known), ", ".join(unknown) or "none", "name cameras of the experiment")
    return [name for name in known if name in wanted]
