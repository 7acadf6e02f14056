import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import assert_close, slow
from preflight_examples import PAINTED, Example, checked, clean_example, of  # noqa: F401

from sphereorient import so3
from sphereorient.errors import TextureError
from sphereorient.preflight import Severity
from sphereorient.preflight.texture_map import (
    ViewPair,
    judge_contrast,
    look_alikes,
    measure_texture,
    most_similar_views,
    views_towards,
)
from sphereorient.search.settings import GreySearchSettings
from sphereorient.sphere.texture import fibonacci_directions, map_directions, random_texture

FAULT, WARNING, OK = Severity.FAULT, Severity.WARNING, Severity.OK
RADIUS_PX = 39.0


@pytest.fixture(scope="module")
def good() -> torch.Tensor:
    return random_texture("blobs", 0, 256)


@pytest.fixture(scope="module")
def pair(good: torch.Tensor) -> ViewPair:
    return most_similar_views(good, GreySearchSettings())


def test_a_ball_white_in_the_north_is_bright_from_there_by_the_share_that_is_seen():
    """From latitude b the cosine-weighted share of the northern hemisphere in view is (1 + sin b) / 2."""
    north = (map_directions(128)[..., 2] > 0).float()
    seen = measure_texture(north).view_brightness
    latitude = math.pi / 2 - math.pi * (torch.arange(len(seen)) + 0.5) / len(seen)
    expected = (1 + latitude.sin().double()) / 2
    assert_close(seen, expected[:, None].expand_as(seen), atol=0.01)


@pytest.mark.parametrize("count", [4, 8, 12])
def test_patches_are_as_wide_as_the_stripes_painted(count):
    """Meridian stripes: at the equator 180 / count degrees, narrower towards the poles, endless along them."""
    directions = map_directions(256)
    longitude = torch.atan2(directions[..., 1], directions[..., 0])
    stripes = (torch.sin(count * longitude) > 0).float()
    assert math.degrees(measure_texture(stripes).patch_rad) == pytest.approx(180 / count, rel=0.35)


@pytest.mark.parametrize("kind", ["blobs", "patches", "dots"])
def test_the_random_paints_are_good(kind):
    assert judge_contrast(measure_texture(random_texture(kind, 1, 256)), RADIUS_PX).severity is OK


@pytest.mark.parametrize(
    ("spoil", "radius_px", "words"),
    [
        (lambda map_: 0.5 + 0.01 * map_, RADIUS_PX, "one colour"),
        (lambda map_: 0.4 + 0.2 * map_, RADIUS_PX, "contrast"),
        (lambda map_: torch.where(torch.arange(256)[:, None] < 128, 0.0, map_), RADIUS_PX, "balance"),
        (lambda map_: map_, 6.0, "larger"),
        (lambda map_: (map_directions(256)[..., 2] > 0).float(), RADIUS_PX, "smaller patches"),
    ],
)
def test_faults_of_a_paint_are_named(good, spoil, radius_px, words):
    found = judge_contrast(measure_texture(spoil(good)), radius_px)
    assert found.severity is (FAULT if words == "one colour" else WARNING)
    assert words in found.advice


def test_views_of_a_random_paint_can_be_distinguished(pair):
    assert look_alikes(pair).severity is OK
    assert pair.score > 0.3  # something is always a little alike


def test_the_angle_is_that_between_the_two_views(pair):
    first, second = pair.R_view_body.double()
    assert pair.angle_rad == pytest.approx(float(so3.geodesic_distance(first, second)))
    assert pair.angle_rad > math.radians(20)


@pytest.mark.slow
@pytest.mark.parametrize("times", [2, slow(3), slow(5)])
def test_a_paint_that_repeats_itself_around_its_axis_is_a_fault(good, times):
    """Twice around is alike after half a turn, three times after a third; and so on."""
    found = most_similar_views(_repeated(good, times), GreySearchSettings())
    assert look_alikes(found).severity is FAULT
    turns = [360 * k / times for k in range(1, times)]
    assert min(abs(math.degrees(found.angle_rad) - min(turn, 360 - turn)) for turn in turns) < 3


def _repeated(map_: torch.Tensor, times: int) -> torch.Tensor:
    """A map (H, 2 H) with its first part some times around."""
    width = map_.shape[1]
    source = (torch.arange(width) * times % width) // times
    return map_[:, source]


@pytest.mark.slow
def test_a_paint_in_bands_looks_alike_however_it_spins():
    bands = (torch.sin(5 * map_directions(256)[..., 2]) > 0).float()
    assert look_alikes(most_similar_views(bands, GreySearchSettings())).severity is FAULT


def test_a_view_towards_a_direction_has_it_in_the_middle_facing_the_viewer():
    directions = fibonacci_directions(50)
    R_view_body = views_towards(directions)
    assert_close((R_view_body @ directions[..., None])[..., 0], torch.tensor([0.0, 0, -1]).double().expand(50, 3))
    assert_close(torch.linalg.det(R_view_body), torch.ones(50).double())
    assert_close(R_view_body @ R_view_body.mT, torch.eye(3).double().expand(50, 3, 3))


def test_a_map_of_one_colour_is_refused(clean, tmp_path):
    with pytest.raises(TextureError, match="one single grey"):
        checked(replace(clean, texture=np.full_like(clean.texture, 200)), tmp_path, sphere=PAINTED)


@pytest.mark.slow
def test_a_map_of_nearly_one_colour_has_no_other_finding(clean, tmp_path):
    faint = replace(clean, texture=(128 + clean.texture // 128).astype(np.uint8))
    result = checked(faint, tmp_path, sphere=PAINTED)
    assert of(result, "paint").severity is FAULT
    assert not [one for one in result.findings if one.title.startswith("map in")]


@pytest.mark.slow
def test_a_map_in_a_mirror_does_not_fit(clean, tmp_path):
    other = replace(clean, texture=np.ascontiguousarray(clean.texture[:, ::-1]))
    found = of(checked(other, tmp_path, sphere=PAINTED), "map in cam1")
    assert found.severity is FAULT
    assert "mirror the map" in found.advice


@pytest.mark.slow
def test_a_map_that_is_still_to_be_learnt_is_a_warning_and_the_only_one(clean, tmp_path):
    result = checked(clean, tmp_path)
    assert [one.title for one in result.findings if one.severity is not OK] == ["paint"]
    assert of(result, "paint").severity is WARNING
