"""Brightness of white and black paint over the disk: low-order maps per camera, estimated from the movie."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

MAP_SIDE = 256  # cells of a look-up map across the disk: a third of a pixel of an 80 px disk
ORDER, DEPTH_ORDER = 4, 3  # of the polynomials in x, y and of those times the depth sqrt(1 - x^2 - y^2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Shading:
    """Orders of the polynomials by which a frame's light may differ from the learnt one."""

    difference: int
    black: int


FIRST = Shading(difference=4, black=2)  # before the light is estimated
LATER = Shading(difference=2, black=1)


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
    """Return the basis of light maps, (..., K, P): polynomials in the normal's components, which fit grazing lamps."""
    depth = (1.0 - across.square().sum(-2)).clamp_min(0).sqrt()
    return torch.cat([polynomials(across, ORDER), polynomials(across, DEPTH_ORDER) * depth[..., None, :]], dim=-2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """Light on the disk and noise of a movie's pictures, one entry per camera; made by `learn_light`.
    A pixel of the sphere shows paint * difference + black, each a map over the disk; its noise has the variance
    noise[0] + noise[1] I + noise[2] I^2 + noise[3] I^3 (read-out; photons; grain of all paint, of white paint alone).
    """

    difference: Tensor  # (C, K), white less black paint, grey levels
    black: Tensor  # (C, K)
    noise: Tensor  # (C, 4), grey levels^2 .. 1 / grey level
    known: bool  # False: difference is 1 everywhere and black 0

    @cached_property
    def _map(self) -> Tensor:
        """Return difference and black over the square about the disk, (C * S * S, 2): a look-up beats 25 functions."""
        at = (torch.arange(MAP_SIDE, dtype=torch.float32, device=self.difference.device) + 0.5) * (2.0 / MAP_SIDE) - 1.0
        y, x = torch.meshgrid(at, at, indexing="ij")
        across = torch.stack([x, y]).reshape(2, -1)
        # Cells that the limb cuts take their value on the disk.
        across = across / across.norm(dim=0).clamp_min(1.0)
        basis = light_basis(across)
        return torch.stack([self.difference @ basis, self.black @ basis], dim=-1).reshape(-1, 2)

    def at(self, across: Tensor) -> tuple[Tensor, Tensor]:
        """Return difference and black, (L, P) each, at places (L, 2, P), the C cameras of a pose side by side."""
        cameras = len(self.difference)
        column, row = ((across + 1.0) * (0.5 * MAP_SIDE)).to(torch.int32).clamp_(0, MAP_SIDE - 1).unbind(1)
        camera = torch.arange(len(across), device=across.device, dtype=torch.int32) % cameras
        cell = (camera[:, None] * MAP_SIDE + row) * MAP_SIDE + column
        found = self._map.index_select(0, cell.reshape(-1)).to(across.dtype)
        return found[:, 0].reshape(cell.shape), found[:, 1].reshape(cell.shape)

    def to(self, device: torch.device) -> Light:
        """Return the same on another device."""
        parts = {name: getattr(self, name).to(device) for name in ("difference", "black", "noise")}
        return replace(self, **parts)

    def of(self, camera: int) -> Light:
        """Return the light of one camera."""
        one = slice(camera, camera + 1)
        return replace(self, difference=self.difference[one], black=self.black[one], noise=self.noise[one])

    @classmethod
    def unknown(cls, cameras: int, noise: Tensor) -> Light:
        """Return flat light, for the first fits."""
        count = light_basis(torch.zeros(1, 2, 1)).shape[-2]
        difference = torch.zeros(cameras, count)
        difference[:, 0] = 1.0
        return cls(difference=difference, black=torch.zeros(cameras, count), noise=noise, known=False)
