# %% [markdown]
# # A fly on a ball, coming from FicTrac
#
# One camera with a known field of view films a fixed ball of unknown texture. FicTrac's `config.txt` is imported,
# the texture map is learnt from the movie, and the walk is computed. The ball is rendered, so that the truth is
# known.

# %%
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np

import sphereorient
from sphereorient.cameras import load_cameras
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory.walk import walk_of

place = TemporaryDirectory()
folder = Path(place.name)
settings = SynthSettings(
    frames=90,
    frame_rate=100.0,
    image_size=(200, 160),
    diameter_px=72.0,
    velocity_rms=0.0,
    volume_mm=1e-3,
    omega_rms=4.0,
    omega_time=0.2,
    exposure=0.001,
)
write_synthetic_experiment(folder, settings)
(height, focal_px) = 160, float(load_cameras(folder / "cameras.yaml")["cam1"].f_mm) / 0.02
(folder / "cameras.yaml").unlink()
(folder / "experiment.yaml").unlink()
(folder / "texture.png").unlink()

# %% [markdown]
# ## The configuration of FicTrac
#
# `vfov` is the field of view from top to bottom. `c2a_r` rotates the camera's axes into the animal's: here they are the
# same.

# %%
vfov = 2 * np.degrees(np.arctan(height / 2 / focal_px))
(folder / "config.txt").write_text(f"src_fn : cam1.mkv\nvfov : {vfov:.6f}\nc2a_r : {{ 0, 0, 0 }}\n")


def sphereorient_command(*words: str) -> None:
    """Run a command as in a shell, and print what it prints."""
    command = [sys.executable, "-m", "sphereorient.cli", *words]
    print(subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout)


sphereorient_command("init", "--from-fictrac", "config.txt", "--set", "frame_rate=100")
print((folder / "experiment.yaml").read_text())

# %% [markdown]
# ## Learn the texture map, and track with it
#
# `sphereorient mark experiment.yaml` would draw masks where the fly and its holder hide the ball.

# %%
sphereorient_command("map", "experiment.yaml", "--out", "texture.png")
sphereorient_command("track", "experiment.yaml", "--out", "track.h5")

# %% [markdown]
# ## The walk
#
# Heading, path, and speeds ahead and to the side, in radii of the ball. `sphereorient export --to fictrac` writes
# FicTrac's table for programs that read it.

# %%
track = sphereorient.Trajectory.load(folder / "track.h5")
walk = track.walk()
print(f"ahead {np.nanmean(walk.forward_rad_s):+.2f} radii/s, turns {np.nanmean(walk.turn_rad_s):+.2f} rad/s")
sphereorient_command("export", "track.h5", "--out", "track.dat", "--experiment", "experiment.yaml")

# %% [markdown]
# The truth: the same walk from the orientations that were rendered, in the camera's axes.

# %%
with h5py.File(folder / "truth.h5") as truth:
    R_cam_lab = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # cam1 of `synth` looks along lab +y
    true_walk = walk_of(truth["time"][:], R_cam_lab @ truth["orientation"][:])
error = np.nanstd(walk.forward_rad_s - true_walk.forward_rad_s) / np.nanstd(true_walk.forward_rad_s)
off = np.abs(walk.path - true_walk.path).max()
print(f"speed ahead: error {100 * error:.1f} % of its scatter; path off by {off:.3f} radii")
assert error < 0.05
place.cleanup()
