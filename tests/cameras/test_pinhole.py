"""The camera without lens."""

from __future__ import annotations

import math

import pytest
import torch
from camera_examples import f64, pinhole
from conftest import assert_close

from sphereorient.cameras.model import focal_of_field, middle_of_picture
from sphereorient.errors import CameraError


def test_the_field_of_view_is_that_of_the_full_height():
    f_px = focal_of_field(288, 45.0)
    assert f_px == pytest.approx(347.6467, abs=1e-4)  # 144 / tan(22.5 degrees)
    camera = pinhole(
        image_size=(384, 288), f_px=f64(f_px), centre_px=middle_of_picture((384, 288)),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
    )  # fmt: skip
    top, bottom = camera.rays(f64([(191.5, -0.5), (191.5, 287.5)])).direction_lab
    assert math.degrees(torch.acos(top @ bottom)) == pytest.approx(45.0, abs=1e-9)
    assert abs(191.5 / math.tan(math.radians(22.5)) - f_px) > 100  # the width would give another


def test_the_middle_of_a_picture_lies_between_its_outer_pixel_centres():
    assert_close(middle_of_picture((384, 288)), f64((191.5, 143.5)))


@pytest.mark.parametrize("vfov_deg", [0.0, -3.0, 180.0, math.nan])
def test_an_impossible_field_of_view_is_refused(vfov_deg):
    with pytest.raises(CameraError, match="vfov_deg: expected an angle"):
        focal_of_field(288, vfov_deg)
