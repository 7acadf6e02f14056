"""The precise method, stage by stage: one likelihood for all cameras, pose after pose, the history, then its motion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, islice

import torch

from sphereorient import assemble, motion
from sphereorient.assemble import Hypotheses
from sphereorient.experiment.recording import Progress, Recording
from sphereorient.experiment.stream import CameraStream, spread_frames
from sphereorient.follow import Appearance, BlockTracker, PerCameraTracker, Poses, PoseTable, joined_tables, pose_table
from sphereorient.follow.appearance import estimate_appearance
from sphereorient.follow.fixed_centre import FixedCentre, find_fixed_centre
from sphereorient.locate import Shot, find_scene, known_diameter_px, screened_frames
from sphereorient.methods import results
from sphereorient.methods.learnt import Learnt, with_motion
from sphereorient.methods.proposers import BlurMatchedSearch
from sphereorient.methods.settings import Settings
from sphereorient.pose import CameraView, base_table, estimate_blur_px
from sphereorient.pose.defocus import FIRST_BLUR_PX, defocus_radii
from sphereorient.pose.fitter import widest_px
from sphereorient.search import Proposer
from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """Blocks of frames that are followed side by side; frames first .. last - 1, counted from the first one used."""

    first: int
    last: int
    lengths: tuple[int, ...]  # of the blocks


@dataclass(frozen=True, kw_only=True, eq=False)
class Follower:
    """All that measuring single frames takes; made by `follower`, read by `follow`."""

    recording: Recording
    study: Appearance
    tracker: BlockTracker | PerCameraTracker

    @property
    def windows(self) -> list[Window]:
        """The windows of the whole recording; which frames they hold depends on frame numbers alone."""
        lengths = self.tracker.windows(self.recording.frames)
        ends = list(accumulate(sum(window) for window in lengths))
        return [
            Window(first=end - sum(window), last=end, lengths=tuple(window))
            for end, window in zip(ends, lengths, strict=True)
        ]


def learn(recording: Recording, settings: Settings, progress: Progress) -> tuple[Appearance, Mapping[str, Proposer]]:
    """Learn the empty scenes, blur and light from frames spread over the movies."""
    with ThreadPoolExecutor(2) as pool:  # decoding, sorting and products leave the interpreter free
        opening = [pool.submit(open_view, recording, stream, settings, progress) for stream in recording.streams]
        search = BlurMatchedSearch(recording.texture, settings, widest_disk_px(recording, settings, opening))
        base = pool.submit(base_table, recording.texture, search.diameter_px)
        sharp = pool.submit(search.of, settings.refine.blur_px or 0.0)
        views = [view.result() for view in opening]
        sharp.result()
        progress("study", 0, 1)
        shots = sample_frames(recording, views, settings.refine.study_frames)
        # Of pictures that are soft the search has to know it; those of others need no better first guess than any.
        seen_px = settings.refine.blur_px or estimate_blur_px(views, shots, settings.locate)
        blur_px = seen_px if defocus_radii(seen_px, search.diameter_px) else FIRST_BLUR_PX
        asked = by_camera(search, views, blur_px)
        learnt = estimate_appearance(
            views, shots, base.result(), asked, recording.radius_mm, settings.locate, settings.refine, blur_px
        )
        progress("study", 1, 1)
    return learnt, by_camera(search, views, learnt.fitter.optics.blur_px)


def widest_disk_px(recording: Recording, settings: Settings, opening: Sequence[Future[CameraView]]) -> float:
    """Return the expected diameter of the ball's largest picture, px; where only the movies show it, wait for them."""
    known = [known_diameter_px(recording, stream.name, settings.locate) for stream in recording.streams]
    return max(px or view.result().diameter_px for px, view in zip(known, opening, strict=True))


def by_camera(search: BlurMatchedSearch, views: Sequence[CameraView], blur_px: float) -> dict[str, Proposer]:
    """Return who proposes for each camera's pictures, which are as blurred as that."""
    return dict.fromkeys((view.name for view in views), search.of(blur_px))


def open_view(recording: Recording, stream: CameraStream, settings: Settings, progress: Progress) -> CameraView:
    """Learn one camera's empty scene."""
    stage = f"{stream.name}: background"
    progress(stage, 0, 1)
    scene = find_scene(recording, stream, settings.refine.background_frames, settings.locate)
    progress(stage, 1, 1)
    return CameraView.of(stream.name, stream.camera, scene)


def sample_frames(recording: Recording, views: Sequence[CameraView], count: int) -> list[tuple[Shot, ...]]:
    """Return frames spread over the movies; where a picture is none, the next frame of which all are."""
    total = len(recording.timeline)
    spread = spread_frames(range(total), count)
    taken = []
    for first, last in zip(spread, [*spread[1:], total], strict=True):
        frames = zip(
            *(
                screened_frames(stream, view.background, first, max(last, first + 1))
                for stream, view in zip(recording.streams, views, strict=True)
            ),
            strict=True,
        )
        best = next(frames)
        for shots in frames:
            if all(shot.usable for shot in best):
                break
            best = max(best, shots, key=lambda each: sum(shot.usable for shot in each))
        taken.append(best)
    return taken


