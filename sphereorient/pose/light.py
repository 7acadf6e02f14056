"""How bright white and black paint look at each place of the disk: learnt from the movie, low order, per camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from sphereorient.pose.model import View
from sphereorient.pose.pixels import Pixels

MAP_SIDE = 256  # cells of a look-up map across the disk: a third of a pixel of an 80 px ball
ORDER, DEPTH_ORDER = 4, 3  # of the polynomials in x, y and of those times the depth sqrt(1 - x^2 - y^2)


def polynomials(across: Tensor, order: int) -> Tensor:
    """Return all monomials of x and y up to an order, (..., K, P), from places (..., 2, P)."""
    x, y = across[..., 0, :], across[..., 1, :]
    columns = [torch.ones_like(x)]
    last = columns
    for _ in range(order):
        last = [last[0] * x, *(column * y for column in last)]
        columns = [*columns, *last]
    return torch.stack(columns, dim=-2)


def light_basis(across: Tensor) -> Tensor:
    """Return the functions that light maps are sums of, (..., K, P).

    Polynomials in the components of the normal: they follow lamps that graze the limb, which those in x and y alone
    cannot.
    """
    depth = (1.0 - across.square().sum(-2)).clamp_min(0).sqrt()
    return torch.cat([polynomials(across, ORDER), polynomials(across, DEPTH_ORDER) * depth[..., None, :]], dim=-2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """What makes a movie's pictures grey: light on the disk, noise, blur; one entry a camera; made by `learn_light`.

    A pixel of the ball shows paint * difference + black, each a map over the disk; its noise has the variance
    noise[0] + noise[1] I + noise[2] I^2 + noise[3] I^3 (read-out; photons; grain of all paint, of white paint alone).
    """

    difference: Tensor  # (C, K), white less black paint, grey levels
    black: Tensor  # (C, K)
    noise: Tensor  # (C, 4), grey levels^2 .. 1 / grey level
    known: bool  # False: nothing learnt yet, difference is 1 everywhere and black 0

    @cached_property
    def _map(self) -> Tensor:
        """Difference and black over the square about the disk, (C * S * S, 2): a look-up beats 25 functions."""
        at = (torch.arange(MAP_SIDE, dtype=torch.float32, device=self.difference.device) + 0.5) * (2.0 / MAP_SIDE) - 1.0
        y, x = torch.meshgrid(at, at, indexing="ij")
        across = torch.stack([x, y]).reshape(2, -1)
        # Cells that the limb cuts take their value on the disk.
        across = across / across.norm(dim=0).clamp_min(1.0)
        basis = light_basis(across)
        return torch.stack([self.difference @ basis, self.black @ basis], dim=-1).reshape(-1, 2)

    def at(self, across: Tensor) -> tuple[Tensor, Tensor]:
        """Return difference and black (L, P) each at places (L, 2, P), the C cameras of a pose next to each other."""
        cameras = len(self.difference)
        column, row = ((across + 1.0) * (0.5 * MAP_SIDE)).to(torch.int32).clamp_(0, MAP_SIDE - 1).unbind(1)
        camera = torch.arange(len(across), device=across.device, dtype=torch.int32) % cameras
        cell = (camera[:, None] * MAP_SIDE + row) * MAP_SIDE + column
        found = self._map.index_select(0, cell.reshape(-1)).to(across.dtype)
        return found[:, 0].reshape(cell.shape), found[:, 1].reshape(cell.shape)

    def to(self, device: torch.device) -> Light:
        """Return the same on another device."""
        parts = (part.to(device) for part in (self.difference, self.black, self.noise))
        difference, black, noise = parts
        return Light(difference=difference, black=black, noise=noise, known=self.known)

    def of(self, camera: int) -> Light:
        """Return the light of one camera."""
        one = slice(camera, camera + 1)
        return Light(difference=self.difference[one], black=self.black[one], noise=self.noise[one], known=self.known)

    @classmethod
    def unknown(cls, cameras: int, noise: Tensor) -> Light:
        """Return flat light, from which the first fits begin."""
        count = light_basis(torch.zeros(1, 2, 1)).shape[-2]
        difference = torch.zeros(cameras, count)
        difference[:, 0] = 1.0
        return cls(difference=difference, black=torch.zeros(cameras, count), noise=noise, known=False)


def light_sums(view: View, pixels: Pixels, precision: Tensor) -> tuple[Tensor, Tensor]:
    """Return one batch's share of the normal equations of light maps, (L, 2 K, 2 K) and (L, 2 K) float64.

    Args:
        view: of L disks at their poses.
        pixels: of these disks.
        precision: (L, P), weight over variance of each pixel.
    """
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
    """Learn how noise grows with brightness, (4,): coefficients of its variance, none of them negative.

    Args:
        model: (N,) grey levels expected.
        residual: (N,) grey levels.
        inside: (N,) bool, pixels that count.
    """
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
