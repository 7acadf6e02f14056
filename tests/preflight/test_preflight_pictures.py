"""Faults of pictures, light and files are reported; the check goes on whatever an experiment lacks."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from conftest import REPO, SHARED
from preflight_examples import PAINTED, Example, checked, clean_example, complaints, of, write  # noqa: F401

from sphereorient.errors import MovieError
from sphereorient.experiment.recording import open_recording
from sphereorient.locate import LocateSettings, find_scenes
from sphereorient.methods.settings import load_settings
from sphereorient.preflight import Severity, preflight
from sphereorient.preflight.sample import sample_movie

FAULT, WARNING, OK = Severity.FAULT, Severity.WARNING, Severity.OK
PROGRAM = [sys.executable, "-m", "sphereorient.cli"]


@pytest.mark.slow
def test_without_pictures_of_the_empty_scene_it_is_learnt(clean, tmp_path):
    result = checked(clean, tmp_path, backgrounds=None)
    assert "learnt" in of(result, "background cam1").measured
    assert of(result, "ball cam1").severity is OK
    assert of(result, "lines of sight").severity is OK


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1.8, 3.0])
def test_a_saturated_movie_is_reported(clean, tmp_path, gain):
    result = checked(clean.spoilt(lambda movie: np.clip(15 + (movie - 15.0) * gain, 0, 255)), tmp_path)
    saturated = [one for one in result.findings if one.severity is not OK and "saturated" in one.measured]
    assert saturated
    assert all("expose shorter" in one.advice for one in saturated)


@pytest.mark.slow
def test_a_movie_wholly_white_is_a_fault_and_no_crash(clean, tmp_path):
    result = checked(clean.spoilt(lambda movie: np.clip(movie * 100.0, 0, 255), ("cam1",)), tmp_path)
    assert result.severity is FAULT
    assert of(result, "pictures cam1").severity is FAULT
    assert "saturated" in of(result, "pictures cam1").measured


@pytest.mark.slow
def test_a_dim_movie_is_reported(clean, tmp_path):
    dim = clean.spoilt(lambda movie: np.rint(15 + (movie - 15.0) * 0.1))
    assert of(checked(dim, tmp_path), "exposure cam1").severity is WARNING


@pytest.mark.slow
def test_movies_without_a_ball_give_one_line_a_camera(clean, tmp_path):
    def empty(movie: np.ndarray) -> np.ndarray:
        return np.clip(np.random.default_rng(1).normal(15.0, 2.0, movie.shape).round(), 0, 255)

    result = checked(clean.spoilt(empty), tmp_path, sphere=PAINTED)
    assert {one.title for one in result.findings if one.severity is not OK} == {"ball cam1", "ball cam2"}
    assert "found in 0 of" in of(result, "ball cam1").measured


def scene_alone(clean: Example, name: str, frames: int) -> np.ndarray:
    """Frames of a camera's scene without the ball."""
    empty = cv2.imread(str(clean.folder / f"empty_{name}.png"), cv2.IMREAD_GRAYSCALE)
    noise = np.random.default_rng(2).normal(0.0, 1.5, (frames, *empty.shape))
    return np.clip(empty + noise, 0, 255).round().astype(np.uint8)


def between(clean: Example, name: str, before: int, frames: slice, after: int) -> np.ndarray:
    """Frames of a camera between those of the scene without the ball."""
    ends = scene_alone(clean, name, before), scene_alone(clean, name, after)
    return np.concatenate([ends[0], clean.pictures[name][frames], ends[1]])


@pytest.mark.slow
@pytest.mark.parametrize("something", [False, True], ids=["nothing", "a faint blob"])
def test_frames_without_a_ball_are_named_and_are_not_dark(clean, tmp_path, something):
    late = replace(clean, pictures={name: between(clean, name, 30, slice(None), 10) for name in clean.pictures})
    if something:  # out of focus behind the place of the ball
        for movie in late.pictures.values():
            v, u = np.mgrid[: movie.shape[1], : movie.shape[2]]
            blob = 25.0 * np.exp(-0.5 * ((u - movie.shape[2] / 3) ** 2 + (v - movie.shape[1] / 3) ** 2) / 12.0**2)
            empty = np.r_[:30, len(movie) - 10 : len(movie)]
            movie[empty] = np.clip(movie[empty] + blob, 0, 255).astype(np.uint8)
    result = checked(late, tmp_path, sphere=PAINTED)
    assert complaints(result) == []
    measured = of(result, "ball cam1").measured
    begin, end = (int(number) for number in re.findall(r"more: (\d+) to (\d+)", measured)[0])
    assert begin == 0
    assert 25 <= end < 30
    assert measured.endswith(f"to {len(late.pictures['cam1']) - 1}")


