import math

import pytest
import torch
from renders import disks_of_pictures, pictures, turning

from sphereorient import so3
from sphereorient.mapping.disks import reduced
from sphereorient.mapping.pairs import refine_pairs, search_pairs

GRID = so3.local_grid(math.radians(8), math.radians(30))


def found(disks, first, second):
    still = torch.eye(3, dtype=torch.float64).expand(len(first), 3, 3)
    start = search_pairs(reduced(disks, 2), first, second, still, GRID, 2)
    return refine_pairs(disks, first, second, start, 6)


@pytest.mark.parametrize(("cameras", "within_deg"), [(1, 0.6), (2, 0.6)])
def test_two_renders_give_the_rotation_without_a_map(cameras, within_deg):
    R = turning(4, 11.0)
    first, second = torch.tensor([0, 1, 0]), torch.tensor([1, 2, 2])
    turns = found(disks_of_pictures(pictures(R, cameras)), first, second)
    off = so3.geodesic_distance(turns.R_ji, R[second] @ R[first].mT)
    assert torch.rad2deg(off).max() < within_deg
    assert turns.score.min() > 0.9
    # The other order of the pair is the inverse rotation.
    assert so3.geodesic_distance(turns.R_ji.mT, R[second] @ R[first].mT).min() > 0.2


def test_paint_that_one_camera_shows_is_found_again_by_the_other():
    # A quarter turn about lab y moves paint that camera 1 sees before camera 2.
    quarter = so3.exp(torch.tensor([0.0, math.pi / 2, 0.0], dtype=torch.float64))
    start = so3.exp(torch.tensor([0.2, 0.4, -0.3], dtype=torch.float64))
    R = torch.stack([start, quarter @ start])
    disks = disks_of_pictures(pictures(R, 2))
    near = so3.exp(torch.tensor([0.05, -0.04, 0.05], dtype=torch.float64)) @ quarter
    turns = refine_pairs(disks, torch.tensor([0]), torch.tensor([1]), near[None], 8)
    assert math.degrees(float(so3.geodesic_distance(turns.R_ji[0], quarter))) < 0.5
    assert float(turns.score) > 0.9


def test_mirrored_pictures_give_the_mirrored_turn():
    R = turning(2, 12.0, (0.3, 1.0, 0.5))
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    mirrored = disks_of_pictures(pictures(R).flip(-1))
    turns = found(mirrored, torch.tensor([0]), torch.tensor([1]))
    expected = mirror @ R[1] @ R[0].mT @ mirror
    assert math.degrees(float(so3.geodesic_distance(turns.R_ji[0], expected))) < 0.6


def test_another_paint_is_not_taken_for_the_same():
    R = turning(1, 0.0)
    two = torch.cat([pictures(R, seed=3), pictures(R, seed=4)])
    turns = found(disks_of_pictures(two), torch.tensor([0]), torch.tensor([1]))
    assert float(turns.score) < 0.7


def test_a_batch_of_pairs_is_the_stack_of_its_singles():
    disks = disks_of_pictures(pictures(turning(3, 9.0), 2))
    first, second = torch.tensor([0, 1]), torch.tensor([1, 2])
    start = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    whole = refine_pairs(disks, first, second, start, 4)
    for k in range(2):
        one = refine_pairs(disks, first[k : k + 1], second[k : k + 1], start[:1], 4)
        assert so3.geodesic_distance(one.R_ji[0], whole.R_ji[k]) < 1e-4
