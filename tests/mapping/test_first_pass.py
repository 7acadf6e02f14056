"""A map that grows with every picture, and the first pass that follows a ball by it."""

import math
import re
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml
from camera_examples import brown, pinhole
from renders import error_deg
from turning_examples import RATE_HZ, turning_ball  # noqa: F401

from sphereorient import so3
from sphereorient.bench.ball import SCENES, write_ball_scene
from sphereorient.cameras import Camera, CoarserCamera, PinholeCamera, centre_lab_mm
from sphereorient.errors import CameraError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.files.whole_file import writing
from sphereorient.locate import Background, CameraScene, Frame, LocateSettings, find_positions
from sphereorient.mapping import first_pass, paint_cells
from sphereorient.mapping.adjustment import LEVELS, adjusted, focal_ratio
from sphereorient.mapping.disks import Crops, cut_out, held_place
from sphereorient.mapping.first_pass import CoarserPictures, FirstPass, KeptFrames
from sphereorient.mapping.paint_cells import BallView, PaintCells
from sphereorient.mapping.settings import MapSettings
from sphereorient.methods.map import first_map_of
from sphereorient.methods.settings import Settings
from sphereorient.movies import open_movie, write_ffv1
from sphereorient.pose import CameraView
from sphereorient.pose.poses import Poses, supported
from sphereorient.report.texture_map import write_map
from sphereorient.run import MemoryStore, Request
from sphereorient.run.stages import run_tracks
from sphereorient.sphere import SphereRenderer, load_texture
from sphereorient.sphere.compare import compare_maps
from sphereorient.sphere.texture import random_texture
from sphereorient.sphere.texture_table import octahedral_directions
from sphereorient.trajectory import Reason

EXCERPT = Path(__file__).parents[2] / "synthetic_data" / "excerpt"
X, RADIUS_MM = torch.tensor([12.0, -9.0, 20.0], dtype=torch.float64), 30.0


def paint(normal_body: torch.Tensor) -> torch.Tensor:
    """Smooth paint, with its slope known by hand."""
    x, y, z = normal_body.unbind(-1)
    return 3.0 + x * y + torch.sin(2 * z)


def picture_of(camera: Camera, R_lab_body: torch.Tensor) -> torch.Tensor:
    """A camera's picture of that paint, (H, W) float32; 0 beside the ball."""
    width, height = camera.image_size
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    rays = camera.rays(torch.stack([u, v], dim=-1))
    to_centre = X - rays.origin_lab_mm
    along = (to_centre * rays.direction_lab).sum(-1)
    inside = RADIUS_MM**2 - to_centre.square().sum(-1) + along.square()
    hit = rays.origin_lab_mm + (along - inside.clamp_min(0).sqrt())[..., None] * rays.direction_lab
    seen = paint(((hit - X) / RADIUS_MM) @ R_lab_body)
    return torch.where(inside > 0, seen, 0.0).float()


@pytest.mark.parametrize("camera", [pinhole(), brown()], ids=["pinhole", "brown"])
@pytest.mark.parametrize("built", [True, False], ids=["compiled", "torch"])
def test_cells_hold_the_paint_and_its_slope_where_pictures_show_it(camera, built, monkeypatch):
    if not built:
        monkeypatch.setattr(paint_cells, "compiled", lambda *_: None)
    cells, view = PaintCells(64, 0.05), BallView.of(camera, X, RADIUS_MM)
    for turn in ((0.3, -0.2, 0.5), (0.5, 0.4, -0.3)):
        R = so3.exp(torch.tensor(turn, dtype=torch.float64))
        picture = picture_of(camera, R)
        cells.add(view, picture, picture > 0, (0, 0), R)
    directions = octahedral_directions(64)
    seen = cells.weight > 0.3
    assert 0.3 < float(seen.float().mean()) < 0.7
    assert float((cells.mean - paint(directions))[seen].abs().max()) < 0.02
    x, y, z = directions.unbind(-1)
    slope = torch.stack([y, x, 2 * torch.cos(2 * z)], dim=-1)
    slope = slope - (slope * directions).sum(-1, keepdim=True) * directions
    off = (cells.table.rows[:, 1:] - slope)[seen].norm(dim=-1)
    assert float(off.median()) < 0.03
    value, _ = cells.table.sample(directions[seen].float().mT[None])
    assert float((value[0] - paint(directions[seen])).abs().max()) < 0.02
    grey, unseen = cells.sample(directions.reshape(64, 64, 3))
    assert torch.equal(unseen.reshape(-1), cells.weight < paint_cells.LEAST_WEIGHT)
    assert bool((grey[unseen] == 0).all())


