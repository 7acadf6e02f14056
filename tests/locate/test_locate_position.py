"""From outlines to the lab: exact centres give exact positions, and the covariance is that of the noise."""

from dataclasses import replace

import pytest
import torch
from conftest import assert_close
from locate_examples import looking_along_y, looking_down, sightings
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.cameras.model import TelecentricCamera
from sphereorient.errors import ExperimentError
from sphereorient.locate import find_positions
from sphereorient.trajectory import Flag

DIAMETER_MM = 18.0
PLACES = torch.tensor(
    [[0.0, 0.0, 0.0], [31.0, -22.0, 14.0], [-40.0, 8.0, -35.0], [5.0, 45.0, 20.0]], dtype=torch.float64
)


def oblique() -> Camera:
    """A camera 50 degrees from `looking_along_y`, so that the two rays do not cross at a right angle."""
    turn = torch.from_numpy(Rotation.from_euler("z", 50, degrees=True).as_matrix())
    return looking_along_y(R_cam_lab=looking_along_y().R_cam_lab @ turn)


def tilted() -> Camera:
    """A camera in a general place."""
    turn = torch.from_numpy(Rotation.from_rotvec([0.2, -0.1, 0.25]).as_matrix())
    T = torch.tensor([4.0, -3.0, 540.0], dtype=torch.float64)
    return looking_down(R_cam_lab=turn @ looking_down().R_cam_lab, T_cam_lab_mm=T)


def exact_radius_px(camera: Camera, place: Tensor) -> Tensor:
    """Mean distance of the limb's picture from the centre's picture, along the picture's axes, (N,)."""
    centre = -(camera.R_cam_lab.mT @ camera.T_cam_lab_mm)
    away = place - centre
    distance = away.norm(dim=-1, keepdim=True)
    sine = DIAMETER_MM / 2 / distance
    middle = camera.project(place)
    limb = []
    for axis in (0, 1):
        across = camera.R_cam_lab[axis].expand_as(away)
        across = across - (across * away).sum(-1, keepdim=True) * away / distance**2
        across = across / across.norm(dim=-1, keepdim=True)
        cosine = (1 - sine**2).sqrt()
        limb += [
            camera.project(centre + cosine * (away / distance * cosine + sign * sine * across) * distance)
            for sign in (-1, 1)
        ]
    return torch.stack([(point - middle).norm(dim=-1) for point in limb]).mean(0)


def lost(count: int) -> Tensor:
    return torch.full((count, 2), torch.nan, dtype=torch.float64)


@pytest.mark.parametrize("second", [looking_down, oblique, tilted])
def test_exact_centres_of_two_cameras_give_the_exact_place(second):
    cameras = {"cam1": looking_along_y(), "cam2": second()}
    seen = {name: sightings(camera.project(PLACES)) for name, camera in cameras.items()}
    found = find_positions(seen, cameras, DIAMETER_MM)
    assert_close(found.position_lab_mm, PLACES, atol=1e-6)
    assert_close(found.gap_mm, torch.zeros(4, dtype=torch.float64), atol=1e-6)
    assert (found.flags == 0).all()
    assert found.measured.all()


def test_the_radius_takes_no_part_where_two_cameras_see():
    cameras = {"cam1": looking_along_y(), "cam2": looking_down()}
    seen = {name: sightings(camera.project(PLACES), radius_px=60.0) for name, camera in cameras.items()}
    assert_close(find_positions(seen, cameras, DIAMETER_MM).position_lab_mm, PLACES, atol=1e-6)


