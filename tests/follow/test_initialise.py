from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sphereorient.follow.initialise import Initialiser, explaining_first
from sphereorient.locate import LocateSettings
from sphereorient.locate.background import Background
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.poses import FittedPoses, blank_parts


def likelihood(nll: list[float], *score: list[float]) -> torch.Tensor:
    """Likelihood of poses with the scores of each camera."""
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
    # the second camera sees only unseen paint of the right pose, and any paint of a wrong one
    assert order([100.0, 200.0], [0.99, 0.6], [0.0, 0.6]) == [0, 1]
    assert order([100.0, 200.0], [0.0, 0.6], [0.0, 0.6]) == [1, 0]


def test_poses_without_a_likelihood_stay_last():
    assert order([float("inf"), 50.0], [0.99, 0.5]) == [1, 0]
    assert order([float("nan"), 50.0, 40.0], [float("nan"), 0.5, 0.55]) == [2, 1, 0]


def test_a_blob_with_less_merit_than_the_balls_is_none():
    rows, columns = np.mgrid[:160, :160]
    disk = np.hypot(rows - 80, columns - 70) < 20
    empty = Background(mean=np.zeros(disk.shape, np.float32), noise=np.ones(disk.shape, np.float32), full_scale=255.0)
    view = CameraView(name="cam1", camera=None, background=empty, diameter_px=40.0, sight=None)
    search = Initialiser(fitter=None, proposers={}, locating=LocateSettings(), candidates=1, known={})
    picture = np.where(disk, 120, 0).astype(np.uint8)
    merit = search.merit(picture, view)
    assert merit > 0
    assert search.merit(picture, replace(view, merit_min=0.99 * merit)) == merit
    assert search.merit(picture, replace(view, merit_min=1.01 * merit)) == 0
