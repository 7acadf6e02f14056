import cv2
import kornia
import numpy as np
import pytest
import torch
from conftest import assert_close
from hypothesis import given
from hypothesis import strategies as st
from orient_examples import attitudes, clean_disks

from sphereorient.errors import ShapeError
from sphereorient.search import OrientSettings, extract_paint
from sphereorient.search.template_bank import otsu, stretch_contrast
from sphereorient.sphere import orthographic_view
from sphereorient.sphere.view import disk_offsets

SIZE = 60
VIEW = orthographic_view(SIZE)


def two_classes(rng: torch.Generator, share: float, dark: float, bright: float, sigma: float) -> np.ndarray:
    """8-bit grey values of two classes with noise."""
    white = torch.rand(60, 60, generator=rng) < share
    grey = torch.where(white, bright, dark) + sigma * torch.randn(60, 60, generator=rng)
    return grey.round().clamp(0, 255).numpy().astype(np.uint8)


# --- Otsu


@pytest.mark.parametrize("case", [(0.5, 60, 180, 25), (0.2, 80, 150, 20), (0.7, 90, 140, 30)], ids=str)
def test_otsu_agrees_with_opencv_and_kornia(rng, case):
    grey = two_classes(rng, *case)
    threshold, contrast = otsu(torch.from_numpy(np.bincount(grey.ravel(), minlength=256)).double())
    opencv, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    # Ours is the upper edge of the lower class's last bin, OpenCV's that bin; 1e-4 of the variance is a level or so.
    assert abs(float(threshold) * 256 - 1 - opencv) <= 1.5
    _, of_kornia = kornia.filters.otsu_threshold(torch.from_numpy(grey).float()[None, None] / 256, nbins=256)
    assert float(threshold) == pytest.approx(float(of_kornia), abs=2 / 256)
    lower, upper = grey[grey <= opencv].mean(), grey[grey > opencv].mean()
    assert float(contrast) * 256 == pytest.approx(upper - lower, rel=0.02)


def test_classes_with_a_gap_are_parted_as_opencv_parts_them(rng):
    grey = two_classes(rng, 0.05, 50, 200, 12)
    threshold, _ = otsu(torch.from_numpy(np.bincount(grey.ravel(), minlength=256)).double())
    _, white = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    assert np.array_equal(grey >= float(threshold) * 256, white > 0)
    assert 0.35 < float(threshold) < 0.65  # in the middle of the gap, not at its lower end as OpenCV's


@given(counts=st.lists(st.integers(0, 50), min_size=4, max_size=20).filter(lambda c: np.count_nonzero(c) >= 2))
def test_no_other_threshold_separates_the_classes_better(counts):
    histogram = torch.tensor(counts, dtype=torch.float64)
    weight = histogram / histogram.sum()
    at = (torch.arange(len(counts), dtype=torch.float64) + 0.5) / len(counts)

    def between(edge: int) -> float:
        below, above = weight[:edge], weight[edge:]
        if below.sum() == 0 or above.sum() == 0:
            return 0.0
        gap = (above * at[edge:]).sum() / above.sum() - (below * at[:edge]).sum() / below.sum()
        return float(below.sum() * above.sum() * gap**2)

    best = max(between(edge) for edge in range(1, len(counts)))
    variances = {edge: between(edge) for edge in range(1, len(counts))}
    ties = [edge / len(counts) for edge, value in variances.items() if value >= best * (1 - 1e-4) * (1 - 1e-12)]
    threshold, _ = otsu(histogram)
    assert float(threshold) == pytest.approx(sum(ties) / len(ties), abs=1e-9)


def test_between_two_lines_the_threshold_is_in_the_middle_of_the_gap():
    histogram = torch.zeros(2, 10, dtype=torch.float64)
    histogram[0, [1, 7]] = 5.0  # bins end at 0.2 and begin at 0.7
    histogram[1, 4] = 3.0  # one class only
    threshold, contrast = otsu(histogram)
    assert_close(threshold[0], torch.tensor(0.45, dtype=torch.float64))
    assert_close(contrast, torch.tensor([0.6, 0.0], dtype=torch.float64))


def test_a_histograms_scale_and_company_do_not_matter(rng, dtype, tolerance, batch):
    histogram = torch.rand(*batch, 32, generator=rng, dtype=torch.float64).to(dtype)
    threshold, contrast = otsu(7 * histogram)
    assert threshold.shape == contrast.shape == batch
    for k, single in enumerate(histogram.reshape(-1, 32)):
        assert_close(otsu(single)[0], threshold.reshape(-1)[k], atol=10 * tolerance)
        assert_close(otsu(single)[1], contrast.reshape(-1)[k], atol=10 * tolerance)


# --- stretching


@given(black=st.floats(0.05, 0.45), white=st.floats(0.05, 0.45), seed=st.integers(0, 1000))
def test_at_least_the_shares_become_black_and_white_and_the_order_stays(black, white, seed):
    disk = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(seed)) * 200
    values = stretch_contrast(disk, VIEW.inside, black, white)[VIEW.inside]
    count = len(values)
    assert black <= float((values == 0).sum()) / count + 1 / count
    assert white <= float((values == 1).sum()) / count + 1 / count
    assert (values == 0).sum() < black * count + 2  # and not more, where no two are alike
    assert (values == 1).sum() < white * count + 2
    assert (values[disk[VIEW.inside].argsort()].diff() >= 0).all()