@pytest.mark.parametrize("camera", [looking_along_y(), tilted()])
def test_one_camera_gives_the_distance_from_the_size(camera):
    seen = {"cam1": sightings(camera.project(PLACES), exact_radius_px(camera, PLACES))}
    found = find_positions(seen, {"cam1": camera}, DIAMETER_MM)
    centre = -(camera.R_cam_lab.mT @ camera.T_cam_lab_mm)
    true, got = (PLACES - centre).norm(dim=1), (found.position_lab_mm - centre).norm(dim=1)
    assert ((got / true - 1).abs() < 0.005).all()
    assert_close(camera.project(found.position_lab_mm), camera.project(PLACES), atol=1e-6)  # on the ray exactly
    assert (found.flags == int(Flag.ONE_CAMERA)).all()
    assert found.measured.all()
    assert found.gap_mm.isnan().all()


def parallel() -> Camera:
    """A telecentric camera that looks down."""
    pose = {"R_cam_lab": looking_down().R_cam_lab, "T_cam_lab_mm": looking_down().T_cam_lab_mm}
    scale, middle = torch.tensor(0.23, dtype=torch.float64), looking_down().centre_px
    return TelecentricCamera(image_size=looking_down().image_size, scale_mm_px=scale, centre_px=middle, **pose)


def test_a_telecentric_camera_gives_a_position_beside_another_one_and_none_by_itself():
    cameras = {"cam1": looking_along_y(), "cam2": parallel()}
    of_size = exact_radius_px(cameras["cam1"], PLACES), DIAMETER_MM / 2 / 0.23
    seen = {
        name: sightings(camera.project(PLACES), radius)
        for (name, camera), radius in zip(cameras.items(), of_size, strict=True)
    }
    found = find_positions(seen, cameras, DIAMETER_MM)
    assert_close(found.position_lab_mm, PLACES, atol=1e-6)
    assert torch.isfinite(found.covariance_mm2).all()
    other = find_positions({**seen, "cam2": sightings(lost(4))}, cameras, DIAMETER_MM)
    alone = find_positions({"cam1": seen["cam1"]}, {"cam1": cameras["cam1"]}, DIAMETER_MM)
    assert_close(other.position_lab_mm, alone.position_lab_mm)
    none = find_positions({**seen, "cam1": sightings(lost(4))}, cameras, DIAMETER_MM)
    assert none.position_lab_mm.isnan().all()
    assert not none.measured.any()


def test_a_sphere_on_the_axis_is_as_far_as_its_limb_gives():
    """By hand: 9 mm at a half angle of asin(9/520), seen with f = 2253.33 px: 39.0058 px, not f 9/520 = 39."""
    camera = looking_along_y()
    seen = {"cam1": sightings(torch.tensor([[324.5, 324.5]]), radius_px=39.005843)}
    assert_close(find_positions(seen, {"cam1": camera}, DIAMETER_MM).position_lab_mm, torch.zeros(1, 3).double(), 1e-4)
    seen = {"cam1": sightings(torch.tensor([[324.5, 324.5]]), radius_px=39.0)}
    assert abs(find_positions(seen, {"cam1": camera}, DIAMETER_MM).position_lab_mm[0, 1] - 0.078) < 0.002


def test_without_a_diameter_lengths_are_in_radii():
    camera = looking_along_y()
    seen = {"cam1": sightings(camera.project(PLACES), exact_radius_px(camera, PLACES))}
    mm = find_positions(seen, {"cam1": camera}, DIAMETER_MM)
    radii = find_positions(seen, {"cam1": camera}, None)
    centre = -(camera.R_cam_lab.mT @ camera.T_cam_lab_mm)
    assert_close((radii.position_lab_mm - centre) * 9.0, mm.position_lab_mm - centre, atol=1e-9)
    assert_close(radii.covariance_mm2 * 81.0, mm.covariance_mm2, atol=1e-9)


def test_two_cameras_without_a_diameter_are_refused():
    """Frames of one camera would be in radii and those of two in mm."""
    cameras = {"cam1": looking_along_y(), "cam2": looking_down()}
    seen = {name: sightings(camera.project(PLACES)) for name, camera in cameras.items()}
    with pytest.raises(ExperimentError, match=r"sphere\.diameter"):
        find_positions(seen, cameras, None)


