"""The trajectory from the stages' results, one function per method."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.assemble import Chosen, Fused, Path
from sphereorient.calibration.contradictions import with_contradictions
from sphereorient.calibration.systematic import with_lasting_errors, with_systematic_errors
from sphereorient.cameras.response import LINEAR
from sphereorient.errors import Flag, Reason
from sphereorient.experiment import Experiment
from sphereorient.experiment.recording import Recording
from sphereorient.follow import Appearance
from sphereorient.follow.appearance import LOOK_ALIKE
from sphereorient.follow.appearance.map_odds import pose_log_odds
from sphereorient.locate import Positions, Sightings
from sphereorient.mapping import LearntMap
from sphereorient.motion import Motion, Smoothed, datasets_of, in_middle
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.lasting import Lasting
from sphereorient.pose.poses import PoseTable, turned_alone
from sphereorient.pose.worn import UNUSED_PAINT, worn_share, worn_text
from sphereorient.search import Candidates
from sphereorient.trajectory import CameraTrack, Trajectory

TWO_BALLS = (
    "two balls have this texture map: identity is uncertain, and frames are marked as ambiguous; hide one by `masks:`"
)
SHARPER = "the pictures are sharper than `exposure:` allows, so `exposure:` was ignored; correct it, or the frame rate"
WORN = (
    "the paint differs from the texture map on about {share:.0f} % of the ball and is not used there; "
    "learn the map again with `sphereorient map --init`"
)
CODED = (
    "grey levels of {name} are not proportional to the light: {found} was learnt; "
    "set `response:` if it is known (docs/movies.md)"
)
RUNAWAY = (
    "nearly every orientation explains each of {pictures} examined frames equally well: method paper expects black "
    "and white paint in even light; try `--method precise`"
)
MISSED = [str(Reason.LOW_SCORE), str(Reason.OUTLINE), str(Reason.NOT_FOUND)]  # a usable picture shows no sphere
SURE = 0.99  # probability from which a ball's name is certain
EXCESS = 6.0  # of an error over that by noise; 1.3 for rendered pictures, 4 after compression (crf 28)


def paper_camera(sightings: Sightings, candidates: Candidates, path: Path) -> CameraTrack:
    """Collect the results of one camera."""
    lost = torch.isnan(path.score)
    reason = [Reason.LOW_SCORE if why is Reason.OK and lost[k] else why for k, why in enumerate(candidates.reason)]
    return replace(
        CameraTrack.empty(len(sightings)),
        centre_px=sightings.centre_px.numpy(),
        radius_px=sightings.radius_px.numpy(),
        outline_rms_px=sightings.outline_rms_px.numpy(),
        orientation=path.R_lab_body.numpy(),
        score=path.score.numpy(),
        xi=path.xi.numpy(),
        reason=tuple(str(why) for why in reason),
        candidate_offset=candidates.offset.numpy(),
        candidate_orientation=candidates.R_lab_body.numpy(),
        candidate_score=candidates.score.numpy(),
    )


def paper_track(
    experiment: Experiment,
    clock: Tensor,
    positions: Positions,
    fused: Fused,
    moved: Motion,
    tracks: Mapping[str, CameraTrack],
) -> Trajectory:
    """Collect all results of the paper's method in a trajectory."""
    empty = _empty(experiment, clock, tracks)
    oriented = torch.isfinite(fused.R_lab_body).all(-1).all(-1)
    variance = fused.sigma_rad.square()[:, None, None] * torch.eye(3, dtype=torch.float64)
    # The weights are inverse variances. A repaired camera's own result is not the one used.
    share = {name: torch.where(fused.repaired[name], 0.0, weight) for name, weight in fused.weight.items()}
    own = {name: torch.where(one > 0, 1 / one, torch.nan)[:, None, None] * variance for name, one in share.items()}
    return replace(
        empty,
        valid=(oriented & positions.measured).numpy(),
        position=positions.position_lab_mm.numpy(),
        position_cov=positions.covariance_mm2.numpy(),
        orientation=fused.R_lab_body.numpy(),
        orientation_cov=variance.numpy(),
        **datasets_of(moved, experiment.length_unit),
        segment=fused.segment.numpy(),
        flags=(fused.flags | positions.flags).numpy().astype(np.uint32),
        cameras={name: replace(track, orientation_cov=own[name].numpy()) for name, track in tracks.items()},
    )


