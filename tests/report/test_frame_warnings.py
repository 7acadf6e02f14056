"""The sheet of the worst frames shows planted faults with their reasons."""

import numpy as np
import pytest
from overlay_examples import camera_changed, changed, excerpt, true_track
from scipy.spatial.transform import Rotation

from sphereorient.errors import OutputError
from sphereorient.report.frame_warnings import APART_FRAMES, choose_worst
from sphereorient.report.gallery import worst_frames
from sphereorient.trajectory import Flag, Reason, Trajectory

TURN = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()


def lost(track: Trajectory, rows: slice, why: Reason = Reason.OUTLINE) -> Trajectory:
    track = changed(track, rows, valid=False, position=np.nan, orientation=np.nan)
    for name in track.cameras:
        track = camera_changed(track, name, rows, reason=why, centre_px=np.nan, radius_px=np.nan, score=np.nan)
    return track


def in_words(bad: dict[int, tuple[str, ...]]) -> dict[int, str]:
    return {k: "; ".join(words) for k, words in bad.items()}


def test_a_gap_is_shown_at_both_edges_with_its_length_and_reason():
    words = in_words(choose_worst(lost(true_track(), slice(10, 18)), 4))
    assert words[10] == "gap of 8 frames begins: cam1: no clear outline, cam2: no clear outline"
    assert words[18].startswith("first frame after a gap of 8 frames")


def test_a_gap_at_the_end_has_no_frame_after_it():
    words = in_words(choose_worst(lost(true_track(), slice(30, 40)), 40))
    assert "gap of 10 frames" in words[30]
    assert max(words) < 40


def test_every_kind_of_trouble_is_among_the_first():
    track = lost(true_track(), slice(30, 36))
    track = changed(track, 5, flags=Flag.SPIKE)
    track = camera_changed(track, "cam1", 10, orientation=TURN @ track.orientation[10])
    track = camera_changed(track, "cam2", 15, score=0.6)
    track = changed(track, 20, orientation=TURN @ track.orientation[20])
    cov = np.broadcast_to(1e-6 * np.eye(3), (40, 3, 3)).copy()
    cov[25] *= 400
    track = changed(track, slice(None), orientation_cov=cov)
    words = in_words(choose_worst(track, 7))
    assert set(words) == {5, 10, 15, 20, 25, 30, 36}
    assert words[5] == "the orientation jumps"
    assert words[10] == "cameras 5.7° apart, usually 0°"
    assert words[15].startswith("cam2: score 0.600, usually 0.95")
    assert "5.7° from the smooth motion" in words[20]
    assert words[25] == "stated error of the orientation 1.1°, usually 0.057°"


def test_many_gaps_do_not_hide_a_spike():
    track = true_track()
    for first in range(8, 40, 4):
        track = lost(track, slice(first, first + 1))
    track = changed(track, 3, flags=Flag.SPIKE)
    assert 3 in in_words(choose_worst(track, 2))


def test_the_lowest_score_of_a_run_of_one_flag_is_shown():
    track = changed(true_track(), slice(12, 19), flags=Flag.DOUBTFUL_FIT)
    track = camera_changed(track, "cam1", 16, score=0.9)
    assert list(choose_worst(track, 1)) == [16]


def test_undoubted_frames_are_not_called_bad():
    bad = choose_worst(true_track(), 5)
    assert len(bad) == 5
    assert next(iter(bad)) == 0  # the lowest score, as planted
    assert all(words.startswith("not in doubt; among the lowest scores") for found in bad.values() for words in found)


@pytest.mark.parametrize("count", [1, 6, 500])
def test_frames_are_apart_and_not_more_than_the_option_allows(count):
    track = changed(true_track(), slice(0, 40), flags=np.arange(40) % 5 == 0)
    rows = sorted(choose_worst(track, count))
    assert 1 <= len(rows) <= count
    assert all(np.diff(rows) >= APART_FRAMES)


def test_nothing_measured_and_nothing_there():
    empty = Trajectory.empty(np.arange(30) / 600.0, cameras=("cam1", "cam2"))
    assert list(choose_worst(empty, 9)) == [0]
    assert choose_worst(Trajectory.empty(np.zeros(0)), 9) == {}


def test_a_name_that_is_no_pictures_is_refused(tmp_path):
    with pytest.raises(OutputError, match=r"--worst .*got '\.txt'"):
        worst_frames(true_track(), excerpt(), tmp_path / "sheet.txt")