def test_outside_the_disk_and_in_a_disk_of_one_grey_all_is_one_half():
    disks = torch.stack([torch.full((SIZE, SIZE), 37.0), torch.rand(SIZE, SIZE)])
    grey = stretch_contrast(disks, VIEW.inside, 0.3, 0.3)
    assert (grey[0] == 0.5).all()
    assert (grey[1][~VIEW.inside] == 0.5).all()


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_saturated_paint_with_less_of_the_other_than_is_forced_is_not_taken_for_one_grey(share):
    white = disk_offsets(SIZE)[..., 0] > 1 - 2 * share
    disk = torch.where(white, 255.0, 30.0)
    assert torch.equal(stretch_contrast(disk, VIEW.inside, 0.3, 0.3)[VIEW.inside], white[VIEW.inside].float())


def test_brightness_and_contrast_of_the_light_do_not_matter(rng):
    disk = torch.rand(SIZE, SIZE, generator=rng, dtype=torch.float64)
    plain = stretch_contrast(disk, VIEW.inside, 0.3, 0.2)
    assert_close(stretch_contrast(40 + 90 * disk, VIEW.inside, 0.3, 0.2), plain, atol=1e-12)


# --- extraction


def test_a_clean_disk_is_extracted_pixel_by_pixel():
    disks = clean_disks("patches", attitudes(5), SIZE)
    paint = extract_paint(disks, VIEW.inside, OrientSettings())
    truth = torch.where(disks > 95, 1.0, -1.0)
    sure = VIEW.inside & ((disks - 95).abs() > 70)
    assert set(paint.unique().tolist()) <= {-1.0, 0.0, 1.0}
    assert (paint[:, ~VIEW.inside] == 0).all()
    assert torch.equal(paint[sure.expand_as(paint)], truth[sure.expand_as(paint)])


def test_under_light_from_one_side_it_finds_the_paint_where_one_threshold_does_not():
    disks = clean_disks("blobs", attitudes(20), SIZE)
    truth, inside = torch.where(disks > 95, 1.0, -1.0), VIEW.inside.expand_as(disks)
    lit = disks * (1 + 0.7 * disk_offsets(SIZE)[..., 0].float())  # 0.3 at the left, 1.7 at the right
    paint = extract_paint(lit, VIEW.inside, OrientSettings())
    decided = inside & (paint != 0)
    assert decided.sum() > 0.93 * inside.sum()
    wrong = float((paint != truth)[decided].double().mean())

    grey = lit[:, VIEW.inside].round().to(torch.uint8).numpy()
    globally = [cv2.threshold(disk, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1].ravel() > 0 for disk in grey]
    wrong_globally = float(np.mean(np.stack(globally) != (truth[:, VIEW.inside] > 0).numpy()))
    assert wrong < 0.015
    assert wrong_globally > 0.03
    assert wrong < wrong_globally / 3


def test_undecided_pixels_are_those_where_one_threshold_alone_is_wrong():
    disks = clean_disks("blobs", attitudes(20), SIZE)
    truth, inside = torch.where(disks > 95, 1.0, -1.0), VIEW.inside.expand_as(disks)
    lit = disks * (1 + 0.8 * disk_offsets(SIZE)[..., 0].float())
    paint = extract_paint(lit, VIEW.inside, OrientSettings())
    undecided = inside & (paint == 0)
    assert 0.01 < undecided.sum() / inside.sum() < 0.1
    alone = extract_paint(lit, VIEW.inside, OrientSettings(region_contrast_min=1.0))  # no region votes
    assert (alone[inside] != 0).all()
    assert torch.equal(alone[inside & ~undecided], paint[inside & ~undecided])
    assert (alone != truth)[undecided].double().mean() > 5 * (alone != truth)[inside & ~undecided].double().mean()


def test_a_disk_is_extracted_alike_with_any_other_disks():
    disks = clean_disks("dots", attitudes(4), SIZE)
    together = extract_paint(disks, VIEW.inside, OrientSettings())
    for disk, expected in zip(disks, together, strict=True):
        assert torch.equal(extract_paint(disk[None], VIEW.inside, OrientSettings())[0], expected)
    assert extract_paint(disks[:0], VIEW.inside, OrientSettings()).shape == (0, SIZE, SIZE)


def test_the_disks_stay_as_they_are():
    disks = clean_disks("dots", attitudes(1), SIZE)
    before = disks.clone()
    extract_paint(disks, VIEW.inside, OrientSettings())
    assert torch.equal(disks, before)


def test_disks_of_another_size_than_the_mask_are_refused():
    with pytest.raises(ShapeError, match=r"got \(1, 50, 50\)"):
        extract_paint(torch.zeros(1, 50, 50), VIEW.inside, OrientSettings())
