"""The trajectory: every dataset always there, written whole or not at all, read back bit by bit."""

import json
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from sphereorient.errors import OutputError, ShapeError, TrackError
from sphereorient.trajectory import CameraTrack, Flag, Reason, Trajectory
from sphereorient.trajectory.datasets import nearest_rows

FRAMES = 7
# docs/data-format.md, written out once more so that the code's own table is not its own oracle
FORMAT_SHAPES: dict[str, tuple[int, ...]] = {"time": (), "valid": (), "segment": (), "flags": (), "confidence": ()}
FORMAT_SHAPES |= dict.fromkeys(("position", "position_smooth"), (3,))
FORMAT_SHAPES |= dict.fromkeys(("position_cov", "position_smooth_cov", "orientation", "orientation_cov"), (3, 3))
FORMAT_SHAPES |= dict.fromkeys(("orientation_smooth", "orientation_smooth_cov"), (3, 3))
# And what came later: docs/data-format.md.
FORMAT_SHAPES |= dict.fromkeys(("position_systematic_cov", "orientation_systematic_cov"), (3, 3))
FORMAT_SHAPES |= {"margin": (), "margin_angle": ()}
MOTIONS = ("velocity", "acceleration", "omega_lab", "omega_body", "alpha_lab", "alpha_body")
FORMAT_SHAPES |= {f"{name}{end}": (3,) for name in MOTIONS for end in ("", "_sigma")}
FORMAT_CAMERA = {"centre_px", "centre_sigma_px", "radius_px", "outline_rms_px", "orientation", "orientation_cov"}
FORMAT_CAMERA |= {"limb_coverage", "score", "xi", "reason"}
FORMAT_CAMERA |= {"candidates/offset", "candidates/orientation", "candidates/score"}


def full_trajectory() -> Trajectory:
    """Return a trajectory in which every array holds numbers, and some of them NaN."""
    rng = np.random.default_rng(7)
    track = Trajectory.empty(
        np.arange(40, 40 + FRAMES) / 600.0,
        cameras=("cam2", "cam1"),
        frame_rate=600.0,
        method="precise",
        settings="motion:\n  separations: [1, 2]\n",
        experiment="mixer-3Hz",
        provenance={"versions": {"sphereorient": "0"}, "command": ["sphereorient", "track"]},
    )
    drawn = {
        entry.name: rng.standard_normal(getattr(track, entry.name).shape)
        for entry in fields(track)
        if isinstance(getattr(track, entry.name), np.ndarray) and getattr(track, entry.name).dtype == float
    }
    drawn |= {"valid": rng.random(FRAMES) > 0.5, "segment": np.repeat([0, -1, 1], [3, 1, 3])}
    drawn["flags"] = np.full(FRAMES, Flag.SPIKE | Flag.ONE_CAMERA, np.uint32)
    drawn["time"] = track.time
    drawn["position"][3] = drawn["identity"][:] = np.nan  # identity is of several balls only
    camera = replace(
        CameraTrack.empty(FRAMES),
        centre_px=rng.standard_normal((FRAMES, 2)),
        centre_sigma_px=rng.random(FRAMES),
        reason=(Reason.OK, Reason.DARK, Reason.OK, Reason.NOT_FOUND, Reason.DARK, Reason.UNDECODABLE, Reason.OK),
        candidate_offset=np.array([0, 2, 2, 3, 3, 3, 3, 5]),
        candidate_orientation=rng.standard_normal((5, 3, 3)),
        candidate_score=rng.random(5),
    )
    return replace(track, cameras=dict(track.cameras) | {"cam1": camera}, **drawn)


def arrays(record: object) -> dict[str, np.ndarray]:
    return {e.name: getattr(record, e.name) for e in fields(record) if isinstance(getattr(record, e.name), np.ndarray)}