def test_a_view_does_not_depend_on_what_memory_held_before():
    # torch's default least squares takes columns first that such memory names.
    views, camera = set[bytes](), brown()
    for k in range(400):
        held = [torch.full((1 + (7 * k + n) % 300,), k % 3, dtype=torch.int32) for n in range(k % 30)]
        views.add(BallView.of(camera, X, RADIUS_MM).place_px.numpy().tobytes())
        del held
    assert len(views) == 1


def test_masked_pixels_show_nothing():
    camera, R = pinhole(), torch.eye(3, dtype=torch.float64)
    cells, view, picture = PaintCells(48, 0.05), BallView.of(pinhole(), X, RADIUS_MM), picture_of(camera, R)
    cells.add(view, picture, torch.zeros_like(picture, dtype=torch.bool), (0, 0), R)
    assert not bool(cells.weight.any())
    cells.add(view, picture[100:, 50:], picture[100:, 50:] > 0, (50, 100), R)
    whole = PaintCells(48, 0.05)
    whole.add(view, picture, picture > 0, (0, 0), R)
    both = (cells.weight > 0) & (whole.weight > 0)
    assert 0.5 * int((whole.weight > 0).sum()) < int(both.sum())
    torch.testing.assert_close(cells.mean[both], whole.mean[both], atol=1e-3, rtol=0.0)


def followed(ball, numbers, place=None) -> list[Poses]:
    follower = FirstPass(place or ball.place)
    return [follower.next(k / RATE_HZ, [ball.frames[k]])[0] for k in numbers]


def test_the_first_pass_follows_a_ball_without_a_map(ball):
    place = replace(ball.place, position_lab_mm=ball.X[:1])
    found = followed(ball, range(70), place)
    R = torch.cat([poses.R_lab_body for poses in found])
    assert torch.equal(R[0], torch.eye(3, dtype=torch.float64)) or float(so3.log(R[0]).norm()) < 1e-3
    steps = error_deg(R[1:] @ R[:-1].mT, ball.R[1:] @ ball.R[:-1].mT)
    assert float(steps.median()) < 0.1
    assert float(error_deg(R, ball.R @ ball.R[0].mT).max()) < 1.0
    sigma = torch.stack([poses.covariance[0, :3, :3].diagonal().sum().sqrt() for poses in found[1:]])
    assert 0.005 < float(torch.rad2deg(sigma.median())) < 0.3


def test_the_fit_uses_the_map_that_grows_whatever_the_rounding_of_the_radius(ball, monkeypatch):
    exact = CameraView.radius_px

    def rounded(view: CameraView, position_lab_mm: torch.Tensor, radius_mm: float) -> torch.Tensor:
        """As vector instructions, which round the radii of many positions otherwise than that of one."""
        return exact(view, position_lab_mm, radius_mm) * (1.0 - 2e-16 * (position_lab_mm.ndim - 1))

    monkeypatch.setattr(CameraView, "radius_px", rounded)
    found = followed(ball, range(2), replace(ball.place, position_lab_mm=ball.X[:1]))
    assert all(map(supported, found))


def test_a_jump_is_found_and_another_thing_is_none(ball):
    place = replace(ball.place, position_lab_mm=ball.X[:1])
    follower = FirstPass(place)
    for k in range(5):
        follower.next(k / RATE_HZ, [ball.frames[k]])
    shape, background = ball.frames[0].picture.shape, place.views[0].background
    dark = Frame(shown=np.zeros(shape, np.uint8), background=background)
    noise = Frame(shown=np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8), background=background)
    assert follower.next(5 / RATE_HZ, [dark])[0].reason == (Reason.DARK,)
    assert follower.next(6 / RATE_HZ, [noise])[0].reason == (Reason.LOW_SCORE,)
    again, searched = follower.next(8 / RATE_HZ, [ball.frames[8]])  # 30 degrees on
    assert searched
    assert supported(again)
    assert float(error_deg(again.R_lab_body, (ball.R[8] @ ball.R[0].mT)[None]).max()) < 1.0
    assert supported(follower.next(8 / RATE_HZ, [ball.frames[8]])[0])  # a time that stands


def test_a_ball_that_has_turned_far_unseen_is_found_again(ball):
    follower = FirstPass(replace(ball.place, position_lab_mm=ball.X[:1]))
    for k in range(50):
        follower.next(k / RATE_HZ, [ball.frames[k]])
    away = torch.rad2deg(so3.geodesic_distance(ball.R[:50], ball.R[49:50]))
    far = int(away.argmax())
    again, searched = follower.next(50 / RATE_HZ, [ball.frames[far]])
    assert searched
    assert float(away[far]) > 60.0
    assert float(so3.geodesic_distance(again.R_lab_body[0], ball.R[far] @ ball.R[0].mT)) < 0.05


