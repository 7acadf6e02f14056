import math

import cv2
import numpy as np
import pytest
import torch
from conftest import assert_close
from PIL import Image
from sphere_examples import body_direction, f64, looked_up, random_map

from sphereorient.errors import ShapeError, TextureError
from sphereorient.sphere import load_known, load_texture, load_unseen, reduced_texture, sample_texture, unseen_share
from sphereorient.sphere.texture import map_directions, sample_spline, texel_areas, texture_coordinates


def saved(folder, picture, name="texture.png"):
    assert cv2.imwrite(str(folder / name), picture)
    return folder / name


# --- looking up


def test_it_agrees_with_a_lookup_in_numpy(rng, dtype):
    texture = random_map(rng)
    direction = torch.randn(5000, 3, generator=rng, dtype=torch.float64)
    got = sample_texture(texture.to(dtype), direction.to(dtype))
    assert got.dtype == dtype
    # float32: a column's position is good to 32 columns x 1e-7, times slopes of up to 1 a column.
    atol = {torch.float64: 1e-13, torch.float32: 2e-5}[dtype]
    assert_close(got.double(), torch.from_numpy(looked_up(texture, direction)), atol=atol)


def test_float64_is_not_rounded_to_float32_on_a_map_of_full_size(rng):
    texture = random_map(rng, 512)
    direction = torch.randn(5000, 3, generator=rng, dtype=torch.float64)
    assert_close(sample_texture(texture, direction), torch.from_numpy(looked_up(texture, direction)), atol=1e-11)


def test_the_middle_of_a_texel_shows_that_texel(rng):
    texture = random_map(
        rng, 4
    )  # docs/conventions.md: column u is longitude 360 (u + 0.5)/8 - 180, row v latitude 90 - 180 (v + 0.5)/4
    assert_close(sample_texture(texture, body_direction(-157.5, 67.5)), texture[0, 0])
    assert_close(sample_texture(texture, body_direction(22.5, 67.5)), texture[0, 4])
    assert_close(sample_texture(texture, body_direction(112.5, -22.5)), texture[2, 6])
    # Rows counted from the south, or columns towards the west, are another texel.
    assert abs(float(sample_texture(texture, body_direction(112.5, 22.5)) - texture[2, 6])) > 0.01
    assert abs(float(sample_texture(texture, body_direction(-112.5, -22.5)) - texture[2, 6])) > 0.01


def test_the_length_of_a_direction_does_not_matter(rng):
    texture, direction = random_map(rng), torch.randn(50, 3, generator=rng, dtype=torch.float64)
    assert_close(sample_texture(texture, 1e-3 * direction), sample_texture(texture, direction), atol=1e-12)


def test_the_date_line_is_no_edge(rng):
    texture = random_map(rng)
    for row, latitude in ((3, 90 - 3.5 * 11.25), (12, 90 - 12.5 * 11.25)):
        mean = (texture[row, 0] + texture[row, -1]) / 2
        for longitude in (180 - 1e-9, -180 + 1e-9, 180, -180):
            assert_close(sample_texture(texture, body_direction(longitude, latitude)), mean, atol=1e-9)


@pytest.mark.parametrize("pole", [1, -1])
def test_a_meridian_goes_on_beyond_the_pole(rng, pole):
    texture = random_map(rng)
    for column in (0, 5, 20):
        longitude = (column + 0.5) * 11.25 - 180
        here = sample_texture(texture, body_direction(longitude, pole * (90 - 1e-9)))
        beyond = sample_texture(texture, body_direction(longitude + 180, pole * (90 - 1e-9)))
        ring = texture[0] if pole > 0 else texture[-1]
        assert_close(here, beyond, atol=1e-8)
        assert_close(here, (ring[column] + ring[(column + 16) % 32]) / 2, atol=1e-8)


def test_a_grey_sphere_is_grey_everywhere_on_seams_and_poles_too(dtype, tolerance, rng):
    direction = torch.randn(2000, 3, generator=rng, dtype=torch.float64)
    special = f64([[0, 0, 1], [0, 0, -1], [-1, 0, 0], [-1, -0.0, 0], [-1, 1e-300, 1e-300], [1, 0, 0], [0, -1, 0]])
    grey = sample_texture(torch.full((8, 16), 0.3, dtype=dtype), torch.cat([direction, special]).to(dtype))
    assert_close(grey, torch.full_like(grey, 0.3), atol=tolerance)


def test_longitude_and_latitude_by_hand():
    lon, lat = texture_coordinates(f64([[1, 1, 0], [0, -2, 2], [-1, 0, 0], [0, 0, 3]]))
    assert_close(lon[:3], f64([45, -90, 180]).deg2rad())
    assert_close(lat, f64([0, 45, 0, 90]).deg2rad(), atol=1e-15)


