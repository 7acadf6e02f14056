"""Frames as they come: of movies, bytes, memory, cameras."""

from __future__ import annotations

import io
from collections.abc import Iterator
from threading import Event

import numpy as np
import pytest
from live_examples import EXCERPT, LIMIT_S, arrivals

from sphereorient.errors import MovieError
from sphereorient.experiment.recording import open_recording
from sphereorient.live.feed import Arrival, Feed, camera_frames, movie_frames, raw_frames
from sphereorient.live.shared import ENDED, SharedFrames, shared_frames


def test_a_feed_that_waits_gives_all_frames_in_order():
    feed = Feed(arrivals(50), 3, wait=True)
    assert [one.number for one in feed] == list(range(50))
    assert feed.dropped == 0


def test_a_feed_of_a_camera_drops_the_oldest_frames_and_counts_them():
    ended = Event()

    def source() -> Iterator[Arrival]:
        yield from arrivals(50)
        ended.set()

    feed = Feed(source(), 3, wait=False)
    assert ended.wait(LIMIT_S)
    assert [one.number for one in feed] == [47, 48, 49]
    assert feed.dropped == 47


def test_a_fault_of_the_source_comes_after_its_frames():
    def source() -> Iterator[Arrival]:
        yield from arrivals(2)
        raise MovieError("movie: expected more, got an end; look at it.")

    frames = iter(Feed(source(), 10, wait=True))
    assert [next(frames).number, next(frames).number] == [0, 1]
    with pytest.raises(MovieError, match="expected more"):
        next(frames)


@pytest.fixture(scope="module")
def recording():
    with open_recording(EXCERPT / "experiment.yaml") as opened_:
        yield opened_


def test_raw_bytes_are_the_pictures_of_all_cameras(recording):
    movies = list(movie_frames(recording, paced=False))[:3]
    content = b"".join(picture.tobytes() for one in movies for picture in one.pictures)
    found = list(raw_frames(io.BytesIO(content), recording.streams, 600.0))
    assert [one.time_s for one in found] == pytest.approx([0, 1 / 600, 2 / 600])
    for one, other in zip(found, movies, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one.pictures, other.pictures, strict=True))
    with pytest.raises(MovieError, match="bytes a frame"):
        list(raw_frames(io.BytesIO(content[:-5]), recording.streams, 600.0))


def test_a_ring_in_memory_gives_each_frame_once(recording, tmp_path):
    movies = list(movie_frames(recording, paced=False))
    size = sum(picture.nbytes for picture in movies[0].pictures)
    with SharedFrames(tmp_path / "ring", size, slots=8) as ring:
        ring.write(0.5, movies[0].pictures)
        frames = shared_frames(tmp_path / "ring", recording.streams)
        for k in range(5):
            found = next(frames)
            assert (found.number, found.time_s) == (k, 0.5 + k)
            assert all(np.array_equal(a, b) for a, b in zip(found.pictures, movies[k].pictures, strict=True))
            ring.write(1.5 + k, movies[k + 1].pictures)
        for k in range(20):
            ring.write(10.0 + k, movies[k].pictures)
        assert next(frames).number == 26 - 8 + 1  # 26 were written; the oldest slot may be written at any time
        frames.close()
    assert not (tmp_path / "ring").exists()


def test_a_ring_that_ends_or_is_another_one_is_told(recording, tmp_path):
    path = tmp_path / "ring"
    with pytest.raises(MovieError, match="expected a ring of frames"):
        next(shared_frames(path, recording.streams))
    with SharedFrames(path, 77), pytest.raises(MovieError, match="77 bytes a frame"):
        next(shared_frames(path, recording.streams))
    path.write_bytes(b"x" * 200)
    with pytest.raises(MovieError, match="another file"):
        next(shared_frames(path, recording.streams))
    path.unlink()
    pictures = next(movie_frames(recording, paced=False)).pictures
    with SharedFrames(path, sum(picture.nbytes for picture in pictures)) as ring:
        ring.write(0.0, pictures)
        frames = shared_frames(path, recording.streams)
        next(frames)
        ring._words[ENDED] = 1
        assert list(frames) == []


class FakeDevice:
    """A camera of OpenCV."""

    def __init__(self, pictures: list[np.ndarray], *, opens: bool = True) -> None:
        self.pictures, self.opens, self.released = list(pictures), opens, False

    def isOpened(self) -> bool:
        return self.opens

    def read(self) -> tuple[bool, np.ndarray | None]:
        return (True, self.pictures.pop(0)) if self.pictures else (False, None)

    def release(self) -> None:
        self.released = True


def test_a_camera_gives_grey_pictures_of_the_size_of_the_movie(recording):
    stream = recording.streams[0]
    height, width = stream.movie.frame_shape
    colour = np.dstack([np.full((height, width), value, np.uint8) for value in (10, 20, 30)])  # blue, green, red
    device = FakeDevice([colour, colour[..., 0]])
    first, second = camera_frames(0, stream, lambda number: device)
    assert (int(first.pictures[0][0, 0]), int(second.pictures[0][0, 0])) == (22, 10)
    assert device.released
    with pytest.raises(MovieError, match="px"):
        list(camera_frames(0, stream, lambda number: FakeDevice([colour[:-1]])))
    with pytest.raises(MovieError, match="none that opens"):
        list(camera_frames(0, stream, lambda number: FakeDevice([], opens=False)))
