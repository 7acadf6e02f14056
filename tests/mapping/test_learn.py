from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from conftest import REPO, SHARED
from map_examples import mapped, true_attitudes
from renders import error_deg, turns_on_both_sides

from sphereorient.cameras import PinholeCamera
from sphereorient.errors import PaintError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.experiment.recording import CameraStream, Recording, TextureMap
from sphereorient.experiment.timeline import timeline
from sphereorient.files.threads import silent
from sphereorient.locate import LocateSettings
from sphereorient.mapping import MapSettings, take_crops
from sphereorient.mapping.learn import SHOWN_MIN, times_seen
from sphereorient.so3 import exp, geodesic_distance
from sphereorient.sphere.texture import fibonacci_directions

EXCERPT = REPO / "synthetic_data" / "excerpt" / "experiment.yaml"
QUICK = MapSettings(pixels=700, rounds=6)


@contextmanager
def opened(path, cameras=None, frames=None):
    """A recording whose experiment names no texture."""
    experiment = load_experiment(path).with_sphere(texture_path=None)
    experiment = experiment if frames is None else replace(experiment, frames=frames)
    names = cameras or list(experiment.movie_paths)
    movies = open_movies(experiment, names)
    lines = timeline(experiment, movies)
    streams = [
        CameraStream(name=name, camera=experiment.cameras[name], movie=movies[name], rows=lines.rows[name])
        for name in names
    ]
    maps = {"": TextureMap(grey=torch.full((8, 16), 0.5))}
    yield Recording(experiment=experiment, streams=streams, timeline=lines, maps=maps, remarks=())


@pytest.mark.slow
def test_one_camera_of_the_excerpt_gives_attitudes_and_leaves_unseen_texels_empty():
    with opened(EXCERPT, ["cam1"]) as recording:
        learnt = mapped(recording, QUICK)
    assert bool(learnt.valid.all())
    error = error_deg(learnt.R_lab_body, true_attitudes(EXCERPT)[: len(learnt.valid)])
    assert error.median() < 0.5
    assert learnt.rounds[-1].moved_rad < learnt.rounds[1].moved_rad
    torch.testing.assert_close(learnt.R_lab_body[0], torch.eye(3, dtype=torch.float64))
    # Paint that never faced the camera stays empty, and its share is reported.
    empty = learnt.seen == 0
    assert 0.02 < float(empty.double().mean()) < 0.7
    assert torch.equal(empty, learnt.texture.isnan())
    assert torch.equal(empty, learnt.sigma.isinf())
    assert learnt.seen_share < 0.98
    assert learnt.score.nanmedian() > 0.85


def test_one_frame_is_refused():
    with opened(EXCERPT, frames=(3, 4)) as recording, pytest.raises(PaintError, match="2 frames"):
        mapped(recording, QUICK)


def test_footage_holds_the_ball_of_every_frame():
    with opened(EXCERPT, ["cam2"], (0, 3)) as recording:
        crops = take_crops(recording, QUICK, LocateSettings(), silent)
        whole = next(iter(recording.streams[0].pictures()))[0]
    assert bool(crops.seen.all())
    window = crops.crops[0][0]
    rows, columns = window.grey.shape
    inside = np.s_[window.top : window.top + rows, window.left : window.left + columns]
    np.testing.assert_array_equal(crops.picture(0, 0)[inside], whole[inside])


def test_a_place_counts_in_the_pictures_that_do_not_show_it_too_slanted():
    # Near cameras, so that the limb is far from 90 degrees; one picture of four is not used.
    R = exp(torch.tensor([[0.3, -1.2, 0.4], [2.0, 0.5, -0.7]], dtype=torch.float64))
    X = torch.tensor([[0.5, 0.2, -0.1], [-0.3, 0.4, 0.0]], dtype=torch.float64)
    middles = torch.tensor([[0.0, 0.0, 5.0], [4.0, 1.0, 0.0]], dtype=torch.float64)
    ahead = -torch.nn.functional.normalize(middles, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(ahead.new_tensor([[0.0, 1.0, 0.0]]), ahead), dim=-1)
    turns = torch.stack([right, torch.linalg.cross(ahead, right), ahead], dim=1)
    lens = {
        "image_size": (200, 200),
        "f_px": torch.tensor(100.0).double(),
        "centre_px": torch.full((2,), 99.5).double(),
    }
    cameras = [PinholeCamera(R_cam_lab=C, T_cam_lab_mm=-C @ m, **lens) for C, m in zip(turns, middles, strict=True)]
    state = SimpleNamespace(
        R_lab_body=R,
        position_lab_mm=X,
        use=torch.tensor([[True, True], [False, True]]),
        fitter=SimpleNamespace(
            radius_mm=1.5,
            views=[SimpleNamespace(camera=camera, background=SimpleNamespace(shown=None)) for camera in cameras],
        ),
    )
    direction = fibonacci_directions(300)
    expected = torch.zeros(300, dtype=torch.int64)
    for k, c in ((0, 0), (0, 1), (1, 1)):
        normal = direction @ R[k].mT
        towards = middles[c] - (X[k] + 1.5 * normal)
        expected += (normal * towards).sum(-1) / towards.norm(dim=-1) > SHOWN_MIN
    assert len(expected.unique()) > 2
    torch.testing.assert_close(times_seen(state, direction), expected)


@pytest.mark.slow
@pytest.mark.shared
def test_a_ball_fixed_in_its_place_is_learnt_from_one_camera():
    path = SHARED / "fixed_ball" / "experiment.yaml"
    with opened(path) as recording:
        learnt = mapped(recording, MapSettings())
    true = true_attitudes(path)
    R = learnt.R_lab_body
    P, _ = turns_on_both_sides(R, true)
    assert error_deg(P @ R, true).median() < 0.01  # 0.013 if the limb counts anew in each picture
    step = torch.rad2deg(geodesic_distance(R[1:] @ R[:-1].mT, P.mT @ true[1:] @ true[:-1].mT @ P))
    assert step.median() < 0.02
    assert learnt.position_lab_mm.std(0).max() < 1e-9
    assert learnt.blur_px == pytest.approx(12**-0.5, rel=0.15)  # of a pixel alone


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize(("cameras", "median_deg"), [(None, 0.07), (["cam1"], 0.14)], ids=["both", "one"])
def test_the_shared_experiment_is_learnt_without_its_texture(tmp_path, cameras, median_deg):
    path = SHARED / "experiment" / "experiment.yaml"
    with opened(path, cameras) as recording:
        learnt = mapped(recording, MapSettings())
    error = error_deg(learnt.R_lab_body, true_attitudes(path))
    # With unsolved smooth distortions of the map one camera is off by 0.17 degrees.
    assert error.median() < median_deg
    assert error.quantile(0.95) < 2 * median_deg
    assert cameras or learnt.seen_share > 0.95
    grey = (torch.nan_to_num(learnt.texture, nan=0.5) * 255).round().byte().numpy()
    assert cv2.imwrite(str(tmp_path / "learnt.png"), grey)
