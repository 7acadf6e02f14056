"""The precise method: appearance of the movie, pose after pose, the most likely path, its motion; for K balls."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import motion
from sphereorient.assemble import Chosen, PathLayer
from sphereorient.assemble.identity import same_balls
from sphereorient.errors import ExperimentError, Reason, refusal
from sphereorient.files.threads import Progress
from sphereorient.follow.appearance import Appearance, estimate_appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.fixed_centre import find_fixed_centre
from sphereorient.follow.follower import Follower, PerCameraTracker, sample_frames
from sphereorient.follow.tracker import Tracker
from sphereorient.methods import results
from sphereorient.methods.method import Followed, Job, Joined, Learnt, Method
from sphereorient.methods.paint import alike, following, open_paints, paint_samples
from sphereorient.methods.proposers import BlurMatchedSearch
from sphereorient.pose.poses import PoseTable, exchanged, pose_tables
from sphereorient.trajectory import Trajectory

Floats = NDArray[np.float64]


def learn(job: Job, progress: Progress) -> Follower:
    """Estimate backgrounds, and blur, light and noise of each paint, from frames spread over the movies."""
    _check(job)
    recording, refine, exposure_s = job.recording, job.settings.refine, exposure_of(job)
    paints = open_paints(job, progress)
    progress("appearance", 0, 1)
    appearances: dict[str, Appearance] = {}
    for paint, sample in zip(paints, paint_samples(recording, refine, paints), strict=True):
        beside = following(recording, sample, exposure_s)
        one = estimate_appearance(sample.first, sample.frames, paint.base, refine, beside, sample.among)
        appearances |= dict.fromkeys(paint.names, one)
    progress("appearance", 1, 1)
    searches = {name: paint.search for paint in paints for name in paint.names}
    found = follower(job, {name: appearances[name] for name in recording.experiment.names}, searches)
    return replace(found, appearances={name: _of_place(found, name) for name in found.appearances})


def _of_place(found: Follower, name: str) -> Appearance:
    """Return the appearance of a ball with the error of its fixed centre, if it has one, in all frames."""
    one, ball = found.appearances[name], found.tracker.balls.get(name)
    centre = None if ball is None else ball.centre
    return one if centre is None else replace(one, lasting=one.lasting.with_place(centre.lasting))


def resume(job: Job, learnt: Mapping[str, Learnt]) -> Follower:
    """Return the follower of `learn`, from learnt results of another run or process."""
    _check(job)
    names = job.recording.experiment.names
    if set(learnt) != set(names):
        do = "pass a file of this experiment"
        got, expected = ", ".join(sorted(learnt)), ", ".join(names)
        raise ExperimentError(refusal("learnt", expected=f"learnt results of {expected}", got=got, do=do))
    appearances = {name: learnt[name].appearance(job.recording.of(name)) for name in names}
    searches: dict[str, BlurMatchedSearch] = {}
    for same in alike(job.recording):
        sizes = [(view.camera, view.diameter_px) for view in appearances[same[0]].fitter.views]
        searches |= dict.fromkeys(same, BlurMatchedSearch(job.recording.of(same[0]).texture, job.settings, sizes))
    return follower(job, appearances, searches)


def follower(job: Job, appearances: Mapping[str, Appearance], searches: Mapping[str, BlurMatchedSearch]) -> Follower:
    """Choose the follower: all balls in all cameras together, or each camera alone if they disagree."""
    balls: dict[str, BallTracker] = {}
    for name, one in appearances.items():
        begin = searches[name].start(one.still, one.fitter.optics.blur_px, score_min=one.clear_score)
        if not one.together:
            apart = PerCameraTracker(name, one.on(job.device), begin, job.settings.refine)
            return Follower(recording=job.recording, appearances=appearances, tracker=apart)
        centre = None
        if job.recording.of(name).experiment.fixed:
            frames, _ = sample_frames(job.recording, one.fitter.views, job.settings.refine.appearance_frames)
            centre = find_fixed_centre(begin, frames, one.score_min)
        balls[name] = BallTracker(one.on(job.device), begin, job.settings.refine, exposure_of(job), centre)
    return Follower(recording=job.recording, appearances=appearances, tracker=Tracker(balls))


def exposure_of(job: Job) -> float:
    """Return the exposure, s; 0 if it is unknown, or if the given blur includes its motion."""
    return 0.0 if job.settings.refine.blur_px is not None else job.recording.experiment.exposure_s or 0.0


def join(job: Job, follower: Follower | None, measured: Iterable[Followed], progress: Progress) -> dict[str, Joined]:
    """Choose each ball's path through the candidates of all frames and smooth it; return track and learnt results.
    Balls of the same paint keep their names over the movie.
    """
    assert follower is not None  # `learn` and `resume` return one
    tables = pose_tables(measured, follower.appearances, len(job.recording.streams))
    found: dict[str, Joined] = {}
    for names in alike(job.recording):
        own, sure = _named([tables[name] for name in names], job, follower)
        for name, table, certain in zip(names, own, sure, strict=True):
            track, learnt = join_ball(job.of(name), follower.appearances[name], table)
            found[name] = results.with_identity(track, certain), learnt
    return {name: found[name] for name in follower.appearances}


def join_ball(job: Job, appearance: Appearance, table: PoseTable) -> tuple[Trajectory, Learnt]:
    """Join the poses of one ball, as `join`."""
    clock, settings = job.recording.clock, job.settings
    given = None if job.given is None else job.given[job.recording.experiment.sphere.name]
    path = settings.path
    if given is not None and given.acceleration_rad_s2 is not None:
        path = path.model_copy(update={"acceleration_rad_s2": given.acceleration_rad_s2})
    # The mean variance over the axes: false candidates are degrees away.
    variance = table.covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).mean(-1)
    chosen: Chosen = PathLayer(2, settings=path)(table.R_lab_body, -table.nll, clock, variance, table.mask)
    chosen = results.with_map_odds(chosen, table, appearance.map_log_odds, path.probability_min)
    picked = table.rows(chosen.choice)
    poses = motion.MeasuredPoses(
        time_s=clock,
        position_lab_mm=picked["position_lab_mm"],
        position_cov_mm2=picked["covariance"][:, 3:, 3:],
        R_lab_body=picked["R_lab_body"],
        orientation_cov_rad2=picked["covariance"][:, :3, :3],
        segment=chosen.segment,
        # All positions of a fixed ball are one estimate, so its path adds no information.
        coupling=None if job.recording.experiment.fixed else picked["covariance"][:, :3, 3:],
    )
    first, second = torch.combinations(torch.arange(len(job.recording.streams)), 2).unbind(1)
    turn, spread = picked["own_turn"], picked["own_covariance"]
    apart, spread = turn[:, first] - turn[:, second], spread[:, first] + spread[:, second]
    counts = comparable_cameras(table)
    apart = torch.where((counts[:, first] & counts[:, second])[..., None], apart, torch.nan)
    share = motion.lasting_share(apart, spread, chosen.segment, settings.smooth.slow_share)
    smooth = settings.smooth.model_copy(update={"slow_share": share})
    smoothed = motion.smooth_motion(poses, smooth, None if given is None else given.process)
    track = results.precise_track(job.recording.experiment, clock, table, chosen, smoothed, appearance)
    return track, Learnt.of(appearance, smoothed.process, float(chosen.acceleration_rad_s2))


def comparable_cameras(table: PoseTable) -> Tensor:
    """Return the cameras (N, C) whose own rotations are compared: those in use, or, where one alone is used, also those
    that contradict it.
    """
    saw = [[why in (Reason.OK, Reason.CONTRADICTS) for why in row] for row in table.reason]
    alone = (table.use.sum(1) < 2)[:, None] & torch.tensor(saw, dtype=torch.bool).reshape(table.use.shape)
    return table.use | alone


def _named(tables: Sequence[PoseTable], job: Job, follower: Follower) -> tuple[Sequence[PoseTable], Sequence[Floats]]:
    """Give K balls that look alike consistent names in all frames; return the certainty, see `same_balls`."""
    if len(tables) == 1:
        return tables, [np.full(len(tables[0]), np.nan)]
    seen = np.stack([(table.mask[:, 0] & table.use.any(1)).numpy() for table in tables])
    X, R = np.zeros((*seen.shape, 3)), np.tile(np.eye(3), (*seen.shape, 1, 1))
    for k, table in enumerate(tables):
        X[k, seen[k]] = table.position_lab_mm[:, 0].numpy()[seen[k]]
        R[k, seen[k]] = table.R_lab_body[:, 0].numpy()[seen[k]]
    breaks = [end for batch in follower.batches for end in accumulate((batch.first, *batch.lengths))]
    order, sure = same_balls(X, R, seen, job.recording.clock.numpy(), breaks)
    return exchanged(tables, torch.as_tensor(order)), list(sure)


def _check(job: Job) -> None:
    spheres = job.recording.experiment.spheres
    fixed = [sphere.name for sphere in spheres if sphere.fixed]
    if fixed and not job.recording.experiment.alone:
        do = "remove `fixed`, or name this ball alone under `sphere`"
        raise ExperimentError(refusal(f"spheres.{fixed[0]}", expected="a ball that moves", got="fixed: true", do=do))


PRECISE = Method(learn=learn, resume=resume, join=join)
