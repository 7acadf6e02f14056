"""Several balls that pass before each other are followed together, and keep their names."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
import yaml
from several_examples import DIAMETER_MM, FRAMES, write_several

from sphereorient import so3
from sphereorient.cameras import perspective_centre_lab_mm
from sphereorient.errors import TrackError
from sphereorient.experiment.recording import open_recording
from sphereorient.files.picture import write_picture
from sphereorient.follow.tracker import Tracker, among_found
from sphereorient.locate import screened_frames
from sphereorient.methods import precise
from sphereorient.methods.method import Job, load_learnt, one_thread, read_poses
from sphereorient.methods.settings import load_settings
from sphereorient.pose.poses import no_pose
from sphereorient.run.stages import run
from sphereorient.run.store import FolderStore, MemoryStore, Request
from sphereorient.trajectory import Reason, Tracks

pytestmark = pytest.mark.slow
CHUNK = "refine.chunk_frames=12"


def tracked(movie, *changed, **known):
    request = Request(experiment=movie.experiment, settings=load_settings(None, (CHUNK, *changed)), **known)
    return run(request, MemoryStore())


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    torch.set_num_threads(1)
    return write_several(tmp_path_factory.mktemp("several"))


@pytest.fixture(scope="module")
def tracks(movie):
    return tracked(movie, save_learnt=movie.experiment.with_name("learnt.h5"))


def off(track, movie, name):
    """Errors of a track as of a ball, (N,) degrees and (N,) mm."""
    R, expected = torch.from_numpy(track.orientation), torch.from_numpy(movie.R_lab_body[name])
    turn = np.degrees(so3.geodesic_distance(R, expected).numpy())
    return turn, np.linalg.norm(track.position - movie.position_mm[name], axis=1)


def test_all_balls_are_measured_in_all_frames_and_none_is_taken_for_another(tracks, movie):
    assert isinstance(tracks, Tracks)
    assert list(tracks) == ["a", "b", "c"]
    named = min(  # names of balls painted alike are free, as a whole
        permutations("ac"), key=lambda order: np.nanmedian(off(tracks[order[0]], movie, "a")[1])
    )
    for name, track in (("a", tracks[named[0]]), ("b", tracks["b"]), ("c", tracks[named[1]])):
        turn, place = off(track, movie, name)
        assert track.valid.sum() >= FRAMES - 1
        assert np.median(turn[track.valid]) < 0.2
        assert turn[track.valid].max() < 1.5
        assert np.median(place[track.valid]) < 0.03
        assert place[track.valid].max() < 0.3
        assert np.isnan(track.identity).all()


def test_results_do_not_depend_on_how_many_chunks_are_followed_side_by_side(tracks, movie):
    again = tracked(movie, "refine.chunks=1", learnt=movie.experiment.with_name("learnt.h5"))
    for name, track in tracks.items():
        assert again[name].orientation.tobytes() == track.orientation.tobytes()
        assert again[name].position_cov.tobytes() == track.position_cov.tobytes()


def test_a_cut_run_goes_on_to_the_same_tracks(tracks, movie, tmp_path):
    known = load_learnt(movie.experiment.with_name("learnt.h5"))
    assert list(known) == list(tracks)
    out = tmp_path / "tracks.h5"
    changed = load_settings(None, (CHUNK, "refine.chunks=1"))
    request = Request(experiment=movie.experiment, out=out, settings=changed, learnt=known)
    store = FolderStore(request.parts)

    def cut(stage: str, done: int, total: int) -> None:
        if stage == "track" and done > 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(request, store, progress=cut)
    (first, *_) = sorted(store.folder.glob("poses-*.h5"))
    assert list(read_poses(first)) == list(tracks)
    run(request, store, resume=True)
    found = Tracks.load(out)
    for name, track in tracks.items():
        assert found[name].orientation.tobytes() == track.orientation.tobytes()


class Astray:
    """A ball's tracker that cannot follow it into one frame."""

    def __init__(self, tracker, frame):
        self.tracker, self.frame = tracker, frame

    def __getattr__(self, name):
        return getattr(self.tracker, name)

    def ahead(self, chunk, frame):
        return None if frame == self.frame else self.tracker.ahead(chunk, frame)


