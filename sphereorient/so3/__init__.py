"""Rotations: (..., 3, 3) matrices that act on columns, not checked; rotation vectors (..., 3), rad, right-handed."""

from sphereorient.so3.grids import from_lattman, lattman_grid, lattman_steps, local_grid, to_lattman
from sphereorient.so3.rotations import (
    angle,
    exp,
    geodesic_distance,
    hat,
    log,
    nearest_rotation,
    random_rotations,
    vee,
    weighted_mean,
)
from sphereorient.so3.tait_bryan import (
    from_tait_bryan,
    rate_matrix_body,
    rate_matrix_lab,
    second_triplet,
    to_tait_bryan,
)

__all__ = [
    "angle",
    "exp",
    "from_lattman",
    "from_tait_bryan",
    "geodesic_distance",
    "hat",
    "lattman_grid",
    "lattman_steps",
    "local_grid",
    "log",
    "nearest_rotation",
    "random_rotations",
    "rate_matrix_body",
    "rate_matrix_lab",
    "second_triplet",
    "to_lattman",
    "to_tait_bryan",
    "vee",
    "weighted_mean",
]
