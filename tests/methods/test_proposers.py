"""The bank of a search shows the view of the nearest camera."""

import pytest
import torch

from sphereorient.cameras import PinholeCamera
from sphereorient.methods.proposers import as_near
from sphereorient.search.settings import GreySearchSettings


def camera(f_px: float) -> PinholeCamera:
    return PinholeCamera(
        image_size=(240, 240),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
        T_cam_lab_mm=torch.zeros(3, dtype=torch.float64),
        f_px=torch.tensor(f_px, dtype=torch.float64),
        centre_px=torch.tensor([119.5, 119.5], dtype=torch.float64),
    )


def test_the_nearest_camera_gives_the_distance_of_the_view():
    near, far = camera(184.8), camera(4000.0)  # a rim of 69 px at a focal length of 184.8: 2.86 radii away
    assert as_near(GreySearchSettings(), [(far, 60.0), (near, 138.0)]).distance_radii == pytest.approx(2.86, abs=0.05)
    assert as_near(GreySearchSettings(), [(far, 60.0)]).distance_radii is None


def test_a_given_distance_stays():
    given = GreySearchSettings(distance_radii=5.0)
    assert as_near(given, [(camera(184.8), 138.0)]) is given
