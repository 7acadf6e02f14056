"""The check names planted faults of cameras and their remedy; a clean experiment gets no finding."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from preflight_examples import PAINTED, Example, checked, clean_example, complaints, of, write  # noqa: F401

from sphereorient.preflight import Severity, preflight

FAULT, WARNING, OK = Severity.FAULT, Severity.WARNING, Severity.OK


@pytest.mark.slow
def test_a_clean_experiment_raises_no_complaint(clean, tmp_path):
    result = checked(clean, tmp_path, sphere=PAINTED)
    assert complaints(result) == []
    assert result.severity is OK


@pytest.mark.slow
@pytest.mark.parametrize(("late", "start"), [("cam2", "{cam1: 0, cam2: 2}"), ("cam1", "{cam1: 2, cam2: 0}")])
def test_a_movie_that_began_two_frames_early_is_found_and_the_start_that_mends_it(clean, tmp_path, late, start):
    other = "cam1" if late == "cam2" else "cam2"
    pictures = {late: clean.pictures[late][:-2], other: clean.pictures[other][2:]}
    early = replace(clean, pictures={name: pictures[name] for name in clean.pictures})
    result = checked(early, tmp_path / "early")
    found = of(result, "movies in step")
    assert found.severity is FAULT
    assert start in found.advice
    assert of(result, "lines of sight").severity is OK  # once they are in step: no fault of the cameras
    mended = checked(early, tmp_path / "mended", start=yaml.safe_load(start), frames=[0, 60])
    assert of(mended, "movies in step").severity is OK


@pytest.mark.slow
def test_a_wrong_start_is_put_right(clean, tmp_path):
    found = of(checked(clean, tmp_path, start={"cam1": 1, "cam2": 4}), "movies in step")
    assert found.severity is FAULT
    assert "{cam1: 1, cam2: 1}" in found.advice


@pytest.mark.slow
def test_a_ball_at_rest_does_not_give_the_step(clean, tmp_path):
    def rest(movie: np.ndarray) -> np.ndarray:
        return movie[:1] + np.arange(len(movie))[:, None, None] % 2  # or the pictures would be repeated ones

    still = clean.spoilt(rest)
    found = of(checked(still, tmp_path), "movies in step")
    assert found.severity is OK
    assert "unknown" in found.measured


def turned(folder: Path, name: str, deg: float) -> None:
    """Rotate a camera about its vertical axis, as a knock does."""
    document = yaml.safe_load((folder / "cameras.yaml").read_text())
    camera = document["cameras"][name]
    c, s = np.cos(np.deg2rad(deg)), np.sin(np.deg2rad(deg))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    camera["R"] = (turn @ np.array(camera["R"])).tolist()
    camera["T"] = (turn @ np.array(camera["T"])).tolist()
    (folder / "cameras.yaml").write_text(yaml.safe_dump(document))


@pytest.mark.slow
@pytest.mark.parametrize("deg", [0.25, 1.0])  # 7 and 28 px
def test_a_bumped_camera_is_not_taken_for_a_late_movie(clean, tmp_path, deg):
    path = write(clean, tmp_path)
    turned(tmp_path, "cam1", deg)
    result = preflight(path)
    assert of(result, "lines of sight").severity is FAULT
    assert of(result, "movies in step").severity is not FAULT


@pytest.mark.slow
def test_swapped_movies_are_named(clean, tmp_path):
    movies = {"cam1": clean.pictures["cam2"], "cam2": clean.pictures["cam1"]}
    result = checked(replace(clean, pictures=movies), tmp_path, sphere=PAINTED)
    assert of(result, "cameras agree").severity is FAULT
    assert "swap cam1 and cam2" in of(result, "cameras agree").advice


@pytest.mark.slow
@pytest.mark.parametrize(("keys", "named"), [({"diameter": 18.9}, ", not 18.9"), ({}, "")])
def test_the_cause_of_a_contradiction_is_named(clean, tmp_path, keys, named):
    """Before: a diameter 5 % off gave a warning of the size only."""
    found = of(checked(clean, tmp_path, sphere=PAINTED | keys), "cameras agree")
    assert found.severity is (FAULT if named else OK), found.measured
    assert named in found.advice


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cam1", "cam2"])
def test_a_turned_camera_is_named_with_its_angle(clean, tmp_path, name):
    """Before: `calibrate again`, of either camera."""
    path = write(clean, tmp_path, sphere=PAINTED)
    turned(tmp_path, name, 1.5)
    found = of(preflight(path), "cameras agree")
    assert found.severity is FAULT
    assert f"{name} rotated by 1.5 degrees" in found.advice


@pytest.mark.slow
def test_a_mirrored_movie_is_named(clean, tmp_path):
    result = checked(clean.spoilt(lambda movie: movie[:, ::-1], ("cam1",)), tmp_path, sphere=PAINTED)
    found = of(result, "map in cam1")
    assert found.severity is FAULT
    assert "flip: {cam1: vertical}" in found.advice
    assert of(result, "map in cam2").severity is OK


@pytest.mark.slow
def test_a_movie_mirrored_left_to_right_is_found_by_the_lines_of_sight(clean, tmp_path):
    result = checked(clean.spoilt(lambda movie: movie[:, :, ::-1], ("cam1",)), tmp_path)
    found = of(result, "lines of sight")
    assert found.severity is FAULT
    assert "flip: {cam1: horizontal}" in found.advice


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [16.2, 19.8, 1.8, 40.0])  # a tenth off; cm for mm; that of another ball
def test_a_wrong_diameter_is_found_and_the_right_one_named(clean, tmp_path, wrong):
    found = of(checked(clean, tmp_path, sphere={"diameter": wrong}), "size of the ball")
    assert found.severity is FAULT
    named = float(found.advice.split("sphere.diameter ")[1].split(" mm")[0])
    assert named == pytest.approx(18.0, rel=0.015)


@pytest.mark.slow
def test_a_wrong_focal_length_is_found_in_its_own_camera(clean, tmp_path):
    path = write(clean, tmp_path)
    document = yaml.safe_load((tmp_path / "cameras.yaml").read_text())
    document["cameras"]["cam2"]["f"] *= 1.1
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(document))
    found = of(preflight(path), "size of the ball")
    assert found.severity is FAULT
    assert "cam2" in found.advice
