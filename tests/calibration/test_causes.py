"""Cameras that contradict each other: planted faults are found and named; cameras that agree get no finding."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch
from conftest import slow

from sphereorient import so3
from sphereorient.calibration.comparison import Limits, Seen
from sphereorient.calibration.contradictions import compare_cameras, majority
from sphereorient.cameras import Camera, R_cam_view, TsaiCamera, sphere_radius_px
from sphereorient.synth import SynthSettings
from sphereorient.synth.write import default_cameras, frame_times_s, motion_of

LIMITS = Limits(gap_px=1.0, turn_deg=0.75, size=0.01)
MM = 18.0
OTHERS = [("cam1", 0), ("cam1", 2), ("cam2", 0), ("cam2", 1), ("cam2", 2)]  # cameras and axes


def seen_by(
    cameras: dict[str, Camera], frames: int = 40, diameter_mm: float = MM, seed: int = 1, noise: float = 1.0
) -> Seen:
    """Return the views of a moving sphere, with the noise of fits in poor light."""
    settings = SynthSettings(frames=frames, seed=seed)
    motion = motion_of(settings).at(frame_times_s(settings))
    rng = torch.Generator().manual_seed(seed)

    def error(*shape: int) -> torch.Tensor:
        return noise * torch.randn(*shape, generator=rng, dtype=torch.float64)

    X, R = motion.position_lab_mm, motion.R_lab_body
    pixels = [camera.project(X) + 0.1 * error(frames, 2) for camera in cameras.values()]
    radii = [sphere_radius_px(c, X, diameter_mm / 2) * (1 + 0.002 * error(frames)) for c in cameras.values()]
    turns = [so3.exp(math.radians(0.1) * error(frames, 3)) @ R for _ in cameras]
    return Seen(
        cameras=cameras,
        centre_px=torch.stack(pixels, 1),
        radius_px=torch.stack(radii, 1),
        R_lab_body=torch.stack(turns, 1),
        diameter_mm=MM,
    )


def reported(seen: Seen, cameras: dict[str, Camera]) -> Seen:
    """Return the same pictures as fits with other cameras read them: the view of the sphere stays."""
    R = torch.empty_like(seen.R_lab_body)
    for k, (true, given) in enumerate(zip(seen.cameras.values(), cameras.values(), strict=True)):
        view = [
            c.R_cam_lab.mT @ R_cam_view(c.rays(seen.centre_px[:, k]).direction_lab @ c.R_cam_lab.mT)
            for c in (true, given)
        ]
        R[:, k] = view[1] @ view[0].mT @ seen.R_lab_body[:, k]
    return replace(seen, cameras=cameras, R_lab_body=R)


def turned(camera: Camera, deg: float, axis: int) -> Camera:
    """Rotate a camera about its own centre."""
    turn = so3.exp(math.radians(deg) * torch.eye(3, dtype=torch.float64)[axis])
    assert isinstance(camera, TsaiCamera)
    return replace(camera, R_cam_lab=turn @ camera.R_cam_lab, T_cam_lab_mm=turn @ camera.T_cam_lab_mm)


CAMERAS = default_cameras(SynthSettings())


@pytest.mark.parametrize("seed", [0, 1, *map(slow, range(2, 6))])
@pytest.mark.parametrize("consecutive", [False, True])
def test_cameras_that_agree_get_no_finding(seed, consecutive):
    seen = seen_by(CAMERAS, seed=seed)
    found = compare_cameras(replace(seen, frame=torch.arange(len(seen.centre_px)) if consecutive else None), LIMITS)
    assert not found.contradicts
    assert found.gap_px < 0.3
    assert found.turn_deg < 0.4


def test_two_frames_are_not_judged():
    found = compare_cameras(seen_by(CAMERAS, frames=2, diameter_mm=30.0), LIMITS)
    assert (found.frames, found.contradicts) == (2, False)


@pytest.mark.parametrize("percent", [-5, 2, 5])
def test_a_wrong_diameter_is_named_with_the_right_one(percent):
    """Before: 30 of 30 frames valid, 25 mm off, without a message."""
    found = compare_cameras(seen_by(CAMERAS, diameter_mm=MM * (1 + percent / 100)), LIMITS)
    assert found.contradicts
    assert not found.deadly
    assert f"fit sphere.diameter {MM * (1 + percent / 100):.4g}, not 18" in found.advice
    assert found.gap_px < 0.3


@pytest.mark.parametrize(("name", "axis"), [("cam1", 1), *(slow(*one) for one in OTHERS)])
def test_a_turned_camera_is_named(name, axis):
    """Before: 30 of 30 frames valid with 0.03 degrees stated, whichever camera was rotated."""
    found = compare_cameras(reported(seen_by(CAMERAS), CAMERAS | {name: turned(CAMERAS[name], 1.5, axis)}), LIMITS)
    assert found.contradicts
    assert f"{name} rotated by 1.5 degrees" in found.advice


def test_a_moved_camera_is_named():
    one = CAMERAS["cam2"]
    assert isinstance(one, TsaiCamera)
    moved = replace(one, T_cam_lab_mm=one.T_cam_lab_mm + torch.tensor([4.0, 0.0, 0.0]))
    found = compare_cameras(reported(seen_by(CAMERAS), CAMERAS | {"cam2": moved}), LIMITS)
    assert found.contradicts
    assert "cam2 rotated by 0.4" in found.advice  # 4 mm at 520 mm: this noise does not distinguish the two


def test_swapped_movies_are_deadly():
    """Before: 30 of 30 frames valid, 90 degrees off."""
    seen = reported(seen_by(CAMERAS), dict(zip(CAMERAS, list(CAMERAS.values())[::-1], strict=True)))
    found = compare_cameras(replace(seen, cameras=dict(zip(CAMERAS, seen.cameras.values(), strict=True))), LIMITS)
    assert found.deadly
    assert found.advice == "swap cam1 and cam2 under movies:"


def test_a_movie_turned_by_half_a_turn_is_deadly():
    seen = seen_by(CAMERAS)
    centre, R = seen.centre_px.clone(), seen.R_lab_body.clone()
    half = torch.tensor([-1.0, -1.0, 1.0]).double()
    camera = CAMERAS["cam2"]
    before = camera.R_cam_lab.mT @ R_cam_view(camera.rays(centre[:, 1]).direction_lab @ camera.R_cam_lab.mT)
    centre[:, 1] = torch.tensor(camera.image_size).double() - 1 - centre[:, 1]
    after = camera.R_cam_lab.mT @ R_cam_view(camera.rays(centre[:, 1]).direction_lab @ camera.R_cam_lab.mT)
    R[:, 1] = after @ (half[:, None] * (before.mT @ R[:, 1]))
    found = compare_cameras(replace(seen, centre_px=centre, R_lab_body=R), LIMITS)
    assert found.deadly
    assert found.advice == "write flip: {cam2: both}"


@pytest.mark.parametrize(("share", "pitch"), [(-0.03, 3.1), (0.03, -2.9)])
def test_wide_pictures_are_named_with_the_changes_of_sx_and_of_pixel_pitch(share, pitch):
    """Before: all frames valid, 0.5 degrees and 7.5 mm off, sigma 6 and 25 times too small."""
    wide = {name: replace(c, sx=c.sx * (1 + share)) for name, c in CAMERAS.items() if isinstance(c, TsaiCamera)}
    seen = seen_by(wide)  # type: ignore[arg-type]
    seen = replace(seen, radius_px=seen.radius_px * (1 + share / 2) / (1 + share))  # of the circle about the ellipse
    found = compare_cameras(reported(seen, CAMERAS), LIMITS)
    assert found.contradicts
    named = re.search(r"pictures of cam1 and cam2 (\S+) % wider .* sx \((\S+) %\), .* u \((\S+) %\)", found.advice)
    assert [float(number) for number in named.groups()] == pytest.approx([100 * share, 100 * share, pitch], abs=0.1)


def test_outlines_that_are_wider_than_high_show_wide_pixels_and_no_wrong_diameter():
    """A ball in the middle of the picture: its size alone fits either."""
    seen = seen_by(CAMERAS, diameter_mm=0.985 * MM)
    round_, wide = torch.zeros_like(seen.radius_px), torch.full_like(seen.radius_px, -0.03)
    assert compare_cameras(replace(seen, outline_stretch=round_), LIMITS).advice.startswith(
        "the pictures fit sphere.diameter"
    )
    found = compare_cameras(replace(seen, outline_stretch=wide), LIMITS)
    assert found.advice.startswith("pictures of cam1 and cam2 -3")


@pytest.mark.parametrize(("late", "frames"), [(-3, 48), slow(1, 48), slow(2, 48), (7, 48), (2, 240)])
def test_a_late_movie_is_named(late, frames):
    """Before: not in movies of more than 60 frames."""
    whole = seen_by(CAMERAS, frames=frames, noise=0.2)
    parts = {}
    for name in ("centre_px", "radius_px", "R_lab_body"):
        first, second = getattr(whole, name)[:, :1], getattr(whole, name)[:, 1:]
        second = torch.roll(second, late, 0)
        parts[name] = torch.cat([first, second], 1)[8:-8]
    found = compare_cameras(replace(whole, **parts, frame=torch.arange(frames - 16)), replace(LIMITS, turn_deg=0.2))
    assert found.contradicts
    assert f"the movie of cam2 {abs(late)} frames {'late' if late > 0 else 'early'}" in found.advice


def test_a_camera_without_measurements_in_some_frames_does_not_matter():
    seen = seen_by(CAMERAS, diameter_mm=1.05 * MM)
    for name in ("centre_px", "radius_px", "R_lab_body"):
        getattr(seen, name)[::2, 1] = torch.nan
    found = compare_cameras(seen, LIMITS)
    assert found.frames == 20
    assert "18.9" in found.advice


THREE, FOUR = (default_cameras(SynthSettings(cameras=count)) for count in (3, 4))


def shifted(camera: Camera, axis: int, mm: float) -> Camera:
    assert isinstance(camera, TsaiCamera)
    off = mm * torch.eye(3, dtype=torch.float64)[axis]
    return replace(camera, T_cam_lab_mm=camera.T_cam_lab_mm + off)


def late(seen: Seen, camera: int) -> Seen:
    centre, R = seen.centre_px.clone(), seen.R_lab_body.clone()
    centre[1:, camera], R[1:, camera] = seen.centre_px[:-1, camera], seen.R_lab_body[:-1, camera]
    centre[0, camera], R[0, camera] = torch.nan, torch.nan
    return replace(seen, centre_px=centre, R_lab_body=R, frame=torch.arange(len(R)))


@pytest.mark.parametrize("wrong", [0, slow(1), slow(2)])
def test_the_one_of_three_cameras_that_contradicts_the_others_is_named_alone(wrong):
    name = list(THREE)[wrong]
    others = tuple(k for k in range(3) if k != wrong)
    turned_one = reported(seen_by(THREE), THREE | {name: turned(THREE[name], 1.5, 0)})
    assert majority(turned_one, LIMITS) == others
    found = compare_cameras(turned_one, LIMITS)
    assert found.contradicts
    assert found.advice.startswith(f"{name} rotated by 1.5 degrees")
    assert not any(other in found.advice for other in THREE if other != name)


@pytest.mark.parametrize("wrong", [0, slow(1), slow(2)])
def test_a_late_movie_of_three_is_named(wrong):
    name = list(THREE)[wrong]
    seen = late(seen_by(THREE, noise=0.1), wrong)
    strict = Limits(gap_px=1.0, turn_deg=0.2, size=0.01)
    assert majority(seen, strict) == tuple(k for k in range(3) if k != wrong)
    assert f"the movie of {name} 1 frames late" in compare_cameras(seen, strict).advice


@pytest.mark.parametrize("wrong", [slow(0), 1, slow(2)])
@pytest.mark.parametrize("axis", [0, slow(1)])
def test_a_shift_that_two_of_three_cameras_measure_is_decided_by_the_size_in_the_third(wrong, axis):
    name = list(THREE)[wrong]
    seen = reported(seen_by(THREE, noise=0.2), THREE | {name: shifted(THREE[name], axis, 2.0)})
    assert majority(seen, LIMITS) == tuple(k for k in range(3) if k != wrong)
    advice = compare_cameras(seen, LIMITS).advice
    assert name in advice
    assert not any(other in advice for other in THREE if other != name)


def test_two_of_four_cameras_that_agree_are_no_majority():
    cameras = dict(FOUR)
    for k, name in enumerate(("cam3", "cam4")):
        cameras[name] = turned(FOUR[name], 2.0 + 3 * k, k)
    assert majority(reported(seen_by(FOUR), cameras), LIMITS) == ()
    assert majority(reported(seen_by(FOUR), FOUR | {"cam4": cameras["cam4"]}), LIMITS) == (0, 1, 2)
    assert majority(seen_by(FOUR), LIMITS) == (0, 1, 2, 3)
