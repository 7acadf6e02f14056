"""Gradients from a track error and from a picture, through renderer, fit and soft path, to a camera and a texel."""

from __future__ import annotations

import re
from dataclasses import dataclass

import pytest
import torch
from conftest import REPO, assert_close
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import SoftTrack, soft_track
from sphereorient.assemble.layer import turning_costs
from sphereorient.cameras import PinholeCamera, Rays
from sphereorient.cameras.parameters import with_parameters
from sphereorient.errors import SettingsError, ShapeError
from sphereorient.pose.implicit import implicit_pose
from sphereorient.sphere.renderer import PaintedBall, expected_grey

FRAMES, SIDE, NOISE = 4, 19, 3.0
EMPTY = 2  # a frame without a picture
NAMES = ("rotation_y", "f_px")  # of the second camera
LOOKS = ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # along lab +y, along lab -x
TEXEL = (5, 9)


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def ball(texture: Tensor) -> PaintedBall:
    return PaintedBall(
        texture=texture,
        radius_mm=9.0,
        edge_mm=0.6,
        ambient=f64(0.5),
        lamps_lab=f64([[-0.4, -0.5, 0.3], [0.3, -0.2, 0.2]]),
        black=f64(20.0),
        white=f64(170.0),
        behind=f64(15.0),
    )


@dataclass(frozen=True)
class Scene:
    cameras: tuple[PinholeCamera, PinholeCamera]
    uv_px: Tensor  # (P, 2)
    texture: Tensor
    grey: Tensor  # (N, 2, P)
    R_lab_body: Tensor  # (N, 3, 3)
    position_lab_mm: Tensor  # (N, 3)

    def sight(self, change: Tensor) -> Rays:
        given = (self.cameras[0], with_parameters(self.cameras[1], NAMES, change))
        both = [camera.rays(self.uv_px) for camera in given]
        origin, direction = ([getattr(rays, part) for rays in both] for part in ("origin_lab_mm", "direction_lab"))
        return Rays(origin_lab_mm=torch.stack(origin), direction_lab=torch.stack(direction))


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = torch.Generator().manual_seed(3)
    cameras = tuple(
        PinholeCamera(
            image_size=(SIDE, SIDE),
            R_cam_lab=f64(look),
            T_cam_lab_mm=f64([0, 0, 300.0]),
            centre_px=f64([0.5 * (SIDE - 1)] * 2),
            f_px=f64(SIDE * 13.0),
        )
        for look in LOOKS
    )
    v, u = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    uv_px = torch.stack([u, v], dim=-1).reshape(-1, 2).double()
    texture = torch.rand(8, 16, generator=rng, dtype=torch.float64)
    R = so3.exp(torch.arange(FRAMES)[:, None] * f64([0.05, -0.04, 0.12])) @ so3.exp(f64([0.4, -0.8, 0.5]))
    X = torch.randn(FRAMES, 3, generator=rng, dtype=torch.float64)
    made = Scene((cameras[0], cameras[1]), uv_px, texture, torch.empty(0), R, X)
    grey = expected_grey(made.sight(f64([0.0, 0.0])), X[:, None], R[:, None], ball(texture))
    grey = grey + NOISE * torch.randn(grey.shape, generator=rng, dtype=torch.float64)
    grey[EMPTY] = torch.nan
    return Scene(made.cameras, uv_px, texture, grey, R, X)


