from itertools import product

import numpy as np
import torch
from conftest import assert_close
from locate_examples import looking_along_y, looking_down

from sphereorient.cameras import sphere_disk_px
from sphereorient.locate.outline import Outline
from sphereorient.locate.position import match_disks, places_of

RADIUS = 9.0
S = 2**-0.5
BETWEEN = torch.tensor([[1.0, 0, 0], [0, -S, -S], [0, S, -S]], dtype=torch.float64)
CAMERAS = [looking_along_y(), looking_down(), looking_along_y(R_cam_lab=BETWEEN)]
NAMED = dict(zip(("a", "b", "c"), CAMERAS, strict=True))


def disk(camera, X, error=0.0, sigma=1.0):
    middle, radius = sphere_disk_px(camera, X, RADIUS)
    return Outline(
        u_px=float(middle[0]) + error, v_px=float(middle[1]), radius_px=float(radius), rms_px=sigma, coverage=0.9
    )


def planted(*places, cameras=CAMERAS):
    return [[disk(camera, X) for X in places] for camera in cameras]


def places(count, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-30, 30, (count, 3)))


def test_all_disks_of_each_ball_are_matched_and_chance_matches_too():
    X = places(5)
    found = {one.chosen for one in match_disks(planted(*X), CAMERAS)}
    assert found >= {
        tuple(k if seen else -1 for seen in who) for k in range(5) for who in product((0, 1), repeat=3)
    } - {(-1, -1, -1)}


def test_every_match_is_of_lines_of_sight_that_meet():
    X = places(6, seed=1)
    disks = planted(*X)
    for one in match_disks(disks, CAMERAS):
        if one.number < 2:
            continue
        (at,) = places_of([one], NAMED, 2 * RADIUS).position_lab_mm
        for camera, chosen in zip(CAMERAS, one.disks, strict=True):
            if chosen is not None:
                u, v = camera.project(at).tolist()
                assert np.hypot(u - chosen.u_px, v - chosen.v_px) < 5 * chosen.rms_px


def test_matches_of_more_cameras_come_first():
    number = [one.number for one in match_disks(planted(*places(4)), CAMERAS)]
    assert number == sorted(number, reverse=True)
    assert number[0] == 3


def test_the_own_error_of_a_disk_decides_whether_lines_of_sight_meet():
    X = torch.tensor([5.0, 2.0, -3.0], dtype=torch.float64)
    for sigma, meets in ((1.0, False), (4.0, True)):
        off = Outline(**{**vars(disk(CAMERAS[2], X)), "v_px": disk(CAMERAS[2], X).v_px + 12, "rms_px": sigma})
        disks = [[disk(CAMERAS[0], X, sigma=sigma)], [disk(CAMERAS[1], X, sigma=sigma)], [off]]
        assert ((0, 0, 0) in {one.chosen for one in match_disks(disks, CAMERAS)}) == meets


def test_one_camera_gives_each_disk_alone_and_its_distance_by_size():
    X = places(3)
    matches = match_disks(planted(*X, cameras=CAMERAS[:1]), CAMERAS[:1])
    assert sorted(one.chosen for one in matches) == [(0,), (1,), (2,)]
    at = places_of(matches, {"a": CAMERAS[0]}, 2 * RADIUS).position_lab_mm
    assert_close(at, X[[one.chosen[0] for one in matches]], atol=1.0)


def test_matches_with_a_common_disk_exclude_each_other():
    first, second, third = (
        next(one for one in match_disks(planted(*places(3)), CAMERAS) if one.chosen == chosen)
        for chosen in ((0, 0, 0), (-1, 0, -1), (1, -1, -1))
    )
    assert first.shares(second)
    assert not first.shares(third)


def test_pictures_without_disks_have_no_matches():
    assert match_disks([[], [], []], CAMERAS) == []
