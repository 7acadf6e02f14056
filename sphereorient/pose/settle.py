"""The fit of poses that are nearly right: to some pixels, repeated where that moves them, then to all."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sphereorient.pose import compiled
from sphereorient.pose.fit import FittedPoses
from sphereorient.pose.fitter import DisksPx, Fitter, Shown
from sphereorient.pose.pixels import Pixels, thinned_places, thinned_stencil
from sphereorient.pose.start import NearStart

NEAR_RAD = 0.006  # a first step that is longer wants another one before all pixels are looked at
FIRST_EVERY = 4  # the first step of a fit looks at every fourth pixel
AGAIN = 3  # times that a fit whose last step is long goes on
MORE = 2, 3  # further iterations after a long step: of some pixels, of all


def settled(
    fitter: Fitter, frames: Sequence[Sequence[Shown]], begin: NearStart, disks_px: DisksPx | None = None
) -> FittedPoses:
    """Fit B poses to the frames of C cameras at the finest level. `disks_px`: what the fitter's method of this name
    tells of the first positions, where that is known. Where compiled code can do it, it does.
    """
    fit = _settled(fitter, frames, begin, disks_px)
    for _ in range(AGAIN):
        turn_rad = np.linalg.norm(fit.step.numpy()[:, :3], axis=-1).tolist()
        rows = [k for k, one in enumerate(turn_rad) if one > NEAR_RAD]
        if not rows:
            break
        there = begin.after(fit.position_lab_mm, fit.R_lab_body).of(torch.tensor(rows))
        _put(fit, rows, _settled(fitter, [frames[k] for k in rows], there, None))
    return fit


def _settled(
    fitter: Fitter, frames: Sequence[Sequence[Shown]], begin: NearStart, disks_px: DisksPx | None
) -> FittedPoses:
    done = _compiled(fitter, frames, begin, disks_px, first=True)
    if done is None:
        return _settled_in_torch(fitter, frames, begin, disks_px)
    fit, far = done
    if rows := [k for k, one in enumerate(far.tolist()) if one]:
        there = begin.after(fit.position_lab_mm, fit.R_lab_body).of(torch.tensor(rows))
        again = _compiled(fitter, [frames[k] for k in rows], there, None, first=False)
        assert again is not None  # as before
        _put(fit, rows, again[0])
    return fit


def _put(fit: FittedPoses, rows: Sequence[int], other: FittedPoses) -> None:
    for name, part in other.parts().items():
        getattr(fit, name)[rows] = part


def _compiled(
    fitter: Fitter, frames: Sequence[Sequence[Shown]], begin: NearStart, disks_px: DisksPx | None, *, first: bool
) -> tuple[FittedPoses, Tensor] | None:
    """Return fits, and for which poses the disks are to be cut out anew, (B,) bool."""
    if fitter.device.type != "cpu" or compiled.library() is None:
        return None
    disks_px = disks_px or fitter.disks_px(begin.position_lab_mm)
    stencil = fitter.stencil(fitter.optics.fine, fitter.widest_px)
    hidden = None
    if begin.among is not None:
        known = disks_px.spoilt
        hidden = (known or fitter.spoilt(begin.position_lab_mm, disks_px, begin.moved, begin.among)).hidden
    done = compiled.settled(
        fitter.decoded(frames, disks_px.middle_px, stencil),
        [(view.sight, view.background) for view in fitter.views],
        disks_px.middle_px,
        (thinned_stencil(stencil, FIRST_EVERY), stencil),
        None if hidden is None else (hidden[:, thinned_places(hidden.shape[1], FIRST_EVERY)], hidden),
        begin,
        fitter.fine_model,
        instants=fitter.instants,
        more=MORE,
        near_rad=NEAR_RAD,
        most_hidden=fitter.most_hidden,
        first=first,
    )
    return None if done is None else (FittedPoses(**done[0]), done[1])


def _settled_in_torch(
    fitter: Fitter, frames: Sequence[Sequence[Shown]], begin: NearStart, disks_px: DisksPx | None
) -> FittedPoses:
    fine, moved = fitter.optics.fine, begin.moved
    others = begin.among
    pixels = fitter.pixels(frames, begin.position_lab_mm, fine, fitter.widest_px, moved, disks_px, others)
    fit, far = _step(fitter, pixels.thinned(FIRST_EVERY), begin, MORE[0])
    there = begin.after(fit.position_lab_mm, fit.R_lab_body)
    if bool(far.any()):
        X = torch.where(far[:, None], there.position_lab_mm, begin.position_lab_mm)
        pixels = fitter.pixels(frames, X, fine, fitter.widest_px, moved, None, others)
    return _step(fitter, pixels, there, MORE[1], fitter.most_hidden)[0]


def _step(
    fitter: Fitter, pixels: Pixels, begin: NearStart, more: int, most_hidden: float = 0.0
) -> tuple[FittedPoses, Tensor]:
    """Take one step, and `more` from where that one was long; return also where it was, (B,) bool."""
    fine, use = fitter.optics.fine, begin.use
    precision = begin.place_precision
    if not begin.held:
        # All cameras together determine the position; for one of two the distance is better known from before.
        precision = torch.where(use.all(1)[:, None, None], 0.0, precision)
    fit = fitter.fit(pixels, begin.position_lab_mm, begin.R_lab_body, use, fine, 1, precision, most_hidden)
    turn, move = fit.step[:, :3].norm(dim=-1), fit.step[:, 3:].norm(dim=-1)
    # One camera's distances scatter; a change of its picture shows in the rotation as well.
    far = (turn > NEAR_RAD) | ((use.sum(1) > 1) & (move > NEAR_RAD * fitter.radius_mm))
    if bool(far.any()):
        on = begin.after(fit.position_lab_mm, fit.R_lab_body)
        again = fitter.fit(pixels, on.position_lab_mm, on.R_lab_body, use, fine, more, precision, most_hidden)
        fit = again.where(far, fit)
    return fit, far
