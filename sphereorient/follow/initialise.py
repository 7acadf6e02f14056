"""The pose of a single frame of which nothing is known: outlines, search over all rotations, fits that narrow down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import R_cam_view
from sphereorient.follow.scan import relocalise
from sphereorient.locate import Frame, LocateSettings, find_ball, find_positions, sightings_of
from sphereorient.locate.find import Found
from sphereorient.pose.fit import Fit
from sphereorient.pose.fitter import Fitter, Picture
from sphereorient.search.crop import crop_disk
from sphereorient.search.proposer import Proposer
from sphereorient.trajectory import Reason

DISTINCT_RAD = 0.12  # fits nearer than this are the same orientation; the widest fit's basin
PLACE_SHARE = 0.03  # of the radius: how far an outline's centre may be off, dark rims included
DEPTH_SHARE = 0.08  # of the distance: how far off it may be where one outline's size alone tells it
NARROWER = (0.15, 0.06)  # deviations from the usual diameter with which outlines are looked for again
CLEARLY_LESS = 0.1  # of a picture's variance: who explains so much less than another pose is wrong, likely or not
SURE_NLL = 20.0  # by so much less likely
GAP_SHARE = 0.3  # of the radius: lines of sight that pass at a greater distance see different things


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses:
    """Distinct poses that one frame's pictures allow, most likely first; made by orient, read by the tracker.

    M poses, C cameras; M = 0 where there is none, and then `reason` says why.
    """

    position_lab_mm: Tensor  # (M, 3)
    R_lab_body: Tensor  # (M, 3, 3)
    covariance: Tensor  # (M, 6, 6), of delta (rad) and position (mm), lab
    own_turn: Tensor  # (M, C, 3), rad, see Fit
    own_covariance: Tensor  # (M, C, 3, 3)
    own_move: Tensor  # (M, C, 3), mm, see Fit
    deviation: Tensor  # (M, C)
    score: Tensor  # (M, C)
    nll: Tensor  # (M,)
    use: Tensor  # (C,) bool, cameras whose pictures count
    reason: tuple[Reason, ...]  # C

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.nll)


POSE_PARTS: tuple[str, ...] = ("position_lab_mm", "R_lab_body", "covariance", "own_turn", "own_covariance", "own_move")
POSE_PARTS += ("deviation", "score", "nll")


def poses_of(fit: Fit, chosen: Tensor, use: Tensor, reason: Sequence[Reason]) -> Poses:
    """Return some rows of a fit as the poses of one frame."""
    return Poses(**{name: getattr(fit, name)[chosen] for name in POSE_PARTS}, use=use, reason=tuple(reason))


def no_pose(cameras: int, reason: Sequence[Reason]) -> Poses:
    """Return a frame without any pose."""
    tails = {"position_lab_mm": (3,), "R_lab_body": (3, 3), "covariance": (6, 6), "own_turn": (cameras, 3)}
    tails |= {"own_covariance": (cameras, 3, 3), "own_move": (cameras, 3), "deviation": (cameras,)}
    tails |= {"score": (cameras,), "nll": ()}
    none = torch.zeros(cameras, dtype=torch.bool)
    parts = {name: torch.zeros(0, *tail, dtype=torch.float64) for name, tail in tails.items()}
    return Poses(**parts, use=none, reason=tuple(reason))


def initialise(
    fitter: Fitter,
    proposers: Mapping[str, Proposer],
    shots: Sequence[Frame],
    locating: LocateSettings,
    *,
    candidates: int,
    finalists: int = 2,
    score_min: float = 0.0,
) -> Poses:
    """Find all poses that the pictures of one instant allow.

    Args:
        fitter: with the C views.
        proposers: of their names.
        shots: C frames; those that cannot be used take no part.
        locating: how outlines are found.
        candidates: proposals of each camera that are fitted.
        finalists: poses that are fitted to all detail.
        score_min: where no picture is explained this well, outlines are looked for again, nearer to the usual size:
            black paint that hides half of a rim leaves arcs that a smaller circle fits as well.

    Returns:
        Poses, or none with the reasons.
    """
    pictures = [shot.picture for shot in shots]
    poses = _with_outlines(fitter, proposers, shots, locating, candidates, finalists)
    for tolerance in NARROWER:
        if _best_score(poses) >= score_min or not any(shot.usable for shot in shots):
            break
        narrower = locating.model_copy(update={"diameter_tolerance": min(tolerance, locating.diameter_tolerance)})
        again = _with_outlines(fitter, proposers, shots, narrower, candidates, finalists)
        poses = max(poses, again, key=_best_score)
    if _best_score(poses) < score_min and any(shot.usable for shot in shots):
        # No rim that is right: the paint itself tells where the disk is.
        scanned = [
            relocalise(shot.picture, view, proposers[view.name], locating) if shot.usable else (None, shot.reason)
            for view, shot in zip(fitter.views, shots, strict=True)
        ]
        again = _poses(fitter, proposers, pictures, scanned, candidates=candidates, finalists=finalists)
        poses = max(poses, again, key=_best_score)
    return poses


def _best_score(poses: Poses) -> float:
    return float(poses.score[0, poses.use].max()) if len(poses) else -1.0


def _with_outlines(
    fitter: Fitter,
    proposers: Mapping[str, Proposer],
    shots: Sequence[Frame],
    locating: LocateSettings,
    candidates: int,
    finalists: int,
) -> Poses:
    found = [
        find_ball(shot.picture, view.background, view.diameter_px, locating) if shot.usable else (None, shot.reason)
        for view, shot in zip(fitter.views, shots, strict=True)
    ]
    pictures = [shot.picture for shot in shots]
    ask = partial(_poses, fitter, proposers, pictures, candidates=candidates, finalists=finalists)
    use = [outline is not None for outline, _ in found]
    if all(use) and len(use) > 1 and _apart_mm(fitter, found) > GAP_SHARE * fitter.radius_mm:
        # The cameras see different things: believe the one whose picture is explained better.
        return max((ask(_only(found, k)) for k in range(len(found))), key=_best_score)
    return ask(found)


def _only(found: Sequence[Found], kept: int) -> list[Found]:
    return [one if k == kept else (None, Reason.OUTLINE) for k, one in enumerate(found)]


def _apart_mm(fitter: Fitter, found: Sequence[Found]) -> float:
    """Distance of the lines of sight to the outlines' centres."""
    seen = {view.name: sightings_of([one]) for view, one in zip(fitter.views, found, strict=True)}
    return float(
        find_positions(seen, {view.name: view.camera for view in fitter.views}, 2 * fitter.radius_mm).gap_mm[0]
    )


