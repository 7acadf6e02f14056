from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from calibration_examples import cameras
from conftest import assert_close

from sphereorient import so3
from sphereorient.calibration.systematic import systematic_errors
from sphereorient.cameras import ParameterCovariance
from sphereorient.cameras.parameters import with_parameters

RADIUS = 9.0
SIGMAS = {"f": 0.02, "centre_u": 0.6, "centre_v": 0.5, "kappa1": 2e-6}
SIGMAS |= {"rotation_x": 4e-4, "rotation_y": 3e-4, "rotation_z": 6e-4, "T_x": 0.1, "T_y": 0.15, "T_z": 0.3}


def covariance(rng, names=("cam1", "cam2")):
    """A covariance with strong correlations, within cameras and between them."""
    labels = tuple(f"{camera}.{name}" for camera in names for name in SIGMAS)
    spread = torch.tensor([*SIGMAS.values()] * len(names), dtype=torch.float64)
    mixed = torch.randn(len(labels), 2 * len(labels), generator=rng, dtype=torch.float64)
    correlation = torch.corrcoef(mixed + 2 * mixed[:1])
    return ParameterCovariance(names=labels, matrix=spread[:, None] * correlation * spread)


def draws(known, count, rng):
    normal = torch.randn(count, len(known.names), generator=rng, dtype=torch.float64)
    return normal @ torch.linalg.cholesky(known.matrix).mT


def wrong_cameras(rig, known, draw):
    """The true cameras: those of the calibration, changed by a draw."""
    made = {}
    for name, camera in rig.items():
        own = [k for k, label in enumerate(known.names) if label.startswith(f"{name}.")]
        made[name] = with_parameters(camera, [known.names[k].rpartition(".")[2] for k in own], draw[own])
    return made


def surface(camera, place):
    """Points on the side of the sphere that a camera sees, spread evenly by a spiral, lab, relative to its centre."""
    k = torch.arange(60, dtype=torch.float64) + 0.5
    depth = 1 - 0.5 * k / 60  # within 60 degrees of the middle
    ring, turn = (1 - depth**2).sqrt(), torch.pi * (1 + 5**0.5) * k
    local = torch.stack([ring * turn.cos(), ring * turn.sin(), -depth], dim=-1)
    return RADIUS * local @ camera.R_cam_lab


def limb(camera, place):
    turn = torch.arange(60, dtype=torch.float64) * (2 * torch.pi / 60)
    # Where a line of sight from the view grazes the sphere: its radius over the distance before the middle's plane.
    apart = (camera.R_cam_lab @ place + camera.T_cam_lab_mm).norm()
    sine = RADIUS / apart
    forward = camera.rays(camera.project(place)).direction_lab
    x = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.3, 0.5, 0.8]).double()), dim=-1)
    ring = turn.cos()[:, None] * x + turn.sin()[:, None] * torch.linalg.cross(forward, x)
    return RADIUS * ((1 - sine**2).sqrt() * ring - sine * forward)


class Ball:
    """Brute force: pictures by the true cameras, the pose fitted with those of the calibration."""

    def __init__(self, rig, place):
        self.rig, self.place = rig, place
        self.paint = {name: surface(camera, place) for name, camera in rig.items()}
        self.rim = {name: limb(camera, place) for name, camera in rig.items()}
        self.middle = {name: camera.project(place) for name, camera in rig.items()}
        self.out = {name: rig[name].project(self.rim[name] + place) - self.middle[name] for name in rig}
        steps = 1e-5 * torch.eye(6, dtype=torch.float64)
        self.slope = torch.stack([(self.shown(rig, h) - self.shown(rig, -h)) / 2e-5 for h in steps], dim=-1)

    def shown(self, some, pose):
        """Pictures of a ball rotated and moved: paint, and the limb's distance from the middle."""
        parts = []
        for name, camera in some.items():
            turned = self.paint[name] @ so3.exp(pose[:3]).mT + self.place + pose[3:]
            edge = camera.project(self.rim[name] + self.place + pose[3:]) - self.middle[name]
            out = torch.nn.functional.normalize(self.out[name], dim=-1)
            parts += [camera.project(turned).reshape(-1), (edge * out).sum(-1)]
        return torch.cat(parts)

    def error(self, truly):
        """The small error (6,) of the pose found with wrong cameras: from it to the truth."""
        pose = torch.zeros(6, dtype=torch.float64)
        seen = self.shown(truly, pose)
        for _ in range(3):
            missed = seen - self.shown(self.rig, pose)
            pose = pose + torch.linalg.lstsq(self.slope, missed[:, None], driver="gels").solution[:, 0]
        return -pose  # R_found = exp(pose) R_true


@pytest.mark.slow
@pytest.mark.parametrize("walls", [False, True], ids=["air", "port"])
def test_covariances_are_those_of_brute_force(walls, rng):
    rig = cameras(walls=walls)
    known = covariance(rng)
    place = torch.tensor([12.0, -20.0, 25.0], dtype=torch.float64)
    ball = Ball(rig, place)
    errors = torch.stack([ball.error(wrong_cameras(rig, known, draw)) for draw in draws(known, 80, rng)])
    computed = systematic_errors(rig, known, place[None], RADIUS)
    for part, block in ((computed[1][0], errors[:, :3]), (computed[0][0], errors[:, 3:])):
        # Whitened by the computed covariance, the errors have unit size in every direction.
        white = torch.linalg.solve_triangular(torch.linalg.cholesky(part), block.mT, upper=False)
        assert torch.allclose(white.square().mean(1).sqrt(), torch.ones(3).double(), atol=0.3)
        assert abs(float(white.square().mean().sqrt()) - 1) < 0.2


