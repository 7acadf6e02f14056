"""Without a map: relative orientations, a map that grows with the frames, and the change from one to the other."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from renders import error_deg
from test_fixed_centre import truth

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.follow.poses import Poses
from sphereorient.live.growing_map import FIRST, FIRST_FRAMES, GrowingMap
from sphereorient.live.learning import HANDED, LAST, LearningTracker, MapLearner
from sphereorient.live.relative import RelativeTracker
from sphereorient.locate import Frame, LocateSettings, screened_frames
from sphereorient.mapping.disks import cut_out, fixed_place
from sphereorient.mapping.settings import MapSettings
from sphereorient.methods.settings import Settings
from sphereorient.pose.poses import PoseStart
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Reason

SETTINGS = MapSettings(pixels=500)
RATE_HZ = 600.0


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A ball that turns in its place by 7 degrees a frame: its place, pictures and true attitudes."""
    settings = SynthSettings(
        frames=70, image_size=(150, 150), diameter_px=56.0, volume_mm=8.0, velocity_rms=0.0, exposure=1e-4,
        exposure_samples=1, omega_rms=60.0, seed=5,
    )  # fmt: skip
    path = write_synthetic_experiment(tmp_path_factory.mktemp("turns"), settings)
    experiment = load_experiment(path).with_sphere(fixed=True, texture_path=None)
    with open_recording(experiment, ["cam1"], textured=False) as recording:
        place = fixed_place(recording, SETTINGS, LocateSettings())
        shots = list(screened_frames(recording.streams[0], place.views[0].background))
        for shot in shots:
            _ = shot.picture
    return SimpleNamespace(place=place, shots=shots, R=truth(path)[1], X=truth(path)[0])


def relative(ball, numbers) -> list[tuple[Poses, bool]]:
    tracker = RelativeTracker(ball.place, SETTINGS)
    return [tracker.next(k / RATE_HZ, [ball.shots[k]]) for k in numbers]


@pytest.mark.slow
def test_relative_orientations_follow_the_ball_from_frame_to_frame(ball):
    found = relative(ball, range(40))
    R = torch.cat([poses.R_lab_body for poses, _ in found])
    assert torch.equal(R[0], torch.eye(3, dtype=torch.float64))
    step = error_deg(R[1:] @ R[:-1].mT, ball.R[1:40] @ ball.R[:39].mT)
    assert step.median() < 0.5
    # What is off is the rate: an outline that is too small or large makes all turns too large or small.
    assert error_deg(R, ball.R[:40]).max() < 6.0
    assert [searched for _, searched in found] == [True] + [False] * 39
    stated = found[-1][0].covariance[0, :3, :3].diagonal().sum().sqrt()
    assert torch.rad2deg(stated) == pytest.approx(1.0)


@pytest.mark.slow
def test_a_dark_frame_and_another_thing_have_no_relative_orientation(ball):
    tracker = RelativeTracker(ball.place, SETTINGS)
    shape = ball.shots[0].picture.shape
    background = ball.place.views[0].background
    dark = Frame(shown=np.zeros(shape, np.uint8), background=background)
    noise = Frame(shown=np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8), background=background)
    for k in range(4):
        tracker.next(k / RATE_HZ, [ball.shots[k]])
    poses, _ = tracker.next(4 / RATE_HZ, [dark])
    assert (len(poses), poses.reason) == (0, (Reason.DARK,))
    poses, searched = tracker.next(5 / RATE_HZ, [noise])
    assert (len(poses), poses.reason, searched) == (0, (Reason.LOW_SCORE,), True)
    poses, _ = tracker.next(6 / RATE_HZ, [ball.shots[6]])
    turn = poses.R_lab_body[0]
    assert error_deg(turn[None], (ball.R[6] @ ball.R[0].mT)[None]) < 2.0


@pytest.mark.slow
def test_relative_orientations_survive_times_that_stand(ball):
    tracker = RelativeTracker(ball.place, SETTINGS)
    found = [tracker.next(time_s, [ball.shots[k]])[0] for k, time_s in enumerate((0.0, 0.1, 0.1, 0.05, 0.2))]
    R = torch.cat([poses.R_lab_body for poses in found])
    assert error_deg(R[1:] @ R[:-1].mT, ball.R[1:5] @ ball.R[:4].mT).max() < 1.0


@pytest.fixture(scope="module")
def grown(ball):
    """A map of 60 frames, after four iterations, from orientations in the body frame of the first frame."""
    growing = GrowingMap(ball.place, SETTINGS)
    Q = ball.R[0].mT
    for k in range(60):
        growing.add(cut_out(ball.place, [ball.shots[k].picture]), ball.R[k] @ Q)
        if k in (FIRST_FRAMES, 40, 50, 59):
            assert growing.ready()
            growing.iterate(size=k >= 50)
    return growing, growing.live_map()


@pytest.mark.slow
def test_a_growing_map_finds_new_frames_in_the_body_frame_that_it_was_given(ball, grown):
    growing, found = grown
    assert found.trusted
    assert found.number == 1
    assert 0.3 < found.seen_share <= 1.0
    fitter, rows = found.appearance.fitter, range(60, 70)
    X = found.centre.position_lab_mm.expand(10, 3)
    pixels = fitter.pixels([[ball.shots[k].picture] for k in rows], X, fitter.optics.fine)
    start = ball.R[60:70] @ ball.R[0].mT @ found.R_map_body.mT
    use, precision = torch.ones(10, 1, dtype=torch.bool), found.centre.precision.expand(10, 3, 3)
    fit = fitter.fit(pixels, PoseStart(X, start, use, precision), fitter.optics.fine, 5)
    error = error_deg(fit.R_lab_body @ found.R_map_body, ball.R[60:70] @ ball.R[0].mT)
    assert error.median() < 0.5
    texture, seen = growing.paint()
    assert torch.equal(seen == 0, texture.isnan())