@pytest.mark.parametrize("blind", ["cam1", "cam2"])
def test_where_one_of_two_cameras_is_blind_the_other_stands_in(blind):
    cameras = {"cam1": looking_along_y(), "cam2": looking_down()}
    seen = {
        name: sightings(camera.project(PLACES), exact_radius_px(camera, PLACES)) for name, camera in cameras.items()
    }
    hidden = seen[blind].centre_px.clone()
    hidden[1:3] = torch.nan
    seen[blind] = sightings(hidden, exact_radius_px(cameras[blind], PLACES))
    found = find_positions(seen, cameras, DIAMETER_MM)
    one = int(Flag.ONE_CAMERA)
    assert found.flags.tolist() == [0, one, one, 0]
    assert found.measured.all()
    assert_close(found.position_lab_mm[[0, 3]], PLACES[[0, 3]], atol=1e-6)
    assert (found.position_lab_mm - PLACES).norm(dim=1).max() < 3
    assert found.gap_mm.isnan().tolist() == [False, True, True, False]
    depth = found.covariance_mm2.diagonal(dim1=1, dim2=2).amax(1)
    assert (depth[1:3] > 20 * depth[[0, 3]]).all()  # far less sure along the ray


@pytest.mark.parametrize("count", [0, 3])
def test_where_no_camera_sees_there_is_nothing(count):
    cameras = {"cam1": looking_along_y(), "cam2": looking_down()}
    found = find_positions({name: sightings(lost(count)) for name in cameras}, cameras, DIAMETER_MM)
    assert found.position_lab_mm.shape == (count, 3)
    assert found.position_lab_mm.isnan().all()
    assert found.covariance_mm2.isnan().all()
    assert not found.measured.any()
    assert (found.flags == 0).all()


@pytest.mark.parametrize("flag", [Flag.POSITION_INTERPOLATED, Flag.POSITION_OUTLIER_REPLACED])
def test_a_frame_that_one_camera_did_not_measure_has_a_position_but_is_not_measured(flag):
    cameras = {"cam1": looking_along_y(), "cam2": looking_down()}
    rms = torch.tensor([0.2, torch.nan, 0.2, 0.2], dtype=torch.float64)
    flags = torch.tensor([0, int(flag), 0, 0])
    seen = {
        "cam1": sightings(cameras["cam1"].project(PLACES), rms_px=rms, flags=flags),
        "cam2": sightings(cameras["cam2"].project(PLACES)),
    }
    found = find_positions(seen, cameras, DIAMETER_MM)
    assert_close(found.position_lab_mm, PLACES, atol=1e-6)
    assert found.measured.tolist() == [True, False, True, True]
    assert found.flags.tolist() == flags.tolist()
    assert found.covariance_mm2.isnan().all(-1).all(-1).tolist() == [False, True, False, False]


@pytest.mark.parametrize("sigma_px", [0.1, 0.4])
@pytest.mark.parametrize("second", [looking_down, oblique])
def test_the_covariance_of_two_cameras_is_that_of_many_noisy_trials(second, sigma_px, rng):
    cameras = {"cam1": looking_along_y(), "cam2": second()}
    place = PLACES[1].expand(2000, 3)
    seen = {
        name: sightings(noisy(camera.project(place), sigma_px, rng), exact_radius_px(camera, place), sigma_px)
        for name, camera in cameras.items()
    }
    found = find_positions(seen, cameras, DIAMETER_MM)
    agree(found.position_lab_mm, found.covariance_mm2.mean(0))


@pytest.mark.parametrize("camera", [looking_along_y(), tilted()])
def test_the_covariance_of_one_camera_is_that_of_many_noisy_trials(camera, rng):
    sigma_px = 0.2
    place = PLACES[1].expand(2000, 3)
    radius = exact_radius_px(camera, place)
    noise = sigma_px * torch.randn(2000, dtype=torch.float64, generator=rng)
    seen = {"cam1": sightings(noisy(camera.project(place), sigma_px, rng), radius + noise, sigma_px)}
    found = find_positions(seen, {"cam1": camera}, DIAMETER_MM)
    agree(found.position_lab_mm, found.covariance_mm2.mean(0))


