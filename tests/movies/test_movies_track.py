"""Tracks of movies with other grey values; formats without loss hold the same ones (test_movies_formats)."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from conftest import SHARED
from movie_formats import Writer, npy, video

from sphereorient import so3
from sphereorient.errors import ExperimentError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.run.stages import track_movies
from sphereorient.trajectory import Trajectory

FIRST, COUNT = 40, 60

pytestmark = [pytest.mark.slow, pytest.mark.shared]


@pytest.fixture(scope="module")
def movies() -> dict[str, np.ndarray]:
    experiment = load_experiment(SHARED / "experiment" / "experiment.yaml")
    return {name: movie.sample(range(FIRST, FIRST + COUNT)) for name, movie in open_movies(experiment).items()}


def tracked(folder: Path, movies: dict[str, np.ndarray], write: Writer) -> Trajectory:
    source = SHARED / "experiment"
    document = yaml.safe_load((source / "experiment.yaml").read_text())
    for name in ("cameras.yaml", document["sphere"]["texture"]):
        shutil.copy(source / name, folder)
    document["movies"] = {}
    for name, movie in movies.items():
        (folder / name).mkdir()
        document["movies"][name] = str(write(folder / name, movie).relative_to(folder))
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document))
    return track_movies(folder / "experiment.yaml")


def test_a_movie_compressed_with_loss_gives_nearly_the_same_track(movies, tmp_path):
    for name in ("lossy", "npy"):
        (tmp_path / name).mkdir()
    reference = tracked(tmp_path / "npy", movies, npy)
    lossy = video("movie.mp4", "libx264", "yuv420p", crf="10")
    track = tracked(tmp_path / "lossy", movies, lossy)
    assert track.valid.all()
    A, B = (torch.from_numpy(each.orientation) for each in (track, reference))
    assert float(torch.rad2deg(so3.geodesic_distance(A, B)).median()) < 0.1


def test_a_mirrored_movie_is_found_out(movies, tmp_path):
    """Every rotation would come out inside out; no pose explains the pictures."""
    with pytest.raises(ExperimentError, match=r"flip: \{cam1: horizontal, cam2: horizontal\}"):
        tracked(tmp_path, {name: movie[:, ::-1] for name, movie in movies.items()}, npy)