def chain(scene: Scene, theta: Tensor, iterations: int = 20) -> tuple[SoftTrack, Tensor]:
    """Track and expected pictures' misfit, of the second camera's changes theta[:2] and one texel's change theta[2].

    Three candidates a frame: each camera's own fit, and one that starts from a wrong pose.
    """
    texture = scene.texture.index_put((torch.tensor(TEXEL[0]), torch.tensor(TEXEL[1])), theta[2], accumulate=True)
    sight, painted = scene.sight(theta[:2]), ball(texture)
    there = torch.arange(FRAMES) != EMPTY
    grey = torch.where(there[:, None, None], scene.grey, 0.0)
    own = torch.tensor([0, 1, 1])
    rays = Rays(origin_lab_mm=sight.origin_lab_mm[own], direction_lab=sight.direction_lab[own])

    def residual(R: Tensor, X: Tensor) -> Tensor:
        R, X = R.unflatten(0, (FRAMES, 3)), X.unflatten(0, (FRAMES, 3))
        picture = (expected_grey(rays, X, R, painted) - grey[:, own]) / NOISE
        return torch.cat([picture, (X - scene.position_lab_mm[:, None]) / 0.1], dim=-1).flatten(0, 1)

    off = so3.exp(f64([[0.02, -0.01, 0.02], [-0.01, 0.02, 0.01], [0.25, -0.3, 0.5]]))
    start = (off @ scene.R_lab_body[:, None]).flatten(0, 1)
    place = scene.position_lab_mm.repeat_interleave(3, 0)
    place[3 * EMPTY] = torch.nan  # an empty frame has no position
    use = there.repeat_interleave(3)
    fit = implicit_pose(residual, start, place, use=use, iterations=iterations)
    track = soft_track(
        fit.R_lab_body.unflatten(0, (FRAMES, 3)),
        fit.position_lab_mm.unflatten(0, (FRAMES, 3)),
        (fit.cost / SIDE**2).unflatten(0, (FRAMES, 3)),
        fit.arrived.unflatten(0, (FRAMES, 3)),
        turn_rad=0.2,
        temperature=0.5,
    )
    shown = expected_grey(sight, track.position_lab_mm[there][:, None], track.R_lab_body[there][:, None], painted)
    return track, (shown - grey[there]) / NOISE


def errors(scene: Scene, theta: Tensor, iterations: int = 20) -> Tensor:
    """The track's squared distance from the truth, and the pictures' mean squared residual, (2,)."""
    track, picture = chain(scene, theta, iterations)
    there = track.marginals.sum(-1) > 0
    apart = so3.geodesic_distance(track.R_lab_body[there], scene.R_lab_body[there])
    return torch.stack([apart.square().sum(), picture.square().mean()])


def gradients(scene: Scene, iterations: int = 20) -> tuple[Tensor, Tensor]:
    """Return both errors (2,) and their gradients (2, 3)."""
    theta = f64(THETA).requires_grad_()
    both = errors(scene, theta, iterations)
    rows = [torch.autograd.grad(error, theta, retain_graph=True)[0] for error in both]
    return both.detach(), torch.stack(rows)


THETA = (0.01, 2.0, 0.2)  # rad, px, paint: given wrong, so that residuals are left
STEPS = (1e-5, 1e-2, 1e-4)  # of the differences; the third order they leave out is below 1e-6


@pytest.mark.slow
def test_gradients_to_camera_and_texel_are_those_of_the_whole_chain_run_again(scene):
    _, got = gradients(scene)
    for k, step in enumerate(STEPS):
        change = step * torch.eye(3, dtype=torch.float64)[k]
        with torch.no_grad():
            slope = (errors(scene, f64(THETA) + change) - errors(scene, f64(THETA) - change)) / (2 * step)
        assert_close(got[:, k] / slope, torch.ones(2, dtype=torch.float64), 1e-4)


@pytest.mark.slow
def test_the_chain_is_what_it_should_be(scene):
    with torch.no_grad():
        track, picture = chain(scene, f64([0.0, 0.0, 0.0]))
    there = torch.arange(FRAMES) != EMPTY
    # Only noise is left; each camera's candidate has its share, and the false one has none.
    assert 0.9 < picture.square().mean().sqrt() < 1.1
    assert so3.geodesic_distance(track.R_lab_body, scene.R_lab_body)[there].max() < 0.02
    assert (track.marginals[there][:, :2] > 0.1).all()
    assert track.marginals[there][:, 2].max() < 0.5
    assert_close(track.marginals.sum(-1), there.double())


@pytest.mark.slow
def test_more_iterations_change_neither_value_nor_gradient(scene):
    for one, other in zip(gradients(scene, 30), gradients(scene, 60), strict=True):
        assert_close(one / other, torch.ones_like(one), 1e-6)


@pytest.mark.slow
def test_an_empty_frame_is_nan_and_spoils_no_gradient(scene):
    theta = f64(THETA).requires_grad_()
    track, picture = chain(scene, theta)
    assert track.R_lab_body[EMPTY].isnan().all()
    assert track.position_lab_mm[EMPTY].isnan().all()
    everything = track.free_energy + track.marginals.square().sum() + picture.square().mean()
    assert torch.autograd.grad(everything, theta)[0].isfinite().all()


# --- the soft track by itself


