import json
import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
import torch
from live_examples import rows
from overlay_examples import true_track

from sphereorient import so3
from sphereorient.live.lines import FicTracLines, Forms, Quantities
from sphereorient.live.live import Measured
from sphereorient.report.export import fictrac_table
from sphereorient.trajectory import Flag, Trajectory
from sphereorient.trajectory.walk import FicTracAxes


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """The excerpt's truth; frames 7 and 8 were not measured."""
    whole = true_track()
    orientation = whole.orientation.copy()
    orientation[7:9] = np.nan
    valid = np.isfinite(orientation).all((1, 2))
    return replace(whole, orientation=orientation, orientation_smooth=orientation, valid=valid)


def test_lines_are_the_rows_of_the_exported_table(track):
    R_cam_own, R_own_lab = so3.exp(torch.tensor([[0.7, -0.1, 0.4], [0.2, 0.1, -0.3]], dtype=torch.float64)).numpy()
    axes = FicTracAxes(R_own_lab=R_own_lab, R_cam_own=R_cam_own)
    table, lines = fictrac_table(track, axes), FicTracLines(axes)
    texts = [Forms(now, lines, Quantities(fixed=True)).fictrac for now in rows(track)]
    found = np.array([[float(part) for part in text.split(", ")] for text in texts])
    assert found.shape == (len(track), 25)
    rest = [k for k in range(25) if k != 4]  # the stated error is another one here
    np.testing.assert_allclose(found[:, rest], table[:, rest], atol=1e-9)


def test_json_has_null_for_what_is_not_known(track):
    known, lost = lines_of(rows(track), fixed=True)[6:8]
    assert known["valid"]
    assert known["sigma_rad"] == pytest.approx([1e-3] * 3)
    assert math.hypot(*known["quaternion_wxyz"]) == pytest.approx(1)
    assert (lost["valid"], lost["quaternion_wxyz"], lost["reason"]) == (False, [None] * 4, ["not_found"])


def forms(frames: Iterable[Measured], known: Quantities) -> list[Forms]:
    table = FicTracLines(FicTracAxes.of_lab(np.eye(3)))
    return [Forms(now, table, known) for now in frames]


def lines_of(frames: Iterable[Measured], fixed: bool, unit: str = "mm") -> list[dict]:
    return [json.loads(one.json) for one in forms(frames, Quantities(fixed, unit))]


def test_json_names_flags(track):
    frames = [replace(now, flags=int(Flag.ONE_CAMERA | Flag.DOUBTFUL_FIT)) for now in rows(track)][:1]
    assert lines_of(frames, fixed=True)[0]["flags"] == ["ONE_CAMERA", "DOUBTFUL_FIT"]
    assert lines_of(rows(track), fixed=True)[0]["flags"] == []


def test_the_keys_of_lengths_name_their_unit(track):
    in_mm, in_radii = (lines_of(rows(track), fixed=False, unit=unit)[6] for unit in ("mm", "radii"))
    lengths = {"position_lab_mm": "position_radii"} | {
        key: key.replace("mm", "radii") for key in ("sigma_mm", "velocity_mm_s", "sigma_velocity_mm_s")
    }
    assert {lengths.get(key, key): value for key, value in in_mm.items()} == in_radii
    assert not [key for key in in_radii if "mm" in key]


def test_numbers_are_those_of_the_json_each_with_a_name(track):
    one = forms(rows(track), Quantities(fixed=False, length_unit="radii"))[6]
    shown = json.loads(one.json)
    assert [one.numbers[f"position_radii_{axis}"] for axis in "xyz"] == shown["position_radii"]
    assert [one.numbers[f"quaternion_{axis}"] for axis in "wxyz"] == shown["quaternion_wxyz"]
    assert math.isnan(one.numbers["omega_rad_s_x"])
    lists = [name for name, value in shown.items() if isinstance(value, list) and name not in ("flags", "reason")]
    assert len(one.numbers) == len(shown) - len(lists) - 1 + sum(len(shown[name]) for name in lists)


def test_the_short_line_is_the_frame_and_the_rotation_vector_of_the_ball(track):
    known, lost = (one.short.split(",") for one in forms(rows(track), Quantities(fixed=True))[6:8])
    R = so3.exp(torch.tensor([float(part) for part in known[1:]], dtype=torch.float64))
    np.testing.assert_allclose(R, track.orientation[6], atol=2e-5)
    assert (known[0], lost) == ("6", ["7", "nan", "nan", "nan"])


def test_json_has_the_rates_of_the_motion_so_far():
    """Truth as if it were measured."""
    whole = true_track()
    frames = [
        replace(now, position_lab_mm=X, covariance=1e-8 * np.eye(6))
        for now, X in zip(rows(whole), whole.position, strict=True)
    ]
    lines = lines_of(frames, fixed=False)
    for line, omega, velocity in [*zip(lines, whole.omega_lab, whole.velocity, strict=True)][-10:]:
        np.testing.assert_allclose(line["omega_rad_s"], omega, atol=5 * max(line["sigma_omega_rad_s"]))
        np.testing.assert_allclose(line["velocity_mm_s"], 1e3 * velocity, atol=5 * max(line["sigma_velocity_mm_s"]))
        assert max(line["sigma_omega_rad_s"]) < 0.1 * np.linalg.norm(omega)
    assert lines[10]["omega_rad_s"] == [None] * 3
    held = lines_of(frames, fixed=True)
    assert {tuple(line["velocity_mm_s"]) for line in held} == {(None,) * 3}
    assert [line["omega_rad_s"] for line in held] == [line["omega_rad_s"] for line in lines]


def test_rates_begin_anew_where_the_ball_was_searched_for_lost_or_measured_by_another_map():
    frames = list(rows(true_track()))
    frames[34] = replace(frames[34], found=True)
    assert unknown(lines_of(frames, fixed=True)) == [34, 35]
    frames = list(rows(true_track()))
    frames[34] = replace(frames[34], covariance=np.full((6, 6), np.nan))
    assert unknown(lines_of(frames, fixed=True)) == [34, 35, 36]
    frames = [replace(now, map_number=1 + (k >= 34)) for k, now in enumerate(rows(true_track()))]
    assert unknown(lines_of(frames, fixed=True)) == [34, 35]


def unknown(lines: list[dict]) -> list[int]:
    return [k for k, line in enumerate(lines) if k >= 26 and line["omega_rad_s"] == [None] * 3]
