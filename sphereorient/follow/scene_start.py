"""Search of a frame for several balls: disks, their matches over cameras, the paint of each, one assignment."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import sphere_disk_px
from sphereorient.errors import Reason
from sphereorient.follow.chunk import Ahead
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import Frame, Match, assigned, find_disks, match_disks, places_of
from sphereorient.locate.outline import Outline
from sphereorient.pose.poses import Poses, no_pose

Floats = NDArray[np.float64]
Kind = tuple[float, ...]  # the same for balls of the same paint and radius
SceneFound = Mapping[str, Poses]  # of each ball in one frame

EXPLAINED = 0.35  # of the radius: a disk with its middle this near a known ball's belongs to it
PATCHES = 40.0  # independent patches of paint on a disk
NO_PAINT = 0.65  # score from which a picture supports a paint: right ones have 0.73 to 0.98, wrong ones up to 0.6
ALIKE_RAD = 0.26  # rotations nearer than this are the same, as proposals err by some degrees
ANOTHER = 1.0  # cost of a disk with another rotation than the others of its match
NOT_SEEN = 3.0  # cost of a ball that is not found
MISSED = 4.0  # cost of a picture that should show a ball's disk but does not: else one ball counts as two
SIZE_SIGMA = 0.06  # relative, of the radius of a disk
DEPTH_SIGMA = 0.15  # relative, of a ball's distance by one camera alone
PROPOSED_RAD, PLACED_SHARE = 0.05, 0.1  # errors of proposals and, in radii, of matches beside a prediction
FREEDOM = 6.0  # of Student's distribution, for changes of motion and wrong diameters


@dataclass(frozen=True, eq=False)
class _Look:
    """A paint at a match: the gain of its log-likelihood over an unknown paint, and the rotations from which to fit."""

    gain: float
    R_lab_body: Tensor  # (M, 3, 3), best first


class SceneStart:
    """Finds balls in frames where no prediction can be fitted. `balls` are all of the scene; those with the same
    proposers and radius cannot be distinguished in a picture.
    """

    def __init__(self, balls: Mapping[str, Initialiser]) -> None:
        self.balls = dict(balls)
        views = next(iter(self.balls.values())).fitter.views
        self.cameras = {view.name: view.camera for view in views}
        self._kind = {
            name: (*(id(each) for each in one.proposers.values()), one.fitter.radius_mm)
            for name, one in self.balls.items()
        }

    def __call__(
        self,
        frames: Sequence[Frame],
        names: Sequence[str],
        known: Mapping[str, Tensor],
        past: Mapping[str, Ahead] | None = None,
    ) -> dict[str, Poses]:
        """Find the named balls in the pictures of one instant, frames of C views. `known`: positions (3,), lab, mm, of
        other balls in this frame; `past`: predictions of the named balls; without it, equal balls come in any order. A
        ball that is not found has no pose, but each camera's reason.
        """
        disks = self._unexplained(frames, known)
        matches = match_disks(disks, list(self.cameras.values()))
        looks = {self._kind[name]: self._looks(name, frames, disks, matches) for name in names}
        cost = np.stack([self._costs(name, frames, matches, looks, (past or {}).get(name)) for name in names])
        fits: dict[tuple[Kind, int], Poses] = {}
        while True:
            pairs = [(self._kind[names[row]], n, names[row]) for row, n in assigned(cost, matches)]
            for kind, n, name in pairs:
                if (kind, n) not in fits:
                    found = [
                        (disk, Reason.OK if disk else Reason.NOT_FOUND if shot.usable else shot.reason)
                        for disk, shot in zip(matches[n].disks, frames, strict=True)
                    ]
                    fits[kind, n] = self.balls[name].fitted(frames, found, looks[kind][n].R_lab_body)
            # A paint that explains the pictures in use no better than an unknown paint is wrong.
            gains = {(kind, n): _gain(fits[kind, n].score[:1, fits[kind, n].use]).sum() for kind, n, _ in pairs}
            wrong = {each for each, gain in gains.items() if not float(gain) > 0}
            if not wrong:
                break
            for row, name in enumerate(names):
                cost[row, [n for kind, n in wrong if kind == self._kind[name]]] = np.inf
        found_ = {name: fits[kind, n] for kind, n, name in pairs}
        reason = [Reason.NOT_FOUND if shot.usable else shot.reason for shot in frames]
        return {name: found_[name] if name in found_ else no_pose(len(frames), reason) for name in names}

    def _unexplained(self, frames: Sequence[Frame], known: Mapping[str, Tensor]) -> list[list[Outline]]:
        """Return the disks of each picture, without those of balls at known positions."""
        of_balls = [one.fitter.views for one in self.balls.values()]
        disks = []
        for k, shot in enumerate(frames):
            views = [views[k] for views in of_balls]
            first = next(iter(self.balls.values()))
            sizes = [view.diameter_px for view in views]
            seen = find_disks(shot.picture, views[0].background, sizes, first.locating) if shot.usable else []
            for name, X in known.items():
                middle, radius = sphere_disk_px(views[0].camera, X, self.balls[name].fitter.radius_mm)
                u, v, reach = *middle.tolist(), EXPLAINED * float(radius)
                seen = [disk for disk in seen if not math.hypot(disk.u_px - u, disk.v_px - v) < reach]
            disks.append(seen)
        return disks

    def _looks(
        self, name: str, frames: Sequence[Frame], disks: Sequence[Sequence[Outline]], matches: Sequence[Match]
    ) -> list[_Look]:
        """Return the look of a ball's paint at each match."""
        ball = self.balls[name]
        where = [(k, n) for k, seen in enumerate(disks) for n in range(len(seen))]
        proposed = ball.proposals([(k, frames[k].picture, disks[k][n]) for k, n in where])
        each = dict(zip(where, proposed, strict=True))
        return [look_of([each[k, n] for k, n in enumerate(match.chosen) if n >= 0]) for match in matches]

    def _costs(
        self,
        name: str,
        frames: Sequence[Frame],
        matches: Sequence[Match],
        looks: Mapping[Kind, Sequence[_Look]],
        ahead: Ahead | None,
    ) -> Floats:
        """Return the cost (N,) of each match for a ball: negative log-likelihood relative to not seeing it."""
        if not matches:
            return np.zeros(0)
        ball, look = self.balls[name], looks[self._kind[name]]
        places = places_of(matches, self.cameras, 2 * ball.fitter.radius_mm)
        X = places.position_lab_mm
        cost = np.array([0.5 * match.chi2 - one.gain for match, one in zip(matches, look, strict=True)]) - NOT_SEEN
        for k, (view, shot) in enumerate(zip(ball.fitter.views, frames, strict=True)):
            if shot.usable:
                place = view.camera.project(X)
                inside = ((place >= 0) & (place <= place.new_tensor(view.camera.image_size) - 1)).all(-1)
                cost += MISSED * ([match.chosen[k] < 0 for match in matches] & inside.numpy())
            radius = torch.tensor(
                [math.nan if (disk := match.disks[k]) is None else disk.radius_px for match in matches]
            )
            off = (radius / view.radius_px(X, ball.fitter.radius_mm) - 1) / SIZE_SIGMA
            alone = (2 * radius / view.diameter_px - 1) / DEPTH_SIGMA
            one = torch.tensor([match.number == 1 for match in matches])
            cost += _heavy_tailed(torch.where(one, alone, off).square().nan_to_num())
        if ahead is not None:
            R = torch.stack([one.R_lab_body[0] if len(one.R_lab_body) else ahead.R_lab_body for one in look])
            cost += _surprise(ahead, X, places.covariance_mm2, R, ball.fitter.radius_mm)
        return cost


