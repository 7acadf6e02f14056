"""Unseen paint has no weight, for any value of the map there."""

import math

import pytest
import torch
from refine_examples import BLUR_PX, balls, cut, fitted, noisy, paint_of, pictures_of, rig_of, turn_errors, turned

from sphereorient import so3
from sphereorient.sphere.texture import map_directions
from sphereorient.sphere.texture_table import texture_table

DIAMETER_PX, SIGMA = 48.0, 4.0
RIG = rig_of(DIAMETER_PX)
X, R = balls(6, 1)
PAINT = paint_of("patches")
HIDDEN = map_directions(len(PAINT))[..., 2] > 0.4  # three tenths of the sphere


@pytest.fixture(scope="module")
def pixels():
    return cut(RIG, noisy(pictures_of(RIG, "patches", X, R), SIGMA, 3), X)


def fit(pixels, fill: float, known: bool, start=None):
    texture = PAINT.masked_fill(HIDDEN, fill)
    table = texture_table(texture, 2 * BLUR_PX / DIAMETER_PX, unseen=HIDDEN if known else None)
    return fitted(RIG, "patches", pixels, X, turned(R, 1.0, 5) if start is None else start, SIGMA, paint=table)


@pytest.fixture(scope="module")
def known(pixels):
    """The fit with the mask of unseen paint."""
    return fit(pixels, 0.5, known=True)


def rms_deg(found) -> float:
    return math.degrees(float(turn_errors(found, R).square().sum(-1).mean().sqrt()))


@pytest.mark.slow
def test_values_of_the_map_there_move_nothing(pixels, known):
    white = fit(pixels, 1.0, known=True)
    apart = so3.geodesic_distance(known.R_lab_body, white.R_lab_body)
    assert float(apart.max()) < math.radians(0.03)  # a fiftieth of the fill reaches over the border


def test_the_pose_is_as_good_as_the_known_paint_and_so_is_its_stated_error(pixels, known):
    assert rms_deg(known) < 0.15
    assert rms_deg(fit(pixels, 0.5, known=False)) > 3 * rms_deg(known)
    error = torch.cat([turn_errors(known, R), X - known.position_lab_mm], -1)
    away = (error * torch.linalg.solve(known.covariance, error)).sum(-1)
    assert float(away.mean()) < 12  # 6 expected


def test_a_disk_of_unknown_paint_has_no_score_and_the_other_camera_measures(known):
    unknown = known.score == 0
    assert bool(unknown.any()) == bool((share_known() < 0.3).any())
    assert float(known.score[~unknown].min()) > 0.9


def share_known() -> torch.Tensor:
    """Share of the hemisphere towards each camera that is known, (B, C)."""
    direction = map_directions(len(PAINT)).reshape(-1, 3)
    area = (1 - direction[:, 2] ** 2).sqrt()
    rows = []
    for camera in RIG.cameras:
        towards = torch.nn.functional.normalize(-(camera.R_cam_lab.mT @ camera.T_cam_lab_mm) - X, dim=-1)
        seen = ((R.mT @ towards[..., None])[..., 0] @ direction.T).clamp_min(0) * area
        rows.append((seen * ~HIDDEN.reshape(-1)).sum(-1) / seen.sum(-1))
    return torch.stack(rows, -1)


@pytest.mark.slow
def test_a_wrong_pose_does_not_hide_behind_unknown_paint(pixels, known):
    """A pose with unknown paint towards the cameras is less likely than one that explains the pictures."""
    for sign in (1, -1):  # body z along lab -y, to the first camera, and away from it
        north = R[:1].new_tensor([[1.0, 0, 0], [0, 0, -sign], [0, sign, 0]])
        wrong = fit(pixels, 0.5, known=True, start=north.expand(len(R), 3, 3))
        astray = so3.geodesic_distance(wrong.R_lab_body, R) > 0.2
        assert int(astray.sum()) >= 5
        assert bool((wrong.nll > known.nll)[astray].all())
