import math

import pytest
import torch
from conftest import assert_close
from grey_examples import KINDS, SIZE, camera_disks, grey_search_of, light_from
from orient_examples import attitudes, best_errors_deg, of_disk, texture_of

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.search import Candidates, GreySearch, GreySearchSettings
from sphereorient.search.grey_search import BATCH, DEVIATIONS, to_int8
from sphereorient.sphere import perspective_view, reduced_texture
from sphereorient.sphere.view import disk_offsets
from sphereorient.trajectory import Reason


def best(found: Candidates) -> torch.Tensor:
    assert (found.offset.diff() > 0).all()
    return found.R_view_body[found.offset[:-1]]


def apart_deg(A: torch.Tensor, B: torch.Tensor) -> torch.Tensor:
    return so3.geodesic_distance(A, B).rad2deg()


def spot(x: float, y: float, radius: float) -> torch.Tensor:
    distance2 = (disk_offsets(SIZE, torch.float32) - torch.tensor([x, y])).square().sum(-1)
    return torch.exp(-distance2 / (2 * radius**2))


# --- it finds what was planted


@pytest.mark.parametrize("kind", KINDS)
def test_the_best_proposal_is_the_planted_attitude(kind):
    R_view_body = attitudes(40)
    found = grey_search_of(kind).propose(camera_disks(kind, R_view_body))
    error = best_errors_deg(found, R_view_body)
    # Half a pixel of 80 is 0.7 degrees at the disk's middle, the radius' error more away from it.
    assert error.max() < 2.0
    assert error.square().mean().sqrt() < 1.1
    # The transpose is no answer.
    assert apart_deg(best(found).mT, R_view_body).median() > 20


@pytest.mark.parametrize("kind", KINDS)
def test_a_lamp_from_the_side_that_leaves_the_other_nearly_dark_does_not_matter(kind):
    R_view_body = attitudes(25)
    disks = camera_disks(kind, R_view_body, light_from(-0.8, -0.3, -0.52))
    error = best_errors_deg(grey_search_of(kind).propose(disks), R_view_body)
    assert error.max() < 3.0
    # The light is dim indeed: a quarter of the disk shows less than an eighth of the step from black to white.
    assert (disks[..., disk_offsets(SIZE).norm(dim=-1) < 0.9].quantile(0.25, dim=-1) < 40).all()


def test_without_noise_and_with_the_true_outline_it_is_right_to_a_third_of_a_degree():
    R_view_body = attitudes(12)
    disks = camera_disks("blobs", R_view_body, noise=0.0, off_px=0.0)
    assert best_errors_deg(grey_search_of("blobs").propose(disks), R_view_body).max() < 0.3


def test_one_pixel_of_80_off_is_found():
    R_view_body = attitudes(25, seed=4)
    error = best_errors_deg(
        grey_search_of("patches").propose(camera_disks("patches", R_view_body, off_px=1.0)), R_view_body
    )
    assert error.max() < 3.0


@pytest.mark.slow
def test_a_near_camera_sees_less_of_the_ball_and_its_distance_is_given():
    R_view_body = attitudes(10)
    texture = reduced_texture(texture_of("blobs"), SIZE)
    disks = 20 + 150 * perspective_view(SIZE, 4.0).render(texture, R_view_body.float())
    near = GreySearch(texture_of("blobs"), GreySearchSettings(distance_radii=4.0)).propose(disks)
    far = grey_search_of("blobs").propose(disks)
    assert best_errors_deg(near, R_view_body).max() < 0.5
    assert (near.score[near.offset[:-1]] > far.score[far.offset[:-1]] + 0.02).all()


# --- invariance


