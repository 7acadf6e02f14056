"""A map that is mirrored, upside down or another one is refused from one picture, with the odds."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import h5py
import pytest
import torch
import yaml

from sphereorient import so3
from sphereorient.assemble import Chosen
from sphereorient.bench.scenes import BenchmarkScene, BenchSettings, write_scene
from sphereorient.errors import ExperimentError
from sphereorient.follow.appearance.map_odds import LEAST_ODDS, VIEWS, MapOdds, pose_log_odds
from sphereorient.methods.results import with_map_odds
from sphereorient.movies import open_movie
from sphereorient.pose.poses import PoseTable, blank_parts
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, random_texture, write_synthetic_experiment
from sphereorient.trajectory import Flag, Reason

SCENE = SynthSettings(frames=2, cameras=1, image_size=(120, 120), volume_mm=6.0, seed=3)


def odds(score: float, mirrored: float) -> MapOdds:
    return MapOdds(score=torch.tensor([[score]]).double(), mirrored=torch.tensor([[mirrored]]).double())


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """An experiment of one picture."""
    path = write_synthetic_experiment(tmp_path_factory.mktemp("still"), SCENE)
    document = yaml.safe_load(path.read_text())
    with open_movie(path.parent / document["movies"]["cam1"]) as movie:
        (picture,) = movie.sample([0])
    (path.parent / "still").mkdir()
    cv2.imwrite(str(path.parent / "still" / "frame_0000.png"), picture)
    document["movies"]["cam1"] = "still"
    path.write_text(yaml.safe_dump(document))
    return path


def with_map(still, change):
    """The same picture with a changed map."""
    texture = cv2.imread(str(still.parent / "texture.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(still.parent / "other.png"), change(texture))
    path = still.parent / "other.yaml"
    document = yaml.safe_load(still.read_text())
    document["sphere"]["texture"] = "other.png"
    path.write_text(yaml.safe_dump(document))
    return path


def off_deg(track, still, of_map):
    with h5py.File(still.parent / "truth.h5") as truth:
        true = torch.from_numpy(truth["orientation"][:1])
    return float(so3.geodesic_distance(torch.from_numpy(track.orientation), true @ of_map).rad2deg())


def test_a_pose_that_explains_no_more_than_another_has_even_odds_and_twice_the_gain_those_of_all_views():
    score = torch.tensor([0.5, 0.75, 0.3, 0.1])
    other = torch.tensor([0.5, 0.5, 0.9, 0.2])  # 0.75 leaves a quarter, 0.5 a half: twice the logarithm
    assert pose_log_odds(score, other).tolist() == pytest.approx([0.0, math.log(VIEWS), 0.0, 0.0])


def test_odds_against_the_mirror_image_are_those_of_the_mirror_image_against_the_map_turned_round():
    assert float(odds(0.7, 0.4).log_odds) == pytest.approx(-float(odds(0.4, 0.7).log_odds))


def test_pictures_add_their_odds_and_one_without_a_disk_adds_none():
    both = MapOdds(score=torch.tensor([[0.7], [0.6], [torch.nan]]), mirrored=torch.tensor([[0.4], [0.5], [torch.nan]]))
    assert float(both.log_odds) == pytest.approx(float(odds(0.7, 0.4).log_odds + odds(0.6, 0.5).log_odds))


def test_a_map_that_is_its_own_mirror_image_is_no_chance():
    odds(0.97, 0.97).check(["cam1"], choices=1)


def test_the_camera_that_is_mirrored_is_named():
    seen = MapOdds(score=torch.tensor([[0.95, 0.3]]), mirrored=torch.tensor([[0.4, 0.95]]))
    with pytest.raises(ExperimentError, match=r"flip: \{cam2: horizontal\}"):
        seen.check(["cam1", "cam2"], choices=1)


def test_a_map_that_explains_what_chance_does_is_refused_where_poses_were_found():
    doubtful = odds(0.42, 0.4)
    assert float(doubtful.log_odds) < math.log(LEAST_ODDS)
    doubtful.check(["cam1"], choices=0)
    with pytest.raises(ExperimentError, match="odds"):
        doubtful.check(["cam1"], choices=1)


def test_the_best_of_many_pictures_needs_larger_odds():
    likely = odds(0.65, 0.4)
    choices = round(math.exp(float(likely.log_odds)) / LEAST_ODDS)
    assert choices > 3
    likely.check(["cam1"], choices=choices - 1)
    with pytest.raises(ExperimentError, match="chance"):
        likely.check(["cam1"], choices=choices + 1)


@pytest.mark.slow
@pytest.mark.parametrize("among", ["odds", "light"])
def test_a_small_half_hidden_ball_of_which_one_frame_fits_by_chance_is_refused(tmp_path, monkeypatch, among):
    if among == "light":  # the light learnt at such a pose explains no more than a disk without paint
        monkeypatch.setattr(MapOdds, "check", lambda *_, **__: None)
    mixed = {"ball_size": 5, "highlights": 5, "occlusion": 5}
    scene = BenchmarkScene(kind="together", level=5, seed=1, number=0, degradations=mixed, plan=BenchSettings())
    with pytest.raises(ExperimentError, match="chance" if among == "odds" else "without paint"):
        track_movies(write_scene(tmp_path / "scene", scene))


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True], ids=["the map", "the map turned by half a turn"])
def test_a_single_frame_has_a_confidence_where_the_map_is_right(still, turned):
    path, turn = still, torch.ones(3).double()
    if turned:  # rows and columns reversed: a rotation, no mirror image
        path, turn = with_map(still, lambda texture: texture[::-1, ::-1]), torch.tensor([1.0, -1.0, -1.0]).double()
    track = track_movies(path)
    assert track.valid.all()
    assert off_deg(track, still, turn.diag()) < 1.0
    assert 0.99 < track.confidence[0] < 1.0
    assert not track.flags[0] & Flag.AMBIGUOUS


@pytest.mark.parametrize(
    "change",
    [lambda texture: texture[:, ::-1], lambda texture: texture[::-1]],
    ids=["mirrored", "upside down"],
)
def test_a_mirrored_map_is_refused_with_its_cause(still, change):
    with pytest.raises(ExperimentError, match=r"flip: \{cam1: horizontal\}"):
        track_movies(with_map(still, change))


def test_a_mirrored_movie_is_refused_with_its_cause(still):
    path = still.parent / "flipped.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(still.read_text()) | {"flip": {"cam1": "vertical"}}))
    with pytest.raises(ExperimentError, match=r"flip: \{cam1: horizontal\}"):
        track_movies(path)


@pytest.mark.slow
def test_a_map_of_another_ball_is_refused(still):
    other = (255 * random_texture(SCENE.texture, 77)).byte().numpy()
    with pytest.raises(ExperimentError, match="map"):
        track_movies(with_map(still, lambda texture: other))


def chosen_alone(odds_of_map, *others):
    """Outcome of a single frame with one pose of score 0.9, and others of these scores."""
    table = PoseTable(
        mask=torch.ones(1, 1 + len(others)).bool(),
        use=torch.ones(1, 1).bool(),
        reason=((Reason.OK,),),
        **blank_parts(1, 1, 1 + len(others)) | {"score": torch.tensor([[[0.9], *([one] for one in others)]]).double()},
    )
    chosen = replace(
        Chosen.nothing(table.mask),
        choice=torch.zeros(1).long(),
        segment=torch.zeros(1).long(),
        probability=torch.ones(1),
    )
    return with_map_odds(chosen, table, odds_of_map, 0.9)


@pytest.mark.parametrize(
    ("odds_of_map", "others", "confidence"),
    [(9.0, (), 0.9), (1e9, (0.9,), 0.5), (1e9, (0.9, 0.9), 1 / 3), (1e9, (0.2,), 1.0), (1.0, (0.9,), 1 / 3)],
)
def test_the_confidence_of_a_frame_alone_weighs_the_map_and_its_other_poses(odds_of_map, others, confidence):
    found = chosen_alone(math.log(odds_of_map), *others)
    assert float(found.probability[0]) == pytest.approx(confidence, abs=1e-5)
    assert bool(found.flags[0] & Flag.AMBIGUOUS) == (confidence < 0.9 - 1e-9)


def test_a_frame_alone_has_no_confidence_where_the_odds_of_the_map_are_not_known():
    assert math.isnan(float(chosen_alone(None).probability[0]))
