"""Wear planted in a series of maps is found, grows as planted, and keeps its position from map to map."""

import json
import math
from functools import cache

import cv2
import pytest
import torch
from conftest import assert_close
from map_examples import save_map, warped
from overlay_examples import command as run
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.report.texture_map import write_seen
from sphereorient.sphere.compare import turned_map
from sphereorient.sphere.texture import map_directions, random_texture, texel_areas
from sphereorient.tools.wear import WearSeries, connected_places, wear_series

HEIGHT = 128
NOISE = 0.02
FIRST_SPOT, LATER_SPOT = (20.0, 15.0), (-120.0, -25.0)  # longitude and latitude, degrees
RADII_DEG = ((0.0, 0.0), (8.0, 0.0), (12.0, 9.0), (16.0, 9.0))  # of both spots, map by map
FRAMES = ((0.0, 0.0, 0.0), (0.3, -0.2, 0.5), (-1.0, 0.4, 2.0), (2.0, 1.0, -0.3))  # rotation vectors of body frames


def centre(spot: tuple[float, float]) -> Tensor:
    longitude, latitude = (math.radians(angle) for angle in spot)
    level = math.cos(latitude)
    return torch.tensor(
        [level * math.cos(longitude), level * math.sin(longitude), math.sin(latitude)], dtype=torch.float64
    )


@cache
def paint() -> Tensor:
    """A painted ball with a large black patch at either spot, so that what wears there shows."""
    texture = random_texture("dots", 3, HEIGHT)
    for spot in (FIRST_SPOT, LATER_SPOT):
        texture = torch.where(near(spot, 20.0), 0.0, texture)
    return texture


def near(spot: tuple[float, float], radius_deg: float) -> Tensor:
    return map_directions(HEIGHT) @ centre(spot) > math.cos(math.radians(radius_deg))


def planted(k: int) -> Tensor:
    """Worn cells of the k-th map."""
    first, later = RADII_DEG[k]
    return (near(FIRST_SPOT, first) & (first > 0)) | (near(LATER_SPOT, later) & (later > 0))


@cache
def learnt(k: int, noise: float = NOISE) -> Tensor:
    """The k-th movie's map: worn to grey, a little displaced, noisy, at its own brightness, in its own body frame."""
    worn = torch.where(planted(k), 0.7, paint())
    worn = warped(worn, 0.2) if k else worn
    rng = torch.Generator().manual_seed(k)
    worn = (0.9 - 0.1 * k) * worn + 0.05 + noise * torch.randn(worn.shape, generator=rng)
    return turned_map(worn, so3.exp(torch.tensor(FRAMES[k], dtype=torch.float64)).mT)


@cache
def found() -> WearSeries:
    return wear_series([learnt(k) for k in range(4)])


@pytest.mark.slow
def test_worn_places_are_found_where_they_were_planted_in_the_first_maps_frame():
    for k, wear in enumerate(found().wear, start=1):
        first, later = RADII_DEG[k]
        # Within a degree of the rim it could be displaced paint; the maps may be displaced by half a degree.
        inside = near(FIRST_SPOT, first - 2.5) | (near(LATER_SPOT, later - 2.5) & (later > 0))
        outside = ~near(FIRST_SPOT, first + 2.5) & ~(near(LATER_SPOT, later + 2.5) & (later > 0))
        assert wear.worn[inside].double().mean() > 0.99
        assert not wear.worn[outside].any()
        assert float(wear.change[inside].median()) > 0.3, "black paint that is gone is brighter"


@pytest.mark.slow
def test_the_worn_share_grows_as_it_was_planted():
    area = texel_areas(HEIGHT) / (4 * math.pi)
    true = [float(area[planted(k)].sum()) for k in range(4)]
    growth = found().growth
    for k, one in enumerate(growth, start=1):
        assert one.known == pytest.approx(1.0, abs=1e-6)
        assert one.worn == pytest.approx(
            true[k], rel=0.12
        )  # half a degree about a rim of 8: displaced, blurred by the turn
        assert one.grown == pytest.approx(one.worn - (growth[k - 2].worn if k > 1 else 0.0), abs=1e-9)
    assert math.isnan(growth[0].stays)
    assert min(growth[1].stays, growth[2].stays) > 0.95, "a place that is worn stays worn"


