"""The methods on one page: the only place that knows the order.

movies -> locate -> orient -> assemble -> motion -> Trajectory
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import assemble, locate, motion, results
from sphereorient.assemble import Hypotheses
from sphereorient.cameras import Camera, ParameterCovariance, R_cam_view
from sphereorient.errors import ExperimentError, SettingsError, refusal
from sphereorient.experiment import Experiment, frame_numbers, load_experiment, movie_span, open_movies, time_s
from sphereorient.locate import Sightings
from sphereorient.movies import Movie
from sphereorient.orient import (
    ApartTracker,
    BlockTracker,
    Candidates,
    Eye,
    GreySearch,
    LinesOfSight,
    Poses,
    Proposals,
    Proposer,
    Study,
    TemplateSearch,
    base_table,
    crop_disk,
    pose_table,
    study,
)
from sphereorient.provenance import provenance
from sphereorient.settings import DEFAULT_METHOD, METHODS, Settings, settings_yaml
from sphereorient.sphere import load_texture
from sphereorient.sphere.paint_table import PaintTable
from sphereorient.trajectory import Trajectory

CHUNK = 64  # frames held at once; a result does not depend on it


Progress = Callable[[str, int, int], None]  # (stage, frames done, frames in all); the command line draws a bar


def silent(stage: str, done: int, total: int) -> None:
    """Tell nobody."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reel:
    """One camera's share of the experiment; made by `track_movies`, read by the stages."""

    name: str
    camera: Camera
    movie: Movie
    frames: range  # the experiment's frames in the movie's own counting

    def pictures(self) -> Iterator[NDArray[Any]]:
        """Yield the experiment's frames of this camera, in order."""
        return self.movie.frames(self.frames.start, self.frames.stop)


def track_movies(
    experiment: Experiment | str | FilePath,
    *,
    method: str = DEFAULT_METHOD,
    settings: Settings | None = None,
    cameras: Sequence[str] | None = None,
    device: str = "cpu",
    progress: Progress = silent,
    command: str = "sphereorient.track_movies",
) -> Trajectory:
    """Measure position and absolute orientation of the sphere in every frame.

    Args:
        experiment: as loaded, or the path of its experiment.yaml.
        method: "precise", refined poses with covariances; "paper", Zimmermann et al. 2011 with the corrections of
            docs/paper-map.md.
        settings: None: the method's defaults.
        cameras: names of those to use; None: all.
        device: where fits are computed, as torch names it: cpu, cuda, cuda:1.
        progress: told how far each stage is.
        command: what the track's provenance names as its origin.

    Returns:
        The trajectory, frame by frame; lengths mm, angles rad, see docs/data-format.md.

    Raises:
        SphereOrientError: inputs that are missing, unreadable or do not fit together.
    """
    if method not in METHODS:
        raise SettingsError(refusal("method", expected=" or ".join(METHODS), got=repr(method), do="name one of these"))
    there = _device(device)
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(FilePath(experiment))
    settings = settings or Settings()
    names = _chosen(experiment, cameras)
    texture = load_texture(_texture_path(experiment))
    _refuse_unsupported(experiment, names)
    movies = open_movies(experiment, names)
    try:
        frames = frame_numbers(experiment, movies)
        reels = [
            Reel(
                name=n, camera=experiment.cameras[n], movie=movies[n], frames=range(*movie_span(experiment, n, frames))
            )
            for n in names
        ]
        clock = torch.from_numpy(time_s(experiment, frames))
        compose = {"paper": _paper, "precise": _precise}[method]
        with one_thread():
            track = compose(experiment, reels, frames, clock, texture, settings, there, progress)
            track = results.with_systematic_errors(
                track, {n: experiment.cameras[n] for n in names}, _covariance(experiment, names), _radius_mm(experiment)
            )
        text = settings_yaml(settings)
        return replace(track, method=method, settings=text, provenance=provenance(experiment, names, command))
    finally:
        for movie in movies.values():
            movie.close()


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch to one thread for a while: its tensors here are small, and idle threads that spin starve decoding."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _paper(
    experiment: Experiment,
    reels: Sequence[Reel],
    frames: range,
    clock: Tensor,
    texture: Tensor,
    settings: Settings,
    device: torch.device,
    progress: Progress,
) -> Trajectory:
    """Section III of the paper, step by step."""
    cameras = {reel.name: reel.camera for reel in reels}
    sightings = {reel.name: locate_sphere(reel, cameras, experiment, settings, progress) for reel in reels}
    locate.check_seen(sightings)
    positions = locate.find_positions(sightings, cameras, experiment.diameter_mm)
    candidates = {
        reel.name: propose_orientations(reel, sightings[reel.name], texture, settings, progress) for reel in reels
    }
    paths = assemble.assemble_paths(candidates, clock, settings.assemble)
    fused = assemble.fuse(paths, candidates, clock, settings.assemble)
    moved = motion.measure_motion(
        positions.for_motion(),
        fused.R_lab_body,
        fused.segment,
        experiment.frame_rate_hz,
        settings.motion,
        position_sigma_mm=positions.covariance_mm2.diagonal(dim1=-2, dim2=-1).sqrt(),
        orientation_sigma_rad=fused.sigma_rad,
    )
    tracks = {name: results.paper_camera(sightings[name], candidates[name], paths[name]) for name in cameras}
    return results.paper_track(experiment, clock, positions, fused, moved, tracks)


