"""Prediction of the next frame from earlier ones, and disagreement of two cameras."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from conftest import assert_close
from refine_examples import f64
from torch import Tensor

from sphereorient import so3
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.chunk import Chunk, mirrored, regained
from sphereorient.follow.follower import cameras_disagree
from sphereorient.follow.initialise import by_decreasing_size
from sphereorient.pose.poses import Poses, blank_parts, no_pose
from sphereorient.trajectory import Reason

TIMES = [0.0, 1.0, 2.5, 3.2]
RADIUS_MM = 9.0
AXIS = f64([0.6, -0.3, 0.74])


def angle(time: float, change: float) -> float:
    return 0.04 * time + 0.5 * change * time**2


def place(time: float, change: float) -> Tensor:
    return f64([1.0, -2.0, 3.0]) + angle(time, change) * f64([2.0, 1.0, -1.0])


def seen(time: float, change: float) -> Poses:
    """The exact pose at a time of a motion whose rates change evenly."""
    parts = blank_parts(2, 1)
    parts |= {name: torch.ones_like(parts[name]) for name in ("own_sigma_mm", "excess", "score")}
    parts["position_lab_mm"], parts["R_lab_body"] = place(time, change)[None], so3.exp(angle(time, change) * AXIS)[None]
    parts["covariance"] = 1e-10 * torch.eye(6, dtype=torch.float64)[None]
    return Poses(**parts, use=torch.tensor([True, True]), reason=(Reason.OK, Reason.OK))


def lane(frames: list[int], change: float, times: list[float] = TIMES) -> Chunk:
    found = Chunk(0, times)
    for frame in frames:
        now = seen(times[frame], change)
        before = found.past[-1][1].R_lab_body[0] if found.past else now.R_lab_body[0]
        found.saw(frame, now, so3.log(now.R_lab_body[0] @ before.mT).numpy())
    return found


@pytest.mark.parametrize(("frames", "change"), [([1, 2], 0.0), ([0, 1, 2], 0.0), ([0, 1, 2], 0.02)], ids=str)
def test_the_next_pose_continues_the_motion_at_any_times(frames, change):
    expected = lane(frames, change).expected(3, RADIUS_MM)
    assert not expected.rough
    assert_close(f64(expected.position_lab_mm), place(3.2, change), 1e-9)
    assert_close(so3.exp(f64(expected.turn)) @ f64(expected.R_before), so3.exp(angle(3.2, change) * AXIS), 1e-6)


def test_half_of_a_change_of_rotation_within_the_scatter_of_poses_goes_on():
    exact, times = lane([0, 1, 2], 0.02, [0.0, 1.0, 2.0, 3.0]), [0.0, 1.0, 2.0, 3.0]
    scattered = Chunk(0, times, past=exact.past.copy(), turns=exact.turns.copy())
    for k, (number, poses) in enumerate(exact.past):
        scattered.past[k] = number, replace(poses, covariance=torch.eye(6, dtype=torch.float64)[None])
    last, before = exact.turns[1], exact.turns[0]
    assert_close(f64(exact.expected(3, RADIUS_MM).turn), f64(last + (last - before)), 1e-6)
    assert_close(f64(scattered.expected(3, RADIUS_MM).turn), f64(last + 0.5 * (last - before)), 1e-12)


@pytest.mark.parametrize("change", [0.0, 0.02])
def test_a_later_pose_is_that_of_the_polynomial_and_its_error_holds_the_next_lower_order(change):
    times = [0.0, 1.0, 2.0, 3.0, 4.0]
    ahead = lane([0, 1, 2], change, times).extrapolated(4)
    assert_close(ahead.position_lab_mm, place(4.0, change), 1e-9)
    assert_close(ahead.R_lab_body, so3.exp(angle(4.0, change) * AXIS), 1e-9)
    # Weights 3, -8, 6 of the three poses; the line through the last two is off by twice the second difference.
    lower = 3 * angle(2.0, change) - 2 * angle(1.0, change) - angle(4.0, change)
    move = lower * f64([2.0, 1.0, -1.0])
    spread = (9 + 64 + 36) * 1e-10
    assert_close(ahead.covariance[3:, 3:], (spread + move @ move) * torch.eye(3).double(), 1e-12)
    assert_close(ahead.covariance[:3, :3], (spread + lower**2 * (AXIS @ AXIS)) * torch.eye(3).double(), 1e-12)
    assert lane([2], change).extrapolated(3) is None


def test_the_shutter_sees_its_share_of_the_motion():
    # From 2 to 3.2: a shutter that is open for 0.3 of these 1.2 sees a quarter of the way.
    expected = lane([0, 1, 2], 0.0).expected(3, RADIUS_MM, exposure_s=0.3)
    way = torch.cat([(angle(3.2, 0.0) - angle(TIMES[2], 0.0)) * AXIS, place(3.2, 0.0) - place(TIMES[2], 0.0)])
    assert_close(f64(expected.moved), 0.3 / (TIMES[3] - TIMES[2]) * way, 1e-9)
    rough = lane([2], 0.0).expected(3, RADIUS_MM, exposure_s=0.3)
    assert not rough.moved.any()
    assert rough.open_share == pytest.approx(0.3 / (TIMES[3] - TIMES[2]))


def test_without_a_known_motion_the_ball_is_near_where_it_was():
    for one in (lane([2], 0.0), lane([0, 2], 0.0)):
        expected = one.expected(3, RADIUS_MM)
        assert expected.rough
        assert_close(f64(expected.R_before), one.past[-1][1].R_lab_body[0])
        assert not expected.turn.any()
        assert_close(f64(expected.place_spread).diagonal().sqrt(), f64([2.7] * 3), 1e-6)


def test_after_a_pause_the_rate_goes_on_roughly():
    one = lane([0, 1, 2], 0.0, [0.0, 1.0, 2.0, 9.0])
    expected = one.expected(3, RADIUS_MM)
    assert expected.rough
    assert_close(f64(expected.turn), 7.0 * f64(one.turns[-1]), 1e-9)
    assert_close(f64(expected.place_spread).diagonal().sqrt(), f64([2.7] * 3), 1e-6)
    far = lane([0, 1, 2], 0.0, [0.0, 1.0, 2.0, 900.0]).expected(3, RADIUS_MM)
    assert not far.turn.any()


@pytest.mark.parametrize("late", [0, 1])
def test_a_late_time_stamp_does_not_bend_the_motion(late):
    stamps = [0.0, 1.0, 2.0, 3.0]
    stamps[late] = late + 0.99
    appended_late = Chunk(0, stamps)
    for frame in range(3):
        appended_late.saw(frame, seen(frame, 0.0), 0.04 * AXIS.numpy())
    expected = appended_late.expected(3, RADIUS_MM)
    assert not expected.rough
    assert_close(f64(expected.turn), 0.04 * AXIS, 1e-9)
    assert_close(f64(expected.position_lab_mm), place(3.0, 0.0), 1e-9)


def test_after_a_frame_without_the_ball_nothing_is_expected():
    assert lane([0, 1], 0.0).expected(3, RADIUS_MM) is None


@pytest.mark.parametrize("change", [0.0, 0.01])
def test_a_ball_is_followed_back_to_where_it_came_into_view(change):
    (back,) = mirrored([range(len(TIMES))], TIMES)
    for frame in (3, 2, 1):
        now = seen(TIMES[frame], change)
        before = back.past[-1][1].R_lab_body[0] if back.past else now.R_lab_body[0]
        back.saw(-frame, now, so3.log(now.R_lab_body[0] @ before.mT).numpy())
    ahead = back.expected(0, RADIUS_MM)
    assert ahead is not None
    assert_close(torch.from_numpy(ahead.position_lab_mm), place(TIMES[0], change), atol=1e-9)
    R = so3.exp(torch.from_numpy(ahead.turn)) @ torch.from_numpy(ahead.R_before)
    assert_close(R, seen(TIMES[0], change).R_lab_body[0], atol=1e-6)


def test_only_a_ball_that_comes_into_view_is_followed_back():
    assert regained([False, True, True])
    assert regained([True, False, True])
    assert not regained([True, True, False])
    assert not regained([False, False])


def test_cameras_disagree_where_their_own_turns_are_apart_by_more_than_usual_and_by_more_than_their_errors():
    x = f64([1.0, 0.0, 0.0])

    def disagree(first: float, second: float, sigma: float = 1e-3, both: bool = True) -> bool:
        fit = SimpleNamespace(
            own_turn=torch.stack([first * x, second * x])[None],
            own_covariance=(sigma**2 * torch.eye(3, dtype=torch.float64)).expand(1, 2, 3, 3),
        )
        tracker = SimpleNamespace(usual_apart_rad=0.002)
        return bool(BallTracker.contradictory(tracker, fit, torch.tensor([[True, both]])))

    assert disagree(0.006, -0.006)
    assert not disagree(0.006, 0.006), "both would rotate the pose alike"
    assert not disagree(0.003, -0.003), "four times the usual angle are 0.008"
    assert not disagree(0.006, -0.006, sigma=0.005), "no more than their errors"
    assert not disagree(0.006, -0.006, both=False), "one camera"


def part(turn: float, cameras: int) -> Poses:
    """Poses by some cameras, rotated about x from those of others."""
    whole = seen(0.0, 0.0)
    names = ("own_turn", "own_covariance", "own_move", "own_sigma_mm", "limb_coverage", "excess", "score")
    return replace(
        whole,
        R_lab_body=so3.exp(f64([[turn, 0.0, 0.0]])),
        use=torch.ones(cameras, dtype=torch.bool),
        reason=(Reason.OK,) * cameras,
        **{name: getattr(whole, name)[:, :cameras] for name in names},
    )


def test_those_that_agree_give_the_pose_and_the_other_contradicts():
    found = cameras_disagree([part(0.0, 2), part(0.3, 1)], [(0, 2), (1,)])
    assert found.use.tolist() == [True, False, True]
    assert found.reason == (Reason.OK, Reason.CONTRADICTS, Reason.OK)
    assert_close(found.own_turn[0], f64([[0.0] * 3, [0.3, 0.0, 0.0], [0.0] * 3]))


def test_where_those_that_agree_do_not_see_it_the_other_gives_the_pose():
    lost = no_pose(2, [Reason.NOT_FOUND, Reason.DARK])
    found = cameras_disagree([lost, part(0.3, 1)], [(0, 2), (1,)])
    assert found.use.tolist() == [False, True, False]
    assert found.reason == (Reason.NOT_FOUND, Reason.OK, Reason.DARK)


def test_subsets_come_by_decreasing_size():
    assert list(by_decreasing_size([0, 1])) == [[(0,), (1,)]]  # of two cameras: each alone
    assert list(by_decreasing_size([0, 2, 3])) == [[(0, 2), (0, 3), (2, 3)], [(0,), (2,), (3,)]]
    assert list(by_decreasing_size([1])) == []


def test_frames_that_are_followed_back_have_rising_times():
    (back,) = mirrored([range(3, 6)], [0.0, 0.1, 0.2, 0.3, 0.5, 0.8])
    assert [back.time_s[frame] for frame in range(back.first, back.first + 3)] == [-0.8, -0.5, -0.3]


def test_each_pose_keeps_the_own_rotation_of_the_camera_in_use():
    one, other = part(0.0, 1), part(0.3, 1)
    parts = {name: torch.cat([value, value]) for name, value in one.parts().items()}
    parts["R_lab_body"] = so3.exp(f64([[0.0] * 3, [1.5, 0.0, 0.0]]))
    found = cameras_disagree([Poses(**parts, use=one.use, reason=one.reason), other], [(0,), (1,)])
    assert_close(found.own_turn[:, 0], torch.zeros(2, 3, dtype=torch.float64))
    assert_close(found.own_turn[:, 1, 0], f64([0.3, -1.2]))
