"""The path with physics: false candidates that stand still, holes, fast spheres, twins; docs/errata.md A6."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from assemble_examples import RATE_HZ, candidates_of, times, turned_deg, turning
from conftest import assert_close, slow
from second_order_examples import (
    Hypotheses,
    flagged,
    lost_frames,
    physical_path,
    pooled,
    seen,
    standing,
    without,
    wrong_frames,
)

from sphereorient import so3
from sphereorient.assemble import (
    AssembleSettings,
    PathSettings,
    assemble_path,
    beam,
)
from sphereorient.errors import ShapeError
from sphereorient.trajectory import Flag

SETTINGS = PathSettings()


def test_errata_a6_a_false_candidate_that_stands_still_is_taken_by_the_paper_and_not_by_this_path(rng):
    R = turning(40)
    still = turned_deg(R[0], 0.0, 0.0, 120.0)
    paper = assemble_path(
        candidates_of([[(R[k], 0.95), (still, 0.55)] for k in range(40)]), times(40), AssembleSettings()
    )
    assert torch.equal(paper.R_lab_body, still.expand(40, 3, 3))
    path = physical_path(pooled(R, still.expand(40, 3, 3)), times(40), SETTINGS)  # equal likelihood: motion alone
    assert torch.equal(path.R_lab_body, R)
    assert (path.probability > 0.99).all()


@pytest.mark.parametrize("deg_per_frame", [1.2, slow(3.7), slow(22.0), 45.0])
def test_a_false_candidate_that_stands_still_loses_although_the_pictures_favour_it(deg_per_frame, rng):
    R = turning(120, deg_per_frame)
    path = physical_path(pooled(seen(standing(120), rng), seen(R, rng), nll=[0.0, 2.0]), times(120), SETTINGS)
    assert path.choice.unique().tolist() == [1]
    assert not flagged(path, Flag.AMBIGUOUS | Flag.SPIKE)


def test_a_sphere_at_rest_is_found_all_the_same(rng):
    path = physical_path(pooled(seen(standing(60), rng)), times(60), SETTINGS)
    assert path.choice.tolist() == [0] * 60
    stops = torch.cat([turning(60, 4.0), turning(60, 4.0)[-1:].expand(60, 3, 3)])
    path = physical_path(pooled(seen(stops, rng)), times(120), SETTINGS)
    assert path.choice.tolist() == [0] * 120


@pytest.mark.parametrize("deg_per_frame", [3.7, 22.0])
@pytest.mark.parametrize("length", [1, slow(3), 8])
def test_a_stuck_candidate_that_is_the_only_one_for_a_while_is_skipped_and_not_followed(length, deg_per_frame, rng):
    R = turning(120, deg_per_frame)
    shown = seen(R, rng)
    shown[60 : 60 + length] = seen(standing(length), rng)
    path = physical_path(pooled(shown), times(120), SETTINGS)
    assert lost_frames(path) == list(range(60, 60 + length))
    assert path.segment.tolist() == [0] * 120  # the motion goes on after it
    assert flagged(path, Flag.RECOVERED) == [60 + length]
    assert not flagged(path, Flag.SPIKE)


@pytest.mark.parametrize("deg_per_frame", [1.2, 22.0, 45.0])
def test_frames_with_one_wrong_candidate_are_skipped(deg_per_frame, rng):
    R = turning(200, deg_per_frame)
    junk = torch.rand(200, generator=rng) < 0.1
    shown = torch.where(junk[:, None, None], so3.random_rotations(200, generator=rng), seen(R, rng))
    path = physical_path(pooled(shown), times(200), SETTINGS)
    assert torch.equal(path.present, ~junk)


@pytest.mark.slow
@pytest.mark.parametrize("deg_per_frame", [3.7, 22.0, 45.0])
def test_thirty_per_cent_of_the_frames_may_be_missing(deg_per_frame, rng):
    R = turning(300, deg_per_frame)
    missing = torch.nonzero(torch.rand(300, generator=rng) < 0.3).flatten().tolist()
    path = physical_path(without(seen(R, rng), missing), times(300), SETTINGS)
    assert lost_frames(path) == missing
    assert wrong_frames(path, R) == []
    assert set(path.segment.tolist()) <= {-1, 0}
    rows = torch.nonzero(path.present).flatten()  # frames that were never written: the same, by the times alone
    dropped = physical_path(pooled(path.R_lab_body[rows]), times(300)[rows], SETTINGS)
    assert_close(dropped.turn_rad, path.turn_rad[rows])
    assert dropped.segment.unique().tolist() == [0]


@pytest.mark.parametrize("deg_per_frame", [slow(22.0), 45.0])
def test_a_fast_sphere_among_false_candidates_is_tracked_without_a_lost_or_wrong_frame(deg_per_frame, rng):
    R = turning(150, deg_per_frame)
    false = so3.random_rotations((2, 150), generator=rng)
    path = physical_path(pooled(*false, seen(R, rng)), times(150), SETTINGS)
    assert path.choice.tolist() == [2] * 150
    assert path.segment.tolist() == [0] * 150
    assert not path.flags.any()


def test_a_hole_of_twelve_frames_is_one_motion(rng):
    R = turning(100, 3.7)
    path = physical_path(without(seen(R, rng), range(50, 62)), times(100), SETTINGS)
    assert lost_frames(path) == list(range(50, 62))
    assert wrong_frames(path, R) == []
    assert path.segment.tolist() == [0] * 100
    assert flagged(path, Flag.RECOVERED) == [62]
    assert math.degrees(float(path.turn_rad[62].norm())) == pytest.approx(13 * 3.7, abs=1.0)


def test_false_candidates_beside_the_truth_behind_a_hole_are_not_taken(rng):
    R = turning(100, 3.7)
    near = turned_deg(R, 25.0, 0.0, 0.0)  # from the truth, less than the rotation over the gap
    mask = torch.ones(100, 2, dtype=torch.bool)
    mask[50:62] = False
    path = physical_path(pooled(seen(near, rng), seen(R, rng), mask=mask, nll=[0.0, 0.0]), times(100), SETTINGS)
    assert len(path.choice[path.present].unique()) == 1  # either one, but the same before and after


def test_both_cameras_blind_for_twenty_frames_end_a_segment_and_the_next_begins_at_once(rng):
    R = turning(120, 3.7)
    path = physical_path(without(seen(R, rng), range(50, 70)), times(120), SETTINGS)
    assert path.segment.tolist() == [0] * 50 + [-1] * 20 + [1] * 50
    assert wrong_frames(path, R) == []
    assert flagged(path, Flag.RECOVERED) == [70]
    assert not flagged(path, Flag.SPIKE | Flag.AMBIGUOUS)
    assert torch.isnan(path.turn_rad[70]).all()
    longer = physical_path(without(seen(R, rng), range(50, 70)), times(120), PathSettings(gap_frames_max=20))
    assert longer.segment.tolist() == [0] * 120


def test_a_new_beginning_needs_more_than_one_frame_of_junk(rng):
    R = turning(120, 3.7)
    shown = seen(R, rng)
    shown[40:70] = so3.random_rotations(30, generator=rng)  # longer than any hole of a segment, and never empty
    path = physical_path(pooled(shown), times(120), SETTINGS)
    assert lost_frames(path) == list(range(40, 70))
    assert path.segment.tolist() == [0] * 40 + [-1] * 30 + [1] * 50


def test_a_turn_that_does_not_follow_from_the_motion_is_a_spike_and_a_new_segment(rng):
    R = turning(100, 3.7)
    R[50:] = turned_deg(R[50:], 0.0, 80.0, 0.0)
    path = physical_path(pooled(seen(R, rng)), times(100), SETTINGS)
    assert path.present.all()
    assert 50 in flagged(path, Flag.SPIKE)
    assert path.segment[49] != path.segment[50]
    assert path.segment[60:].unique().tolist() == [path.segment[-1]]


def test_a_turn_far_off_the_motion_parts_segments_although_no_break_is_thought_possible(rng):
    R = turning(100, 3.7)
    R[50:] = turned_deg(R[50:], 0.0, 15.0, 0.0)
    path = physical_path(pooled(seen(R, rng)), times(100), PathSettings(break_probability=1.0e-30))
    assert path.present.all()
    assert not path.turn_rad[1:].isnan().any()  # it was followed
    assert 50 in flagged(path, Flag.SPIKE)
    assert 50 in flagged(path, Flag.RECOVERED)
    assert path.segment[49] != path.segment[50]
    small = PathSettings(break_probability=1.0e-30, spike_min_deg=30.0)
    assert physical_path(pooled(seen(R, rng)), times(100), small).segment.tolist() == [0] * 100


def test_a_rotation_by_more_than_half_a_turn_over_a_gap_is_counted_by_omega(rng):
    R = turning(100, 45.0)
    path = physical_path(without(seen(R, rng), range(50, 55)), times(100), SETTINGS)
    assert path.segment.tolist() == [0] * 100
    assert math.degrees(float(path.turn_rad[55].norm())) == pytest.approx(6 * 45.0, abs=2.0)
    assert_close(so3.exp(path.turn_rad[55]) @ path.R_lab_body[49], path.R_lab_body[55], 1e-9)
    shortest = so3.log(path.R_lab_body[55] @ path.R_lab_body[49].mT).norm()
    assert math.degrees(float(shortest)) < 100  # the reading that takes the shortest rotation


def test_a_whole_turn_over_a_hole_is_not_taken_for_none(rng):
    R = turning(100, 45.0)
    path = physical_path(without(seen(R, rng), range(50, 57)), times(100), SETTINGS)
    assert path.segment.tolist() == [0] * 100
    assert math.degrees(float(path.turn_rad[57].norm())) == pytest.approx(360.0, abs=5.0)
    assert not flagged(path, Flag.SPIKE)


def test_turns_are_those_from_the_orientation_before():
    R = turning(10, 5.0)
    path = physical_path(without(R, [4]), times(10), SETTINGS)
    assert torch.isnan(path.turn_rad[[0, 4]]).all()
    assert_close(so3.exp(path.turn_rad[1]), R[1] @ R[0].mT)
    assert_close(so3.exp(path.turn_rad[5]), R[5] @ R[3].mT)
    assert not torch.allclose(so3.exp(path.turn_rad[5]), R[3].mT @ R[5], atol=1e-4)  # the same rotation in body axes


@pytest.mark.parametrize("deg_per_frame", [3.7, slow(22.0)])
def test_twins_that_turn_alike_are_flagged_with_even_odds(deg_per_frame, rng):
    """A map that looks the same after half a turn about the body's z axis."""
    R = turning(150, deg_per_frame)
    twin = R @ so3.exp(torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64))
    path = physical_path(pooled(seen(R, rng), seen(twin, rng)), times(150), SETTINGS)
    assert path.present.all()
    assert len(path.choice.unique()) == 1
    assert flagged(path, Flag.AMBIGUOUS) == list(range(150))
    assert_close(path.posterior, torch.full_like(path.posterior, 0.5), 0.2)
    costs = torch.zeros(150, 2, dtype=torch.float64)
    costs[:, 0] = 0.2  # a little in every frame: over the movie it decides
    assert physical_path(pooled(R, twin, nll=costs), times(150), SETTINGS).choice.unique().tolist() == [1]


