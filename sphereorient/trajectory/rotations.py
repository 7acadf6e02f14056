"""Orientations of tracks as NumPy arrays (N, 3, 3): rotation vectors, angles, distances; NaN if unknown."""

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3

Floats = NDArray[np.float64]
AT_POLE = 0.02  # |cos theta_y| below which the axes of theta_x and theta_z nearly coincide


def rotation_vectors(R: Floats) -> Floats:
    """Return the rotation vectors (N, 3), rad, of rotations (N, 3, 3)."""
    known = np.asarray(np.isfinite(R).all(axis=(1, 2)))
    some = R if known.all() else np.where(known[:, None, None], R, np.eye(3))
    turn: Floats = so3.log(torch.from_numpy(some)).numpy()
    turn[~known] = np.nan
    return turn


def rotations(vectors: Floats) -> Floats:
    """Return the rotations (N, 3, 3) of rotation vectors (N, 3), rad."""
    return np.asarray(so3.exp(torch.from_numpy(np.ascontiguousarray(vectors))).numpy(), np.float64)


def nearest_rotations(M: Floats) -> Floats:
    """Return the rotations (..., 3, 3) nearest to matrices, as `so3.nearest_rotation`."""
    return np.asarray(so3.nearest_rotation(torch.from_numpy(M)).numpy(), np.float64)


def distance_rad(A: Floats, B: Floats) -> Floats:
    """Return the angles (N,), rad, between orientations (N, 3, 3)."""
    return np.asarray(so3.geodesic_distance(torch.from_numpy(A), torch.from_numpy(B)).numpy(), np.float64)


def distance_deg(A: Floats, B: Floats) -> Floats:
    """Return the angles (N,), degrees, between orientations (N, 3, 3)."""
    return np.rad2deg(distance_rad(A, B))


def tait_bryan(R_lab_body: Floats) -> Floats:
    """Return theta_x, theta_y, theta_z (N, 3), rad, of orientations. Source: docs/errata.md E1."""
    known = np.isfinite(R_lab_body.reshape(-1, 9)).all(1, keepdims=True)  # for NaN it gives theta_z = 0, as at a pole
    return np.where(known, so3.to_tait_bryan(torch.from_numpy(R_lab_body)).numpy(), np.nan)


def tait_bryan_sigma(R_lab_body: Floats, cov_lab_rad2: Floats) -> Floats:
    """Return the sigmas of the Tait-Bryan angles (N, 3), rad; NaN near the poles. Source: docs/errata.md E3."""
    theta = tait_bryan(R_lab_body)
    there, sigma = np.isfinite(theta).all(1) & (np.abs(np.cos(theta[:, 1])) > AT_POLE), np.full_like(theta, np.nan)
    inverse = np.linalg.inv(so3.rate_matrix_lab(torch.from_numpy(theta[there])).numpy())
    cov = inverse @ cov_lab_rad2[there] @ inverse.swapaxes(1, 2)
    sigma[there] = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    return sigma
