"""Paint that differs from the map is found, and has no weight."""

import math
from dataclasses import replace

import pytest
import torch
from refine_examples import BLUR_PX, balls, cut, fitted, model_of, noisy, paint_of, pictures_of, rig_of, turn_errors

from sphereorient import so3
from sphereorient.pose.model import FIRST, LATER, UNSEEN
from sphereorient.pose.worn import CELLS, without, worn_cells, worn_of_text, worn_share, worn_text
from sphereorient.sphere.texture import map_directions
from sphereorient.sphere.texture_table import octahedral_directions, texture_table

DIAMETER_PX, SIGMA, COUNT = 48.0, 3.0, 16
RIG = rig_of(DIAMETER_PX)
X, R = balls(COUNT, 2)
PAINT = paint_of("patches")
NORTH = 0.75  # the cap above this z has lost its paint: an eighth of the sphere
USE = torch.ones(COUNT, 2, dtype=torch.bool)
CELL_Z = octahedral_directions(CELLS)[:, 2]


def table(paint=PAINT, unseen=None):
    return texture_table(paint, 2 * BLUR_PX / DIAMETER_PX, unseen=unseen)


@pytest.fixture(scope="module")
def pixels():
    return cut(RIG, noisy(pictures_of(RIG, "patches", X, R), SIGMA, 3), X)


def found(pixels, paint, use=USE):
    """Fit with a map, learn the light, and return where the paint differs."""
    model = model_of(table(paint), SIGMA, FIRST)
    fit = fitted(RIG, "patches", pixels, X, R, SIGMA, paint=model.paint, shading=FIRST)
    model = replace(model, light=model.light.learnt(pixels, fit, use, model), shading=LATER)
    return worn_cells(pixels, fit, use, model), fit, model


# The pictures show the whole map; the given map has a grey cap, as if the paint were worn.
CAPPED = torch.where(map_directions(len(PAINT))[..., 2] > NORTH, 0.5, PAINT.double()).float()


def test_a_worn_cap_is_found_and_nothing_else(pixels):
    worn, _, _ = found(pixels, CAPPED)
    assert worn.shape == (CELLS**2,)
    inner, outer = CELL_Z > NORTH + 0.03, CELL_Z < NORTH - 0.05
    assert float(worn[inner].float().mean()) > 0.85  # the rest are cells on borders, grey as the cap
    assert float(worn[outer].float().mean()) < 0.01


def test_paint_as_the_map_has_it_is_not_worn(pixels):
    worn, _, _ = found(pixels, PAINT)
    assert not worn.any()


def test_poses_without_worn_paint_are_as_good_as_before(pixels):
    worn, bent, model = found(pixels, CAPPED)
    fit = fitted(RIG, "patches", pixels, X, R, SIGMA, paint=without(model.paint, worn))
    right = fitted(RIG, "patches", pixels, X, R, SIGMA, paint=table())
    rms = [math.degrees(float(turn_errors(one, R).square().sum(-1).mean().sqrt())) for one in (bent, fit, right)]
    assert rms[1] < 1.5 * rms[2]
    assert rms[0] > 2.0 * rms[1]


def test_pictures_not_in_use_change_nothing(pixels):
    use = USE.clone()
    use[9:, 1] = False
    _, fit, model = found(pixels, CAPPED, use)
    spoilt = pixels.grey.clone()
    spoilt[19::2] = 250.0
    one, other = (worn_cells(part, fit, use, model) for part in (pixels, replace(pixels, grey=spoilt)))
    assert one.equal(other)


def test_a_rotation_of_body_and_poses_rotates_the_worn_cells(pixels):
    """The cells are of the body: the same pictures with another body frame show the same cap elsewhere."""
    worn, fit, model = found(pixels, CAPPED)
    half = so3.exp(torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64))  # about the body's z
    rolled = torch.roll(CAPPED, len(CAPPED), dims=1)
    turned = replace(fit, R_lab_body=fit.R_lab_body @ half.mT)
    again = worn_cells(pixels, turned, USE, replace(model, paint=table(rolled)))
    there = octahedral_directions(CELLS) @ half.mT
    place = (there[:, None] - octahedral_directions(CELLS)[None]).norm(dim=-1).argmin(1)
    assert float((again[place] == worn).float().mean()) > 0.99


@pytest.mark.parametrize("known", [True, False])
def test_worn_paint_becomes_unknown_and_unknown_paint_stays_unknown(known):
    worn = CELL_Z > NORTH
    unseen = None if known else map_directions(len(PAINT))[..., 2] < -0.6
    paint = table(unseen=unseen)
    at = octahedral_directions(96).float()
    share = without(paint, worn).unseen.sample(at.T[None])[0][0]
    assert (share[at[:, 2] > NORTH + 0.06] > 0.98).all()
    assert (share[at[:, 2].abs() < 0.5] < UNSEEN).all()
    south = share[at[:, 2] < -0.7]
    assert (south < UNSEEN).all() if known else (south > 0.98).all()
    assert without(paint, worn).rows.equal(paint.rows)


def test_worn_cells_survive_as_text_and_their_share_is_one_of_area():
    worn = CELL_Z > NORTH
    assert torch.equal(worn_of_text(worn_text(worn)), worn)
    assert worn_share(worn) == pytest.approx((1 - NORTH) / 2, abs=0.01)
