import math

import torch
from torch import Tensor

from sphereorient.errors import SettingsError, refusal
from sphereorient.so3.exp import exp

# Half the cube's edge of the body-centred cubic lattice with one point per unit of volume.
HALF_EDGE = 2 ** (1 / 3) / 2


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
