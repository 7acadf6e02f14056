# %% [markdown]
# # The toolkit from Python
#
# The parts are `torch.nn.Module`s that work without a movie: a differentiable renderer, a template search over SO(3),
# a fit with covariance, and a path layer.

# %%
import math

import matplotlib.pyplot as plt
import torch

from sphereorient import PathLayer, PoseFitter, SphereRenderer, TemplateBank, so3
from sphereorient.cameras import PinholeCamera
from sphereorient.synth import random_texture

texture = random_texture("patches", seed=3)
turn = torch.tensor([0.4, -0.9, 0.2], dtype=torch.float64)
R_true = so3.exp(turn)

# %% [markdown]
# ## Render
#
# Orthographic along z (`size_px`), or through any camera of the toolkit. Orientations may have any leading shape.

# %%
disk = SphereRenderer(texture, size_px=80)
views = disk(so3.exp(turn * torch.linspace(0.0, 1.0, 4)[:, None]).float())
figure, axes = plt.subplots(1, 4, figsize=(9, 2.4))
for ax, view in zip(axes, views, strict=True):
    ax.imshow(view, cmap="gray")
    ax.set_axis_off()

# %% [markdown]
# ## Search
#
# Templates of all SO(3), compared in batches; then finer about the best. float32, float64 and NumPy arrays are
# accepted.

# %%
bank = TemplateBank(texture, size_px=80)
picture = disk(R_true.float())
for form in (picture, picture.double(), picture.numpy()):
    best = bank(form).R_view_body[0]
    print(f"{type(form).__name__}: off by {math.degrees(float(so3.geodesic_distance(best, R_true))):.2f} degrees")
    assert so3.geodesic_distance(best, R_true) < math.radians(3)

# %% [markdown]
# A disk without a candidate has a reason. If no picture showed the paint (`load_unseen` reads that with a learnt map),
# write NaN into the map: pixels that show it are not compared.

# %%
print("one grey:", bank(torch.full((80, 80), 0.5)).reason)
patchy = texture.clone()
patchy[330:] = torch.nan
best = TemplateBank(patchy, size_px=80)(picture).R_view_body[0]
print(f"a third unseen: off by {math.degrees(so3.geodesic_distance(best, R_true)):.2f} degrees")
assert so3.geodesic_distance(best, R_true) < math.radians(4)

# %% [markdown]
# ## Fit
#
# Position and orientation with covariance, from a start that is right to some degrees.

# %%
camera = PinholeCamera(
    image_size=(160, 160),
    f_px=torch.tensor(2200.0),
    centre_px=torch.tensor([79.5, 79.5]),
    R_cam_lab=torch.eye(3),
    T_cam_lab_mm=torch.tensor([0.0, 0.0, 500.0]),
)
filmed = SphereRenderer(texture, radius_mm=9.0, camera=camera)
truth = torch.tensor([0.6, -0.4, 0.0])
grey = 200 * filmed(R_true, truth) + torch.randn(160, 160, generator=torch.Generator().manual_seed(0))
fitter = PoseFitter(camera, texture, radius_mm=9.0, diameter_px=79.0)
fit = fitter(grey, so3.exp(torch.tensor([0.05, -0.04, 0.03], dtype=torch.float64)) @ R_true, truth)
off = math.degrees(so3.geodesic_distance(fit.R_lab_body, R_true))
sigma = math.degrees(fit.covariance[:3, :3].trace().sqrt())
print(f"off by {off:.3f} degrees, stated {sigma:.3f}; score {float(fit.score[0]):.3f}")
assert fit.success
assert off < 5 * sigma

# %% [markdown]
# A start that is too far away ends elsewhere: the fit fails, with a reason.

# %%
lost = fitter(grey, so3.exp(torch.tensor([0.0, 1.5, 0.0], dtype=torch.float64)) @ R_true, truth)
print(lost.reason, f"score {float(lost.score[0]):.2f}")
assert not lost.success

# %% [markdown]
# ## Gradients
#
# From a picture to the orientation and to the texels.

# %%
delta = torch.zeros(3, dtype=torch.float64, requires_grad=True)
loss = (filmed(so3.exp(delta) @ fit.R_lab_body, fit.position_lab_mm) - grey / 200).square().mean()
loss.backward()
print("slope by the rotation:", delta.grad)

# %% [markdown]
# ## Path
#
# Each frame has candidates; the path minimises changes of omega. Here the likelier one is wrong in every fifth frame.

# %%
frames, step = 40, 0.01
time_s = step * torch.arange(frames, dtype=torch.float64)
smooth = so3.exp(torch.stack([2 * time_s, torch.sin(5 * time_s), 0 * time_s], dim=-1))
false = so3.exp(torch.randn(frames, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)) @ smooth
candidates = torch.stack([smooth, false], dim=1)
score = torch.zeros(frames, 2, dtype=torch.float64)
score[::5, 1] = 3.0
chosen = PathLayer()(candidates, score, time_s, torch.full((frames, 2), 1e-6))
print("wrong choices:", int((chosen.choice != 0).sum()))
assert bool((chosen.choice == 0).all())
