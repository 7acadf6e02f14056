"""Spikes of xi and the segments between them."""

from __future__ import annotations

import math

import pytest
import torch
from assemble_examples import noisy, single, times, turned_deg, turning
from conftest import assert_close, slow

from sphereorient import so3
from sphereorient.assemble import AssembleSettings, assemble_path
from sphereorient.assemble.segments import find_spikes, moving, number_segments

SETTINGS = AssembleSettings()


def with_wrong_frame(frames: int, at: int, deg_per_frame: float):
    R = turning(frames, deg_per_frame)
    R[at] = turned_deg(R[at], 0.0, 60.0, 0.0)
    return R


@pytest.mark.parametrize("deg_per_frame", [0.0, 1.2, 8.0])
def test_a_wrong_frame_is_a_segment_of_its_own_between_two_spikes(deg_per_frame):
    path = assemble_path(single(with_wrong_frame(60, 30, deg_per_frame)), times(60), SETTINGS)
    assert torch.nonzero(path.spike).flatten().tolist() == [30, 31]
    assert path.segment.tolist() == [0] * 30 + [1] + [2] * 29


@pytest.mark.parametrize("at", [0, 59])
def test_a_wrong_frame_at_the_end_of_a_movie_is_cut_off(at):
    path = assemble_path(single(with_wrong_frame(60, at, 1.2)), times(60), SETTINGS)
    assert int(path.spike.sum()) == 1
    assert int((path.segment == path.segment[at]).sum()) == 1


def test_a_steady_turn_has_no_spike_however_fast():
    path = assemble_path(single(turning(60, 25.0)), times(60), SETTINGS)
    assert not path.spike.any()


def test_the_first_steps_after_a_standstill_are_no_spikes():
    R = torch.cat([turning(1).expand(30, 3, 3), turning(31, 3.0)[1:]])
    assert not assemble_path(single(R), times(60), SETTINGS).spike.any()


def seen_on_a_grid(seed: int, deg_per_frame: float, wrong: slice = slice(0, 0)):
    """500 frames whose orientations are wrong by 1 degree rms, with the scatter of T that goes with it."""
    rng = torch.Generator().manual_seed(seed)
    R = noisy(turning(500, deg_per_frame), math.radians(1.0) / math.sqrt(3), rng)
    R[wrong] = turned_deg(R[wrong], 0.0, 70.0, 0.0)
    score = (0.9 + 0.02 * (2 * torch.rand(500, generator=rng) - 1)).tolist()
    return single(R, dict(enumerate(score)))


# Fast: every rotation is above the least one, so only the size of xi distinguishes noise from a spike.
@pytest.mark.parametrize("deg_per_frame", [2.0, 18.0], ids=["usual", "fast"])
@pytest.mark.parametrize("seed", [0, 1, slow(2), slow(3)])
def test_ordinary_motion_seen_on_a_grid_has_no_spike(seed, deg_per_frame):
    path = assemble_path(seen_on_a_grid(seed, deg_per_frame), times(500), SETTINGS)
    assert not path.spike.any()
    assert (path.segment == 0).all()


@pytest.mark.parametrize("deg_per_frame", [2.0, 18.0], ids=["usual", "fast"])
@pytest.mark.parametrize("length", [1, 6, 30])
def test_a_wrong_stretch_in_noise_has_a_spike_on_entering_and_one_on_leaving(length, deg_per_frame):
    wrong = slice(200, 200 + length)
    path = assemble_path(seen_on_a_grid(0, deg_per_frame, wrong), times(500), SETTINGS)
    assert torch.nonzero(path.spike).flatten().tolist() == [200, 200 + length]
    assert path.segment.tolist() == [0] * 200 + [1] * length + [2] * (300 - length)


@pytest.mark.parametrize("small_deg", [1.0, 14.0])
def test_a_small_move_after_a_standstill_is_no_spike_and_a_large_one_is(small_deg):
    R = turning(1).expand(60, 3, 3).clone()
    R[30:] = turned_deg(R[30:], small_deg, 0.0, 0.0)
    assert not assemble_path(single(R), times(60), SETTINGS).spike.any()
    R[30:] = turned_deg(R[30:], 20.0, 0.0, 0.0)
    assert torch.nonzero(assemble_path(single(R), times(60), SETTINGS).spike).flatten().tolist() == [30]


