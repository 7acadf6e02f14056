"""Which light a movie has: one in the lab where that explains the pictures better than maps of each disk."""

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.lights.lab import LabLight, lab_lights
from sphereorient.pose.model import Light, even_light
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses

KINDS: tuple[type[Light], ...] = (DiskLight, LabLight)
FEWEST_LIT = 8  # rows of poses from which the light in the lab is learnt
CLEARLY_MORE = 1.0  # standard errors of the gain by which it must leave less
# Shares of the variance: by which it must leave less, or may leave more where it is preferred; within which two lights
# explain about as much; and by which it never gets less.
CHANGED, ALIKE, HOPELESS = 0.01, 0.05, 0.2

Rivals = tuple[FittedPoses, FittedPoses, Tensor] | None  # fits of the same pictures by two models, and `use` (B, C)


def light_of(parts: Mapping[str, Tensor], known: bool) -> Light:
    """Return the light that consists of tensors, `Light.parts` and others; older files lack some."""
    parts = {**even_light(len(parts["noise"])), **parts}
    kind = next((kind for kind in KINDS if parts.keys() >= set(kind.names())), DiskLight)
    return kind(known=known, **{name: parts[name] for name in kind.names()})


def lit_in_the_lab(
    fitter: Fitter, pixels: Pixels, fit: FittedPoses, use: Tensor, *, preferred: bool = False
) -> tuple[Fitter, FittedPoses, Rivals]:
    """Return a fitter with one light in the lab for all cameras, and its fit, if maps of the disks explain less.
    Both are learnt from every other row of `use` (B, C); what counts is what they leave in the pictures of the rows
    between, beside its standard error. Return the fits of these rows by both where neither explains clearly more.
    `preferred`: where it does not explain clearly less, half-way or at the end.
    """
    if len(use) < FEWEST_LIT:
        return fitter, fit, None
    every = torch.arange(len(use))
    learning, held = (some_of(rows, pixels, fit, use) for rows in (every[::2], every[1::2]))
    maps, lit = fitter.with_light_of(*learning), fitter
    maps_leave, most = maps.logs_left(*held), -math.inf
    for light in lab_lights(*learning, fitter.model()):
        lit = replace(fitter, light=light)
        gains = maps_leave - lit.logs_left(*held)
        gain, error = float(gains.mean()), float(gains.std()) / math.sqrt(len(gains))
        most = max(most, gain)
        if gain < -HOPELESS:  # half-way, too
            return fitter, fit, None
    if (most < -CHANGED) if preferred else (gain < max(CHANGED, CLEARLY_MORE * error)):
        return fitter, fit, (maps.again(*held), lit.again(*held), held[2]) if gain > -ALIKE else None
    for _ in range(4):  # the poses, too, were found with the maps
        lit = lit.with_light_of(pixels, fit, use)
        fit = lit.again(pixels, fit, use)
    return lit, fit, None


def some_of(rows: Tensor, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Pixels, FittedPoses, Tensor]:
    """Return some rows of poses, of their B * C disks, and of `use` (B, C), by index."""
    cameras = use.shape[1]
    return pixels.where((rows[:, None] * cameras + torch.arange(cameras)).reshape(-1)), fit.of(rows), use[rows]