@pytest.mark.parametrize(
    "place",
    [(0, 0, 1), (0, 0, -1), (1e-300, 0, 1), (1e-17, -1e-17, 1), (0, -0.0, -1), (-1, 0, 0), (-1, -0.0, 0)],
)
def test_gradients_at_poles_and_date_line_are_finite_and_do_not_drown_the_others(rng, dtype, place):
    texture = random_map(rng).to(dtype)
    direction = torch.tensor(place, dtype=dtype, requires_grad=True)
    (gradient,) = torch.autograd.grad(sample_texture(texture, direction), direction)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() < 32  # a grey step of 1 over a column is 5 per rad


def test_gradients_are_right_in_directions_and_in_the_map(rng):
    texture = random_map(rng, 4).requires_grad_()
    direction = torch.randn(12, 3, generator=rng, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(sample_texture, (texture, direction))


def test_a_batch_is_the_stack_of_its_singles(rng, dtype, tolerance, batch):
    texture = random_map(rng, 8).to(dtype)
    direction = torch.randn(*batch, 3, generator=rng, dtype=torch.float64).to(dtype)
    grey = sample_texture(texture, direction)
    assert grey.shape == batch
    for single, expected in zip(direction.reshape(-1, 3), grey.reshape(-1), strict=True):
        assert_close(sample_texture(texture, single), expected, atol=10 * tolerance)


def test_inputs_stay_as_they_are(rng):
    texture, direction = random_map(rng), f64([[0, 0, 1], [1, 2, 3]])
    before = texture.clone(), direction.clone()
    sample_texture(texture, direction)
    assert torch.equal(texture, before[0])
    assert torch.equal(direction, before[1])


def test_shapes_of_no_map_and_of_no_direction_are_refused():
    with pytest.raises(ShapeError, match=r"texture: .*got \(8, 15\)"):
        sample_texture(torch.zeros(8, 15), torch.zeros(1, 3))
    with pytest.raises(ShapeError, match=r"direction_body: expected shape \(\.\.\., 3\)"):
        sample_texture(torch.zeros(8, 16), torch.zeros(3, 2))


# --- reducing


def test_a_map_is_reduced_by_the_whole_factor_that_leaves_a_disk_pixel_its_texel():
    texture = torch.zeros(512, 1024)
    assert reduced_texture(texture, 78.0).shape == (128, 256)  # circumference 245 px: 4 texels each
    assert reduced_texture(texture, 400.0).shape == (512, 1024)  # 1257 px: finer than the map


@pytest.mark.parametrize("diameter_px", [1.0, 9.0, 20.0, 40.0, 78.0, 300.0])
def test_reducing_keeps_the_mean_and_is_never_coarser_than_the_disk(rng, diameter_px):
    texture = random_map(rng, 240)
    small = reduced_texture(texture, diameter_px)
    assert small.shape[1] == 2 * small.shape[0]
    assert small.shape[1] >= min(math.pi * diameter_px, 480)
    assert_close(small.mean(), texture.mean())


def test_a_reduced_map_lies_where_the_map_lay(rng):
    # A map that is the cosine of the longitude, averaged over 4 columns, is that cosine still but for 0.6 %.
    longitude = math.pi * (torch.arange(64, dtype=torch.float64) + 0.5) / 32 - math.pi
    texture = (longitude.cos() * 0.5 + 0.5).expand(32, 64)
    direction = torch.randn(200, 3, generator=rng, dtype=torch.float64)
    direction = direction[direction[:, 2].abs() < direction[:, :2].norm(dim=-1)]  # not at the poles
    small = reduced_texture(texture, 5.0)
    assert small.shape == (8, 16)
    gap = sample_texture(small, direction) - sample_texture(texture, direction)
    assert gap.abs().max() < 0.02


# --- loading


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_white_paint_is_1_and_black_paint_0_in_8_and_16_bits(tmp_path, kind, white):
    picture = np.zeros((8, 16), kind)
    picture[2, 5], picture[3, 6] = white, white // 5
    texture = load_texture(saved(tmp_path, picture))
    assert texture.dtype == torch.float32
    assert texture.shape == (8, 16)
    assert texture[2, 5] == 1.0
    assert_close(texture[3, 6], torch.tensor(0.2), atol=1e-7)
    assert texture[0, 0] == 0.0


def test_a_colour_picture_becomes_grey(tmp_path):
    picture = np.zeros((8, 16, 3), np.uint8)
    picture[2, 5] = 255
    texture = load_texture(saved(tmp_path, picture))
    assert texture[2, 5] == 1.0
    assert texture.shape == (8, 16)


@pytest.mark.parametrize(
    ("picture", "got"),
    [
        (np.eye(16, dtype=np.uint8), "got 16 x 16"),
        (np.eye(16, 8, dtype=np.uint8), "got 8 x 16"),
        (np.eye(7, 14, dtype=np.uint8), "got 14 x 7"),
        (np.full((8, 16), 200, np.uint8), "got one single grey"),
    ],
    ids=["square", "upright", "small", "one grey"],
)
def test_a_picture_that_is_no_map_is_refused(tmp_path, picture, got):
    with pytest.raises(TextureError, match=got):
        load_texture(saved(tmp_path, picture))


def test_a_float_picture_is_refused(tmp_path):
    with pytest.raises(TextureError, match="got float32"):
        load_texture(saved(tmp_path, np.eye(8, 16, dtype=np.float32), "texture.tiff"))


@pytest.mark.parametrize("content", [b"", b"no picture at all"], ids=["empty", "text"])
def test_a_file_that_is_no_picture_is_refused(tmp_path, content):
    path = tmp_path / "texture.png"
    path.write_bytes(content)
    with pytest.raises(TextureError, match="does not decode"):
        load_texture(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for path, got in ((tmp_path / "texture.png", "no such file"), (tmp_path, "a folder")):
        with pytest.raises(TextureError, match=f"got {got}"):
            load_texture(path)


# --- the spline


def test_a_lone_texel_is_the_cubic_b_spline():
    texture = torch.zeros(8, 16, dtype=torch.float64)
    texture[3, 5] = 1.0
    middle = map_directions(8)
    assert_close(sample_spline(texture, middle[3, 5]), f64(4 / 9))  # 2/3 along the row, 2/3 along the column
    assert_close(sample_spline(texture, middle[3, 6]), f64(2 / 3 * 1 / 6))
    assert_close(sample_spline(texture, middle[4, 6]), f64(1 / 36))
    assert_close(sample_spline(texture, middle[3, 7]), f64(0.0))


def test_the_spline_agrees_with_the_bilinear_map_where_it_is_smooth(rng):
    directions = torch.randn(2000, 3, generator=rng, dtype=torch.float64)
    body = map_directions(256)
    texture = 0.5 + 0.3 * body[..., 0] - 0.2 * body[..., 1] * body[..., 2]
    assert_close(sample_spline(texture, directions), sample_texture(texture, directions), 2e-4)


def test_date_line_and_poles_are_no_edges(rng):
    texture = torch.rand(8, 16, generator=rng, dtype=torch.float64)
    for latitude in (-80, -20, 0, 50, 85):
        lat, lon = math.radians(latitude), math.pi
        sides = f64([[math.cos(lat) * math.cos(lon), s * 1e-9, math.sin(lat)] for s in (1, -1)])
        first, second = sample_spline(texture, sides)
        assert_close(first, second, 1e-7)
    over = f64([[1e-9, 1e-9, 1.0], [-1e-9, -1e-9, 1.0]])  # along one meridian over the pole
    assert_close(*sample_spline(texture, over), 1e-7)
    with pytest.raises(ShapeError, match="texture"):
        sample_spline(texture[:, :8], over)


# --- texels that are no paint


def pattern(height: int = 16) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 255, (height, 2 * height)).astype(np.uint8)


def test_counts_of_zero_beside_a_map_and_transparent_texels_are_no_paint(tmp_path):
    path = saved(tmp_path, pattern())
    assert load_unseen(path) is None
    counts = np.full((16, 32), 7, np.uint8)
    counts[:4] = 0
    saved(tmp_path, counts, "texture_seen.png")
    expected = torch.arange(16)[:, None].expand(-1, 32) < 4
    assert torch.equal(load_unseen(path), expected)
    assert unseen_share(expected) == pytest.approx(0.5 * (1 - math.cos(math.pi / 4)), abs=2e-3)
    colour = np.dstack([pattern()] * 3 + [np.where(expected, 0, 255).astype(np.uint8)])
    assert torch.equal(load_unseen(saved(tmp_path, colour, "clear.png")), expected)


def test_counts_of_another_size_and_a_map_without_paint_are_refused(tmp_path):
    path = saved(tmp_path, pattern())
    saved(tmp_path, np.full((8, 16), 7, np.uint8), "texture_seen.png")
    with pytest.raises(TextureError, match=r"texture_seen\.png: .*got 16 x 8"):
        load_unseen(path)
    saved(tmp_path, np.zeros((16, 32), np.uint8), "texture_seen.png")
    with pytest.raises(TextureError, match="some picture shows"):
        load_unseen(path)


def test_texel_areas_are_those_of_their_zones():
    area = texel_areas(3) / (4 * math.pi)  # 60 degrees a row
    assert float(area.sum()) == pytest.approx(1.0)
    assert_close(area[:, 0] * 6, torch.tensor([0.25, 0.5, 0.25], dtype=torch.float64))


@pytest.mark.parametrize("mode", ["indexed", "grey"])
def test_a_transparent_index_or_grey_level_is_no_paint(tmp_path, mode):
    grey, path = pattern().clip(1), tmp_path / "clear.png"
    grey[:4] = 0
    picture = Image.fromarray(grey)
    if mode == "indexed":
        picture.putpalette([level for level in range(256) for _ in range(3)])
    picture.save(path, transparency=0)
    assert torch.equal(load_unseen(path), torch.arange(16)[:, None].expand(-1, 32) < 4)


def test_a_map_is_read_with_its_unseen_texels_as_nan(tmp_path):
    path = saved(tmp_path, pattern())
    assert torch.equal(load_known(path), load_texture(path))
    counts = np.full((16, 32), 7, np.uint8)
    counts[:4] = 0
    saved(tmp_path, counts, "texture_seen.png")
    known = load_known(path)
    assert bool(known[:4].isnan().all())
    assert torch.equal(known[4:], load_texture(path)[4:])