def candidates(rng: torch.Generator, *shape: int) -> tuple[Tensor, Tensor, Tensor]:
    R = so3.random_rotations(shape, generator=rng).double()
    return R, torch.randn(*shape, 3, generator=rng, dtype=torch.float64), torch.rand(shape, generator=rng).double()


def test_turns_over_a_gap_are_those_from_the_last_frame_seen(rng):
    R, _, _ = candidates(rng, 5, 2)
    mask = torch.tensor([[False, False], [True, True], [False, False], [False, False], [True, False]])
    cost = turning_costs(R, mask, 0.5)
    assert cost.shape == (4, 2, 2)
    apart = so3.geodesic_distance(R[1, 1], R[4, 0])
    assert_close(cost[3, 1, 0], 0.5 * (apart / 1.5) ** 2)  # three frames on


def test_a_cold_track_is_the_best_candidates_and_a_hot_one_their_mean(rng):
    R, X, misfit = candidates(rng, 4, 3)
    mask = torch.ones(4, 3, dtype=torch.bool)
    cold = soft_track(R, X, 100 * misfit, mask, turn_rad=1e3, temperature=1e-3)
    best = misfit.argmin(-1)
    assert_close(cold.R_lab_body, R[torch.arange(4), best], 1e-9)
    hot = soft_track(R, X, misfit, mask, turn_rad=1e3, temperature=1e9)
    assert_close(hot.position_lab_mm, X.mean(1), 1e-6)
    assert_close(hot.R_lab_body, so3.nearest_rotation(R.mean(1)), 1e-5)


def test_a_batch_of_movies_is_the_stack_of_single_ones_and_what_is_masked_does_not_matter(rng):
    R, X, misfit = candidates(rng, 3, 4, 2)
    mask = torch.rand(3, 4, 2, generator=rng) < 0.7
    whole = soft_track(R, X, misfit, mask, turn_rad=0.5)
    lost = [torch.where(mask[(..., *[None] * (part.ndim - 3))], part, torch.nan) for part in (R, X, misfit)]
    for k in range(3):
        one = soft_track(lost[0][k], lost[1][k], lost[2][k], mask[k], turn_rad=0.5)
        assert_close(one.R_lab_body, whole.R_lab_body[k])
        assert_close(one.position_lab_mm, whole.position_lab_mm[k])
        assert_close(one.free_energy, whole.free_energy[k])


def test_gradcheck_of_the_soft_track(rng):
    delta = 0.3 * torch.randn(3, 2, 3, generator=rng, dtype=torch.float64)
    mask = torch.tensor([[True, True], [True, False], [True, True]])

    def track(delta: Tensor, misfit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = soft_track(so3.exp(delta), delta, misfit, mask, turn_rad=0.5)
        return found.R_lab_body, found.position_lab_mm, found.free_energy

    inputs = (delta.requires_grad_(), torch.rand(3, 2, generator=rng, dtype=torch.float64).requires_grad_())
    assert torch.autograd.gradcheck(track, inputs)


def test_inconsistent_arguments_are_refused(rng):
    R, X, misfit = candidates(rng, 4, 3)
    mask = torch.ones(4, 3, dtype=torch.bool)
    with pytest.raises(ShapeError, match="misfit"):
        soft_track(R, X, misfit[:2], mask, turn_rad=1.0)
    with pytest.raises(SettingsError, match="turn_rad"):
        soft_track(R, X, misfit, mask, turn_rad=0.0)


# --- the example and its page


def test_the_code_of_the_page_is_the_scripts():
    script = (REPO / "scripts" / "example_differentiable.py").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", (REPO / "docs" / "differentiable.md").read_text(), re.M | re.S)
    assert len(blocks) >= 3
    for block in blocks:
        assert block in script, block


@pytest.mark.slow  # two minutes of descent
def test_a_camera_angle_and_a_paint_error_are_recovered_from_a_movie():
    from example_differentiable import recover

    first, *_, last = recover(30).seen
    loss, angle_deg, texels, track_deg = range(4)
    assert first[angle_deg] == pytest.approx(0.3, abs=0.01)
    assert last[angle_deg] < 0.4 * first[angle_deg]
    assert last[texels] < 0.1 * first[texels]
    assert last[track_deg] < 0.3 * first[track_deg]
    assert last[loss] < 0.1 * first[loss]
