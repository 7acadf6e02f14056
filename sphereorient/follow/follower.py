"""Tracking batch by batch, while the frames of the next batch are decoded; all cameras together, or each alone."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, islice, pairwise

import torch

from sphereorient import so3
from sphereorient.experiment.recording import Recording
from sphereorient.experiment.stream import spread_frames
from sphereorient.files.threads import side_by_side
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.poses import Poses, no_pose
from sphereorient.follow.scene_tracker import SceneTracker
from sphereorient.follow.settings import RefineSettings
from sphereorient.follow.tracker import OWN, ChunkTracker
from sphereorient.locate import Frame, screened_frames
from sphereorient.pose import CameraView
from sphereorient.trajectory import Reason

DECODING = 2  # threads in which parts of pictures are decoded


class PerCameraTracker:
    """Tracks the sphere in each camera alone; the first that sees it gives the pose, the others contradict."""

    def __init__(self, appearance: Appearance, search: Initialiser, settings: RefineSettings) -> None:
        alone = [appearance.of(k) for k in range(len(appearance.fitter.views))]
        self.trackers = [ChunkTracker(one, search, settings) for one in alone]

    def batches(self, frames: range) -> list[list[int]]:
        """Return the lengths of the chunks of each batch; see `ChunkTracker`."""
        return self.trackers[0].batches(frames)

    def track(self, shots: Sequence[Sequence[Frame]], batch: Sequence[int], time_s: Sequence[float]) -> Iterator[Poses]:
        """Track the chunks of one batch; see `ChunkTracker`."""
        each = [tracker.track([movie], batch, time_s) for tracker, movie in zip(self.trackers, shots, strict=True)]
        yield from (cameras_disagree(poses) for poses in zip(*each, strict=True))


def cameras_disagree(alone: Sequence[Poses]) -> Poses:
    """Return one frame's poses of the first of C cameras that sees the sphere, with the results of the others alone."""
    reason = [poses.reason[0] for poses in alone]
    seeing = [k for k, poses in enumerate(alone) if len(poses) and bool(poses.use.any())]
    if not seeing:
        return no_pose(len(alone), [Reason.LOW_SCORE if why is Reason.OK else why for why in reason])
    main, parts = alone[seeing[0]], alone[seeing[0]].parts()
    for name in ("own_turn", "own_move", *OWN):
        parts[name] = parts[name].new_zeros(len(main), len(alone), *parts[name].shape[2:])
    for k in seeing:
        parts["own_turn"][:, k] = so3.log(alone[k].R_lab_body[:1] @ main.R_lab_body.mT)
        parts["own_move"][:, k] = alone[k].position_lab_mm[:1] - main.position_lab_mm
        for name in OWN:
            own = getattr(alone[k], name)[:, 0]
            parts[name][:, k] = own if k == seeing[0] else own[:1]
        if k != seeing[0]:
            reason[k] = Reason.CONTRADICTS
    use = torch.arange(len(alone)) == seeing[0]
    return Poses(**parts, use=use, reason=tuple(reason))


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Chunks of frames that are tracked together; frames first .. last - 1, counted from the first one used."""

    first: int
    last: int
    lengths: tuple[int, ...]  # of the chunks

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.last - self.first


@dataclass(frozen=True, kw_only=True, eq=False)
class Follower:
    """What single frames are measured with; made by a method, read by `run`."""

    recording: Recording
    appearances: Mapping[str, Appearance]  # of each ball, by name
    tracker: ChunkTracker | PerCameraTracker | SceneTracker

    @property
    def appearance(self) -> Appearance:
        """That of an only ball."""
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
                    _ = frames[begin].reason  # what a chunk begins with is decoded whole
                return frames

            def ahead(batch: Batch) -> list[Future[list[Frame]]]:
                return [pool.submit(read_on, movie, batch) for movie in movies]

            coming = ahead(batches[0])
            for k, batch in enumerate(batches):
                read = [movie.result() for movie in coming]
                coming = ahead(batches[k + 1]) if k + 1 < len(batches) else []
                times = time_s[batch.first : batch.last].tolist()
                if isinstance(self.tracker, SceneTracker):
                    scenes = list(self.tracker.track(read, batch.lengths, times))
                    yield batch, {name: [scene[name] for scene in scenes] for name in self.appearances}
                else:
                    (only,) = self.appearances
                    yield batch, {only: list(self.tracker.track(read, batch.lengths, times))}


def sample_frames(
    recording: Recording, views: Sequence[CameraView], count: int
) -> tuple[list[tuple[Frame, ...]], list[int]]:
    """Return `count` frames of all cameras, spread over the movies, each the first readable one of its stretch, and
    their places among the frames in use.
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
        for k, shots in enumerate(zip(*movies, strict=True), first):
            if not best or sum(shot.usable for shot in shots) > sum(shot.usable for shot in best):
                best, place = shots, k
            if all(shot.usable for shot in best):
                break
        return best, place

    with ThreadPoolExecutor(DECODING) as parts:  # `usable` decodes all of a picture
        found = list(side_by_side(of_stretch, zip(spread, [*spread[1:], total], strict=True)))
    return [shots for shots, _ in found], [place for _, place in found]


def frames_at(recording: Recording, views: Sequence[CameraView], places: Sequence[int]) -> list[tuple[Frame, ...]]:
    """Return the frames of all cameras at some places among the frames in use."""

    def at(k: int) -> tuple[Frame, ...]:
        pairs = zip(recording.streams, views, strict=True)
        shots = tuple(next(screened_frames(stream, view.background, k, k + 1, parts)) for stream, view in pairs)
        _ = [shot.reason for shot in shots]  # decodes all of a picture
        return shots

    with ThreadPoolExecutor(DECODING) as parts:
        return list(side_by_side(at, places))
