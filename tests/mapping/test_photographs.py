"""Photographs in any order: attitudes from pairs, joined sets, left-out photographs, refusals."""

import math
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import SHARED
from map_examples import mapped, rewrite, true_attitudes
from photographs import Stills, write_stills
from renders import disks_of_pictures, error_deg, pictures, turning

from sphereorient import so3
from sphereorient.cli import main
from sphereorient.errors import PaintError
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.mapping import MapSettings
from sphereorient.mapping.pairs import search_pairs, search_views
from sphereorient.mapping.photographs import all_pairs, find_photographs, joined_sets, measured_evidence
from sphereorient.movies import open_movie
from sphereorient.sphere import load_texture
from sphereorient.sphere.compare import compare_maps

SETTINGS = MapSettings(disk_px=48)


def random_attitudes(count, seed):
    return so3.random_rotations(count, generator=torch.Generator().manual_seed(seed))


def near_attitudes(count, seed, within_deg):
    """Attitudes that all show about the same side."""
    rng = torch.Generator().manual_seed(seed)
    turn = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return so3.exp(math.radians(within_deg) * turn / turn.norm(dim=1, keepdim=True)) @ random_attitudes(1, seed)


def found_in(whole, detail=0.04):
    return find_photographs(disks_of_pictures(whole), disks_of_pictures(whole, detail, 0.2), SETTINGS)


@pytest.mark.slow
def test_photographs_in_any_order_get_their_attitudes():
    R = random_attitudes(12, 2)
    chain = found_in(pictures(R))
    assert chain.rows.tolist() == list(range(12))
    assert error_deg(chain.R_lab_body, R).max() < 5
    torch.testing.assert_close(chain.R_lab_body[0], torch.eye(3, dtype=torch.float64))
    # Every kept pair is right: pairs without a common patch are left out.
    assert math.degrees(chain.closure.drift_after_rad) < 5


@pytest.mark.slow
def test_the_order_of_the_pictures_does_not_matter():
    R, order = random_attitudes(12, 3), torch.tensor([5, 0, 7, 3, 11, 9, 1, 2, 10, 8, 4, 6])
    whole = pictures(R)
    one, other = found_in(whole), found_in(whole[order])
    assert sorted(order[other.rows].tolist()) == one.rows.tolist()
    place = {k: n for n, k in enumerate(order[other.rows].tolist())}
    again = other.R_lab_body[[place[k] for k in one.rows.tolist()]]
    assert error_deg(again, one.R_lab_body).max() < 0.5


@pytest.mark.slow
def test_two_cameras_see_more_than_one():
    R = random_attitudes(8, 5)
    chain = found_in(pictures(R, 2))
    assert len(chain.rows) == 8
    assert error_deg(chain.R_lab_body, R).max() < 5


@pytest.mark.slow
def test_pictures_of_other_paint_are_left_out():
    R = near_attitudes(7, 6, 25)
    whole = torch.cat([pictures(R[:5]), pictures(R[5:], seed=11), pictures(random_attitudes(1, 7), seed=12)])
    chain = found_in(whole)
    assert chain.rows.tolist() == [0, 1, 2, 3, 4]
    assert error_deg(chain.R_lab_body, R[:5]).max() < 5


@pytest.mark.slow
def test_a_wrong_pair_does_not_join_two_sets():
    """The most certain pair between the two halves is made wrong: all other pairs contradict it."""
    R = near_attitudes(8, 8, 30)
    evidence = measured_evidence(disks_of_pictures(pictures(R)), SETTINGS)
    found = all_pairs(evidence.disks)
    halves = (found.first < 4) == (found.second < 4)
    across = torch.nonzero(~halves)[:, 0][:6]
    wrong = found.where(across)
    bent = so3.exp(torch.tensor([0.5, -0.4, 0.6], dtype=torch.float64)) @ wrong.R_ji
    planted = type(found)(
        **{name: torch.cat([getattr(found.where(halves), name), getattr(wrong, name)]) for name in vars(wrong)}
    )
    planted.R_ji[-6:] = bent
    planted.score[-6:] = 0.97
    planted.overlap[-6:] = 0.8
    label, placed = joined_sets(evidence, planted)
    for half in (slice(0, 4), slice(4, 8)):
        assert len(label[half].unique()) == 1
        assert error_deg(placed[half], R[half]).max() < 5
    assert label[0] != label[4]


@pytest.mark.slow
def test_other_paint_is_no_evidence_and_the_same_paint_is():
    R = near_attitudes(6, 9, 20)
    whole = torch.cat([pictures(R[:3]), pictures(R[3:], seed=21)])
    evidence = measured_evidence(disks_of_pictures(whole), SETTINGS)
    found = all_pairs(evidence.disks)
    odds = evidence.log_odds(found)
    same = (found.first < 3) == (found.second < 3)
    assert odds[same].max() > 50
    assert odds[~same].max() < 25


