"""Several balls that pass before each other are followed together, and keep their names."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from several_examples import FRAMES, write_several

from sphereorient import so3
from sphereorient.experiment.recording import open_recording, silent
from sphereorient.follow.scene_tracker import SceneTracker
from sphereorient.locate import screened_frames
from sphereorient.methods import precise
from sphereorient.methods.method import Job, load_learnt, one_thread
from sphereorient.methods.settings import load_settings
from sphereorient.run.stages import run
from sphereorient.run.store import FolderStore, MemoryStore, Request, read_poses
from sphereorient.trajectory import Tracks

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


def test_one_ball_followed_as_a_scene_is_followed_as_ever(tmp_path):
    movie = write_several(tmp_path, "b", cameras=2)
    with open_recording(movie.experiment) as recording, one_thread():
        job = Job(recording=recording, settings=load_settings(None, (CHUNK,)), device=torch.device("cpu"))
        follower = precise.learn(job, silent)
        tracker, views = follower.tracker, follower.appearance.fitter.views

        def shots():
            pairs = zip(recording.streams, views, strict=True)
            return [list(screened_frames(stream, view.background)) for stream, view in pairs]

        scene = SceneTracker({"": tracker}, lambda frame, names, known: {"": tracker._search(frame)})
        times, batch = recording.clock.tolist(), [12, 12, 6]
        alone, together = list(tracker.track(shots(), batch, times)), list(scene.track(shots(), batch, times))
    for one, of_scene in zip(alone, together, strict=True):
        for name, part in one.parts().items():
            assert torch.equal(part, of_scene[""].parts()[name]), name
        assert one.use.tolist() == of_scene[""].use.tolist()
        assert one.reason == of_scene[""].reason
