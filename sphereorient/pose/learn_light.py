import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from sphereorient.pose.fit import FittedPoses, by_pose, residuals
from sphereorient.pose.light import Light, light_basis
from sphereorient.pose.model import SphereModel, SphereView
from sphereorient.pose.pixels import Pixels


def learn_light(pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel) -> Light:
    """Estimate the light and the noise of a movie from the fits of B * C disks, those of `use` (B, C) bool."""
    cameras = use.shape[1]
    X, R = fit.position_lab_mm, fit.R_lab_body
    at = residuals(pixels, X, R, None, model, cameras)
    at = residuals(pixels, X, R, (at.model, at.weight), model, cameras)
    normal, right = light_sums(at.view, pixels, at.weight / at.variance * use.reshape(-1, 1))
    difference, black = light_maps(by_pose(normal, cameras).sum(0), by_pose(right, cameras).sum(0))
    counted = pixels.inside & use.reshape(-1, 1)
    noise = torch.stack(
        [noise_curve(at.model[c::cameras], at.residual[c::cameras], counted[c::cameras]) for c in range(cameras)]
    )
    return Light(difference=difference, black=black, noise=noise, known=True)


def light_sums(view: SphereView, pixels: Pixels, precision: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal equations of light maps of L disks, (L, 2 K, 2 K) and (L, 2 K); precision (L, P)."""
    basis = light_basis(view.across)
    columns = torch.cat([(view.coverage * view.paint)[:, None] * basis, view.coverage[:, None] * basis], dim=1)
    weighted = columns * precision[:, None]
    target = pixels.grey - (1.0 - view.coverage) * pixels.behind
    return (weighted @ columns.mT).double(), (weighted @ target[..., None])[..., 0].double()


def light_maps(normal: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Solve the summed normal equations (C, 2 K, 2 K), (C, 2 K) for the maps of difference and black, (C, K) each."""
    # The basis is nearly dependent (x^2 + y^2 + depth^2 = 1): a ridge of 1e-5 picks the smallest coefficients.
    ridge = 1e-5 * normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-9)
    solution = torch.linalg.solve(normal + torch.diag_embed(ridge), right).float()
    difference, black = solution.chunk(2, dim=-1)
    return difference, black


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