def datasets(path: Path) -> dict[str, h5py.Dataset]:
    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def test_an_empty_trajectory_has_every_dataset_of_the_design_in_its_shape(tmp_path: Path) -> None:
    Trajectory.empty(np.arange(FRAMES) / 600.0, cameras=("cam1",)).save(tmp_path / "track.h5")
    found = datasets(tmp_path / "track.h5")
    assert set(found) == set(FORMAT_SHAPES) | {f"cameras/cam1/{name}" for name in FORMAT_CAMERA}
    assert {name: found[name].shape for name in FORMAT_SHAPES} == {n: (FRAMES, *s) for n, s in FORMAT_SHAPES.items()}
    assert found["cameras/cam1/candidates/offset"].shape == (FRAMES + 1,)
    assert found["flags"].dtype == np.uint32
    assert found["valid"].dtype == bool


def test_unmeasured_frames_are_nan_and_outside_any_segment() -> None:
    track = Trajectory.empty(np.arange(FRAMES) / 600.0, cameras=("cam1",))
    for name, values in arrays(track).items():
        if name not in ("time", "valid", "segment", "flags"):
            assert np.isnan(values).all(), name
    assert not track.valid.any()
    assert (track.segment == -1).all()
    assert set(track.cameras["cam1"].reason) == {"not_found"}


def test_every_dataset_has_its_units_and_a_description(tmp_path: Path) -> None:
    full_trajectory().save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5") as file:
        silent: list[str] = []

        def look(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset) and not (item.attrs.get("units") and item.attrs.get("description")):
                silent.append(name)

        file.visititems(look)
        assert not silent
        assert file["velocity"].attrs["units"] == "m/s"
        assert file["position"].attrs["units"] == "mm"
        assert file["alpha_body_sigma"].attrs["units"] == "rad/s^2"


def test_the_root_and_the_flags_are_named_as_in_the_design(tmp_path: Path) -> None:
    full_trajectory().save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5") as file:
        assert file.attrs["schema"] == "sphereorient-track/1"
        assert file.attrs["frame_rate"] == 600.0
        assert (file.attrs["method"], file.attrs["experiment"]) == ("precise", "mixer-3Hz")
        assert json.loads(file.attrs["provenance"])["command"] == ["sphereorient", "track"]
        bits = json.loads(file["flags"].attrs["bits"])
        assert bits["SPIKE"] == 128
        assert sorted(bits.values()) == [2**k for k in range(10)]
        assert file["cameras/cam1/reason"].asstr()[1] == "dark"


def test_saving_and_loading_gives_back_every_number_and_every_nan(tmp_path: Path) -> None:
    track = full_trajectory()
    track.save(tmp_path / "track.h5")
    read = Trajectory.load(tmp_path / "track.h5")
    for before, after in [(track, read), *((track.cameras[name], read.cameras[name]) for name in track.cameras)]:
        for name, values in arrays(before).items():
            np.testing.assert_array_equal(values, arrays(after)[name], err_msg=name)
            assert arrays(after)[name].dtype == values.dtype, name
    assert read.cameras["cam1"].reason == track.cameras["cam1"].reason
    assert isinstance(read.cameras["cam1"].reason[0], Reason)
    for name in ("frame_rate", "method", "settings", "experiment", "provenance"):
        assert getattr(read, name) == getattr(track, name)


@pytest.mark.parametrize("frames", [0, 1])
def test_a_trajectory_of_no_frame_or_one_is_a_trajectory(tmp_path: Path, frames: int) -> None:
    Trajectory.empty(np.arange(frames) / 600.0, cameras=("cam1",)).save(tmp_path / "track.h5")
    read = Trajectory.load(tmp_path / "track.h5")
    assert len(read) == frames
    assert len(read.to_pandas()) == frames
    assert read.summary()["frames"] == frames


def test_a_reason_of_a_later_version_is_kept(tmp_path: Path) -> None:
    camera = replace(CameraTrack.empty(2), reason=("ok", "swallowed_by_a_very_large_bubble"))
    replace(Trajectory.empty(np.zeros(2)), cameras={"cam1": camera}).save(tmp_path / "track.h5")
    assert Trajectory.load(tmp_path / "track.h5").cameras["cam1"].reason == camera.reason


