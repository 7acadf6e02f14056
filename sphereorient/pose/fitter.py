"""The fit of poses at three levels of blur, to the pictures of all cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sphereorient.cameras import R_lab_view
from sphereorient.pose.camera_view import (
    SIZES,
    CameraView,
    FrameDisks,
    Optics,
    PyramidLevel,
    Shown,
    Steps,
    size_steps,
    widest_px,
)
from sphereorient.pose.compiled import IN_TORCH, body_of, settle_alone
from sphereorient.pose.fit import AGAIN, HOPELESS, MOST_HIDDEN, longest_near_rad
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.model import FIRST, LATER, UNSEEN, Light, SphereModel
from sphereorient.pose.neighbours import DiskPlaces, Neighbours, Spoilt, spoilt
from sphereorient.pose.pixels import Pixels, Stencil
from sphereorient.pose.poses import FittedPoses, PoseStart, moved_to
from sphereorient.pose.residuals import KNOWN
from sphereorient.sphere import orthographic_view
from sphereorient.sphere.texture_table import TextureTable

CPU = torch.device("cpu")
LEAST_LEFT = 1e-6  # least unexplained share of a picture's variance; rounding alone leaves more
DISK_PX = 32  # diameter of the disk on which the share of known paint is measured


class DisksPx(NamedTuple):
    """Where a sphere's disks lie in the pictures."""

    middle_px: Tensor  # (C, B, 2)
    largest_px: Tensor  # (B,), largest radius
    spoilt: Spoilt | None = None  # by other spheres, see `Fitter.spoilt`; None: unknown


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitter:
    """Fits poses to the pictures of all views, with known blur and light."""

    views: Sequence[CameraView]
    radius_mm: float
    optics: Optics
    light: Light
    device: torch.device = CPU  # of the fits; inputs and results are on the CPU
    widest_px: float = 0.0  # largest expected radius of a disk; 0: unknown
    limb_px: Tensor | None = None  # (C,), see `SphereModel`; None: 0
    most_hidden: float = (
        MOST_HIDDEN  # share of a disk that occluders may cover; 0: none are sought, as the model is wrong
    )
    instants: int = 1  # rendered in an exposure; 1: the sphere at rest, with motion blur as blur
    _models: dict[PyramidLevel, SphereModel] = field(default_factory=dict, init=False, repr=False)

    def model(self, level: PyramidLevel | None = None) -> SphereModel:
        """Return the measuring model at a level, by default the finest."""
        level = level or self.optics.fine
        if level not in self._models:
            first = not self.light.known and level.extra_px == 0  # high orders until the light is learnt
            self._models[level] = SphereModel(
                radius_mm=self.radius_mm,
                paint=level.paint,
                blur_px=level.blur_px,
                light=self.light,
                shading=FIRST if first else LATER,
                limb_px=self.limb_px,
                near_rad=longest_near_rad(level.blur_px, self.widest_px),
            )
        return self._models[level]

    def with_blur(self, paint: TextureTable, blur_px: float, limb_blur_px: float | None = None) -> "Fitter":
        """Return a fitter for paint and limb of other blurs, px; see `Optics`."""
        return replace(self, optics=Optics(paint, blur_px, widest_px(self.views), limb_blur_px))

    def with_light_of(self, pixels: Pixels, fit: FittedPoses, use: Tensor, *, glints: bool = True) -> "Fitter":
        """Return a fitter with light (of the same kind) and noise of fitted pictures; see `Light.learnt`."""
        return replace(self, light=self.light.learnt(pixels, fit, use, self.model(), glints=glints))

    def left(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, level: PyramidLevel | None = None, iterations: int = 3
    ) -> float:
        """Return the mean of `logs_left` after a new fit: cameras' residuals may differ tenfold."""
        begin = PoseStart(fit.position_lab_mm, fit.R_lab_body, use)
        return float(logs_left(self.fit(pixels, begin, level or self.optics.fine, iterations), use).mean())

    def on(self, device: torch.device) -> "Fitter":
        """Return a fitter that computes on another device."""
        return replace(self, optics=self.optics.to(device), light=self.light.to(device), device=device)

    def of(self, *cameras: int) -> "Fitter":
        """Return the fitter of some of the cameras."""
        limb_px = self.limb_px if self.limb_px is None else self.limb_px[list(cameras)]
        return replace(self, views=[self.views[k] for k in cameras], light=self.light.of(*cameras), limb_px=limb_px)

    def disks_px(self, position_lab_mm: Tensor) -> DisksPx:
        """Return where the disks of a sphere at (B, 3), mm, lie."""
        middles, radii = body_of(position_lab_mm).disks(self.views, position_lab_mm, self.radius_mm)
        return DisksPx(middles, radii.nan_to_num().amax(0))

    def shows_unknown(self, camera: int, position_lab_mm: Tensor, R_lab_body: Tensor) -> Tensor:
        """Return at which poses (B, 3), mm, (B, 3, 3) a camera sees hardly any known paint, (B,) bool."""
        unseen, there = self.optics.fine.paint.unseen, self.views[camera].camera
        if unseen is None:
            return torch.zeros(len(R_lab_body), dtype=torch.bool)
        R_body_view = R_lab_body.mT @ R_lab_view(there, there.project(position_lab_mm))
        normal_body = R_body_view @ orthographic_view(DISK_PX, torch.float64).normal_view.mT
        return (unseen.sample(normal_body.float())[0] < UNSEEN).double().mean(-1) < KNOWN

    def stencil(self, level: PyramidLevel, radius_px: float) -> Stencil:
        """Return the stencil of a disk of a given radius, px, at a level."""
        return level.stencil(min(radius_px, 0.5 * max(max(view.camera.image_size) for view in self.views)))

    def places(
        self,
        position_lab_mm: Tensor,
        level: PyramidLevel,
        stencil: Stencil,
        middle_px: Tensor,
        moved: Tensor | None = None,
    ) -> DiskPlaces:
        """Return where the disks of B poses lie, for `spoilt`. `moved` (B, 6): rotation (rad) and displacement (mm)
        during the exposure; None: at rest.
        """
        return DiskPlaces(
            sights=[view.sight for view in self.views],
            stencil=stencil,
            middle_px=middle_px,
            position_lab_mm=position_lab_mm,
            radius_mm=self.radius_mm,
            blur_px=level.blur_px,
            move_mm=None if moved is None or self.instants == 1 else moved[:, 3:],
        )

    def spoilt(
        self, position_lab_mm: Tensor, disks_px: DisksPx, moved: Tensor | None, neighbours: Neighbours
    ) -> Spoilt:
        """Return where neighbours spoil the disks of B poses, for `settled`; `moved` as in `places`."""
        fine = self.optics.fine
        stencil = self.stencil(fine, self.widest_px)
        return spoilt(self.places(position_lab_mm, fine, stencil, disks_px.middle_px, moved), neighbours)

    def pixels(
        self,
        pictures: Sequence[Sequence[Shown]],
        position_lab_mm: Tensor,
        level: PyramidLevel,
        radius_px: float | None = None,
        *,
        neighbours: Neighbours | None = None,
    ) -> Pixels:
        """Cut the disks of B poses out of the pictures of C views; position_lab_mm (B, 3) is right to a few pixels.
        Without `radius_px` the largest disk sets the radius, so that the last bits depend on the batch. Places that
        `neighbours` spoil are not inside, see `spoilt`.
        """
        middle_px, largest_px, _ = self.disks_px(position_lab_mm)
        if radius_px is None:
            radius_px = SIZES ** size_steps(max(1.0, float(largest_px.max())))
        stencil, hidden = self.stencil(level, radius_px), None
        if neighbours is not None:
            hidden = spoilt(self.places(position_lab_mm, level, stencil, middle_px), neighbours).hidden
        disks = FrameDisks.of(self.views, pictures, middle_px, stencil, hidden, level.extra_px)
        return disks.pixels(level.extra_px)

    def unoccluded(self, pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor) -> Pixels:
        """Return the pixels of B * C disks without occluders; see `occluded`.
        Positions (B, 3), mm, and rotations (B, 3, 3) are right to a fraction of a pixel.
        """
        if self.most_hidden == 0.0:
            return pixels
        every = torch.ones(len(position_lab_mm), len(self.views), dtype=torch.bool)
        begin = moved_to(self.device, PoseStart(position_lab_mm, R_lab_body, every))
        seen = moved_to(self.device, pixels)
        kept = body_of(begin.position_lab_mm).kept(seen, begin, self.model(), self.most_hidden)
        return replace(pixels, inside=kept.to(CPU))

    def fit(self, pixels: Pixels, begin: PoseStart, level: PyramidLevel, iterations: int) -> FittedPoses:
        """Refine B poses at one level; see `refine`."""
        begin, pixels = moved_to(self.device, begin), moved_to(self.device, pixels)
        fit = body_of(begin.position_lab_mm).refine(pixels, begin, self.model(level), iterations, 0.0)
        return moved_to(CPU, fit)

    def again(self, pixels: Pixels, fit: FittedPoses, use: Tensor) -> FittedPoses:
        """Refine fitted poses at full detail after a change of the model."""
        return self.fit(pixels, PoseStart(fit.position_lab_mm, fit.R_lab_body, use), self.optics.fine, 3)

    def fit_through(self, steps: Steps, pictures: Sequence[Sequence[Shown]], begin: PoseStart) -> FittedPoses:
        """Refine B poses step by step."""
        for level, every, iterations in steps:
            pixels = self.pixels(pictures, begin.position_lab_mm, level, neighbours=begin.among).thinned(every)
            fit = self.fit(pixels, begin, level, iterations)
            begin = begin.after(fit)
        return fit

    def settled(
        self, frames: Sequence[Sequence[Shown]], begin: PoseStart, disks_px: DisksPx | None = None
    ) -> FittedPoses:
        """Fit B poses that are right to a few degrees and pixels to the frames of C cameras, at the finest level;
        repeat while steps are long. The position's precision is used if not all cameras see the sphere, or if it is
        held. `disks_px`: precomputed `self.disks_px` of the first positions; None: computed here.
        """
        if len(frames) == 1 and (alone := self._alone(frames[0], begin)) is not None:
            return alone
        fit, near_rad = self._settled(frames, begin, disks_px), self.model().near_rad
        for _ in range(AGAIN):
            hopeful = ((fit.score > HOPELESS) & begin.use).any(1).numpy()
            rows = np.flatnonzero((np.linalg.norm(fit.step.numpy()[:, :3], axis=-1) > near_rad) & hopeful).tolist()
            if not rows:
                break
            on = begin.after(fit).of(torch.tensor(rows))
            fit = fit.with_rows(rows, self._settled([frames[k] for k in rows], on))
        return fit

    def _alone(self, frames: Sequence[Shown], begin: PoseStart) -> FittedPoses | None:
        """Fit one pose by one compiled call; None if that is impossible."""
        plain = all(isinstance(one, np.ndarray) and view.plain for one, view in zip(frames, self.views, strict=True))
        if not plain or begin.among is not None or self.device != CPU or body_of(begin.position_lab_mm) is IN_TORCH:
            return None
        shown, stencil = [np.asarray(one) for one in frames], self.stencil(self.optics.fine, self.widest_px)
        of_model = self.model(), stencil, self.instants, self.most_hidden, self.radius_mm
        return settle_alone(self.views, shown, begin, *of_model)

    def _settled(
        self,
        frames: Sequence[Sequence[Shown]],
        begin: PoseStart,
        disks_px: DisksPx | None = None,
        *,
        first: bool = True,
    ) -> FittedPoses:
        """Fit once: first with some pixels; disks of poses that moved far are cut out anew."""
        disks_px = disks_px or self.disks_px(begin.position_lab_mm)
        stencil, hidden = self.stencil(self.optics.fine, self.widest_px), None
        if begin.among is not None:
            known = disks_px.spoilt or self.spoilt(begin.position_lab_mm, disks_px, begin.moved, begin.among)
            hidden = known.hidden
        disks = FrameDisks.of(self.views, frames, disks_px.middle_px, stencil, hidden)
        model, there = self.model(), moved_to(self.device, begin)
        fit, far = body_of(there.position_lab_mm).settle(disks, there, model, self.instants, self.most_hidden, first)
        fit = moved_to(CPU, fit)
        if rows := far.nonzero()[:, 0].tolist():
            on = begin.after(fit).of(torch.tensor(rows))
            fit = fit.with_rows(rows, self._settled([frames[k] for k in rows], on, first=False))
        return fit


def logs_left(fit: FittedPoses, use: Tensor) -> Tensor:
    """Return the logarithm of the unexplained share of each picture in `use`, (n,), see `scores_of`."""
    return (1.0 - fit.score)[use].clamp_min(LEAST_LEFT).log()


def first_fitter(views: Sequence[CameraView], radius_mm: float, base: TextureTable, blur_px: float) -> Fitter:
    """Return a fitter with an assumed blur, flat light, and the scenes' noise with a little sensor noise."""
    noise = torch.tensor([[view.background.typical_noise**2, 0.02, 0.001, 0.0] for view in views])
    light = DiskLight.unknown(len(views), noise)
    return Fitter(views=views, radius_mm=radius_mm, optics=Optics(base, blur_px, widest_px(views)), light=light)
