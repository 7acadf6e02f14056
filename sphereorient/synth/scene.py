import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, centre_lab_mm
from sphereorient.sphere import reduced_texture
from sphereorient.sphere.renderer import fine_pixels, reach_px
from sphereorient.sphere.texture import closed_texture, sample_closed
from sphereorient.synth.settings import SynthSettings

SUPERSAMPLING = 3  # rays per pixel and axis: edges are accurate to a few per cent
AT_ONCE = 256  # frames whose places in the picture are computed at once
ROOM = 6  # rays are computed for windows that are wider by this part on each side: they serve some frames

# Lamp directions from the sphere (lab) and shares: two bright, one weak, so that no side is black.
LAMPS = ((-0.6, -0.5, 0.6, 0.55), (0.7, -0.3, 0.65, 0.35), (0.0, 0.9, -0.4, 0.1))
LIT = 0.75  # share of the lamps that the brightest side receives

Floats = NDArray[np.float32]
Window = tuple[slice, slice]  # rows and columns of a picture


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedScene:
    """Static part of the scene: texture map, light, grey levels; made by `make_scene`."""

    texture: Tensor  # (H, 2 H) float32, reduced to the picture's resolution
    closed: Tensor  # the same, continued over its edges, see `closed_texture`
    settings: SynthSettings


def make_scene(texture: Tensor, settings: SynthSettings) -> RenderedScene:
    """Prepare a scene from a texture map (H, 2 H)."""
    reduced = reduced_texture(texture, SUPERSAMPLING * settings.diameter_px)
    return RenderedScene(texture=reduced, closed=closed_texture(reduced), settings=settings)


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """The part of a picture that balls change, before noise; made by `exposures`."""

    size: tuple[int, int]  # height and width of the whole picture, px
    window: Window
    light: Floats  # (h, w), grey level of the balls times their coverage, blurred by the optics
    cover: Floats  # (h, w), their coverage, blurred alike

    @classmethod
    def none(cls, size: tuple[int, int]) -> Self:
        """Return that of a picture (H, W) without a ball."""
        nothing = np.zeros((0, 0), np.float32)
        return cls(size=size, window=(slice(0, 0), slice(0, 0)), light=nothing, cover=nothing)

    def before(self, behind: Floats | float) -> Floats:
        """Return the picture (H, W) of the balls before grey levels (H, W), or one level."""
        picture = np.array(np.broadcast_to(np.float32(behind), self.size))
        picture[self.window] *= 1 - self.cover
        picture[self.window] += self.light
        return picture

    def within(self, margin_px: int) -> Self:
        """Return it with a window that is wider on all sides, as far as the picture reaches."""
        window = _wider(self.window, margin_px, self.size)
        pads = [(old.start - new.start, new.stop - old.stop) for old, new in zip(self.window, window, strict=True)]
        return replace(self, window=window, light=np.pad(self.light, pads), cover=np.pad(self.cover, pads))

    @property
    def covered(self) -> Floats:
        """The coverage of every pixel, (H, W)."""
        whole = np.zeros(self.size, np.float32)
        whole[self.window] = self.cover
        return whole