def test_a_file_that_is_no_track_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("hello")
    for name, got in (("absent", "no file"), ("text", "something else")):
        with pytest.raises(TrackError, match=rf"{name}\.h5.*{got}"):
            Trajectory.load(tmp_path / f"{name}.h5")


def short_velocity(file: h5py.File) -> None:
    del file["velocity"]
    file["velocity"] = np.zeros((FRAMES - 1, 3))


DAMAGE: dict[str, Callable[[h5py.File], object]] = {
    "track/1, got sphereorient-track/9": lambda file: file.attrs.update(schema="sphereorient-track/9"),
    "/alpha_body_sigma": lambda file: file.__delitem__("alpha_body_sigma"),
    "/cameras/cam1/reason": lambda file: file.__delitem__("cameras/cam1/reason"),
    "/cameras/cam2/candidates/offset": lambda file: file.__delitem__("cameras/cam2/candidates/offset"),
    r"velocity: .* \(7, 3\), got \(6, 3\)": short_velocity,
}


@pytest.mark.parametrize("words", DAMAGE)
def test_the_damaged_dataset_is_named(tmp_path: Path, words: str) -> None:
    full_trajectory().save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5", "a") as file:
        DAMAGE[words](file)
    with pytest.raises(TrackError, match=words):
        Trajectory.load(tmp_path / "track.h5")


def test_arrays_of_unequal_length_make_no_trajectory() -> None:
    track = full_trajectory()
    with pytest.raises(ShapeError, match=r"Trajectory\.position"):
        replace(track, position=np.zeros((FRAMES, 2)))
    with pytest.raises(ShapeError, match="cam1"):
        replace(track, cameras={"cam1": CameraTrack.empty(FRAMES + 1)})
    with pytest.raises(ShapeError, match="candidate_score"):
        replace(track.cameras["cam1"], candidate_score=np.zeros(4))


def test_the_table_has_units_in_its_names_and_quaternions_w_first() -> None:
    quarter_about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    track = full_trajectory()
    R = np.full((FRAMES, 3, 3), np.nan)
    R[2] = quarter_about_z
    table = replace(track, orientation=R, orientation_smooth=R).to_pandas()
    assert len(table) == FRAMES
    np.testing.assert_array_equal(table["velocity_y_m_s"], track.velocity[:, 1])
    np.testing.assert_array_equal(table["alpha_lab_sigma_z_rad_s2"], track.alpha_lab_sigma[:, 2])
    assert {"time_s", "valid", "segment", "flags", "confidence", "position_x_mm"} <= set(table)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(table.loc[2, ["quat_w", "quat_x", "quat_y", "quat_z"]].astype(float), [half, 0, 0, half])
    assert table.loc[3, ["quat_w", "quat_smooth_z", "position_x_mm"]].isna().all()


def test_the_table_names_the_extra_where_pandas_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(OutputError, match=r"pip install 'sphereorient\[table\]'"):
        full_trajectory().to_pandas()


def test_the_summary_counts_lost_frames_by_reason() -> None:
    summary = full_trajectory().summary()
    assert summary["frames"] == FRAMES
    assert summary["valid"] == int(full_trajectory().valid.sum())
    assert list(summary["lost"]["cam1"].items()) == [("dark", 2)]
    assert json.loads(json.dumps(summary)) == summary


def test_a_track_of_before_the_systematic_errors_is_read_without_them(tmp_path: Path) -> None:
    track = full_trajectory()
    track.save(tmp_path / "track.h5")
    names = ("position_systematic_cov", "orientation_systematic_cov")
    with h5py.File(tmp_path / "track.h5", "a") as file:
        for name in names:
            del file[name]
    old = Trajectory.load(tmp_path / "track.h5")
    for name in names:
        np.testing.assert_array_equal(getattr(old, name), np.full((len(track), 3, 3), np.nan))
    np.testing.assert_array_equal(old.position_cov, track.position_cov)


