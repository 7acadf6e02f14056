"""Estimation of the appearance before tracking: presence, agreement, light, blur, worn paint, exposure."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from sphereorient.errors import ExperimentError
from sphereorient.follow.appearance.agreement import ProvenPoses, agreeing_poses, limb_px, proven_poses, usual_apart_rad
from sphereorient.follow.appearance.exposure import with_motion
from sphereorient.follow.appearance.light import (
    check_white,
    darkest_white,
    light_and_blur,
    without_occluders,
)
from sphereorient.follow.appearance.map_odds import FEW, map_odds
from sphereorient.follow.appearance.presence import (
    NO_BETTER,
    explained,
    find_poses,
    for_blur,
    no_better_error,
    proven,
    second_ball,
    seldom,
    with_least_merit,
)
from sphereorient.follow.appearance.record import Among, Appearance, Following, Studied, clear_of, soft
from sphereorient.follow.appearance.response import with_more_blur, with_response
from sphereorient.follow.appearance.worn import without_worn
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.settings import RefineSettings
from sphereorient.locate import Frame
from sphereorient.pose.lasting import lasting_errors
from sphereorient.pose.lights.kinds import lit_in_the_lab
from sphereorient.pose.poses import Poses
from sphereorient.sphere.texture_table import TextureTable

BLUR_FAR_OFF = 0.1  # relative error of the first blur above which its poses are not used
WIDER = 1.02  # ratio of the largest disk of all frames to that of the sampled frames


def estimate_appearance(
    first: Initialiser,
    frames: Sequence[Sequence[Frame]],
    base: TextureTable,
    settings: RefineSettings,
    following: Following | None = None,
    among: Among | None = None,
) -> Appearance:
    """Estimate light, blur (unless the settings give it) and noise from n x C frames spread over the movies. `first`
    finds poses with an assumed blur and light; `base` is the finest table of the texture. Without `following`, motion
    during the exposure counts as blur. `among`: known poses of several balls; then cameras that see another ball do not
    disagree. Raises ExperimentError: no frame has a pose, or none is better than wrong poses.
    """
    search, found, sample, odds = _chosen(for_blur(first), frames, among)
    given = settings.blur_px is not None
    others = None if among is None else among.neighbours.of(sample.frame)
    pictures = [[shot.picture for shot in frames[k]] for k in sample.frame]
    studied = light_and_blur(Studied.begun(search.fitter, base, pictures, sample.poses, others), given=given)
    studied, coded = with_response(studied, given=given)
    search = replace(search, fitter=replace(search.fitter, views=studied.fitter.views))
    if not given and (matched := _matched(search, studied)) is not None:
        # Poses from a wrong blur and light learnt at them support each other: repeat both with the estimated blur.
        with suppress(ExperimentError):  # if nothing is found, the first poses may still be right
            known = settings.model_copy(update={"blur_px": matched.fitter.optics.blur_px})
            return estimate_appearance(matched, frames, base, known, following, among)
    # Light learnt at wrong poses explains them too: use what the map explained before.
    best, wrong = explained(sample.found, sample.rows)
    studied, worn = without_worn(studied, given=given) if settings.learn_paint else (studied, None)
    still, sharper = studied, False
    if following is not None and sample.camera is None:
        studied, sharper = with_motion(studied, search, sample.frame, following, others)
    check_white(studied.fitter)
    moves = studied.fitter.instants > 1
    fitter, fit, rivals = lit_in_the_lab(studied.fitter, studied.pixels, studied.fit, studied.use)
    studied = without_occluders(replace(studied, fitter=fitter, fit=fit))
    score_min = _score_min(studied, still.right_score if moves else studied.right_score, best, wrong)
    sure = [frames[k] for k in proven(found)] if among is None else []
    alone = among is None and sample.camera is None  # one ball, all cameras together
    views = with_least_merit(search, sure, sample.poses[2]) if alone else studied.fitter.views
    fitter, fit, use = studied.fitter, studied.fit, studied.use
    most_px = WIDER * float(fitter.disks_px(fit.position_lab_mm).largest_px.max())
    fitter = replace(fitter, views=views, widest_px=most_px, limb_px=limb_px(fitter, fit, use))
    # Search all pixels: an occluder moves, a highlight missing in the light does not.
    lasting = lasting_errors(studied.pixels, fit, use, fitter.model(), with_more_blur(studied) if coded else None)
    return Appearance(
        fitter=fitter,
        still=replace(fitter, optics=still.fitter.optics, instants=1) if moves else fitter,
        lasting=lasting if rivals is None else lasting.widened(*rivals),
        score_min=score_min,
        right_score=studied.right_score,
        usual_apart_rad=usual_apart_rad(fit, use),
        together=sample.together,
        majority=sample.majority(fitter, fit),
        sharper=sharper,
        second_ball=second_ball(search, sure, len(frames)),
        worn=worn,
        map_log_odds=odds,
    )


def _chosen(
    search: Initialiser, frames: Sequence[Sequence[Frame]], among: Among | None
) -> tuple[Initialiser, list[Poses], ProvenPoses, float | None]:
    """Return the search, the poses of all frames, the poses used for the estimate, and the map's log odds, None if
    there are more than a few frames.

    Raises:
        ExperimentError: chance, or the map's mirror image, explains as much of the few frames or of the proven ones.
    """
    search, found = find_poses(search, frames) if among is None else (search, list(among.found))
    sure, few, log_odds = proven(found), len(frames) <= FEW, None
    if few or seldom(found):
        posed = [k for k, poses in enumerate(found) if len(poses)]
        some = range(len(frames)) if few else (sure or posed)[:FEW]
        odds = map_odds(search, [frames[k] for k in some], [found[k] for k in some], only=among is None)
        choices = 0 if not sure else 1 if few else math.comb(len(posed), len(sure))
        odds.check([view.name for view in search.fitter.views], choices=choices)
        log_odds = float(odds.log_odds.sum()) if few else None
    sample = agreeing_poses(search, frames, found) if among is None else proven_poses(found)
    return search, found, sample, log_odds


def _matched(search: Initialiser, studied: Studied) -> Initialiser | None:
    """Return a search with the blur that was found; None if the first guess was near, or blur holds the motion."""
    fitter, blur_px = search.fitter, studied.fitter.optics.blur_px
    if abs(blur_px / fitter.optics.blur_px - 1) <= BLUR_FAR_OFF or darkest_white(studied.fitter) is not None:
        return None
    return replace(search, fitter=fitter.with_blur(studied.paint, blur_px))


def _score_min(studied: Studied, still: float, best: float, wrong: float) -> float:
    """Return the score between wrong and right poses. `still`: the typical one with the sphere rendered at rest, as in
    a search; `best` and `wrong`: explained by the map before the light was known.

    Raises:
        ExperimentError: with the estimated light the map explains no more than a disk without paint, whose score is 0.
    """
    right = studied.right_score
    if min(right, still) < NO_BETTER:
        raise no_better_error(right, "a disk without paint")
    if right < wrong + NO_BETTER:
        # Dirt or a hidden rim spoils the estimated light: all poses explain less than before.
        wrong = right - (best - wrong)
    least = min(right, still)
    score_min = 0.5 * (least + min(wrong, least))
    # Out of focus, wrong poses explain nearly as much.
    return max(NO_BETTER, min(score_min, clear_of(right)) if soft(studied.fitter) else score_min)
