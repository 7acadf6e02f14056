"""Orientations to pictures: the differentiable renderer, and the table look-up that fills banks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sphereorient.errors import check_tail
from sphereorient.sphere.texture import sample_texture
from sphereorient.sphere.view import DiskView


class SphereRenderer(nn.Module):
    """Pictures of a textured sphere in a canonical view, differentiable in the orientation and in the texture.

    Args:
        texture: (H, W), W = 2 H, 0 black .. 1 white; kept as a parameter-like buffer, replaceable in `forward`.
        view: orthographic or perspective, see sphere.view; its size is the picture's.
        outside: grey of the pixels that miss the sphere.
    """

    texture: Tensor
    normal_view: Tensor

    def __init__(self, texture: Tensor, view: DiskView, outside: float = 0.0) -> None:
        super().__init__()
        self.view = view
        self.outside = outside
        self.register_buffer("texture", texture)
        self.register_buffer("normal_view", view.normal_view)

    def forward(self, R_view_body: Tensor, texture: Tensor | None = None) -> Tensor:
        """Render orientations.

        Args:
            R_view_body: (..., 3, 3), body to view frame.
            texture: (H, W), instead of the renderer's own, for gradients towards the paint.

        Returns:
            (..., S, S) pictures in the dtype of R_view_body.
        """
        return self.view.picture(self.disk(R_view_body, texture), self.outside)

    def disk(self, R_view_body: Tensor, texture: Tensor | None = None) -> Tensor:
        """Render the pixels inside the disk only, (..., P), in the order of `view.normal_view`."""
        check_tail("R_view_body", R_view_body, 3, 3)
        texture = (self.texture if texture is None else texture).to(R_view_body.dtype)
        # Rows: n_view @ R_view_body is R_view_body^T n_view, the normal in body components.
        direction_body = self.normal_view.to(R_view_body.dtype) @ R_view_body
        return sample_texture(texture, direction_body)


class DirectionTable:
    """The paint as a look-up table over direction space, for banks of templates (ten times faster than the map).

    The unit cube is cut into n^3 cells; a cell holds the paint at its middle. Differs from `SphereRenderer` only in
    pixels at the borders of patches, which is good enough for candidates and not for refinement.

    Args:
        texture: (H, W), the map; only sign(texture - 0.5) is kept.
        cells: n, cells along each axis; 128 is 1 degree, 2 MB.
    """

    def __init__(self, texture: Tensor, cells: int = 128) -> None:
        self.cells = cells
        at = (torch.arange(cells, dtype=torch.float32) + 0.5) * (2.0 / cells) - 1.0
        x, y, z = torch.meshgrid(at, at, at, indexing="ij")
        grey = sample_texture(texture.float(), torch.stack([x, y, z], dim=-1).reshape(-1, 3))
        self.paint = torch.where(grey >= 0.5, 1.0, -1.0).to(torch.int8)

    def render(self, R_view_body: Tensor, normal_view: Tensor) -> Tensor:
        """Look up many orientations.

        Args:
            R_view_body: (K, 3, 3) float32.
            normal_view: (P, 3) float32, of a `DiskView`.

        Returns:
            (K, P) int8, -1 black and +1 white.
        """
        n = self.cells
        # One product for all: rows of (R^T n) for x, y and z lie contiguous, (K, 3, P). The chunk keeps the
        # temporaries in the cache, where the whole at once spends its time on page faults.
        columns = normal_view.T.contiguous() * (0.5 * n * (1.0 - 1e-6))
        out = torch.empty((len(R_view_body), len(normal_view)), dtype=torch.int8)
        for first in range(0, len(R_view_body), 32):
            R = R_view_body[first : first + 32]
            cell = (R.mT.reshape(-1, 3) @ columns + 0.5 * n).to(torch.int32).reshape(len(R), 3, -1)
            index = (cell[:, 0] * n + cell[:, 1]) * n + cell[:, 2]
            out[first : first + 32] = self.paint.index_select(0, index.reshape(-1)).reshape(len(R), -1)
        return out
