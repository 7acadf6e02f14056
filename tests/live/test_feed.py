import io
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from threading import Event, Semaphore
from types import SimpleNamespace

import numpy as np
import pytest
from live_examples import EXCERPT, LIMIT_S, arrivals, until

from sphereorient.errors import MovieError
from sphereorient.experiment.recording import open_recording
from sphereorient.live import shared
from sphereorient.live.feed import Arrival, Feed
from sphereorient.live.shared import ENDED, SharedFrames, shared_frames
from sphereorient.live.sources import movie_frames, raw_frames, recorded, source_of


def let(count: int, goes_on: Semaphore) -> Iterator[Arrival]:
    """Yield frames, each once it is let."""
    for arrival in arrivals(count):
        goes_on.acquire()
        yield arrival


def test_a_feed_that_waits_gives_all_frames_in_order():
    feed = Feed(arrivals(50), 3, wait=True)
    assert [one.number for one in feed] == list(range(50))
    assert feed.dropped == 0


def test_a_frame_that_waits_for_the_tracking_arrives_when_it_is_taken():
    """Frames of movie-fast are read ahead: their waiting time is no latency."""
    with open_recording(EXCERPT / "experiment.yaml") as recording:
        frames = iter(Feed(movie_frames(recording, paced=False), 4, wait=True))
        for _ in range(8):
            before_s = time.perf_counter()
            assert before_s <= next(frames).arrived_s <= time.perf_counter()


def test_frames_of_a_camera_that_is_too_fast_are_skipped_in_growing_steps():
    goes_on, numbers = Semaphore(9), []
    feed = Feed(let(60, goes_on), 64, wait=False)
    frames = iter(feed)
    for newest in range(8, 58, 2):  # two frames come while one is measured
        until(lambda at=newest: feed.newest_s == pytest.approx(0.1 * at))
        numbers.append(next(frames).number)
        goes_on.release(2)
    feed.close()
    steps = np.diff(numbers)
    assert numbers[0] == 0
    assert steps[0] == 2
    assert (steps[1:] <= 2 * steps[:-1]).all()
    assert (np.arange(8, 58, 2) - numbers)[3:].max() <= 1  # frames that wait
    assert feed.dropped == numbers[-1] - len(numbers) + 1


def test_a_feed_of_a_camera_drops_the_oldest_frames_and_counts_them():
    ended = Event()

    def source() -> Iterator[Arrival]:
        yield from arrivals(50)
        ended.set()

    feed = Feed(source(), 3, wait=False)
    assert ended.wait(LIMIT_S)
    assert [one.number for one in feed] == [47, 48, 49]
    assert feed.dropped == 47


def test_after_a_search_steps_begin_anew():
    goes_on = Semaphore(20)
    feed = Feed(let(60, goes_on), 64, wait=False)
    frames = iter(feed)
    until(lambda: feed.newest_s == pytest.approx(1.9))
    assert [next(frames).number for _ in range(3)] == [0, 2, 6]
    feed.restart()
    goes_on.release(20)
    until(lambda: feed.newest_s == pytest.approx(3.9))
    assert [next(frames).number for _ in range(2)] == [8, 12]
    feed.restart()  # soon after the last one: the motion is too quick for steps
    assert [next(frames).number for _ in range(3)] == [13, 15, 19]
    feed.close()
    goes_on.release(40)


def test_after_a_search_in_a_steady_motion_one_frame_may_be_passed_over():
    goes_on = Semaphore(1)
    feed = Feed(let(60, goes_on), 64, wait=False)
    frames = iter(feed)
    for number in range(10):
        assert next(frames).number == number
        goes_on.release(1)
    assert next(frames).number == 10
    feed.restart()
    goes_on.release(20)
    until(lambda: feed.newest_s == pytest.approx(3.0))
    assert next(frames).number == 12
    feed.close()
    goes_on.release(60)


def test_where_a_search_took_so_long_that_frames_behind_it_were_dropped_all_that_wait_are_passed_over():
    goes_on = Semaphore(1)
    feed = Feed(let(60, goes_on), 4, wait=False)
    frames = iter(feed)
    assert next(frames).number == 0
    goes_on.release(20)
    until(lambda: feed.newest_s == pytest.approx(2.0))
    assert feed.dropped == 16
    feed.restart()
    assert feed.dropped == 20
    goes_on.release(1)
    assert next(frames).number == 21
    feed.close()
    goes_on.release(60)


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


