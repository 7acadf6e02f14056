"""Lengths carry the track's unit in every output; a fixed ball has no translation."""

import io
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from ensembles import EnsembleSpec, draw_ensemble
from overlay_examples import true_track

from sphereorient import so3
from sphereorient.errors import TrackError
from sphereorient.motion import MotionSettings, datasets_of, measure_motion
from sphereorient.report import plots
from sphereorient.report.build import write_report
from sphereorient.report.columns import columns, to_xarray
from sphereorient.report.export import export_track
from sphereorient.report.page import page_html
from sphereorient.report.tables import tables_of
from sphereorient.report.verdicts import verdicts
from sphereorient.statistics import StatisticsSettings, summarise
from sphereorient.statistics.noise import width_curve
from sphereorient.statistics.segments import ensemble_of
from sphereorient.trajectory import Trajectory

FEW = StatisticsSettings(resamples=100)
LENGTHS = {"position": "radii", "position_cov": "radii^2", "velocity": "radii/s", "acceleration_sigma": "radii/s^2"}


@pytest.fixture
def track():
    return replace(true_track(), length_unit="radii")


def lengths_in(text):
    """Units of length in mm or m that a text writes."""
    return [word for word in ("mm", "m/s", "_m_s", "m per s") if word in text]


def test_the_file_and_its_tables_have_lengths_in_radii(track, tmp_path):
    """Before: mm and m/s in file, table and export. After: radii, radii/s; other units as ever."""
    track.save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5") as file:
        assert {name: file[name].attrs["units"] for name in LENGTHS} == LENGTHS
        assert file["omega_lab"].attrs["units"] == "rad/s"
        assert file["cameras/cam1/radius_px"].attrs["units"] == "px"
    again = Trajectory.load(tmp_path / "track.h5")
    assert again.length_unit == again[3:9].length_unit == "radii"
    table = list(again.to_pandas())
    assert {"position_x_radii", "velocity_x_radii_s", "acceleration_y_radii_s2", "omega_lab_x_rad_s"} <= set(table)
    exported = [one.name for one in columns(again)]
    assert "position_cov_xy_radii2" in exported
    assert not lengths_in(" ".join(table + exported))
    export_track(again, tmp_path / "track.csv")
    text = (tmp_path / "track.csv").read_text()
    assert "# length_unit: radii" in text
    assert not lengths_in(text)
    assert to_xarray(again)["velocity"].attrs["units"] == "radii/s"


def test_a_file_without_the_unit_is_in_mm(track, tmp_path):
    track.save(tmp_path / "track.h5")
    with h5py.File(tmp_path / "track.h5", "a") as file:
        del file.attrs["length_unit"]
    assert Trajectory.load(tmp_path / "track.h5").length_unit == "mm"


def test_figures_have_lengths_in_radii(track):
    labels = [axes.get_ylabel() for axes in (*plots.track_figure(track).axes, *track.plot().axes)]
    (path,) = plots.path_figure(track).axes
    labels += [path.get_xlabel(), path.get_zlabel()]
    assert {"position, lab (radii)", "velocity, lab (radii/s)", "x, lab (radii)"} <= set(labels)
    assert not lengths_in(" ".join(labels))


def test_statistics_and_their_figures_have_lengths_in_radii():
    tracks = replace(draw_ensemble(EnsembleSpec(segments=4, mean_frames=90.0), 1), length_unit="radii")
    table = summarise(tracks, FEW).table
    assert [table[name].units for name in ("velocity", "acceleration", "omega_lab")] == [
        "radii/s",
        "radii/s^2",
        "rad/s",
    ]
    widths = {"acceleration": width_curve([tracks], "acceleration", settings=FEW)}
    assert "(radii/s²)" in plots.widths_figure(widths).axes[0].get_ylabel()


def test_tables_and_page_of_a_report_have_lengths_in_radii():
    """Before: errors in mm and velocities in m/s, of numbers in radii."""
    one = replace(draw_ensemble(EnsembleSpec(segments=6, mean_frames=90.0), 1), length_unit="radii")
    tracks, summary = {"a.h5": one, "b.h5": one}, summarise([one], FEW)
    tables = tables_of(summary, tracks, [])
    (row, _), (other, _) = (
        {table.name: table for table in made}["tracks"].rows
        for made in (tables, tables_of(summary, dict.fromkeys(tracks, replace(one, length_unit="mm")), []))
    )
    assert not lengths_in(" ".join(row))
    assert row["rms_v_radii_s"] == other["rms_v_m_s"]
    page = page_html(summary, tracks, "", verdicts=[], tables=tables, suffixes=["csv"], figures=[], strips=[])
    heads = re.findall("<th[^>]*>([^<]*)</th>", page)
    assert {"stated error, radii", "rms of v, radii/s"} <= set(heads)
    assert not lengths_in(" ".join(heads))


