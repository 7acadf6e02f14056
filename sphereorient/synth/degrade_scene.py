"""What degradations change of a filmed scene: its settings, the map, the pictures, and the reported inputs."""

import math
import zlib
from collections.abc import Mapping
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
from sphereorient.synth.degrade import OPERATIONS, Disk, gain_to_clip, lost_frames
from sphereorient.synth.scene import expose, make_scene
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
    # Half above the rms of both: most of the movie is sampled finely enough.
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


class Filming:
    """Apply degradations of map, pictures and movie, name -> physical value, each with its own random numbers."""

    def __init__(self, settings: SynthSettings, values: Mapping[str, float], cameras: Mapping[str, Camera]) -> None:
        self.settings = settings
        self.values = dict(values)
        self.cameras = cameras
        self.gains = {name: self._gain(name) for name in cameras} if "saturation" in values else {}

    def paint(self, texture: Tensor, number: int = 0) -> Tensor:
        """Return the map of a filmed paint, (H, 2 H), worn."""
        return worn(texture, self.values.get("paint_wear", 0.0), self._of_paint("paint_wear", number))

    def reported_texture(self, texture: Tensor, number: int = 0) -> Tensor:
        """Return the map of a paint to write, (H, 2 H), with exchanged patches."""
        return misdrawn(texture, self.values.get("texture_error", 0.0), self._of_paint("texture_error", number))

    def disk(self, name: str, position_lab_mm: Tensor, cover: NDArray[np.float32]) -> Disk:
        """Return the place of the sphere at (3,) in a camera's picture; `cover` (H, W): coverage of each pixel."""
        centre_px, radius_px = picture_of_ball(self.cameras[name], position_lab_mm, self.settings.diameter_mm / 2)
        return Disk(centre_px=centre_px, radius_px=radius_px, cover=torch.from_numpy(cover))

    def picture(self, picture: NDArray[np.float32], disk: Disk, name: str, frame: int | None) -> NDArray[np.float32]:
        """Degrade grey levels (H, W) before noise; frame None gets only degradations that the movie shares."""
        light = self._through(tuple(OPERATIONS), torch.from_numpy(picture), disk, name, frame)
        return cast("NDArray[np.float32]", light.numpy())

    def lost(self, name: str, frames: int) -> frozenset[int]:
        """Draw the black frames of a camera."""
        share = self.values.get("dropped_frames", 0.0)
        lost = lost_frames(torch.empty(frames), share, self._generator("dropped_frames", name))
        return frozenset(lost.nonzero()[:, 0].tolist())

    def _through(self, operations: tuple[str, ...], light: Tensor, disk: Disk, name: str, frame: int | None) -> Tensor:
        for what in operations:
            row = DEGRADATIONS[what]
            value = self.values.get(what, row.nothing)
            if value is None or value == row.nothing or (row.where == "frame" and frame is None):
                continue
            # Static degradations use the same random numbers in every frame.
            rng = self._generator(what, name, *([] if row.where != "frame" else [frame or 0]))
            light = light * self.gains[name] if what == "saturation" else OPERATIONS[what](light, value, disk, rng)
        return light

    def _gain(self, name: str) -> float:
        """Return the exposure gain that saturates a white sphere, after the operations before saturation."""
        origin = torch.zeros(1, 3, dtype=torch.float64)
        scene = make_scene(torch.ones(8, 16), self.settings)
        picture, cover = expose(scene, self.cameras[name], origin, torch.eye(3, dtype=torch.float64)[None])
        before = tuple(OPERATIONS)[: tuple(OPERATIONS).index("saturation")]
        light = self._through(before, torch.from_numpy(picture), self.disk(name, origin[0], cover), name, None)
        white = torch.from_numpy(cover) > 0.99
        return float(gain_to_clip(light.flatten(), white.flatten(), self.values["saturation"]))

    def _of_paint(self, what: str, number: int) -> torch.Generator:
        return self._generator(what, *([number] if number else []))

    def _generator(self, *what: str | int) -> torch.Generator:
        # By name: another degradation does not change the random numbers of the rest.
        words = [zlib.crc32(word.encode()) if isinstance(word, str) else word for word in what]
        state = np.random.SeedSequence([self.settings.seed, *words]).generate_state(1, np.uint64)
        return torch.Generator().manual_seed(int(state[0]) >> 1)


def picture_of_ball(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> tuple[Tensor, Tensor]:
    """Return the projected centres (..., 2) and mean rim radii (...), px, of spheres at (..., 3), mm, lab."""
    centre_px = camera.project(position_lab_mm)
    rim, _ = rim_directions(camera, position_lab_mm, 4)
    rim_px = camera.project(position_lab_mm[..., None, :] + radius_mm * rim)
    return centre_px, (rim_px - centre_px[..., None, :]).norm(dim=-1).mean(-1)


def wrong_cameras(cameras: Mapping[str, Camera], values: Mapping[str, float], seed: int = 0) -> Mapping[str, Camera]:
    """Return cameras whose principal points are off along the diagonal, in opposite directions by turns.

    One is also rotated about the lab origin, whose pixel stays, and shifted along its own x: the second with an even
    seed, the first with an odd one.
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
