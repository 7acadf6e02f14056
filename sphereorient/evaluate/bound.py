"""The Cramér-Rao bound: how well any unbiased method can do on one picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, check_tail, refusal
from sphereorient.sphere import reduced_texture, sample_texture
from sphereorient.synth.aperture import aperture_matrix, fine_places

STEP_PX = 0.1  # of central differences, as motion on the picture: their error is 0.5 % of the bound at 0.6 px of blur
ROUNDING = 1e-6  # an unknown whose own information is below this share of the greatest moves nothing but last digits
DETERMINED = 1e-3  # with each unknown's own information 1: differences of sampled pictures tell no less from nothing
OPEN_SHARE = 1e-3  # an unknown is open if this share of it lies along open directions
ATTITUDES = 16  # whose derivatives are held at once
SAMPLES = 1 << 18  # fine samples drawn at once, of all pictures together: more leave the cache


@dataclass(frozen=True, kw_only=True, eq=False)
class Bound:
    """Least covariance of six unknowns from single pictures; made by `cramer_rao_bound`, read by benchmarks.

    Order of the unknowns: delta of R = exp([delta]x) R_view_body, view components, rad (three); centre (u, v), px;
    radius, px. What the picture does not determine has an infinite variance, and covariance 0 with the others.
    """

    information: Tensor  # (..., 6, 6)

    @property
    def covariance(self) -> Tensor:
        """(..., 6, 6), inverse of the information."""
        return _inverse(self.information)

    @property
    def orientation_rms_rad(self) -> Tensor:
        """(...), rms geodesic error, centre and radius unknown too."""
        return _root_trace(self.covariance[..., :3, :3])

    @property
    def orientation_known_place_rms_rad(self) -> Tensor:
        """(...), the same with centre and radius known."""
        return _root_trace(_inverse(self.information, 3))

    @property
    def centre_rms_px(self) -> Tensor:
        """(...), rms distance of the centre from the true one."""
        return _root_trace(self.covariance[..., 3:5, 3:5])

    @property
    def radius_rms_px(self) -> Tensor:
        """(...), rms error of the radius."""
        return _root_trace(self.covariance[..., 5:, 5:])


def cramer_rao_bound(
    texture: Tensor,
    R_view_body: Tensor,
    *,
    diameter_px: float,
    noise_share: float = 0.05,
    optics_sigma_px: float = 0.55,
    background: float = 0.0,
    supersampling: int = 6,
) -> Bound:
    """Return the bound of pictures of a painted sphere, evenly lit, orthographic, the light's gain and offset known.

    The picture: paint 0 .. 1 on a disk, blurred by the optics' Gaussian and the pixel's square, in white noise. The
    rms over attitudes is the root of the mean of the squares: mean the variances, not the roots.

    Args:
        texture: (H, 2 H), the map, 0 black .. 1 white.
        R_view_body: (..., 3, 3), attitudes; dtype of the result.
        diameter_px: of the disk.
        noise_share: standard deviation of a pixel's noise over the step from black to white; the bound is
            proportional to it.
        optics_sigma_px: standard deviation of the optics' blur, px; the pixel comes on top.
        background: grey behind the disk, 0 as the black paint, 1 as the white.
        supersampling: fine samples per pixel and axis; 6 is right to 3 % from 20 px up, 4 from 40 px up.

    Raises:
        ShapeError: attitudes that are not 3 x 3, or a map that is not 2:1.
        SettingsError: a diameter, noise or supersampling that is not positive.

    Source: ERRATA, The bound; for white noise the information is J^T J / sigma^2, J the picture's derivatives.
    """
    check_tail("R_view_body", R_view_body, 3, 3)
    for name, value in (("diameter_px", diameter_px), ("noise_share", noise_share), ("supersampling", supersampling)):
        if not value > 0:
            do = "pass what the picture has"
            raise SettingsError(refusal(name, expected="a number above 0", got=f"{value:g}", do=do))
    disk = DiskPicture(
        texture=reduced_texture(texture.to(R_view_body), supersampling * diameter_px),
        radius_px=diameter_px / 2,
        optics_sigma_px=optics_sigma_px,
        background=background,
        supersampling=supersampling,
    )
    flat = R_view_body.reshape(-1, 3, 3)
    parts = [flat.new_zeros(0, 6, 6)]
    for R in torch.split(flat, ATTITUDES):
        jacobian = disk.jacobian(R)
        parts.append(jacobian.mT @ jacobian / noise_share**2)
    return Bound(information=torch.cat(parts).reshape(*R_view_body.shape[:-2], 6, 6))


class DiskPicture:
    """Pictures of a sphere seen from far away, its centre near the middle of a square with room for the blur.

    Args:
        texture: (H, 2 H), as fine as the fine samples.
        radius_px: of the disk.
        optics_sigma_px: standard deviation of the optics' Gaussian, px.
        background: grey behind the disk.
        supersampling: fine samples per pixel and axis.
    """

    def __init__(
        self, *, texture: Tensor, radius_px: float, optics_sigma_px: float, background: float, supersampling: int
    ) -> None:
        self.texture, self.radius_px, self.background = texture, radius_px, background
        self.supersampling = supersampling
        self.size_px = 2 * math.ceil(radius_px + 4 * optics_sigma_px + 1)
        self.aperture = aperture_matrix(self.size_px, supersampling, optics_sigma_px).to(texture)
        at = fine_places(self.size_px, supersampling).to(texture) - 0.5 * (self.size_px - 1)
        down, right = torch.meshgrid(at, at, indexing="ij")
        # Only samples that the disk reaches while its centre and radius move by up to half a pixel.
        self.reached = right.square() + down.square() < (radius_px + 1.0) ** 2
        self.place = torch.stack([right[self.reached], down[self.reached]], dim=-1)

    def __call__(self, R_view_body: Tensor, centre_px: Tensor, radius_px: Tensor) -> Tensor:
        """Draw the pictures.

        Args:
            R_view_body: (K, 3, 3).
            centre_px: (K, 2), from the middle of the picture, up to half a pixel.
            radius_px: (K,), within half a pixel of the one given at first.

        Returns:
            (K, S, S), grey, 0 black paint .. 1 white paint.
        """
        across = (self.place - centre_px[:, None]) / radius_px[:, None, None]
        distance = across.norm(dim=-1)
        # The limb as wide as a fine sample: a step would count samples, and its derivative be noise.
        share = ((1.0 - distance) * (radius_px * self.supersampling)[:, None] + 0.5).clamp(0.0, 1.0)
        across = across / distance.clamp_min(1.0)[..., None]
        depth = (1.0 - across.square().sum(-1)).clamp_min(0.0).sqrt()
        normal_view = torch.cat([across, -depth[..., None]], dim=-1)
        paint = sample_texture(self.texture, normal_view @ R_view_body)
        fine = paint.new_zeros(len(paint), *self.reached.shape)
        fine[:, self.reached] = share * (paint - self.background)
        return self.background + self.aperture @ fine @ self.aperture.mT

    def jacobian(self, R_view_body: Tensor) -> Tensor:
        """Derivatives of the pictures (K, S^2, 6), the disk in the middle; order of the unknowns as in `Bound`."""
        count = len(R_view_body)
        step = STEP_PX * R_view_body.new_tensor([1 / self.radius_px] * 3 + [1.0] * 3)
        both = torch.cat([torch.diag(step), -torch.diag(step)])  # (12, 6)
        R = (so3.exp(both[:, :3]) @ R_view_body[:, None]).flatten(0, 1)
        centre_px, radius_px = both[:, 3:5].repeat(count, 1), self.radius_px + both[:, 5].repeat(count)
        at_once = max(1, SAMPLES // len(self.place))
        parts = zip(*(torch.split(each, at_once) for each in (R, centre_px, radius_px)), strict=True)
        pictures = torch.cat([self(*part) for part in parts]).reshape(count, 2, 6, self.size_px**2)
        return ((pictures[:, 0] - pictures[:, 1]) / (2 * step[:, None])).mT


def _inverse(information: Tensor, count: int = 6) -> Tensor:
    """Invert information (..., 6, 6) of the first `count` unknowns, the others known; what is open gets infinity."""
    own = information.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    # What is rounding shows beside the outline's information, not among unknowns that may all be open.
    greatest = own.amax(-1, keepdim=True).clamp_min(torch.finfo(own.dtype).tiny)
    own, information = own[..., :count], information[..., :count, :count]
    # In units in which each unknown's own information is 1, as far as it has any: rad and px cannot be compared.
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
