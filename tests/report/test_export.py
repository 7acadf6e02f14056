import json
import re
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from overlay_examples import changed, command, true_track
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from sphereorient.errors import OutputError
from sphereorient.report.columns import columns, safe_names, to_xarray
from sphereorient.report.export import export_track, format_of
from sphereorient.report.tables import Table, write_tables
from sphereorient.trajectory import CameraTrack, Trajectory

pd = pytest.importorskip("pandas")
arrow_parquet = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """The excerpt's truth with covariances, flags, a frame lost, and text that is awkward in a table."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(40, 3, 3))
    made = replace(true_track(), position_cov=root @ root.mT, flags=np.arange(40, dtype=np.uint32))
    made = changed(made, 7, position=np.nan, orientation=np.nan, valid=False)
    return replace(made, settings="a:\n  b: 1.0e-3  # why\n", experiment="of\nMay", provenance={"versions": {"x": "1"}})


@pytest.fixture(scope="module", params=["csv", "parquet"])
def table(request, track, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / f"track.{request.param}"
    export_track(track, path, request.param)
    return pd.read_csv(path, comment="#") if request.param == "csv" else pd.read_parquet(path)


def test_a_table_holds_what_to_pandas_gives_and_more(table, track):
    expected = track.to_pandas()
    assert set(expected.columns) <= set(table.columns)
    for name in expected.columns:
        np.testing.assert_array_equal(table[name].to_numpy(float), expected[name].to_numpy(float), err_msg=name)


def test_every_frame_wise_dataset_is_in_the_table(table):
    for record, prefix in ((Trajectory, ""), (CameraTrack, "cam2_")):
        for entry in fields(record):
            column = entry.metadata.get("column")
            if column is not None and column.rows == "frames" and not column.of_several:
                stem = entry.name.removesuffix("_px").replace("orientation", "quat", 1)
                stems = (prefix + stem, prefix + entry.name)
                assert any(name.startswith(stems) for name in table.columns), entry.name
    assert {"cam1_centre_u_px", "cam1_radius_px", "cam1_reason", "margin_angle_rad", "alpha_lab_sigma_z_rad_s2"} <= set(
        table.columns
    )


def test_covariances_are_found_again_from_their_six_columns(table, track):
    for i in range(3):
        for j in range(3):
            name = f"position_cov_{''.join(sorted('xyz'[i] + 'xyz'[j]))}_mm2"
            np.testing.assert_array_equal(table[name], track.position_cov[:, i, j])


def test_quaternions_are_the_orientations_w_first(table, track):
    quat = table[["cam1_quat_w", "cam1_quat_x", "cam1_quat_y", "cam1_quat_z"]].to_numpy()
    back = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    np.testing.assert_allclose(back, track.cameras["cam1"].orientation, atol=1e-12)
    assert (quat[:, 0] >= 0).all()


def test_what_was_not_measured_is_nan(table):
    assert np.flatnonzero(table["quat_w"].isna()).tolist() == [7]
    assert table["position_x_mm"].isna().sum() == 1
    assert table["valid"].sum() == 39
    assert table["cam1_reason"].tolist() == ["ok"] * 40


def test_the_csv_begins_with_the_metadata_of_the_track(track, tmp_path):
    export_track(track, tmp_path / "t.csv", "csv")
    head = [line for line in (tmp_path / "t.csv").read_text().splitlines() if line.startswith("#")]
    assert head[:2] == ["# made by sphereorient", "# experiment: of May"]
    assert "# method: precise" in head
    assert "# frame_rate_hz: 600.0" in head
    assert '# provenance: {"versions": {"x": "1"}}' in head
    assert "#     b: 1.0e-3  # why" in head


def test_parquet_keeps_nan_apart_from_nothing_and_names_units(track, tmp_path):
    export_track(track, tmp_path / "t.parquet", "parquet")
    table = arrow_parquet.read_table(tmp_path / "t.parquet")
    assert all(table[name].null_count == 0 for name in table.column_names)
    field = table.schema.field("velocity_x_m_s")
    assert field.metadata[b"units"] == b"m/s"
    assert b"velocity of the centre" in field.metadata[b"description"]
    about = table.schema.metadata
    assert about[b"method"] == b"precise"
    assert float(about[b"frame_rate_hz"]) == 600.0
    assert json.loads(about[b"provenance"]) == track.provenance
    assert about[b"settings"].decode() == track.settings


def test_matlab_gets_matrices_quaternions_structs_and_metadata(track, tmp_path):
    export_track(track, tmp_path / "t.mat", "mat")
    found = loadmat(tmp_path / "t.mat", simplify_cells=True)
    np.testing.assert_array_equal(found["orientation"], track.orientation)
    np.testing.assert_array_equal(found["position_cov_mm2"], track.position_cov)
    np.testing.assert_array_equal(found["omega_lab_rad_s"], track.omega_lab)
    there = np.arange(40) != 7
    back = Rotation.from_quat(found["quat_wxyz"][there], scalar_first=True).as_matrix()
    np.testing.assert_allclose(back, track.orientation[there], atol=1e-12)
    np.testing.assert_array_equal(found["cameras"]["cam2"]["centre_px"], track.cameras["cam2"].centre_px)
    assert list(found["cameras"]["cam1"]["reason"]) == ["ok"] * 40
    about = found["metadata"]
    assert (about["method"], about["frame_rate_hz"], about["flags"]["SPIKE"]) == ("precise", 600.0, 128)
    assert json.loads(about["provenance"]) == track.provenance
    assert about["units"]["alpha_lab_rad_s2"] == "rad/s^2"


@pytest.mark.slow
def test_xarray_names_axes_and_units(track):
    pytest.importorskip("xarray")
    data = to_xarray(track)
    assert data["orientation"].dims == ("time", "axis", "body_axis")
    assert data["position_cov"].dims == ("time", "axis", "axis_2")
    assert data["camera_centre_px"].dims == ("camera", "time", "image_axis")
    np.testing.assert_array_equal(data["omega_lab"].sel(axis="y"), track.omega_lab[:, 1])
    np.testing.assert_array_equal(data["camera_radius_px"].sel(camera="cam2"), track.cameras["cam2"].radius_px)
    assert data["acceleration"].attrs["units"] == "m/s^2"
    assert data["time"].attrs["units"] == "s"
    assert (data.attrs["method"], data.attrs["frame_rate_hz"]) == ("precise", 600.0)
    columns = {entry.name: entry.metadata.get("column") for entry in fields(Trajectory)}
    wanted = {name for name, column in columns.items() if column is not None and not column.of_several}
    assert wanted <= set(data.variables)


@pytest.mark.parametrize("to", ["csv", "parquet", "mat", "vtkhdf"])
def test_a_track_without_frames_or_cameras_can_be_written(tmp_path, to):
    export_track(Trajectory.empty(np.zeros(0)), tmp_path / f"t.{to}")
    assert (tmp_path / f"t.{to}").stat().st_size > 100
    pytest.importorskip("xarray")
    assert to_xarray(Trajectory.empty(np.zeros(0))).sizes["time"] == 0


def test_long_tracks_are_written_in_parts_and_progress_is_reported(tmp_path, monkeypatch, track):
    monkeypatch.setattr("sphereorient.report.export.ROWS", 15)
    for to in ("csv", "parquet"):
        steps: list[tuple[int, int]] = []
        export_track(track, tmp_path / f"t.{to}", to, lambda *at, steps=steps: steps.append(at))
        assert steps == [(15, 40), (30, 40), (40, 40)]
    np.testing.assert_array_equal(pd.read_csv(tmp_path / "t.csv", comment="#")["time_s"], track.time)
    np.testing.assert_array_equal(pd.read_parquet(tmp_path / "t.parquet")["time_s"], track.time)


def test_names_of_cameras_that_no_table_takes_are_made_plain():
    empty = CameraTrack.empty(2)
    odd = replace(Trajectory.empty(np.arange(2.0)), cameras={"a b": empty, "a#b": empty, "1": empty, "ä": empty})
    assert list(safe_names(odd)) == ["a_b", "a_b_2", "camera_1", "camera__"]
    names = [column.name for column in columns(odd)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(("to", "package"), [("parquet", "pyarrow"), ("nc", "xarray"), ("nwb", "pynwb")])
def test_a_missing_package_is_named_with_its_remedy(monkeypatch, track, tmp_path, to, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(OutputError, match=f"package {package}, got none; .*pip install") as error:
        export_track(track, tmp_path / f"t.{to}")
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "to", "words"),
    [
        ("t.xlsx", None, r"expected \.csv \.parquet .* \.nc, got '\.xlsx'; add --to"),
        ("t", None, "got ''"),
        ("t.csv", "excel", "expected one of csv, parquet, .*netcdf, got 'excel'"),
        ("t.csv", "mat", "expected a name for mat, got '.csv'"),
    ],
)
def test_unknown_formats_are_refused(tmp_path, name, to, words):
    with pytest.raises(OutputError, match=words):
        format_of(tmp_path / name, to)


@pytest.mark.parametrize(
    ("name", "to", "format_"), [("t.csv", None, "csv"), ("T.PQ", None, "parquet"), ("t.txt", "csv", "csv")]
)
def test_the_suffix_gives_the_format_unless_an_option_does(tmp_path, name, to, format_):
    assert format_of(tmp_path / name, to) == format_


def test_the_command_writes_a_whole_file_or_one_line(track, tmp_path, monkeypatch, capsys):
    track.save(tmp_path / "track.h5")
    code, printed, _ = command(monkeypatch, capsys, "export", tmp_path / "track.h5", "--out", tmp_path / "t.csv")
    assert code == 0
    assert "40 frames" in printed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t.csv", "track.h5"]
    code, _, error = command(
        monkeypatch, capsys, "export", tmp_path / "t.csv", "--to", "mat", "--out", tmp_path / "t.mat"
    )
    assert code == 2
    assert error.count("\n") == 1
    assert "t.csv: expected an HDF5 file" in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t.csv", "track.h5"]


@pytest.mark.parametrize("begin", list("=+-@\t\r"))
def test_no_cell_of_a_table_is_a_formula(track, tmp_path, begin):
    """Before: the experiment's name stood in the CSV as it is, and spreadsheet programs computed it."""
    evil = f'{begin}HYPERLINK("http://x","y")'
    named = replace(track, experiment=f"a,{evil}", settings=f"{evil}\n", method=f"b;{evil}\tc")
    export_track(named, tmp_path / "t.csv", "csv")
    with (tmp_path / "t.csv").open(newline="") as file:
        text = file.read()
    head = text[: text.index("\ntime_s")]
    assert begin.isspace() or f"# experiment: a,'{begin}HYPERLINK" in head  # blanks are single spaces there
    assert not [cell for cell in re.split(r"[,;\t\n]", head) if re.match(r"[=+\-@\r]", cell)]
    rows = [{"file": evil, "frames": -3, "note": "plain"}]
    write_tables([Table(name="tracks", about="", rows=rows)], tmp_path)
    assert pd.read_csv(tmp_path / "tracks.csv").iloc[0].tolist() == [f"'{evil}", -3, "plain"]
