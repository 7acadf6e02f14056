"""Tracking batch by batch, while the frames of the next batch are decoded."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, islice

from sphereorient.experiment.recording import Recording
from sphereorient.experiment.stream import spread_frames
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.per_camera import PerCameraTracker
from sphereorient.follow.poses import Poses
from sphereorient.follow.tracker import ChunkTracker
from sphereorient.locate import Frame, screened_frames
from sphereorient.pose import CameraView


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
    appearance: Appearance
    tracker: ChunkTracker | PerCameraTracker

    @property
    def batches(self) -> list[Batch]:
        """The batches of the whole recording; they depend on frame numbers alone."""
        lengths = self.tracker.batches(self.recording.frames)
        ends = list(accumulate(sum(batch) for batch in lengths))
        return [
            Batch(first=end - sum(batch), last=end, lengths=tuple(batch))
            for end, batch in zip(ends, lengths, strict=True)
        ]

    def follow(self, batches: Sequence[Batch]) -> Iterator[tuple[Batch, list[Poses]]]:
        """Yield the poses of each frame, batch by batch; consecutive batches are decoded ahead."""
        for stretch in _consecutive(batches):
            yield from self._follow(stretch)

    def _follow(self, batches: Sequence[Batch]) -> Iterator[tuple[Batch, list[Poses]]]:
        streams, time_s = self.recording.streams, self.recording.timeline.time_s
        first, last = batches[0].first, batches[-1].last
        with ThreadPoolExecutor(len(streams)) as pool:
            movies = [
                screened_frames(stream, view.background, first, last)
                for stream, view in zip(streams, self.appearance.fitter.views, strict=True)
            ]

            def ahead(batch: Batch) -> list[Future[list[Frame]]]:
                return [pool.submit(_taken, movie, len(batch)) for movie in movies]

            coming = ahead(batches[0])
            for k, batch in enumerate(batches):
                read = [movie.result() for movie in coming]
                coming = ahead(batches[k + 1]) if k + 1 < len(batches) else []
                times = time_s[batch.first : batch.last].tolist()
                yield batch, list(self.tracker.track(read, batch.lengths, times))


def _taken(frames: Iterator[Frame], count: int) -> list[Frame]:
    return list(islice(frames, count))


def _consecutive(batches: Sequence[Batch]) -> Iterator[list[Batch]]:
    stretch: list[Batch] = []
    for batch in batches:
        if stretch and stretch[-1].last != batch.first:
            yield stretch
            stretch = []
        stretch.append(batch)
    if stretch:
        yield stretch


def sample_frames(recording: Recording, views: Sequence[CameraView], count: int) -> list[tuple[Frame, ...]]:
    """Return `count` frames of all cameras, spread over the movies; each the first readable one of its stretch."""
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
