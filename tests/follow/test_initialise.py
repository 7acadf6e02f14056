from __future__ import annotations

import torch

from sphereorient.follow.initialise import explaining_first
from sphereorient.pose.poses import FittedPoses, blank_parts


def likelihood(nll: list[float], *score: list[float]) -> torch.Tensor:
    """Of poses with the scores of each camera."""
    parts = blank_parts(len(score), len(nll)) | {"nll": torch.tensor(nll), "score": torch.tensor(score).T}
    return explaining_first(FittedPoses(**parts), torch.ones(len(score), dtype=torch.bool))


def order(nll: list[float], *score: list[float]) -> list[int]:
    return likelihood(nll, *score).argsort(stable=True).tolist()


def test_a_pose_that_explains_clearly_more_comes_before_a_likelier_one():
    # worn paint: a tenth of the right pose's pixels are off by far
    assert order([36722.0, 35772.0, 36900.0], [0.92, 0.55, 0.9]) == [0, 2, 1]


def test_poses_that_explain_about_as_much_keep_their_order():
    nll = [120.0, 100.0, 130.0]
    assert likelihood(nll, [0.97, 0.93, 0.9]).tolist() == nll


def test_a_pose_that_is_less_likely_anyway_keeps_its_likelihood():
    assert likelihood([10.0, 500.0], [0.9, 0.5]).tolist() == [10.0, 500.0]


def test_a_disk_of_unknown_paint_does_not_count():
    # the second camera sees nothing known of the right pose, and of a wrong one what might be anything
    assert order([100.0, 200.0], [0.99, 0.6], [0.0, 0.6]) == [0, 1]
    assert order([100.0, 200.0], [0.0, 0.6], [0.0, 0.6]) == [1, 0]


def test_poses_without_a_likelihood_stay_last():
    assert order([float("inf"), 50.0], [0.99, 0.5]) == [1, 0]
    assert order([float("nan"), 50.0, 40.0], [float("nan"), 0.5, 0.55]) == [2, 1, 0]