def locate_sphere(
    reel: Reel, cameras: Mapping[str, Camera], experiment: Experiment, settings: Settings, progress: Progress
) -> Sightings:
    """Find the sphere's outline in every frame of one camera, outliers replaced and short gaps filled."""
    stage = f"{reel.name}: locate"
    progress(stage, 0, len(reel.frames))
    diameter_px = _diameter_px(reel.name, cameras, experiment, settings)
    background = empty_scene(reel, settings.locate.background_frames, diameter_px, experiment, settings)
    found = []
    for done, picture in enumerate(reel.pictures(), 1):
        found.append(locate.find_ball(picture, background, diameter_px, settings.locate))
        if done % CHUNK == 0 or done == len(reel.frames):
            progress(stage, done, len(reel.frames))
    return locate.repair(locate.sightings_of(found), settings.locate)


def propose_orientations(
    reel: Reel, sightings: Sightings, texture: Tensor, settings: Settings, progress: Progress
) -> Candidates:
    """Propose orientations for every frame in which one camera has the sphere, in the lab frame."""
    stage = f"{reel.name}: orient"
    total = len(reel.frames)
    progress(stage, 0, total)
    if not sightings.placed.any():
        return in_the_lab(Proposals.none(sightings.reason), reel.camera, sightings.centre_px)
    proposer: Proposer = TemplateSearch(texture, locate.size_of(sightings, settings.orient.size_px), settings.orient)
    proposals = [Proposals.none(sightings.reason[:0])]
    waiting: list[NDArray[np.float32]] = []
    done = 0
    for k, picture in enumerate(reel.pictures()):
        if sightings.placed[k]:
            u, v = sightings.centre_px[k].tolist()
            waiting.append(crop_disk(picture, u, v, float(sightings.radius_px[k]), proposer.size_px))
        if (k + 1) % CHUNK == 0 or k + 1 == total:
            placed = sightings.placed[done : k + 1]
            found = proposer.propose(torch.from_numpy(np.stack(waiting))) if waiting else Proposals.none(())
            proposals.append(found.spread(placed, sightings.reason[done : k + 1]))
            waiting, done = [], k + 1
            progress(stage, done, total)
    return in_the_lab(Proposals.joined(proposals), reel.camera, sightings.centre_px)