def _poses(
    fitter: Fitter,
    proposers: Mapping[str, Proposer],
    pictures: Sequence[Picture],
    found: Sequence[Found],
    *,
    candidates: int,
    finalists: int,
) -> Poses:
    """Search and fit, given the outlines."""
    views, reason = fitter.views, [why for _, why in found]
    use = torch.tensor([outline is not None for outline, _ in found])
    if not use.any():
        return no_pose(len(views), reason)
    seen = {view.name: sightings_of([one]) for view, one in zip(views, found, strict=True)}
    placed = find_positions(seen, {view.name: view.camera for view in views}, 2 * fitter.radius_mm)
    starts = [torch.zeros(0, 3, 3, dtype=torch.float64)]
    for view, frame, (outline, _) in zip(views, pictures, found, strict=True):
        if outline is None:
            continue
        proposer = proposers[view.name]
        disk = crop_disk(frame, outline.u_px, outline.v_px, outline.radius_px, proposer.size_px)
        proposals = proposer.propose(torch.from_numpy(disk)[None])
        ray = view.camera.rays(torch.tensor([outline.u_px, outline.v_px], dtype=torch.float64)).direction_lab
        R_lab_view = view.camera.R_cam_lab.mT @ R_cam_view(view.camera.R_cam_lab @ ray)
        starts.append(R_lab_view @ proposals.R_view_body[:candidates])
    R = torch.cat(starts)
    if not len(R):
        return no_pose(len(views), [Reason.LOW_SCORE if why is Reason.OK else why for why in reason])
    slack = torch.nan_to_num(placed.covariance_mm2[0]) + (PLACE_SHARE * fitter.radius_mm) ** 2 * torch.eye(3).double()
    if int(use.sum()) == 1:
        # Arcs of a rim that is dark in part fit a smaller circle as well, and do not know it.
        (seeing,) = (view for view, used in zip(views, use.tolist(), strict=True) if used)
        sight = seeing.camera.rays(seeing.camera.project(placed.position_lab_mm))
        along = placed.position_lab_mm[0] - sight.origin_lab_mm[0]
        slack = slack + DEPTH_SHARE**2 * along[:, None] * along
    return _narrow(fitter, pictures, placed.position_lab_mm, torch.linalg.inv(slack), R, use, reason, finalists)


