"""Pictures of a turning ball for the tests: exact rotations, any paint, a light that shades."""

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.mapping.disks import Disks, normalised_disks
from sphereorient.mapping.settings import MapSettings
from sphereorient.sphere import perspective_view, sample_texture
from sphereorient.sphere.texture import random_texture

SIZE, DISTANCE = 48, 20.0
LAMP_LAB = torch.tensor([0.5, -0.6, -0.6], dtype=torch.float64)
# Two cameras at right angles: one looks along lab z, the other along lab x.
R_LAB_VIEWS = torch.tensor(
    [[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]], dtype=torch.float64
)


def pictures(R_lab_body: Tensor, cameras: int = 1, kind: str = "blobs", seed: int = 3) -> Tensor:
    """Render (N, C, S, S) of attitudes (N, 3, 3) under one lamp, noise of 1 %."""
    view = perspective_view(SIZE, DISTANCE)
    texture = random_texture(kind, seed, 128).double()
    rows = []
    for R_lab_view in R_LAB_VIEWS[:cameras]:
        normal_lab = view.normal_view.double() @ R_lab_view.T
        paint = sample_texture(texture, normal_lab @ R_lab_body)
        light = 0.5 + 0.5 * (normal_lab @ (LAMP_LAB / LAMP_LAB.norm())).clamp_min(0)
        rows.append(view.picture((20 + 150 * paint) * light))
    whole = torch.stack(rows, dim=1)
    return whole + torch.randn(whole.shape, generator=torch.Generator().manual_seed(1), dtype=whole.dtype)


def disks_of_pictures(whole: Tensor, detail: float = 0.06, window: float = 0.3) -> Disks:
    """Normalise pictures (N, C, S, S) of `pictures`."""
    count, cameras = whole.shape[:2]
    return normalised_disks(
        whole,
        R_LAB_VIEWS[:cameras].expand(count, cameras, 3, 3),
        torch.full((count, cameras), DISTANCE),
        torch.ones(count, cameras, dtype=torch.bool),
        MapSettings(detail=detail, window=window),
    )


def turning(count: int, step_deg: float, axis: tuple[float, float, float] = (0.1, 1.0, 0.2)) -> Tensor:
    """Attitudes (N, 3, 3) of a ball that rotates about one axis, the first one not the identity."""
    unit = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    angle = torch.deg2rad(torch.arange(count, dtype=torch.float64) * step_deg)
    start = so3.exp(torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64))
    return so3.exp(angle[:, None] * unit) @ start


def turns_on_both_sides(R: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """The constant rotations P and Q, (3, 3), for which P R Q is nearest to the truth; both frames are free."""
    P = Q = torch.eye(3, dtype=torch.float64)
    for _ in range(100):
        Q = so3.nearest_rotation(((P @ R).mT @ truth).mean(0))
        P = so3.nearest_rotation((truth @ (R @ Q).mT).mean(0))
    return P, Q


def error_deg(R: Tensor, truth: Tensor) -> Tensor:
    """Angles (N,), degrees, less the rotation of the body frame."""
    Q = so3.nearest_rotation((R.mT @ truth).mean(0))
    return torch.rad2deg(so3.geodesic_distance(R @ Q, truth))