@pytest.mark.parametrize("camera", [looking_along_y(), tilted()])
def test_a_radius_that_is_wrong_with_its_centre_moves_the_position_as_the_covariance_states(camera, rng):
    """Of half a rim the errors of centre and radius correlate."""
    covariance = 0.04 * torch.tensor([[10.5, 0.0, -6.7], [0.0, 2.0, 0.0], [-6.7, 0.0, 5.3]], dtype=torch.float64)
    place = PLACES[1].expand(2000, 3)
    error = torch.randn(2000, 3, dtype=torch.float64, generator=rng) @ torch.linalg.cholesky(covariance).mT
    seen = sightings(camera.project(place) + error[:, :2], exact_radius_px(camera, place) + error[:, 2])
    seen = replace(seen, covariance_px2=covariance.expand(2000, 3, 3))
    found = find_positions({"cam1": seen}, {"cam1": camera}, DIAMETER_MM)
    agree(found.position_lab_mm, found.covariance_mm2.mean(0))


def test_the_more_certain_of_two_cameras_counts_more():
    """By hand: both see lab x, 9 mm on 39 px; with sigmas of 0.1 and 0.3 px the weights are 9 to 1."""
    cameras = {"cam1": looking_along_y(), "cam2": looking_down()}
    middle = torch.tensor([[324.5, 324.5]], dtype=torch.float64)
    off = middle + torch.tensor([10.0, 0.0])
    seen = {"cam1": sightings(middle, 39.0, 0.1), "cam2": sightings(off, 39.0, 0.3)}
    found = find_positions(seen, cameras, DIAMETER_MM)
    expected = torch.tensor([[10 * 9 / 39 / 10, 0.0, 0.0]], dtype=torch.float64)
    assert_close(found.position_lab_mm, expected, atol=0.005)


def noisy(centre_px: Tensor, sigma_px: float, rng: torch.Generator) -> Tensor:
    return centre_px + sigma_px * torch.randn(centre_px.shape, dtype=torch.float64, generator=rng)


def agree(places: Tensor, covariance: Tensor) -> None:
    """Compare in every direction: whitened by the claimed covariance, the real one is the unit matrix."""
    whiten = torch.linalg.inv(torch.linalg.cholesky(covariance))
    real = whiten @ torch.cov(places.T) @ whiten.mT
    variances = torch.linalg.eigvalsh(real)
    assert (variances > 0.8).all(), variances
    assert (variances < 1.2).all(), variances


def test_three_cameras_place_the_sphere_with_those_that_see_it():
    cameras = {"cam1": looking_along_y(), "cam2": looking_down(), "cam3": oblique()}
    seen = {}
    for k, (name, camera) in enumerate(cameras.items()):
        centre = camera.project(PLACES)
        centre[: k + 1] = torch.nan  # 0 of none, 1 of the first alone, 2 of two, 3 of all
        centre[0] = torch.nan
        seen[name] = sightings(centre, exact_radius_px(camera, PLACES))
    seen["cam1"] = sightings(
        torch.where(PLACES[:, :1] == PLACES[0, 0], torch.nan, cameras["cam1"].project(PLACES)),
        exact_radius_px(cameras["cam1"], PLACES),
    )
    found = find_positions(seen, cameras, DIAMETER_MM)
    assert found.position_lab_mm[0].isnan().all()
    assert (found.position_lab_mm[1] - PLACES[1]).norm() < 3
    assert_close(found.position_lab_mm[2:], PLACES[2:], atol=1e-6)
    assert found.flags.tolist() == [0, int(Flag.ONE_CAMERA), 0, 0]
    assert found.covariance_mm2[3].trace() < found.covariance_mm2[2].trace() < found.covariance_mm2[1].trace()
