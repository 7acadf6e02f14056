"""The fit at three levels of blur, and what it needs of each camera; `PoseFitter`: alone."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from sphereorient.cameras import Camera, R_lab_view, centre_lab_mm, holds_disk, sphere_disk_px, sphere_radius_px
from sphereorient.errors import CameraError, SettingsError, ShapeError, check_finite, check_tail, refusal, tensor_of
from sphereorient.locate import Background, CameraScene
from sphereorient.movies import OnDemand
from sphereorient.pose.compiled import refined
from sphereorient.pose.fit import FittedPoses, learn_light, refine
from sphereorient.pose.lab_light import lab_lights, learn_lab_light
from sphereorient.pose.model import FIRST, LATER, UNSEEN, Light, Lighting, SphereModel
from sphereorient.pose.neighbours import DiskPlaces, Neighbours, Spoilt, spoilt
from sphereorient.pose.occluders import MOST_HIDDEN, unoccluded
from sphereorient.pose.pixels import LinesOfSight, Pixels, Stencil, cut_pixels, disk_stencil, stacked, window_of
from sphereorient.pose.residuals import KNOWN
from sphereorient.pose.start import PoseStart
from sphereorient.so3 import check_rotations
from sphereorient.sphere import orthographic_view
from sphereorient.sphere.texture import as_texture
from sphereorient.sphere.texture_table import BASE_RAD, SIDE, TextureTable, texture_table

Picture = NDArray[np.generic]
Shown = Picture | OnDemand  # of which fits cut out disks
Record = TypeVar("Record", Pixels, PoseStart, FittedPoses)

RIM = 2.5  # standard deviations of the blur beyond the limb to which pixels are looked at
SIZES = 1.06  # ratio of neighbouring stencil sizes
CPU = torch.device("cpu")
FINEST_PX = 0.4  # least blur of any picture, px: a pixel alone has 0.29
COARSE, MIDDLE = 0.07, 0.03  # blur laid over a picture before a coarse fit, in radii of the disk
SOFT, SOFT_PX = 0.06, 1.5  # radii, px: templates of pictures that are blurred by more than both are blurred as well
FINER_SIDES = 2  # of the usual table, for disks of over 100 px: 16 MB
FIRST_BLUR_PX = 0.625  # first blur of sharp pictures: a pixel's own width and a good lens

FEWEST_LIT = 8  # rows of poses from which the light in the lab is learnt
CLEARLY_MORE = 2.0  # standard errors of the gain by which it must leave less
MORE_EXPLAINED, HOPELESS = (
    0.05,
    0.2,
)  # share of the variance by which it may leave more, and by which it never gets less
LEAST_LEFT = 1e-6  # of a picture's variance; rounding leaves more
DISK_PX = 32  # of the disk on which the share of known paint is counted
NOISE = 1.0  # grey levels, of a background of one grey


class DisksPx(NamedTuple):
    """Where a sphere's disks lie in the pictures; made by `Fitter.disks_px`."""

    middle_px: Tensor  # (C, B, 2)
    largest_px: Tensor  # (B,), the largest radius
    spoilt: Spoilt | None = None  # by other spheres, see `Fitter.spoilt`; None: not known


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView:
    """One calibrated camera and its movie's empty scene; made by the pipeline, read by the fits."""

    name: str
    camera: Camera
    background: Background
    diameter_px: float  # of the sphere in the middle of the volume
    sight: LinesOfSight
    merit_min: float = 0.0  # see `CameraScene`

    @classmethod
    def of(cls, name: str, camera: Camera, scene: CameraScene) -> "CameraView":
        """Return the view of a camera whose scene is known."""
        return cls(name=name, camera=camera, sight=LinesOfSight(camera), **vars(scene))

    @property
    def scene(self) -> CameraScene:
        """What is known of the camera's movie."""
        return CameraScene(background=self.background, diameter_px=self.diameter_px, merit_min=self.merit_min)

    def radius_px(self, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
        """Return the radius (...), px, of the sphere's picture at positions (..., 3), mm, along the camera's x."""
        return sphere_radius_px(self.camera, position_lab_mm, radius_mm)

    def smear_px(self, position_lab_mm: Tensor, moved: Tensor, radius_mm: float) -> Tensor:
        """Return how far the middle of the disk moves in the picture, (B,), px, of spheres at (B, 3), mm.
        `moved` (B, 6): turn (rad) and move (mm) of the sphere while the shutter is open.
        """
        sight = torch.nn.functional.normalize(position_lab_mm - centre_lab_mm(self.camera), dim=-1)
        front = moved[:, 3:] + torch.linalg.cross(moved[:, :3], -radius_mm * sight)
        across = front - (front * sight).sum(-1, keepdim=True) * sight
        smear: Tensor = across.norm(dim=-1) * self.radius_px(position_lab_mm, radius_mm) / radius_mm
        return smear

    def shows_whole(self, centre_px: Tensor, radius_px: Tensor) -> Tensor:
        """Return whether the picture holds the whole disk, (...) bool, of centres (..., 2) and radii (...), px."""
        return holds_disk(self.camera, centre_px, radius_px)


def widest_px(views: Sequence[CameraView]) -> float:
    """Return the expected diameter of the sphere, px, in the camera that sees it largest."""
    return max(view.diameter_px for view in views)


def unknown_light(views: Sequence[CameraView]) -> Light:
    """Return the light of the first fits: flat, with the scene's noise and a little sensor noise."""
    noise = torch.tensor([[view.background.typical_noise**2, 0.02, 0.001, 0.0] for view in views])
    return Light.unknown(len(views), noise)


@dataclass(frozen=True, kw_only=True, eq=False)
class PyramidLevel:
    """One width of detail: what is laid over the picture, which pixels are looked at, the paint as blurred."""

    extra_px: float
    blur_px: float
    paint: TextureTable

    def stencil(self, radius_px: float) -> Stencil:
        """Return the places of a disk of some radius."""
        return disk_stencil(radius_px + RIM * self.blur_px, max(1, round(self.extra_px)))


Steps = Sequence[tuple[PyramidLevel, int, int]]  # of a fit: level, every n-th pixel, iterations
Rivals = tuple[FittedPoses, FittedPoses, Tensor] | None  # fits of the same pictures by two models, and `use` (B, C)


class Optics:
    """Texture tables at the levels of blur of the fits: pictures of blur `blur_px` and disks of `diameter_px`, px."""

    def __init__(self, base: TextureTable, blur_px: float, diameter_px: float) -> None:
        self.blur_px = blur_px
        self._radius_px = diameter_px / 2
        self.fine = level_of(base, blur_px, 0.0, self._radius_px)

    # Each from the one before: a wider blur allows a smaller table.
    @cached_property
    def middle(self) -> PyramidLevel:
        """The level of a fit that is right to a few degrees."""
        return level_of(self.fine.paint, self.blur_px, MIDDLE * self._radius_px, self._radius_px)

    @cached_property
    def coarse(self) -> PyramidLevel:
        """The level of a fit from a candidate."""
        return level_of(self.middle.paint, self.blur_px, COARSE * self._radius_px, self._radius_px)

    @property
    def steps(self) -> Steps:
        """The steps of a fit from poses that are roughly right to all detail."""
        return (self.coarse, 1, 4), (self.middle, 1, 3), (self.fine, 1, 4)

    def to(self, device: torch.device) -> "Optics":
        """Return the same with its tables on another device."""
        moved = copy(self)
        for name in ("fine", "middle", "coarse"):
            level: PyramidLevel = getattr(self, name)
            setattr(moved, name, replace(level, paint=level.paint.to(device)))
        return moved


def level_of(base: TextureTable, blur_px: float, extra_px: float, radius_px: float) -> PyramidLevel:
    """Return the level at which `extra_px` of blur are laid over pictures of blur `blur_px`."""
    whole = math.hypot(blur_px, extra_px)
    return PyramidLevel(extra_px=extra_px, blur_px=whole, paint=base.blurred(whole / radius_px))


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitter:
    """Fits poses to the pictures of all views; made by the pipeline once blur and light are known."""

    views: Sequence[CameraView]
    radius_mm: float
    optics: Optics
    light: Lighting
    device: torch.device = CPU  # of the fits; inputs and results are on the CPU
    widest_px: float = 0.0  # radius of a disk as large as any that is expected; 0 where nothing is known
    limb_px: Tensor | None = None  # (C,), see `SphereModel`; None: 0
    most_hidden: float = MOST_HIDDEN  # share of a disk that occluders may cover; 0: the model is wrong, none are sought
    instants: int = 1  # of the exposure that fits render; 1: the sphere as if at rest, the blur holds its motion

    @cached_property
    def fine_model(self) -> SphereModel:
        """What the pictures of the finest level depend on."""
        return self._model(self.optics.fine)

    def model(self, level: PyramidLevel) -> SphereModel:
        """Return what the pictures of a level depend on."""
        return self.fine_model if level is self.optics.fine else self._model(level)

    def _model(self, level: PyramidLevel) -> SphereModel:
        shading = LATER if self.light.known or level.extra_px > 0 else FIRST  # high orders while nothing is learnt
        return SphereModel(
            radius_mm=self.radius_mm,
            paint=level.paint,
            blur_px=level.blur_px,
            light=self.light,
            shading=shading,
            limb_px=self.limb_px,
        )

    def with_light_of(self, pixels: Pixels, fit: FittedPoses, use: Tensor, *, glints: bool = True) -> "Fitter":
        """Return a fitter with the light and the noise of fitted pictures; see `learn_light`."""
        return replace(self, light=learn_light(pixels, fit, use, self.model(self.optics.fine), glints=glints))

    def lit_in_the_lab(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, *, preferred: bool = False
    ) -> tuple["Fitter", FittedPoses, Rivals]:
        """Return a fitter with one light in the lab for all cameras, and its fit, if maps of the disks explain less.
        Both are learnt from every other row of `use` (B, C); what counts is what they leave in the pictures of the rows
        between, beside its standard error. Return the fits of these rows by both where neither explains clearly more.
        `preferred`: where it does not explain clearly less.
        """
        fine = self.optics.fine
        if len(use) < FEWEST_LIT:
            return self, fit, None

        every = torch.arange(len(use))
        learning, held = (some_of(rows, pixels, fit, use) for rows in (every[::2], every[1::2]))
        maps, lit = self.with_light_of(*learning), self
        maps_leave = maps.logs_left(*held)
        for light in lab_lights(*learning, self.model(fine)):
            lit = replace(self, light=light)
            gains = maps_leave - lit.logs_left(*held)
            gain, error = float(gains.mean()), float(gains.std()) / math.sqrt(len(gains))
            if gain < -HOPELESS:  # half-way, too
                return self, fit, None
        if gain < (-MORE_EXPLAINED if preferred else CLEARLY_MORE * error):
            return self, fit, (maps.again(*held), lit.again(*held), held[2]) if gain > -MORE_EXPLAINED else None
        for _ in range(4):  # the poses, too, were found with the maps
            lit = lit.lit_again(pixels, fit, use)
            fit = lit.again(pixels, fit, use)
        return lit, fit, None

    def lit_again(self, pixels: Pixels, fit: FittedPoses, use: Tensor) -> "Fitter":
        """Return a fitter whose light, of the same kind, and noise are learnt anew from fitted pictures."""
        if isinstance(self.light, Light):
            return self.with_light_of(pixels, fit, use)
        return replace(self, light=learn_lab_light(pixels, fit, use, self.model(self.optics.fine)))

    def left(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, level: PyramidLevel | None = None, iterations: int = 3
    ) -> float:
        """Return the mean of `logs_left`: the pictures of one camera may be left ten times as much as of another."""
        return float(self.logs_left(pixels, fit, use, level, iterations).mean())

    def logs_left(
        self, pixels: Pixels, fit: FittedPoses, use: Tensor, level: PyramidLevel | None = None, iterations: int = 3
    ) -> Tensor:
        """Return the logarithm of what poses fitted anew leave in each picture of `use`, (n,), see `scores_of`."""
        level = level or self.optics.fine
        score = self.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, level, iterations).score
        return (1.0 - score)[use].clamp_min(LEAST_LEFT).log()

    def on(self, device: torch.device) -> "Fitter":
        """Return a fitter that computes on another device."""
        return replace(self, optics=self.optics.to(device), light=self.light.to(device), device=device)

    def of(self, *cameras: int) -> "Fitter":
        """Return the fitter of some cameras by themselves."""
        limb_px = self.limb_px if self.limb_px is None else self.limb_px[list(cameras)]
        return replace(self, views=[self.views[k] for k in cameras], light=self.light.of(*cameras), limb_px=limb_px)

    def disks_px(self, position_lab_mm: Tensor) -> DisksPx:
        """Return where the disks lie that a sphere at (B, 3), mm, shows."""
        disks = [sphere_disk_px(view.camera, position_lab_mm, self.radius_mm) for view in self.views]
        middles, radii = (torch.stack(parts) for parts in zip(*disks, strict=True))
        return DisksPx(middles, radii.nan_to_num().amax(0))

    def largest_px(self, position_lab_mm: Tensor) -> Tensor:
        """Return the radius (B,), px, of the largest disk that a sphere at positions (B, 3) shows in any picture."""
        return self.disks_px(position_lab_mm).largest_px

    def shows_unknown(self, camera: int, position_lab_mm: Tensor, R_lab_body: Tensor) -> Tensor:
        """Return which poses (B, 3), mm, (B, 3, 3) turn hardly any known paint to a camera, (B,) bool."""
        unseen, there = self.optics.fine.paint.unseen, self.views[camera].camera
        if unseen is None:
            return torch.zeros(len(R_lab_body), dtype=torch.bool)
        R_body_view = R_lab_body.mT @ R_lab_view(there, there.project(position_lab_mm))
        normal_body = R_body_view @ orthographic_view(DISK_PX, torch.float64).normal_view.mT
        return (unseen.sample(normal_body.float())[0] < UNSEEN).double().mean(-1) < KNOWN

    def stencil(self, level: PyramidLevel, radius_px: float) -> Stencil:
        """Return the places of a disk of some radius, px, at a level."""
        return level.stencil(min(radius_px, 0.5 * max(self.views[0].camera.image_size)))

    def decoded(
        self, pictures: Sequence[Sequence[Shown]], middle_px: Tensor, stencil: Stencil, blur_px: float = 0.0
    ) -> list[list[Picture]]:
        """Return pictures that hold at least the disks about `middle_px` (C, B, 2), and what a blur reads around."""
        middles = middle_px.nan_to_num().tolist()

        def window(b: int, c: int) -> tuple[int, int, int, int]:
            return window_of(middles[c][b], stencil, blur_px, self.views[c].sight.size)

        for b, frames in enumerate(pictures):
            for c, frame in enumerate(frames):
                if isinstance(frame, OnDemand):  # all of them, before the first is waited for
                    frame.ask(*window(b, c))
        return [
            [frame.part(*window(b, c)) if isinstance(frame, OnDemand) else frame for c, frame in enumerate(frames)]
            for b, frames in enumerate(pictures)
        ]

    def pixels(
        self,
        pictures: Sequence[Sequence[Shown]],
        position_lab_mm: Tensor,
        level: PyramidLevel,
        radius_px: float | None = None,
        moved: Tensor | None = None,
        disks_px: DisksPx | None = None,
        neighbours: Neighbours | None = None,
    ) -> Pixels:
        """Cut the disks of B poses out of the pictures of C views; position_lab_mm (B, 3) is right to a few pixels.
        Without `radius_px` the largest disk sets it, so that the last bits depend on the batch. `moved` (B, 6): the
        sphere's turn (rad) and move (mm) while the shutter is open; None: unknown, as if at rest. `disks_px`: what
        the method of this name tells of these positions, where that is known. Places that `neighbours` spoil are not
        inside, see `spoilt`.
        """
        middle_px, largest_px, _ = disks_px or self.disks_px(position_lab_mm)
        middles = middle_px.nan_to_num().tolist()
        if radius_px is None:
            radius_px = max(1.0, float(largest_px.max()))
            radius_px = SIZES ** size_steps(radius_px)
        stencil = self.stencil(level, radius_px)
        pictures = self.decoded(pictures, middle_px, stencil, level.extra_px)
        disks = []
        for b, frames in enumerate(pictures):
            for c, (view, frame) in enumerate(zip(self.views, frames, strict=True)):
                disks.append(cut_pixels(frame, view.background, view.sight, middles[c][b], stencil, level.extra_px))
        pixels = self.exposed(stacked(disks), moved)
        if neighbours is None:
            return pixels
        hidden = spoilt(self.places(position_lab_mm, level, stencil, middle_px, moved), neighbours).hidden
        return pixels if hidden is None else replace(pixels, inside=pixels.inside & ~hidden)

    def places(
        self,
        position_lab_mm: Tensor,
        level: PyramidLevel,
        stencil: Stencil,
        middle_px: Tensor,
        moved: Tensor | None = None,
    ) -> DiskPlaces:
        """Return where the disks of B poses lie, for `spoilt`; arguments as of `pixels`."""
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
        """Return where neighbours spoil the disks of B poses, for fits of `settled`; arguments as of `pixels`."""
        fine = self.optics.fine
        stencil = self.stencil(fine, self.widest_px)
        return spoilt(self.places(position_lab_mm, fine, stencil, disks_px.middle_px, moved), neighbours)

    def exposed(self, pixels: Pixels, moved: Tensor | None) -> Pixels:
        """Return the pixels of B * C disks with the sphere's motion (B, 6) while the shutter is open; None: at rest."""
        if moved is None or self.instants == 1:
            return pixels
        return replace(pixels, moved=moved.repeat_interleave(len(self.views), 0), instants=self.instants)

    def unoccluded(self, pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor) -> Pixels:
        """Return the pixels of B * C disks without those that something before the sphere shows; see `occluded`.
        Positions (B, 3), mm, and rotations (B, 3, 3) are right to a fraction of a pixel.
        """
        if self.most_hidden == 0.0:
            return pixels
        there, model, cameras = moved_to(self.device, pixels), self.model(self.optics.fine), len(self.views)
        X, R = (part.to(self.device).double() for part in (position_lab_mm, R_lab_body))
        every = torch.ones(len(X), cameras, dtype=torch.bool)
        done = refined(there, X, R, model, every, most_hidden=self.most_hidden)
        kept = unoccluded(there, X, R, model, cameras, self.most_hidden).inside if done is None else done[0]
        return replace(pixels, inside=kept.to(CPU))

    def fit(
        self,
        pixels: Pixels,
        position_lab_mm: Tensor,
        R_lab_body: Tensor,
        use: Tensor,
        level: PyramidLevel,
        iterations: int,
        place_precision: Tensor | None = None,
        most_hidden: float = 0.0,
    ) -> FittedPoses:
        """Refine B poses at one level; see `refine`."""
        begin = PoseStart(
            position_lab_mm=position_lab_mm, R_lab_body=R_lab_body, use=use, place_precision=place_precision
        )
        there, begin = moved_to(self.device, pixels), moved_to(self.device, begin)
        return moved_to(CPU, refine(there, begin, self.model(level), iterations, most_hidden))

    def again(self, pixels: Pixels, fit: FittedPoses, use: Tensor) -> FittedPoses:
        """Refine fitted poses in all detail, once the model is another."""
        return self.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, self.optics.fine, 3)

    def fit_through(
        self,
        steps: Steps,
        pictures: Sequence[Sequence[Shown]],
        position_lab_mm: Tensor,
        R_lab_body: Tensor,
        use: Tensor,
        place_precision: Tensor | None = None,
        held: bool = False,
        neighbours: Neighbours | None = None,
    ) -> FittedPoses:
        """Refine B poses step by step; `held`: each from the first position."""
        X, R = position_lab_mm, R_lab_body
        for level, every, iterations in steps:
            pixels = self.pixels(pictures, X, level, neighbours=neighbours).thinned(every)
            fit = self.fit(pixels, X, R, use, level, iterations, place_precision)
            X, R = X if held else fit.position_lab_mm, fit.R_lab_body
        return fit


