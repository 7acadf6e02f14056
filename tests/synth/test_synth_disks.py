"""Single balls for a proposer: position of the paint, effect of degradations, the same for the same seed."""

import math

import numpy as np
import pytest
import torch
from conftest import assert_close
from numpy.typing import NDArray
from synth_examples import camera, scene, seen_at
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError
from sphereorient.search.normalisation import crop_disk
from sphereorient.sphere.texture import map_directions
from sphereorient.sphere.view import disk_offsets
from sphereorient.synth import disks, random_texture, render_frame, severity
from sphereorient.synth.degrade import OPERATIONS, blurred
from sphereorient.synth.disks import DISK_DEGRADATIONS, DiskSettings, film_disks

EXACT = DiskSettings(centre_sigma_px=0.0, radius_sigma=0.0)  # outlines without error
AT = disk_offsets(EXACT.size_px).numpy()  # (S, S, 2), right and down of the middle, radii


def dotted(direction_body: Tensor) -> Tensor:
    """White paint with a black dot of 14 degrees there."""
    cosine = map_directions(128) @ direction_body.double()
    return (cosine < math.cos(math.radians(14))).float()


def seeded(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


@pytest.fixture
def noiseless(monkeypatch):
    monkeypatch.setattr(disks, "READ_NOISE", 0.0)
    monkeypatch.setattr(disks, "SHOT_NOISE", 0.0)


def dark_place(disk: Tensor) -> NDArray[np.float64]:
    """Where the dot is, (right, down) in radii: mean of the darkest pixels relative to the light about them."""
    inside = np.hypot(*np.moveaxis(AT, -1, 0)) < 0.85
    grey = disk.numpy()
    low = inside & (grey < 0.5 * (grey[inside].min() + np.median(grey[inside])))
    return AT[low].mean(0)


@pytest.mark.parametrize(
    ("direction", "place"),
    # View: x right, y down, z away from the camera; body axes along them.
    [
        ((0, 0, -1), (0, 0)),
        ((0.6, 0, -0.8), (0.6, 0)),
        ((0, 0.6, -0.8), (0, 0.6)),
        ((-0.5, -0.3, -0.812), (-0.5, -0.3)),
    ],
)
def test_a_dot_of_a_ball_whose_axes_are_the_views_appears_where_it_is(direction, place):
    film = film_disks(dotted(torch.tensor(direction)), torch.eye(3)[None], {}, seeded(), EXACT)
    assert np.abs(dark_place(film[0]) - place).max() < 0.05


def test_a_dot_appears_where_the_rotation_takes_it(rng):
    """R_view_body times the body direction, not its inverse, and no mirror."""
    dot = torch.nn.functional.normalize(torch.tensor([0.3, -0.7, 0.5]), dim=0)
    R = so3.random_rotations(60, generator=rng).float()
    at = R @ dot
    R, at = R[at[:, 2] < -0.65], at[at[:, 2] < -0.65]
    assert len(R) > 5
    film = film_disks(dotted(dot), R, {}, seeded(), EXACT)
    found = np.stack([dark_place(disk) for disk in film])
    assert np.abs(found - at[:, :2].numpy()).max() < 0.06


def test_a_dot_on_the_far_side_does_not_appear(rng):
    film = film_disks(dotted(torch.tensor([0.0, 0, 1])), torch.eye(3)[None], {}, seeded(), EXACT)
    inside = np.hypot(*np.moveaxis(AT, -1, 0)) < 0.9
    assert film[0].numpy()[inside].min() > 0.25 * film[0].numpy()[inside].max()


def test_paint_is_that_which_the_projects_other_renderer_shows(rng):
    """A camera that looks at the ball along its axis, its frame cropped as the pipeline does it."""
    lens, texture = camera(f_px=1600.0), random_texture("blobs", 3, 256)
    stage = scene(texture, diameter_px=72.0)
    centre = seen_at(lens, 0.0, 0.0)
    inside = np.hypot(*np.moveaxis(AT, -1, 0)) < 0.9
    for R_lab_body in so3.random_rotations(4, generator=rng):
        frame = render_frame(stage, lens, centre[None], R_lab_body[None], seeded(0))
        u, v = (side.item() for side in lens.centre_px)
        cropped = crop_disk(frame, u, v, 36.0, EXACT.size_px)[inside]
        R_view_body = (lens.R_cam_lab @ R_lab_body).float()
        right, inverse, mirrored = (
            film_disks(paint, R[None], {}, seeded(), EXACT)[0].numpy()[inside]
            for paint, R in ((texture, R_view_body), (texture, R_view_body.mT), (texture.flip(1), R_view_body))
        )
        assert np.corrcoef(cropped, right)[0, 1] > 0.85
        assert np.corrcoef(cropped, inverse)[0, 1] < 0.6
        assert np.corrcoef(cropped, mirrored)[0, 1] < 0.6


def test_the_outline_is_the_pictures_border():
    """A white ball before darkness: half of a pixel's depth inside the rim is bright, outside it is not."""
    film = film_disks(torch.ones(16, 32), torch.eye(3).expand(20, 3, 3), {}, seeded(), EXACT)
    radius = np.hypot(*np.moveaxis(AT, -1, 0))
    middle = film[:, radius < 0.5].mean(1)
    outside = film[:, (radius > 1.08)].mean(1)
    ring = film[:, (radius > 0.93) & (radius < 0.97)].mean(1)
    assert (outside < 0.5 * middle).all()
    assert (ring > outside + 0.3 * (middle - outside)).all()


def test_errors_of_the_outline_move_and_stretch_the_picture():
    """Twenty pictures scatter by the settings' 0.5 px of a radius of 39 px."""
    dot = dotted(torch.tensor([0.0, 0, -1]))
    loose = DiskSettings(centre_sigma_px=2.0, radius_sigma=0.0)
    places = np.stack([dark_place(d) for d in film_disks(dot, torch.eye(3).expand(60, 3, 3), {}, seeded(), loose)])
    assert abs(places.std() - 2.0 / 39) < 0.02
    wide = DiskSettings(centre_sigma_px=0.0, radius_sigma=0.05)
    edge = dotted(torch.tensor([0.5, 0, -0.866]))
    places = np.stack([dark_place(d) for d in film_disks(edge, torch.eye(3).expand(60, 3, 3), {}, seeded(), wide)])
    # The quantile that is one sigma: a shadow at the rim passes for the dot now and then.
    assert abs(np.quantile(np.abs(places[:, 0] - np.median(places[:, 0])), 0.683) - 0.05 * 0.5) < 0.008


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(rng):
    texture, R = random_texture("patches", 1, 64), so3.random_rotations(3, generator=rng).float()
    values = {name: severity(name, 3) for name in ("bubbles", "motion_blur", "defocus")}
    first, again, other = (film_disks(texture, R, values, seeded(k), EXACT) for k in (7, 7, 8))
    assert torch.equal(first, again)
    assert (first - other).abs().mean() > 3


@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("size_px", [24, 40])
def test_there_is_a_picture_for_each_attitude(count, size_px, rng):
    R = so3.random_rotations(count, generator=rng).float()
    settings = DiskSettings(size_px=size_px)
    film = film_disks(random_texture("dots", 1, 64), R, {"bubbles": 3.0}, seeded(), settings)
    assert film.shape == (count, size_px, size_px)
    assert film.dtype == torch.float32
    assert film.isfinite().all()
    assert ((film >= 0) & (film <= 255)).all()


def test_light_is_another_for_each_picture():
    film = film_disks(random_texture("blobs", 2, 64), torch.eye(3).expand(8, 3, 3), {}, seeded(), EXACT)
    assert film.mean((1, 2)).std() > 5


def test_coarser_pixels_show_the_same_ball(rng):
    texture, R = random_texture("blobs", 2, 128), so3.random_rotations(1, generator=rng).float()
    fine, coarse = (
        film_disks(texture, R, {}, seeded(1), DiskSettings(scale=scale, centre_sigma_px=0, radius_sigma=0))
        for scale in (1.0, 0.5)
    )
    inside = torch.from_numpy(np.hypot(*np.moveaxis(AT, -1, 0)) < 0.9)
    assert torch.corrcoef(torch.stack([fine[0][inside], coarse[0][inside]]))[0, 1] > 0.9


# What acts on grey levels after the light is drawn: all else is the same with the same seed.
ON_PICTURES = [name for name in DISK_DEGRADATIONS if name in OPERATIONS]


@pytest.mark.usefixtures("noiseless")
@pytest.mark.parametrize("name", ON_PICTURES)
def test_a_degradation_of_pictures_changes_them_and_more_so_the_harder_it_is(name, rng):
    texture, R = random_texture("blobs", 2, 128), so3.random_rotations(8, generator=rng).float()
    plain, mild, hard = (
        film_disks(texture, R, values, seeded(3), EXACT)
        for values in ({}, {name: severity(name, 2)}, {name: severity(name, 5)})
    )
    change = [float((film - plain).square().mean().sqrt()) for film in (mild, hard)]
    assert change[0] > 0.3
    assert change[1] > 1.4 * change[0]


@pytest.mark.usefixtures("noiseless")
@pytest.mark.parametrize("name", ["motion_blur", "ball_size", "defocus"])
def test_blurs_make_pictures_less_sharp(name, rng):
    """Steps between neighbours in the middle of the disks, rms, grey levels."""
    texture, R = random_texture("blobs", 2, 128), so3.random_rotations(48, generator=rng).float()
    plain, mild, hard = (
        float(film_disks(texture, R, values, seeded(3), EXACT)[:, 8:32, 8:32].diff(dim=2).square().mean().sqrt())
        for values in ({}, {name: severity(name, 4)}, {name: severity(name, 5)})
    )
    assert hard < 0.95 * mild
    assert hard < 0.7 * plain
    assert mild < 0.95 * plain


@pytest.mark.slow
def test_a_blur_by_motion_is_about_the_attitude_in_the_middle_of_the_exposure():
    """A dot is smeared on both sides."""
    dot = dotted(torch.tensor([0.0, 0, -1]))
    film = film_disks(dot, torch.eye(3).expand(80, 3, 3), {"motion_blur": 8.0}, seeded(), EXACT)
    places = np.stack([dark_place(disk) for disk in film])
    assert np.abs(np.median(places, 0)).max() < 0.01
    assert np.quantile(np.hypot(*places.T), 0.9) < 0.05


@pytest.mark.parametrize(("error_px", "scale"), [(4.0, 1.0), (4.0, 0.5)])
def test_a_wrong_centre_moves_the_ball_by_that_much(error_px, scale):
    """4 px of a radius of 39 px, also where pixels are coarser."""
    settings = DiskSettings(scale=scale, centre_sigma_px=0.0, radius_sigma=0.0)
    dot = dotted(torch.tensor([0.0, 0, -1]))
    film = film_disks(dot, torch.eye(3).expand(12, 3, 3), {"centre_error": error_px}, seeded(), settings)
    off = np.hypot(*np.stack([dark_place(disk) for disk in film]).T)
    assert np.abs(off - error_px / 39).max() < 0.025


def test_a_wrong_radius_shrinks_the_ball():
    dot = dotted(torch.tensor([0.6, 0, -0.8]))
    film = film_disks(dot, torch.eye(3)[None], {"radius_error": 6.0}, seeded(), EXACT)
    assert_close(torch.from_numpy(dark_place(film[0])), torch.tensor([0.6 * 39 / 45, 0.0]).double(), atol=0.03)


def test_degradations_of_maps_change_no_disk(rng):
    texture, R = random_texture("blobs", 2, 64), so3.random_rotations(2, generator=rng).float()
    plain = film_disks(texture, R, {}, seeded(), EXACT)
    assert torch.equal(film_disks(texture, R, {"paint_wear": 0.4, "texture_error": 0.4}, seeded(), EXACT), plain)


@pytest.mark.parametrize(
    ("values", "word"),
    [({"bubble": 3.0}, "bubbles"), ({"spin": 20.0}, "write_degraded"), ({"occlusion": 1.5}, "occlusion")],
)
def test_unknown_names_and_impossible_values_are_refused(values, word):
    with pytest.raises(SettingsError, match=word) as caught:
        film_disks(torch.ones(16, 32), torch.eye(3)[None], values, seeded(), EXACT)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "value"), [("uneven_light", 8.0), ("highlights", 30.0)])
def test_the_optics_blur_the_light_of_the_ball(name, value, noiseless, monkeypatch):
    monkeypatch.setattr(disks, "_cropped", lambda grey, *_: grey)
    R = so3.random_rotations(2, generator=seeded()).float()
    texture = random_texture("blobs", 1, 64)
    seen = []
    for blur in (0.3, 2.0):
        monkeypatch.setattr(disks, "BLUR_PX", blur)
        seen.append(film_disks(texture, R, {name: value}, seeded(), EXACT))
    expected = blurred(seen[0], math.sqrt(2.0**2 - 0.3**2))
    assert (seen[1] - expected).abs().max() < 1.2  # both are rounded to whole levels; the other order: 11 and 5
