import pydantic
import pytest
import torch
from conftest import assert_close

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.search import Candidates, OrientSettings
from sphereorient.trajectory import Reason

OK, DARK, RUNAWAY, NOT_FOUND = Reason.OK, Reason.DARK, Reason.RUNAWAY, Reason.NOT_FOUND


def candidates(counts: list[int], rng: torch.Generator) -> Candidates:
    total = sum(counts)
    return Candidates(
        offset=torch.tensor([0, *counts]).cumsum(0),
        R_view_body=so3.random_rotations(total, generator=rng),
        R_lab_view=so3.random_rotations(len(counts), generator=rng).double(),
        score=torch.rand(total, generator=rng, dtype=torch.float64),
        reason=tuple(OK if count else DARK for count in counts),
    )


def proposals(counts: list[int], first: int, reason: tuple[Reason, ...]) -> Candidates:
    """Scores count up from `first`, so that each row is unique."""
    total = sum(counts)
    return Candidates(
        offset=torch.tensor([0, *counts]).cumsum(0),
        R_view_body=so3.random_rotations(total, generator=torch.Generator().manual_seed(first)),
        score=first + torch.arange(total, dtype=torch.float64),
        reason=reason,
    )


def test_padded_candidates_hold_each_frames_rows_and_unit_rotations_else(rng):
    some = candidates([2, 0, 3, 1], rng)
    assert len(some) == 4
    assert some.counts.tolist() == [2, 0, 3, 1]
    R, score, mask = some.padded()
    assert R.shape == (4, 3, 3, 3)
    assert mask.tolist() == [[True, True, False], [False] * 3, [True] * 3, [True, False, False]]
    assert torch.equal(R[0, :2], some.R_lab_body[:2])
    assert torch.equal(R[2], some.R_lab_body[2:5])
    assert torch.equal(R[3, 0], some.R_lab_body[5])
    assert torch.equal(score[2], some.score[2:5])
    assert_close(R[~mask], torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert (score[~mask] == 0).all()


@pytest.mark.parametrize("counts", [[], [0], [0, 0]], ids=str)
def test_padded_is_one_wide_where_no_frame_has_a_candidate(rng, counts):
    R, score, mask = candidates(counts, rng).padded()
    assert R.shape == (len(counts), 1, 3, 3)
    assert score.shape == mask.shape == (len(counts), 1)
    assert not mask.any()


def test_candidates_whose_lengths_disagree_are_refused(rng):
    good = candidates([2, 0, 1], rng)
    parts = {"offset": good.offset, "R_view_body": good.R_view_body, "score": good.score, "reason": good.reason}
    for wrong in (
        {"R_view_body": good.R_view_body[:2]},
        {"score": good.score[:2]},
        {"offset": torch.tensor([0, 2, 2, 4])},
        {"reason": good.reason[:2]},
    ):
        with pytest.raises(ShapeError, match="orientations and scores"):
            Candidates(**(parts | wrong))
    with pytest.raises(ShapeError, match=r"Candidates\.R_view_body"):
        Candidates(**(parts | {"R_view_body": torch.zeros(3, 4)}))


def test_candidates_are_turned_into_the_lab_frame_by_frame(rng):
    some = candidates([2, 0, 1], rng)
    expected = [some.R_lab_view[0] @ some.R_view_body[0], some.R_lab_view[0] @ some.R_view_body[1]]
    assert_close(some.R_lab_body, torch.stack([*expected, some.R_lab_view[2] @ some.R_view_body[2]]))


def test_joined_proposals_are_the_disks_of_all_parts_in_order():
    joined = Candidates.joined(
        [proposals([1, 2], 0, (OK, OK)), Candidates.none([RUNAWAY]), proposals([0, 1], 10, (DARK, OK))]
    )
    assert joined.offset.tolist() == [0, 1, 3, 3, 3, 4]
    assert joined.score.tolist() == [0, 1, 2, 10]
    assert joined.reason == (OK, OK, RUNAWAY, DARK, OK)
    assert torch.equal(joined.R_view_body[:3], proposals([1, 2], 0, (OK, OK)).R_view_body)
    assert joined.offset.dtype == torch.int64


def test_spread_proposals_have_an_entry_for_every_frame():
    disks = proposals([2, 0, 1], 5, (OK, RUNAWAY, OK))
    placed = torch.tensor([False, True, True, False, True])
    spread = disks.spread(placed, (NOT_FOUND, OK, OK, DARK, OK))
    assert spread.offset.tolist() == [0, 0, 2, 2, 2, 3]
    assert spread.reason == (NOT_FOUND, OK, RUNAWAY, DARK, OK)
    assert torch.equal(spread.score, disks.score)
    assert torch.equal(spread.R_view_body, disks.R_view_body)


def test_spread_over_frames_without_any_disk():
    spread = Candidates.none(()).spread(torch.zeros(3, dtype=torch.bool), (DARK, NOT_FOUND, DARK))
    assert spread.offset.tolist() == [0, 0, 0, 0]
    assert spread.reason == (DARK, NOT_FOUND, DARK)


def test_reasons_for_another_number_of_frames_are_refused():
    with pytest.raises(ValueError, match="zip"):
        Candidates.none([RUNAWAY]).spread(torch.tensor([True, False]), (OK,))


def test_the_defaults_are_the_papers():
    paper = OrientSettings()
    assert (paper.black_share, paper.white_share, paper.score_margin, paper.score_min) == (0.3, 0.3, 0.1, 0.5)
    assert (paper.coarse_step_deg, paper.fine_step_deg) == (12, 3)
    assert 30 <= paper.group_deg <= 45
    assert all(entry.description for entry in OrientSettings.model_fields.values())


@pytest.mark.parametrize("wrong", [{"black_share": 1.0}, {"fine_step_deg": 0.1}, {"blackshare": 0.3}], ids=str)
def test_impossible_and_unknown_settings_are_refused(wrong):
    with pytest.raises(pydantic.ValidationError):
        OrientSettings(**wrong)
