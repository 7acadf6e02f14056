import math

import pytest
import torch
from locate_examples import looking_along_y, looking_down, sightings

from sphereorient.cameras import load_cameras
from sphereorient.errors import ExperimentError, SettingsError
from sphereorient.locate import check_seen, expected_diameter_px, size_of

FOCAL_PX = 78.0 * 520 / 18


def limb_diameter_px(distance_mm: float, diameter_mm: float = 18.0) -> float:
    """The exact picture of a sphere on the axis: the cone that touches it has the half angle asin(r / d)."""
    return 2 * FOCAL_PX * math.tan(math.asin(diameter_mm / 2 / distance_mm))


@pytest.mark.parametrize("diameter_mm", [5.0, 18.0, 60.0])
def test_the_size_is_that_of_the_exact_projection(diameter_mm):
    got = expected_diameter_px("cam1", {"cam1": looking_along_y()}, diameter_mm)
    assert got == pytest.approx(limb_diameter_px(520, diameter_mm), rel=2e-3)


def test_two_cameras_expect_it_where_their_axes_meet():
    """The origin may be anywhere: here the cameras look at (0, 200, 30), 720 and 490 mm away."""
    cameras = {
        "cam1": looking_along_y(T_cam_lab_mm=torch.tensor([0.0, 30.0, 520.0], dtype=torch.float64)),
        "cam2": looking_down(T_cam_lab_mm=torch.tensor([0.0, 200.0, 520.0], dtype=torch.float64)),
    }
    assert expected_diameter_px("cam1", cameras, 18.0) == pytest.approx(limb_diameter_px(720), rel=1e-3)
    assert expected_diameter_px("cam2", cameras, 18.0) == pytest.approx(limb_diameter_px(490), rel=1e-3)
    alone = expected_diameter_px("cam1", {"cam1": cameras["cam1"]}, 18.0)
    assert abs(alone / limb_diameter_px(720) - 1) > 0.3


def test_the_cameras_of_the_excerpt_expect_the_papers_size(request):
    cameras = load_cameras(request.config.rootpath / "synthetic_data" / "excerpt" / "cameras.yaml")
    for name in cameras:
        assert 70 < expected_diameter_px(name, cameras, 18.0) < 90


def test_an_unknown_diameter_is_refused():
    with pytest.raises(SettingsError, match=r"sphere\.diameter.*null.*locate\.diameter_px"):
        expected_diameter_px("cam1", {"cam1": looking_along_y()}, None)


@pytest.mark.parametrize("depth", [0.0, -100.0])
def test_a_camera_that_does_not_see_the_origin_is_refused(depth):
    camera = looking_along_y(T_cam_lab_mm=torch.tensor([0.0, 0.0, depth], dtype=torch.float64))
    with pytest.raises(SettingsError, match=r"camera cam1.*out of its sight.*locate\.diameter_px"):
        expected_diameter_px("cam1", {"cam1": camera}, 18.0)


@pytest.mark.parametrize("diameter_mm", [0.5, 200.0])
def test_a_sphere_that_does_not_fit_the_picture_is_refused(diameter_mm):
    with pytest.raises(SettingsError, match="fits the picture"):
        expected_diameter_px("cam1", {"cam1": looking_along_y()}, diameter_mm)


def test_two_parallel_cameras_are_refused():
    cameras = {"cam1": looking_along_y(), "cam2": looking_along_y()}
    with pytest.raises(SettingsError, match=r"camera cam1.*R and T"):
        expected_diameter_px("cam1", cameras, 18.0)


LOST = torch.full((3, 2), torch.nan, dtype=torch.float64)
SEEN = torch.tensor([[10.0, 20.0], [11.0, 20.0], [torch.nan, torch.nan]], dtype=torch.float64)


def test_movies_without_any_ball_are_refused_with_the_frames_reasons():
    with pytest.raises(ExperimentError, match="not_found"):
        check_seen({"cam1": sightings(LOST), "cam2": sightings(LOST)})


def test_one_camera_with_a_ball_is_enough():
    check_seen({"cam1": sightings(LOST), "cam2": sightings(SEEN)})


@pytest.mark.parametrize(("radius_px", "expected"), [(39.0, 78), (38.6, 77), (38.8, 78), (5.0, 16)])
def test_the_size_of_the_disks_pictures_is_the_median_diameter(radius_px, expected):
    assert size_of(sightings(SEEN, radius_px), None) == expected


def test_the_size_of_the_disks_pictures_can_be_set():
    assert size_of(sightings(SEEN), 64) == 64