@dataclass(frozen=True, kw_only=True, eq=False)
class FineRays:
    """Rays through the fine samples of a window's pixels, x, y and z apart, float64."""

    window: Window
    origin: Tensor  # (3, h, w, S), lab, mm; (3, 1, 1, 1) where all start in one point
    direction: Tensor  # (3, h, w, S), lab

    @classmethod
    def of(cls, camera: Camera, window: Window) -> Self:
        """Compute the rays of a window."""
        within = fine_pixels(1, SUPERSAMPLING)
        rows, columns = (torch.arange(side.start, side.stop, dtype=torch.float64)[:, None] + within for side in window)
        shape = len(rows), len(columns), SUPERSAMPLING, SUPERSAMPLING
        v, u = rows[:, None, :, None].expand(shape), columns[:, None, :].expand(shape)
        rays = camera.rays(torch.stack([u, v], -1).flatten(2, 3))
        origin, direction = (part.movedim(-1, 0) for part in (rays.origin_lab_mm, rays.direction_lab))
        central = origin.stride()[1:] == (0, 0, 0)
        return cls(
            window=window,
            origin=(origin[:, :1, :1, :1] if central else origin).contiguous(),
            direction=direction.contiguous(),
        )

    def holds(self, window: Window) -> bool:
        """Return whether a window is part of this one."""
        return all(a.start <= b.start and b.stop <= a.stop for a, b in zip(self.window, window, strict=True))

    def through(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return origins (3, M S) or (3, 1) and directions (3, M S) of the M pixels (v, u), (M, 2)."""
        rows, columns = self.window
        place = (pixels[:, 0] - rows.start) * (columns.stop - columns.start) + pixels[:, 1] - columns.start
        parts = [self.direction] if self.origin.numel() == 3 else [self.direction, self.origin]
        found = [part.flatten(1, 2).index_select(1, place).flatten(1) for part in parts]
        return (found[1] if len(found) > 1 else self.origin.flatten(1)), found[0]


def render_frame(
    scene: RenderedScene, camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor, rng: torch.Generator
) -> NDArray[np.uint8]:
    """Render one noisy exposure, (H, W), of one ball at poses (E, 3) and (E, 3, 3)."""
    exposure = expose([scene], camera, position_lab_mm[None], R_lab_body[None])
    return digitise(exposure.before(scene.settings.background), scene.settings, rng)


def expose(scenes: Sequence[RenderedScene], camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor) -> Exposure:
    """Return one exposure of K balls at poses (K, E, 3) and (K, E, 3, 3), as `exposures` does."""
    return next(exposures(scenes, camera, position_lab_mm[:, None], R_lab_body[:, None]))


def exposures(
    scenes: Sequence[RenderedScene], camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor
) -> Iterator[Exposure]:
    """Yield N exposures of K balls without noise.
    `position_lab_mm` (K, N, E, 3) and `R_lab_body` (K, N, E, 3, 3) are the poses at the E instants of each exposure.
    Nearer balls cover those behind them; balls cast no shadows.
    Raises CameraError: sphere not wholly in front of the camera, or not wholly in the liquid.
    """
    size, blur_px = camera.image_size[::-1], scenes[0].settings.blur_px
    radii_mm = position_lab_mm.new_tensor([scene.settings.diameter_mm / 2 for scene in scenes])[:, None, None]
    rays = [FineRays.of(camera, (slice(0, 0), slice(0, 0))) for _ in scenes]
    parts = (torch.split(poses, AT_ONCE, 1) for poses in (position_lab_mm, R_lab_body))
    for X, R in zip(*parts, strict=True):
        disks = torch.cat([camera.project(X), reach_px(camera, X, radii_mm)[..., None]], -1).numpy()
        away = (X - centre_lab_mm(camera)).norm(dim=-1).sum(-1)
        for n in range(X.shape[1]):
            balls = []
            for k in away[:, n].argsort(descending=True).tolist():  # far ones first
                window = _window(disks[k, n], size)
                if not rays[k].holds(window):
                    rays[k] = FineRays.of(camera, _wider(window, (window[0].stop - window[0].start) // ROOM, size))
                pixels = _near(disks[k, n], window)
                origin, direction = rays[k].through(pixels)
                instants = zip(X[k, n], R[k, n], strict=True)
                seen = torch.stack([_seen(scenes[k], origin, direction, *pose) for pose in instants])
                balls.append((pixels, seen))
            yield _exposure(balls, blur_px, size)


def _exposure(balls: Sequence[tuple[Tensor, Tensor]], blur_px: float, size: tuple[int, int]) -> Exposure:
    """Put balls before each other, far ones first: pixels (M, 2) as (v, u), and what is seen there, (E, 2, M)."""
    every = torch.cat([pixels for pixels, _ in balls])
    if not len(every):
        return Exposure.none(size)
    (top, left), (bottom, right) = every.amin(0).tolist(), every.amax(0).tolist()
    window = _wider((slice(top, bottom + 1), slice(left, right + 1)), 2 + round(4 * blur_px), size)
    rows, columns = window
    shape = rows.stop - rows.start, columns.stop - columns.start
    both = torch.zeros(len(balls[0][1]), 2, shape[0] * shape[1])
    for pixels, seen in balls:
        place = (pixels[:, 0] - rows.start) * shape[1] + pixels[:, 1] - columns.start
        both.index_copy_(2, place, (1 - seen[:, 1:]) * both.index_select(2, place) + seen)
    light, cover = both.mean(0).reshape(2, *shape).numpy()
    if blur_px > 0:
        light, cover = (np.asarray(cv2.GaussianBlur(one, (0, 0), blur_px)) for one in (light, cover))
    return Exposure(size=size, window=window, light=light, cover=cover)


def _window(disks: NDArray[np.float64], size: tuple[int, int]) -> Window:
    """Return the part of a picture (H, W) that disks (E, 3) reach: u, v, radius, px."""
    low, high = (disks[:, 1::-1] - disks[:, 2:]).min(0), (disks[:, 1::-1] + disks[:, 2:]).max(0)
    starts, stops = np.floor(low).astype(int), np.ceil(high).astype(int) + 1
    down, right = (slice(int(a), int(b)) for a, b in zip(starts.clip(0, size), stops.clip(0, size), strict=True))
    return down, right


def _wider(window: Window, margin_px: int, size: tuple[int, int]) -> Window:
    down, right = (
        slice(max(0, side.start - margin_px), min(end, side.stop + margin_px))
        for side, end in zip(window, size, strict=True)
    )
    return down, right


def _near(disks: NDArray[np.float64], window: Window) -> Tensor:
    """Return the pixels (M, 2), (v, u), of a window that lie in one of the disks (E, 3), or at most one beside it."""
    v, u = np.ogrid[window]
    near = np.any([(u - at_u) ** 2 + (v - at_v) ** 2 < (reach + 1) ** 2 for at_u, at_v, reach in disks], 0)
    return torch.from_numpy(np.argwhere(near) + [side.start for side in window])


def _seen(
    scene: RenderedScene, origin: Tensor, direction: Tensor, position_lab_mm: Tensor, R_lab_body: Tensor
) -> Tensor:
    """Return shaded paint times coverage, and coverage, (2, M) float32, of M pixels with rays (3, M S), float64.
    It is what `see_sphere` sees, where a ray hits; with x, y and z apart it takes a fifth of the time.
    """
    settings, radius_mm = scene.settings, scene.settings.diameter_mm / 2
    to_centre = position_lab_mm[:, None] - origin
    along = (to_centre * direction).sum(0)
    depth2 = along * along - (to_centre * to_centre).sum(0) + radius_mm**2
    first = along - depth2.clamp_min(0).sqrt()
    normal = ((first * direction - to_centre) / radius_mm).float()
    lamps = torch.tensor(LAMPS)
    lit = (lamps[:, 3] / LIT) @ (torch.nn.functional.normalize(lamps[:, :3], dim=-1) @ normal).clamp_min(0)
    light = settings.ambient + (1 - settings.ambient) * lit
    paint = sample_closed(scene.closed, (R_lab_body.mT.float() @ normal).mT)
    hit = (depth2 > 0).float()
    grey = (settings.black + (settings.white - settings.black) * paint) * light * hit
    fine: Tensor = torch.stack([grey, hit]).reshape(2, -1, SUPERSAMPLING**2)
    return fine.mean(-1)


def digitise(picture: Floats, settings: SynthSettings, rng: torch.Generator) -> NDArray[np.uint8]:
    """Add camera noise to grey levels (H, W) and round to 8 bits."""
    noise = torch.empty(picture.shape).normal_(generator=rng).numpy()
    sigma = np.sqrt(settings.read_noise**2 + settings.shot_noise**2 * np.maximum(picture, 0))
    return np.asarray(cv2.add(picture, cv2.multiply(sigma, noise), dtype=cv2.CV_8U))


def seeded(*what: str | int) -> torch.Generator:
    """Return a generator of random numbers that these words and numbers decide."""
    words = [zlib.crc32(word.encode()) if isinstance(word, str) else word for word in what]
    state = np.random.SeedSequence(words).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0]) >> 1)
