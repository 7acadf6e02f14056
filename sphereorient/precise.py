"""The precise method, stage by stage: one likelihood for all cameras, pose after pose, the history, then its motion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, islice

import torch

from sphereorient import assemble, motion, results
from sphereorient.assemble import Hypotheses
from sphereorient.learnt import Learnt, with_motion
from sphereorient.locate import Shot, spread_frames
from sphereorient.orient import (
    ApartTracker,
    BlockTracker,
    Eye,
    LinesOfSight,
    Poses,
    PoseTable,
    Proposer,
    Study,
    base_table,
    blur_seen_px,
    joined_tables,
    pose_table,
    softness,
    study,
)
from sphereorient.orient.held import HeldPlace, held_place
from sphereorient.orient.softness import FIRST_BLUR_PX
from sphereorient.proposers import SearchOfBlur
from sphereorient.recording import Progress, Recording
from sphereorient.reel import Reel
from sphereorient.settings import Settings
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
    study: Study
    tracker: BlockTracker | ApartTracker

    @property
    def windows(self) -> list[Window]:
        """The windows of the whole recording; which frames they hold depends on frame numbers alone."""
        lengths = self.tracker.windows(self.recording.frames)
        ends = list(accumulate(sum(window) for window in lengths))
        return [
            Window(first=end - sum(window), last=end, lengths=tuple(window))
            for end, window in zip(ends, lengths, strict=True)
        ]


def learn(recording: Recording, settings: Settings, progress: Progress) -> tuple[Study, Mapping[str, Proposer]]:
    """Learn the empty scenes, blur and light from frames spread over the movies."""
    with ThreadPoolExecutor(2) as pool:  # decoding, sorting and products leave the interpreter free
        opening = [pool.submit(open_eye, recording, reel, settings, progress) for reel in recording.reels]
        search = SearchOfBlur(recording.texture, settings, widest_disk_px(recording, settings))
        base = pool.submit(base_table, recording.texture, search.diameter_px)
        sharp = pool.submit(search.of, settings.refine.blur_px or 0.0)
        eyes = [eye.result() for eye in opening]
        sharp.result()
        progress("study", 0, 1)
        shots = study_shots(recording, eyes, settings.refine.study_frames)
        # Of pictures that are soft the search has to know it; those of others need no better first guess than any.
        seen_px = settings.refine.blur_px or blur_seen_px(eyes, shots, settings.locate)
        blur_px = seen_px if softness(seen_px, search.diameter_px) else FIRST_BLUR_PX
        asked = by_camera(search, eyes, blur_px)
        learnt = study(
            eyes, shots, base.result(), asked, recording.radius_mm, settings.locate, settings.refine, blur_px
        )
        progress("study", 1, 1)
    return learnt, by_camera(search, eyes, learnt.fitter.optics.blur_px)


def widest_disk_px(recording: Recording, settings: Settings) -> float:
    """Return the expected diameter of the ball's largest picture, px."""
    return max(recording.diameter_px(reel.name, settings) for reel in recording.reels)


def by_camera(search: SearchOfBlur, eyes: Sequence[Eye], blur_px: float) -> dict[str, Proposer]:
    """Return who proposes for each camera's pictures, which are as blurred as that."""
    return dict.fromkeys((eye.name for eye in eyes), search.of(blur_px))


def open_eye(recording: Recording, reel: Reel, settings: Settings, progress: Progress) -> Eye:
    """Learn one camera's empty scene."""
    stage = f"{reel.name}: background"
    progress(stage, 0, 1)
    background = recording.empty_scene(reel, settings.refine.background_frames, settings)
    progress(stage, 1, 1)
    return Eye(
        name=reel.name,
        camera=reel.camera,
        background=background,
        diameter_px=recording.diameter_px(reel.name, settings),
        sight=LinesOfSight(reel.camera),
    )


def study_shots(recording: Recording, eyes: Sequence[Eye], count: int) -> list[tuple[Shot, ...]]:
    """Return frames spread over the movies; where a picture is none, the next frame of which all are."""
    total = len(recording.timeline)
    spread = spread_frames(range(total), count)
    taken = []
    for first, last in zip(spread, [*spread[1:], total], strict=True):
        frames = zip(
            *(
                reel.shots(eye.background, first, max(last, first + 1))
                for reel, eye in zip(recording.reels, eyes, strict=True)
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
    recording: Recording, learnt: Study, proposers: Mapping[str, Proposer], settings: Settings, device: torch.device
) -> Follower:
    """Return what measures single frames."""
    tracker: BlockTracker | ApartTracker
    if learnt.together:
        place = one_place(recording, learnt, proposers, settings) if recording.experiment.fixed else None
        tracker = BlockTracker(learnt.on(device), proposers, settings.locate, settings.refine, place)
    else:  # cameras that were bumped would pull one pose to and fro between them
        tracker = ApartTracker(learnt.on(device), proposers, settings.locate, settings.refine)
    return Follower(recording=recording, study=learnt, tracker=tracker)


def one_place(
    recording: Recording, learnt: Study, proposers: Mapping[str, Proposer], settings: Settings
) -> HeldPlace | None:
    """Find the place of a ball that turns in it: of this movie, whichever taught the light."""
    shots = study_shots(recording, learnt.fitter.eyes, settings.refine.study_frames)
    return held_place(learnt, proposers, shots, settings.locate, settings.refine)


def follower_of(recording: Recording, learnt: Learnt, settings: Settings, device: torch.device) -> Follower:
    """Return what measures single frames, with what another run or process learnt."""
    known = learnt.study(recording)
    search = SearchOfBlur(recording.texture, settings, widest_disk_px(recording, settings))
    proposers = by_camera(search, known.fitter.eyes, known.fitter.optics.blur_px)
    return follower(recording, known, proposers, settings, device)


def follow(follower: Follower, windows: Sequence[Window]) -> Iterator[tuple[Window, list[Poses]]]:
    """Yield the poses of consecutive windows, while the frames of the windows to come are being decoded."""
    reels, time_s = follower.recording.reels, follower.recording.timeline.time_s
    if not windows:
        return
    first, last = windows[0].first, windows[-1].last
    with ThreadPoolExecutor(len(reels)) as pool:
        movies = [
            reel.shots(eye.background, first, last) for reel, eye in zip(reels, follower.study.fitter.eyes, strict=True)
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
    recording: Recording, known: Study, table: PoseTable, settings: Settings, given: Learnt | None = None
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
    smoothed = motion.smooth_motion(
        clock,
        picked["position_lab_mm"],
        picked["covariance"][:, 3:, 3:],
        picked["R_lab_body"],
        picked["covariance"][:, :3, :3],
        chosen.segment,
        settings.smooth,
        None if given is None else given.process,
    )
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
        tables.append(pose_table(measured, len(recording.reels)))
        progress("track", window.last, total)
    return join(recording, seeing.study, joined_tables(tables), settings, given)
