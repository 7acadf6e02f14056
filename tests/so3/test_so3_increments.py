"""In whose components an increment's axis is: docs/errata.md E4."""

import math

import torch
from conftest import assert_close

from sphereorient import so3

F64 = torch.float64


def test_E4_R_later_times_R_T_is_the_turn_in_lab_components_and_R_T_times_R_later_in_body_components(rng):
    R_k, R_later = so3.random_rotations((2, 200), generator=rng)
    turn_lab, turn_body = so3.log(R_later @ R_k.mT), so3.log(R_k.mT @ R_later)
    assert_close(turn_lab.norm(dim=-1), turn_body.norm(dim=-1))  # same angle
    assert_close((R_k @ turn_body[..., None])[..., 0], turn_lab)  # n_lab = R_k n_body
    assert (turn_lab - turn_body).norm(dim=-1).median() > 0.5  # as printed, lab components are called the particle's


def test_E4_a_turn_about_the_labs_z_has_the_labs_z_as_axis_of_T():
    R_k = so3.exp(torch.tensor([math.pi / 2, 0.0, 0.0], dtype=F64))  # the body's y lies along the lab's z
    R_later = so3.exp(torch.tensor([0.0, 0.0, 0.3], dtype=F64)) @ R_k
    assert_close(so3.log(R_later @ R_k.mT), torch.tensor([0.0, 0.0, 0.3], dtype=F64))
    assert_close(so3.log(R_k.mT @ R_later), torch.tensor([0.0, 0.3, 0.0], dtype=F64))


def test_E4_only_the_body_components_do_not_depend_on_the_choice_of_lab(rng):
    R_k, R_later = so3.random_rotations((2, 200), generator=rng)
    R_lab2_lab = so3.random_rotations((), generator=rng)
    T_lab2 = (R_lab2_lab @ R_later) @ (R_lab2_lab @ R_k).mT
    assert_close((R_lab2_lab @ R_k).mT @ (R_lab2_lab @ R_later), R_k.mT @ R_later)
    assert so3.geodesic_distance(T_lab2, R_later @ R_k.mT).median() > 0.5