def test_velocities_are_lengths_of_the_position_a_second():
    """Before: 1/1000 radius per s, called m/s. After: radii/s: a ball at 2 radii a frame of 1/100 s has 200."""
    frames = torch.arange(60, dtype=torch.float64)
    place = torch.stack([2.0 * frames, 0 * frames, 0 * frames], dim=-1)
    turn = so3.exp(torch.stack([0 * frames, 0 * frames, 0.1 * frames], dim=-1))
    motion = measure_motion(place, turn, torch.zeros(60, dtype=torch.long), 100.0, MotionSettings())
    assert datasets_of(motion)["velocity"][30] == pytest.approx([0.2, 0.0, 0.0])  # m/s of 2 mm a frame
    radii = datasets_of(motion, "radii")
    assert radii["velocity"][30] == pytest.approx([200.0, 0.0, 0.0])
    assert radii["omega_lab"][30] == pytest.approx([0.0, 0.0, 10.0])


def test_tracks_of_different_units_are_not_averaged():
    one = draw_ensemble(EnsembleSpec(segments=4, mean_frames=90.0), 1)
    with pytest.raises(TrackError, match="got mm, radii"):
        ensemble_of([one, replace(one, length_unit="radii")])


def held(track, spread_mm=1e-9):
    """The track of a fixed ball: one position, with its error."""
    rng = np.random.default_rng(1)
    place = np.array([1.0, 2.0, 3.0]) + spread_mm * rng.normal(size=(len(track), 3))
    still = {name: 1e-10 * rng.normal(size=(len(track), 3)) for name in ("velocity", "acceleration")}
    still |= {f"{name}_sigma": np.full((len(track), 3), 1e-3) for name in ("velocity", "acceleration")}
    cov = np.tile(0.02**2 * np.eye(3), (len(track), 1, 1))
    return replace(track, position=place, position_smooth=place, position_cov=cov, valid=track.segment >= 0, **still)


@pytest.mark.slow
def test_the_report_of_a_fixed_ball_has_nothing_on_its_translation(tmp_path):
    """Before: six verdicts "velocity x: 100 % of the variance is smoothed away", 1.25e-10 m/s in large letters.

    After: one sentence that the centre is fixed; omega and alpha as of any track, to the digit.
    """
    moving = draw_ensemble(EnsembleSpec(segments=12, mean_frames=90.0), 3)
    still = held(moving)
    assert still.held
    assert not moving.held
    assert not held(moving, 0.01).held  # half its error: it may move
    found = verdicts(summarise(still, FEW), {"track.h5": still}, ())
    assert [one.words for one in found if one.title == "Place"] == [
        "the centre is fixed: this page reports the rotation only"
    ]
    words = " ".join(f"{one.title} {one.words}" for one in found)
    assert "velocity" not in words
    assert "acceleration" not in words
    assert "Lift" not in words
    write_report({"track.h5": still}, tmp_path / "report", settings=FEW)
    page = re.sub("base64,[A-Za-z0-9+/=]+", "", (tmp_path / "report" / "index.html").read_text())
    assert "<title>Rotation of a sphere" in page
    assert "rad/s" in page
    assert "m/s" not in page
    for name in ("moments", "fits", "correlations", "isotropy", "kernel_widths", "multi_lag"):
        path = tmp_path / "report" / "tables" / f"{name}.csv"
        assert not path.exists() or "velocity" not in path.read_text().replace("angular velocity", "")
    omega = [summarise(one, FEW).table["omega_lab"].rms.value for one in (still, moving)]
    np.testing.assert_array_equal(*omega)


def test_a_figure_of_a_fixed_ball_shows_its_rotation_alone():
    figure = plots.track_figure(held(true_track()))
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert len(labels) == 3
    assert labels[1:] == ["ω, lab (rad/s)", "α, lab (rad/s²)"]
    assert all(axes.lines for axes in figure.axes)
    figure.savefig(io.BytesIO(), format="png")