def followed_where(movie, again, exchanged=False):
    """Poses in a chunk of 20 frames in which no motion leads from frame 7 to 8, and a search finds `a` and `c` again in
    frame `again`.
    """
    learnt = load_learnt(movie.experiment.with_name("learnt.h5"))
    with open_recording(movie.experiment) as recording, one_thread():
        job = Job(recording=recording, settings=load_settings(None, (CHUNK,)), device=torch.device("cpu"))
        follower = precise.resume(job, learnt)
        scene, views = follower.tracker, next(iter(follower.appearances.values())).fitter.views
        frames = [list(screened_frames(s, v.background, 0, 20)) for s, v in zip(recording.streams, views, strict=True)]
        number = {id(frame): k for k, frame in enumerate(frames[0])}

        def start(frame, names, known, past):
            if 0 < number[id(frame[0])] < again:
                return {name: no_pose(len(frame), [Reason.NOT_FOUND] * len(frame)) for name in names}
            found = scene.start(frame, names, known, past)
            return found | {"a": found["c"], "c": found["a"]} if exchanged and number[id(frame[0])] == again else found

        balls = {name: tracker if name == "b" else Astray(tracker, 8) for name, tracker in scene.balls.items()}
        tracker = Tracker(balls)
        tracker.start = start
        return list(tracker.track(frames, [20], recording.clock.tolist()))


def names_of(found, movie):
    """The ball, of those alike, at the place of each pose of `a`; "" without a pose."""

    def name(poses):
        return min("ac", key=lambda ball: np.linalg.norm(poses[0] - movie.position_mm[ball][poses[1]]))

    rows = [(found[k]["a"].position_lab_mm[0].numpy(), k) if len(found[k]["a"]) else None for k in range(len(found))]
    return "".join("-" if row is None else name(row) for row in rows)


def test_a_ball_that_is_found_late_is_followed_back_to_where_it_was_lost(tracks, movie):
    found = followed_where(movie, again=13)
    (first, *_) = names_of(found, movie)
    assert names_of(found, movie) == first * 20
    poses = [row["a"] for row in found[8:13]]
    X = np.stack([one.position_lab_mm[0].numpy() for one in poses])
    assert np.linalg.norm(X - movie.position_mm[first][8:13], axis=1).max() < 0.05
    assert all(one.use.any() for one in poses)


def test_another_ball_found_in_its_place_is_not_joined_to_it(tracks, movie):
    names = names_of(followed_where(movie, again=13, exchanged=True), movie)
    first, other = names[0], names[-1]
    assert first != other
    assert names == first * 8 + "-" + other * 11


def test_a_ball_found_behind_another_is_hidden_in_that_camera(tracks, movie):
    learnt = load_learnt(movie.experiment.with_name("learnt.h5"))
    with open_recording(movie.experiment) as recording, one_thread():
        job = Job(recording=recording, settings=load_settings(None, (CHUNK,)), device=torch.device("cpu"))
        balls = precise.resume(job, learnt).tracker.balls
        searches = {name: tracker.search for name, tracker in balls.items()}
        views = searches["b"].fitter.views
        frame = [next(screened_frames(s, v.background, 0, 1)) for s, v in zip(recording.streams, views, strict=True)]
        (found,) = Tracker(balls).start(frame, ["b"], {}, {}).values()
    assert found.use.all()
    eye = perspective_centre_lab_mm(views[0].camera, found.position_lab_mm)
    toward = torch.nn.functional.normalize(eye - found.position_lab_mm, dim=-1)
    before = replace(found, position_lab_mm=found.position_lab_mm + 2 * DIAMETER_MM * toward)
    seen = balls["b"].looked_past(found, frame, among_found([("b", {"a": before})], searches))
    assert seen.use.tolist() == [False, True, True]
    assert seen.reason == (Reason.HIDDEN, Reason.OK, Reason.OK)


def test_learnt_results_take_mask_and_response_of_the_experiment(tracks, movie):
    learnt = load_learnt(movie.experiment.with_name("learnt.h5"))["a"]
    keys = yaml.safe_load(movie.experiment.read_text())
    mask = np.full((260, 260), 255, np.uint8)
    mask[:, :120] = 0
    write_picture(movie.experiment.with_name("mask.png"), mask)
    masked = movie.experiment.with_name("masked.yaml")
    masked.write_text(yaml.safe_dump(keys | {"masks": {"cam1": "mask.png"}}))
    with open_recording(masked) as recording:
        first, *others = learnt.appearance(recording.of("a")).fitter.views
    assert np.array_equal(first.background.shown, mask > 0)
    assert all(view.background.shown is None for view in others)
    masked.write_text(yaml.safe_dump(keys | {"response": {"cam1": "srgb"}}))
    with open_recording(masked) as recording, pytest.raises(TrackError, match="response of cam1: expected srgb"):
        learnt.appearance(recording.of("a"))
