"""The precise method: appearance of the movie, pose after pose, the most likely path, its motion."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch

from sphereorient import motion
from sphereorient.assemble import Chosen, PathLayer
from sphereorient.experiment.recording import Progress
from sphereorient.follow.appearance import Appearance, Following, estimate_appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.fixed_centre import find_fixed_centre
from sphereorient.follow.follower import Follower, PerCameraTracker, frames_at, frames_showing, sample_frames
from sphereorient.follow.initialise import UNPROVEN, Initialiser
from sphereorient.follow.poses import Poses, pose_table
from sphereorient.follow.tracker import Tracker
from sphereorient.methods import results
from sphereorient.methods.method import Job, Joined, Learnt, Measured
from sphereorient.methods.proposers import BlurMatchedSearch, open_views, sizes_of
from sphereorient.pose.blur import estimate_blur_px
from sphereorient.pose.camera_view import FIRST_BLUR_PX, defocus_radii
from sphereorient.pose.fitter import first_fitter
from sphereorient.trajectory import Trajectory


def learn(job: Job, progress: Progress) -> Follower:
    """Estimate backgrounds, blur, light and noise from frames spread over the movies."""
    recording, settings = job.recording, job.settings
    views, base, search = open_views(recording, settings, progress)
    progress("appearance", 0, 1)
    blur_px = settings.refine.blur_px or FIRST_BLUR_PX
    first = Initialiser(
        fitter=first_fitter(views, recording.experiment.radius_mm, base, blur_px),
        proposers=search.by_camera(views, blur_px),
        locating=settings.locate,
        candidates=settings.refine.candidates,
        score_min=UNPROVEN,
        known={},
    )
    assert first.known is not None
    frames, places = frames_showing(recording, views, settings.refine.appearance_frames, first.disks)
    shown = {id(shot.picture) for shots in frames for shot in shots}
    first = replace(first, known={key: one for key, one in first.known.items() if key[0] in shown})
    if settings.refine.blur_px is None:
        pairs = (pair for shots in frames for pair in zip(shots, first.disks(shots), strict=True))
        blur_px = estimate_blur_px((shot.picture, disk) for shot, disk in pairs if disk is not None)
        # Only blurred pictures need blurred templates; sharp ones share one first guess.
        if defocus_radii(blur_px, search.diameter_px):
            fitter = first_fitter(views, recording.experiment.radius_mm, base, blur_px)
            first = replace(first, fitter=fitter, proposers=search.by_camera(views, blur_px))
    following = None
    if exposure_s(job) > 0 and len(recording.clock) > 1:
        beside = [place + 1 if place + 1 < len(recording.clock) else place - 1 for place in places]
        following = Following(
            shots=lambda rows: frames_at(recording, views, [beside[k] for k in rows]),
            open_share=exposure_s(job) / (recording.clock[beside] - recording.clock[places]),
        )
    appearance = estimate_appearance(first, frames, base, settings.refine, following)
    progress("appearance", 1, 1)
    return follower(job, appearance, search)


def resume(job: Job, learnt: Mapping[str, Learnt]) -> Follower:
    """Return the follower of `learn`, from what another run or process learnt."""
    appearance = learnt[""].appearance(job.recording)
    search = BlurMatchedSearch(job.recording.texture, job.settings, sizes_of(appearance.fitter.views))
    return follower(job, appearance, search)


def follower(job: Job, appearance: Appearance, search: BlurMatchedSearch) -> Follower:
    """Choose how to follow frames: all cameras together, or one by one if they disagree."""
    settings, views = job.settings, appearance.fitter.views
    proposers = search.by_camera(views, appearance.fitter.optics.blur_px)
    begin = Initialiser(
        fitter=appearance.still,
        proposers=proposers,
        locating=settings.locate,
        candidates=settings.refine.candidates,
        score_min=appearance.clear_score,
    )
    there = appearance.on(job.device)
    tracker: Tracker | PerCameraTracker
    if appearance.together:
        centre = None
        if job.recording.experiment.fixed:
            frames, _ = sample_frames(job.recording, views, settings.refine.appearance_frames)
            centre = find_fixed_centre(begin, frames, appearance.score_min)
        ball = BallTracker(there, begin, settings.refine, exposure_s(job), centre)
        tracker = Tracker({"": ball}, ball.start)
    else:
        tracker = PerCameraTracker("", there, begin, settings.refine)
    return Follower(recording=job.recording, appearances={"": appearance}, tracker=tracker)


def exposure_s(job: Job) -> float:
    """Return how long the shutter is open, s; 0 where that is not known, or where the given blur holds its motion."""
    return 0.0 if job.settings.refine.blur_px is not None else job.recording.experiment.exposure_s or 0.0


def join(job: Job, follower: Follower | None, measured: Iterable[Measured], progress: Progress) -> dict[str, Joined]:
    """Choose the path through all frames' candidates and smooth it; return the track and what was learnt."""
    assert follower is not None  # `learn` and `resume` return one
    return {"": joined(job, follower.appearance, (poses[""] for poses in measured))}


def joined(job: Job, appearance: Appearance, measured: Iterable[list[Poses]]) -> tuple[Trajectory, Learnt]:
    """Join the poses of one ball, as `join`."""
    clock, settings = job.recording.clock, job.settings
    given = None if job.given is None else job.given[""]
    table = pose_table(measured, len(job.recording.streams))
    path = settings.path
    if given is not None and given.acceleration_rad_s2 is not None:
        path = path.model_copy(update={"acceleration_rad_s2": given.acceleration_rad_s2})
    # The mean variance over the axes: false candidates are degrees away.
    variance = table.covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).mean(-1)
    chosen: Chosen = PathLayer(2, settings=path)(table.R_lab_body, -table.nll, clock, variance, table.mask)
    picked = table.rows(chosen.choice)
    poses = motion.MeasuredPoses(
        time_s=clock,
        position_lab_mm=picked["position_lab_mm"],
        position_cov_mm2=picked["covariance"][:, 3:, 3:],
        R_lab_body=picked["R_lab_body"],
        orientation_cov_rad2=picked["covariance"][:, :3, :3],
        segment=chosen.segment,
        # Of a ball held in place all positions are one estimate: its path tells nothing more.
        coupling=None if job.recording.experiment.fixed else picked["covariance"][:, :3, 3:],
    )
    first, second = torch.combinations(torch.arange(len(job.recording.streams)), 2).unbind(1)
    turn, spread = picked["own_turn"], picked["own_covariance"]
    apart, spread = turn[:, first] - turn[:, second], spread[:, first] + spread[:, second]
    counts = table.use[:, first] & table.use[:, second] | (table.use.sum(1) < 2)[:, None]
    apart = torch.where(counts[..., None], apart, torch.nan)  # a camera that contradicts those in use does not count
    share = motion.lasting_share(apart, spread, chosen.segment, settings.smooth.slow_share)
    smooth = settings.smooth.model_copy(update={"slow_share": share})
    smoothed = motion.smooth_motion(poses, smooth, None if given is None else given.process)
    track = results.precise_track(job.recording.experiment, clock, table, chosen, smoothed, appearance)
    return track, Learnt.of(appearance, smoothed.process, float(chosen.acceleration_rad_s2))
