"""The start of a frame of several balls: names by paint, lines of sight, size and motion."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from conftest import assert_close
from locate_examples import SETTINGS, even_background, looking_along_y, looking_down

from sphereorient import so3
from sphereorient.cameras import sphere_disk_px
from sphereorient.follow.scene_start import Ahead, SceneStart, look_of
from sphereorient.locate import CameraScene, Frame, Match, places_of
from sphereorient.locate.position import assigned
from sphereorient.pose import CameraView
from sphereorient.pose.poses import Poses, blank_parts
from sphereorient.trajectory import Reason

RADIUS = 9.0
CAMERAS = {"cam1": looking_along_y(), "cam2": looking_down()}
SHAPE = (650, 650)


def rotation(*rotvec):
    return so3.exp(torch.tensor(rotvec, dtype=torch.float64))


class Planted:
    """A ball whose paint is known exactly: disks show the rotations of the planted balls that have it."""

    def __init__(self, paint, truth, worse=()):
        self.paint, self.truth, self.worse = paint, truth, worse
        scene = CameraScene(background=even_background(SHAPE), diameter_px=78.0)
        views = [CameraView.of(name, camera, scene) for name, camera in CAMERAS.items()]
        self.fitter = SimpleNamespace(views=views, radius_mm=RADIUS)
        self.proposers, self.locating = dict.fromkeys(CAMERAS, paint), SETTINGS

    def proposals(self, disks):
        rows = []
        for k, _, disk in disks:
            camera = list(CAMERAS.values())[k]
            away = [
                np.hypot(*(camera.project(X) - torch.tensor([disk.u_px, disk.v_px])).tolist()) for X, *_ in self.truth
            ]
            _, R, paint = self.truth[int(np.argmin(away))]
            astray = rotation(0.02 * k, -0.03, 0.01) @ R
            other = rotation(1.0 + k, 0.5, -0.7) @ R  # another one in each picture
            score = torch.tensor([0.93, 0.55]) if paint == self.paint and min(away) < 9 else torch.tensor([0.58, 0.5])
            rows.append((torch.stack([astray, other] if paint == self.paint else [other, astray.mT]), score))
        return rows

    def fitted(self, frames, found, R):
        use = torch.tensor([one is not None for one, _ in found])
        match = Match(chosen=(), disks=tuple(one for one, _ in found), chi2=0.0)
        parts = blank_parts(len(CAMERAS), 1)
        parts["position_lab_mm"] = places_of([match], CAMERAS, 2 * RADIUS).position_lab_mm
        away = [float((parts["position_lab_mm"][0] - X).norm()) for X, *_ in self.truth]
        parts["score"] = torch.where(use, 0.1 if int(np.argmin(away)) in self.worse else 0.95, 0.0)[None].double()
        return Poses(**parts | {"R_lab_body": R[:1]}, use=use, reason=tuple(why for _, why in found))


def frames_of(truth):
    found = []
    for camera in CAMERAS.values():
        picture = np.full(SHAPE, 15, np.uint8)
        for X, *_ in truth:
            (u, v), radius = (part.tolist() for part in sphere_disk_px(camera, X, RADIUS))
            cv2.circle(picture, (round(16 * u), round(16 * v)), round(16 * radius), 160, -1, cv2.LINE_AA, 4)
        noisy = picture + np.random.default_rng(0).normal(0, 1.5, SHAPE)
        found.append(Frame(shown=np.clip(np.rint(noisy), 0, 255).astype(np.uint8)))
    return found


def at(x, y, z):
    return torch.tensor([x, y, z], dtype=torch.float64)


A, B, C = at(-30.0, 5.0, 8.0), at(10.0, -20.0, 25.0), at(35.0, 25.0, -30.0)
TRUTH = [(A, rotation(0.1, 0.2, 0.3), 0), (B, rotation(-1.0, 0.4, 0.1), 1), (C, rotation(0.5, 2.0, -0.4), 0)]


def start_of(truth=TRUTH, **worse):
    stub = {paint: Planted(paint, truth, worse.get(f"paint{paint}", ())) for paint in (0, 1)}
    return SceneStart({"a": stub[0], "b": stub[1], "c": stub[0]})


def ahead(X, R, sigma_mm=1.0):
    covariance = torch.diag(torch.tensor([0.05] * 3 + [sigma_mm] * 3, dtype=torch.float64)).square()
    return Ahead(position_lab_mm=X, R_lab_body=R, covariance=covariance)


def test_each_ball_is_found_by_its_paint_with_pictures_of_both_cameras():
    found = start_of()(frames_of(TRUTH), ["a", "b", "c"], {})
    assert_close(found["b"].position_lab_mm[0], B, 0.5)
    assert so3.geodesic_distance(found["b"].R_lab_body[0], TRUTH[1][1]) < 0.1
    assert all(poses.use.all() for poses in found.values())
    alike = sorted(found[name].position_lab_mm[0, 0].item() for name in "ac")
    assert alike == pytest.approx([A[0].item(), C[0].item()], abs=0.5)


@pytest.mark.parametrize("exchanged", [False, True])
def test_balls_painted_alike_get_their_names_from_the_past(exchanged):
    first, second = (TRUTH[2], TRUTH[0]) if exchanged else (TRUTH[0], TRUTH[2])
    past = {"a": ahead(first[0] + 2.0, first[1], 3.0), "c": ahead(second[0] - 2.0, second[1], 3.0)}
    found = start_of()(frames_of(TRUTH), ["a", "b", "c"], {}, past)
    assert_close(found["a"].position_lab_mm[0], first[0], 0.5)
    assert_close(found["c"].position_lab_mm[0], second[0], 0.5)


def test_a_ball_at_a_known_place_leaves_its_disks_to_no_other():
    found = start_of()(frames_of(TRUTH), ["c"], {"a": C, "b": B})
    assert list(found) == ["c"]
    assert_close(found["c"].position_lab_mm[0], A, 0.5)


def test_a_ball_that_is_not_in_view_has_no_pose_and_a_reason():
    here = [TRUTH[0], TRUTH[2]]
    found = start_of(here)(frames_of(here), ["a", "b", "c"], {})
    assert len(found["b"]) == 0
    assert found["b"].reason == (Reason.NOT_FOUND, Reason.NOT_FOUND)
    assert len(found["a"]) == len(found["c"]) == 1


def test_a_picture_that_cannot_be_used_leaves_the_ball_to_the_other_camera():
    frames = frames_of(TRUTH)
    frames[1] = replace(frames[1], read=Reason.MISSING)
    found = start_of()(frames, ["a", "b", "c"], {})
    assert found["b"].use.tolist() == [True, False]
    assert found["b"].reason == (Reason.OK, Reason.MISSING)


def test_a_position_whose_fit_does_not_explain_the_pictures_goes_to_another_paint_or_to_no_ball():
    found = start_of(paint0=(2,))(frames_of(TRUTH), ["a", "b", "c"], {})
    assert sorted(len(found[name]) for name in "ac") == [0, 1]
    assert len(found["b"]) == 1


def test_pictures_of_nothing_have_no_balls():
    found = start_of()(frames_of([]), ["a", "b"], {})
    assert [len(poses) for poses in found.values()] == [0, 0]


def match(*chosen):
    return Match(chosen=chosen, disks=(None,) * len(chosen), chi2=0.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_assignment_is_the_best_of_all_that_use_each_ball_and_disk_once(seed):
    rng = np.random.default_rng(seed)
    matches = [match(*rng.integers(-1, 3, 3)) for _ in range(6)]
    cost = rng.normal(-1, 3, (3, 6))

    def allowed(choice):
        some = [matches[n] for n in choice if n >= 0]
        return not any(one.shares(other) for k, one in enumerate(some) for other in some[:k]) and all(
            choice.count(n) == 1 for n in choice if n >= 0
        )

    def total(choice):
        return sum(cost[ball, n] for ball, n in enumerate(choice) if n >= 0)

    least = min(total(choice) for choice in product(range(-1, 6), repeat=3) if allowed(choice))
    found = dict(assigned(cost, matches))
    assert allowed(tuple(found.get(ball, -1) for ball in range(3)))
    assert total([found.get(ball, -1) for ball in range(3)]) == pytest.approx(least)


def test_a_match_of_disks_that_show_different_rotations_gains_less_than_one_of_them_alone():
    R, other = rotation(0.3, 0.1, 0.0), rotation(1.5, -0.4, 0.9)
    one = (R[None], torch.tensor([0.9]))
    alike = (rotation(0.03, 0.0, 0.02)[None] @ R, torch.tensor([0.9]))
    different = (other[None], torch.tensor([0.9]))
    assert look_of([one, alike]).gain == pytest.approx(2 * look_of([one]).gain)
    assert look_of([one, different]).gain < look_of([one]).gain
    assert look_of([one, (R[None], torch.tensor([0.4]))]).gain < look_of([one]).gain  # a paint that does not fit


def test_a_disk_without_a_proposal_is_no_support():
    nothing = (torch.zeros(0, 3, 3, dtype=torch.float64), torch.zeros(0))
    assert look_of([nothing]).gain == -np.inf
