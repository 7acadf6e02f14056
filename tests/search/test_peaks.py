import math

import pytest
import torch

from sphereorient import so3
from sphereorient.search.candidates import distinct
from sphereorient.search.grey_search import best_of_groups, compact_groups


def turned_deg(*angles: float) -> torch.Tensor:
    """Rotations about one axis."""
    return so3.exp(torch.deg2rad(torch.tensor(angles))[:, None] * torch.tensor([0.6, 0.0, 0.8]))


@pytest.mark.parametrize(("count", "size"), [(1, 8), (8, 8), (100, 8), (1001, 4), (37, 1)])
def test_every_rotation_is_in_a_group_and_all_groups_are_of_one_size(count, size):
    groups = compact_groups(so3.random_rotations(count), size)
    assert groups.shape == (math.ceil(count / size), size)
    assert groups.unique().tolist() == list(range(count))


def test_a_group_holds_neighbours():
    R = so3.lattman_grid(math.radians(12.0))
    groups = R[compact_groups(R, 8)]
    within = so3.geodesic_distance(groups[:, :, None], groups[:, None]).amax((1, 2)).rad2deg()
    # Eight rotations of a grid of 12 degrees fill two steps each way; drawn at random they would span 170.
    assert within.median() < 40
    assert within.mean() < 45


@pytest.mark.parametrize("count", [1, 5, 40])
def test_the_best_of_groups_agree_with_sorting_all(count):
    scores = torch.randperm(3 * 4 * 20, generator=torch.Generator().manual_seed(2)).reshape(3, 4, 20).int()
    place = best_of_groups(scores, count)
    assert place.shape == (3, min(count, 20))
    for row, places in zip(scores, place, strict=True):
        best = sorted(((int(group.max()), g) for g, group in enumerate(row.unbind(1))), reverse=True)[: len(places)]
        assert row.flatten()[places].tolist() == [score for score, _ in best]
        assert (places % 20).tolist() == [group for _, group in best]


def test_a_rotation_near_a_better_one_is_no_top():
    assert distinct(turned_deg(0, 15, 30, -21, 90), math.radians(20)).tolist() == [True, False, False, True, True]
    # 30 is near 15 only, which is no peak itself: it lies on the slope of the first one.
    assert distinct(turned_deg(0, 30), math.radians(20)).tolist() == [True, True]
    assert distinct(turned_deg(0, 359), math.radians(20)).tolist() == [True, False]


def test_distinct_of_a_batch_is_that_of_each_list():
    R = so3.random_rotations((2, 3, 30), generator=torch.Generator().manual_seed(4))
    together = distinct(R, 0.8)
    assert together.shape == (2, 3, 30)
    assert together[..., 0].all()
    for some, alone in zip(together.flatten(0, 1), R.flatten(0, 1), strict=True):
        assert torch.equal(some, distinct(alone, 0.8))
        assert 1 < some.sum() < 30
