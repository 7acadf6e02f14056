from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from sphereorient.cameras import Camera, ParameterCovariance
from sphereorient.experiment.experiment import Experiment, Sphere, load_experiment, open_movies, outside_paths, refused
from sphereorient.experiment.stream import CameraStream, given_mask
from sphereorient.experiment.timeline import Rows, Timeline, timeline
from sphereorient.sphere import load_texture, load_unseen, unseen_share

UNKNOWN = 0.5  # grey of texels that are no paint, for searches


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureMap:
    """The texture map of a sphere, as read from its file."""

    grey: Tensor  # (H, 2 H); (0, 0) if it is to be estimated
    unseen: Tensor | None = None  # (H, 2 H) bool, texels that are no paint; None: all are


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Experiment with open movies; made by `open_recording`."""

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
        """Texels of this map that are no paint, (H, 2 H) bool; None: all are paint."""
        return self.maps[self.experiment.sphere.name].unseen

    @property
    def cameras(self) -> dict[str, Camera]:
        """Cameras in use."""
        return {stream.name: stream.camera for stream in self.streams}

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
    names = _chosen(experiment, cameras)
    movies = open_movies(experiment, names)
    frames = timeline(experiment, movies)
    streams = []
    for name, movie in movies.items():
        shown = given_mask(experiment, name, movie.frame_shape)
        camera, rows = experiment.cameras[name], frames.rows[name]
        streams.append(CameraStream(name=name, camera=camera, movie=movie, rows=rows, shown=shown))
    remarks = [f"{experiment.path}: reads outside of its folder: {path}" for path in outside_paths(experiment)]
    remarks += [
        f"{path}: {100 * unseen_share(one.unseen):.0f} % of the ball is unseen and no paint"
        for path, one in loaded.items()
        if one.unseen is not None
    ]
    remarks += [f"{movie.path}: {remark}" for movie in movies.values() for remark in movie.remarks]
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
    do = f"learn it with `sphereorient map`, then write {key}.texture: the file that this gives"
    raise refused(f"{experiment.path}{name}", "a texture", "none", do)


def load_map(path: Path) -> TextureMap:
    """Read a texture map, with what of it is no paint; TextureError for a file that is none."""
    grey, unseen = load_texture(path), load_unseen(path)
    return TextureMap(grey=grey if unseen is None else grey.masked_fill(unseen, UNKNOWN), unseen=unseen)


def _chosen(experiment: Experiment, cameras: Sequence[str] | None) -> list[str]:
    known = list(experiment.movie_paths)
    wanted = known if cameras is None else list(cameras)
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        raise refused("cameras", " or ".join(known), ", ".join(unknown) or "none", "name cameras of the experiment")
    return [name for name in known if name in wanted]
