"""Tracks of several spheres of one recording, and their file."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Self

import h5py
import numpy as np

from sphereorient.errors import ShapeError, TrackError, refusal
from sphereorient.files.hdf5 import whole_hdf5
from sphereorient.trajectory import datasets
from sphereorient.trajectory.trajectory import AGAIN, SCHEMA_OF_SEVERAL, SPHERES, Trajectory, opened_track


def one_track(found: "Trajectory | Tracks") -> Trajectory:
    """Return the track of an only sphere; raise TrackError for those of several."""
    if isinstance(found, Trajectory):
        return found
    got, do = ", ".join(found), "pick one by its name"
    raise TrackError(refusal("tracks", expected="one sphere", got=got, do=do))


class Tracks(Mapping[str, Trajectory]):
    """Trajectories of the spheres of one recording, by name: `tracks["a"]`. The name of a sphere under the key `sphere`
    of experiment.yaml is empty. All have the same times.
    """

    def __init__(self, tracks: Mapping[str, Trajectory]) -> None:
        times = [track.time for track in tracks.values()]
        if not all(np.array_equal(time, times[0]) for time in times):
            got, do = ", ".join(str(len(time)) for time in times) + " frames, of other times", "give each all frames"
            raise ShapeError(refusal("Tracks", expected="the same times of every ball", got=got, do=do))
        self._tracks = {name: replace(track, sphere=name) for name, track in tracks.items()}

    def __getitem__(self, name: str) -> Trajectory:
        return self._tracks[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tracks)

    def __len__(self) -> int:
        return len(self._tracks)

    def __repr__(self) -> str:
        return "\n".join(map(repr, self.values())) or "no tracks"

    def _repr_html_(self) -> str:
        return "".join(track._repr_html_() for track in self.values())

    @classmethod
    def of(cls, tracks: Trajectory | Mapping[str, Trajectory]) -> Self:
        """Return tracks by name, or those of one trajectory."""
        return cls({tracks.sphere: tracks} if isinstance(tracks, Trajectory) else tracks)

    def save(self, path: str | Path) -> None:
        """Write HDF5 of schema sphereorient-track/2: a group /spheres/NAME each, as `Trajectory.save` writes a file. Of
        an only sphere, write the file that this writes.

        Raises:
            OutputError: the file cannot be written.
        """
        if len(self) == 1:
            next(iter(self.values())).save(path)
            return
        with whole_hdf5(Path(path)) as file:
            file.attrs["schema"] = SCHEMA_OF_SEVERAL
            spheres = file.create_group(SPHERES, track_order=True)
            for name, track in self.items():
                track.write(spheres.create_group(name))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `Tracks.save` or `Trajectory.save`.

        Raises:
            TrackError: no HDF5 file, another schema, or a dataset missing or of wrong shape.
        """
        with opened_track(path) as file:
            if not isinstance(file, h5py.File) or file.attrs.get("schema") != SCHEMA_OF_SEVERAL:
                return cls.of(Trajectory.read(file))
            spheres = datasets.inside(file, SPHERES)
            if not isinstance(spheres, h5py.Group) or not len(spheres):
                raise TrackError(refusal(f"{path}: {SPHERES}", expected="groups with names", got="none", do=AGAIN))
            return cls({name: Trajectory.read(datasets.named_group(spheres, name)) for name in spheres})

    def picked(self, name: str | None) -> Self:
        """Return the sphere of this name alone; None: all. Raise TrackError for an unknown name."""
        if name is None:
            return self
        if name not in self:
            known = ", ".join(each or "one ball without name" for each in self)
            do = "leave --sphere out" if "" in self else "name one of these"
            raise TrackError(refusal("--sphere", expected=known, got=repr(name)[:60], do=do))
        return type(self)({name: self[name]})