def precise_camera(place: int, table: PoseTable, picked: Mapping[str, Tensor], learnt: Appearance) -> CameraTrack:
    """Collect one camera's results at the chosen poses; `place`: its index in the fit, `picked`: `PoseTable.rows`."""
    view = learnt.fitter.views[place]
    frames = len(table)
    usable = torch.tensor([why[place] in (Reason.OK, Reason.CONTRADICTS) for why in table.reason], dtype=torch.bool)
    position, R = picked["position_lab_mm"] + picked["own_move"][:, place], picked["R_lab_body"]
    position = torch.where(usable[:, None], position, picked["position_lab_mm"])
    centre_px, radius_px = view.camera.project(position), view.radius_px(position, learnt.fitter.radius_mm)
    sigma_px = picked["own_sigma_mm"][:, place] * radius_px / learnt.fitter.radius_mm
    counts = table.mask.sum(-1)
    shown = usable & torch.isfinite(position[:, 0])
    where = shown[:, None, None]
    reason = [
        Reason.LOW_SCORE if why[place] is Reason.OK and not shown[k] else why[place]
        for k, why in enumerate(table.reason)
    ]
    if learnt.second_ball:
        reason = [Reason.SECOND_BALL if why is Reason.CONTRADICTS else why for why in reason]
    failed = [k for k, why in enumerate(reason) if why is Reason.LOW_SCORE]
    unknown = learnt.fitter.shows_unknown(place, picked["position_lab_mm"][failed], R[failed])
    for k in torch.tensor(failed)[unknown].tolist():
        reason[k] = Reason.UNSEEN
    return replace(
        CameraTrack.empty(frames),
        centre_px=centre_px.numpy(),
        centre_sigma_px=torch.where(shown, sigma_px, torch.nan).numpy(),
        radius_px=radius_px.numpy(),
        limb_coverage=torch.where(shown, picked["limb_coverage"][:, place], torch.nan).numpy(),
        orientation=torch.where(where, turned_alone(picked, place), torch.nan).numpy(),
        orientation_cov=torch.where(where, picked["own_covariance"][:, place], torch.nan).numpy(),
        score=picked["score"][:, place].numpy(),
        reason=tuple(str(why) for why in reason),
        candidate_offset=torch.nn.functional.pad(counts.cumsum(0), (1, 0)).numpy(),
        candidate_orientation=table.R_lab_body[table.mask].numpy(),
        candidate_score=table.score[..., place][table.mask].numpy(),
    )


def measured_track(
    experiment: Experiment, clock: Tensor, table: PoseTable, choice: Tensor, learnt: Appearance
) -> Trajectory:
    """Collect measured poses: those of a table at a choice (N,), -1 for none, without path and smoother."""
    picked = table.rows(choice)
    covariance = picked["covariance"]
    margin, angle = table.margin(choice)
    cameras = {view.name: precise_camera(k, table, picked, learnt) for k, view in enumerate(learnt.fitter.views)}
    missed = [
        missed_by(view, one.reason, torch.from_numpy(one.centre_px), torch.from_numpy(one.radius_px))
        for view, one in zip(learnt.fitter.views, cameras.values(), strict=True)
    ]
    seeing = table.use & (choice >= 0)[:, None]
    flags = fit_flags(learnt, seeing, picked["score"], picked["excess"], np.sum(missed, axis=0))
    return replace(
        _empty(experiment, clock, cameras),
        valid=(choice >= 0).numpy(),
        position=picked["position_lab_mm"].numpy(),
        position_cov=covariance[:, 3:, 3:].numpy(),
        orientation=picked["R_lab_body"].numpy(),
        orientation_cov=covariance[:, :3, :3].numpy(),
        flags=flags,
        margin=margin.numpy(),
        margin_angle=angle.numpy(),
        cameras=cameras,
    )


