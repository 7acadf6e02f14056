from types import SimpleNamespace

import pytest
from test_fixed_centre import truth

from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.locate import LocateSettings, screened_frames
from sphereorient.mapping.disks import held_place
from sphereorient.mapping.settings import MapSettings
from sphereorient.synth import SynthSettings, write_synthetic_experiment

SETTINGS = MapSettings(pixels=500)
RATE_HZ = 600.0


@pytest.fixture(name="ball", scope="module")
def turning_ball(tmp_path_factory):
    """A ball that turns in its place by 7 degrees a frame: its place, pictures and true attitudes."""
    settings = SynthSettings(
        frames=70, image_size=(150, 150), diameter_px=56.0, volume_mm=8.0, velocity_rms=0.0, exposure=1e-4,
        exposure_samples=1, omega_rms=60.0, seed=5,
    )  # fmt: skip
    path = write_synthetic_experiment(tmp_path_factory.mktemp("turns"), settings)
    experiment = load_experiment(path).with_sphere(fixed=True, texture_path=None)
    with open_recording(experiment, ["cam1"], textured=False) as recording:
        place = held_place(recording, SETTINGS, LocateSettings())
        frames = list(screened_frames(recording.streams[0], place.views[0].background))
        for frame in frames:
            _ = frame.picture
    return SimpleNamespace(place=place, frames=frames, R=truth(path)[1], X=truth(path)[0])
