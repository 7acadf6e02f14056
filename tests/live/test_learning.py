"""Without a map at the start: the change from relative orientations to a map, and the process that learns it."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace

import pytest
import torch
from growing_examples import RATE_HZ, SETTINGS, grown_map, turning_ball  # noqa: F401
from renders import error_deg

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.live.learning import HANDED, LAST, LearningTracker, MapLearner
from sphereorient.methods.settings import Settings


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
