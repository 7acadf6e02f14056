"""One movie in every format gives one track, to the last bit where the format is lossless."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from conftest import SHARED
from movie_formats import LOSSLESS, Writer, cine, npy, video

from sphereorient import so3
from sphereorient.errors import ExperimentError
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.movies import write_ffv1
from sphereorient.run.stages import track_movies
from sphereorient.trajectory import Trajectory

FIRST, COUNT = 40, 60
STEPS = {1: 1, 2: 16}  # bytes a pixel -> what a grey level counts: 12-bit numbers in 16 bits

pytestmark = [pytest.mark.slow, pytest.mark.shared]


def ffv1(folder: Path, frames: np.ndarray) -> Path:
    write_ffv1(folder / "movie.mkv", iter(frames), 600.0)
    return folder / "movie.mkv"


NAMES = ("ffv1 avi", "cine", "cine, rows top-down", "tiff", "tif pictures", "pattern", "hdf5")
WRITERS = {name: LOSSLESS[name] for name in NAMES} | {"ffv1 mkv": ffv1}
WRITERS["cine, cropped"] = cine(first_number=-30, total=20_000, annotation=24)


@pytest.fixture(scope="module", params=STEPS, ids=lambda size: f"{8 * size} bit")
def movies(request: Any) -> dict[str, np.ndarray]:
    experiment = load_experiment(SHARED / "experiment" / "experiment.yaml")
    pictures = {name: movie.sample(range(FIRST, FIRST + COUNT)) for name, movie in open_movies(experiment).items()}
    kind = np.dtype(f"u{request.param}")
    return {name: (movie.astype(kind) * STEPS[request.param]).astype(kind) for name, movie in pictures.items()}


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


@pytest.fixture(scope="module")
def reference(movies: dict[str, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Trajectory:
    return tracked(tmp_path_factory.mktemp("npy"), movies, npy)


@pytest.mark.parametrize("name", WRITERS)
def test_every_lossless_format_gives_the_same_track(movies, reference, tmp_path, name):
    track = tracked(tmp_path, movies, WRITERS[name])
    assert track.valid.all()
    for part in ("position", "position_cov", "orientation", "orientation_cov", "omega_lab", "flags"):
        assert getattr(track, part).tobytes() == getattr(reference, part).tobytes(), part
    for camera, seen in track.cameras.items():
        assert seen.score.tobytes() == reference.cameras[camera].score.tobytes()
        assert seen.reason == reference.cameras[camera].reason


def test_a_movie_compressed_with_loss_gives_nearly_the_same_track(movies, reference, tmp_path):
    if next(iter(movies.values())).dtype != np.uint8:
        pytest.skip("H.264 as cameras write it has 8 bits")
    lossy = video("movie.mp4", "libx264", "yuv420p", crf="10")
    track = tracked(tmp_path, movies, lossy)
    assert track.valid.all()
    A, B = (torch.from_numpy(each.orientation) for each in (track, reference))
    assert float(torch.rad2deg(so3.geodesic_distance(A, B)).median()) < 0.1


def test_a_mirrored_movie_is_found_out(movies, tmp_path):
    """Every rotation would come out inside out; no pose explains the pictures."""
    with pytest.raises(ExperimentError, match=r"not mirrored.*write flip: \{cam1: horizontal, cam2: horizontal\}"):
        tracked(tmp_path, {name: movie[:, ::-1] for name, movie in movies.items()}, npy)