@pytest.mark.parametrize("step_s", [0.002, 0.01])
def test_a_ring_is_not_looked_at_while_no_frame_is_due(recording, tmp_path, monkeypatch, step_s):
    pictures, now, looks, written_s = next(movie_frames(recording, paced=False)).pictures, [0.0], [], []

    def sleep(seconds: float) -> None:
        looks.append(now[0])
        now[0] += seconds
        while (due := step_s * (len(written_s) + 1)) <= now[0]:
            ring.write(due, pictures)
            written_s.append(due)

    monkeypatch.setattr(shared, "time", SimpleNamespace(perf_counter=lambda: now[0], sleep=sleep))
    with SharedFrames(tmp_path / "ring", sum(picture.nbytes for picture in pictures)) as ring:
        ring.write(0.0, pictures)
        frames = shared_frames(tmp_path / "ring", recording.streams)
        late_s = np.array([one.arrived_s - one.time_s for one in islice(frames, 80)])
    assert late_s.max() < 0.0003, "a look each 0.2 ms when it is due"
    since = np.array([min(look - due for due in [0.0, *written_s] if due <= look + 1e-9) for look in looks[-20:]])
    assert ((since < 0.0003) | (since > 0.6 * step_s)).all()
    assert sum(look > written_s[39] for look in looks) < 0.4 * 40 * step_s / 0.0002


def test_a_recording_lies_as_the_movies_do_that_flip_mirrors(recording):
    took: list[np.ndarray] = []
    recorders = [SimpleNamespace(room=lambda: True, take=lambda time_s, picture, room: took.append(picture))] * 2
    mirrored = replace(recording, experiment=replace(recording.experiment, flip={"cam2": "vertical"}))
    shown = next(recorded(source_of("movie-fast", pytest.fail), recorders).frames(mirrored)).pictures
    np.testing.assert_array_equal(took[0], shown[0])
    np.testing.assert_array_equal(took[1], shown[1][::-1])


def test_a_ring_that_ends_or_is_another_one_is_reported(recording, tmp_path):
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


def test_a_source_that_stalls_is_reported_once_and_reported_when_it_comes_back(monkeypatch):
    monkeypatch.setattr("sphereorient.live.feed.STALLED_S", 0.02)
    messages: list[str] = []
    goes_on = Event()

    def source() -> Iterator[Arrival]:
        yield from arrivals(3)
        goes_on.wait(LIMIT_S)
        yield from arrivals(3)

    found = []
    for arrival in Feed(source(), 10, wait=True, log=lambda line: (messages.append(line), goes_on.set())):
        found.append(arrival.number)
    assert found == [0, 1, 2, 0, 1, 2]
    assert re.fullmatch(r"source: no frame for 0\.\d s; tracking waits\.", messages[0])
    assert re.fullmatch(r"source: frames arrive again, after 0\.\d s\.", messages[1])
    assert len(messages) == 2


def test_a_slow_source_does_not_stall(monkeypatch):
    monkeypatch.setattr("sphereorient.live.feed.STALLED_S", 0.005)
    messages: list[str] = []

    def source() -> Iterator[Arrival]:
        for arrival in arrivals(8):
            time.sleep(0.02)
            yield replace(arrival, arrived_s=time.perf_counter())

    list(Feed(source(), 10, wait=True, log=messages.append))
    assert len(messages) <= 4  # before the second frame the rate is unknown


def test_a_ring_that_another_one_replaces_is_read_on(recording, tmp_path):
    """The acquisition program was killed, and began again."""
    path = tmp_path / "ring"
    movies = list(movie_frames(recording, paced=False))
    size = sum(picture.nbytes for picture in movies[0].pictures)
    killed = SharedFrames(path, size)
    killed.write(0.0, movies[0].pictures)
    frames = shared_frames(path, recording.streams)
    assert next(frames).number == 0
    path.unlink()
    with SharedFrames(path, size) as ring:
        for k in range(3):
            ring.write(1.0 + k, movies[1 + k].pictures)
        found = next(frames)
        assert (found.number, found.time_s) == (1 + 2, 3.0), "the newest one; numbers go on"
        assert np.array_equal(found.pictures[0], movies[3].pictures[0])
