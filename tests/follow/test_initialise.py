from __future__ import annotations

import torch

from sphereorient.follow.initialise import explaining_first


def order(nll: list[float], score: list[float]) -> list[int]:
    return explaining_first(torch.tensor(nll), torch.tensor(score)).argsort(stable=True).tolist()


def test_a_pose_that_explains_clearly_more_comes_before_a_likelier_one():
    # worn paint: a tenth of the right pose's pixels are off by far
    assert order([36722.0, 35772.0, 36900.0], [0.92, 0.55, 0.9]) == [0, 2, 1]


def test_poses_that_explain_about_as_much_keep_their_order():
    nll = torch.tensor([120.0, 100.0, 130.0])
    score = torch.tensor([0.97, 0.93, 0.9])
    assert explaining_first(nll, score).tolist() == nll.tolist()


def test_a_pose_that_is_less_likely_anyway_keeps_its_likelihood():
    assert explaining_first(torch.tensor([10.0, 500.0]), torch.tensor([0.9, 0.5])).tolist() == [10.0, 500.0]


def test_poses_without_a_likelihood_stay_last():
    assert order([float("inf"), 50.0], [0.99, 0.5]) == [1, 0]
    assert order([float("nan"), 50.0, 40.0], [float("nan"), 0.5, 0.55]) == [2, 1, 0]
