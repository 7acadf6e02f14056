"""A pose as a line: FicTrac's, and JSON."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from live_examples import rows
from overlay_examples import true_track

from sphereorient import so3
from sphereorient.cameras import PinholeCamera
from sphereorient.live.lines import FicTracLines, fictrac_line, json_line
from sphereorient.report.export_poses import fictrac_table
from sphereorient.trajectory import Trajectory


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """The excerpt's truth; frames 7 and 8 were not measured."""
    whole = true_track()
    orientation = whole.orientation.copy()
    orientation[7:9] = np.nan
    valid = np.isfinite(orientation).all((1, 2))
    return replace(whole, orientation=orientation, orientation_smooth=orientation, valid=valid)


def test_lines_are_the_rows_of_the_exported_table(track):
    R_cam_lab = so3.exp(torch.tensor([0.7, -0.1, 0.4], dtype=torch.float64))
    camera = PinholeCamera(
        image_size=(64, 48),
        f_px=torch.tensor(90.0),
        centre_px=torch.tensor([31.5, 23.5]),
        R_cam_lab=R_cam_lab,
        T_cam_lab_mm=torch.zeros(3),
    )
    table, lines = fictrac_table(track, camera), FicTracLines(camera)
    found = np.array([[float(part) for part in fictrac_line(lines.columns(now)).split(", ")] for now in rows(track)])
    assert found.shape == (len(track), 25)
    rest = [k for k in range(25) if k != 4]  # the stated error is another one here
    np.testing.assert_allclose(found[:, rest], table[:, rest], atol=1e-9)


def test_json_has_null_for_what_is_not_known(track):
    known, lost = [json.loads(json_line(now)) for now in rows(track)][6:8]
    assert known["valid"]
    assert known["sigma_rad"] == pytest.approx([1e-3] * 3)
    assert math.hypot(*known["quaternion_wxyz"]) == pytest.approx(1)
    assert (lost["valid"], lost["quaternion_wxyz"], lost["reason"]) == (False, [None] * 4, ["not_found"])
