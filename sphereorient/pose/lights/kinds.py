"""Which light a movie has: one in the lab unless maps of each disk explain the pictures better."""

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
TURNED_RAD = 0.2  # mean angle between them: the finest details of light are as wide, and of less turn they take paint
# Shares of the variance: which it may leave more, and within which two lights explain about as much.
CHANGED, ALIKE = 0.01, 0.05

Rivals = tuple[FittedPoses, FittedPoses, Tensor] | None  # fits of the same pictures by two models, and `use` (B, C)


def light_of(parts: Mapping[str, Tensor], known: bool) -> Light:
    """Return the light that consists of tensors, `Light.parts` and others; older files lack some."""
    parts = {**even_light(len(parts["noise"])), **parts}
    kind = next((kind for kind in KINDS if parts.keys() >= set(kind.names())), DiskLight)
    return kind(known=known, **{name: parts[name] for name in kind.names()})


def lit_in_the_lab(fitter: Fitter, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Fitter, FittedPoses, Rivals]:
    """Return a fitter with one light in the lab for all cameras, and its fit, unless maps of the disks explain more:
    it has fewer freedoms, and hardly any that look like a turn of the ball.
    Both are learnt from every other row of `use` (B, C); what counts is what they leave in the pictures of the rows
    between. Return the fits of these rows by both where they explain about as much.
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
    for _ in range(3):  # the poses, too, were found with the maps
        lit = lit.with_light_of(pixels, fit, use)
        fit = lit.again(pixels, fit, use)
    return lit, fit, rivals


def some_of(rows: Tensor, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Pixels, FittedPoses, Tensor]:
    """Return some rows of poses, of their B * C disks, and of `use` (B, C), by index."""
    cameras = use.shape[1]
    return pixels.where((rows[:, None] * cameras + torch.arange(cameras)).reshape(-1)), fit.of(rows), use[rows]
