"""The fit of nearly right poses out of whole frames: compiled code against torch's, which defines it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from camera_examples import MODELS as CAMERAS
from camera_examples import behind_port, pinhole
from refine_examples import (
    BEHIND,
    BLUR_PX,
    RADIUS_MM,
    balls,
    base_of,
    moved,
    noisy,
    pictures_of,
    rig_of,
    scene_of,
    turned,
)

from sphereorient import so3
from sphereorient.cameras import centre_lab_mm, sphere_disk_px
from sphereorient.cameras.response import Response
from sphereorient.locate import CameraScene
from sphereorient.pose import compiled
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.fit import NEAR_RAD
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.pixels import LinesOfSight
from sphereorient.pose.poses import POSE_PARTS, PoseStart

RIG, COUNT = rig_of(), 6
ONE_CAMERA = 1  # the pose that one camera sees
pytestmark = pytest.mark.skipif(
    compiled.refine_library() is None, reason="needs the compiled fit: `make setup` with a compiler"
)
KINDS = [np.uint8, np.uint16, np.float32, np.float64]


@pytest.fixture(scope="module")
def scene():
    """Balls, one of them at the border of a picture, before a mask; frames in grey levels."""
    X, R = balls(COUNT, 4)
    X[2, 0] += 16.0
    pictures = noisy(pictures_of(RIG, "patches", X, R), 2.0, 3).round().clamp(0, 255).numpy()
    shown = np.ones(pictures.shape[-2:], bool)
    shown[70:75, :] = False
    height, width = shown.shape
    views = []
    for k, camera in enumerate(RIG.cameras):
        mean = np.full((height, width), BEHIND, np.float32)
        background = scene_of(mean, shown if k else None, full_scale=190.0)
        known = CameraScene(background=background, diameter_px=RIG.diameter_px)
        views.append(CameraView.of(f"cam{k + 1}", camera, known))
    fitter = replace(first_fitter(views, RADIUS_MM, base_of("patches"), BLUR_PX), widest_px=0.55 * RIG.diameter_px)
    return fitter, pictures, X, R


def start(X, R, *, held: bool = False) -> PoseStart:
    """Poses with errors below and above the reach of the first step."""
    count = len(X)
    off = torch.linspace(0.05, 2.0, count).tolist()
    use = torch.ones(count, 2, dtype=torch.bool)
    use[ONE_CAMERA, 0] = False
    return PoseStart(
        position_lab_mm=X if held else torch.cat([moved(X[k : k + 1], 0.05 * off[k], k) for k in range(count)]),
        R_lab_body=torch.cat([turned(R[k : k + 1], off[k], k) for k in range(count)]),
        use=use,
        place_precision=4.0 * torch.eye(3, dtype=torch.float64).expand(count, 3, 3),
        moved=0.01 * torch.ones(count, 6, dtype=torch.float64),
        held=held,
    )


def assert_same(found, expected) -> None:
    both = torch.arange(COUNT) != ONE_CAMERA
    turned = so3.log(found.R_lab_body @ expected.R_lab_body.mT)
    moved_mm = found.position_lab_mm - expected.position_lab_mm
    assert float(torch.rad2deg(turned.norm(dim=-1))[both].max()) < 2e-3
    assert float(moved_mm.norm(dim=-1)[both].max()) < 5e-4
    covered = (found.limb_coverage - expected.limb_coverage).abs()
    assert float(covered[both].max()) < 0.01
    variances = [part.covariance.diagonal(dim1=-2, dim2=-1) for part in (found, expected)]
    ratio = (variances[0] / variances[1] - 1).abs()
    assert float(ratio[both].max()) < 0.02
    assert float((found.score - expected.score).abs().max()) < 1e-3
    # The last steps of a fit by one camera are not small beside rounding: compared in sigmas.
    apart = (torch.cat([turned, moved_mm], dim=-1) / variances[1].sqrt())[ONE_CAMERA]
    assert float(apart.abs().max()) < 0.2
    assert float(covered[ONE_CAMERA].max()) < 0.02
    assert float(ratio[ONE_CAMERA].max()) < 0.05


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("held", [False, True])
def test_poses_are_those_of_torch(scene, kind, held, monkeypatch):
    fitter, pictures, X, R = scene
    frames, begin = [list(row) for row in pictures.astype(kind)], start(X, R, held=held)
    found = fitter.settled(frames, begin)
    monkeypatch.setattr(compiled, "refine_library", lambda: None)
    expected = fitter.settled(frames, begin)
    assert_same(found, expected)
    assert float(torch.rad2deg(so3.geodesic_distance(found.R_lab_body, R)).max()) < 0.5


@pytest.mark.parametrize("name", [*CAMERAS, "port"])
def test_disks_lie_where_cameras_of_all_models_project_them(name):
    camera = behind_port(pinhole()) if name == "port" else CAMERAS[name]()
    width, height = camera.image_size
    still = scene_of(np.zeros((height, width), np.float32))
    view = CameraView(name=name, camera=camera, background=still, diameter_px=40.0, sight=LinesOfSight(camera))
    spread = torch.randn(300, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    middles, radii = compiled.disks_compiled([view], 30.0 * spread, 5.0)
    expected, radii_px = sphere_disk_px(camera, 30.0 * spread, 5.0)
    within = ((expected > 20.0) & (expected < expected.new_tensor([width - 20.0, height - 20.0]))).all(-1)
    assert int(within.sum()) > 200
    assert float((middles[0] - expected)[within].abs().max()) < 0.02
    assert float((radii[0] - radii_px)[within].abs().max()) < 0.02
    if name not in ("telecentric", "fisheye", "port"):
        behind = 2 * centre_lab_mm(camera) - 30.0 * spread
        assert bool(compiled.disks_compiled([view], behind, 5.0)[0].isnan().all())


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_coded_pictures_are_measured_by_their_light(scene, kind):
    fitter, pictures, X, R = scene
    pictures = pictures.clip(max=190.0)  # no camera records more than its full scale
    code, begin = Response(gamma=2.2), start(X, R)

    def coded(light):
        return 190.0 * (np.asarray(light) / 190.0) ** (1 / 2.2)

    views = [
        replace(view, response=code, background=replace(view.background, mean=coded(view.background.mean)))
        for view in fitter.views
    ]
    frames = [list(row) for row in coded(pictures).round().astype(kind)]
    found = replace(fitter, views=views).settled(frames, begin)
    expected = fitter.settled([list(row) for row in pictures], begin)
    off = so3.geodesic_distance(found.R_lab_body, expected.R_lab_body)
    assert float((off / expected.covariance.diagonal(dim1=-2, dim2=-1)[:, :3].sum(-1).sqrt()).max()) < 0.4  # sigmas
    as_linear = so3.geodesic_distance(fitter.settled(frames, begin).R_lab_body, expected.R_lab_body)
    assert float(off.median()) < 0.3 * float(as_linear.median())


def test_a_fit_goes_on_while_its_steps_are_long(scene):
    fitter, pictures, X, R = scene
    far = torch.cat([turned(R[k : k + 1], 15.0, k) for k in range(COUNT)])
    fit = fitter.settled([list(row) for row in pictures], replace(start(X, R), R_lab_body=far))
    assert float(fit.step[:, :3].norm(dim=-1).max()) < NEAR_RAD
    assert float(torch.rad2deg(so3.geodesic_distance(fit.R_lab_body, R)).max()) < 0.5


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("off_deg", [0.0, 15.0])
def test_a_pose_alone_by_one_call_is_that_among_others_to_the_last_bit(scene, held, off_deg):
    fitter, pictures, X, R = scene
    fitter, frames, begin = replace(fitter, instants=3), [list(row) for row in pictures], start(X, R, held=held)
    if off_deg:
        far = torch.cat([turned(R[k : k + 1], off_deg, k) for k in range(COUNT)])
        begin = replace(begin, R_lab_body=far)
    together = fitter.settled(frames, begin)
    for k in range(COUNT):
        alone = fitter.settled(frames[k : k + 1], begin.of(torch.tensor([k])))
        for name, part in alone.parts().items():
            assert torch.equal(part[0], getattr(together, name)[k]), (k, name)


def test_the_shutter_is_open_while_the_ball_moves(scene, monkeypatch):
    fitter, pictures, X, R = scene
    frames, begin = [list(row) for row in pictures], start(X, R)
    found = replace(fitter, instants=3).settled(frames, begin)
    assert not torch.equal(found.R_lab_body, fitter.settled(frames, begin).R_lab_body)
    monkeypatch.setattr(compiled, "refine_library", lambda: None)
    assert_same(found, replace(fitter, instants=3).settled(frames, begin))


def test_lines_of_sight_may_start_at_different_places(scene, monkeypatch):
    fitter, pictures, X, R = scene
    views = list(fitter.views)
    sight = RIG.sights[1]
    ported = type(sight).__new__(type(sight))
    vars(ported).update(vars(sight))
    ported.origin = sight.origin + sight.direction * torch.linspace(-3, 3, sight.size[0])  # as behind a wall
    ported.one_origin, ported.pitch_mm = False, torch.full_like(sight.pitch_rad, 0.01)
    views[1] = replace(views[1], sight=ported)
    behind_a_wall, frames = replace(fitter, views=views), [list(row) for row in pictures]
    found = behind_a_wall.settled(frames, start(X, R))
    monkeypatch.setattr(compiled, "refine_library", lambda: None)
    assert_same(found, behind_a_wall.settled(frames, start(X, R)))


def test_each_disk_may_have_axes_of_its_own(scene, monkeypatch):
    fitter, pictures, X, R = scene
    views, sight = list(fitter.views), RIG.sights[1]
    turning = type(sight).__new__(type(sight))
    vars(turning).update(vars(sight))

    def axes_at(middle_px):  # rotated about the camera's axis, by position
        angle = middle_px.double().round()[:, :1] @ torch.tensor([[0.0, 0.0, 0.3]]).double()
        return (so3.exp(angle) @ RIG.cameras[1].R_cam_lab)[:, :2].float()

    turning.axes_at = axes_at
    views[1] = replace(views[1], sight=turning)
    uneven = fitter.light.black.clone()
    uneven[:, 1] += 20.0  # along the disk's x
    beside = replace(fitter, views=views, light=replace(fitter.light, black=uneven))
    frames = [list(row) for row in pictures]
    found = beside.settled(frames, start(X, R, held=True))
    monkeypatch.setattr(compiled, "refine_library", lambda: None)
    assert_same(found, beside.settled(frames, start(X, R, held=True)))


def test_a_pose_does_not_depend_on_its_batch_or_on_how_a_frame_lies_in_memory(scene):
    fitter, pictures, X, R = scene
    frames, begin = [list(row) for row in pictures.astype(np.uint8)], start(X, R)
    whole = fitter.settled(frames, begin)
    rows = torch.tensor([1, 5])
    flipped = [[np.ascontiguousarray(frame[:, ::-1])[:, ::-1] for frame in frames[k]] for k in rows.tolist()]
    some = fitter.settled(flipped, begin.of(rows))
    for name in POSE_PARTS:
        assert torch.equal(getattr(whole, name)[rows], getattr(some, name)), name
