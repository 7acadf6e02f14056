"""The fixed centre of a sphere that only rotates, from a few frames; all frames are then fitted at it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import Frame
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import PoseStart, best_poses
from sphereorient.pose.residuals import EDGE_PX

ROUNDS = 10  # of robust weights
USUAL = 2.366  # median of chi squared with three degrees of freedom
FAR = 2.0  # usual distances at which a frame has half weight
FOLLOWS_EVERY = 4  # every n-th pixel, as this derivative need not be precise
ASIDE = 0.005  # of the radius: step of the finite difference
FIRM = 0.01  # of the centre's error: allowed displacement of a fit from the centre
ITERATIONS = 3  # of the fits; they start at the result of a search


@dataclass(frozen=True, kw_only=True, eq=False)
class FixedCentre:
    """Centre of a sphere in all frames."""

    position_lab_mm: Tensor  # (3,) float64
    covariance_mm2: Tensor  # (3, 3), of its error, common to all frames
    follows_rad_mm: Tensor  # (3, 3), derivative of the orientation, delta lab, by the centre: mean over frames

    @cached_property
    def spread_mm2(self) -> Tensor:
        """Covariance (3, 3) of the prior that holds fits at the centre, to FIRM of its error."""
        return FIRM**2 * self.covariance_mm2

    @property
    def precision(self) -> Tensor:
        """Inverse of `spread_mm2`, 1/mm^2."""
        inverse: Tensor = torch.linalg.inv(self.spread_mm2)
        return inverse

    @cached_property
    def lasting(self) -> Tensor:
        """Covariance (6, 6) of delta (rad) and position (mm) of all poses held here, due to the centre's error."""
        follows = torch.cat([self.follows_rad_mm, torch.eye(3, dtype=self.follows_rad_mm.dtype)])
        whole: Tensor = follows @ self.covariance_mm2 @ follows.mT
        return whole


def find_fixed_centre(search: Initialiser, frames: Sequence[Sequence[Frame]], score_min: float) -> FixedCentre | None:
    """Find the centre of a sphere that only rotates, from n x C frames and their poses of at least `score_min`.
    None if no frame has a pose supported by all of its pictures.
    """
    fitter = search.fitter
    found = search.all_poses(frames)
    rows = [k for k, one in enumerate(found) if len(one) and bool((one.score[0, one.use] >= score_min).all())]
    if not rows:
        return None
    X, R, use = best_poses([found[k] for k in rows])
    fine = fitter.optics.fine
    pixels = fitter.pixels([[shot.picture for shot in frames[k]] for k in rows], X, fine)
    fit = fitter.fit(pixels, PoseStart(X, R, use), fine, ITERATIONS)
    place, covariance = mean_place(fit.position_lab_mm, fit.covariance[:, 3:, 3:])
    return FixedCentre(
        position_lab_mm=place,
        covariance_mm2=covariance + _edge(fitter, place),
        follows_rad_mm=follows_place(fitter, pixels.thinned(FOLLOWS_EVERY), place, fit.R_lab_body, use),
    )


def follows_place(fitter: Fitter, pixels: Pixels, place: Tensor, R: Tensor, use: Tensor) -> Tensor:
    """Return the derivative (3, 3), rad/mm, of held orientations (n, 3, 3) by the centre, by finite differences."""
    aside = ASIDE * fitter.radius_mm * torch.eye(3, dtype=torch.float64)
    beyond_doubt = torch.eye(3, dtype=torch.float64).expand(len(R), 3, 3) / (FIRM**2 * ASIDE * fitter.radius_mm) ** 2

    def held_at(X: Tensor) -> Tensor:
        there = X.expand(len(R), 3)
        return fitter.fit(pixels, PoseStart(there, R, use, beyond_doubt), fitter.optics.fine, ITERATIONS).R_lab_body

    columns = [so3.log(held_at(place + by) @ held_at(place - by).mT).median(0).values for by in aside]
    return torch.stack(columns, dim=1) / (2 * ASIDE * fitter.radius_mm)


def mean_place(position_lab_mm: Tensor, covariance_mm2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the robust mean (3,) of n >= 1 independent positions (n, 3), mm, and its covariance (3, 3).
    The covariance is wider if the positions scatter more than their covariances (n, 3, 3).
    """
    X, precision = position_lab_mm.double(), torch.linalg.inv(covariance_mm2.double())
    place, weight, away = X.median(0).values, X.new_ones(len(X)), X.new_zeros(len(X))
    for _ in range(ROUNDS):
        off = X - place
        away = (off[:, None] @ precision @ off[..., None])[:, 0, 0]
        usual = (away.median() / USUAL).clamp_min(1.0)
        weight = 1 / (1 + away / (FAR**2 * USUAL * usual))
        whole = (weight[:, None, None] * precision).sum(0)
        place = torch.linalg.solve(whole, (weight[:, None, None] * precision @ X[..., None]).sum(0)[:, 0])
    count = weight.sum()
    spread = (weight * away).sum() / (3 * (count - 1)).clamp_min(1.0)
    return place, torch.linalg.inv(whole) * spread.clamp_min(1.0)


def _edge(fitter: Fitter, position_lab_mm: Tensor) -> Tensor:
    """Return the covariance (3, 3), mm^2, of a limb that is off by EDGE_PX in all frames, to one side or all around."""
    radius_px = torch.stack([view.radius_px(position_lab_mm, fitter.radius_mm) for view in fitter.views])
    aside = EDGE_PX * fitter.radius_mm / float(radius_px.min())
    covariance = aside**2 * torch.eye(3, dtype=torch.float64)
    if len(fitter.views) > 1:
        return covariance
    camera = fitter.views[0].camera
    along = position_lab_mm - camera.rays(camera.project(position_lab_mm)).origin_lab_mm
    off = along * EDGE_PX / radius_px[0]
    return covariance + off[:, None] * off
