"""Planted faults appear in the strip and the stretches, and the pictures show the ball."""

import html
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from overlay_examples import camera_changed, changed, excerpt, true_track
from PIL import Image
from scipy.spatial.transform import Rotation

from sphereorient.errors import SphereOrientError
from sphereorient.report.frame_warnings import (
    DOUBTFUL,
    GOOD,
    NO_BALL,
    NOT_VALID,
    bad_stretches,
    choose_worst,
    frame_numbers,
    status_of,
    strip_of,
)
from sphereorient.report.gallery import GAP, TILE, chosen_frames, gallery
from sphereorient.report.page import strip_assets, strip_html
from sphereorient.trajectory import CameraTrack, Flag, Reason, Trajectory

TURN = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()


def good_track(frames: int, names: tuple[str, ...] = ("cam1", "cam2"), first: int = 0) -> Trajectory:
    """A track without pictures in which nothing is wrong, 600 Hz, errors of 0.1 degree and 0.2 mm."""
    cov = np.tile(np.eye(3), (frames, 1, 1))
    right = {"reason": ("ok",) * frames, "score": np.full(frames, 0.95), "orientation": cov}
    seen = {name: replace(CameraTrack.empty(frames), **right) for name in names}
    track = Trajectory.empty((first + np.arange(frames)) / 600.0, cameras=names, frame_rate=600.0, experiment="planted")
    covs = {"orientation_cov": cov * np.deg2rad(0.1) ** 2, "position_cov": cov * 0.04}
    return replace(track, valid=np.ones(frames, bool), cameras=seen, **covs)


def troubled() -> Trajectory:
    """Of 300 frames: 60 .. 79 not valid, 85 and 200 with flags, 120 .. 122 lost by one camera."""
    track = changed(good_track(300), slice(60, 80), valid=False, orientation_cov=np.nan, position_cov=np.nan)
    track = camera_changed(track, "cam1", slice(60, 80), reason=Reason.DARK, score=np.nan, orientation=np.nan)
    track = camera_changed(track, "cam2", slice(60, 70), reason=Reason.OUTLINE, score=np.nan, orientation=np.nan)
    track = changed(track, 85, flags=Flag.SPIKE)
    track = changed(track, 200, flags=Flag.SPIKE | Flag.RECOVERED)
    return camera_changed(track, "cam2", slice(120, 123), reason=Reason.LOW_SCORE)


def test_stretches_are_the_planted_ones_longest_first_with_their_reasons_counted():
    found = bad_stretches(troubled())
    assert [(one.first, one.last, one.doubtful, one.not_valid) for one in found] == [
        (60, 85, 1, 20),  # five good frames between the gap and the spike
        (120, 122, 3, 0),
        (200, 200, 1, 0),
    ]
    assert [one.frames for one in found] == [26, 3, 1]
    assert found[0].reasons == (("cam1: too dark", 20), ("cam2: no clear outline", 10), ("the orientation jumps", 1))
    assert found[1].reasons == (("cam2: no orientation explains the picture", 3),)
    assert dict(found[2].reasons) == {"found again after a loss": 1, "the orientation jumps": 1}


@pytest.mark.parametrize(("second", "count"), [(19, 1), (20, 1), (21, 2)])
def test_ten_good_frames_between_part_two_stretches_and_nine_do_not(second, count):
    track = changed(changed(good_track(40), 10, flags=Flag.SPIKE), second, flags=Flag.SPIKE)
    assert len(bad_stretches(track)) == count


def test_frames_without_a_ball_are_neither_doubtful_nor_lost():
    track, away = good_track(60), slice(0, 20)
    for name in ("cam1", "cam2"):
        track = camera_changed(track, name, away, reason=Reason.NOT_FOUND, score=np.nan)
    track = camera_changed(track, "cam1", slice(20, 23), reason=Reason.NOT_FOUND, score=np.nan)  # cam2 sees it
    track = changed(track, away, valid=False)
    assert status_of(track)[away].tolist() == [NO_BALL] * 20
    assert status_of(track)[20:23].tolist() == [DOUBTFUL] * 3
    assert [(one.first, one.last) for one in bad_stretches(track)] == [(20, 22)]
    assert 0 not in choose_worst(track, 20)
    assert track.summary()["no_ball"] == 20
    assert track.summary()["lost"] == {"cam1": {"not_found": 3}, "cam2": {}}


