from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_trajectory import arrays, full_trajectory

from sphereorient.errors import ShapeError, TrackError
from sphereorient.trajectory import Flag, Tracks, Trajectory


def several() -> Tracks:
    track = full_trajectory()
    doubt = replace(track, identity=np.linspace(0.5, 1, len(track)), flags=track.flags | Flag.IDENTITY)
    return Tracks({"b": track, "a": doubt, "c": replace(track, cameras={})})


def same(one: Trajectory, other: Trajectory) -> None:
    for before, after in [(one, other), *((one.cameras[name], other.cameras[name]) for name in one.cameras)]:
        for name, values in arrays(before).items():
            np.testing.assert_array_equal(values, arrays(after)[name], err_msg=name)
    assert (one.provenance, one.settings, one.frame_rate) == (other.provenance, other.settings, other.frame_rate)


def test_balls_are_read_in_the_order_in_which_they_were_written(tmp_path: Path) -> None:
    several().save(tmp_path / "track.h5")
    read = Tracks.load(tmp_path / "track.h5")
    assert list(read) == ["b", "a", "c"]
    for name, track in several().items():
        same(track, read[name])


def test_the_group_of_a_ball_is_a_file_of_one_ball(tmp_path: Path) -> None:
    several().save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5") as file, h5py.File(tmp_path / "b.h5", "w") as alone:
        assert file.attrs["schema"] == "sphereorient-track/2"
        assert set(file) == {"spheres"}
        assert '"IDENTITY": 1024' in file["spheres/a/flags"].attrs["bits"]
        for name in file["spheres/b"]:
            file.copy(f"spheres/b/{name}", alone)
        alone.attrs.update(file["spheres/b"].attrs)
    same(Trajectory.load(tmp_path / "b.h5"), several()["b"])
    assert list(Tracks.load(tmp_path / "b.h5")) == ["b"]
    several()["b"].save(tmp_path / "saved.h5")
    same(Trajectory.load(tmp_path / "saved.h5"), several()["b"])


def test_the_file_of_one_ball_without_name_is_that_of_a_trajectory(tmp_path: Path) -> None:
    full_trajectory().save(tmp_path / "track.h5")
    Tracks({"": full_trajectory()}).save(tmp_path / "tracks.h5")
    assert (tmp_path / "track.h5").read_bytes() == (tmp_path / "tracks.h5").read_bytes()
    assert list(Tracks.load(tmp_path / "track.h5")) == [""]
    same(Tracks.load(tmp_path / "track.h5")[""], full_trajectory())
    with h5py.File(tmp_path / "track.h5") as file:
        assert "identity" not in file


def test_tracks_of_other_times_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"same times .* 7, 3 frames"):
        Tracks({"a": full_trajectory(), "b": full_trajectory()[2:5]})


def test_one_ball_of_several_is_picked_by_name() -> None:
    assert list(several().picked("a")) == ["a"]
    assert several().picked(None).keys() == several().keys()
    with pytest.raises(TrackError, match="b, a, c, got 'd'"):
        several().picked("d")
    with pytest.raises(TrackError, match="one ball without name"):
        Tracks.of(full_trajectory()).picked("a")
    assert several()["a"][1:3].sphere == "a"
    assert "ball a" in repr(several())


def test_one_ball_with_a_name_keeps_it_in_the_file_of_a_trajectory(tmp_path: Path) -> None:
    several().picked("a").save(tmp_path / "track.h5")
    same(Trajectory.load(tmp_path / "track.h5"), several()["a"])
    assert Tracks.load(tmp_path / "track.h5")["a"].bits["IDENTITY"] == 1024


def test_equal_tracks_give_equal_bytes_which_are_no_trajectory_and_the_refusal_names_the_balls(tmp_path: Path) -> None:
    several().save(tmp_path / "one.h5")
    several().save(tmp_path / "track.h5")
    assert (tmp_path / "one.h5").read_bytes() == (tmp_path / "track.h5").read_bytes()
    with pytest.raises(TrackError, match=r"track\.h5: .* one ball, got b, a, c"):
        Trajectory.load(tmp_path / "track.h5")


def test_damaged_groups_are_refused_with_their_place(tmp_path: Path) -> None:
    path = tmp_path / "track.h5"
    several().save(path)
    with h5py.File(path, "r+") as file:
        del file["spheres/a/omega_lab"]
    with pytest.raises(TrackError, match=r"track\.h5: /spheres/a/omega_lab"):
        Tracks.load(path)
    for name, got in (("a", "'a'"), ("", "none")):
        with h5py.File(path, "r+") as file:
            del file["spheres"]
            if name:
                file["spheres/a"] = h5py.ExternalLink("/etc/passwd", "/")
        with pytest.raises(TrackError, match=f"spheres: .* got {got}"):
            Tracks.load(path)
