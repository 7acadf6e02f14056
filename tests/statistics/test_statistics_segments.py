from dataclasses import replace

import numpy as np
import pytest
from statistics_examples import STEP_S, holds, track

from sphereorient.errors import TrackError
from sphereorient.statistics.segments import durations, ensemble_of
from sphereorient.statistics.settings import SegmentSettings
from sphereorient.trajectory import Flag, Trajectory


def test_short_segments_are_left_out_and_the_others_numbered_anew():
    found = ensemble_of(track([60, 49, 50, 3, 80]))
    assert np.bincount(found.segment).tolist() == [60, 50, 80]
    assert np.diff(found.starts).tolist() == [60, 50, 80]
    np.testing.assert_allclose(found.span_s, np.array([60, 50, 80]) * STEP_S)


def test_segments_shorter_than_a_quarter_of_the_integral_time_are_left_out():
    settings = SegmentSettings(integral_time_s=4 * 69.5 * STEP_S)
    assert np.bincount(ensemble_of(track([60, 70, 80]), settings).segment).tolist() == [70, 80]


def test_extrapolated_frames_leave_a_gap_in_time_unless_kept():
    whole = track([60, 60])
    flags = whole.flags.copy()
    flags[5:8] = Flag.EXTRAPOLATED
    marked = replace(whole, flags=flags)
    found = ensemble_of(marked)
    assert len(found) == 117
    assert found.frame[4:6].tolist() == [4, 8]
    assert len(ensemble_of(marked, SegmentSettings(keep_extrapolated=True))) == 120


def test_frames_without_a_motion_do_not_count():
    whole = track([60, 60])
    alpha = whole.alpha_lab.copy()
    alpha[:4] = np.nan
    found = ensemble_of(replace(whole, alpha_lab=alpha))
    assert len(found) == 116
    assert all(np.isfinite(x).all() for x in found.values.values())


def test_equal_numbers_of_segments_in_two_tracks_are_different_segments():
    found = ensemble_of([track([60, 70]), track([80])])
    assert np.bincount(found.segment).tolist() == [60, 70, 80]
    assert found.track.tolist() == [0, 0, 1]


def test_uneven_times_round_to_the_nearest_frame():
    whole = track([60, 60])
    rng = np.random.default_rng(0)
    time = whole.time + 0.1 * STEP_S * rng.uniform(-1, 1, len(whole))
    found = ensemble_of(replace(whole, time=time))
    assert found.frame[:60].tolist() == list(range(60))


def test_part_of_an_ensemble_has_the_segments_in_order():
    whole = ensemble_of(track([60, 70, 80]))
    part = whole.at(np.array([True, False, True]))
    assert np.bincount(part.segment).tolist() == [60, 80]
    np.testing.assert_array_equal(part.values["velocity"][60:], whole.values["velocity"][130:])


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (track([60, 20]), "at least two segments"),
        ([], "no valid frame"),
        (Trajectory.empty(np.arange(5.0)), "no valid frame"),
        ([track([60, 60]), track([60, 60], method="paper")], "one method"),
    ],
)
def test_an_impossible_sample_is_refused_in_one_line(tracks, words):
    with pytest.raises(TrackError, match=words) as caught:
        ensemble_of(tracks)
    assert "\n" not in str(caught.value)


def test_a_smoothers_sigma_is_what_it_removed_and_a_kernels_what_it_let_through():
    assert ensemble_of(track([60, 60])).error == "removed"
    assert ensemble_of(track([60, 60], method="paper")).error == "added"


def test_frames_with_errors_far_above_the_usual_are_left_out_and_the_segment_keeps_its_duration():
    whole = track([60, 60])
    sigma = whole.alpha_lab_sigma.copy()
    sigma[:2] *= 3.1
    sigma[57:60] = np.nan  # not known: no reason to leave it out
    found = ensemble_of(replace(whole, alpha_lab_sigma=sigma))
    assert len(found) == 118
    assert found.frame[:3].tolist() == [2, 3, 4]
    np.testing.assert_allclose(found.span_s, 60 * STEP_S)
    assert len(ensemble_of(replace(whole, alpha_lab_sigma=sigma), SegmentSettings(max_sigma=3.2))) == 120


def test_errors_of_the_acceleration_count_as_well():
    whole = track([60, 60])
    sigma = whole.acceleration_sigma.copy()
    sigma[70:80] *= 5
    assert len(ensemble_of(replace(whole, acceleration_sigma=sigma))) == 110


def test_long_segments_are_cut_into_equal_pieces():
    found = ensemble_of(track([600, 60]), SegmentSettings(max_duration_s=200 * STEP_S))
    assert np.bincount(found.segment).tolist() == [200, 200, 200, 60]
    assert found.frame[200] == 0
    assert found.time_s[200] - found.time_s[199] == pytest.approx(STEP_S)
    assert (found.span_s <= 201 * STEP_S).all()


def test_frames_without_a_motion_cannot_be_cut():
    """Before: an IndexError."""
    still = replace(track([60]), velocity=np.full((62, 3), np.nan))
    assert len(ensemble_of(still, SegmentSettings(max_duration_s=20 * STEP_S), fewest=0)) == 0


def test_an_ensemble_of_one_segment_only_by_its_option():
    with pytest.raises(TrackError, match=r"two segments.*got 1.*max_duration_s"):
        ensemble_of(track([60]))
    assert ensemble_of(track([60]), fewest=1).segments == 1
    with pytest.raises(TrackError, match="at least one segment"):
        ensemble_of(track([40]), fewest=1)


def test_decay_time_of_truncated_durations_and_its_interval():
    rng = np.random.default_rng(1)
    held, means = 0, []
    for _ in range(500):
        found = durations(0.08 + rng.exponential(0.15, 40), 0.08)
        held += bool(holds(found.decay_time_s, 0.15))
        means.append(float(found.decay_time_s.value))
    assert 0.92 <= held / 500 <= 0.98
    assert np.mean(means) == pytest.approx(0.15, rel=0.02)


def test_every_duration_is_counted_and_the_law_expects_nearly_as_many():
    span = 0.08 + np.random.default_rng(2).exponential(0.15, 3000)
    found = durations(span, 0.08)
    assert found.counts.sum() == found.segments == 3000
    assert found.expected.sum() == pytest.approx(3000, rel=0.01)
    assert np.abs(found.counts - found.expected)[:5].max() < 5 * np.sqrt(found.expected[0])


def test_shorter_durations_do_not_count():
    assert durations(np.array([0.01, 0.2, 0.3]), 0.1).segments == 2
    with pytest.raises(TrackError, match="two segments"):
        durations(np.array([0.01, 0.2]), 0.1)