def test_a_turn_of_both_cameras_turns_the_ball_and_its_place(rng):
    """By hand: two cameras rotated together by a small angle about lab x, and about the lab's origin."""
    rig = cameras(turned_deg=0.0)
    axis = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    names, columns = [], []
    for name, camera in rig.items():
        in_camera = camera.R_cam_lab @ axis
        names += [f"{name}.rotation_{which}" for which in "xyz"]
        # X_cam = R X + T with T as it is: R_new = exp(delta) R is the same as lab points rotated about the origin.
        columns.append(in_camera)
    direction = torch.cat(columns)
    sigma = 1e-3
    known = ParameterCovariance(names=tuple(names), matrix=sigma**2 * torch.outer(direction, direction))
    place = torch.tensor([0.0, 30.0, 0.0], dtype=torch.float64)
    computed = systematic_errors(rig, known, place[None], RADIUS)
    expected_turn, expected_move = torch.zeros(3, 3).double(), torch.zeros(3, 3).double()
    expected_turn[0, 0] = sigma**2
    expected_move[2, 2] = (sigma * 30.0) ** 2  # rotated about x, y = 30 goes along z
    assert_close(computed[1][0], expected_turn, atol=1e-10)
    assert_close(computed[0][0], expected_move, atol=1e-8)


def test_between_the_frames_that_are_computed_a_quadratic_gives_the_same(rng):
    """With many frames some are computed; with as few as here all."""
    rig, known = cameras(), covariance(rng)
    places = 40 * (2 * torch.rand(400, 3, generator=rng, dtype=torch.float64) - 1)
    direct = systematic_errors(rig, known, places[:100], RADIUS)
    quick = [errors[:100] for errors in systematic_errors(rig, known, places, RADIUS)]
    for both in zip(direct, quick, strict=True):
        sigmas = [computed.diagonal(dim1=-2, dim2=-1).sqrt() for computed in both]
        assert float(((sigmas[1] - sigmas[0]).norm(dim=-1) / sigmas[0].norm(dim=-1)).max()) < 0.02


def test_frames_without_motion_have_systematic_errors_as_well(rng):
    """A quadratic through one place only is not determined: it must still give what was computed there."""
    rig, known = cameras(), covariance(rng)
    places = torch.tensor([[5.0, 1.0, -3.0]], dtype=torch.float64).expand(400, 3) + 1e-9 * torch.randn(400, 3).double()
    direct = systematic_errors(rig, known, places[:1], RADIUS)
    quick = systematic_errors(rig, known, places, RADIUS)
    assert_close(quick[0][7] / direct[0][0], torch.ones(3, 3).double(), atol=1e-3)


@pytest.mark.parametrize("kept", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)], ids=["point", "line", "plane"])
def test_positions_at_one_point_or_in_a_plane_have_the_systematic_errors_of_each_alone(kept, rng):
    rig, known = cameras(), covariance(rng)
    places = 10 * (2 * torch.rand(300, 3, generator=rng, dtype=torch.float64) - 1)
    places = places * torch.tensor(kept, dtype=torch.float64) + torch.tensor([1.2345678, 2.3, 3.1])
    alone = systematic_errors(rig, known, places[7:8], RADIUS)
    for one, all_frames in zip(alone, systematic_errors(rig, known, places, RADIUS), strict=True):
        assert_close(all_frames[7] / one[0].diagonal().max(), one[0] / one[0].diagonal().max(), atol=1e-3)


def test_systematic_errors_do_not_depend_on_what_memory_held_before(rng):
    rig, known = cameras(), covariance(rng)
    flat = 10 * torch.rand(300, 3, generator=rng, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.0])
    found = set()
    for k in range(20):
        garbage = (torch.nan, 1e300)[k % 2]
        held = [torch.full((1 + (97 * k + 31 * n) % 4000,), garbage, dtype=torch.float64) for n in range(30)]
        del held
        found.add(systematic_errors(rig, known, flat, RADIUS)[0].numpy().tobytes())
    assert len(found) == 1


def test_a_point_in_the_name_of_a_camera_changes_nothing(rng):
    rig, plain = cameras(), covariance(rng)
    place = torch.tensor([[5.0, 1.0, -3.0]], dtype=torch.float64)
    expected = systematic_errors(rig, plain, place, RADIUS)
    pointed = {f"side.{name[-1]}": camera for name, camera in rig.items()}
    known = replace(plain, names=tuple(name.replace("cam", "side.") for name in plain.names)).of(pointed)
    for one, other in zip(systematic_errors(pointed, known, place, RADIUS), expected, strict=True):
        assert_close(one, other)


def test_frames_without_a_position_have_no_systematic_error(rng):
    rig, known = cameras(), covariance(rng)
    places = torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0], [1.0, 2, 3]], dtype=torch.float64)
    computed = systematic_errors(rig, known, places, RADIUS)
    assert torch.isnan(computed[0][1]).all()
    assert torch.isfinite(computed[0][[0, 2]]).all()
    alone = systematic_errors(rig, known, places[2:], RADIUS)
    assert_close(computed[1][2], alone[1][0])
    empty = systematic_errors(rig, known, places[:0], RADIUS)
    assert empty[0].shape == (0, 3, 3)


def test_exact_cameras_leave_no_systematic_error(rng):
    rig = cameras()
    known = covariance(rng)
    exact = ParameterCovariance(names=known.names, matrix=0 * known.matrix)
    computed = systematic_errors(rig, exact, torch.zeros(1, 3, dtype=torch.float64), RADIUS)
    assert_close(computed[0], torch.zeros(1, 3, 3).double())
