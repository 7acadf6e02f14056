"""Whether the cameras see one sphere at one position, and which poses are used to estimate the appearance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, compress, permutations

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.comparison import Seen, limits_of
from sphereorient.calibration.contradictions import compare_cameras, majority
from sphereorient.cameras import perspective_centre_lab_mm, triangulate
from sphereorient.errors import ExperimentError, Reason, refusal
from sphereorient.follow.appearance.presence import no_sphere_error, proven, seldom
from sphereorient.follow.initialise import Initialiser
from sphereorient.locate import Frame
from sphereorient.pose.camera_view import Picture, widest_px
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart, best_poses, pose_table

TRIED = 6  # frames
APART_GAIN = 1.5  # cameras whose unexplained variance together is this many times that alone are tracked separately
APART_PX = 0.4  # distance of lines of sight from which light is estimated from each camera alone
FAR_APART_PX = 1.5  # distance from which no pose fits all cameras
FEWEST_BOTH = 4  # least number of frames of two cameras for their usual disagreement
TORN = (Reason.OUTLINE, Reason.LOW_SCORE)  # a camera that sees the sphere elsewhere than the other


@dataclass(frozen=True, kw_only=True, eq=False)
class ProvenPoses:
    """The B poses used to estimate the appearance, and whether the cameras agree."""

    found: Sequence[Poses]  # of all frames: all cameras together, or each alone, one camera after the other
    frame: list[int]  # of each of the B poses
    poses: tuple[Tensor, Tensor, Tensor]  # positions (B, 3), lab, mm, rotations (B, 3, 3) and use (B, C)
    camera: list[int] | None = None  # of each of the B poses, if each camera is used alone
    together: bool = True  # whether the cameras see the sphere at one position

    @property
    def rows(self) -> list[int]:
        """Indices of the B poses in `found`."""
        if self.camera is None:
            return self.frame
        frames = len(self.found) // self.poses[2].shape[1]
        return [camera * frames + frame for frame, camera in zip(self.frame, self.camera, strict=True)]

    def majority(self, fitter: Fitter, fit: FittedPoses) -> tuple[int, ...]:
        """Return the cameras that agree if they are more than half of at least three; `fit`: of the B poses."""
        if self.together or self.camera is None:
            return ()
        parts = []
        for part in (fit.position_lab_mm, fit.R_lab_body, fit.covariance[:, :3, :3]):
            whole = part.new_full((max(self.frame) + 1, len(fitter.views), *part.shape[1:]), torch.nan)
            whole[torch.tensor(self.frame), torch.tensor(self.camera)] = part
            parts.append(whole)
        X, R, covariance = parts
        seen = _seen_alone(fitter, X, R)
        return majority(seen, limits_of(seen, covariance))


def proven_poses(found: Sequence[Poses]) -> ProvenPoses:
    """Return the proven poses of all cameras together.

    Raises:
        ExperimentError: no pose is proven.
    """
    rows = proven(found)
    if not rows:
        raise no_sphere_error(found)
    return ProvenPoses(found=found, frame=rows, poses=best_poses([found[k] for k in rows]))


def agreeing_poses(search: Initialiser, frames: Sequence[Sequence[Frame]], found: Sequence[Poses]) -> ProvenPoses:
    """Return the proven poses of n frames: of all cameras together, or of each alone if they disagree or prove hardly
    any frame together. A pose between disagreeing cameras would give a wrong light.

    Raises:
        ExperimentError: no pose is proven, or the cameras contradict each other too much for any measurement.
    """
    fitter = search.fitter
    if len(fitter.views) == 1 and not proven(found):
        raise no_sphere_error(found)
    gain, gap_px = _apart(fitter, [[shot.picture for shot in frame] for frame in frames], found)
    if gain <= APART_GAIN and gap_px <= APART_PX and not (len(fitter.views) > 1 and seldom(found)):
        return proven_poses(found)
    alone = [replace(search, fitter=fitter.of(k)) for k in range(len(fitter.views))]
    each = [one.all_poses([[frame[k]] for frame in frames]) for k, one in enumerate(alone)]
    _check_cameras(fitter, each)
    seen = [(frame, camera) for camera, of_camera in enumerate(each) for frame in proven(of_camera)]
    if not seen or not proven(found):
        raise no_sphere_error(found)
    frame, camera = (list(one) for one in zip(*seen, strict=True))
    X, R, _ = best_poses([each[c][k] for k, c in seen])
    use = torch.nn.functional.one_hot(torch.tensor(camera), len(each)).bool()
    return ProvenPoses(
        found=[poses for of_camera in each for poses in of_camera],
        frame=frame,
        poses=(X, R, use),
        camera=camera,
        together=gain <= APART_GAIN and gap_px <= FAR_APART_PX,
    )


def _check_cameras(fitter: Fitter, alone: Sequence[Sequence[Poses]]) -> None:
    """Raise ExperimentError if the cameras contradict each other too much for any measurement, and no majority agrees;
    `alone`: poses by camera and frame.
    """
    parts = []
    for of_camera in alone:
        clear = torch.tensor([0 if k in proven(of_camera) else -1 for k in range(len(of_camera))])
        best = pose_table(of_camera, 1).rows(clear)
        parts.append((best["position_lab_mm"], best["R_lab_body"], best["covariance"][:, :3, :3]))
    X, R, covariance = (torch.stack(part, 1) for part in zip(*parts, strict=True))
    seen = _seen_alone(fitter, X, R)
    limits = limits_of(seen, covariance)
    found = compare_cameras(seen, limits)
    if found.deadly and not majority(seen, limits):
        expected = "cameras that agree"
        raise ExperimentError(refusal("movies", expected=expected, got=str(found), do=found.advice))


def _seen_alone(fitter: Fitter, position_lab_mm: Tensor, R_lab_body: Tensor) -> Seen:
    """Return poses (N, C, 3), (N, C, 3, 3) of each camera alone as observations in its pictures."""
    views = list(enumerate(fitter.views))
    return Seen(
        cameras={view.name: view.camera for view in fitter.views},
        centre_px=torch.stack([view.camera.project(position_lab_mm[:, k]) for k, view in views], 1),
        radius_px=torch.stack([view.radius_px(position_lab_mm[:, k], fitter.radius_mm) for k, view in views], 1),
        R_lab_body=R_lab_body,
        diameter_mm=2 * fitter.radius_mm,
    )


def usual_apart_rad(fit: FittedPoses, use: Tensor) -> float:
    """Return the median angle between the rotations of two cameras that see the sphere together; inf without any."""
    angles = [
        (fit.own_turn[:, k] - fit.own_turn[:, m]).norm(dim=-1)[use[:, k] & use[:, m]]
        for k, m in combinations(range(use.shape[1]), 2)
    ]
    both = torch.cat([torch.zeros(0, dtype=torch.float64), *angles])
    return float(both.median()) if len(both) >= FEWEST_BOTH else math.inf


def limb_px(fitter: Fitter, fit: FittedPoses, use: Tensor) -> Tensor:
    """Return the outward error of the limb against its position by all cameras, (C,), px: the median of B poses.
    Causes: wrong diameter, glare, glass missing in the camera model. 0 with fewer than `FEWEST_BOTH` poses.
    """
    found = torch.zeros(len(fitter.views), dtype=torch.float64)
    for k, view in enumerate(fitter.views):
        shared = use[:, k] & (use.sum(1) > 1)
        to_centre = fit.position_lab_mm - perspective_centre_lab_mm(view.camera, fit.position_lab_mm)
        nearer = -(fit.own_move[:, k] * to_centre).sum(-1) / to_centre.square().sum(-1)
        if int(shared.sum()) >= FEWEST_BOTH:
            found[k] = (nearer * view.radius_px(fit.position_lab_mm, fitter.radius_mm))[shared].median()
    return found


def _apart(fitter: Fitter, pictures: Sequence[Sequence[Picture]], found: Sequence[Poses]) -> tuple[float, float]:
    """Measure on a few frames whether the cameras see one sphere at one position.
    Return, for the worst quarter of frames, the unexplained variance of all cameras together over that of each alone,
    and the distance between the lines of sight, px. The first is 1 if the cameras differ by less than `APART_PX` (px of
    the picture) in lines of sight, rotation and size: alone, each camera also fits the errors of its model. Rotations
    that differ by less than their errors are ignored: a small disk determines them poorly.
    """
    cameras = len(fitter.views)
    sure = proven(found)
    if not sure:  # wrong cameras spoil every joint pose
        return math.inf, math.inf
    whole = [k for k in sure if bool(found[k].use.all())]
    showing = {k: _showing(fitter, found[k]) for k in sure}
    torn = [any(why in TORN for why in compress(found[k].reason, shown)) for k, shown in showing.items()]
    if len(whole) < sum(torn):  # a camera that should see it sees it elsewhere or not at all
        return math.inf, math.inf
    if cameras == 1 or not whole:
        return 1.0, 0.0
    whole = [k for k in whole if all(showing[k])] or whole
    tried = [whole[int(k)] for k in torch.linspace(0, len(whole) - 1, min(TRIED, len(whole))).round()]
    gains, rays, alone, covariance_rad2 = [], [], [], []
    for camera, view in enumerate(fitter.views):
        only = torch.zeros(len(tried), cameras, dtype=torch.bool)
        only[:, camera] = True
        X, R, _ = best_poses([found[k] for k in tried])
        steps = ((fitter.optics.middle, 3, 3), (fitter.optics.fine, 4, 3))
        fit = fitter.fit_through(steps, [pictures[k] for k in tried], PoseStart(X, R, only))
        X, R = fit.position_lab_mm, fit.R_lab_body
        joint = torch.cat([found[k].score[:1, camera] for k in tried])
        gains.append((1 - joint) / (1 - fit.score[:, camera]).clamp_min(1e-6))
        rays.append(view.camera.rays(view.camera.project(X)))
        alone.append((view.camera, X, R))
        covariance_rad2.append(so3.trace(fit.covariance[:, :3, :3]))
    gap_mm = torch.stack([triangulate(one, other)[1] for one, other in combinations(rays, 2)]).amax(0)
    radius_px = widest_px(fitter.views) / 2
    gap_px = gap_mm * (radius_px / fitter.radius_mm)
    others_px = []
    for k, m in combinations(range(cameras), 2):
        turn = so3.geodesic_distance(alone[k][2], alone[m][2])
        apart = turn > (covariance_rad2[k] + covariance_rad2[m]).sqrt()
        others_px.append(turn * apart * radius_px)
    for (one_camera, X, _), (_, Y, _) in permutations(alone, 2):
        centre = perspective_centre_lab_mm(one_camera, X)
        sight = torch.nn.functional.normalize(X - centre, dim=-1)
        # Distance by the other camera's line of sight, and by the size of this camera's picture.
        others_px.append((((Y - X) * sight).sum(-1) / (X - centre).norm(dim=-1)).abs() * radius_px)
    differ_px = float(torch.stack([gap_px, *others_px]).amax(0).quantile(0.75))
    gain = float(torch.stack(gains).amax(0).quantile(0.75)) if differ_px > APART_PX else 1.0
    return gain, float(gap_px.quantile(0.75))


def _showing(fitter: Fitter, poses: Poses) -> list[bool]:
    """Return which cameras should show the whole disk of a sphere at its best pose."""
    X = poses.position_lab_mm[:1]
    return [
        bool(view.shows_whole(view.camera.project(X), view.radius_px(X, fitter.radius_mm)).all())
        for view in fitter.views
    ]