def follower(
    recording: Recording,
    learnt: Appearance,
    proposers: Mapping[str, Proposer],
    settings: Settings,
    device: torch.device,
) -> Follower:
    """Return what measures single frames."""
    tracker: BlockTracker | PerCameraTracker
    if learnt.together:
        place = one_place(recording, learnt, proposers, settings) if recording.experiment.fixed else None
        tracker = BlockTracker(learnt.on(device), proposers, settings.locate, settings.refine, place)
    else:  # cameras that were bumped would pull one pose to and fro between them
        tracker = PerCameraTracker(learnt.on(device), proposers, settings.locate, settings.refine)
    return Follower(recording=recording, study=learnt, tracker=tracker)


def one_place(
    recording: Recording, learnt: Appearance, proposers: Mapping[str, Proposer], settings: Settings
) -> FixedCentre | None:
    """Find the place of a ball that turns in it: of this movie, whichever taught the light."""
    shots = sample_frames(recording, learnt.fitter.views, settings.refine.study_frames)
    return find_fixed_centre(learnt, proposers, shots, settings.locate, settings.refine)


def follower_of(recording: Recording, learnt: Learnt, settings: Settings, device: torch.device) -> Follower:
    """Return what measures single frames, with what another run or process learnt."""
    known = learnt.estimate_appearance(recording)
    search = BlurMatchedSearch(recording.texture, settings, widest_px(known.fitter.views))
    proposers = by_camera(search, known.fitter.views, known.fitter.optics.blur_px)
    return follower(recording, known, proposers, settings, device)


def follow(follower: Follower, windows: Sequence[Window]) -> Iterator[tuple[Window, list[Poses]]]:
    """Yield the poses of consecutive windows, while the frames of the windows to come are being decoded."""
    streams, time_s = follower.recording.streams, follower.recording.timeline.time_s
    if not windows:
        return
    first, last = windows[0].first, windows[-1].last
    with ThreadPoolExecutor(len(streams)) as pool:
        movies = [
            screened_frames(stream, view.background, first, last)
            for stream, view in zip(streams, follower.study.fitter.views, strict=True)
        ]

        def ahead(window: Window) -> list[Future[list[Shot]]]:
            return [pool.submit(_taken, movie, window.last - window.first) for movie in movies]

        coming = ahead(windows[0])
        for k, window in enumerate(windows):
            read = [movie.result() for movie in coming]
            coming = ahead(windows[k + 1]) if k + 1 < len(windows) else []
            times = time_s[window.first : window.last].tolist()
            yield window, list(follower.tracker.track(read, window.lengths, times))


def _taken(shots: Iterator[Shot], count: int) -> list[Shot]:
    """Take the next pictures of a movie."""
    return list(islice(shots, count))


def join(
    recording: Recording, known: Appearance, table: PoseTable, settings: Settings, given: Learnt | None = None
) -> tuple[Trajectory, Learnt]:
    """Choose the history, smooth it, and put everything into the noun that comes out.

    Args:
        recording: with the times.
        known: light and scores that the poses were measured with.
        table: poses of all frames.
        settings: of the path and the smoother.
        given: the motion as another run learnt it; None learns it.

    Returns:
        The track, and what it taught.
    """
    hypotheses = Hypotheses(
        R_lab_body=table.R_lab_body, nll=table.nll, covariance_rad2=table.covariance[..., :3, :3], mask=table.mask
    )
    path = settings.path
    if given is not None and given.acceleration_rad_s2 is not None:
        path = path.model_copy(update={"acceleration_rad_s2": given.acceleration_rad_s2})
    clock = recording.clock
    chosen = assemble.physical_path(hypotheses, clock, path)
    picked = table.rows(chosen.choice)
    poses = motion.MeasuredPoses(
        time_s=clock,
        position_lab_mm=picked["position_lab_mm"],
        position_cov_mm2=picked["covariance"][:, 3:, 3:],
        R_lab_body=picked["R_lab_body"],
        orientation_cov_rad2=picked["covariance"][:, :3, :3],
        segment=chosen.segment,
    )
    smoothed = motion.smooth_motion(poses, settings.smooth, None if given is None else given.process)
    track = results.precise_track(recording.experiment, clock, table, chosen, smoothed, known)
    return track, with_motion(Learnt.of(known), smoothed.process, chosen.acceleration_rad_s2)


def track_precise(
    recording: Recording, settings: Settings, device: torch.device, given: Learnt | None, progress: Progress
) -> tuple[Trajectory, Learnt]:
    """Measure the movies from the first frame to the last."""
    if given is None:
        seeing = follower(recording, *learn(recording, settings, progress), settings, device)
    else:
        seeing = follower_of(recording, given, settings, device)
    tables: list[PoseTable] = []
    total = len(recording.timeline)
    progress("track", 0, total)
    for window, measured in follow(seeing, seeing.windows):
        tables.append(pose_table(measured, len(recording.streams)))
        progress("track", window.last, total)
    return join(recording, seeing.study, joined_tables(tables), settings, given)