def test_neither_brightness_nor_contrast_nor_the_cameras_units_change_anything():
    search, disks = grey_search_of("dots"), camera_disks("dots", attitudes(8))
    as_they_are = search.propose(disks)
    for changed in (disks + 300, 0.05 * disks, 257 * disks, 1e-4 * disks - 1):
        found = search.propose(changed)
        assert apart_deg(best(found), best(as_they_are)).max() < 0.02
        assert_close(found.score[found.offset[:-1]], as_they_are.score[as_they_are.offset[:-1]], atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_light_that_changes_across_the_disk_does_not_change_the_best_proposal(kind):
    search, disks = grey_search_of(kind), camera_disks(kind, attitudes(8))
    x, y = disk_offsets(SIZE, torch.float32).unbind(-1)
    as_they_are = best(search.propose(disks))
    assert apart_deg(best(search.propose(disks * (1 + 0.7 * x))), as_they_are).max() < 0.3
    assert apart_deg(best(search.propose(disks + 100 * y)), as_they_are).max() < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_a_reflection_does_not_change_the_best_proposal(kind):
    search, disks = grey_search_of(kind), camera_disks(kind, attitudes(12))
    shiny = disks + 200 * spot(-0.3, -0.35, 0.08)
    assert apart_deg(best(search.propose(shiny)), best(search.propose(disks))).max() < 1.5


def test_a_dim_picture_in_whole_grey_levels_is_found():
    R_view_body = attitudes(15)
    dim = (0.08 * camera_disks("patches", R_view_body)).round()  # 12 levels from black to white
    assert best_errors_deg(grey_search_of("patches").propose(dim), R_view_body).max() < 2.0


# --- disks without a proposal


def test_a_picture_without_any_contrast_has_a_reason_and_no_proposal():
    flat = torch.stack([torch.zeros(SIZE, SIZE), torch.full((SIZE, SIZE), 90.0), torch.full((SIZE, SIZE), torch.nan)])
    found = grey_search_of("blobs").propose(flat)
    assert found.reason == (Reason.LOW_SCORE,) * 3
    assert found.offset.tolist() == [0] * 4
    assert len(found.score) == len(found.R_view_body) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_light_alone_and_noise_alone_have_a_reason_and_no_proposal(kind):
    x, y = disk_offsets(SIZE, torch.float32).unbind(-1)
    noise = torch.randn(10, SIZE, SIZE, generator=torch.Generator().manual_seed(8))
    ball = (1 - x * x - y * y).clamp_min(0).sqrt()
    pictures = torch.cat([60 + 20 * noise, 80 + 60 * x + 2 * noise[:3], 150 * ball + 2 * noise[:3]])
    assert grey_search_of(kind).propose(pictures).reason == (Reason.LOW_SCORE,) * 16


@pytest.mark.parametrize("kind", KINDS)
def test_a_negative_and_a_mirrored_picture_explain_less(kind):
    search, disks = grey_search_of(kind), camera_disks(kind, attitudes(8))
    right = search.propose(disks)
    for wrong in (search.propose(190 - disks), search.propose(disks.flip(-1))):
        for disk in range(8):
            assert of_disk(right, disk)[1][0] > 0.9
            assert (of_disk(wrong, disk)[1] < 0.8).all()


@pytest.mark.slow
def test_no_proposal_scores_below_score_min_and_those_above_stay():
    disks = camera_disks("blobs", attitudes(10))
    some, few = (
        GreySearch(texture_of("blobs"), GreySearchSettings(score_min=least, step_deg=15)).propose(disks)
        for least in (0.0, 0.6)
    )
    assert (some.score < 0.6).any()
    assert torch.equal(few.score, some.score[some.score >= 0.6])


def test_disks_of_another_size_are_refused():
    with pytest.raises(ShapeError, match=r"got \(2, 42, 42\)"):
        grey_search_of("blobs").propose(torch.zeros(2, 42, 42))


# --- the record


def test_proposals_are_rotations_of_float64_best_first_and_distinct():
    settings = GreySearchSettings()
    found = grey_search_of("dots").propose(camera_disks("dots", attitudes(20), light_from(-0.8, -0.3, -0.52)))
    R = found.R_view_body
    assert R.dtype == found.score.dtype == torch.float64
    assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
    assert_close(torch.linalg.det(R), torch.ones(len(R), dtype=torch.float64))
    assert ((found.score >= settings.score_min) & (found.score <= 1)).all()
    assert found.reason == (Reason.OK,) * 20
    several = 0
    for disk in range(20):
        R, score = of_disk(found, disk)
        assert len(R) <= settings.finalists
        assert (score.diff() <= 0).all()
        gap = apart_deg(R[:, None], R[None]) + 360 * torch.eye(len(R))
        assert gap.min() >= settings.distinct_deg - 0.01
        several += len(R) > 1
    assert several >= 3


@pytest.mark.slow
def test_a_disks_answer_is_the_same_to_the_last_bit_alone_or_among_37():
    search, disks = grey_search_of("patches"), camera_disks("patches", attitudes(37))
    disks[5] = 70.0  # an empty disk shifts no other's rows
    assert len(disks) > BATCH
    together, reversed_order = search.propose(disks), search.propose(disks.flip(0))
    three = search.propose(disks[[34, 2, 17]])
    assert together.reason[5] is Reason.LOW_SCORE
    for found, disk, place in (
        *((reversed_order, disk, 36 - disk) for disk in range(37)),
        *((three, disk, place) for place, disk in enumerate((34, 2, 17))),
        *((search.propose(disks[disk : disk + 1]), disk, 0) for disk in (0, 5, 31, 32, 36)),
    ):
        for got, expected in zip(of_disk(found, place), of_disk(together, disk), strict=True):
            assert torch.equal(got, expected)


def test_no_disks_give_no_proposals():
    found = grey_search_of("blobs").propose(torch.zeros(0, SIZE, SIZE))
    assert found.offset.tolist() == [0]
    assert found.R_view_body.shape == (0, 3, 3)
    assert found.reason == ()


# --- the bank


def test_every_rotation_lies_within_the_grids_covering_angle_of_a_template():
    templates = grey_search_of("blobs").templates
    R = so3.random_rotations(1000, generator=torch.Generator().manual_seed(6)).float()
    trace = (R.flatten(1) @ templates.flatten(1).T).amax(1)
    covered_deg = ((trace - 1) / 2).clamp(-1, 1).acos().rad2deg()
    step_deg = GreySearchSettings().step_deg
    assert covered_deg.max() <= (0.5 + 0.5**0.5) * step_deg
    assert covered_deg.max() > 0.7 * step_deg  # and is no finer than stated
    # The grid itself, in another order; what fills the last group up is there twice.
    grid = so3.lattman_grid(math.radians(step_deg)).float()
    assert len(templates) - len(grid) < 8
    assert torch.equal(torch.unique(templates.flatten(1), dim=0), torch.unique(grid.flatten(1), dim=0))


@pytest.mark.parametrize("kind", KINDS)
def test_a_peak_of_the_bank_lies_within_the_covering_angle_of_each_attitude(kind):
    search, R_view_body = grey_search_of(kind), attitudes(60, seed=2)
    place, peak = search.search(camera_disks(kind, R_view_body))
    distance = apart_deg(search.templates[place].double(), R_view_body[:, None])
    first_peaks = peak & (peak.cumsum(1) <= 3)
    assert (distance.masked_fill(~first_peaks, 180).amin(1) < 1.21 * GreySearchSettings().step_deg).all()
    assert peak[:, 0].all()


def test_rough_starts_are_the_peaks_of_the_bank():
    search = grey_search_of(KINDS[0])
    disks = camera_disks(KINDS[0], attitudes(3))
    rough = search.rough(disks)
    for found, disk in zip(rough.each(), disks, strict=True):
        (place,), (peak,) = search.search(disk[None])
        peaks = search.templates[place[peak]].double()
        assert torch.equal(found.R_view_body, peaks[: len(found.score)])
        assert len(found.score) == min(len(peaks), GreySearchSettings().peaks)


def test_a_normalised_picture_has_length_1_and_no_mean():
    normalise = grey_search_of("blobs")._normalise
    even = normalise(camera_disks("blobs", attitudes(4), light_from(-0.8, -0.3, -0.52)))
    assert_close(even.norm(dim=1), torch.ones(4), 1e-5)
    assert_close(even @ normalise._unit, torch.zeros(4), 1e-5)


def test_whole_numbers_keep_the_correlation_to_a_few_thousandths():
    search = grey_search_of("blobs")
    even = search._normalise(camera_disks("blobs", attitudes(BATCH)))
    per_unit = (127 / DEVIATIONS) ** 2 * even.shape[1]
    steps = to_int8(even)
    assert (steps.abs() < 127).float().mean() > 0.999  # hardly anything is cut off
    assert search.bank.shape[1] == steps.shape[1]
    bank = search.bank[:500].float()
    assert_close(bank.square().sum(1) / per_unit, torch.ones(500), atol=5e-3)
    correlation = even @ bank[:, : even.shape[1]].T / per_unit**0.5
    error = torch._int_mm(steps, search.bank[:500].T) / per_unit - correlation
    assert error.square().mean().sqrt() < 1e-3
    assert error.abs().max() < 5e-3


@pytest.mark.slow
def test_a_small_bank_and_small_disks_work_alike():
    settings = GreySearchSettings(size_px=24)
    search = GreySearch(texture_of("blobs"), settings)
    assert search.size_px == 24
    R_view_body = attitudes(15)
    small = torch.nn.functional.interpolate(camera_disks("blobs", R_view_body)[:, None], size=(24, 24), mode="area")
    assert best_errors_deg(search.propose(small[:, 0]), R_view_body).max() < 3.0
