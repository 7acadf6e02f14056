"""Grids: Lattman's angles, in which the metric of SO(3) is diagonal, his grid over all rotations, and a local one."""

import math

import torch
from torch import Tensor

from sphereorient.errors import SettingsError, check_tail, refusal
from sphereorient.so3.rotations import exp
from sphereorient.so3.tait_bryan import from_tait_bryan

# A count that is a whole number by geometry must not be rounded up for the last bits of a sine.
ROUNDING = 1e-9
# Half the cube's edge of the body-centred cubic lattice with one point per unit of volume.
HALF_EDGE = 2 ** (1 / 3) / 2


def to_lattman(theta: Tensor) -> Tensor:
    """Return the Lattman angles (theta_x + theta_z, theta_y, theta_x - theta_z) of Tait-Bryan angles (..., 3), rad."""
    check_tail("theta", theta, 3)
    x, y, z = theta.unbind(-1)
    return torch.stack([x + z, y, x - z], -1)


def from_lattman(lattman: Tensor) -> Tensor:
    """Return the Tait-Bryan angles (..., 3), rad, of Lattman's, of ranges 4 pi, -pi/2 .. pi/2, 2 pi over SO(3)."""
    check_tail("lattman", lattman, 3)
    plus, y, minus = lattman.unbind(-1)
    return torch.stack([(plus + minus) / 2, y, (plus - minus) / 2], -1)


def lattman_steps(theta_y: Tensor, delta: float) -> tuple[Tensor, Tensor]:
    """Return the steps of theta_plus and theta_minus, (...) rad each, that rotate by `delta` rad.
    theta_y (...), rad, is in -pi/2 .. pi/2; at these ends, where an angle has no effect, its step is infinite.
    Source: d^2 = dtheta^2 + sin^2(pi/4 + theta/2) dtheta_plus^2 + sin^2(pi/4 - theta/2) dtheta_minus^2, the paper's own
    metric; the steps that it prints do not follow from it (docs/errata.md E5).
    """
    quarter = math.pi / 4
    return delta / (quarter + theta_y / 2).sin(), delta / (quarter - theta_y / 2).sin()


def lattman_grid(
    step_rad: float, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Return a grid of rotations (K, 3, 3), evenly over SO(3); K is about 8 pi^2 / step_rad^3, step_rad at most pi.
    Every rotation is within (1/2 + 1/sqrt 2) step_rad of the grid; random ones within sqrt(3)/2 step_rad (measured in
    tests/so3/test_so3_lattman.py). Rows of theta_y from -pi/2, each by theta_plus, then theta_minus. The last row,
    theta_y = pi/2, holds its rotations twice: there 2 pi of theta_plus is a full turn.
    Source: Lattman 1972 as in the paper, with the steps of docs/errata.md E5.

    Raises:
        SettingsError: the step is not in 0 .. pi.
    """
    if not 0 < step_rad <= math.pi:
        raise SettingsError(refusal("step_rad", expected="0 .. pi", got=f"{step_rad}", do="give the step in rad"))
    rows = max(math.ceil(math.pi / step_rad - ROUNDING), 1) + 1
    theta_y = torch.linspace(-math.pi / 2, math.pi / 2, rows, dtype=torch.float64)
    step_plus, step_minus = lattman_steps(theta_y, step_rad)
    plus_counts, minus_counts = _count(4 * math.pi, step_plus), _count(2 * math.pi, step_minus)
    angles = [
        torch.cartesian_prod(_circle(4 * math.pi, plus), y[None], _circle(2 * math.pi, minus))
        for y, plus, minus in zip(theta_y, plus_counts, minus_counts, strict=True)
    ]
    return from_tait_bryan(from_lattman(torch.cat(angles))).to(dtype=dtype, device=device)


def _count(length: float, step: Tensor) -> list[int]:
    """Return the least number of steps around a circle, 1 or more."""
    return [int(n) for n in (length / step - ROUNDING).ceil().clamp_min(1).tolist()]


def _circle(length: float, count: int) -> Tensor:
    return torch.arange(count, dtype=torch.float64) * (length / count)


def local_grid(
    step_rad: float, radius_rad: float, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Return rotations (M, 3, 3) spread evenly up to the angle radius_rad (0 .. pi), the unit first, then by angle.
    The rotation vectors are a body-centred cubic lattice with one point per step_rad^3, in rad; each rotation's inverse
    is included. Covering radius c = 0.704 step_rad: every rotation by at most radius_rad - c is within c of the grid,
    every one by at most radius_rad within 2 c.
    Source: Conway and Sloane, Sphere Packings, Lattices and Groups, ch. 2 (covering radius sqrt(5)/4 of the edge).

    Raises:
        SettingsError: the step is not above 0, or the radius not in 0 .. pi.
    """
    if not step_rad > 0:
        raise SettingsError(refusal("step_rad", expected="above 0", got=f"{step_rad}", do="give the step in rad"))
    if not 0 <= radius_rad <= math.pi:
        do = "give the radius in rad, or take lattman_grid for all rotations"
        raise SettingsError(refusal("radius_rad", expected="0 .. pi", got=f"{radius_rad}", do=do))
    unit = HALF_EDGE * step_rad
    reach = radius_rad / unit * (1 + 1e-9)  # keeps a shell that is exactly on the rim
    line = torch.arange(-math.floor(reach), math.floor(reach) + 1)
    places = torch.cartesian_prod(line, line, line)
    norm2 = places.square().sum(1)
    inside = (norm2 <= math.floor(reach**2)) & (places % 2 == places[:, :1] % 2).all(1)
    # whole numbers: ties in angle are exact, and the stable sort keeps them in the order of the places
    order = norm2[inside].argsort(stable=True)
    return exp(places[inside][order].to(torch.float64) * unit).to(dtype=dtype, device=device)
