"""Which frames show the ball: poses of all sampled frames, and whether the map explains them better than chance."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.errors import ExperimentError, Reason, refusal
from sphereorient.files.threads import side_by_side
from sphereorient.follow.appearance.record import ALWAYS, clear_of, soft
from sphereorient.follow.initialise import FAINT, Initialiser
from sphereorient.locate import Frame
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.fitter import LEAST_LEFT, Fitter
from sphereorient.pose.poses import Poses, PoseStart, poses_of

BETTER = 0.1  # least excess of a proven pose's score over that of wrong poses
NO_BETTER = 0.05  # the map is refused if its best score exceeds that of wrong poses by less than this
TELLING = 2.0  # unless wrong poses have this many times the unexplained variance per picture; wrong maps: 1.6 at most
LOOK_ALIKE = "look with `sphereorient check`: another map, a mirrored movie (flip:) or swapped cameras look like this"
SELDOM = 0.25  # share of the frames with poses; fewer proven frames may be chance
RIVALS = 0.1  # share of the frames (two at least) with two disks that fit the map: there is a second ball


def for_blur(search: Initialiser) -> Initialiser:
    """Return a search that ignores outlines of pictures out of focus: the texture locates the sphere."""
    return replace(search, score_min=ALWAYS) if soft(search.fitter) else search


def find_poses(search: Initialiser, frames: Sequence[Sequence[Frame]]) -> tuple[Initialiser, list[Poses]]:
    """Find the poses of n frames; return them and the search. If outlines miss the ball, the texture locates it."""
    found = _poses_of_all(search, frames)
    if proven(found) or search.score_min >= ALWAYS:
        return search, found
    search = replace(search, score_min=ALWAYS)
    return search, _poses_of_all(search, frames)


def proven(found: Sequence[Poses]) -> list[int]:
    """Return the frames whose best pose explains every picture in use better than wrong poses do, and about as well as
    in the typical one of these frames.
    """
    best = torch.tensor([float(poses.score[0, poses.use].min()) if len(poses) else -1.0 for poses in found])
    wrong = torch.tensor([float(poses.score[1, poses.use].min()) for poses in found if len(poses) > 1])
    least = BETTER + (float(wrong.quantile(0.9)) if len(wrong) else 0.0)
    right = best[best >= least]
    if not len(right):
        return []
    least = max(least, clear_of(float(right.quantile(0.75))))
    return [k for k, score in enumerate(best.tolist()) if score >= least]


def seldom(found: Sequence[Poses]) -> bool:
    """Return whether so few of the frames with poses are proven that this may be chance."""
    return len(proven(found)) < SELDOM * sum(len(poses) > 0 for poses in found)


def explained(found: Sequence[Poses], clear: Sequence[int]) -> tuple[float, float]:
    """Return the median score of the best poses of proven frames, `clear`, and the highest typical score of wrong ones.

    Raises:
        ExperimentError: the map explains the pictures no better at the best poses than at wrong ones.
    """
    right = torch.cat([found[k].score[0][found[k].use] for k in clear])
    wrong = torch.cat([found[k].score[1:][:, found[k].use].reshape(-1) for k in clear])
    best, highest = float(right.median()), float(wrong.quantile(0.9)) if len(wrong) else 0.0
    if best < highest + NO_BETTER and _times_better(found, clear) < TELLING:
        raise no_better_error(best, "wrong poses")
    return best, highest


def no_better_error(score: float, than: str) -> ExperimentError:
    """Return the error for a map whose best poses, of this score, explain about as much as something without it."""
    got = f"best poses that explain {100 * score:.0f} % of the pictures, about as much as {than}"
    return ExperimentError(refusal("movies", expected="frames that the map explains", got=got, do=LOOK_ALIKE))


def _times_better(found: Sequence[Poses], clear: Sequence[int]) -> float:
    """Return the median ratio of the unexplained variance of second and best pose; needed for blurred pictures."""
    rows = [(found[k].score[:2], found[k].use) for k in clear if len(found[k]) > 1]
    if not rows:
        return math.inf
    left = torch.stack([(1 - score[:, use]).mean(1).clamp_min(LEAST_LEFT) for score, use in rows])
    return float((left[:, 1] / left[:, 0]).median())


def no_sphere_error(found: Sequence[Poses]) -> ExperimentError:
    """Return the error for a movie without the sphere or without a fitting pose."""
    reasons = {str(why) for poses in found for why in poses.reason} - {Reason.OK}
    why = f" ({', '.join(sorted(reasons))})" if reasons else ""
    got = f"none in {len(found)} frames looked at{why}"
    if Reason.LOW_SCORE in reasons or any(len(poses) for poses in found):
        expected, do = "frames that the map explains", LOOK_ALIKE
    else:
        expected, do = "the sphere in some frame", "check sphere.diameter and the cameras, or set locate.diameter_px"
    return ExperimentError(refusal("movies", expected=expected, got=got, do=do))


def with_least_merit(search: Initialiser, frames: Sequence[Sequence[Frame]], use: Tensor) -> list[CameraView]:
    """Return the views with the least merit of an examined blob; `use` (n, C): cameras that show the sphere."""
    views = []
    for camera, view in enumerate(search.fitter.views):
        seeing = zip(frames, use[:, camera].tolist(), strict=True)
        merits = [search.merit(frame[camera].picture, view) for frame, used in seeing if used]
        views.append(replace(view, merit_min=FAINT * min(merits) if merits else 0.0))
    return views


def second_ball(search: Initialiser, frames: Sequence[Sequence[Frame]], studied: int) -> bool:
    """Return whether so many of the `studied` frames have two disks that fit the map that there are two balls."""
    claimed = sum(count > 1 for count in side_by_side(search.claimants, frames))
    return claimed >= max(2, RIVALS * studied)


def _poses_of_all(search: Initialiser, frames: Sequence[Sequence[Frame]]) -> list[Poses]:
    """Find the poses of n frames, also in cameras that see the sphere without an outline."""
    return [_seen_by_all(search.fitter, *one) for one in zip(frames, search.all_poses(frames), strict=True)]


def _seen_by_all(fitter: Fitter, frames: Sequence[Frame], poses: Poses) -> Poses:
    """Use cameras without an outline too if one pose explains all pictures: black paint may hide a rim."""
    usable = torch.tensor([shot.usable for shot in frames])
    if not len(poses) or bool((poses.use == usable).all()):
        return poses
    pictures = [[shot.picture for shot in frames]] * len(poses)
    X, R, use = poses.position_lab_mm, poses.R_lab_body, usable.expand(len(poses), -1)
    fit = fitter.fit_through(fitter.optics.steps, pictures, PoseStart(X, R, use))
    order = fit.nll.argsort(stable=True)
    if float(fit.score[order[0], usable].min()) < clear_of(float(poses.score[0, poses.use].min())):
        return poses
    return poses_of(fit, order, usable, [Reason.OK if shot.usable else shot.reason for shot in frames])
