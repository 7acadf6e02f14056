"""Soft pictures: their blur is measured first, and templates of the same blur find the attitude."""

import cv2
import numpy as np
import pytest
import torch
from grey_examples import camera_disks, grey_search_of
from orient_examples import attitudes, texture_of
from refine_examples import BLUR_PX, balls, base_of, cut, fitter_of, noisy, pictures_of, rig_of

from sphereorient import so3
from sphereorient.follow.appearance.light import FINER, FINEST, best_blur_px, steepest_blur_px
from sphereorient.pose.camera_view import defocus_radii
from sphereorient.pose.poses import PoseStart
from sphereorient.search import GreySearch, GreySearchSettings

WIDE = 0.2  # radii


def step(blur_px: float, noise: float) -> np.ndarray:
    """A black half and a white one under a Gaussian blur, 8 bits."""
    picture = np.full((80, 80), 20.0, np.float32)
    picture[:, 40:] = 170.0
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    noisy = picture + noise * np.random.default_rng(0).standard_normal(picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("blur_px", [1.5, 3.0, 6.0])
def test_the_blur_of_an_edge_is_read_off_its_slope(blur_px, noise):
    assert steepest_blur_px(step(blur_px, noise)) == pytest.approx(blur_px, rel=0.2, abs=0.3)


def test_a_picture_of_one_grey_is_not_divided_by_zero():
    assert np.isfinite(steepest_blur_px(np.full((40, 40), 7.0, np.float32)))


def test_the_blur_of_the_pictures_is_found_to_a_percent():
    rig, (X, R) = rig_of(), balls(4, 3)
    pixels, use = cut(rig, noisy(pictures_of(rig, "patches", X, R), 2.0, 5), X), torch.ones(4, 2, dtype=torch.bool)
    fitter = fitter_of(rig, 1.6 * BLUR_PX)
    for ratio in (FINER, FINEST):
        fit = fitter.fit(pixels, PoseStart(X, R, use), fitter.optics.fine, 3)
        found = best_blur_px(fitter, base_of("patches"), pixels, fit, use, ratio)
        fitter = fitter_of(rig, found)
    assert found == pytest.approx(BLUR_PX, rel=0.015)


def test_only_pictures_that_are_blurred_by_much_are_soft():
    assert defocus_radii(0.6, 78.0) == 0.0
    assert defocus_radii(0.9, 20.0) == 0.0, "a pixel's own width on a small ball"
    assert defocus_radii(6.0, 78.0) == pytest.approx(6.0 / 39.0)


def blurred_disks(R: torch.Tensor) -> torch.Tensor:
    """Disks under a Gaussian of WIDE radii, the scene's dark blurred into them as through a lens."""
    disks = camera_disks("patches", R, noise=0.0, off_px=0.0).numpy()
    side = disks.shape[1]
    framed = [cv2.copyMakeBorder(disk, side, side, side, side, cv2.BORDER_CONSTANT, value=15.0) for disk in disks]
    soft = [cv2.GaussianBlur(one, (0, 0), WIDE * side / 2)[side : 2 * side, side : 2 * side] for one in framed]
    return torch.from_numpy(np.stack(soft))


def share_found(search: GreySearch, disks: torch.Tensor, R: torch.Tensor) -> float:
    """Share of the disks whose first proposal is the planted attitude."""
    found = search.propose(disks)
    some = found.offset.diff() > 0
    away = so3.geodesic_distance(found.R_view_body[found.offset[:-1][some]], R[some])
    return float((away < np.deg2rad(15)).sum()) / len(R)


@pytest.mark.slow
def test_templates_as_soft_as_the_pictures_find_what_sharp_ones_miss():
    R = attitudes(24)
    disks = blurred_disks(R)
    soft = GreySearch(texture_of("patches"), GreySearchSettings(), blur=WIDE)
    share = share_found(soft, disks, R)
    assert share > 0.85
    assert share > share_found(grey_search_of("patches"), disks, R) + 0.15
