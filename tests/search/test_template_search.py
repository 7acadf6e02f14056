"""The template search on disks whose attitude is known (paper sections III B and C)."""

from __future__ import annotations

import math

import pytest
import torch
from conftest import assert_close
from orient_examples import (
    KINDS,
    SIZE,
    attitudes,
    best_errors_deg,
    clean_disks,
    of_disk,
    search_of,
    texture_of,
)

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.search import OrientSettings, PaperSearch
from sphereorient.trajectory import Reason


def noise(count: int, seed: int = 5) -> torch.Tensor:
    return 200 * torch.rand(count, SIZE, SIZE, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_the_best_proposal_lies_within_the_fine_grids_covering(kind):
    R_view_body = attitudes(30)
    found = search_of(kind).propose(clean_disks(kind, R_view_body))
    error = best_errors_deg(found, R_view_body)
    # The fine grid's covering radius is 0.704 x 3 = 2.1 degrees; the winner of T may be the point next to the nearest.
    assert error.max() < 4.0
    assert error.square().mean().sqrt() < 2.0
    assert found.score[found.offset[:-1]].min() > 0.9
    # The other reading of the matrix is no answer.
    assert so3.geodesic_distance(found.R_view_body[found.offset[:-1]].mT, R_view_body).rad2deg().median() > 20


def test_proposals_are_rotations_of_float64_best_score_first():
    found = search_of("dots").propose(clean_disks("dots", attitudes(30)))
    assert found.R_view_body.dtype == found.score.dtype == torch.float64
    assert_close(
        found.R_view_body @ found.R_view_body.mT, torch.eye(3, dtype=torch.float64).expand_as(found.R_view_body)
    )
    assert ((found.score >= 0.5) & (found.score <= 1)).all()
    assert found.offset[0] == 0
    assert found.offset[-1] == len(found.score) == len(found.R_view_body)
    for disk in range(30):
        assert (of_disk(found, disk)[1].diff() <= 0).all()
    assert found.reason == (Reason.OK,) * 30


def test_a_finer_grid_answers_more_exactly():
    R_view_body = attitudes(8)
    disks = clean_disks("blobs", R_view_body, 64)
    coarse, fine = (
        best_errors_deg(
            PaperSearch(texture_of("blobs"), 64, OrientSettings(fine_step_deg=step)).propose(disks), R_view_body
        )
        for step in (6.0, 2.0)
    )
    assert fine.square().mean().sqrt() < 0.5 * coarse.square().mean().sqrt()
    assert fine.max() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_tells_a_mirrored_picture_and_a_mirrored_map_from_the_right_one(kind):
    disks = clean_disks(kind, attitudes(10))
    mirrored_search = PaperSearch(texture_of(kind).flip(1), SIZE, OrientSettings())

    def best_scores(search: PaperSearch, disks: torch.Tensor) -> torch.Tensor:
        found = search.propose(disks)
        none = torch.zeros(1, dtype=torch.float64)
        return torch.stack([torch.cat([of_disk(found, disk)[1], none])[0] for disk in range(len(disks))])

    right = best_scores(search_of(kind), disks)
    assert right.min() > 0.9
    assert (right - best_scores(search_of(kind), disks.flip(-1))).min() > 0.05
    assert (right - best_scores(mirrored_search, disks)).min() > 0.05
    # Two mirrors are none.
    assert (right - best_scores(mirrored_search, disks.flip(-1))).abs().max() < 0.05


# --- T, docs/errata.md A2


def test_T_of_the_perfect_picture_is_1_because_the_pixels_counted_are_divided_by():
    search = search_of("patches")
    on_grid = so3.lattman_grid(math.radians(12.0))[4321]
    # The search's own template as the picture: each pixel of it is right.
    template = search._table.render(on_grid[None].float(), search._fine.normal_view).float()
    found = search.propose(search._fine.picture(template))
    R, score = of_disk(found, 0)
    assert score[0] == 1.0
    assert_close(R[0], on_grid, atol=1e-6)
    # As printed, 1/2 + sum / (2 pi r^2): the disk that is compared has fewer pixels than pi r^2.
    counted = int(search._fine_used.sum())
    as_printed = 0.5 + counted / (2 * math.pi * (SIZE / 2) ** 2)
    assert as_printed < 0.97


def test_T_of_the_coarse_search_is_1_half_and_0_for_a_template_noise_and_its_negative():
    search = search_of("blobs")
    half_size = torch.zeros(1, int(search._coarse.inside.sum()))
    half_size[:, search._coarse_used] = search._bank[777]
    paint = search._coarse.picture(half_size).repeat_interleave(2, -1).repeat_interleave(2, -2)
    score = search._coarse_scores(torch.cat([paint, -paint, 0 * paint]))
    assert score[0, 777] == 1.0
    assert score[1, 777] == 0.0
    assert (score[2] == 0.5).all()


# --- one disk, many disks


@pytest.mark.slow
def test_a_disks_answer_does_not_depend_on_which_others_come_with_it():
    search, R_view_body = search_of("blobs"), attitudes(35)  # more than one batch
    disks = clean_disks("blobs", R_view_body) + noise(35) / 20
    together = search.propose(disks)
    reversed_order = search.propose(disks.flip(0))
    three = search.propose(disks[[34, 2, 17]])
    assert together.reason == reversed_order.reason[::-1]
    for disk in range(35):
        for got, expected in zip(of_disk(reversed_order, 34 - disk), of_disk(together, disk), strict=True):
            assert torch.equal(got, expected)
    for place, disk in enumerate((34, 2, 17)):
        for got, expected in zip(of_disk(three, place), of_disk(together, disk), strict=True):
            assert torch.equal(got, expected)
    for disk in (0, 31, 32):
        for got, expected in zip(
            of_disk(search.propose(disks[disk : disk + 1]), 0), of_disk(together, disk), strict=True
        ):
            assert torch.equal(got, expected)


def test_no_disks_give_no_proposals():
    found = search_of("blobs").propose(torch.zeros(0, SIZE, SIZE))
    assert found.offset.tolist() == [0]
    assert found.R_view_body.shape == (0, 3, 3)
    assert found.reason == ()


def test_disks_of_another_size_are_refused_and_an_odd_size_is_rounded_up():
    with pytest.raises(ShapeError, match=r"disks: expected \(F, 48, 48\)"):
        search_of("blobs").propose(torch.zeros(2, SIZE + 2, SIZE + 2))
    search = PaperSearch(texture_of("blobs"), SIZE - 1, OrientSettings())
    assert search.size_px == SIZE
    R_view_body = attitudes(2)
    assert best_errors_deg(search.propose(clean_disks("blobs", R_view_body)), R_view_body).max() < 4


# --- what is no picture of the sphere


def test_noise_fits_everywhere_and_is_a_runaway():
    found = search_of("blobs").propose(noise(6))
    assert found.reason == (Reason.RUNAWAY,) * 6
    assert len(found.score) == 0
    assert found.offset.tolist() == [0] * 7


def test_a_disk_of_one_grey_is_a_runaway():
    assert search_of("blobs").propose(torch.full((1, SIZE, SIZE), 90.0)).reason == (Reason.RUNAWAY,)


def test_noise_does_not_change_its_neighbours():
    disks = clean_disks("blobs", attitudes(3))
    found = search_of("blobs").propose(torch.cat([disks[:1], noise(1), disks[1:]]))
    assert found.reason == (Reason.OK, Reason.RUNAWAY, Reason.OK, Reason.OK)
    assert best_errors_deg(search_of("blobs").propose(disks), attitudes(3)).max() < 4
    alone = search_of("blobs").propose(disks)
    assert torch.equal(found.R_view_body, alone.R_view_body)
    assert torch.equal(found.score, alone.score)


@pytest.mark.slow
def test_no_proposal_scores_below_score_min_and_those_above_stay():
    disks = clean_disks("dots", attitudes(30))
    all_of_them = search_of("dots").propose(disks)
    few = PaperSearch(texture_of("dots"), SIZE, OrientSettings(score_min=0.8)).propose(disks)
    assert (all_of_them.score < 0.8).any()
    assert (few.score >= 0.8).all()
    assert torch.equal(few.score, all_of_them.score[all_of_them.score >= 0.8])


def test_a_disk_whose_best_is_below_score_min_says_so():
    search = PaperSearch(texture_of("blobs"), SIZE, OrientSettings(score_min=1.0))
    found = search.propose(clean_disks("blobs", attitudes(2)))
    assert found.reason == (Reason.LOW_SCORE,) * 2
    assert found.offset.tolist() == [0, 0, 0]


# --- groups


@pytest.mark.parametrize("group_deg", [30.0, 45.0])
def test_the_groups_of_a_disk_are_apart_by_the_groups_angle(group_deg):
    # A fine grid of one point: the proposals are the groups' best on the coarse grid.
    settings = OrientSettings(
        group_deg=group_deg, score_margin=0.2, groups_max=500, fine_radius_deg=0.1, fine_step_deg=1.0
    )
    found = PaperSearch(texture_of("dots"), SIZE, settings).propose(clean_disks("dots", attitudes(6)))
    several = 0
    for disk in range(6):
        R, _ = of_disk(found, disk)
        gap = so3.geodesic_distance(R[:, None], R[None]).rad2deg() + 360 * torch.eye(len(R))
        several += len(R) > 1
        if len(R) > 1:
            assert gap.min() >= group_deg - 0.01
    assert several >= 3


def test_more_groups_than_allowed_are_a_runaway():
    disks = clean_disks("dots", attitudes(12))
    many = search_of("dots").propose(disks)
    assert (many.offset.diff() > 1).any()
    one = PaperSearch(texture_of("dots"), SIZE, OrientSettings(groups_max=1)).propose(disks)
    for disk in range(12):
        if many.offset.diff()[disk] > 1:
            assert one.reason[disk] == Reason.RUNAWAY
    assert Reason.OK in one.reason


@pytest.mark.slow
def test_two_groups_that_climb_to_one_place_give_one_proposal():
    settings = OrientSettings(group_deg=10.0, groups_max=500, score_margin=0.15)
    found = PaperSearch(texture_of("blobs"), SIZE, settings).propose(clean_disks("blobs", attitudes(2)))
    for disk in range(2):
        R, _ = of_disk(found, disk)
        gap = so3.geodesic_distance(R[:, None], R[None]).rad2deg() + 360 * torch.eye(len(R))
        assert gap.min() >= 2 * settings.fine_step_deg - 1e-6
