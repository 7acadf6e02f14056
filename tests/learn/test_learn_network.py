"""The network: blurs of a map against sums and known laws, features rotate with the ball, pictures of any scale."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from conftest import assert_close
from learn_examples import tiny, untrained
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient import so3
from sphereorient.learn.metrics import cross_entropy, predict
from sphereorient.learn.network import SCALES, Correlator, find_modes, first_right, map_blurs
from sphereorient.learn.pictures import TrainingBatch
from sphereorient.sphere.texture import map_directions, random_texture
from sphereorient.sphere.texture_table import octahedral_directions

SIDE = 32
DIRECTION = octahedral_directions(SIDE)


def smooth_map(R_body_ball: np.ndarray, height: int = 256) -> Tensor:
    """A ball of a few broad lobes with rotated paint."""
    d = map_directions(height).double().numpy() @ R_body_ball  # what was at d before, R^T d as a row
    value = (
        np.exp(4 * (d @ [0.6, 0.0, 0.8] - 1))
        - 0.7 * np.exp(6 * (d @ [0.0, -0.8, 0.6] - 1))
        + 0.3 * d[..., 0] * d[..., 1]
    )
    return torch.from_numpy(0.5 + 0.4 * value).float()


@pytest.mark.parametrize("degree", [1, 2])
def test_a_spherical_harmonic_decays_as_the_kernel_predicts(degree):
    """A kernel exp(kappa cos) shrinks those of degree 1 by coth(kappa) - 1 / kappa, of degree 2 by 1 - 3 of it / kappa.

    About exp(-l (l + 1) s^2 / 2) where s is small.
    """
    z = map_directions(128)[..., 2]
    texture = (0.5 + 0.3 * (z if degree == 1 else (3 * z * z - 1) / 2)).float()
    blurs = map_blurs(texture[None], 48)[0].double()
    for k, scale in enumerate(SCALES, start=1):
        kappa = 1 / scale**2
        first = 1 / math.tanh(kappa) - 1 / kappa
        expected = first if degree == 1 else 1 - 3 * first / kappa
        found = float((blurs[:, k] * blurs[:, 0]).sum() / blurs[:, 0].square().sum())
        assert abs(found - expected) < 0.01
        if scale < 0.3:
            assert abs(found - math.exp(-degree * (degree + 1) * scale**2 / 2)) < 0.02
    # Nothing but its size changes.
    assert_close(blurs[:, 4] / blurs[:, 4].norm(), blurs[:, 0] / blurs[:, 0].norm(), atol=2e-3)


@pytest.mark.slow
def test_blurs_are_sums_over_the_sphere():
    """The oracle: even points of the sphere instead of cells with areas, in numpy float64."""
    texture = smooth_map(np.eye(3))
    blurs = map_blurs(texture[None], SIDE)[0].double().numpy()
    k = np.arange(20000) + 0.5  # Fibonacci's points: each has the same share of the sphere
    z, turn = 1 - 2 * k / len(k), np.pi * (1 + 5**0.5) * k
    d = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], -1)
    value = np.exp(4 * (d @ [0.6, 0, 0.8] - 1)) - 0.7 * np.exp(6 * (d @ [0, -0.8, 0.6] - 1)) + 0.3 * d[:, 0] * d[:, 1]
    value = (value - value.mean()) / value.std()
    for column, scale in list(enumerate(SCALES, start=1))[2:]:
        kernel = np.exp((DIRECTION.numpy() @ d.T - 1) / scale**2)
        expected = (kernel @ value) / kernel.sum(1)
        assert np.abs(blurs[:, column] - expected).max() < 0.02


def test_light_and_contrast_of_a_map_do_not_matter():
    texture = random_texture("blobs", 5, 64)
    assert_close(map_blurs((0.3 + 0.4 * texture)[None], SIDE), map_blurs(texture[None], SIDE), atol=1e-4)
    assert_close(map_blurs((1 - texture)[None], SIDE), -map_blurs(texture[None], SIDE), atol=1e-4)


def test_a_batch_of_maps_is_the_stack_of_its_singles():
    textures = torch.stack([random_texture("blobs", k, 64) for k in range(3)])
    together = map_blurs(textures, SIDE)
    assert together.shape == (3, SIDE * SIDE, 1 + len(SCALES))
    for k in range(3):
        assert_close(map_blurs(textures[k : k + 1], SIDE)[0], together[k], atol=1e-5)


def test_features_of_a_map_turned_by_a_quarter_are_the_turned_features():
    """A quarter turn about the body's z takes cells onto cells, so nothing is lost."""
    texture = random_texture("blobs", 8, 64)
    quarter = torch.roll(texture, 64 // 2, dims=1)  # longitude + 90 degrees: a quarter of 128 columns
    plain, turned = (untrained().map(map_blurs(one[None], SIDE)[0]).detach() for one in (texture, quarter))
    R = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    source = (torch.from_numpy(DIRECTION.numpy() @ R) @ DIRECTION.T).argmax(1)  # the cell that came here
    assert_close(turned, plain[source], atol=1e-3)
    backwards = (torch.from_numpy(DIRECTION.numpy() @ R.T) @ DIRECTION.T).argmax(1)
    assert (turned - plain[backwards]).abs().max() > 0.02


def test_features_of_a_turned_map_are_the_turned_features_up_to_the_cells():
    R = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    plain, turned = (map_blurs(smooth_map(one)[None], SIDE)[0].double() for one in (np.eye(3), R))
    near = torch.from_numpy(DIRECTION.numpy() @ R) @ DIRECTION.T
    source = near.argmax(1)
    # Cells are 4 degrees apart and slopes about 1 a radian.
    assert (turned - plain[source]).abs().mean() < 0.05
    features = [untrained().map(one.float()).detach() for one in (plain, turned)]
    backwards = (torch.from_numpy(DIRECTION.numpy() @ R.T) @ DIRECTION.T).argmax(1)
    right, wrong = ((features[1] - features[0][cells]).abs().mean() for cells in (source, backwards))
    assert right < 0.1 * wrong


def test_the_bank_shows_each_view_what_is_before_the_camera():
    """Features that are the body direction itself: view k must see R_k^T n at normal n, before the ball's middle."""
    network = Correlator(tiny().network)
    network.map = torch.nn.Identity()
    direction = octahedral_directions(network.settings.nodes).float()
    bank = network.bank(direction).unflatten(1, (-1, 3))  # (K, P, 3)
    # The mean normal of the visible half looks at the camera: -z of the view.
    seen = torch.nn.functional.normalize(bank.mean(1), dim=-1)
    camera = -network.grid[:, 2]  # R^T (0, 0, -1)
    assert (seen * camera).sum(-1).min() > 0.995


def test_a_planted_answer_is_found_at_its_rotation(rng):
    """A picture whose features are those of the map seen so: the top is there, with the right hand."""
    network = untrained()
    blurs = map_blurs(random_texture("blobs", 4, 64)[None], network.settings.nodes)[0]
    with torch.no_grad():
        bank = network.bank(blurs)
        bank = bank - bank.mean(0)
        for k in (0, 77, 1500):
            tops = find_modes(20 * network.logits(bank[[k]], bank), network.grid, 1)
            assert so3.geodesic_distance(tops.R_view_body[0, 0], network.grid[k]) < math.radians(9)


def test_grey_levels_of_any_scale_give_the_same(rng):
    disks = 100 * torch.rand(3, 24, 24, generator=rng)
    with torch.no_grad():
        plain, scaled = untrained().seen(disks), untrained().seen(2.5 * disks + 7)
    assert_close(scaled, plain, atol=1e-4)


def test_a_dark_disk_gives_finite_logits():
    blurs = map_blurs(random_texture("blobs", 4, 64)[None], untrained().settings.nodes)[0]
    with torch.no_grad():
        assert untrained()(torch.zeros(2, 24, 24), blurs).isfinite().all()


def tensors_in(thing: object) -> list[Tensor]:
    """All tensors that an object holds, however deep."""
    if isinstance(thing, Tensor):
        return [thing]
    inner = thing.values() if isinstance(thing, dict) else thing if isinstance(thing, list | tuple) else None
    if inner is None:
        inner = vars(thing).values() if hasattr(thing, "__dict__") and not isinstance(thing, type) else ()
    return [tensor for one in inner for tensor in tensors_in(one)]


def test_nothing_stays_on_the_cpu_when_the_network_goes_elsewhere():
    """Tensors without content stand for a GPU; one that is no buffer would stay behind."""
    network = Correlator(tiny().network).to("meta")
    held = tensors_in(network)
    assert len(held) > 30
    assert {tensor.device.type for tensor in held} == {"meta"}


def test_training_and_tops_are_on_the_device_of_the_network():
    network = Correlator(tiny().network).to("meta")
    lesson = TrainingBatch(
        textures=torch.zeros(2, 48, 96, device="meta"),
        blurs=torch.zeros(2, 32 * 32, 1 + len(SCALES), device="meta"),
        disks=torch.zeros(2, 3, 24, 24, device="meta"),
        R_view_body=torch.zeros(2, 3, 3, 3, device="meta"),
    )
    predictions = predict(network, lesson)
    logits, truth = predictions.logits, predictions.R_view_body
    cross_entropy(predictions, network.grid, 0.1).mean().backward()
    assert network.gain.grad.device.type == "meta"
    assert first_right(find_modes(logits, network.grid, 3, 0.4), truth, 10.0).device.type == "meta"
