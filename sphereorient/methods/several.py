"""The precise method of several balls: the appearance of each paint, all balls in lock step, who is who."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.assemble.identity import same_balls
from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment.recording import Progress
from sphereorient.follow.appearance import Among, Appearance, Following, estimate_appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.follower import Follower, frames_at, sample_frames
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.poses import Poses, supported
from sphereorient.follow.scene_start import SceneStart
from sphereorient.follow.tracker import Tracker, among_found
from sphereorient.locate import Frame
from sphereorient.methods import precise
from sphereorient.methods.method import Job, Joined, Learnt, Measured, Method
from sphereorient.methods.proposers import BlurMatchedSearch, finest_table, open_scene, sizes_of
from sphereorient.pose import CameraView
from sphereorient.pose.camera_view import FIRST_BLUR_PX, widest_px
from sphereorient.pose.fitter import Fitter, first_fitter
from sphereorient.pose.neighbours import spoilt
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.trajectory import Flag

Floats = NDArray[np.float64]

SURE = 0.99  # probability from which a ball has its name
MOSTLY_SEEN = 0.5  # share of a disk that others must leave to each camera, of the frames that light is learnt from
MORE_FRAMES = 2  # times those of one ball: others hide it in some
WIDER = 1.03  # how much larger than in the frames looked at a disk may be in others


def learn(job: Job, progress: Progress) -> Follower:
    """Estimate backgrounds, and blur, light and noise of each paint, from frames spread over the movies."""
    if len(job.recording.experiment.spheres) == 1:
        return precise.learn(job, progress)
    _check(job)
    recording, refine = job.recording, job.settings.refine
    views = open_scene(recording, job.settings, progress)
    progress("appearance", 0, 1)
    any_views = next(iter(views.values()))
    frames, places = sample_frames(recording, any_views, MORE_FRAMES * refine.appearance_frames)
    paints = [_Paint.of(job, names, views[names[0]]) for names in alike(job)]
    first = {name: paint.first for paint in paints for name in paint.names}
    start = SceneStart(first)
    found = [start(shots, list(first), {}) for shots in frames]
    open_share = None
    if precise.exposure_s(job) > 0 and len(recording.clock) > 1:
        beside = [place + 1 if place + 1 < len(recording.clock) else place - 1 for place in places]
        open_share = precise.exposure_s(job) / (recording.clock[beside] - recording.clock[places])
    appearances: dict[str, Appearance] = {}
    for paint in paints:
        rows = _mostly_seen(paint, first, found)
        # Mixed: light is judged from halves of them, and any half should hold all balls at all times.
        rows = [rows[k] for k in np.random.default_rng(0).permutation(len(rows))]
        if not rows:
            raise ExperimentError(_none(paint.names))
        followed = None
        if open_share is not None:
            numbers = [beside[k] for k, _ in rows]
            followed = Following(
                shots=partial(_frames_of, job, any_views, numbers),
                open_share=open_share[[k for k, _ in rows]],
            )
        among_others = Among(
            found=[found[k][name] for k, name in rows],
            neighbours=among_found([(name, found[k]) for k, name in rows], first),
        )
        one = estimate_appearance(paint.first, [frames[k] for k, _ in rows], paint.base, refine, followed, among_others)
        appearances |= dict.fromkeys(paint.names, one)
    widest = WIDER * max(one.fitter.widest_px for one in appearances.values())
    known = {id(one): _as_wide(one, widest) for one in appearances.values()}
    progress("appearance", 1, 1)
    return follower(job, {name: known[id(appearances[name])] for name in recording.experiment.names})


def resume(job: Job, learnt: Mapping[str, Learnt]) -> Follower:
    """Return the follower of `learn`, from what another run or process learnt."""
    if len(job.recording.experiment.spheres) == 1:
        return precise.resume(job, learnt)
    _check(job)
    names = job.recording.experiment.names
    if set(learnt) != set(names):
        do = "pass what was learnt of this experiment"
        got, expected = ", ".join(sorted(learnt)), ", ".join(names)
        raise ExperimentError(refusal("learnt", expected=f"what was learnt of {expected}", got=got, do=do))
    return follower(job, {name: learnt[name].appearance(job.recording.of(name)) for name in names})


def follower(job: Job, appearances: Mapping[str, Appearance]) -> Follower:
    """Return what follows all balls in lock step."""
    settings = job.settings
    begin: dict[str, Initialiser] = {}
    for names in alike(job):
        one = appearances[names[0]]
        search = BlurMatchedSearch(job.recording.of(names[0]).texture, settings, sizes_of(one.fitter.views))
        begin |= {
            name: Initialiser(
                fitter=appearances[name].still,
                proposers=search.by_camera(one.fitter.views, one.fitter.optics.blur_px),
                locating=settings.locate,
                candidates=settings.refine.candidates,
                score_min=appearances[name].clear_score,
            )
            for name in names
        }
    balls = {
        name: BallTracker(one.on(job.device), begin[name], settings.refine, precise.exposure_s(job))
        for name, one in appearances.items()
    }
    return Follower(recording=job.recording, appearances=appearances, tracker=Tracker(balls, SceneStart(begin)))


def join(job: Job, follower: Follower | None, measured: Iterable[Measured], progress: Progress) -> dict[str, Joined]:
    """Join the poses of each ball as the precise method does; balls of one paint keep their names over the movie."""
    if len(job.recording.experiment.spheres) == 1:
        return precise.join(job, follower, measured, progress)
    assert follower is not None  # `learn` and `resume` return one
    frames: dict[str, list[Poses]] = {name: [] for name in follower.appearances}
    for batch in measured:
        for name, poses in batch.items():
            frames[name] += poses
    sure: dict[str, Floats] = {}
    for names in alike(job):
        if len(names) > 1:
            sure |= _named(names, frames, job, follower)
    found: dict[str, Joined] = {}
    for name, appearance in follower.appearances.items():
        track, learnt = precise.joined(job.of(name), appearance, [frames[name]])
        if name in sure:
            flags = np.where(sure[name] < SURE, np.uint32(Flag.IDENTITY), np.uint32(0))
            track = replace(track, identity=sure[name], flags=track.flags | flags)
        found[name] = track, learnt
    return found


def _named(names: Sequence[str], frames: dict[str, list[Poses]], job: Job, follower: Follower) -> dict[str, Floats]:
    """Give balls that look alike the same names in all `frames`; return how sure that is, see `same_balls`."""
    clock = job.recording.clock.numpy()
    seen = np.array([[supported(poses) for poses in frames[name]] for name in names])
    X, R = np.zeros((*seen.shape, 3)), np.tile(np.eye(3), (*seen.shape, 1, 1))
    for k, name in enumerate(names):
        for n in np.flatnonzero(seen[k]):
            X[k, n], R[k, n] = (getattr(frames[name][n], part)[0].numpy() for part in ("position_lab_mm", "R_lab_body"))
    breaks = [end for batch in follower.batches for end in accumulate((batch.first, *batch.lengths))]
    order, sure = same_balls(X, R, seen, clock, breaks)
    before = {name: frames[name] for name in names}
    for k, name in enumerate(names):
        frames[name] = [before[names[row]][n] for n, row in enumerate(order[k])]
    return dict(zip(names, sure, strict=True))


def alike(job: Job) -> list[list[str]]:
    """Return the names of the balls, those of one map and diameter together: no picture tells them apart."""
    kinds: list[list[str]] = []
    for sphere in job.recording.experiment.spheres:
        own = job.recording.of(sphere.name)
        for names in kinds:
            other = job.recording.of(names[0])
            same = own.experiment.radius_mm == other.experiment.radius_mm
            if same and torch.equal(own.texture, other.texture):
                names.append(sphere.name)
                break
        else:
            kinds.append([sphere.name])
    return kinds


def unlit(job: Job, views: Mapping[str, Sequence[CameraView]]) -> dict[str, Initialiser]:
    """Return how each ball is looked for before its light is known; balls that look alike share it."""
    paints = [_Paint.of(job, names, views[names[0]]) for names in alike(job)]
    first = {name: paint.first for paint in paints for name in paint.names}
    return {name: first[name] for name in job.recording.experiment.names}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Paint:
    """Balls that look alike, and how they are looked for before their light is known."""

    names: Sequence[str]
    base: TextureTable
    first: Initialiser

    @classmethod
    def of(cls, job: Job, names: Sequence[str], views: Sequence[CameraView]) -> "_Paint":
        one, settings = job.recording.of(names[0]), job.settings
        diameter_px = widest_px(views)
        base = finest_table(one.texture, diameter_px, one.unseen)
        blur_px = settings.refine.blur_px or FIRST_BLUR_PX
        first = Initialiser(
            fitter=first_fitter(views, one.experiment.radius_mm, base, blur_px),
            proposers=BlurMatchedSearch(one.texture, settings, sizes_of(views)).by_camera(views, blur_px),
            locating=settings.locate,
            candidates=settings.refine.candidates,
        )
        return cls(names=names, base=base, first=first)


def _mostly_seen(
    paint: _Paint, first: Mapping[str, Initialiser], found: Sequence[Mapping[str, Poses]]
) -> list[tuple[int, str]]:
    """Return frames and names of balls of a paint that the others mostly leave to all cameras that see them."""
    rows = []
    for k, there in enumerate(found):
        for name in paint.names:
            if name not in there or not len(there[name]):
                continue
            poses = there[name]
            fitter, fine = paint.first.fitter, paint.first.fitter.optics.fine
            X = poses.position_lab_mm[:1]
            middle_px, radius_px, _ = fitter.disks_px(X)
            places = fitter.places(X, fine, fitter.stencil(fine, float(radius_px)), middle_px)
            share = spoilt(places, among_found([(name, there)], first)).left[0]
            if bool((share[poses.use] > MOSTLY_SEEN).all()):
                rows.append((k, name))
    return rows


def _as_wide(one: Appearance, widest_px: float) -> Appearance:
    def wide(fitter: Fitter) -> Fitter:
        return replace(fitter, widest_px=widest_px)

    return replace(one, fitter=wide(one.fitter), still=wide(one.still))


def _frames_of(
    job: Job, views: Sequence[CameraView], numbers: Sequence[int], rows: Sequence[int]
) -> Sequence[Sequence[Frame]]:
    return frames_at(job.recording, views, [numbers[k] for k in rows])


def _none(names: Sequence[str]) -> str:
    do = "check the texture and diameter of this ball, and whether it is in view"
    return refusal(f"ball {' or '.join(names)}", expected="some frames that show it", got="none", do=do)


def _check(job: Job) -> None:
    fixed = [sphere.name for sphere in job.recording.experiment.spheres if sphere.fixed]
    if fixed:
        do = "leave `fixed` out, or name it alone under `sphere`"
        raise ExperimentError(refusal(f"spheres.{fixed[0]}", expected="a ball that moves", got="fixed: true", do=do))


PRECISE = Method(learn=learn, resume=resume, join=join)
