"""The Cramér-Rao bound of any unbiased method on one picture."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, check_tail, refusal
from sphereorient.sphere import Sampling, SphereRenderer
from sphereorient.sphere.renderer import orthographic_camera

STEP_PX = 0.1  # of central differences, as motion on the picture: their error is 0.5 % of the bound at 0.6 px of blur
ROUNDING = 1e-6  # share of the greatest information; less is rounding error
DETERMINED = 1e-3  # least eigenvalue (own information of each unknown: 1) resolved by differences of sampled pictures
OPEN_SHARE = 1e-3  # an unknown is open if this share of it lies along open directions
ATTITUDES = 16  # per batch of derivatives
SAMPLING = Sampling(supersampling=6)


@dataclass(frozen=True, kw_only=True, eq=False)
class Bound:
    """Least covariance of delta of R = exp([delta]x) R_view_body, view, rad (3), centre (u, v), px, and radius, px.
    Made by `cramer_rao_bound`. Undetermined unknowns have infinite variance, and covariance 0 with the others.
    """

    information: Tensor  # (..., 6, 6)

    @property
    def covariance(self) -> Tensor:
        """Covariance (..., 6, 6): inverse of the information."""
        return _inverse(self.information)

    @property
    def orientation_rms_rad(self) -> Tensor:
        """Rms geodesic error (...), rad, centre and radius unknown."""
        return _root_trace(self.covariance[..., :3, :3])

    @property
    def orientation_known_place_rms_rad(self) -> Tensor:
        """Rms geodesic error (...), rad, centre and radius known."""
        return _root_trace(_inverse(self.information, 3))

    @property
    def centre_rms_px(self) -> Tensor:
        """Rms distance (...), px, of the centre from the true one."""
        return _root_trace(self.covariance[..., 3:5, 3:5])

    @property
    def radius_rms_px(self) -> Tensor:
        """Rms error (...), px, of the radius."""
        return _root_trace(self.covariance[..., 5:, 5:])


def cramer_rao_bound(
    texture: Tensor,
    R_view_body: Tensor,
    *,
    diameter_px: float,
    noise_share: float = 0.05,
    sampling: Sampling = SAMPLING,
) -> Bound:
    """Return the bound for orthographic pictures in white noise, even light of known gain and offset.

    For the rms over orientations average the variances, not their roots.

    Args:
        texture: (H, 2 H), the map, 0 black .. 1 white.
        R_view_body: (..., 3, 3), orientations; dtype of the result.
        diameter_px: of the disk.
        noise_share: standard deviation of the noise over the step from black to white; the bound is proportional.
        sampling: blur and background; 6 fine samples per pixel and axis are right to 3 % from 20 px up, 4 from 40 px.

    Raises:
        ShapeError: orientations that are not 3 x 3, or a map that is not 2:1.
        SettingsError: a diameter, noise or supersampling that is not positive.
    Source: docs/errata.md, The bound.
    """
    check_tail("R_view_body", R_view_body, 3, 3)
    numbers = {"diameter_px": diameter_px, "noise_share": noise_share, "supersampling": sampling.supersampling}
    for name, value in numbers.items():
        if not value > 0:
            do = "pass the picture's value"
            raise SettingsError(refusal(name, expected="a number above 0", got=f"{value:g}", do=do))
    render = disk_renderer(texture.to(R_view_body), diameter_px, sampling)
    flat = R_view_body.reshape(-1, 3, 3)
    parts = [flat.new_zeros(0, 6, 6)]
    for J in (jacobian(render, R) for R in torch.split(flat, ATTITUDES)):
        parts.append(J.mT @ J / noise_share**2)
    return Bound(information=torch.cat(parts).reshape(*R_view_body.shape[:-2], 6, 6))


def disk_renderer(texture: Tensor, diameter_px: float, sampling: Sampling = SAMPLING) -> SphereRenderer:
    """Return the renderer of the bound's pictures: a disk with room for the blur; one mm is one pixel."""
    size = 2 * math.ceil(diameter_px / 2 + 4 * sampling.blur_px + 1)
    camera = orthographic_camera(size, 1.0)
    return SphereRenderer(texture, radius_mm=diameter_px / 2, camera=camera, sampling=sampling)


def jacobian(render: SphereRenderer, R_view_body: Tensor) -> Tensor:
    """Return derivatives (K, S^2, 6) by `Bound`'s unknowns, by central differences, as kinks disturb automatic ones."""
    step = STEP_PX * R_view_body.new_tensor([1 / render.radius_mm] * 3 + [1.0] * 3)
    both = torch.cat([torch.diag(step), -torch.diag(step)])  # (12, 6)
    R = so3.exp(both[:, :3]) @ R_view_body[:, None]
    position = torch.nn.functional.pad(both[:, 3:5], (0, 1))
    pictures: Tensor = render(R, position, render.radius_mm + both[:, 5]).flatten(-2)  # (K, 12, S^2)
    return ((pictures[:, :6] - pictures[:, 6:]) / (2 * step[:, None])).mT


def _inverse(information: Tensor, count: int = 6) -> Tensor:
    """Invert information (..., 6, 6) of the first `count` unknowns, the others known; infinity: undetermined."""
    own = information.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    # Compare with all unknowns, as the first `count` may all be undetermined.
    greatest = own.amax(-1, keepdim=True).clamp_min(torch.finfo(own.dtype).tiny)
    own, information = own[..., :count], information[..., :count, :count]
    # Scale each unknown's own information to 1, as rad and px are not comparable.
    unit = torch.where(own > ROUNDING * greatest, own, greatest).rsqrt()
    value, axis = torch.linalg.eigh(information * unit[..., None] * unit[..., None, :])
    open_ = value < DETERMINED
    weight = torch.where(open_, 0.0, 1.0 / torch.where(open_, 1.0, value))
    covariance = (axis * weight[..., None, :]) @ axis.mT * unit[..., None] * unit[..., None, :]
    lost = (axis.square() * open_[..., None, :]).sum(-1) > OPEN_SHARE
    covariance = torch.where(lost[..., None] | lost[..., None, :], 0.0, covariance)
    return covariance + torch.diag_embed(torch.where(lost, torch.inf, 0.0))


def _root_trace(matrix: Tensor) -> Tensor:
    return matrix.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