def test_the_strip_shows_of_every_frame_what_was_planted():
    track = camera_changed(troubled(), "cam1", 5, score=0.6)
    track = camera_changed(track, "cam1", 7, orientation=TURN)
    strip = strip_of(track)
    status = np.zeros(300, int)
    status[[85, 120, 121, 122, 200]] = DOUBTFUL
    status[60:80] = NOT_VALID
    assert strip["status"] == status.tolist()
    assert strip["counts"] == [275, 0, 5, 20]
    assert strip["number"] == strip["row"] == list(range(300))
    reasons = strip["reason_words"]
    words = {camera["name"]: [reasons[code] for code in camera["reason"]] for camera in strip["cameras"]}
    assert words["cam1"] == ["measured"] * 60 + ["too dark"] * 20 + ["measured"] * 220
    assert set(words["cam2"][60:70]) == {"no clear outline"}
    assert set(words["cam2"][70:80]) == {"measured"}
    assert words["cam2"][121] == "no orientation explains the picture"
    flags = dict(strip["flag_words"])
    planted = {"found again after a loss", "the orientation jumps"}
    assert {flags[bit] for bit in flags if strip["flags"][200] & bit} == planted
    assert [k for k in range(300) if strip["flags"][k]] == [85, 200]
    assert strip["cameras"][0]["score"][5] == 0.6
    assert strip["cameras"][0]["score"][61] is None
    assert strip["orientation_error_deg"][0] == 0.1
    assert strip["position_error"][0] == 0.2
    assert strip["orientation_error_deg"][61] is None
    assert strip["apart_deg"][7] == pytest.approx(np.rad2deg(0.1), rel=1e-3)
    assert strip["apart_deg"][8] == 0.0