def test_spikes_are_measured_against_what_is_usual_about_them_and_not_in_the_whole_movie():
    xi, turn = torch.full((200,), 1.0), torch.full((200,), 1.0)
    xi[:100] += 0.1 * torch.sin(torch.arange(100.0))
    xi[100:] = 50.0 + 5 * torch.sin(torch.arange(100.0))
    xi[30] = 40.0  # usual in the second half, and a spike in the first
    assert torch.nonzero(find_spikes(xi, turn, SETTINGS)).flatten().tolist()[0] == 30
    assert not find_spikes(xi, turn, SETTINGS)[125:].any()


def test_several_spikes_near_each_other_do_not_hide_one_another():
    R = turning(80)
    for at in (30, 33, 36, 39):
        R[at] = turned_deg(R[at], 0.0, 45.0, 0.0)
    path = assemble_path(single(R), times(80), SETTINGS)
    assert torch.nonzero(path.spike).flatten().tolist() == [30, 31, 33, 34, 36, 37, 39, 40]


def test_a_frame_that_no_link_enters_is_no_spike():
    nothing = torch.full((5,), torch.nan)
    assert not find_spikes(nothing, nothing, SETTINGS).any()
    assert find_spikes(nothing[:0], nothing[:0], SETTINGS).shape == (0,)


def test_a_larger_factor_and_a_larger_least_turn_leave_fewer_spikes():
    xi, turn = torch.ones(50), torch.full((50,), math.radians(20.0))
    xi += 0.1 * torch.sin(torch.arange(50.0))
    xi[25] = 2.0
    assert find_spikes(xi, turn, SETTINGS).sum() == 1
    assert not find_spikes(xi, turn, AssembleSettings(spike_factor=100.0)).any()
    assert not find_spikes(xi, turn, AssembleSettings(spike_min_deg=21.0)).any()


@pytest.mark.parametrize(("hole", "bridged"), [(1, True), (4, True), (5, False), (12, False)])
def test_a_path_over_a_hole_is_one_segment_where_the_hole_is_short(hole, bridged):
    R = turning(60, 2.0)
    path = assemble_path(single(R, without=range(20, 20 + hole)), times(60), SETTINGS)
    inside, behind = (0, 0) if bridged else (-1, 1)
    assert path.segment.tolist() == [0] * 20 + [inside] * hole + [behind] * (40 - hole)
    assert not path.spike.any()
    assert_close(path.xi[20 + hole], so3.geodesic_distance(R[19], R[20 + hole]) * 600.0 / (hole + 1), 1e-9)


@pytest.mark.parametrize(("longest", "segments"), [(0, 3), (1, 2), (2, 1)])
def test_the_longest_hole_inside_a_segment_is_a_setting(longest, segments):
    without = (20, 40, 41)
    settings = AssembleSettings(gap_frames_max=longest)
    path = assemble_path(single(turning(60), without=without), times(60), settings)
    assert int(path.segment.max()) + 1 == segments
    assert (path.segment[[20]] == -1).all() == (longest < 1)


def test_a_spike_over_a_hole_leaves_the_hole_outside():
    present = torch.tensor([True, True, False, True, True])
    spike = torch.tensor([False, False, False, True, False])
    assert number_segments(present, spike, 4).tolist() == [0, 0, -1, 1, 1]


@pytest.mark.parametrize("frames", [0, 4])
def test_without_orientations_there_are_no_segments(frames):
    nothing = torch.zeros(frames, dtype=torch.bool)
    assert number_segments(nothing, nothing, 4).tolist() == [-1] * frames


@pytest.mark.parametrize(("frames", "window"), [(0, 5), (1, 5), (3, 4), (9, 5)])
def test_windows_are_centred_and_end_with_the_movie(frames, window):
    windows = moving(torch.arange(float(frames)), window)
    assert windows.shape == (frames, 5)
    for k, each in enumerate(windows):
        assert each[each.isfinite()].tolist() == [i for i in range(k - 2, k + 3) if 0 <= i < frames]