def in_the_lab(proposals: Proposals, camera: Camera, centre_px: Tensor) -> Candidates:
    """Turn orientations from the view frame of each frame into the lab, the perspective removed (ERRATA A1).

    Args:
        proposals: of N frames.
        camera: that saw them.
        centre_px: (N, 2), the outline's centre.
    """
    direction_cam = camera.rays(centre_px).direction_lab @ camera.R_cam_lab.mT
    R_lab_view = camera.R_cam_lab.mT @ R_cam_view(direction_cam)
    frame = torch.repeat_interleave(torch.arange(len(centre_px)), proposals.offset.diff())
    return Candidates(
        offset=proposals.offset,
        R_lab_body=R_lab_view[frame] @ proposals.R_view_body,
        score=proposals.score,
        reason=proposals.reason,
    )


def _precise(
    experiment: Experiment,
    reels: Sequence[Reel],
    frames: range,
    clock: Tensor,
    texture: Tensor,
    settings: Settings,
    device: torch.device,
    progress: Progress,
) -> Trajectory:
    """One likelihood for all cameras: pose after pose refined, then the history, then its motion."""
    cameras = {reel.name: reel.camera for reel in reels}
    diameters = {name: _diameter_px(name, cameras, experiment, settings) for name in cameras}
    with ThreadPoolExecutor(2) as pool:  # decoding, sorting and products leave the interpreter free
        opening = [pool.submit(open_eye, reel, diameters[reel.name], experiment, settings, progress) for reel in reels]
        base = pool.submit(base_table, texture, max(diameters.values()))
        search = pool.submit(GreySearch, texture, settings.search)
        eyes = [eye.result() for eye in opening]
        proposers: dict[str, Proposer] = {eye.name: search.result() for eye in eyes}
        learnt = study_movies(reels, eyes, base.result(), proposers, experiment, settings, progress)
    # Cameras that were bumped would pull one pose to and fro between them.
    follower = BlockTracker if learnt.together else ApartTracker
    tracker = follower(learnt.on(device), proposers, settings.locate, settings.refine)
    table = pose_table(list(follow_sphere(reels, frames, tracker, progress)), len(eyes))
    hypotheses = Hypotheses(
        R_lab_body=table.R_lab_body, nll=table.nll, covariance_rad2=table.covariance[..., :3, :3], mask=table.mask
    )
    chosen = assemble.physical_path(hypotheses, clock, settings.path)
    picked = table.rows(chosen.choice)
    smoothed = motion.smooth_motion(
        clock,
        picked["position_lab_mm"],
        picked["covariance"][:, 3:, 3:],
        picked["R_lab_body"],
        picked["covariance"][:, :3, :3],
        chosen.segment,
        settings.smooth,
    )
    return results.precise_track(experiment, clock, table, chosen, smoothed, learnt)


def empty_scene(
    reel: Reel, count: int, diameter_px: float, experiment: Experiment, settings: Settings
) -> locate.Background:
    """Learn what one camera shows without the ball, from `count` frames or the experiment's own picture."""
    path = experiment.background_paths.get(reel.name)
    empty = None if path is None else locate.load_background(path, reel.movie.frame_shape)
    spread = locate.spread_frames(reel.frames, count)
    return locate.learn_background(reel.movie, spread, diameter_px, settings.locate, empty)


def open_eye(reel: Reel, diameter_px: float, experiment: Experiment, settings: Settings, progress: Progress) -> Eye:
    """Learn one camera's empty scene."""
    stage = f"{reel.name}: background"
    progress(stage, 0, 1)
    background = empty_scene(reel, settings.refine.background_frames, diameter_px, experiment, settings)
    progress(stage, 1, 1)
    sight = LinesOfSight(reel.camera)
    return Eye(name=reel.name, camera=reel.camera, background=background, diameter_px=diameter_px, sight=sight)


def study_movies(
    reels: Sequence[Reel],
    eyes: Sequence[Eye],
    base: PaintTable,
    proposers: Mapping[str, Proposer],
    experiment: Experiment,
    settings: Settings,
    progress: Progress,
) -> Study:
    """Learn blur and light from a few frames of all cameras."""
    progress("study", 0, 1)
    count = settings.refine.study_frames
    pictures = [reel.movie.sample(locate.spread_frames(reel.frames, count)) for reel in reels]
    learnt = study(
        eyes,
        list(zip(*pictures, strict=True)),
        base,
        proposers,
        _radius_mm(experiment),
        settings.locate,
        settings.refine,
    )
    progress("study", 1, 1)
    return learnt