@pytest.mark.slow
def test_frames_that_come_extend_the_map_in_its_body_frame_though_theirs_has_drifted(ball):
    growing = GrowingMap(ball.place, SETTINGS)
    Q = ball.R[0].mT
    drifted = Q @ so3.exp(torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64))
    for k in range(25):
        growing.add(cut_out(ball.place, [ball.shots[k].picture]), ball.R[k] @ Q)
    first = [growing.grown(idle=False) for _ in range(FIRST)][-1]
    for k in range(25, 45):
        growing.add(cut_out(ball.place, [ball.shots[k].picture]), ball.R[k] @ drifted)
        if k % 5 == 4:
            found = growing.grown(idle=False)
    assert (growing.done, found.number) == (FIRST, 5), "no iteration"
    assert found.seen_share > first.seen_share + 0.1
    assert not growing.whole
    X = found.centre.position_lab_mm
    before, after = [
        one.appearance.fitter.fit(
            one.appearance.fitter.pixels([[ball.shots[44].picture]], X[None], one.appearance.fitter.optics.fine),
            PoseStart(
                X[None], (ball.R[44] @ Q @ one.R_map_body.mT)[None], torch.ones(1, 1, dtype=torch.bool),
                one.centre.precision[None],
            ),
            one.appearance.fitter.optics.fine, 5,
        )
        for one in (first, found)
    ]  # fmt: skip
    assert after.score > found.appearance.score_min
    assert after.score > before.score
    assert error_deg(after.R_lab_body @ found.R_map_body, (ball.R[44] @ Q)[None]) < 0.6
    assert error_deg((drifted @ found.R_recent_map)[None], (Q @ found.R_map_body.mT)[None]) < 0.6
    for k in range(45, 60):
        growing.add(cut_out(ball.place, [ball.shots[k].picture]), ball.R[k] @ drifted)
    parts = [growing.grown(idle=False) for _ in range(4)]  # of the iteration of twice as many frames
    assert (growing.done, growing.whole) == (FIRST + 1, True)
    assert parts[0] is not None, "extended before"
    assert parts[-1].number == found.number + 2


@pytest.mark.slow
def test_a_map_of_the_wrong_orientations_is_not_trusted(ball):
    growing = GrowingMap(ball.place, SETTINGS)
    wrong = so3.random_rotations(FIRST_FRAMES, generator=torch.Generator().manual_seed(1))
    for k in range(FIRST_FRAMES):
        growing.add(cut_out(ball.place, [ball.shots[k].picture]), wrong[k])
    growing.iterate()
    growing.iterate()
    assert not growing.live_map().trusted


class Known:
    """A learner that gives one map from a frame on."""

    def __init__(self, found, after: int) -> None:
        self.found, self.after, self.handed = found, after, 0

    @property
    def newest(self):
        return self.found if self.handed >= self.after else None

    def hand(self, shots, R_lab_body) -> None:
        self.handed += 1


@pytest.mark.slow
def test_the_change_to_a_map_is_no_jump_and_its_number_tells_it(ball, grown):
    tracker = LearningTracker(ball.place, Settings(), Known(grown[1], 10))
    found, numbers = [], []
    for k in range(30):
        poses, searched = tracker.next(k / RATE_HZ, [ball.shots[k]])
        found.append(poses.R_lab_body[0])
        numbers.append(tracker.number)
        assert searched == (k == 0)
    assert numbers == [0] * 10 + [1] * 20
    R = torch.stack(found)
    step = error_deg(R[1:] @ R[:-1].mT, ball.R[1:30] @ ball.R[:29].mT)
    assert step[9] < 0.5, "the frame of the change"
    after = R[10:] @ ball.R[10:30].mT  # one turn of the body frame
    Q = so3.nearest_rotation((ball.R[10:30].mT @ R[10:]).mean(0))
    assert error_deg(R[10:], ball.R[10:30] @ Q).median() < 0.3
    assert after.isfinite().all()


@pytest.mark.slow
def test_a_map_of_another_ball_is_not_taken(ball, grown):
    found = grown[1]
    other = replace(found, R_recent_map=so3.exp(torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)))
    tracker = LearningTracker(ball.place, Settings(), Known(other, LAST))
    numbers = []
    for k in range(12):
        tracker.next(k / RATE_HZ, [ball.shots[k]])
        numbers.append(tracker.number)
    assert numbers == [0] * 12


@pytest.mark.slow
def test_a_learner_in_its_own_process_gives_a_map_and_its_paint(ball):
    learner = MapLearner()
    try:
        learner.begin(ball.place, SETTINGS)
        for k in range(40):
            learner.hand([ball.shots[k]], ball.R[k])
        assert learner._count <= min(40, HANDED)
        texture, seen = learner.paint()
    finally:
        learner.close()
    assert texture.shape == seen.shape
    assert float((seen > 0).double().mean()) > 0.3


@pytest.mark.slow
def test_ctrl_c_does_not_end_the_learner_and_without_it_there_is_no_waiting(ball):
    learner = MapLearner()
    try:
        learner.begin(ball.place, SETTINGS)
        for k in range(30):
            learner.hand([ball.shots[k]], ball.R[k])
        until = time.monotonic() + 60
        while learner.newest is None and time.monotonic() < until:
            time.sleep(0.1)
        os.kill(learner._process.pid, signal.SIGINT)
        assert learner.paint()[0].isfinite().any()
        learner._process.kill()
        learner._paint = None
        begun = time.monotonic()
        with pytest.raises(PaintError, match="learnt meanwhile"):
            learner.paint()
        assert time.monotonic() - begun < 30
    finally:
        learner.close()