def test_pictures_decide_where_motion_cannot():
    lone = pooled(turning(1), standing(1), nll=[0.0, 1.0])
    path = physical_path(lone, times(1), SETTINGS)
    assert path.choice.tolist() == [0]
    assert float(path.posterior[0, 0] / path.posterior[0, 1]) == pytest.approx(math.e, rel=0.05)
    assert flagged(path, Flag.AMBIGUOUS) == [0]


def test_a_frame_with_a_certain_but_wrong_likelihood_is_corrected_by_the_motion(rng):
    R = turning(80, 3.7)
    nll = torch.tensor([0.0, 30.0], dtype=torch.float64).repeat(80, 1)
    nll[40] = torch.tensor([30.0, 0.0])
    path = physical_path(pooled(seen(R, rng), so3.random_rotations(80, generator=rng), nll=nll), times(80), SETTINGS)
    assert path.choice.tolist() == [0] * 80


@pytest.mark.parametrize("deg_per_frame", [0.0, 1.2, 22.0])
def test_single_candidates_are_left_as_they_are(deg_per_frame, rng):
    R = seen(turning(200, deg_per_frame), rng)
    path = physical_path(pooled(R), times(200), SETTINGS)
    assert torch.equal(path.R_lab_body, R)
    assert (path.probability > 0.99).all()
    assert path.segment.tolist() == [0] * 200
    assert not path.flags.any()