@pytest.mark.parametrize("hidden", ["beside the picture", "behind the mask"])
def test_a_camera_that_does_not_show_the_ball_does_not_stop_the_other(ball, hidden):
    view = ball.place.views[0]
    camera, scene = view.camera, view.scene
    if hidden == "beside the picture":
        camera = replace(camera, centre_px=camera.centre_px + 1000.0)
    else:
        mask = np.zeros(scene.background.mean.shape, bool)
        scene = replace(scene, background=replace(scene.background, shown=mask))
    views = [view, CameraView.of("cam2", camera, scene)]
    follower = FirstPass(replace(ball.place, views=views, position_lab_mm=ball.X[:1]))
    there = ball.X[0], torch.tensor([True, False])
    found = [follower.next(k / RATE_HZ, [ball.frames[k]] * 2, there)[0] for k in range(8)]
    assert all(map(supported, found))
    R = torch.cat([poses.R_lab_body for poses in found])
    assert float(error_deg(R, ball.R[:8] @ ball.R[0].mT).max()) < 1.0


def test_only_frames_of_the_first_pass_count_as_showing_the_ball(ball, monkeypatch):
    place = replace(ball.place, fixed=False, position_lab_mm=ball.X, seen=torch.ones(70, 1, dtype=torch.bool))
    found = followed(ball, range(12), replace(ball.place, position_lab_mm=ball.X[:1]))
    done = SimpleNamespace(turned_rad=1.0, adjusted=lambda _: "adjusted")
    monkeypatch.setattr(first_pass, "FOLLOWED", 12)
    monkeypatch.setattr(first_pass, "swept", lambda *_: (found, done))
    recording = SimpleNamespace(timeline=range(70))
    assert first_pass.first_adjustment(recording, place, lambda *_: None) == "adjusted"


def kept(ball, place) -> KeptFrames:
    follower, frames = FirstPass(place), KeptFrames(place)
    for k, frame in enumerate(ball.frames):
        frames.add([frame], follower.next(k / RATE_HZ, [frame])[0])
    return frames


def test_place_and_turns_are_adjusted_together(ball):
    camera, radius_mm = ball.place.views[0].camera, ball.place.radius_mm
    px = radius_mm / float(ball.place.views[0].radius_px(ball.X[0], radius_mm))  # mm
    start = ball.X[:1] + 0.4 * px * (camera.R_cam_lab[0] - camera.R_cam_lab[1])
    start = start + 0.01 * (start - centre_lab_mm(camera))
    found = kept(ball, replace(ball.place, position_lab_mm=start)).adjusted()
    X = found.crops.position_lab_mm[0]
    assert float((camera.project(X) - camera.project(ball.X[0])).norm()) < 0.05  # px, of 0.57
    sizes = [float(ball.place.views[0].radius_px(one, radius_mm)) for one in (X, ball.X[0])]
    assert abs(sizes[0] / sizes[1] - 1) < 0.003  # of 0.01
    body = so3.nearest_rotation((found.R_lab_body.mT @ ball.R).mean(0))
    assert float(error_deg(found.R_lab_body @ body, ball.R).median()) < 0.1


def test_the_light_is_that_of_all_frames_though_a_mask_hides_much_of_the_first():
    """Before: the light was 0 where the first frame hides the ball; residuals of 4 times the paint."""
    size, behind, texture = (140, 100), 20.0, random_texture("blobs", 1, 128)
    camera = PinholeCamera(
        image_size=size,
        R_cam_lab=torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double(),
        T_cam_lab_mm=torch.tensor([0.0, 0, 500.0]).double(),
        centre_px=torch.tensor([69.5, 49.5]).double(),
        f_px=torch.tensor(1250.0).double(),
    )
    shown = np.ones((100, 140), bool)
    shown[:, :55] = False
    scene = Background(
        mean=np.full((100, 140), behind, np.float32),
        noise=np.ones((100, 140), np.float32),
        full_scale=math.inf,
        shown=shown,
    )
    views = [CameraView.of("cam1", camera, CameraScene(background=scene, diameter_px=50.0))]
    step = torch.arange(12, dtype=torch.float64)
    places = (step - 2.0)[:, None] * torch.tensor([1.0, 0.0, 0.0]).double()
    R = so3.exp(step[:, None] * torch.tensor([0.02, 0.05, 0.06]).double())
    rows = SphereRenderer(texture, radius_mm=10.0, camera=camera)(R, places) * 180 + behind
    held = {"radius_mm": 10.0, "fixed": False, "seen": torch.ones(12, 1, dtype=torch.bool)}
    place = Crops(views=views, crops=[[]], position_lab_mm=places, **held)
    cut = [
        cut_out(place, [row.round().byte().numpy() * shown.astype(np.uint8)], X)
        for row, X in zip(rows, places, strict=True)
    ]
    found = adjusted(place.holding(cut, held["seen"], places), R, levels=LEVELS[:1])
    assert found.left < 0.1


