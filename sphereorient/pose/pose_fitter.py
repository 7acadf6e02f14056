from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from sphereorient.cameras import Camera
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.locate import Background, CameraScene
from sphereorient.pose.fitter import CameraView, base_table, first_fitter

STEPS = (("coarse", 4), ("middle", 3), ("fine", 4))  # pyramid levels, and iterations at each
NOISE = 1.0  # grey levels, of a background of one grey


class PoseFitter(nn.Module):
    """Fits poses of a sphere of known texture to pictures of one or more calibrated cameras, coarse to fine.

    Args:
        cameras: one, or C of them.
        texture: (H, 2 H), the texture map, 0 black .. 1 white.
        radius_mm: of the sphere.
        diameter_px: expected diameter of the sphere's disk in the pictures.
        blur_px: standard deviation of optics, pixel and exposure together, px.
        background: (C, H, W), grey levels of the scene without the sphere; None: black.
    """

    def __init__(
        self,
        cameras: Camera | Sequence[Camera],
        texture: Tensor | NDArray[np.generic],
        *,
        radius_mm: float,
        diameter_px: float,
        blur_px: float = 0.625,
        background: Tensor | NDArray[np.generic] | None = None,
    ) -> None:
        super().__init__()
        seen = list(cameras) if isinstance(cameras, Sequence) else [cameras]
        self.register_buffer("texture", torch.as_tensor(texture).float())
        views = []
        for k, camera in enumerate(seen):
            width, height = camera.image_size
            mean = np.zeros((height, width), np.float32) if background is None else _grey(background[k])
            noise = np.full(mean.shape, NOISE, np.float32)
            scene = CameraScene(
                background=Background(mean=mean, noise=noise, full_scale=float("inf")), diameter_px=diameter_px
            )
            views.append(CameraView.of(f"camera {k + 1}", camera, scene))
        base = base_table(torch.as_tensor(texture).float().cpu(), diameter_px)
        self.fitter = first_fitter(views, radius_mm, base, blur_px)

    def forward(
        self,
        pictures: Tensor | NDArray[np.generic],
        R_lab_body: ArrayLike | Tensor,
        position_lab_mm: ArrayLike | Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return fitted R_lab_body (..., 3, 3), position_lab_mm (..., 3) and covariance (..., 6, 6), float64.
        The covariance is of delta (rad, lab) and position (mm). Pictures (..., C, H, W) are grey levels, (..., H, W)
        for a single camera; the start is right to about 10 degrees and a few pixels.

        Raises:
            ShapeError: shapes that do not fit together.
        """
        R, X = (torch.as_tensor(part, dtype=torch.float64) for part in (R_lab_body, position_lab_mm))
        check_tail("R_lab_body", R, 3, 3)
        check_tail("position_lab_mm", X, 3)
        device = self.get_buffer("texture").device
        fitter = self.fitter if device == self.fitter.device else self.fitter.on(device)
        views = fitter.views
        height, width = views[0].background.mean.shape
        grey = torch.as_tensor(pictures)
        lead = R.shape[:-2]
        if grey.shape[-2:] != (height, width) or grey.numel() != lead.numel() * len(views) * height * width:
            expected = f"(..., {len(views)}, {height}, {width}) with {lead.numel()} poses"
            raise ShapeError(
                refusal("pictures", expected=expected, got=str(tuple(grey.shape)), do="pass one picture per camera")
            )
        frames = [[_grey(one) for one in row] for row in grey.reshape(-1, len(views), height, width)]
        R, X = R.reshape(-1, 3, 3), X.expand(*lead, 3).reshape(-1, 3)
        use = torch.ones(len(R), len(views), dtype=torch.bool)
        fit = None
        for name, iterations in STEPS if len(R) else ():
            level = getattr(fitter.optics, name)
            fit = fitter.fit(fitter.pixels(frames, X, level), X, R, use, level, iterations)
            R, X = fit.R_lab_body, fit.position_lab_mm
        covariance = torch.zeros(0, 6, 6, dtype=torch.float64) if fit is None else fit.covariance
        return R.reshape(*lead, 3, 3), X.reshape(*lead, 3), covariance.reshape(*lead, 6, 6)


def _grey(picture: Tensor | NDArray[np.generic]) -> NDArray[np.float32]:
    return np.asarray(torch.as_tensor(picture).detach().cpu().numpy(), np.float32)
