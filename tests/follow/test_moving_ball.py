"""`track` measures how far a ball moves during the exposure, and renders this motion instead of a wider blur."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from run_examples import off_deg, rms_sigmas

from sphereorient.bench.scenes import BenchmarkScene, write_scene
from sphereorient.methods.method import load_learnt
from sphereorient.run.stages import run
from sphereorient.run.store import MemoryStore, Request
from sphereorient.synth import SynthSettings, write_synthetic_experiment


@pytest.mark.slow
def test_motion_while_the_shutter_is_open_is_no_blur(tmp_path):
    scene = BenchmarkScene(kind="moving", level=3, seed=0, number=0, degradations={"motion_blur": 3})
    experiment, known = write_scene(tmp_path, scene), tmp_path / "learnt.h5"
    track = run(Request(experiment=experiment, save_learnt=known), MemoryStore())
    learnt = load_learnt(known)[""]
    # The optics' 0.55 px and the pixel's own 0.29 px; 8 degrees in an exposure are 5 px.
    assert learnt.blur_px == pytest.approx(0.62, rel=0.1)
    assert learnt.still_blur_px > 1.3 * learnt.blur_px
    assert learnt.instants > 2
    assert not learnt.sharper
    off = off_deg(track, experiment)
    assert np.median(off) < 0.04
    assert rms_sigmas(track, off) < 1.5

    again = run(Request(experiment=experiment, learnt=known), MemoryStore())
    assert again.orientation.tobytes() == track.orientation.tobytes()
    assert again.orientation_cov.tobytes() == track.orientation_cov.tobytes()

    # Without a known exposure all of it counts as blur.
    keys = yaml.safe_load(experiment.read_text())
    del keys["exposure"]
    experiment.write_text(yaml.safe_dump(keys))
    asis = run(Request(experiment=experiment, save_learnt=tmp_path / "asis.h5"), MemoryStore())
    assert load_learnt(tmp_path / "asis.h5")[""].instants == 1
    assert np.median(off_deg(asis, experiment)) > 1.5 * np.median(off)


@pytest.mark.slow
def test_an_exposure_that_is_not_that_of_the_pictures_smears_nothing(tmp_path):
    """Sharp pictures of a ball that would rotate by 20 degrees in the exposure of the file."""
    settings = SynthSettings(frames=24, omega_rms=480.0, omega_time=1.0, exposure=0.0004, exposure_samples=1)
    experiment, known = write_synthetic_experiment(tmp_path, settings), tmp_path / "learnt.h5"
    track = run(Request(experiment=experiment, save_learnt=known), MemoryStore())
    assert load_learnt(known)[""].instants == 1
    assert load_learnt(known)[""].sharper
    assert any("pictures are sharper" in remark for remark in track.provenance["remarks"])
    off = off_deg(track, experiment)
    assert np.median(off) < 0.03
    assert rms_sigmas(track, off) < 1.5
