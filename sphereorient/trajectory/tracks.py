"""Tracks of several spheres of one recording, and their file."""

from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Self

import h5py

from sphereorient.errors import TrackError, refusal
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
    """Trajectories of the spheres of one recording, by name: `tracks["a"]`. The name of an only sphere, the one under
    the key `sphere` of experiment.yaml, is empty.
    """

    def __init__(self, tracks: Mapping[str, Trajectory]) -> None:
        self._tracks = dict(tracks)

    def __getitem__(self, name: str) -> Trajectory:
        return self._tracks[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tracks)

    def __len__(self) -> int:
        return len(self._tracks)

    def __repr__(self) -> str:
        return "\n".join(f"{name}: {track!r}" if name else repr(track) for name, track in self.items()) or "no tracks"

    def _repr_html_(self) -> str:
        return "".join(f"<p>{escape(name)}</p>{track._repr_html_()}" for name, track in self.items())

    def save(self, path: str | Path) -> None:
        """Write HDF5 of schema sphereorient-track/2: a group /spheres/NAME each, as `Trajectory.save` writes a file. Of
        an only sphere without name, write the file that this writes.

        Raises:
            OutputError: the file cannot be written.
        """
        if list(self) == [""]:
            self[""].save(path)
            return
        with whole_hdf5(Path(path)) as file:
            file.attrs["schema"] = SCHEMA_OF_SEVERAL
            spheres = file.create_group(SPHERES, track_order=True)
            for name, track in self.items():
                track.write(spheres.create_group(name))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by `Tracks.save` or `Trajectory.save`; of the latter the name of the sphere is empty.

        Raises:
            TrackError: no HDF5 file, another schema, or a dataset missing or of wrong shape.
        """
        with opened_track(path) as file:
            if not isinstance(file, h5py.File) or file.attrs.get("schema") != SCHEMA_OF_SEVERAL:
                return cls({"": Trajectory.read(file)})
            spheres = datasets.inside(file, SPHERES)
            if not isinstance(spheres, h5py.Group) or not len(spheres):
                raise TrackError(refusal(f"{path}: {SPHERES}", expected="groups with names", got="none", do=AGAIN))
            return cls({name: Trajectory.read(datasets.named_group(spheres, name)) for name in spheres})