def _narrow(
    fitter: Fitter,
    pictures: Sequence[Picture],
    place: Tensor,
    precision: Tensor,
    R: Tensor,
    use: Tensor,
    reason: Sequence[Reason],
    finalists: int,
) -> Poses:
    """Fit all starts to coarse detail, and the best distinct ones to finer and finer."""
    X = place.expand(len(R), 3)
    optics = fitter.optics
    # (level, every which pixel, iterations, poses kept): what is coarse needs few pixels, and the last look all.
    steps = (
        (optics.coarse, 1, 4, finalists + 1),
        (optics.middle, 3, 3, finalists),
        (optics.fine, 4, 2, finalists),
        (optics.fine, 1, 1, finalists),
    )
    for level, every, iterations, keep in steps:
        held = None if level is optics.fine else precision.expand(len(R), 3, 3)
        # All starts of a level look at the same pixels: those about the place the outlines give.
        one = fitter.pixels([pictures], place, level).thinned(every)
        pixels = one.where(torch.arange(len(one)).repeat(len(R)))
        fit = fitter.fit(pixels, X, R, use.expand(len(R), -1), level, iterations, held)
        fit = replace(fit, nll=explaining_first(fit.nll, fit.score[:, use].mean(-1)))
        chosen = distinct(fit.R_lab_body, fit.nll, keep)
        X, R = fit.position_lab_mm[chosen], fit.R_lab_body[chosen]
        place = X[:1]
    return poses_of(fit, chosen, use, reason)


def explaining_first(nll: Tensor, score: Tensor) -> Tensor:
    """Return the likelihoods (M,) of poses, those that explain clearly less of the pictures behind those that do.

    Likelihood forgives a wide scatter before it forgives worn paint or dirt: of a right pose a tenth of the pixels may
    be off by many standard deviations, of a wrong one half of them by few of larger ones.

    Args:
        nll: (M,), negative log-likelihood.
        score: (M,), share of the pictures' variance that each explains.
    """
    behind = score < score.nan_to_num(-1.0).max() - CLEARLY_LESS
    if not bool((~behind & torch.isfinite(nll)).any()):
        return nll
    last = nll[~behind & torch.isfinite(nll)].max()
    return torch.where(behind, nll.maximum(last + SURE_NLL), nll)


def distinct(R: Tensor, nll: Tensor, count: int) -> Tensor:
    """Return the indices of the most likely rotations (M, 3, 3) that are not near a likelier one, at most `count`."""
    near = so3.geodesic_distance(R[:, None], R[None]) < DISTINCT_RAD
    left = torch.isfinite(nll)
    chosen: list[int] = []
    for k in nll.argsort(stable=True).tolist():
        if left[k] and len(chosen) < count:
            chosen.append(k)
            left = left & ~near[k]
    return torch.tensor(chosen, dtype=torch.int64)