def moved_to(device: torch.device, record: Record) -> Record:
    """Return a record with its tensors on a device; all of them are on one."""
    if next(part for part in vars(record).values() if isinstance(part, Tensor)).device == device:
        return record
    parts = {field.name: getattr(record, field.name) for field in fields(record)}
    moved: dict[str, Any] = {name: part.to(device) for name, part in parts.items() if isinstance(part, Tensor)}
    return replace(record, **moved)


def some_of(rows: Tensor, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Pixels, FittedPoses, Tensor]:
    """Return some rows of poses, of their B * C disks, and of `use` (B, C), by index."""
    cameras = use.shape[1]
    return pixels.where((rows[:, None] * cameras + torch.arange(cameras)).reshape(-1)), fit.of(rows), use[rows]


def base_table(texture: Tensor, diameter_px: float, unseen: Tensor | None = None) -> TextureTable:
    """Return the finest table of a map that disks of some diameter resolve; all others are blurred from it.
    `unseen` (H, 2 H) bool: texels that are no paint.
    """
    blur_rad = max(FINEST_PX * 2 / diameter_px, BASE_RAD / FINER_SIDES)
    finer = 1 << max(0, math.ceil(math.log2(BASE_RAD / blur_rad)))  # large disks resolve smaller cells
    return texture_table(texture, blur_rad, finer * SIDE, unseen)


