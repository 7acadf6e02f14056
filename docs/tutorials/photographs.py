# %% [markdown]
# # A texture map from photographs
#
# Photographs of a ball in any order: the map of its paint, and the attitude of the ball in each.

# %%
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import sphereorient
from sphereorient.methods.settings import load_settings
from sphereorient.movies import open_movie
from sphereorient.sphere import load_texture
from sphereorient.synth import SynthSettings, write_synthetic_experiment

place = TemporaryDirectory()
folder = Path(place.name)
settings = SynthSettings(
    frames=24, image_size=(150, 150), diameter_px=56.0, velocity_rms=0.0, volume_mm=1e-3, omega_rms=40.0, omega_time=0.2
)
experiment = write_synthetic_experiment(folder, settings)

# %% [markdown]
# The frames are shuffled: nothing follows from their order any more.

# %%
order = np.random.default_rng(0).permutation(24)
for name in ("cam1", "cam2"):
    np.save(folder / f"{name}.npy", open_movie(folder / f"{name}.mkv").sample(order.tolist()))
text = experiment.read_text().replace("cam1.mkv", "cam1.npy").replace("cam2.mkv", "cam2.npy")
experiment.write_text(text)

# %% [markdown]
# `sphereorient map --photographs` does the same.

# %%
learnt = sphereorient.learn_map(experiment, load_settings(None, ["paint.unordered=true"]))
print(f"fitted {int(learnt.learnt.fitted.sum())} of {len(learnt.learnt.valid)} photographs")
print(f"seen: {100 * learnt.learnt.seen_share:.0f} % of the sphere")
assert learnt.learnt.fitted.float().mean() > 0.8

# %% [markdown]
# The map is that of the ball, in a body frame of its own.

# %%
print("true map:", tuple(load_texture(folder / "texture.png").shape), "learnt:", tuple(learnt.texture.shape))
place.cleanup()
