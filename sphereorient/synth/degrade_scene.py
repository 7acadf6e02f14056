"""Changes of a filmed scene by degradations: settings, map, pictures, and reported inputs."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, TsaiCamera
from sphereorient.sphere import sample_texture
from sphereorient.sphere.renderer import rim_directions
from sphereorient.sphere.texture import map_directions
from sphereorient.synth.degrade import (
    BEYOND,
    FIELDS,
    NOISE,
    ON_THE_BALL,
    OPERATIONS,
    Disk,
    blur_reach,
    degrade,
    gain_to_clip,
    lost_frames,
)
from sphereorient.synth.scene import Exposure, expose, make_scene, seeded
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.severities import DEGRADATIONS, degradation

BARE = 0.5  # grey of bare patches
WAVES, WAVE_RATES = 24, (6.0, 12.0)  # patches: waves, and rates for periods of 30 to 60 degrees
MASK_ROWS = 128  # height of the patch map: finer than the patches' borders
SMEAR_PX = 1.0  # largest motion between exposure samples


def degraded_settings(base: SynthSettings, values: Mapping[str, float]) -> SynthSettings:
    """Return the settings with ball_size, spin and motion_blur applied, in this order."""
    settings = base
    for name, change in (("ball_size", with_ball_size), ("spin", with_spin), ("motion_blur", with_motion_blur)):
        if name in values:
            settings = change(settings, values[name])
    return settings


def with_ball_size(base: SynthSettings, diameter_px: float) -> SynthSettings:
    """Return settings with another pixel size: picture and sphere scale together."""
    scale = diameter_px / base.diameter_px
    width, height = (max(8, round(side * scale)) for side in base.image_size)
    return _changed(base, diameter_px=diameter_px, image_size=(width, height))


def with_spin(base: SynthSettings, degrees_per_frame: float) -> SynthSettings:
    """Return settings with this rotation per frame, rms of |omega|; a shorter exposure keeps the motion blur."""
    omega_rms = math.radians(degrees_per_frame) * base.frame_rate / math.sqrt(3)
    shorter = min(1.0, base.omega_rms / omega_rms) if omega_rms > 0 else 1.0
    return _changed(base, omega_rms=omega_rms, exposure=base.exposure * shorter)


def with_motion_blur(base: SynthSettings, degrees_per_exposure: float) -> SynthSettings:
    """Return settings with this rotation per exposure, rms of |omega|: longer exposure first, then faster rotation."""
    turn = math.radians(degrees_per_exposure)
    spin = base.omega_rms * math.sqrt(3)
    exposure = min(turn / spin, 1 / base.frame_rate) if spin > 0 else 1 / base.frame_rate
    omega_rms = max(base.omega_rms, turn / exposure / math.sqrt(3)) if exposure > 0 else base.omega_rms
    turned_px = turn * base.diameter_px / 2
    moved_px = math.sqrt(3) * base.velocity_rms * 1000 * exposure * base.diameter_px / base.diameter_mm
    # Half more than the rms of both, so that most of the movie is sampled finely enough.
    samples = math.ceil(1.5 * math.hypot(turned_px, moved_px) / SMEAR_PX)
    samples = max(base.exposure_samples, samples)
    return _changed(base, exposure=exposure, omega_rms=omega_rms, exposure_samples=samples)


def _changed(base: SynthSettings, **update: object) -> SynthSettings:
    return SynthSettings.model_validate(base.model_dump() | update)


def worn(texture: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Return maps (..., H, 2 H) with grey `BARE` patches on this share of the sphere's area."""
    degradation("paint_wear").check(share)
    return torch.where(random_patches(texture, share, rng), torch.full_like(texture, BARE), texture)


