"""What all lights are learnt with alike: stray light beside the sphere, and the noise of each camera."""

import math

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from sphereorient.pose.model import no_stray, scene_beside, stray_basis
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.residuals import NOISE_MIN, Residuals

NO_SPHERE = 0.01  # share of a pixel; less of the sphere shows nothing of it
STRAY_ROUNDS, STRAY_TUKEY, FEWEST_BESIDE = 5, 6.0, 200  # rounds, standard deviations, pixels
STRAY_LEAST = 0.05  # coefficients, summed, of the step from black to white paint: clean pictures 0.01, glare 0.13


def learn_stray(at: Residuals, pixels: Pixels, use: Tensor, known: Tensor) -> Tensor:
    """Estimate the stray light (C, K) from pixels that no sphere covers in B * C disks, those of `use` (B, C) bool.
    `known` (C, K) is the one that the residuals hold. Robust: bubbles and other passers-by count for nothing. Light as
    weak as the errors of the model of the limb is taken for none.
    """
    beside = at.inside & ~pixels.clipped & (at.view.coverage < NO_SPHERE) & use.reshape(-1, 1)
    beside[:, : pixels.inner] = False
    cameras = use.shape[1]
    found = no_stray(cameras)
    stray_known = scene_beside(at.view, pixels, known) - pixels.behind  # less what the sphere's edge adds
    for camera in range(cameras):
        own = slice(camera, None, cameras)
        basis = stray_basis(at.view.across[own]).mT[beside[own]].double()
        more = (at.residual + stray_known)[own][beside[own]].double()
        weight = torch.ones_like(more)
        for _ in range(STRAY_ROUNDS if len(more) >= FEWEST_BESIDE else 0):
            weighted = basis * weight[:, None]
            coefficients = torch.linalg.solve(weighted.mT @ basis + torch.eye(basis.shape[1]), weighted.mT @ more)
            left = more - basis @ coefficients
            scale = (1.4826 * left.abs().median()).clamp_min(math.sqrt(NOISE_MIN))
            weight = (1.0 - (left / (STRAY_TUKEY * scale)).square()).clamp_min(0.0).square()
            found[camera] = coefficients.float()
        step = at.lit[own, : pixels.inner][use[:, camera]].median() if bool(use[:, camera].any()) else math.inf
        if found[camera].abs().sum() < STRAY_LEAST * step:
            found[camera] = 0.0
    return found


def noise_curves(model: Tensor, residual: Tensor, inside: Tensor, cameras: int) -> Tensor:
    """Return the noise curve of each camera, (C, 4), from B * C disks (L, P); see `noise_curve`."""
    disks = [slice(camera, None, cameras) for camera in range(cameras)]
    return torch.stack([noise_curve(model[own], residual[own], inside[own]) for own in disks])


def noise_curve(model: Tensor, residual: Tensor, inside: Tensor) -> Tensor:
    """Return the noise variance's coefficients (4,), not negative, in the grey level, from pixels (N,) inside."""
    model, residual = model[inside].clamp_min(0).double(), residual[inside].double()
    order = model.argsort(stable=True)
    groups = [group for group in order.tensor_split(24) if len(group) >= 50]
    if len(groups) < 3:
        return torch.tensor([float(residual.square().mean()) if len(residual) else 1.0, 0.0, 0.0, 0.0])
    at = torch.stack([model[group].mean() for group in groups])
    # Robust: the paint's borders leave residuals that are not noise.
    seen = torch.stack([(1.4826 * residual[group].abs().median()).square() for group in groups]).clamp_min(0.1)
    design = torch.stack([at**power for power in range(4)], dim=-1) / seen[:, None]
    return torch.from_numpy(nnls(design.numpy(), np.ones(len(groups)))[0]).float()
