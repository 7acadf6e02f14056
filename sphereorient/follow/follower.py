"""Tracking batch by batch, decoding the next batch meanwhile; all cameras together, or those that agree."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, islice, pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.experiment.recording import Recording, spread_frames
from sphereorient.files.threads import side_by_side
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.ball import OWN, BallTracker
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.settings import RefineSettings
from sphereorient.follow.tracker import Tracker
from sphereorient.locate import Frame, screened_frames
from sphereorient.locate.outline import Outline
from sphereorient.pose import CameraView
from sphereorient.pose.poses import Poses, no_pose

MOST, KEPT = 8, 2  # times the wanted number of frames: examined, and kept
SHOWN = 0.75  # of the wanted frames, in which each camera should show the ball
FEWEST = 4  # frames that show the ball
DECODING = 2  # threads in which parts of pictures are decoded


class PerCameraTracker:
    """Tracks the sphere in the agreeing cameras together, and in each other one alone. The first of these that sees it
    gives the pose; the others are recorded as contradicting.
    """

    def __init__(self, name: str, appearance: Appearance, search: Initialiser, settings: RefineSettings) -> None:
        others = [(k,) for k in range(len(appearance.fitter.views)) if k not in appearance.majority]
        self.parts = [part for part in (appearance.majority, *others) if part]
        balls = [BallTracker(appearance.of(*part), search, settings) for part in self.parts]
        self.balls: dict[str, BallTracker] = {}  # followed in all cameras together
        self.trackers = [Tracker({name: ball}) for ball in balls]

    def batches(self, frames: range) -> list[list[int]]:
        """Return the lengths of the chunks of each batch; see `Tracker`."""
        return self.trackers[0].batches(frames)

    def track(
        self, frames: Sequence[Sequence[Frame]], batch: Sequence[int], time_s: Sequence[float]
    ) -> Iterator[dict[str, Poses]]:
        """Track the chunks of one batch; see `Tracker`."""
        each = [
            tracker.track([frames[k] for k in part], batch, time_s)
            for tracker, part in zip(self.trackers, self.parts, strict=True)
        ]
        for apart in zip(*each, strict=True):
            yield {name: cameras_disagree([poses[name] for poses in apart], self.parts) for name in apart[0]}


def cameras_disagree(apart: Sequence[Poses], parts: Sequence[Sequence[int]]) -> Poses:
    """Return one frame's poses by the first part of C cameras that sees the sphere, and the others' own results."""
    why = dict(pair for poses, part in zip(apart, parts, strict=True) for pair in zip(part, poses.reason, strict=True))
    reason = [why[k] for k in range(len(why))]
    seeing = [k for k, poses in enumerate(apart) if len(poses) and bool(poses.use.any())]
    if not seeing:
        return no_pose(len(reason), reason)
    main, own = apart[seeing[0]], parts[seeing[0]]
    arrays, use = main.parts(), torch.zeros(len(reason), dtype=torch.bool)
    use[list(own)] = main.use
    for name in ("own_turn", "own_move", *OWN):
        whole = arrays[name].new_zeros(len(main), len(reason), *arrays[name].shape[2:])
        whole[:, list(own)] = arrays[name]
        arrays[name] = whole
    for other, (k, *several) in ((apart[part], parts[part]) for part in seeing):
        if several or other is main:  # the agreeing cameras, or the camera in use, have their own results
            continue
        arrays["own_turn"][:, k] = so3.log(other.R_lab_body[:1] @ main.R_lab_body.mT)
        arrays["own_move"][:, k] = other.position_lab_mm[:1] - main.position_lab_mm
        reason[k] = Reason.CONTRADICTS
        for name in OWN:
            arrays[name][:, k] = getattr(other, name)[:1, 0]
    return Poses(**arrays, use=use, reason=tuple(reason))


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Chunks of frames tracked together; frames first .. last - 1, counted from the first one used."""

    first: int
    last: int
    lengths: tuple[int, ...]  # of the chunks

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.last - self.first