def first_fitter(views: Sequence[CameraView], radius_mm: float, base: TextureTable, blur_px: float) -> Fitter:
    """Return a fitter with an assumed blur, and flat light."""
    optics = Optics(base, blur_px, widest_px(views))
    return Fitter(views=views, radius_mm=radius_mm, optics=optics, light=unknown_light(views))


def size_steps(ratio: float) -> int:
    """Return how many steps of `SIZES` a ratio of stencil sizes needs."""
    return math.ceil(math.log(ratio) / math.log(SIZES))


def defocus_radii(blur_px: float, diameter_px: float) -> float:
    """Return the blur of pictures, radii, as the search needs it: 0 unless they are defocused."""
    blur = 2 * blur_px / diameter_px
    return blur if blur > SOFT and blur_px > SOFT_PX else 0.0


class PoseFitter(nn.Module):
    """Fits poses of a sphere of known texture to pictures of one or more calibrated cameras, coarse to fine.

    Args:
        cameras: one, or C of them.
        texture: (H, 2 H), the texture map, 0 black .. 1 white.
        radius_mm: of the sphere.
        diameter_px: expected diameter of the sphere's disk in the pictures.
        blur_px: standard deviation of optics, pixel and exposure together, px.
        background: (C, H, W), grey levels of the scene without the sphere; None: black.

    Raises:
        CameraError: something else than cameras.
        SettingsError: radius or diameter not above 0.
        ShapeError: texture is not (H, 2 H), or not of numbers 0 .. 1.
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
        for one in seen:
            if not hasattr(one, "image_size"):
                do = "pass one of load_cameras(path).values(), or a list of them"
                raise CameraError(refusal("cameras", expected="cameras", got=type(one).__name__, do=do))
        for name, value in (("radius_mm", radius_mm), ("diameter_px", diameter_px)):
            if not value > 0:
                raise SettingsError(refusal(name, expected="a number above 0", got=f"{value:g}", do="measure it"))
        self.register_buffer("texture", as_texture(texture).float())
        views = []
        for k, camera in enumerate(seen):
            width, height = camera.image_size
            mean = np.zeros((height, width), np.float32) if background is None else _grey(background[k])
            noise = np.full(mean.shape, NOISE, np.float32)
            scene = CameraScene(
                background=Background(mean=mean, noise=noise, full_scale=float("inf")), diameter_px=diameter_px
            )
            views.append(CameraView.of(f"camera {k + 1}", camera, scene))
        base = base_table(self.get_buffer("texture").cpu(), diameter_px)
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
            ShapeError: shapes that do not fit together, starts that are no rotations, pictures that are not finite.
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
        R, X = R.reshape(-1, 3, 3), X.expand(*lead, 3).reshape(-1, 3)
        use = torch.ones(len(R), len(views), dtype=torch.bool)
        covariance = torch.zeros(len(R), 6, 6, dtype=torch.float64)
        if len(R):
            fit = fitter.fit_through(fitter.optics.steps, frames, X, R, use)
            R, X, covariance = fit.R_lab_body, fit.position_lab_mm, fit.covariance
        return R.reshape(*lead, 3, 3), X.reshape(*lead, 3), covariance.reshape(*lead, 6, 6)


def _grey(picture: Tensor | NDArray[np.generic]) -> NDArray[np.float32]:
    return np.asarray(torch.as_tensor(picture).detach().cpu().numpy(), np.float32)
