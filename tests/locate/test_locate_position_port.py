"""Behind a flat wall: the ball's position from one outline, whose rays do not begin in one point."""

import pytest
import torch
from conftest import assert_close
from locate_examples import looking_along_y, sightings
from torch import Tensor

from sphereorient.cameras import Camera, Port, PortCamera
from sphereorient.locate import find_positions

RADIUS_MM = 9.0


def behind_wall(n_glass: float, n_fluid: float) -> Camera:
    camera = looking_along_y()
    normal = -camera.R_cam_lab[2]
    return PortCamera(
        camera=camera,
        port=Port(normal=normal, offset_mm=120.0, thickness_mm=12.0, n_glass=n_glass, n_fluid=n_fluid),
    )


def limb_radius_px(camera: Camera, place: Tensor) -> float:
    """Mean distance of the limb from the centre's picture along the picture's axes, by bisection on the rays."""
    centre_px = camera.project(place)
    radii = []
    for step in torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64):
        low, high = 0.0, 200.0
        for _ in range(60):
            middle = (low + high) / 2
            ray = camera.rays(centre_px + middle * step)
            away = torch.linalg.cross(place - ray.origin_lab_mm, ray.direction_lab).norm()
            low, high = (middle, high) if away < RADIUS_MM else (low, middle)
        radii.append(low)
    return sum(radii) / 4


@pytest.mark.parametrize(("n_glass", "n_fluid"), [(1.49, 1.36), (1.0, 1.0)])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (25.0, -40.0, 10.0), (-30.0, 50.0, -35.0)])
def test_the_distance_from_the_size_is_right(n_glass, n_fluid, place):
    camera = behind_wall(n_glass, n_fluid)
    truth = torch.tensor(place, dtype=torch.float64)
    seen = sightings(camera.project(truth)[None], limb_radius_px(camera, truth))
    found = find_positions({"cam1": seen}, {"cam1": camera}, 2 * RADIUS_MM)
    # The limb of a perspective picture is no circle about the centre's picture: a thousandth of the distance.
    assert_close(found.position_lab_mm[0], truth, atol=0.6)