@pytest.mark.slow
def test_places_keep_their_number_from_map_to_map():
    first, later = found().places
    for place, spot in ((first, FIRST_SPOT), (later, LATER_SPOT)):
        assert (place.longitude_deg, place.latitude_deg) == pytest.approx(spot, abs=1.5)
    assert first.share[0] < first.share[1] < first.share[2]
    assert later.share[0] == 0.0, "not worn yet"
    assert later.share[1] == pytest.approx(later.share[2], rel=0.15), "not worn on"
    assert int(found().number.max()) == 2
    assert (found().number[near(LATER_SPOT, 5.0)] == 2).all()


@pytest.mark.slow
def test_maps_of_an_unworn_ball_show_no_wear_however_noisy():
    for noise in (0.0, 0.06):
        rng = torch.Generator().manual_seed(9)
        maps = [paint() + noise * torch.randn(paint().shape, generator=rng) for _ in range(3)]
        series = wear_series(maps, turned=False)
        assert series.places == ()
        assert [one.worn for one in series.growth] == [0.0, 0.0]
        if noise:  # of two maps
            assert series.wear[0].scatter == pytest.approx(noise * math.sqrt(2), rel=0.15)


@pytest.mark.slow
def test_unseen_paint_is_neither_worn_nor_healed():
    blind = torch.where(near(FIRST_SPOT, 25.0), torch.nan, paint())
    worn = torch.where(planted(3), 0.7, paint())
    series = wear_series([paint(), worn, blind, worn], turned=False)
    shares = series.places[0].share
    assert math.isnan(shares[1])
    assert shares[0] == shares[2] > 0
    assert not series.wear[1].worn.any()
    growth = series.growth
    assert growth[1].known == pytest.approx(1 - 0.5 * (1 - math.cos(math.radians(25))), abs=0.005)
    assert growth[2].stays != growth[2].stays, "no cell was worn in the map before, where it shows paint"


def test_places_are_one_across_the_maps_edge_and_over_its_poles():
    assert_close(connected_places(torch.zeros(4, 8, dtype=torch.bool)), torch.zeros(4, 8, dtype=torch.int64))
    edge = torch.zeros(4, 8, dtype=torch.bool)
    edge[1, [0, 7]] = True
    edge[2, 4] = True
    number = connected_places(edge)
    assert number[1, 0] == number[1, 7] != number[2, 4]
    pole = torch.zeros(4, 8, dtype=torch.bool)
    pole[0, [1, 5]] = True
    pole[3, [0, 3]] = True
    number = connected_places(pole)
    assert number[0, 1] == number[0, 5] != number[3, 0] == number[3, 3]
    assert int(number.max()) == 2


@pytest.mark.slow
def test_the_command_prints_and_draws_a_series(tmp_path, monkeypatch, capsys):
    paths = [save_map(learnt(k), tmp_path / f"movie{k}.png") for k in range(3)]
    write_seen((~near(FIRST_SPOT, 0.0)).long() * 20, tmp_path / "movie0.png")
    code, output, err = run(monkeypatch, capsys, "compare-maps", "--series", *paths, "--out", tmp_path / "wear.png")
    assert code == 0, err
    assert "place 1 at longitude 20°, latitude 15°" in output
    assert "place 2 at longitude -120°, latitude -25°" in output
    assert cv2.imread(str(tmp_path / "wear.png")).shape[1] > 500
    code, output, err = run(monkeypatch, capsys, "compare-maps", "--series", *paths[:2], "--json")
    assert code == 0, err
    printed = json.loads(output)
    assert [row["map"] for row in printed["maps"]] == [str(paths[1])]
    assert printed["maps"][0]["stays_share"] is None
    assert [row["worn_share"] for row in printed["maps"]] == pytest.approx(
        [one.worn for one in found().growth[:1]], rel=0.05
    )
    assert all(row["moved_rms_deg"] < 0.4 for row in printed["maps"])
    assert len(printed["places"]) == 1


def test_maps_that_make_no_pair_and_no_series_are_refused_in_one_line(tmp_path, monkeypatch, capsys):
    paths = [save_map(paint(), tmp_path / f"{k}.png") for k in range(3)]
    for arguments, expected in ((paths, "--series"), (paths[:1], "two"), (["--series", paths[0]], "two or more")):
        code, _, err = run(monkeypatch, capsys, "compare-maps", *arguments)
        assert code == 2
        assert len(err.strip().splitlines()) == 1
        assert expected in err
    with pytest.raises(PaintError, match="two or more"):
        wear_series([paint()])