def crowded(rng: torch.Generator, frames: int = 60) -> tuple[Hypotheses, torch.Tensor]:
    """The truth in a random place among false ones, missing in some frames; scores help a little."""
    R = turning(frames, 6.0)
    every = so3.random_rotations((frames, 4), generator=rng)
    mask = torch.rand(frames, 4, generator=rng) < 0.8
    place = torch.randint(4, (frames,), generator=rng)
    row = torch.arange(frames)
    every[row, place], mask[row, place] = seen(R, rng), torch.rand(frames, generator=rng) < 0.9
    nll = 3 * torch.rand(frames, 4, generator=rng, dtype=torch.float64)
    return replace(pooled(*every.unbind(1)), nll=nll, mask=mask), R


def test_the_order_of_the_candidates_does_not_matter(rng):
    hypotheses, R = crowded(rng)
    order = torch.rand(60, 4, generator=rng).argsort(1)
    row = torch.arange(60)[:, None]
    shuffled = Hypotheses(**{name: getattr(hypotheses, name)[row, order] for name in Hypotheses.__dataclass_fields__})
    one, other = (physical_path(each, times(60), SETTINGS) for each in (hypotheses, shuffled))
    assert wrong_frames(one, R) == []
    assert_close(other.R_lab_body, one.R_lab_body)
    assert_close(other.posterior, one.posterior[row, order], 1e-6)  # the beam drops what weighs less than this
    assert torch.equal(other.flags, one.flags)


