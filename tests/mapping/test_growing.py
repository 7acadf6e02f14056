"""Relative orientations without a map, and a map that grows with the frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from growing_examples import RATE_HZ, SETTINGS, grown_map, turning_ball  # noqa: F401
from renders import error_deg

from sphereorient import so3
from sphereorient.locate import Frame
from sphereorient.mapping.chain import RelativeTracker
from sphereorient.mapping.disks import cut_out
from sphereorient.mapping.growing import FIRST, FIRST_FRAMES, GrowingMap
from sphereorient.pose.poses import Poses, PoseStart
from sphereorient.trajectory import Reason


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
