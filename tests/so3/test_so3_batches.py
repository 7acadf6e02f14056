"""The batch law, one driver over all functions: a batch is the stack of its singles, in the dtype that came."""

import pytest
import torch
from conftest import assert_close

from sphereorient import so3
from sphereorient.errors import ShapeError


def vectors(batch, dtype, rng):
    return (torch.randn(*batch, 3, generator=rng, dtype=dtype),)


def rotations(batch, dtype, rng):
    return (so3.random_rotations(batch, generator=rng, dtype=dtype),)


def pairs(batch, dtype, rng):
    return rotations(batch, dtype, rng) + rotations(batch, dtype, rng)


def weighted(batch, dtype, rng):
    return *rotations((*batch, 3), dtype, rng), torch.rand(*batch, 3, generator=rng, dtype=dtype)


def angles(batch, dtype, rng):
    return (torch.rand(batch, generator=rng, dtype=dtype),)


def steps(theta_y):
    return torch.stack(so3.lattman_steps(theta_y, 0.1), -1)


CASES = {
    so3.exp: (vectors, (3, 3)),
    so3.hat: (vectors, (3, 3)),
    so3.from_tait_bryan: (vectors, (3, 3)),
    so3.second_triplet: (vectors, (3,)),
    so3.rate_matrix_lab: (vectors, (3, 3)),
    so3.rate_matrix_body: (vectors, (3, 3)),
    so3.to_lattman: (vectors, (3,)),
    so3.from_lattman: (vectors, (3,)),
    so3.log: (rotations, (3,)),
    so3.vee: (rotations, (3,)),
    so3.trace: (rotations, ()),
    so3.angle: (rotations, ()),
    so3.to_tait_bryan: (rotations, (3,)),
    so3.nearest_rotation: (rotations, (3, 3)),
    so3.geodesic_distance: (pairs, ()),
    so3.weighted_mean: (weighted, (3, 3)),
    steps: (angles, (2,)),
}


@pytest.mark.parametrize("function", CASES, ids=lambda f: f.__name__)
def test_a_batch_is_the_stack_of_its_singles(function, batch, dtype, rng, tolerance):
    make, tail = CASES[function]
    inputs = make(batch, dtype, rng)
    before = [x.clone() for x in inputs]
    found = function(*inputs)
    assert found.shape == (*batch, *tail)
    assert found.dtype == dtype
    assert all(torch.equal(x, old) for x, old in zip(inputs, before, strict=True))
    for index in torch.cartesian_prod(*map(torch.arange, batch)).reshape(-1, len(batch)).tolist() if batch else [[]]:
        single = function(*(x[tuple(index)] for x in inputs))
        assert_close(found[tuple(index)], single, atol=tolerance)


@pytest.mark.parametrize("function", CASES, ids=lambda f: f.__name__)
def test_a_batch_of_no_elements_passes_gradients(function, dtype, rng):
    inputs = [x.requires_grad_() for x in CASES[function][0]((0,), dtype, rng)]
    function(*inputs).sum().backward()
    assert all(x.grad.shape == x.shape for x in inputs)


@pytest.mark.parametrize("function", [f for f in CASES if f not in (steps, so3.trace)], ids=lambda f: f.__name__)
def test_another_last_axis_is_refused(function, rng):
    first, *others = CASES[function][0]((2,), torch.float64, rng)
    with pytest.raises(ShapeError, match="expected shape"):
        function(first[..., :2], *others)


def test_every_public_function_is_a_case():
    public = {f for name, f in vars(so3).items() if getattr(f, "__module__", "") == so3.__name__ and name[0] != "_"}
    grids = {so3.lattman_grid, so3.local_grid, so3.random_rotations, so3.lattman_steps}  # no tensor in, or two out
    algebra = {so3.check_rotations, so3.solve_damped, so3.inverse_damped, so3.cross_first_axis}  # tested by themselves
    assert public - grids - algebra == set(CASES) - {steps}
