"""The choice of a movie's light: in the lab, unless maps of each disk explain the pictures better."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.pose.fitter import Fitter, logs_left
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.lights.lab import LabLight, lab_light
from sphereorient.pose.model import Light, even_light
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses

KINDS: tuple[type[Light], ...] = (DiskLight, LabLight)
FEWEST_LIT = 8  # rows of poses from which the light in the lab is learnt
TURNED_RAD = 0.2  # mean angle between them, as wide as the finest details of light; with less, light absorbs paint
# Shares of the variance: allowed excess of the light in the lab; difference below which two lights count as equal.
CHANGED, ALIKE = 0.01, 0.05

Rivals = tuple[FittedPoses, FittedPoses, Tensor] | None  # fits of the same pictures by two models, and `use` (B, C)


def light_of(parts: Mapping[str, Tensor], known: bool) -> Light:
    """Return the light made of tensors by name, `Light.parts` or a file's; older files lack some."""
    parts = {**even_light(len(parts["noise"])), **parts}
    kind = next((kind for kind in KINDS if parts.keys() >= set(kind.names())), DiskLight)
    return kind(known=known, **{name: parts[name] for name in kind.names()})


def lit_in_the_lab(fitter: Fitter, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Fitter, FittedPoses, Rivals]:
    """Return a fitter with one light in the lab for all cameras, and its fit, unless maps of the disks explain more:
    the light in the lab has fewer unknowns, and hardly any that resemble a rotation of the ball.
    Both are learnt from every other row of `use` (B, C) and compared by their residuals in the other rows. Return also
    the fits of these rows by both if the residuals are about equal.
    """
    R = fit.R_lab_body
    if len(use) < FEWEST_LIT or so3.geodesic_distance(R[:, None], R).mean() < TURNED_RAD:
        return fitter, fit, None
    every = torch.arange(len(use))
    learning, held = (some_of(rows, pixels, fit, use) for rows in (every[::2], every[1::2]))
    maps, lit = fitter.with_light_of(*learning), replace(fitter, light=lab_light(*learning, fitter.model()))
    by_maps, by_lit, held_use = maps.again(*held), lit.again(*held), held[2]
    gain = float((logs_left(by_maps, held_use) - logs_left(by_lit, held_use)).mean())
    rivals = (by_maps, by_lit, held_use) if abs(gain) < ALIKE else None
    if gain < -CHANGED:
        return fitter, fit, rivals
    for _ in range(3):  # the poses were fitted with the maps, too
        lit = lit.with_light_of(pixels, fit, use)
        fit = lit.again(pixels, fit, use)
    return lit, fit, rivals


def some_of(rows: Tensor, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Pixels, FittedPoses, Tensor]:
    """Return some rows of poses, their B * C disks and `use` (B, C), by index."""
    cameras = use.shape[1]
    return pixels.where((rows[:, None] * cameras + torch.arange(cameras)).reshape(-1)), fit.of(rows), use[rows]