def misdrawn(texture: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Return maps (..., H, 2 H) with black and white exchanged on this share of the sphere's area."""
    degradation("texture_error").check(share)
    return torch.where(random_patches(texture, share, rng), 1 - texture, texture)


def random_patches(texture: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Draw seamless patches on this share of the sphere's area, bool, shape of the maps (..., H, 2 H)."""
    if share == 0:
        return torch.zeros_like(texture, dtype=torch.bool)
    height, lead = texture.shape[-2], texture.shape[:-2]
    draw = torch.rand((*lead, WAVES, 4), generator=rng, dtype=torch.float64, device=rng.device).cpu()
    up = 2 * draw[..., 0] - 1
    around, phase = 2 * math.pi * draw[..., 1], 2 * math.pi * draw[..., 2]
    rate = WAVE_RATES[0] + (WAVE_RATES[1] - WAVE_RATES[0]) * draw[..., 3]
    level = (1 - up.square()).sqrt()
    wave = rate[..., None] * torch.stack([level * around.cos(), level * around.sin(), up], dim=-1)
    angle = map_directions(MASK_ROWS) @ wave.mT[..., None, :, :] + phase[..., None, None, :]
    fields = angle.cos().sum(-1)
    if height != MASK_ROWS:
        body = map_directions(height)
        finer = [sample_texture(field, body) for field in fields.reshape(-1, *fields.shape[-2:])]
        fields = torch.stack(finer).reshape(texture.shape) if finer else fields.new_zeros(texture.shape)
    area = map_directions(height)[..., :2].norm(dim=-1).flatten()  # texel area: cosine of the latitude
    rising = fields.flatten(-2).sort(-1)
    below = area[rising.indices].cumsum(-1) / area.sum()
    last = (below < share).sum(-1, keepdim=True).clamp_max(below.shape[-1] - 1)
    return (fields <= rising.values.gather(-1, last)[..., None]).to(texture.device)


def through_optics(
    exposure: Exposure, disk: Disk, values: Mapping[str, float], rng: Callable[[str], torch.Generator]
) -> Exposure:
    """Return an exposure with the degradations `ON_THE_BALL` in `values`, then blurred by the optics; `rng` by name."""
    ball = replace(disk.within(exposure.window), cover=torch.from_numpy(exposure.cover), behind=torch.zeros(()))
    light = torch.from_numpy(exposure.light)
    for name in ON_THE_BALL:
        if name in values:
            light = degrade(light, ball, {name: values[name]}, rng(name))
    return replace(exposure, light=light.numpy()).through_optics()


class Filming:
    """Apply degradations of map, pictures and movie, name -> physical value, each with its own random numbers."""

    def __init__(self, settings: SynthSettings, values: Mapping[str, float], cameras: Mapping[str, Camera]) -> None:
        self.settings = settings
        self.values = dict(values)
        self.cameras = cameras
        without = {name: DEGRADATIONS[name].nothing for name in OPERATIONS}
        self.applied = tuple(name for name, value in without.items() if self.values.get(name, value) != value)
        self.optics = tuple(name for name in self.applied if name not in (*ON_THE_BALL, *NOISE))
        size = {name: camera.image_size[::-1] for name, camera in cameras.items()}
        self.fields = {
            (name, what): draw(torch.empty(size[name]), self.values[what], self._generator(what, name))
            for name in cameras
            for what, (draw, _) in FIELDS.items()
            if what in self.applied
        }
        self.gains = {name: self._gain(name) for name in cameras} if "saturation" in self.applied else {}
        anywhere = Disk(centre_px=torch.zeros(2), radius_px=torch.ones(()))
        self.empty = {  # grey levels (H, W) without a ball, before noise
            name: self._lit(Exposure.none(size[name]).within(max(size[name])), anywhere, name, None, self.optics)
            for name in cameras
        }

    def reported_texture(self, texture: Tensor, number: int = 0) -> Tensor:
        """Return the map of a paint to write, (H, 2 H), with exchanged patches."""
        rng = self._generator("texture_error", *[number] * (number > 0))
        return misdrawn(texture, self.values.get("texture_error", 0.0), rng)

    def picture(self, exposure: Exposure, disk: Disk, name: str, frame: int) -> NDArray[np.float32]:
        """Return degraded grey levels (H, W) of a camera's frame, without camera noise; `disk`: of the sphere."""
        exposure = self._lit_ball(exposure, disk, name)
        beyond = max((BEYOND.get(what, 0.0) for what in self.optics), default=0.0) * float(disk.radius_px)
        changed = exposure.within(math.ceil(beyond) + self._spread)
        picture = self.empty[name].clone()
        picture[changed.window] = self._lit(changed, disk, name, frame, self.optics)
        for what in (one for one in self.applied if one in NOISE):
            picture = OPERATIONS[what](picture, self.values[what], disk, self._generator(what, name, frame))
        return cast("NDArray[np.float32]", picture.numpy())

    def lost(self, name: str, frames: int) -> frozenset[int]:
        """Draw the black frames of a camera."""
        share = self.values.get("dropped_frames", 0.0)
        lost = lost_frames(torch.empty(frames), share, self._generator("dropped_frames", name))
        return frozenset(lost.nonzero()[:, 0].tolist())

    @property
    def _spread(self) -> int:
        return blur_reach(self.values.get("defocus", 0.0))

    def _lit_ball(self, exposure: Exposure, disk: Disk, name: str) -> Exposure:
        return through_optics(exposure, disk, self.values, lambda what: self._generator(what, name))

    def _lit(self, part: Exposure, disk: Disk, name: str, frame: int | None, optics: Sequence[str]) -> Tensor:
        """Return grey levels (h, w) of a part of a picture, before noise; frame None: the part common to the movie."""
        wider = part.within(self._spread)
        (rows, columns), height, width = wider.window, *part.light.shape
        cover = torch.from_numpy(wider.cover)
        disk = replace(disk.within(wider.window), cover=cover)
        light = torch.from_numpy(wider.light) + (1 - cover) * float(self.settings.background)
        for what in optics:
            moves = DEGRADATIONS[what].where == "frame"
            if what in FIELDS:
                light = FIELDS[what][1](light, self.fields[name, what][wider.window], disk)
            elif what == "saturation":
                light = light * self.gains[name]
            elif not moves or frame is not None:
                # Static degradations use the same random numbers in every frame.
                rng = self._generator(what, name, *([frame] if moves and frame is not None else []))
                light = OPERATIONS[what](light, self.values[what], disk, rng)
        down, right = part.window[0].start - rows.start, part.window[1].start - columns.start
        return light[down : down + height, right : right + width]

    def _gain(self, name: str) -> float:
        """Return the exposure gain that saturates a white sphere, after the operations before saturation."""
        camera, origin = self.cameras[name], torch.zeros(1, 1, 3, dtype=torch.float64)
        white = make_scene(torch.ones(8, 16), self.settings)
        disk = picture_of_ball(camera, origin[0, 0], self.settings.diameter_mm / 2)
        part = expose([white], camera, origin, torch.eye(3, dtype=torch.float64)[None, None])
        part = self._lit_ball(part, disk, name)
        light = self._lit(part, disk, name, None, self.optics[: self.optics.index("saturation")])
        inside = torch.from_numpy(part.cover) > 0.99
        return float(gain_to_clip(light.flatten(), inside.flatten(), self.values["saturation"]))

    def _generator(self, *what: str | int) -> torch.Generator:
        # By name, so that a degradation does not change the random numbers of others.
        return seeded(self.settings.seed, *what)


def picture_of_ball(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> Disk:
    """Return the disks of spheres at (..., 3), mm, lab: projected centres (..., 2) and mean rim radii (...), px."""
    centre_px = camera.project(position_lab_mm)
    rim, _ = rim_directions(camera, position_lab_mm, 4)
    rim_px = camera.project(position_lab_mm[..., None, :] + radius_mm * rim)
    return Disk(centre_px=centre_px, radius_px=(rim_px - centre_px[..., None, :]).norm(dim=-1).mean(-1))


def wrong_cameras(cameras: Mapping[str, Camera], values: Mapping[str, float], seed: int = 0) -> Mapping[str, Camera]:
    """Return cameras with principal points shifted along the diagonal, in alternating directions.
    One camera (the second for an even seed, else the first) is also rotated about the lab origin, whose pixel stays,
    and shifted along its own x.
    """
    off_px, degrees, shift_mm = (values.get(key, 0.0) for key in ("centre_error", "camera_rotation", "camera_shift"))
    if not (off_px or degrees or shift_mm):
        return cameras
    wrong = {}
    for k, (name, camera) in enumerate(cameras.items()):
        assert isinstance(camera, TsaiCamera)
        wrong[name] = replace(camera, centre_px=camera.centre_px + (-1) ** k * off_px / math.sqrt(2))
    name = list(cameras)[(1 - seed % 2) % len(cameras)]
    moved = wrong[name]
    turn = so3.exp(torch.full((3,), math.radians(degrees) / math.sqrt(3), dtype=torch.float64))
    right = torch.tensor([shift_mm, 0.0, 0.0], dtype=torch.float64)
    wrong[name] = replace(moved, R_cam_lab=turn @ moved.R_cam_lab, T_cam_lab_mm=moved.T_cam_lab_mm + right)
    return wrong
