"""Two proposers: which one is used, and the order of their proposals."""

import math

import pytest
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search import Candidates, FallbackProposer
from sphereorient.search.candidates import interleaved, resized
from sphereorient.trajectory import Reason


def turned(*degrees: float) -> Tensor:
    return so3.exp(torch.tensor([[0.0, 0.0, math.radians(d)] for d in degrees], dtype=torch.float64).reshape(-1, 3))


def proposals(*disks: list[tuple[float, float]]) -> Candidates:
    """Proposals of each disk: pairs of angle (degrees) and score."""
    counts = torch.tensor([len(disk) for disk in disks])
    rows = [row for disk in disks for row in disk]
    return Candidates(
        offset=torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
        R_view_body=turned(*(angle for angle, _ in rows)),
        score=torch.tensor([score for _, score in rows], dtype=torch.float64),
        reason=tuple(Reason.OK if disk else Reason.LOW_SCORE for disk in disks),
    )


class Planted:
    """Planted proposals by the grey level of a disk's first pixel; keeps these levels."""

    def __init__(self, answers: dict[int, list[tuple[float, float]]], size_px: int = 4) -> None:
        self.answers, self.size_px, self.asked = answers, size_px, []

    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        assert disks.shape[1:] == (self.size_px, self.size_px)
        keys = [round(float(disk[0, 0])) for disk in disks]
        self.asked += keys
        return proposals(*(self.answers.get(key, []) for key in keys))


def disks(*keys: int, size_px: int = 4) -> Tensor:
    return torch.tensor(keys, dtype=torch.float32)[:, None, None].expand(-1, size_px, size_px).contiguous()


def angles(found: Candidates, f: int) -> list[float]:
    R = found.R_view_body[found.offset[f] : found.offset[f + 1]]
    return [round(math.degrees(float(x)), 3) for x in so3.log(R)[:, 2]]


FIRST = {1: [(0.0, 0.9), (50.0, 0.5)], 2: [(10.0, 0.6), (90.0, 0.5)], 3: []}
SECOND = {2: [(-60.0, 0.7), (85.0, 0.2)], 3: [(120.0, 0.4)], 1: [(170.0, 1.0)]}


def test_the_second_gets_doubtful_disks_alone() -> None:
    first, second = Planted(FIRST), Planted(SECOND)
    found = FallbackProposer(first, second, sure=0.75).propose(disks(1, 2, 3, 1))
    assert first.asked == [1, 2, 3, 1]
    assert second.asked == [2, 3]
    assert angles(found, 0) == angles(found, 3) == [0.0, 50.0]
    assert found.reason == (Reason.OK,) * 4


def test_for_a_doubtful_disk_the_second_comes_first_and_nothing_comes_twice() -> None:
    found = FallbackProposer(Planted(FIRST), Planted(SECOND), sure=0.75).propose(disks(2))
    # 90 is within 12 degrees of the second's 85, which comes later in turn than the first's 10 but before its 90.
    assert angles(found, 0) == [-60.0, 10.0, 85.0]
    torch.testing.assert_close(found.score, torch.tensor([0.7, 0.6, 0.2], dtype=torch.float64))


@pytest.mark.parametrize(("sure", "asked"), [(0.0, []), (0.61, [2, 3]), (1.0, [1, 2, 3])])
def test_the_threshold_of_the_first_counts(sure: float, asked: list[int]) -> None:
    second = Planted(SECOND)
    FallbackProposer(Planted(FIRST), second, sure=sure).propose(disks(1, 2, 3))
    assert second.asked == asked


def test_a_disk_without_a_proposal_of_either_has_the_reason_of_the_second() -> None:
    found = FallbackProposer(Planted({}), Planted({}), sure=0.75).propose(disks(1, 2))
    assert found.offset.tolist() == [0, 0, 0]
    assert found.reason == (Reason.LOW_SCORE,) * 2


def test_one_disk_at_a_time_gives_the_same_as_all() -> None:
    proposer = FallbackProposer(Planted(FIRST), Planted(SECOND), sure=0.75)
    together = proposer.propose(disks(3, 1, 2))
    alone = Candidates.joined([proposer.propose(disks(key)) for key in (3, 1, 2)])
    assert torch.equal(together.offset, alone.offset)
    assert torch.equal(together.R_view_body, alone.R_view_body)


def test_the_second_gets_disks_of_its_own_size() -> None:
    second = Planted(SECOND, size_px=6)
    FallbackProposer(Planted(FIRST), second, sure=0.75).propose(disks(2, 3))
    assert second.asked == [2, 3]


def test_resized_disks_keep_their_place() -> None:
    ramp = torch.arange(8.0)[None, None].expand(1, 8, 8)  # grey of a column is its place, middle of the pixel
    half = resized(ramp, 4)[0]
    torch.testing.assert_close(half[2, 1:3], torch.tensor([2.5, 4.5]), atol=0.2, rtol=0)
    assert resized(ramp, 8) is ramp


def test_interleaved_keeps_the_order_of_each() -> None:
    one, other = proposals([(0, 0.9), (40, 0.8), (80, 0.7)]), proposals([(120, 0.6), (160, 0.5)])
    assert angles(interleaved(one, other), 0) == [0.0, 120.0, 40.0, 160.0, 80.0]
