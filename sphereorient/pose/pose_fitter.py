"""`PoseFitter`: poses from pictures without the pipeline."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from sphereorient.cameras import Camera
from sphereorient.errors import CameraError, SettingsError, ShapeError, check_finite, check_tail, refusal, tensor_of
from sphereorient.locate import Background, CameraScene
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView, base_table
from sphereorient.pose.fit import NEAR_RAD
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.poses import FittedPoses, PoseStart, blank_parts
from sphereorient.so3 import check_rotations
from sphereorient.sphere.texture import known_paint

NOISE = 1.0  # grey levels, of a uniform background
LEAST_SCORE = 0.5  # right poses have 0.9 and more, wrong ones 0.4 at most


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseFit:
    """Poses that `PoseFitter` found, of any leading shape; float64. Poses without `success` are no measurement."""

    R_lab_body: Tensor  # (..., 3, 3)
    position_lab_mm: Tensor  # (..., 3)
    covariance: Tensor  # (..., 6, 6), of delta (rad, lab) and position (mm); NaN without success
    score: Tensor  # (..., C), share of each picture's variance that the pose explains, at most 1; 0: unseen paint
    explained: Tensor  # (...) bool, whether the scores' mean is at least 0.5
    converged: Tensor  # (...) bool, whether the last step was shorter than 0.006 rad

    @property
    def success(self) -> Tensor:
        """Whether the pose explains the pictures and the fit converged, (...) bool."""
        return self.explained & self.converged

    @property
    def reason(self) -> list[str]:
        """Why each pose failed, one text per pose; empty for a success."""
        each = zip(self.explained.flatten().tolist(), self.converged.flatten().tolist(), strict=True)
        none, on = "the pose does not explain the pictures: start nearer", "the last step was long: start again here"
        return [("" if rests else on) if explains else none for explains, rests in each]


class PoseFitter(nn.Module):
    """Fits poses of a sphere of known texture to pictures of one or more calibrated cameras, coarse to fine.

    Args:
        cameras: one, or C of them.
        texture: (H, 2 H), the texture map, 0 black .. 1 white; NaN: unknown paint, not used.
        radius_mm: of the sphere.
        diameter_px: expected diameter of the sphere's disk in the pictures.
        blur_px: standard deviation of optics, pixel and exposure together, px.
        background: (C, H, W), or (H, W) for one camera, grey levels of the scene without the sphere; None: black.

    Raises:
        CameraError: not a camera, none, or cameras of different picture sizes.
        SettingsError: radius, diameter or blur not above 0.
        ShapeError: texture is not (H, 2 H), or not of numbers 0 .. 1; background of another shape than the pictures.
    """

    def __init__(
        self,
        cameras: Camera | Sequence[Camera],
        texture: Tensor | NDArray[np.generic],
        *,
        radius_mm: float,
        diameter_px: float,
        blur_px: float = FIRST_BLUR_PX,
        background: Tensor | NDArray[np.generic] | None = None,
    ) -> None:
        super().__init__()
        seen = list(cameras) if isinstance(cameras, Sequence) else [cameras]
        _check_cameras(seen)
        for name, value in (("radius_mm", radius_mm), ("diameter_px", diameter_px), ("blur_px", blur_px)):
            if not value > 0:
                raise SettingsError(refusal(name, expected="a number above 0", got=f"{value:g}", do="measure it"))
        paint, hidden = known_paint(texture)
        self.register_buffer("texture", paint.float())
        views = []
        for k, (camera, mean) in enumerate(zip(seen, _scenes(background, seen), strict=True)):
            noise = np.full(mean.shape, NOISE, np.float32)
            scene = CameraScene(
                background=Background(mean=mean, noise=noise, full_scale=float("inf")), diameter_px=diameter_px
            )
            views.append(CameraView.of(f"camera {k + 1}", camera, scene))
        base = base_table(self.get_buffer("texture").cpu(), diameter_px, None if hidden is None else hidden.cpu())
        self.fitter = first_fitter(views, radius_mm, base, blur_px)

    def forward(
        self,
        pictures: Tensor | NDArray[np.generic],
        R_lab_body: ArrayLike | Tensor,
        position_lab_mm: ArrayLike | Tensor,
    ) -> PoseFit:
        """Return the poses found from a start (..., 3, 3), (..., 3), and whether they are right.
        Pictures (..., C, H, W) are grey levels, (..., H, W) for a single camera; the start is right to about 10 degrees
        and a few pixels.

        Raises:
            ShapeError: shapes that do not agree, starts that are no rotations, pictures that are not finite.
        """
        R, X = tensor_of("R_lab_body", R_lab_body).double(), tensor_of("position_lab_mm", position_lab_mm).double()
        check_rotations("R_lab_body", R)
        check_tail("position_lab_mm", X, 3)
        device = self.get_buffer("texture").device
        fitter = self.fitter if device == self.fitter.device else self.fitter.on(device)
        views = fitter.views
        height, width = views[0].background.mean.shape
        grey = tensor_of("pictures", pictures)
        lead = R.shape[:-2]
        if grey.shape[-2:] != (height, width) or grey.numel() != lead.numel() * len(views) * height * width:
            expected = f"(..., {len(views)}, {height}, {width}) with {lead.numel()} poses"
            raise ShapeError(
                refusal("pictures", expected=expected, got=str(tuple(grey.shape)), do="pass one picture per camera")
            )
        check_finite("pictures", grey)
        frames = [[_grey(one) for one in row] for row in grey.reshape(-1, len(views), height, width)]
        R, X = R.reshape(-1, 3, 3), _of_each(X, lead).reshape(-1, 3)
        use = torch.ones(len(R), len(views), dtype=torch.bool)
        fit = FittedPoses(**blank_parts(len(views), 0))
        if len(R):
            fit = fitter.fit_through(fitter.optics.steps, frames, PoseStart(X, R, use))
        seen = (fit.score != 0).sum(1).clamp_min(1)  # cameras that see hardly any known paint have 0
        explained, converged = fit.score.sum(1) >= LEAST_SCORE * seen, fit.step[:, :3].norm(dim=1) < NEAR_RAD
        found = {name: getattr(fit, name) for name in ("R_lab_body", "position_lab_mm", "score")}
        found |= {"explained": explained, "converged": converged}
        found["covariance"] = torch.where((explained & converged)[:, None, None], fit.covariance, torch.nan)
        return PoseFit(**{name: part.reshape((*lead, *part.shape[1:])) for name, part in found.items()})


def _check_cameras(cameras: Sequence[Camera]) -> None:
    do = "pass one of load_cameras(path).values(), or a list of them"
    for one in cameras:
        if not hasattr(one, "image_size"):
            raise CameraError(refusal("cameras", expected="cameras", got=type(one).__name__, do=do))
    if not cameras:
        raise CameraError(refusal("cameras", expected="one or more", got="none", do=do))
    sizes = [f"{width} x {height} px" for width, height in dict.fromkeys(one.image_size for one in cameras)]
    if len(sizes) > 1:
        do = "pad the pictures to one size, with image_size to match"
        raise CameraError(refusal("cameras", expected="one picture size", got=", ".join(sizes), do=do))


def _scenes(background: Tensor | NDArray[np.generic] | None, cameras: Sequence[Camera]) -> list[NDArray[np.float32]]:
    """Return the background (H, W) of each of C cameras, from (C, H, W), or (H, W) for one; None: black."""
    width, height = cameras[0].image_size
    if background is None:
        return [np.zeros((height, width), np.float32) for _ in cameras]
    scenes = [_grey(one) for one in (background[None] if np.ndim(background) == 2 else background)]
    if [one.shape for one in scenes] != [(height, width)] * len(cameras):
        expected, got = f"shape ({len(cameras)}, {height}, {width})", str(tuple(np.shape(background)))
        raise ShapeError(refusal("background", expected=expected, got=got, do="pass one scene per camera"))
    return scenes


def _of_each(position_lab_mm: Tensor, lead: torch.Size) -> Tensor:
    """Return positions for all poses, (*lead, 3); raise ShapeError for another number of them."""
    try:
        return position_lab_mm.expand(*lead, 3)
    except RuntimeError as error:
        expected, got = f"shape {(*lead, 3)} or (3,)", str(tuple(position_lab_mm.shape))
        do = "pass one position per pose, or one for all"
        raise ShapeError(refusal("position_lab_mm", expected=expected, got=got, do=do)) from error


def _grey(picture: Tensor | NDArray[np.generic]) -> NDArray[np.float32]:
    return np.asarray(torch.as_tensor(picture).detach().cpu().numpy(), np.float32)