def test_a_slice_is_a_part_with_its_candidates() -> None:
    track = full_trajectory()
    part = track[2:7:2]
    np.testing.assert_array_equal(part.time, track.time[[2, 4, 6]])
    np.testing.assert_array_equal(part.cameras["cam1"].candidate_offset, [0, 1, 1, 3])
    np.testing.assert_array_equal(
        part.cameras["cam1"].candidate_score, track.cameras["cam1"].candidate_score[[2, 3, 4]]
    )
    assert part.cameras["cam1"].reason == (Reason.OK, Reason.DARK, Reason.OK)
    np.testing.assert_array_equal(track[-3:].position, track.position[-3:])
    assert len(track[10:50]) == 0


@pytest.mark.parametrize(
    ("index", "error", "words"),
    [
        (3, TypeError, r"got 3; write track\[10:11\]"),
        ("time", TypeError, "got 'time'"),
        (slice(None, None, -1), ShapeError, "positive step"),
    ],
)
def test_other_indices_are_refused(index: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        full_trajectory()[index]


def test_the_summary_of_a_track_is_a_few_lines() -> None:
    lines = repr(full_trajectory()).splitlines()
    assert lines[:2] == ["Trajectory", "  of       mixer-3Hz"]
    assert lines[2] == f"  frames   7, {int(full_trajectory().valid.sum())} valid"
    assert lines[3:] == [
        "  time     0.0666667 .. 0.0766667 s, 600 Hz",
        "  cameras  cam2 (5 frames lost), cam1 (2 frames lost)",
        "  method   precise",
    ]
    assert "none" in repr(Trajectory.empty(np.zeros(0)))


def test_the_summary_in_a_notebook_is_an_escaped_table() -> None:
    page = replace(full_trajectory(), experiment="<b>& co")._repr_html_()
    assert "<td>&lt;b&gt;&amp; co</td>" in page
    assert page.count("<tr>") == 5


@pytest.mark.slow
def test_the_plot_has_a_row_of_axes_for_each_quantity_with_its_unit(tmp_path: Path) -> None:
    track = full_trajectory()
    about_z = np.linspace(0, 5, FRAMES)  # rad: the canonical quaternion changes its sign on the way
    R = np.zeros((FRAMES, 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1] = np.cos(about_z), -np.sin(about_z), np.sin(about_z), np.cos(about_z)
    R[:, 2, 2] = 1
    R[3] = np.nan
    figure = replace(track, orientation=R, orientation_smooth=R).plot()
    figure.savefig(tmp_path / "track.png")
    labels = ["position (mm)", "orientation (quaternion, 1)", "velocity (m/s)", "angular velocity, lab (rad/s)"]
    assert [axes.get_ylabel() for axes in figure.axes] == labels
    assert figure.axes[-1].get_xlabel() == "time (s)"
    w = figure.axes[1].lines[-4].get_ydata()
    np.testing.assert_allclose(np.delete(w, 3), np.delete(np.cos(about_z / 2), 3))
    assert np.isnan(w[3])
    np.testing.assert_array_equal(figure.axes[0].lines[0].get_ydata(), track.position[:, 0])
    assert len(Trajectory.empty(np.zeros(0)).plot().axes) == 4


@pytest.mark.parametrize(("known", "wanted"), [(2, 1), (1, 2)])
def test_rows_match_to_half_of_the_shorter_step(known: int, wanted: int) -> None:
    """Before: to half of the known one, so that a frame between two known ones was compared with either."""
    row, there = nearest_rows(np.arange(0, 20, known), np.arange(0, 20, wanted) + 0.3)
    assert there.tolist() == [k % known == 0 for k in range(0, 20, wanted)]
    np.testing.assert_array_equal((known * row)[there], np.arange(0, 20, wanted)[there])
