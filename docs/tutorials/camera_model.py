# %% [markdown]
# # A new camera model
#
# A model is one dataclass: how slopes become pixels and back. The table `KEYS` gives the file its keys, and the
# calibration the names of its parameters. Here: the division model of Fitzgibbon 2001.

# %%
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras import add_model, load_cameras, save_cameras
from sphereorient.cameras.model import CentralCamera, Key
from sphereorient.cameras.parameters import parameter_names


@dataclass(frozen=True, kw_only=True, eq=False)
class DivisionCamera(CentralCamera):
    """Undistorted radius = r / (1 + d r^2), r in units of the focal length."""

    f_px: Tensor  # ()
    d: Tensor  # ()

    MODEL: ClassVar[str] = "division"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("f_px", "f_px", positive=True),
        Key("d", "d", default=0.0),
        Key("centre", "centre_px", ("centre_u", "centre_v"), optional=True),
    )

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px.expand(2)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Divide by 1 + d r^2."""
        r = (uv_px - self.centre_px) / self.f_px
        return self.centre_px + self.f_px * r / (1 + self.d * r.square().sum(-1, keepdim=True))

    def distort(self, uv_px: Tensor) -> Tensor:
        """Solve the quadratic equation; the root that is 1 without distortion."""
        r = (uv_px - self.centre_px) / self.f_px
        square = 4 * self.d * r.square().sum(-1, keepdim=True)
        return self.centre_px + self.f_px * 2 * r / (1 + (1 - square).sqrt())


# %% [markdown]
# ## Try it
#
# A point is projected to a pixel, and the ray of that pixel passes through the point.

# %%
camera = DivisionCamera(
    image_size=(640, 480),
    f_px=torch.tensor(700.0),
    d=torch.tensor(-0.2),
    centre_px=torch.tensor([319.5, 239.5]),
    R_cam_lab=torch.eye(3),
    T_cam_lab_mm=torch.tensor([0.0, 0.0, 300.0]),
)
point = torch.tensor([40.0, -25.0, 10.0], dtype=torch.float64)
rays = camera.rays(camera.project(point))
along = (point - rays.origin_lab_mm) @ rays.direction_lab
miss = float((rays.origin_lab_mm + along * rays.direction_lab - point).norm())
print(f"the ray misses the point by {miss:.1e} mm")
assert miss < 1e-9

# %% [markdown]
# ## Into files, calibration and tracking
#
# After `add_model`, `cameras.yaml` may hold `model: division`. Calibration, walls (`port`), triangulation and
# fits use `project` and `rays`, and find the parameters by their names.

# %%
add_model(DivisionCamera)
with TemporaryDirectory() as folder:
    path = Path(folder) / "cameras.yaml"
    save_cameras(path, {"cam1": camera})
    again = load_cameras(path)["cam1"]
assert torch.equal(again.project(point), camera.project(point))
print(parameter_names(again))