def precise_track(
    experiment: Experiment, clock: Tensor, table: PoseTable, chosen: Chosen, smoothed: Smoothed, learnt: Appearance
) -> Trajectory:
    """Collect all results of the precise method in a trajectory, poses at mid-exposure."""
    smoothed, move_mm = in_middle(smoothed, experiment.exposure_s or 0.0)
    track = measured_track(experiment, clock, table, chosen.choice, learnt)
    flags = chosen.flags | torch.where(smoothed.extrapolated, int(Flag.EXTRAPOLATED), 0)
    # Far from the smooth motion of all other frames.
    flags = flags | torch.where(smoothed.rejected, int(Flag.DOUBTFUL_FIT), 0)
    noticed = ((learnt.second_ball, TWO_BALLS), (learnt.sharper, SHARPER))
    provenance: dict[str, Any] = {"remarks": [text for there, text in noticed if there]}
    responses = {view.name: view.response or LINEAR for view in learnt.fitter.views}
    provenance["response"] = ", ".join(f"{name} {found}" for name, found in responses.items())
    provenance["remarks"] += [
        CODED.format(name=name, found=found)
        for name, found in responses.items()
        if name not in experiment.response and not found.linear
    ]
    if learnt.worn is not None:
        provenance["remarks"].append(WORN.format(share=100 * worn_share(learnt.worn)))
        provenance[UNUSED_PAINT] = worn_text(learnt.worn)
    return replace(
        track,
        position=track.position - move_mm.numpy(),
        position_cov=track.position_cov * smoothed.position_scale**2,
        orientation=smoothed.R_given_path.numpy(),
        orientation_cov=smoothed.cov_given_path_rad2.numpy(),
        **datasets_of(smoothed, experiment.length_unit),
        segment=chosen.segment.numpy(),
        flags=track.flags | flags.numpy().astype(np.uint32),
        provenance=provenance,
        confidence=chosen.probability.numpy(),
    )


def with_map_odds(chosen: Chosen, table: PoseTable, map_log_odds: float | None, least: float) -> Chosen:
    """Return choices whose probability includes the odds of the map; for a single frame of a segment, which no other
    confirms, also the odds against the next pose by the scores, and NaN if the map's are unknown. Less than `least` is
    ambiguous.
    """
    number, count = np.unique(chosen.segment[chosen.present].numpy(), return_counts=True)
    alone = torch.from_numpy(np.isin(chosen.segment.numpy(), number[count == 1])) & chosen.present
    against = torch.full_like(chosen.probability, torch.nan if map_log_odds is None else math.exp(-map_log_odds))
    confidence = torch.where(
        alone | torch.isfinite(against), 1 / (1 / chosen.probability + against), chosen.probability
    )
    for n in torch.nonzero(alone)[:, 0].tolist():
        score, others = table.score[n][:, table.use[n]], table.mask[n].clone()
        others[chosen.choice[n]] = False
        rivals = pose_log_odds(score[chosen.choice[n]], score[others]).sum(-1)
        confidence[n] = 1 / (1 + against[n] + torch.exp(-rivals).sum())
    ambiguous = torch.where(confidence < least, int(Flag.AMBIGUOUS), 0)
    return replace(chosen, probability=confidence, flags=chosen.flags | ambiguous)


def with_errors(
    track: Trajectory, recording: Recording, lasting: Lasting | None, *, compared: bool
) -> tuple[Trajectory, list[str]]:
    """Add the errors of calibration, of contradicting cameras, and those that last; return also remarks on the cameras.
    `compared`: whether these are compared, which takes all frames of a movie.
    """
    cameras, radius_mm = recording.cameras, recording.experiment.radius_mm
    track, remarks = with_systematic_errors(track, cameras, recording.covariance, radius_mm), list[str]()
    if compared and len(cameras) > 1:
        own_rad2 = 0.0 if lasting is None else lasting.own_rad2
        track, found = with_contradictions(track, cameras, 2 * radius_mm, recording.timeline.even, own_rad2)
        if found.contradicts:
            remarks.append(f"the cameras contradict each other ({found}): {found.advice}")
    if lasting is not None:  # last, as only noise is scaled
        track = with_lasting_errors(track, lasting.covariance, lasting.alone)
    return track, remarks


def with_identity(track: Trajectory, certain: NDArray[np.float64]) -> Trajectory:
    """Return a ball's track with the probability (N,) of its identity, NaN: never in doubt; mark uncertain frames."""
    doubtful = np.where(certain < SURE, np.uint32(Flag.IDENTITY), np.uint32(0))
    return replace(track, identity=certain, flags=track.flags | doubtful)


def missed_text(track: Trajectory) -> list[str]:
    """Return remarks on cameras that measure the sphere in no frame, one per cause."""
    cameras_of: dict[str, list[str]] = {}
    for name, lost in track.summary()["lost"].items():
        pictures = len(track) - lost.pop(Reason.MISSING, 0)
        usual = next(iter(lost), None)
        if usual not in (*MISSED, Reason.RUNAWAY) or sum(lost.values()) < pictures:
            continue
        text = f"no ball found in {pictures} frames examined"
        if usual == Reason.RUNAWAY:
            text = RUNAWAY.format(pictures=pictures)
        if usual == Reason.LOW_SCORE:
            text = f"no pose of the map explains any of {pictures} frames examined"
            text += "" if track.valid.any() else f"; {LOOK_ALIKE}"
        cameras_of.setdefault(text, []).append(name)
    return [f"{', '.join(names)}: {text}" for text, names in cameras_of.items()]


