"""A track for FicTrac's readers, evo, ParaView, NWB and netCDF; and how an animal walks on the ball."""

import math
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from conftest import SHARED
from overlay_examples import changed, true_track
from scipy.spatial.transform import Rotation

from sphereorient import so3
from sphereorient.errors import OutputError
from sphereorient.report.export import export_track, fictrac_table
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.walk import FicTracAxes, walk_of

HERTZ = 100.0


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """The excerpt's truth; frame 7 was not measured."""
    return changed(true_track(), 7, position=np.nan, orientation=np.nan, orientation_smooth=np.nan, valid=False)


@pytest.fixture(scope="module")
def axes() -> FicTracAxes:
    return FicTracAxes.of_lab(so3.exp(vector(0.7, -0.1, 0.4)).numpy())


def rolled(rate: torch.Tensor, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and orientations of a ball that rotates at a constant rate (3,), rad/s, lab."""
    time_s = np.arange(frames) / HERTZ
    return time_s, (so3.exp(torch.from_numpy(time_s)[:, None] * rate) @ so3.exp(vector(0.3, 0.2, -1.0))).numpy()


def test_an_animal_that_walks_ahead_turns_the_ball_about_its_right():
    walk = walk_of(*rolled(vector(0.0, 2.0, 0.0), 51))
    np.testing.assert_allclose(walk.forward_rad_s[1:], 2.0)
    np.testing.assert_allclose(walk.path[-1], [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.minimum(walk.heading_rad, 2 * np.pi - walk.heading_rad), 0.0, atol=1e-12)


def test_an_animal_that_turns_while_it_walks_goes_round_a_circle():
    """A whole turn at 3 rad/s with 2 radii/s ahead: a circle of 2/3 radii, back where it began."""
    frames = round(2 * math.pi / 3 * HERTZ)
    rate = 2 * math.pi / (frames / HERTZ)
    walk = walk_of(*rolled(vector(0.0, 2.0, -rate), frames + 1))
    np.testing.assert_allclose(walk.turn_rad_s[1:], rate)
    np.testing.assert_allclose(walk.path[-1], [0.0, 0.0], atol=1e-9)
    middle = np.array([0.0, 2.0 / rate])  # to the right: it turns right
    np.testing.assert_allclose(np.linalg.norm(walk.path - middle, axis=1), 2.0 / rate, rtol=1e-9)


def test_a_gap_begins_anew():
    time_s, R = rolled(vector(0.1, 2.0, 0.3), 40)
    R[20] = np.nan
    walk = walk_of(time_s, R)
    assert np.flatnonzero(walk.start).tolist() == [0, 21]
    assert np.isnan(walk.heading_rad[20])
    np.testing.assert_array_equal(walk.path[21], 0.0)
    fresh = walk_of(time_s[21:], R[21:])
    np.testing.assert_allclose(walk.path[21:], fresh.path, atol=1e-12)


@pytest.mark.shared
def test_the_walk_is_what_fictrac_itself_wrote():
    """From its absolute rotations, its other columns; its path is integrated in four steps a frame."""
    table = np.loadtxt(SHARED / "real" / "fictrac" / "fictrac_q6.dat", delimiter=",")
    walk = walk_of(np.arange(len(table), dtype=float), so3.exp(torch.from_numpy(table[:, 11:14])).numpy())
    np.testing.assert_allclose(walk.turn_rad[1:], table[1:, 5:8], atol=1e-9)
    np.testing.assert_allclose(np.cos(walk.heading_rad - table[:, 16]), 1.0, atol=1e-12)
    np.testing.assert_allclose(walk.path, table[:, 14:16], atol=1e-4)
    np.testing.assert_allclose(np.nancumsum(walk.forward_rad_s), table[:, 19], atol=1e-9)
    np.testing.assert_allclose(np.nancumsum(walk.side_rad_s), table[:, 20], atol=1e-9)


def test_fictracs_columns_belong_together(track, axes, tmp_path):
    export_track(track, tmp_path / "t.dat", axes=axes)
    table = np.loadtxt(tmp_path / "t.dat", delimiter=",")
    assert table.shape == (40, 25)
    R_cam_lab = axes.R_cam_own
    np.testing.assert_allclose(table[1:7, 1:4], table[1:7, 5:8] @ R_cam_lab.T, atol=1e-12)
    # R_cam(k) = exp(dr_cam(k)) R_cam(k - 1), from the unit rotation; R_lab = C R_cam.
    R_cam, step = (Rotation.from_rotvec(table[:7, part]) for part in (slice(8, 11), slice(1, 4)))
    assert max(R_cam[0].magnitude(), step[0].magnitude()) < 1e-12
    for k in range(1, 7):
        assert (R_cam[k].inv() * step[k] * R_cam[k - 1]).magnitude() < 1e-12
    R_lab = Rotation.from_rotvec(table[:7, 11:14]).as_matrix()
    np.testing.assert_allclose(R_lab, R_cam_lab.T @ R_cam.as_matrix(), atol=1e-12)
    assert np.isnan(table[7, 1:21]).all()
    np.testing.assert_array_equal(table[:, 0], np.arange(40))  # both counters from 0, as FicTrac's program has them
    np.testing.assert_array_equal(table[:, 22], [*range(8), *range(32)])  # the sequence begins anew
    np.testing.assert_allclose(table[:, 21], 1e3 * track.time)


def test_fictracs_frame_is_that_of_the_experiment(axes):
    """Before: the row, so that a part of the frames, or a track without some, was compared with other ones."""
    part = true_track().at(np.array([5, 6, 8, 12, 13]))
    table = fictrac_table(part, axes)
    np.testing.assert_array_equal(table[:, 0], [5, 6, 8, 12, 13])


def test_fictracs_table_needs_the_camera(track, tmp_path):
    with pytest.raises(OutputError, match="add --experiment"):
        export_track(track, tmp_path / "t.dat")
    assert not list(tmp_path.iterdir())


def test_a_smoothed_pose_stands_in_for_one_not_measured(track, axes):
    smooth = replace(track, orientation_smooth=true_track().orientation)
    whole = fictrac_table(true_track(), axes)
    np.testing.assert_allclose(fictrac_table(smooth, axes)[:, 5:21], whole[:, 5:21], atol=1e-12)


def test_tum_has_the_valid_frames_with_w_last(track, tmp_path):
    export_track(track, tmp_path / "t.tum")
    table = np.loadtxt(tmp_path / "t.tum")
    assert len(table) == 39
    np.testing.assert_array_equal(table[:, 0], track.time[track.valid])
    np.testing.assert_array_equal(table[:, 1:4], track.position[track.valid])
    R = Rotation.from_quat(table[:, 4:]).as_matrix()
    np.testing.assert_allclose(R, track.orientation[track.valid], atol=1e-12)


def test_vtk_has_a_vertex_a_step(track, tmp_path):
    export_track(track, tmp_path / "t.vtkhdf")
    with h5py.File(tmp_path / "t.vtkhdf") as file:
        root = file["VTKHDF"]
        assert bytes(root.attrs["Type"]) == b"PolyData"
        np.testing.assert_array_equal(root["Steps/Values"], track.time[track.valid])
        np.testing.assert_array_equal(root["Points"], track.position[track.valid])
        np.testing.assert_array_equal(root["PointData/body_y"], track.orientation[track.valid][:, :, 1])
        assert root["Vertices/Offsets"].shape == (2 * 39,)
        assert root["Lines/Offsets"].shape == (39,)


def test_paraviews_reader_plays_it(track, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    export_track(track, tmp_path / "t.vtkhdf")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "t.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 39
    for step in (0, 7, 38):
        reader.SetStep(step)
        reader.Update()
        shown = reader.GetOutput()
        assert shown.GetNumberOfVerts() == 1
        np.testing.assert_allclose(shown.GetPoint(0), track.position[track.valid][step], atol=1e-5)
        omega = vtk_to_numpy(shown.GetPointData().GetArray("omega_lab"))
        np.testing.assert_array_equal(omega[0], track.omega_lab[track.valid][step])


def test_nwb_is_read_back(track, tmp_path):
    pynwb = pytest.importorskip("pynwb")
    export_track(track, tmp_path / "t.nwb")
    with pynwb.NWBHDF5IO(str(tmp_path / "t.nwb"), "r") as io:
        behavior = io.read().processing["behavior"]
        position = behavior["position"]
        assert (position.unit, behavior["omega_lab"].unit) == ("m", "rad/s")
        np.testing.assert_allclose(position.data[:], 1e-3 * track.position)
        np.testing.assert_array_equal(position.timestamps[:], track.time)


def test_netcdf_is_read_back(track, tmp_path):
    xarray = pytest.importorskip("xarray")
    export_track(track, tmp_path / "t.nc")
    with xarray.open_dataset(tmp_path / "t.nc") as data:
        np.testing.assert_array_equal(data["position"], track.position)
        np.testing.assert_array_equal(data["valid"], track.valid)
        assert data["omega_lab"].attrs["units"] == "rad/s"


def test_csv_needs_no_extra(monkeypatch, track, tmp_path):
    for package in ("pyarrow", "pandas", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
    export_track(track, tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().count("\n") > 40


def test_scipy_gets_the_valid_orientations(track):
    np.testing.assert_allclose(track.to_scipy().as_matrix(), track.orientation[track.valid], atol=1e-12)
