"""One fit of poses that are nearly right: to some pixels, then to all."""

from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.pose.camera_view import FrameDisks
from sphereorient.pose.fit import refine
from sphereorient.pose.model import SphereModel
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses, PoseStart, moved_to

NEAR_RAD = 0.006  # a step that is longer wants another one before more pixels are looked at
FIRST_EVERY = 4  # the first step of a fit looks at every fourth pixel
MORE = 2, 3  # further iterations after a long step: of some pixels, of all


def settle(
    disks: FrameDisks, begin: PoseStart, model: SphereModel, instants: int, most_hidden: float, first: bool
) -> tuple[FittedPoses, Tensor]:
    """Fit B poses to their disks; `first`: to every `FIRST_EVERY`-th pixel before.
    Return also which poses that moved far, (B,) bool: nothing else was done there; the disks are to be cut out anew.
    """
    pixels = moved_to(begin.R_lab_body.device, disks.pixels().exposed(begin.moved, instants))
    if not first:
        fit, far = _step(pixels, begin, model, MORE[1], most_hidden)
        return fit, torch.zeros_like(far)
    near, far = _step(pixels.thinned(FIRST_EVERY), begin, model, MORE[0])
    return near.where(far, _step(pixels, begin.after(near), model, MORE[1], most_hidden)[0]), far


def _step(
    pixels: Pixels, begin: PoseStart, model: SphereModel, more: int, most_hidden: float = 0.0
) -> tuple[FittedPoses, Tensor]:
    """Take one step, and `more` from where that one was long; return also where it was, (B,) bool."""
    use = begin.use
    if begin.place_precision is not None and not begin.held:
        # All cameras together determine the position; for one of two the distance is better known from before.
        precision = torch.where(use.all(1)[:, None, None], 0.0, begin.place_precision)
        begin = replace(begin, place_precision=precision)
    fit = refine(pixels, begin, model, 1, most_hidden)
    turn, move = fit.step[:, :3].norm(dim=-1), fit.step[:, 3:].norm(dim=-1)
    # One camera's distances scatter; a change of its picture shows in the rotation as well.
    far = (turn > NEAR_RAD) | ((use.sum(1) > 1) & (move > NEAR_RAD * model.radius_mm))
    if bool(far.any()):
        fit = refine(pixels, begin.after(fit), model, more, most_hidden).where(far, fit)
    return fit, far