def follow_sphere(
    reels: Sequence[Reel], frames: range, tracker: BlockTracker | ApartTracker, progress: Progress
) -> Iterator[Poses]:
    """Yield the poses of every frame, while the frames of the blocks to come are being decoded."""
    stage, done = "track", 0
    progress(stage, 0, len(frames))
    windows = tracker.windows(frames)
    with ThreadPoolExecutor(len(reels)) as pool:
        pictures = [reel.pictures() for reel in reels]

        def ahead(window: Sequence[int]) -> list[Future[list[NDArray[Any]]]]:
            return [pool.submit(_taken, movie, sum(window)) for movie in pictures]

        coming = ahead(windows[0]) if windows else []
        for k, window in enumerate(windows):
            read = [movie.result() for movie in coming]
            coming = ahead(windows[k + 1]) if k + 1 < len(windows) else []
            for poses in tracker.track(read, window):
                yield poses
                done += 1
            progress(stage, done, len(frames))


def _taken(pictures: Iterator[NDArray[Any]], count: int) -> list[NDArray[Any]]:
    """Take the next pictures of a movie."""
    return list(islice(pictures, count))


def _diameter_px(name: str, cameras: Mapping[str, Camera], experiment: Experiment, settings: Settings) -> float:
    """Expected diameter of the sphere's picture."""
    return settings.locate.diameter_px or locate.expected_diameter_px(name, cameras, experiment.diameter_mm)


def _covariance(experiment: Experiment, names: Sequence[str]) -> ParameterCovariance | None:
    """Covariance of the parameters of some cameras."""
    whole = experiment.camera_covariance
    return None if whole is None else whole.of(names)


def _radius_mm(experiment: Experiment) -> float:
    """Radius of the sphere; 1 where lengths are in radii."""
    return 1.0 if experiment.diameter_mm is None else experiment.diameter_mm / 2


def _texture_path(experiment: Experiment) -> FilePath:
    if experiment.texture_path is None:
        do = "give sphere.texture; learning it from the movie is not part of this version"
        raise ExperimentError(refusal(str(experiment.path), expected="a texture", got="none", do=do))
    return experiment.texture_path


def _device(name: str) -> torch.device:
    """Return a device that is there."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        got, do = f"'{name}': {str(error).splitlines()[0]}", "name cpu, or install torch for your GPU"
        raise SettingsError(refusal("device", expected="a device that torch can use", got=got, do=do)) from None
    return device


def _refuse_unsupported(experiment: Experiment, names: Sequence[str]) -> None:
    """Refuse what the file may say and this version would ignore: a wrong result is worse than none."""
    if any(name in experiment.mask_paths for name in names):
        do = "remove masks: and see how far the method gets without them"
        raise ExperimentError(
            refusal(f"{experiment.path}, masks", expected="none with method paper", got="masks", do=do)
        )
    if experiment.fixed and not all(name in experiment.background_paths for name in names):
        do = "give backgrounds: pictures of the scene without the ball; a ball at rest is part of the movie's own"
        got = "a fixed ball without them"
        raise ExperimentError(refusal(f"{experiment.path}", expected="backgrounds of all cameras", got=got, do=do))


def _chosen(experiment: Experiment, cameras: Sequence[str] | None) -> list[str]:
    """Names of the cameras to use, in the experiment's order."""
    known = list(experiment.movie_paths)
    wanted = known if cameras is None else list(cameras)
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        got = ", ".join(unknown) or "none"
        raise ExperimentError(
            refusal("cameras", expected=" or ".join(known), got=got, do="name cameras of the experiment")
        )
    return [name for name in known if name in wanted]