@dataclass(frozen=True, kw_only=True, eq=False)
class Follower:
    """The tracker, its movies and its appearance, made by a method, read by `run`."""

    recording: Recording
    appearances: Mapping[str, Appearance]  # of each ball, by name
    tracker: Tracker | PerCameraTracker

    @property
    def appearance(self) -> Appearance:
        """Appearance of the only ball."""
        (only,) = self.appearances.values()
        return only

    @property
    def batches(self) -> list[Batch]:
        """The batches of the whole recording; they depend on frame numbers alone."""
        lengths = self.tracker.batches(self.recording.frames)
        ends = list(accumulate(sum(batch) for batch in lengths))
        return [
            Batch(first=end - sum(batch), last=end, lengths=tuple(batch))
            for end, batch in zip(ends, lengths, strict=True)
        ]

    def follow(self, batches: Sequence[Batch]) -> Iterator[tuple[Batch, dict[str, list[Poses]]]]:
        """Yield the poses of each ball in each frame, batch by batch; consecutive batches are decoded ahead."""
        breaks = [k for k in range(1, len(batches)) if batches[k - 1].last != batches[k].first]
        for first, last in pairwise([0, *breaks, len(batches)] if batches else []):
            yield from self._follow(batches[first:last])

    def _follow(self, batches: Sequence[Batch]) -> Iterator[tuple[Batch, dict[str, list[Poses]]]]:
        streams, time_s = self.recording.streams, self.recording.timeline.time_s
        first, last = batches[0].first, batches[-1].last
        views = next(iter(self.appearances.values())).fitter.views
        with ThreadPoolExecutor(DECODING) as parts, ThreadPoolExecutor(len(streams)) as pool:
            movies = [
                screened_frames(stream, view.background, first, last, parts)
                for stream, view in zip(streams, views, strict=True)
            ]

            def read_on(movie: Iterator[Frame], batch: Batch) -> list[Frame]:
                frames = list(islice(movie, len(batch)))
                for begin in accumulate([0, *batch.lengths[:-1]]):
                    _ = frames[begin].reason  # the first frames of a chunk are decoded whole
                return frames

            def ahead(batch: Batch) -> list[Future[list[Frame]]]:
                return [pool.submit(read_on, movie, batch) for movie in movies]

            coming = ahead(batches[0])
            for k, batch in enumerate(batches):
                read = [movie.result() for movie in coming]
                coming = ahead(batches[k + 1]) if k + 1 < len(batches) else []
                times = time_s[batch.first : batch.last].tolist()
                scenes = list(self.tracker.track(read, batch.lengths, times))
                yield batch, {name: [scene[name] for scene in scenes] for name in self.appearances}


def sample_frames(
    recording: Recording, views: Sequence[CameraView], count: int
) -> tuple[list[tuple[Frame, ...]], list[int]]:
    """Return `count` frames of all cameras, spread over the movies, each the first readable one of its stretch, and
    their indices among the frames in use.
    """
    total = len(recording.timeline)
    spread = spread_frames(range(total), count)

    def of_stretch(ends: tuple[int, int]) -> tuple[tuple[Frame, ...], int]:
        first, last = ends
        movies = [
            screened_frames(stream, view.background, first, max(last, first + 1), parts)
            for stream, view in zip(recording.streams, views, strict=True)
        ]
        best: tuple[Frame, ...] = ()
        place = first
        for k, frames in enumerate(zip(*movies, strict=True), first):
            if not best or sum(shot.usable for shot in frames) > sum(shot.usable for shot in best):
                best, place = frames, k
            if all(shot.usable for shot in best):
                break
        return best, place

    with ThreadPoolExecutor(DECODING) as parts:  # `usable` decodes the whole picture
        found = list(side_by_side(of_stretch, zip(spread, [*spread[1:], total], strict=True)))
    return [frames for frames, _ in found], [place for _, place in found]


def frames_showing(
    recording: Recording,
    views: Sequence[CameraView],
    count: int,
    disks: Callable[[Sequence[Frame]], list[Outline | None]],
) -> tuple[list[tuple[Frame, ...]], list[int]]:
    """Return frames of all cameras that show the ball, spread over the movies, and their indices among the frames in
    use. `disks` finds it in the C pictures of a frame. At least `count` and up to `MOST` times as many frames are
    examined, until each camera shows the ball in `SHOWN` of `count`. Those that most cameras show are returned, evenly
    spread, with as many pictures as `KEPT` times `count` frames of all cameras have. If hardly any frame shows the
    ball, the first `count` are returned.
    """
    frames, places = sample_frames(recording, views, count)
    looked, total, times = list(places), len(recording.timeline), 1

    def shown(some: Sequence[tuple[Frame, ...]]) -> Iterator[NDArray[np.bool_]]:
        return (np.array([disk is not None for disk in found]) for found in side_by_side(disks, some))

    seen = dict(zip(places, zip(frames, shown(frames), strict=True), strict=True))
    while times < MOST and np.sum([by for _, by in seen.values()], axis=0).min() < SHOWN * count:
        times *= 2
        more = sorted(set(spread_frames(range(total), times * count)) - set(looked))
        looked += more
        new = frames_at(recording, views, more)
        seen |= {k: (frame, by) for k, frame, by in zip(more, new, shown(new), strict=True) if by.any()}
    kept, room = [], KEPT * count * len(views)
    for cameras in range(len(views), 0, -1):
        alike = sorted(k for k, (_, by) in seen.items() if by.sum() == cameras)
        kept += [alike[k] for k in spread_frames(range(len(alike)), room // cameras)]
        room -= cameras * min(len(alike), room // cameras)
    if len(kept) < FEWEST:
        return frames, places
    return [seen[k][0] for k in sorted(kept)], sorted(kept)


def frames_at(recording: Recording, views: Sequence[CameraView], places: Sequence[int]) -> list[tuple[Frame, ...]]:
    """Return the frames of all cameras at some indices among the frames in use."""

    def at(k: int) -> tuple[Frame, ...]:
        pairs = zip(recording.streams, views, strict=True)
        frames = tuple(next(screened_frames(stream, view.background, k, k + 1, parts)) for stream, view in pairs)
        _ = [shot.reason for shot in frames]  # decodes the whole picture
        return frames

    with ThreadPoolExecutor(DECODING) as parts:
        return list(side_by_side(at, places))