def test_the_choice_of_lab_body_time_zero_and_unit_does_not_matter(rng):
    hypotheses, _ = crowded(rng)
    R_new_lab, R_body_other = so3.random_rotations(2, generator=rng)
    moved = replace(hypotheses, R_lab_body=R_new_lab @ hypotheses.R_lab_body @ R_body_other)
    one = physical_path(hypotheses, times(60), SETTINGS)
    other = physical_path(moved, 10 * times(60) + 1000.0, SETTINGS)
    assert torch.equal(other.choice, one.choice)
    assert_close(other.posterior, one.posterior, 1e-6)
    assert_close(other.turn_rad, one.turn_rad @ R_new_lab.mT, 1e-9)
    assert float(other.acceleration_rad_s2) == pytest.approx(float(one.acceleration_rad_s2) / 100, rel=1e-6)


def test_places_that_are_not_in_use_may_hold_anything(rng):
    hypotheses, _ = crowded(rng)
    unused = ~hypotheses.mask
    filled = Hypotheses(
        R_lab_body=hypotheses.R_lab_body.masked_fill(unused[..., None, None], torch.nan),
        nll=hypotheses.nll.masked_fill(unused, torch.nan),
        variance_rad2=hypotheses.variance_rad2.masked_fill(unused, torch.nan),
        mask=hypotheses.mask,
    )
    one, other = (physical_path(each, times(60), SETTINGS) for each in (hypotheses, filled))
    assert_close(other.R_lab_body, one.R_lab_body)
    assert_close(other.posterior, one.posterior)


def test_uneven_times_are_no_change_of_omega(rng):
    """A steady rotation, sampled with steps of one to three intervals."""
    time = torch.randint(1, 4, (120,), generator=rng).cumsum(0) / RATE_HZ
    rate = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64) * 40
    R = so3.exp(time.double()[:, None] * rate)
    still = standing(120)
    path = physical_path(pooled(seen(still, rng), seen(R, rng)), time.double(), SETTINGS)
    assert path.choice.tolist() == [1] * 120
    assert not path.flags.any()