@pytest.mark.slow
def test_a_ball_that_passes_by_in_few_frames_is_found(clean, tmp_path):
    one = replace(clean, pictures={"cam1": between(clean, "cam1", 310, slice(12), 300)})
    result = checked(one, tmp_path, sphere=PAINTED, backgrounds={"cam1": "empty_cam1.png"})
    assert result.severity is not FAULT, complaints(result)
    assert of(result, "ball cam1").severity is OK


@pytest.mark.slow
def test_a_movie_out_of_focus_is_reported(clean, tmp_path):
    soft = clean.spoilt(lambda movie: np.stack([cv2.GaussianBlur(one, (0, 0), 2.0) for one in movie]))
    assert of(checked(soft, tmp_path), "sharpness cam1").severity is WARNING


@pytest.mark.slow
def test_black_and_repeated_pictures_are_counted(clean, tmp_path):
    def spoil(movie: np.ndarray) -> np.ndarray:
        movie = movie.copy()
        movie[-1] = 0
        movie[1] = movie[0]
        return movie

    found = of(checked(clean.spoilt(spoil, ("cam2",)), tmp_path), "pictures cam2")
    assert found.severity is WARNING
    assert "1 dark" in found.measured
    assert "1 repeated" in found.measured


def test_one_camera_is_checked_alone(clean, tmp_path):
    one = replace(clean, pictures={"cam1": clean.pictures["cam1"]})
    result = checked(one, tmp_path, backgrounds={"cam1": "empty_cam1.png"})
    assert {one.title for one in result.findings if one.severity is not OK} == {"paint"}  # no map
    assert result.scans == ()


@pytest.mark.slow
def test_a_ball_of_unknown_size_is_measured_and_the_setting_named(clean, tmp_path):
    one = replace(clean, pictures={"cam1": clean.pictures["cam1"]})
    path = write(one, tmp_path, backgrounds={"cam1": "empty_cam1.png"}, sphere={"diameter": None})
    found = of(preflight(path), "size of the ball, cam1")
    assert found.severity is WARNING
    size = int(found.advice.split("diameter_px to ")[1].split()[0])
    assert size == pytest.approx(56, abs=4)
    finding = of(preflight(path, load_settings(None, [f"locate.diameter_px={size}"])), "size of the ball, cam1")
    assert finding.severity is OK


@pytest.mark.slow
def test_a_fixed_ball_is_better_off_with_pictures_without_it(clean, tmp_path):
    sphere = {"diameter": 18.0, "fixed": True}
    still = clean.spoilt(lambda movie: np.repeat(movie[:1], 12, axis=0))
    still = still.spoilt(lambda movie: movie + np.random.default_rng(0).integers(0, 3, movie.shape))
    assert of(checked(still, tmp_path / "with", sphere=sphere), "background cam1").severity is OK
    without = checked(still, tmp_path / "without", sphere=sphere, backgrounds=None)
    assert of(without, "background cam1").severity is WARNING
    assert of(without, "ball cam1").severity is OK


def test_a_fixed_ball_that_is_not_found_is_searched_where_the_mask_shows_it(clean, tmp_path):
    path = write(
        clean, tmp_path, backgrounds=None, masks={"cam1": "mask.png"}, sphere={"diameter": 18.0, "fixed": True}
    )
    mask = np.full(clean.pictures["cam1"].shape[1:], 255, np.uint8)
    mask[:20] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    with open_recording(path, textured=False) as recording:
        stream = recording.streams[0]
        sample = sample_movie(stream, None, LocateSettings(), stays=True)
        np.testing.assert_array_equal(sample.background.shown, stream.shown)