def test_frames_that_were_kept_since_an_adjustment_turn_with_it(ball):
    place = replace(ball.place, position_lab_mm=ball.X[:1])
    frames = kept(ball, place)
    before, late = frames.so_far(), frames.count
    follower = FirstPass(place)
    first, _ = follower.next(0.0, [ball.frames[0]])
    far = replace(first, R_lab_body=so3.exp(torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)))
    frames.add([ball.frames[0]], far)
    assert (before.count, frames.count) == (late, late + 1)
    R = before.crops()[1]
    right = [R[0]]  # all rotations were 2 % too small
    for one, other in pairwise(R):
        right.append(so3.exp(1.02 * so3.log(other @ one.mT)) @ right[-1])
    expected = so3.exp(1.02 * so3.log(far.R_lab_body[0] @ R[-1].mT)) @ right[-1]
    corrected, since = frames.corrected(before, torch.stack(right))
    torch.testing.assert_close(corrected @ far.R_lab_body[0], expected)
    assert len(since.crops()[1]) == 1
    torch.testing.assert_close(frames.crops()[1][-1], expected)


@pytest.mark.parametrize("camera", [pinhole(), brown()], ids=["pinhole", "brown"])
def test_a_coarser_camera_sees_the_middle_of_four_pixels_where_they_meet(camera):
    coarse = CoarserCamera(camera=camera, factor=2)
    assert coarse.image_size == tuple(side // 2 for side in camera.image_size)
    torch.testing.assert_close(coarse.project(X), (camera.project(X) + 0.5) / 2 - 0.5)
    uv = torch.tensor([[0.0, 0.0], [31.0, 12.0]], dtype=torch.float64)
    four = camera.rays(2 * uv + 0.5)
    torch.testing.assert_close(coarse.rays(uv).direction_lab, four.direction_lab)
    torch.testing.assert_close(coarse.distort(coarse.undistort(uv)), uv, atol=1e-6, rtol=0.0)


def test_a_large_ball_is_followed_in_coarser_pixels(ball):
    place = replace(ball.place, position_lab_mm=ball.X[:1])
    assert CoarserPictures.of(place).factor == 1
    view = place.views[0]
    twice = 2 * np.array(view.camera.image_size)
    large = [cv2.resize(frame.picture, twice.tolist(), interpolation=cv2.INTER_NEAREST) for frame in ball.frames[:3]]
    back = CoarserPictures(place=place, whole=place.views, factor=2).frames([Frame(shown=one) for one in large])
    for one, frame in zip(back, ball.frames, strict=False):
        np.testing.assert_array_equal(one.picture, frame.picture.astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("field_deg", [30.0, 60.0])
def test_a_field_of_view_that_the_pictures_contradict_is_reported(tmp_path, field_deg):
    path = write_ball_scene(tmp_path / "scene", SCENES["clean_fly"], 120, 1)
    cameras = yaml.safe_load((path.parent / "cameras.yaml").read_text())
    del cameras["cameras"]["cam1"]["f_px"]
    cameras["cameras"]["cam1"]["vfov_deg"] = field_deg
    (path.parent / "cameras.yaml").write_text(yaml.safe_dump(cameras))
    _, remarks = first_map_of(load_experiment(path), Settings(), None, lambda *_: None)
    if field_deg == 30.0:
        assert remarks == []
    else:
        (remark,) = remarks
        assert float(re.search(r"about ([0-9.]+) degrees, not 60", remark)[1]) == pytest.approx(30.0, rel=0.15)


@pytest.mark.slow
def test_a_ball_far_away_does_not_give_the_field_of_view(ball):
    place = replace(ball.place, position_lab_mm=ball.X[:1])
    camera = place.views[0].camera
    pinhole_like = PinholeCamera(
        image_size=camera.image_size,
        f_px=camera.focal_px[0].clone(),
        centre_px=camera.centre_px,
        R_cam_lab=camera.R_cam_lab,
        T_cam_lab_mm=camera.T_cam_lab_mm,
    )
    place = replace(place, views=[CameraView.of("cam1", pinhole_like, place.views[0].scene)])
    assert focal_ratio(kept(ball, place).adjusted()) == 1.0


@pytest.mark.slow
def test_a_flying_ball_gets_a_map():
    experiment = load_experiment(EXCERPT / "experiment.yaml")
    found, remarks = first_map_of(experiment.with_sphere(texture_path=None), Settings(), None, lambda *_: None)
    assert remarks == []
    assert found.unseen is not None
    assert 0.05 < float(found.unseen.float().mean()) < 0.3
    seen = torch.where(found.unseen, torch.nan, found.grey)
    compared = compare_maps(seen, load_texture(EXCERPT / "texture.png"))
    assert compared.correlation > 0.8
    assert math.degrees(float(compared.moved_rad.norm(dim=1).nanmedian())) < 0.5


@pytest.mark.slow
def test_a_ball_that_comes_late_and_leaves_is_tracked_without_a_map(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("cam1", "cam2"):
        empty = cv2.imread(str(EXCERPT / f"empty_{name}.png"), cv2.IMREAD_GRAYSCALE).astype(float)
        with open_movie(EXCERPT / f"{name}.mkv") as movie:
            pictures = list(movie.sample(range(len(movie))))
        nothing = [(empty + rng.normal(0, 2, empty.shape)).round().clip(0, 255).astype(np.uint8) for _ in range(30)]
        with writing(force=True):
            write_ffv1(tmp_path / f"{name}.mkv", iter([*nothing[:18], *pictures, *nothing[18:]]), 600.0)
    (tmp_path / "cameras.yaml").write_bytes((EXCERPT / "cameras.yaml").read_bytes())
    content = yaml.safe_load((EXCERPT / "experiment.yaml").read_text())
    for key in ("backgrounds", "frames", "start"):
        content.pop(key, None)
    del content["sphere"]["texture"]
    (tmp_path / "experiment.yaml").write_text(yaml.safe_dump(content))
    experiment, texture = load_experiment(tmp_path / "experiment.yaml"), tmp_path / "learnt.png"
    with writing(force=False):
        write_map(first_map_of(experiment, Settings(), None, lambda *_: None)[0], texture)
    (track,) = run_tracks(Request(experiment=experiment.with_sphere(texture_path=texture)), MemoryStore()).values()
    shows = np.arange(len(track)) - 18
    shows = (shows >= 0) & (shows < len(pictures))
    assert not track.valid[~shows].any()
    assert track.valid[shows].mean() > 0.95
    with h5py.File(EXCERPT / "truth.h5") as file:
        true = torch.from_numpy(file["orientation"][()])
    ok = track.valid[shows]
    R, true = torch.from_numpy(track.orientation[shows][ok]), true[: len(pictures)][ok]
    body = so3.nearest_rotation((R.mT @ true).mean(0))
    assert float(error_deg(R @ body, true).median()) < 0.5


def test_a_ball_behind_a_camera_is_refused_with_what_to_check(tmp_path):
    experiment = load_experiment(shutil.copytree(EXCERPT, tmp_path / "copy") / "experiment.yaml")
    cameras = yaml.safe_load((path := experiment.folder / "cameras.yaml").read_text("utf-8"))
    known, about_y = cameras["cameras"]["cam2"], np.diag([-1.0, 1.0, -1.0])  # half a turn of the camera in its place
    known |= {"R": (about_y @ known["R"]).tolist(), "T": (about_y @ known["T"]).tolist()}
    path.write_text(yaml.safe_dump(cameras), "utf-8")
    with (
        open_recording(experiment.path, textured=False) as recording,
        pytest.raises(CameraError, match=r"cam2.*out of its sight.*R and T"),
    ):
        held_place(recording, MapSettings(), LocateSettings(diameter_px=76.0))


def test_a_frame_with_the_ball_behind_a_camera_is_not_used(monkeypatch):
    def one_behind(*arguments):
        found = find_positions(*arguments)
        found.position_lab_mm[3] = 2 * centre_lab_mm(recording.cameras["cam2"])
        return found

    monkeypatch.setattr("sphereorient.mapping.disks.find_positions", one_behind)
    with open_recording(EXCERPT / "experiment.yaml", textured=False) as recording:
        place = held_place(recording, MapSettings(), LocateSettings())
    unseen = ~place.seen.any(1)
    assert torch.nonzero(unseen)[:, 0].tolist() == [3]
    assert torch.equal(unseen, place.position_lab_mm.isnan().any(1))