def _gain(score: Tensor) -> Tensor:
    """Return the gain of log-likelihood of a paint over an unknown one, for scores of pictures."""
    return 0.5 * PATCHES * ((1 - NO_PAINT) / (1 - score.clamp(-1.0, 0.99))).log()


def look_of(proposed: Sequence[tuple[Tensor, Tensor]]) -> _Look:
    """Return the look of the disks of a match, each with its proposals: rotations (M, 3, 3), scores (M,)."""
    R = torch.cat([each for each, _ in proposed])
    if not len(R):
        return _Look(-math.inf, R)
    total = torch.zeros(len(R), dtype=torch.float64)
    for own, score in proposed:
        if not len(own):
            total -= ANOTHER
            continue
        alike = so3.geodesic_distance(R[:, None], own[None]) < ALIKE_RAD
        best = torch.where(alike, _gain(score.double()), -torch.inf).amax(1)
        total += torch.where(torch.isfinite(best), best, -ANOTHER)
    order = total.argsort(descending=True, stable=True)
    return _Look(float(total[order[0]]), R[order])


def _surprise(ahead: Ahead, X: Tensor, covariance_mm2: Tensor, R: Tensor, radius_mm: float) -> Floats:
    """Return negative log-likelihoods (N,) of positions (N, 3) and rotations (N, 3, 3) under a prediction."""
    away = torch.cat([so3.log(R @ ahead.R_lab_body.mT), X - ahead.position_lab_mm], dim=-1)
    spread = ahead.covariance.expand(len(X), 6, 6).clone()
    spread[:, :3, :3] += PROPOSED_RAD**2 * torch.eye(3)
    spread[:, 3:, 3:] += covariance_mm2.nan_to_num() + (PLACED_SHARE * radius_mm) ** 2 * torch.eye(3)
    chi2 = (away[:, None] @ torch.linalg.solve(spread, away[..., None]))[:, 0, 0]
    return _heavy_tailed(chi2)


def _heavy_tailed(chi2: Tensor) -> Floats:
    """Return negative log-likelihoods of chi2 (N,): half of it if small; no paint is excluded."""
    return np.asarray(0.5 * FREEDOM * torch.log1p(chi2 / FREEDOM).numpy())
