"""The motion of the ball during the exposure, and the instants at which it is rendered."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.follow.appearance.agreement import TRIED
from sphereorient.follow.appearance.light import light_and_blur
from sphereorient.follow.appearance.record import CLEAR, Following, Studied
from sphereorient.follow.initialise import Initialiser
from sphereorient.pose.camera_view import FINEST_PX
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.neighbours import Neighbours
from sphereorient.pose.poses import PoseStart, best_poses

LITTLE_MOTION = 0.25  # share of the blur's variance due to motion during the exposure; less counts as blur
MOST_KNOWN = 0.7  # least share of the frames with measured motion
MORE_LEFT = 0.05  # increase of the unexplained variance that proves a wrong exposure
APART_BLURS, MOST_INSTANTS = 3.0, 8  # distance of neighbouring instants of the exposure; their greatest number


def with_motion(
    studied: Studied, search: Initialiser, rows: Sequence[int], following: Following, others: Neighbours | None
) -> tuple[Studied, bool]:
    """Render the motion of B poses, of frames `rows`, during the exposure, with the rest of the blur, if that explains
    more; return also whether the pictures are sharper than this motion allows.
    """
    open_, moved = _exposed(studied, search, rows, following, others)
    if moved is None:
        return studied, False
    known = studied.use & moved.isfinite().all(1)[:, None]
    whole, pixels = (part.exposed(moved.nan_to_num(), open_.instants) for part in (studied.whole, studied.pixels))
    opened = light_and_blur(replace(studied, fitter=open_, whole=whole, pixels=pixels, use=known), given=False)
    more = opened.fitter.left(pixels, opened.fit, known) - studied.fitter.left(studied.pixels, studied.fit, known)
    return (opened, False) if more < 0 else (studied, more > MORE_LEFT)


def _exposed(
    studied: Studied, search: Initialiser, rows: Sequence[int], following: Following, others: Neighbours | None
) -> tuple[Fitter, Tensor | None]:
    """Return a fitter that renders as many instants of the exposure as B poses need, with the rest of the paint's blur,
    and their rotation and displacement (B, 6) during the exposure, NaN if unknown. If motion hardly blurs the pictures:
    the same fitter, and None. `others`: neighbours of the B poses, also for the frames next to them.
    """
    fitter, fit, use = studied.fitter, studied.fit, studied.use
    search = replace(search, fitter=fitter)

    def measured(some: Tensor) -> Tensor:
        frames = following.frames([rows[k] for k in some.tolist()])
        usable = torch.tensor([[shot.usable for shot in frame] for frame in frames])
        before, seen = fit.of(some), use[some]
        share = following.open_share[[rows[k] for k in some.tolist()]]

        def from_poses(these: Tensor, X: Tensor, R: Tensor) -> Tensor:
            pictures = [[shot.picture for shot in frames[k]] for k in these.tolist()]
            known, shown, was = seen[these], usable[these], before.of(these)
            beside = None if others is None else others.of(some[these])
            there = fitter.fit_through(fitter.optics.steps, pictures, PoseStart(X, R, known & shown, among=beside))
            right = ((1 - there.score <= CLEAR * (1 - was.score)) | ~known).all(1) & (shown | ~known).all(1)
            turn = so3.log(there.R_lab_body @ was.R_lab_body.mT)
            way = torch.cat([turn, there.position_lab_mm - was.position_lab_mm], dim=-1)
            return torch.where(right[:, None], share[these, None] * way, torch.nan)

        way = from_poses(torch.arange(len(some)), before.position_lab_mm, before.R_lab_body)
        # If the ball rotates far between frames, the next pose must be searched.
        lost = [k for k in torch.nonzero(way.isnan().any(1))[:, 0].tolist() if others is None and bool(usable[k].all())]
        found = dict(zip(lost, search.all_poses([frames[k] for k in lost]), strict=True))
        again = torch.tensor([k for k in lost if len(found[k])], dtype=torch.int64)
        if len(again):
            X, R, _ = best_poses([found[k] for k in again.tolist()])
            way[again] = from_poses(again, X, R)
        return way

    def smear_px(some: Tensor, moved: Tensor) -> Tensor:
        return (
            torch.stack([view.smear_px(fit.position_lab_mm[some], moved, fitter.radius_mm) for view in fitter.views])
            .square()
            .mean(0)
            .sqrt()
        )

    tried = torch.linspace(0, len(rows) - 1, min(TRIED, len(rows))).round().long()
    width_px = smear_px(tried, measured(tried))
    blur_px = fitter.optics.blur_px
    if not float(width_px.square().nanmean() / 12) > LITTLE_MOTION * blur_px**2:
        return fitter, None
    every = torch.arange(len(rows))
    moved = measured(every)
    width_px = smear_px(every, moved)
    if float(width_px.isfinite().double().mean()) < MOST_KNOWN:
        return fitter, None
    # The blur without the motion sets the distance of the instants.
    left_px = math.sqrt(max(blur_px**2 - float(width_px.square().nanmean()) / 12, FINEST_PX**2))
    instants = 1 + math.ceil(float(width_px.nanquantile(0.9)) / (APART_BLURS * left_px))
    fitter = fitter.with_blur(studied.paint, left_px)
    return replace(fitter, instants=min(max(2, instants), MOST_INSTANTS)), moved