@pytest.mark.parametrize("circles", [None, {"cam1": [120.0, 120.0, 28.0]}], ids=["found", "given"])
def test_the_full_scale_of_a_fixed_ball_is_that_of_its_camera(clean, tmp_path, circles):
    """Before: 65535 for cameras of 12 bits: saturated pixels were none, and light was that of a dark picture."""
    ball = clean.pictures["cam1"][0].astype(np.uint16)
    light = np.random.default_rng(0).uniform(14.0, 30.0, (12, 1, 1)) * np.where(ball > 60, 1.0, 0.6)
    deep = np.minimum(ball * light, 4095).astype(np.uint16)
    one = replace(clean, pictures={"cam1": deep})
    keys = {"sphere": {"diameter": 18.0, "fixed": True}, "backgrounds": None, "circles": circles}
    with open_recording(write(one, tmp_path, **keys), textured=False) as recording:
        (scene,) = find_scenes(recording, recording.streams[0], 12, LocateSettings()).values()
    assert scene.background.full_scale == 4095


@pytest.mark.slow
def test_a_ball_that_one_camera_does_not_show_is_reported_of_this_camera(clean, tmp_path):
    """Before: a traceback, as more frames of this camera were read than of the other one."""

    def empty(movie: np.ndarray) -> np.ndarray:
        return scene_alone(clean, "cam2", len(movie))

    result = checked(clean.spoilt(empty, ("cam2",)), tmp_path)
    assert of(result, "ball cam1").severity is OK
    assert of(result, "ball cam2").severity is FAULT
    assert len(result.samples[0].frame) == len(result.samples[1].frame)


@pytest.mark.slow
def test_movies_of_unequal_length_are_reported(clean, tmp_path):
    result = checked(clean.spoilt(lambda movie: movie[:50], ("cam2",)), tmp_path)
    assert of(result, "frames").severity is WARNING
    assert of(result, "lines of sight").severity is OK


@pytest.mark.slow
def test_files_outside_the_folder_are_reported(clean, tmp_path):
    path = write(clean, tmp_path / "inside", cameras="../cameras.yaml")
    (tmp_path / "cameras.yaml").write_text((tmp_path / "inside" / "cameras.yaml").read_text())
    found = of(preflight(path), "files elsewhere")
    assert found.severity is WARNING
    assert "../cameras.yaml" in found.measured


def test_a_missing_movie_is_an_error_and_no_finding(clean, tmp_path):
    path = write(clean, tmp_path)
    (tmp_path / "cam2.npy").unlink()
    with pytest.raises(MovieError, match=r"cam2\.npy"):
        preflight(path)


def test_a_movie_of_a_single_frame_is_checked_without_a_crash(clean, tmp_path):
    result = checked(clean.spoilt(lambda movie: movie[:1]), tmp_path)
    assert of(result, "ball cam1").severity is OK


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["experiment", "tank", "gloss", "fixed_ball", "swarm", "cases/near_ball", "cases/sharp_pictures"]
)
def test_check_invents_no_fault_of_what_track_measures(name):
    result = preflight(SHARED / name / "experiment.yaml")
    assert result.severity is not FAULT, complaints(result)
    assert all(one.severity is OK for one in result.findings if one.title == "movies in step")


@pytest.mark.shared
@pytest.mark.slow
def test_check_looks_at_a_held_ball_as_track_does_with_any_paint(tmp_path):
    for name in ("config.txt", "sample.mp4"):
        shutil.copy(SHARED / "real" / "fictrac" / name, tmp_path)
    run = partial(subprocess.run, cwd=tmp_path, check=True, capture_output=True, text=True)
    run([*PROGRAM, "init", "--from-fictrac", "config.txt", "--set", "frame_rate=30"])
    run([*PROGRAM, "live", "experiment.yaml", "--source", "movie-fast", "--to", "p.jsonl"])  # it learns the map
    result = preflight(tmp_path / "experiment.yaml")
    assert result.severity is not FAULT, complaints(result)
    assert of(result, "ball cam1").severity is OK
    assert of(result, "size of the ball, cam1").severity is OK
    assert of(result, "map in cam1").severity is OK


@pytest.mark.slow
def test_a_truncated_movie_with_holes_is_checked_for_what_is_left(tmp_path):
    shutil.copytree(REPO / "synthetic_data" / "excerpt", tmp_path / "copy")
    path = tmp_path / "copy" / "cam1.mkv"
    damaged = bytearray(path.read_bytes())
    for hole in (len(damaged) // 3, len(damaged) // 2):
        damaged[hole : hole + 3000] = bytes(3000)
    path.write_bytes(damaged[: int(0.9 * len(damaged))])
    result = preflight(tmp_path / "copy" / "experiment.yaml")
    assert "2 undecodable" in of(result, "pictures cam1").measured
    assert "truncated" in of(result, "movie cam1").measured
    assert result.severity is WARNING
    assert of(result, "movies in step").severity is OK