def map_track(
    experiment: Experiment, clock: Tensor, learnt: LearntMap, settings: str, provenance: Mapping[str, Any]
) -> Trajectory:
    """Return the orientations of a learnt map as a trajectory, without errors; clock: times (N,), s, of its frames."""
    names = [view.name for view in learnt.views]
    empty = _empty(experiment, clock, names, method="map", settings=settings, provenance=provenance)
    position, R = learnt.position_lab_mm, learnt.R_lab_body
    placed = torch.isfinite(position).all(1)  # photographs without paint in common with the others have only a position
    reasons = tuple(
        str(Reason.OK if valid else Reason.LOW_SCORE if there else Reason.NOT_FOUND)
        for valid, there in zip(learnt.valid.tolist(), placed.tolist(), strict=True)
    )
    cameras = {}
    for c, view in enumerate(learnt.views):
        used = learnt.valid & torch.isfinite(learnt.score[:, c])
        centre_px = torch.where(learnt.valid[:, None], view.camera.project(position.nan_to_num()), torch.nan)
        cameras[view.name] = replace(
            empty.cameras[view.name],
            centre_px=centre_px.numpy(),
            radius_px=view.radius_px(position, experiment.radius_mm).numpy(),
            orientation=torch.where(used[:, None, None], R, torch.nan).numpy(),
            score=learnt.score[:, c].numpy(),
            reason=reasons,
        )
    # Frames not used for the map.
    flags = torch.where(learnt.valid & ~learnt.fitted, int(Flag.EXTRAPOLATED), 0)
    return replace(
        empty,
        valid=learnt.valid.numpy(),
        position=position.numpy(),
        orientation=R.numpy(),
        segment=torch.where(learnt.valid, 0, -1).numpy(),
        flags=flags.numpy().astype(np.uint32),
        cameras=cameras,
    )


def _empty(experiment: Experiment, clock: Tensor, cameras: Iterable[str], **about: Any) -> Trajectory:
    known = {"frame_rate": experiment.frame_rate_hz, "experiment": experiment.name}
    known |= {"length_unit": experiment.length_unit} | about
    return Trajectory.empty(clock.numpy(), cameras=tuple(cameras), **known)


def missed_by(view: CameraView, reason: Sequence[str], centre_px: Tensor, radius_px: Tensor) -> NDArray[np.bool_]:
    """Return the frames (N,) in which a camera misses the sphere although its whole disk, centre (N, 2), radius (N,),
    px, by the other cameras, should be visible; `reason`: of the camera.
    """
    missed: NDArray[np.bool_] = np.isin(reason, MISSED) & view.shows_whole(centre_px, radius_px).numpy()
    if view.background.shown is not None:
        u, v = centre_px.numpy()[missed].round().astype(int).T
        missed[missed] = view.background.shown[v, u]
    return missed


def fit_flags(
    learnt: Appearance, use: Tensor, score: Tensor, excess: Tensor, missed: NDArray[np.integer]
) -> NDArray[np.uint32]:
    """Return flags (N,) of frames of a single camera, of poor fits, and of a movie of two balls, from use, score and
    excess (N, C) of each picture; frames without a used picture have none. If as many other cameras miss the sphere
    (`missed`, a number), half of the poses are wrong.
    """
    seen = use.numpy()
    count = seen.sum(-1)
    best = np.where(seen, score.numpy(), -np.inf).max(-1)
    # Errors so far above noise come from a wrong model, for example a wrong map.
    least = np.where(seen, excess.numpy(), np.inf).min(-1)
    outvoted = (missed > 0) & (missed >= count)
    one = (count == 1) & (use.shape[-1] > 1)
    # Without confirmation by another camera, a pose must fit as well as right poses do.
    poor = best < np.where(one, learnt.usual_score, learnt.poor_score)
    doubtful = poor | (least > EXCESS) | learnt.in_doubt | outvoted
    bits = {Flag.ONE_CAMERA: one, Flag.DOUBTFUL_FIT: doubtful, Flag.AMBIGUOUS: np.full(len(use), learnt.second_ball)}
    flags = np.zeros(len(use), np.uint32)
    for flag, where in bits.items():
        flags |= (where & (count > 0)) * np.uint32(flag)
    return flags
