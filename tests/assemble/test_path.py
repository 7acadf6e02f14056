"""One camera's path: planted truths are recovered, gaps skipped, poor candidates left out; docs/errata.md A6."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from assemble_examples import RATE_HZ, candidates_of, single, times, turned_deg, turning
from conftest import assert_close, slow

from sphereorient import so3
from sphereorient.assemble import AssembleSettings, Path, assemble_path, assemble_paths
from sphereorient.errors import ShapeError
from sphereorient.search import Candidates

SETTINGS = AssembleSettings()


def among_false_ones(R, rng, *, false_ones: int = 3, better_in: tuple[int, ...] = ()) -> Candidates:
    """The truth with T = 0.9 among random orientations of T = 0.6, in some frames of 0.97."""
    wrong = so3.random_rotations((len(R), false_ones), generator=rng)
    return candidates_of(
        [[(R[k], 0.9), *((each, 0.97 if k in better_in else 0.6) for each in wrong[k])] for k in range(len(R))]
    )


def test_a_smooth_turn_is_found_among_false_candidates_that_score_higher_in_single_frames(rng):
    R = turning(60)
    candidates = among_false_ones(R, rng, better_in=(7, 20, 21, 40))
    path = assemble_path(candidates, times(60), SETTINGS)
    assert float(so3.geodesic_distance(candidates.padded()[0][:, 0], R)[7]) > 0.1  # the best score would be wrong there
    assert torch.equal(path.R_lab_body, R)
    assert (path.choice[[7, 20, 21, 40]] == 3).all()  # best first: three false ones stand before it
    assert not path.spike.any()
    assert (path.segment == 0).all()


def draw(rng: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=rng))


@pytest.mark.parametrize("seed", [0, *map(slow, range(1, 4))])
def test_two_degrees_a_frame_are_found_among_three_to_six_false_candidates(seed):
    rng = torch.Generator().manual_seed(seed)
    R = turning(300, 2.0)
    empty = {0, 1, 298, 299, *torch.randint(300, (20,), generator=rng).tolist()}
    frames, truth = [], []
    for k in range(300):
        wrong = so3.random_rotations(int(torch.randint(3, 7, (), generator=rng)), generator=rng)
        better = k % 10 == 5  # one of the false ones beats the truth
        frame = [(each, 0.97 if better and not i else draw(rng, 0.5, 0.85)) for i, each in enumerate(wrong)]
        truth.append(draw(rng, 0.85, 0.95))
        frames.append([] if k in empty else [*frame, (R[k], truth[-1])])
    path = assemble_path(candidates_of(frames), times(300), SETTINGS)
    seen = torch.tensor([k not in empty for k in range(300)])
    assert torch.equal(path.present, seen)
    assert torch.equal(path.R_lab_body[seen], R[seen])
    frame, T = torch.nonzero(seen).flatten(), torch.tensor(truth, dtype=torch.float64)[seen]
    assert_close(path.score[seen], T)
    dt = frame.diff().double() / RATE_HZ
    expected = so3.geodesic_distance(R[frame[:-1]], R[frame[1:]]) / dt  # rad/s, without the scores
    assert_close(path.xi[frame[1:]], expected, 1e-9)
    assert not path.spike.any()


def test_single_precision_chooses_the_same_and_keeps_its_links_late_in_a_movie(rng):
    full = among_false_ones(turning(40), rng, better_in=(7,))
    single_precision = replace(
        full, R_view_body=full.R_view_body.float(), R_lab_view=full.R_lab_view.float(), score=full.score.float()
    )
    late = times(40) + 20_000.0  # s; steps of 1/600 s are lost in single precision there
    expected, path = (assemble_path(each, late, SETTINGS) for each in (full, single_precision))
    assert torch.equal(path.choice, expected.choice)
    assert path.xi.dtype == path.R_lab_body.dtype == torch.float32
    assert_close(path.xi, expected.xi.float(), 1e-4)
    assert late.float().diff().min() == 0.0  # the reading that rounds the times first


def test_frames_without_candidates_are_skipped_and_the_link_over_them_takes_its_time():
    R = turning(30)
    path = assemble_path(single(R, without=(0, 10, 11, 29)), times(30), SETTINGS)
    assert path.choice[[0, 10, 11, 29]].tolist() == [-1] * 4
    for values in (path.R_lab_body, path.score, path.xi):
        assert values[[0, 10, 11, 29]].isnan().all()
    over = so3.geodesic_distance(R[9], R[12]) * RATE_HZ
    assert_close(path.xi[12], over / 3)
    assert abs(float(path.xi[12] - over)) > 1.0  # the reading that counts the hole as one frame
    assert math.isnan(path.xi[1])  # the first frame seen: no link enters it
    assert path.segment.tolist() == [-1, *[0] * 28, -1]


@pytest.mark.parametrize("by", ["hole", "uneven_times"])
def test_the_longer_of_two_links_is_given_the_larger_turn(by):
    """Both ways rotate by 30 degrees in all; the better scored one by most of it in the short link."""
    still = torch.eye(3, dtype=torch.float64)
    early, late = turned_deg(still, 25.0, 0.0, 0.0), turned_deg(still, 5.0, 0.0, 0.0)
    frames = [[(still, 0.9)], [(early, 0.905), (late, 0.9)], [(turned_deg(still, 30.0, 0.0, 0.0), 0.9)]]
    time = times(3)
    if by == "hole":
        frames, time = [*frames[:2], [], [], [], frames[2]], times(6)
    else:
        time[2] = time[1] + 4 / RATE_HZ
    assert assemble_path(candidates_of(frames), time, SETTINGS).choice[1] == 1
    evenly = candidates_of([frames[0], frames[1], frames[-1]])
    assert assemble_path(evenly, times(3), SETTINGS).choice[1] == 0  # the reading that counts links, not time


def test_xi_stands_at_the_frame_that_the_link_enters():
    R = torch.eye(3, dtype=torch.float64).repeat(20, 1, 1)
    R[12:] = turned_deg(R[12:], 40.0, 0.0, 0.0)
    path = assemble_path(single(R), times(20), SETTINGS)
    assert torch.nonzero(path.xi > 5).flatten().tolist() == [12]
    assert torch.nonzero(path.spike).flatten().tolist() == [12]
    assert_close(path.xi[12], torch.tensor(math.radians(40) * RATE_HZ, dtype=torch.float64), 1e-9)
    assert path.segment.tolist() == [0] * 12 + [1] * 8


def test_candidates_below_the_least_quality_are_never_chosen(rng):
    R = turning(20)
    poor = so3.random_rotations(20, generator=rng)
    frames = [[(R[k], 0.49), (poor[k], 0.5)] for k in range(20)]
    frames[5] = [(R[5], 0.49)]
    path = assemble_path(candidates_of(frames), times(20), SETTINGS)
    assert (path.score[path.present] == 0.5).all()
    assert torch.nonzero(~path.present).flatten().tolist() == [5]
    lower = assemble_path(candidates_of(frames), times(20), AssembleSettings(quality_min=0.4))
    assert torch.equal(lower.R_lab_body, R)


def test_cameras_in_one_batch_give_what_each_gives_alone(rng):
    R = turning(40)
    full = among_false_ones(R, rng, better_in=(3, 4))
    holes = candidates_of(
        [[] if k in (0, 5, 6, 20) else [(R[k], 0.8), (turned_deg(R[k], 0.0, 50.0 + k, 0.0), 0.85)] for k in range(40)]
    )
    cameras = {"cam1": full, "cam2": holes, "blind": single(R, without=range(40))}
    together = assemble_paths(cameras, times(40), SETTINGS)
    assert list(together) == list(cameras)
    for name, candidates in cameras.items():
        alone = assemble_path(candidates, times(40), SETTINGS)
        for field in Path.__dataclass_fields__:
            assert_close(getattr(together[name], field), getattr(alone, field))


@pytest.mark.parametrize(("frames", "seen"), [(0, False), (1, False), (3, False), (1, True)])
def test_a_camera_that_saw_nothing_has_an_empty_path_and_one_frame_is_a_path(frames, seen):
    camera = single(turning(frames)[:frames], without=[] if seen else range(frames))
    path = assemble_path(camera, times(frames), SETTINGS)
    assert path.choice.tolist() == path.segment.tolist() == [int(seen) - 1] * frames
    assert path.R_lab_body.shape == (frames, 3, 3)
    assert path.R_lab_body.isnan().all() != seen or not frames


def test_a_camera_of_another_length_is_refused():
    with pytest.raises(ShapeError, match="'cam2': expected 10 frames"):
        assemble_paths({"cam1": single(turning(10)), "cam2": single(turning(9))}, times(10), SETTINGS)