@pytest.mark.parametrize("frames", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_one_bad_frame_of_a_million_survives(frames):
    bad, per_bin = frames * 7 // 9, frames // 20_000
    track = changed(good_track(frames), bad, valid=False, flags=Flag.AMBIGUOUS)
    track = camera_changed(track, "cam2", bad, reason=Reason.DARK, score=0.2, orientation=TURN)
    cov = np.array(track.orientation_cov)
    cov[bad] *= 900
    strip = strip_of(replace(track, orientation_cov=cov))
    assert strip["per_bin"] == per_bin
    assert len(strip["status"]) == 20_000
    place = bad // per_bin
    assert [k for k, status in enumerate(strip["status"]) if status] == [place]
    assert strip["number"][place] == strip["row"][place] == bad
    assert strip["time_s"][place] == pytest.approx(bad / 600)
    assert strip["orientation_error_deg"][place] == 3.0
    assert strip["cameras"][1]["score"][place] == 0.2
    assert strip["cameras"][0]["score"][place] == 0.95
    assert strip["reason_words"][strip["cameras"][1]["reason"][place]] == "too dark"
    assert strip["flags"][place] == Flag.AMBIGUOUS
    assert strip["apart_deg"][place] == pytest.approx(np.rad2deg(0.1), rel=1e-3)
    assert [(one.first, one.frames) for one in bad_stretches(track)] == [(bad, 1)]


def test_the_last_bin_may_be_shorter_and_a_gap_in_a_bin_hides_no_error():
    track = changed(good_track(20_001), 20_000, valid=False)
    track = changed(track, 4, orientation_cov=np.nan)
    strip = strip_of(track)
    assert (strip["per_bin"], len(strip["status"])) == (2, 10_001)
    assert (strip["status"][-1], strip["row"][-1]) == (NOT_VALID, 20_000)
    assert strip["orientation_error_deg"][2] == 0.1


def test_numbers_are_the_experiments():
    assert strip_of(good_track(30, first=100))["number"][:2] == [100, 101]
    uneven = replace(good_track(4), time=np.array([0.0, 0.0013, 0.0022, 0.0051]))
    assert frame_numbers(uneven).tolist() == [0, 1, 2, 3]


def test_one_camera_only_is_no_doubt_where_there_is_no_other():
    alone = changed(good_track(30, ("cam1",)), slice(None), flags=Flag.ONE_CAMERA)
    assert bad_stretches(alone) == []
    assert set(strip_of(alone)["flags"]) == {0}
    assert strip_of(alone)["apart_deg"] is None
    of_two = changed(good_track(30), slice(None), flags=Flag.ONE_CAMERA)
    assert bad_stretches(of_two)[0].reasons == (("one camera only", 30),)


@pytest.mark.parametrize("frames", [0, 1, 50])
def test_nothing_measured_is_json_and_a_page(frames):
    track = Trajectory.empty(np.arange(frames) / 600.0, cameras=("cam1",))
    text = json.dumps(strip_of(track), allow_nan=False)
    assert json.loads(text)["counts"] == [0, frames, 0, 0]  # no ball was found
    assert "Quality of every frame" in strip_html("empty", track, None)


def data_of(page: str) -> dict[str, object]:
    """The data of a section as a browser finds it: up to the first end of a script."""
    start = page.index('<script type="application/json">') + len('<script type="application/json">')
    return json.loads(page[start : page.index("</script", start)], parse_constant=pytest.fail)


def test_a_hostile_name_stays_a_name():
    name = '</script><img src=x onerror=alert(1)> & "quoted"'
    track = replace(troubled(), experiment=name)
    track = replace(track, cameras={name: track.cameras["cam1"], "cam2": track.cameras["cam2"]})
    page = strip_html(name, track, None)
    assert "<img" not in page
    assert page.count("</script>") == 1
    assert data_of(page)["name"] == name
    assert html.escape("</script><img src=x") in page


def test_the_page_has_no_number_that_json_lacks_and_a_row_a_stretch():
    page = strip_html("planted", troubled(), None)
    assert len(data_of(page)["status"]) == 300
    rows = r'<tr data-first="(\d+)" data-last="(\d+)"'
    assert re.findall(rows, page) == [("60", "85"), ("120", "122"), ("200", "200")]
    assert "cam1: too dark (20); cam2: no clear outline (10); the orientation jumps (1)" in page


def test_style_and_script_load_nothing_from_elsewhere():
    for text in strip_assets():
        assert len(text) > 1000
        assert not re.search(r"https?:|@import|url\(|fetch\(|</", text)


def lost_excerpt() -> Trajectory:
    """The excerpt, 40 frames, of which 20 .. 27 are not valid and lack a position, and 5 is flagged."""
    track = changed(true_track(), slice(20, 28), valid=False)
    track = camera_changed(track, "cam1", slice(20, 28), reason=Reason.DARK)
    return changed(track, 5, flags=Flag.SPIKE)


def test_pictures_are_of_the_bad_frames_and_of_good_ones_between():
    track = changed(changed(good_track(3000), slice(1000, 1400), valid=False), 2500, flags=Flag.SPIKE)
    why = chosen_frames(track, 60)
    assert len(why) == 60
    assert "the orientation jumps" in why[2500]
    assert why[1000][0].startswith("gap of 400 frames")
    bad = [k for k in why if 1000 <= k < 1400]
    good = sorted(k for k, words in why.items() if words == ("good; to compare with",))
    assert len(bad) > 20
    assert len(good) >= 20
    assert np.diff([1000, *sorted(bad), 1400]).max() < 40
    assert np.diff([0, *good, 3000]).max() < 600  # the stretch of 400 has none
    assert next(iter(why)) in bad


@pytest.mark.parametrize("count", [0, 1, 2, 7, 500])
def test_there_are_not_more_pictures_than_given_by_the_option_and_the_first_is_of_the_worst(count):
    why = chosen_frames(lost_excerpt(), count)
    assert len(why) == min(count, 40)
    assert not count or 20 <= next(iter(why)) < 28


def test_a_track_without_trouble_is_shown_evenly_after_its_lowest_score():
    track = camera_changed(good_track(1000), "cam2", 630, score=0.94)
    why = chosen_frames(track, 11)
    (worst, words), *others = why.items()
    assert worst == 630
    assert "cam2: score 0.940, usually 0.950" in words
    rows = sorted(k for k, _ in others)
    assert len(rows) == 10
    assert max(np.diff(rows)) <= 101


def test_the_page_begins_with_the_worst_frame_and_its_reason():
    page = strip_html("planted", troubled(), None)
    first = re.search(r'data-first="(\d+)".*?</p>', page, re.DOTALL)
    assert first[1] == "60"
    assert "0.1000&thinsp;–&thinsp;0.1417" in page  # s, of the first stretch
    assert "gap of 20 frames begins: cam1: too dark, cam2: no clear outline" in first[0]
    assert first.start() < page.index("strip__main") < page.index("strip__stretches") < page.index("strip__overview")


@pytest.mark.slow
def test_the_pictures_show_the_ball_within_its_outline():
    track, calls = lost_excerpt(), []
    shown = gallery(track, excerpt(), count=6, progress=lambda done, total: calls.append((done, total)))
    rows = [frame.k for frame in shown.frames]
    assert 5 in rows
    assert any(20 <= k < 28 for k in rows)
    assert sum(track.valid[k] and k != 5 for k in rows) >= 2
    assert calls == [(done, 6) for done in range(1, 7)]
    assert set(status_of(track)[rows]) == {GOOD, DOUBTFUL, NOT_VALID}
    assert shown.numbers.tolist() == list(range(len(track)))
    assert rows == list(chosen_frames(track, 6))
    for frame in shown.frames:
        picture = np.asarray(Image.open(io.BytesIO(frame.jpeg)).convert("L"), np.float64)
        assert picture.shape == (TILE, 4 * (TILE + GAP) - GAP) == shown.size[::-1]
        v, u = np.mgrid[:TILE, :TILE]
        radius = np.hypot(u - TILE / 2, v - TILE / 2) / (TILE / 2 / 1.3)  # a crop is 1.3 radii wide
        for left in range(0, picture.shape[1], TILE + GAP):
            tile = picture[:, left : left + TILE]
            assert tile[radius < 0.85].mean() > 2 * tile[(radius > 1.1) & (v > 30)].mean()
            assert tile[radius < 0.85].std() > 20  # painted


@pytest.mark.slow
def test_the_page_holds_the_pictures_and_why_they_are_there():
    shown = gallery(lost_excerpt(), excerpt(), count=15)
    page = strip_html("excerpt", lost_excerpt(), shown)
    assert page.count("data:image/jpeg;base64,") == 15
    assert page.index("frame 5</b>") > 0
    assert "3 more pictures" in page
    assert "doubtful; alone among good ones; the orientation jumps" in page


def test_a_movie_that_cannot_be_opened_is_not_passed_over(tmp_path):
    gone = replace(excerpt(), movie_paths=dict.fromkeys(excerpt().movie_paths, tmp_path / "gone.mkv"))
    with pytest.raises(SphereOrientError, match=r"gone\.mkv"):
        gallery(true_track(), gone, count=3)
