"""The grey levels that pixels of a painted ball should have: smooth in cameras, pose, paint and light, limb included.

`picture.sphere_view` is the pipeline's: single precision, its paint a table whose slopes autograd does not see. This
one is for derivatives of derivatives: slower, simpler in its optics, and differentiable twice in everything.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.cameras import Rays
from sphereorient.errors import check_tail
from sphereorient.sphere.spline_texture import sample_spline

RIM = 0.02  # of the squared depth, radii^2: the depth of a look-up on the limb is 0.1 and not 0, where its slope ends
SHADE = 0.02  # of the cosine: a lamp is as wide as a few degrees, so that the light does not end at a kink


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintedBall:
    """A ball, its paint and its light. Every tensor may require gradients; one dtype and device for all."""

    texture: Tensor  # (H, 2 H), 0 black paint .. 1 white paint
    radius_mm: float
    edge_mm: float  # standard deviation of the optics' and the pixel's blur, as long as it is at the ball
    ambient: Tensor  # (), light from everywhere
    lamps_lab: Tensor  # (K, 3), towards each lamp, as long as it is bright (Lambert)
    black: Tensor  # (), grey level of black paint in light 1
    white: Tensor  # (), grey level of white paint in light 1
    behind: Tensor  # () or of the pixels' shape, grey level without the ball


def expected_grey(rays: Rays, position_lab_mm: Tensor, R_lab_body: Tensor, ball: PaintedBall) -> Tensor:
    """Return what pixels should show.

    Args:
        rays: lines of sight of P pixels, (..., P, 3), of any camera; its parameters receive gradients through them.
        position_lab_mm: (..., 3), centre of the ball.
        R_lab_body: (..., 3, 3).
        ball: paint and light.

    Returns:
        (..., P), grey levels: shaded paint times the share of the pixel that is ball, and for the rest what is behind.
        Within about 0.1 radii of the limb the paint looked up lies a little inside the true place.

    Raises:
        ShapeError: a pose of another shape.
    """
    check_tail("position_lab_mm", position_lab_mm, 3)
    check_tail("R_lab_body", R_lab_body, 3, 3)
    normal, coverage = soft_normals(rays, position_lab_mm, ball.radius_mm, ball.edge_mm)
    paint = sample_spline(ball.texture, normal @ R_lab_body)  # rows: R_lab_body^T n, the normal in body components
    light = ball.ambient + lambert(normal, ball.lamps_lab)
    grey = (ball.black + (ball.white - ball.black) * paint) * light
    return coverage * grey + (1.0 - coverage) * ball.behind


def soft_normals(rays: Rays, position_lab_mm: Tensor, radius_mm: float, edge_mm: float) -> tuple[Tensor, Tensor]:
    """Intersect lines of sight with a ball, smoothly also where they only just hit it, or miss.

    Args:
        rays: (..., P, 3).
        position_lab_mm: (..., 3).
        radius_mm: of the ball.
        edge_mm: standard deviation of the blur at the ball.

    Returns:
        Outward unit normals (..., P, 3), lab, and the share of each pixel that is ball (..., P).
    """
    to_centre = position_lab_mm[..., None, :] - rays.origin_lab_mm
    along = (to_centre * rays.direction_lab).sum(-1, keepdim=True)
    outward = (along * rays.direction_lab - to_centre) / radius_mm  # from the centre to the line's nearest point
    depth2 = 1.0 - outward.square().sum(-1, keepdim=True)
    normal = outward - smooth_positive(depth2, RIM).sqrt() * rays.direction_lab
    normal = normal / normal.norm(dim=-1, keepdim=True)
    # Half of depth2 is the distance from the limb, in radii, near the limb; and it has no kink in the middle.
    coverage = torch.special.ndtr(0.5 * depth2[..., 0] * (radius_mm / edge_mm))
    return normal, coverage


def lambert(normal_lab: Tensor, lamps_lab: Tensor) -> Tensor:
    """Return the light (...) that surfaces with unit normals (..., 3) get from lamps (K, 3) as long as bright."""
    strength = lamps_lab.norm(dim=-1)
    cosine = normal_lab @ (lamps_lab / strength[:, None]).mT
    light: Tensor = (smooth_positive(cosine, SHADE) * strength).sum(-1)
    return light


def smooth_positive(x: Tensor, width: float) -> Tensor:
    """Return max(x, 0) with its corner rounded over about `width`; always above 0."""
    root = (x * x + width * width).sqrt()
    # The second form is the same without the difference of two nearly equal numbers.
    return torch.where(x > 0, 0.5 * (x + root), 0.5 * width * width / (root + x.abs()))
