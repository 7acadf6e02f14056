"""`sphereorient track` of a fixed ball without a map."""

from __future__ import annotations

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.cli import app
from sphereorient.errors import SphereOrientError
from sphereorient.experiment.recording import TextureMap
from sphereorient.files.whole_file import has_mark
from sphereorient.run import Request
from sphereorient.run.store import fingerprint
from sphereorient.sphere import load_texture
from sphereorient.synth import SynthSettings, write_synthetic_experiment


def experiment_of(folder, omega_rms: float):
    """A movie of a ball in its place, without a map; and its true attitudes."""
    settings = SynthSettings(
        frames=70, image_size=(150, 150), diameter_px=56.0, volume_mm=8.0, velocity_rms=0.0, exposure=1e-4,
        exposure_samples=1, omega_rms=omega_rms, seed=5,
    )  # fmt: skip
    path = write_synthetic_experiment(folder, settings)
    content = yaml.safe_load(path.read_text())
    content["sphere"] = {"diameter": content["sphere"]["diameter"], "texture": "own.png", "fixed": True}
    path.write_text(yaml.safe_dump(content))
    with h5py.File(folder / "truth.h5") as file:
        return path, torch.from_numpy(file["orientation"][()])


def run(path, *more: str):
    out = path.parent / "track.h5"
    return CliRunner().invoke(app, ["track", str(path), "--out", str(out), "--cameras", "cam1", *more]), out


@pytest.mark.slow
def test_a_map_of_the_first_frames_is_written_and_used(tmp_path):
    path, R_true = experiment_of(tmp_path / "turns", 60.0)
    done, out = run(path)
    assert done.exit_code == 0, done.output
    assert "no map: wrote" in done.output
    assert load_texture(path.parent / "own.png").std() > 0.1
    with h5py.File(out) as file:
        R, valid = torch.from_numpy(file["orientation"][()]), file["valid"][()]
    assert np.mean(valid) > 0.95
    R, R_true = R[valid], R_true[valid]
    body = so3.nearest_rotation((R.mT @ R_true).mean(0))
    assert float(torch.rad2deg(so3.geodesic_distance(R @ body, R_true)).median()) < 0.6
    again, _ = run(path, "--force")
    assert "no map" not in again.output


def test_a_ball_that_rests_has_no_map(tmp_path):
    path, _ = experiment_of(tmp_path / "rests", 0.02)
    done, out = run(path)
    assert done.exit_code == 1
    assert isinstance(done.exception, SphereOrientError)
    assert "rotates" in str(done.exception)
    assert not out.exists()
    assert not (path.parent / "own.png").exists()


def test_an_interrupted_run_goes_on_with_the_map_that_it_learnt(tmp_path, monkeypatch):
    """Before: --resume refused its own map; and once it was named in the file, that was another experiment."""
    path, _ = experiment_of(tmp_path / "turns", 60.0)
    content = yaml.safe_load(path.read_text())
    del content["sphere"]["texture"]
    path.write_text(yaml.safe_dump(content))
    target = path.parent / "texture.png"
    target.unlink()  # that of the renderer
    asked, learnt = [], []

    def first_map(*_: object) -> tuple[TextureMap, list[str]]:
        learnt.append(1)
        return TextureMap(grey=torch.rand(64, 128), unseen=None), []

    def stopped(request: Request, *_: object, **more: object) -> None:
        asked.append((fingerprint(request), request.experiment.texture_path, more["resume"]))
        raise KeyboardInterrupt

    monkeypatch.setattr("sphereorient.methods.map.first_map_of", first_map)
    monkeypatch.setattr("sphereorient.run.stages.run_tracks", stopped)
    run(path)
    assert has_mark(target)
    run(path, "--resume")
    assert len(learnt) == 1
    (first, path_1, _), (second, path_2, resume) = asked
    assert resume
    assert path_1 == path_2 == target
    assert first == second
    target.write_bytes(cv2.imencode(".png", np.zeros((64, 128), np.uint8))[1].tobytes())  # the user's own picture
    done, _ = run(path, "--resume")
    assert "write it under sphere: texture:" in str(done.exception)
    assert len(asked) == 2


def test_a_map_that_the_experiment_does_not_name_is_not_written_over(tmp_path):
    path, _ = experiment_of(tmp_path / "turns", 60.0)
    content = yaml.safe_load(path.read_text())
    del content["sphere"]["texture"]
    path.write_text(yaml.safe_dump(content))
    before = (path.parent / "texture.png").read_bytes()  # that of the renderer
    done, out = run(path, "--force")
    assert isinstance(done.exception, SphereOrientError)
    assert "write it under sphere: texture:" in str(done.exception)
    assert (path.parent / "texture.png").read_bytes() == before
    assert not out.exists()
