"""Repair of the track in the picture: wrong frames replaced, short gaps filled, each flagged; all else untouched."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from locate_examples import SETTINGS, sightings
from torch import Tensor

from sphereorient.locate import LocateSettings, fill_gaps
from sphereorient.locate.sightings import known_stretches
from sphereorient.trajectory import Flag, Reason

N = 120
REPLACED, INTERPOLATED = int(Flag.POSITION_OUTLIER_REPLACED), int(Flag.POSITION_INTERPOLATED)


def path(frames: int = N, noise_px: float = 0.2, seed: int = 0) -> Tensor:
    """A smooth path through the picture with the noise of an outline, (N, 2) px."""
    k = torch.arange(frames, dtype=torch.float64)
    smooth = torch.stack([300 + 90 * torch.sin(k / 25), 280 + 70 * torch.cos(k / 31 + 0.4)], dim=1)
    noise = torch.randn(frames, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return smooth + noise_px * noise


def without(centre_px: Tensor, *lost: int) -> Tensor:
    out = centre_px.clone()
    out[list(lost)] = torch.nan
    return out


def with_outliers(centre_px: Tensor, *wrong: int, by: tuple[float, float] = (7.0, -4.0)) -> Tensor:
    out = centre_px.clone()
    out[list(wrong)] += torch.tensor(by, dtype=torch.float64)
    return out


@pytest.mark.parametrize("by", [(7.0, -4.0), (0.0, 5.0), (-60.0, 0.0)])
def test_outliers_are_replaced_and_flagged(by):
    wrong = [20, 55, 56, 90]
    fixed = fill_gaps(sightings(with_outliers(path(), *wrong, by=by)), SETTINGS)
    assert torch.nonzero(fixed.flags)[:, 0].tolist() == wrong
    assert (fixed.flags[wrong] == REPLACED).all()
    assert ((fixed.centre_px - path(noise_px=0.0)).norm(dim=1)[wrong] < 0.6).all()
    assert fixed.outline_rms_px[wrong].isnan().all()
    assert fixed.covariance_px2[wrong].isnan().all()
    assert all(fixed.reason[k] is Reason.OUTLINE for k in wrong)


def test_an_outlier_of_the_radius_is_one():
    radius = torch.full((N,), 39.0, dtype=torch.float64)
    radius[40] = 46.0
    fixed = fill_gaps(sightings(path(), radius_px=radius), SETTINGS)
    assert torch.nonzero(fixed.flags)[:, 0].tolist() == [40]
    assert abs(fixed.radius_px[40] - 39.0) < 0.5


def test_measured_values_stay_to_the_last_bit():
    wrong, lost = [30, 70], [50, 51]
    seen = sightings(without(with_outliers(path(), *wrong), *lost), radius_px=39 + 0.1 * torch.rand(N).double())
    before = [part.clone() for part in (seen.centre_px, seen.radius_px, seen.covariance_px2, seen.flags)]
    fixed = fill_gaps(seen, SETTINGS)
    kept = [k for k in range(N) if k not in wrong + lost]
    for name in ("centre_px", "radius_px", "outline_rms_px", "coverage", "covariance_px2", "flags"):
        assert torch.equal(getattr(fixed, name)[kept], getattr(seen, name)[kept]), name
    assert [fixed.reason[k] for k in kept] == [Reason.OK] * len(kept)
    after = [seen.centre_px, seen.radius_px, seen.covariance_px2, seen.flags]
    for old, new in zip(before, after, strict=True):  # the input is not written into
        torch.testing.assert_close(new, old, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("length", [1, 2, 3, 4])
def test_short_gaps_are_filled_and_flagged(length):
    lost = list(range(60, 60 + length))
    fixed = fill_gaps(sightings(without(path(), *lost)), SETTINGS)
    assert torch.nonzero(fixed.flags)[:, 0].tolist() == lost
    assert (fixed.flags[lost] == INTERPOLATED).all()
    assert ((fixed.centre_px - path(noise_px=0.0)).norm(dim=1)[lost] < 0.8).all()
    assert fixed.radius_px[lost].isfinite().all()
    assert fixed.outline_rms_px[lost].isnan().all()
    assert all(fixed.reason[k] is Reason.NOT_FOUND for k in lost)
    assert fixed.placed.all()


@pytest.mark.parametrize("length", [5, 6, 30])
def test_longer_gaps_stay_empty(length):
    """The paper: under five frames."""
    lost = list(range(60, 60 + length))
    fixed = fill_gaps(sightings(without(path(), *lost)), SETTINGS)
    assert fixed.centre_px[lost].isnan().all()
    assert fixed.radius_px[lost].isnan().all()
    assert (fixed.flags == 0).all()
    assert fixed.placed.sum() == N - length


def test_the_longest_gap_is_a_setting():
    seen = sightings(without(path(), *range(60, 66)))
    assert fill_gaps(seen, LocateSettings(gap_frames_max=6)).placed.all()
    assert fill_gaps(sightings(without(path(), 60)), LocateSettings(gap_frames_max=0)).placed.sum() == N - 1


def test_a_gap_is_filled_between_its_neighbours_without_overshoot():
    lost = [60, 61, 62]
    fixed = fill_gaps(sightings(without(path(), *lost)), SETTINGS)
    for axis in range(2):
        low, high = sorted(fixed.centre_px[[59, 63], axis].tolist())
        assert ((fixed.centre_px[lost, axis] >= low) & (fixed.centre_px[lost, axis] <= high)).all()


@pytest.mark.parametrize("frames", [0, 1, 5])
def test_a_sphere_that_is_never_seen_is_no_error(frames):
    fixed = fill_gaps(sightings(torch.full((frames, 2), torch.nan)), SETTINGS)
    assert len(fixed) == frames
    assert not fixed.placed.any()


@pytest.mark.parametrize("frames", [1, 2, 8, 15])
def test_tracks_too_short_to_judge_are_untouched(frames):
    seen = sightings(with_outliers(path(frames), frames // 2, by=(30.0, 0.0)))
    fixed = fill_gaps(seen, SETTINGS)
    assert torch.equal(fixed.centre_px, seen.centre_px)
    assert (fixed.flags == 0).all()


def test_gaps_of_short_tracks_are_filled_nevertheless():
    fixed = fill_gaps(sightings(without(path(8), 3, 4)), SETTINGS)
    assert fixed.flags.tolist() == [0, 0, 0, INTERPOLATED, INTERPOLATED, 0, 0, 0]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("period", [40.0, 60.0, 100.0])
def test_fast_motion_makes_no_outliers(period, seed):
    """1 px/frame^2 all along a wave: 24 m/s^2 at the paper's scale, four times its rms."""
    k = torch.arange(240, dtype=torch.float64)
    omega = 2 * torch.pi / period
    wave = torch.stack([torch.sin(omega * k), torch.cos(omega * k)], dim=1) / omega**2
    noise = torch.randn(240, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    fixed = fill_gaps(sightings(300 + wave + 0.2 * noise), SETTINGS)
    assert (fixed.flags == 0).all()


def test_an_outlier_at_either_end_is_replaced():
    fixed = fill_gaps(sightings(with_outliers(path(), 0, N - 1)), SETTINGS)
    assert torch.nonzero(fixed.flags)[:, 0].tolist() == [0, N - 1]
    assert ((fixed.centre_px - path(noise_px=0.0)).norm(dim=1)[[0, N - 1]] < 2.0).all()


def test_an_outlier_beside_a_gap_does_not_change_the_values_in_the_gap():
    fixed = fill_gaps(sightings(without(with_outliers(path(), 62), 60, 61)), SETTINGS)
    assert (fixed.flags[60:62] == INTERPOLATED).all()
    assert fixed.flags[62] == REPLACED
    assert ((fixed.centre_px - path(noise_px=0.0)).norm(dim=1)[60:63] < 1.0).all()


def test_flags_that_were_there_stay():
    flags = torch.zeros(N, dtype=torch.int64)
    flags[5] = int(Flag.ONE_CAMERA)
    assert fill_gaps(sightings(path(), flags=flags), SETTINGS).flags[5] == int(Flag.ONE_CAMERA)


@given(st.lists(st.booleans(), max_size=40), st.integers(0, 5))
@settings(max_examples=60, deadline=None)
def test_known_stretches_hold_every_known_frame_once_and_no_long_hole(known, gap):
    parts = known_stretches(np.array(known, bool), gap)
    covered = np.concatenate([*parts, np.zeros(0, int)])
    assert set(np.flatnonzero(known)) <= set(covered)
    assert len(set(covered)) == len(covered)
    for part in parts:
        at = np.flatnonzero(np.array(known)[part])
        assert known[part[0]]
        assert known[part[-1]]
        assert (np.diff(at) <= gap + 1).all()
    for one, two in pairwise(parts):
        assert two[0] - one[-1] > gap + 1
