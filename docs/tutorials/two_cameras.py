# %% [markdown]
# # Two cameras: from a plate to a track
#
# A ball is filmed by two cameras. First the cameras are calibrated, then the ball is tracked, then its track is saved.
# Everything here is rendered, so that the truth is known; the same commands work for your movies.

# %%
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

import sphereorient
from sphereorient.cameras import load_cameras, save_cameras
from sphereorient.synth import SynthSettings, write_synthetic_experiment

place = TemporaryDirectory()
folder = Path(place.name)
settings = SynthSettings(frames=40, image_size=(400, 400), diameter_px=70.0, volume_mm=25.0)
experiment = write_synthetic_experiment(folder, settings)

# %% [markdown]
# ## Calibrate
#
# `sphereorient init --plate FOLDER` writes `calibration.yaml` from pictures of a plate. Here each camera gets a table
# of points instead, as another program could have measured them: lab coordinates (mm) and pixels, with noise of 0.03
# px.

# %%
exact = load_cameras(folder / "cameras.yaml")
rng = np.random.default_rng(1)
points = 80.0 * (rng.random((400, 3)) - 0.5)
for name, camera in exact.items():
    uv = camera.project(torch.from_numpy(points)).numpy() + 0.03 * rng.standard_normal((400, 2))
    np.savetxt(folder / f"{name}.csv", np.hstack([points, uv]), delimiter=",", header="x,y,z,u,v", comments="")
(folder / "calibration.yaml").write_text(
    "schema: sphereorient-calibration/1\n"
    "image_size: [400, 400]\n"
    "pixel_pitch: [0.02, 0.02]\n"
    "points: {cam1: cam1.csv, cam2: cam2.csv}\n"
)
calibrated = sphereorient.calibrate(folder / "calibration.yaml")
save_cameras(folder / "cameras.yaml", calibrated.cameras, covariance=calibrated.covariance)
for name in calibrated.cameras:
    print(name, f"{calibrated.rms_px(name):.3f} px rms")
    assert calibrated.rms_px(name) < 0.06

# %% [markdown]
# ## Check, then track
#
# `check` examines movies, cameras and texture map, and gives advice where they do not fit together.

# %%
checked = sphereorient.check(experiment)
print(*(f"{one.severity:8} {one.title}: {one.measured}" for one in checked.findings[:6]), sep="\n")

track = sphereorient.track_movies(experiment)
print(track.summary())
assert track.valid.all()

# %% [markdown]
# ## Look at it
#
# A part of a track is a track. Dots are measured, lines smoothed.

# %%
figure = track[5:35].plot()
figure

# %% [markdown]
# ## How good is it?
#
# The truth is known here: errors in degrees and mm, and those that the track states.

# %%
from sphereorient.bench import score_track

score = score_track(track, folder / "truth.h5")
p50, p95, *_ = score.percentiles_deg()
stated = np.degrees(np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2)))
print(f"orientation: median {p50:.3f} degrees, 95 % {p95:.3f}; stated {np.median(stated):.3f}")
assert p50 < 0.1

# %% [markdown]
# ## Save it
#
# `sphereorient report track.h5 --experiment experiment.yaml --out report` makes a page of it, with figures. Statistics
# need segments of at least 50 frames.

# %%
track.save(folder / "track.h5")
print((folder / "track.h5").stat().st_size, "bytes")
place.cleanup()