def test_the_acceleration_is_learnt_from_the_track(rng):
    frames, change = 400, math.radians(1.0)
    steps = torch.cat([torch.full((1, 3), 0.1), change * torch.randn(frames - 1, 3, generator=rng)]).double()
    turn = torch.tensor([0.2, 0.0, 0.1]) + steps.cumsum(0)
    R = [torch.eye(3, dtype=torch.float64)]
    for each in turn:
        R.append(so3.exp(each) @ R[-1])
    track = torch.stack(R)
    path = physical_path(pooled(seen(track, rng)), times(frames + 1), SETTINGS)
    learnt = path.acceleration_rad_s2 / RATE_HZ**2
    assert 0.6 * change < learnt < 1.3 * change  # the scale of a Student's t, which is less than the deviation
    given = physical_path(pooled(track), times(frames + 1), PathSettings(acceleration_rad_s2=5000.0))
    assert given.acceleration_rad_s2 == 5000.0


@pytest.mark.parametrize("gap_nats", [0.5, 30.0])
def test_runs_go_on_over_frames_whose_other_candidates_do_not_follow(rng, monkeypatch, gap_nats):
    """Every sixteenth frame has several, as after a search without history."""
    R = turning(200, 6.0)
    places = [seen(R, rng), *(so3.random_rotations(200, generator=rng) for _ in range(3))]
    mask = torch.ones(200, 4, dtype=torch.bool)
    mask[:, 1:] = (torch.arange(200) % 16 == 0)[:, None]
    nll = torch.tensor([0.0, gap_nats, gap_nats, gap_nats], dtype=torch.float64).expand(200, 4)
    hypotheses = replace(pooled(*places, mask=mask), nll=nll)
    steps = []
    one_step = beam.BeamSearch._step
    monkeypatch.setattr(beam.BeamSearch, "_step", lambda self, *given: steps.append(0) or one_step(self, *given))
    settings = SETTINGS.model_copy(update={"acceleration_rad_s2": 5000.0})
    skipping = physical_path(hypotheses, times(200), settings)
    assert len(steps) < 20
    monkeypatch.setattr(beam, "PIN_NATS", math.inf)
    searching = physical_path(hypotheses, times(200), settings)
    assert torch.equal(skipping.choice, searching.choice)
    assert_close(skipping.posterior, searching.posterior, 1e-4)
    assert_close(skipping.turn_rad, searching.turn_rad)


@pytest.mark.parametrize(("frames", "places"), [(0, 1), (1, 1), (4, 2), (3, 0), (0, 0)])
def test_a_movie_without_candidates_has_an_empty_path(frames, places):
    R = torch.eye(3, dtype=torch.float64).expand(frames, places, 3, 3)
    nothing = Hypotheses(
        R_lab_body=R,
        nll=torch.zeros(frames, places, dtype=torch.float64),
        variance_rad2=torch.zeros(frames, places, dtype=torch.float64),
        mask=torch.zeros(frames, places, dtype=torch.bool),
    )
    path = physical_path(nothing, times(frames), SETTINGS)
    assert path.choice.tolist() == [-1] * frames
    assert path.segment.tolist() == [-1] * frames
    assert path.R_lab_body.shape == (frames, 3, 3)
    assert path.R_lab_body.isnan().all()
    assert path.posterior.shape == (frames, places)
    assert not path.flags.any()


@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_a_short_movie_is_a_path(frames):
    path = physical_path(pooled(turning(frames, 5.0)), times(frames), SETTINGS)
    assert path.choice.tolist() == [0] * frames
    assert (path.probability > 0.9).all()


def test_parts_of_unequal_size_are_refused():
    hypotheses = pooled(turning(5), standing(5))
    with pytest.raises(ShapeError, match="score: expected shape"):
        physical_path(replace(hypotheses, nll=hypotheses.nll[:4]), times(5), SETTINGS)
    with pytest.raises(ShapeError, match="time_s: expected shape"):
        physical_path(hypotheses, times(4), SETTINGS)