def test_photographs_that_differ_in_fine_detail_are_refused_as_such():
    whole = pictures(near_attitudes(4, 9, 15))
    noise = 300 * torch.randn(whole.shape, generator=torch.Generator().manual_seed(3), dtype=whole.dtype)
    with pytest.raises(PaintError, match=r"3 that agree in fine detail, got none; .* raise paint\.detail"):
        find_photographs(disks_of_pictures(whole), disks_of_pictures(whole + noise, 0.02, 0.15), SETTINGS)


def test_views_compared_with_all_others_at_once_rank_rotations_as_pairs_one_by_one_do():
    R = random_attitudes(4, 10)
    disks = disks_of_pictures(pictures(R))
    grid = so3.random_rotations(300, generator=torch.Generator().manual_seed(0))
    for second in range(4):
        scores = search_views(disks, (0, 0), second, grid, 2)
        first = torch.tensor([k for k in range(4) if k != second])
        still = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)  # one camera along lab z: view and lab are one
        alone = search_pairs(disks, first, torch.full((3,), second), still, grid, 2)
        torch.testing.assert_close(grid[scores[first].argmax(1)], alone, atol=1e-6, rtol=0)


def refused(whole):
    with pytest.raises(PaintError) as caught:
        found_in(whole)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_too_few_photographs_are_refused():
    assert "at least 3 with the ball, got 2" in refused(pictures(random_attitudes(2, 1)))


@pytest.mark.slow
def test_photographs_that_share_no_paint_are_refused():
    whole = torch.cat([pictures(random_attitudes(1, k), seed=30 + k) for k in range(5)])
    assert "3 with a common patch, got none among 5" in refused(whole)


@pytest.mark.slow
def test_photographs_of_two_balls_are_refused():
    R = near_attitudes(10, 13, 25)
    line = refused(torch.cat([pictures(R[:5]), pictures(R[5:], seed=31)]))
    assert "one ball, got 5 pictures and 5 others" in line


@pytest.mark.slow
def test_photographs_of_a_ball_that_does_not_turn_are_refused():
    assert "a ball that rotates" in refused(pictures(turning(4, 0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("moves", [False, True])
def test_a_map_is_learnt_from_photographs_at_random_attitudes(tmp_path, moves):
    path = write_stills(tmp_path, Stills(count=14, seed=2, paint="dots", moves=moves, diameter_px=90.0))
    with open_recording(path, textured=False) as recording:
        learnt = mapped(recording, MapSettings(unordered=True))
    assert learnt.valid.all()
    assert error_deg(learnt.R_lab_body, true_attitudes(path)).median() < 0.2
    comparison = compare_maps(learnt.texture, load_texture(path.parent / "texture.png"))
    assert math.degrees(comparison.rms_rad) < 0.4


@pytest.mark.slow
def test_a_photograph_of_another_ball_keeps_its_place_and_gets_no_attitude(tmp_path):
    path = write_stills(tmp_path, Stills(count=14, seed=2, paint="dots", moves=True, diameter_px=60.0))
    other = write_stills(tmp_path / "other", Stills(count=6, seed=3, paint="blobs", moves=True, diameter_px=60.0))
    shutil.copy(other.parent / "photographs" / "005.png", path.parent / "photographs" / "005.png")
    with open_recording(path, textured=False) as recording:
        learnt = mapped(recording, MapSettings(unordered=True))
    assert learnt.valid.tolist() == [k != 5 for k in range(14)]
    assert learnt.R_lab_body[5].isnan().all()
    assert learnt.position_lab_mm[5].isfinite().all()
    known = learnt.valid
    assert error_deg(learnt.R_lab_body[known], true_attitudes(path)[known]).median() < 0.4


@pytest.mark.slow
@pytest.mark.shared
def test_frames_of_the_shared_experiment_shuffled_and_thinned_are_photographs(tmp_path):
    source = SHARED / "experiment" / "experiment.yaml"
    rows = torch.linspace(0, 239, 30).round().long()[torch.randperm(30, generator=torch.Generator().manual_seed(1))]
    frames = list(open_movie(source.parent / "cam1.mkv").frames(0, 240))
    np.save(tmp_path / "stills.npy", np.stack([frames[k] for k in rows.tolist()]))
    experiment = load_experiment(source).with_sphere(texture_path=None)
    experiment = replace(experiment, movie_paths={"cam1": tmp_path / "stills.npy"}, start={})
    with open_recording(experiment, ["cam1"], textured=False) as recording:
        learnt = mapped(recording, MapSettings(unordered=True))
    assert learnt.valid.all()
    error = error_deg(learnt.R_lab_body, true_attitudes(source)[rows])
    assert error.median() < 0.2
    assert error.max() < 0.5


@pytest.mark.parametrize("words", [["--photographs"], ["--set", "paint.unordered=true"]])
def test_the_command_takes_one_photograph_for_none(tmp_path, monkeypatch, capsys, words):
    path = write_stills(tmp_path, Stills(count=3, seed=1, diameter_px=60.0))
    rewrite(path, frames=[0, 2])
    monkeypatch.setattr(
        sys, "argv", ["sphereorient", "map", str(path), "--out", str(tmp_path / "map.png"), "--quiet", *words]
    )
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "photographs: expected at least 3 with the ball" in line
