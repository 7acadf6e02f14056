import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, centre_lab_mm, sphere_disk_px
from sphereorient.sphere import reduced_texture
from sphereorient.sphere.renderer import fine_pixels, reach_px
from sphereorient.sphere.texture import closed_texture
from sphereorient.synth.settings import SynthSettings

SUPERSAMPLING = 3  # rays per pixel and axis: edges are accurate to a few per cent
AT_ONCE = 256  # frames whose positions in the picture are computed at once
POINTS = 41  # samples across a partly hidden disk
ROOM = 6  # rays are computed for windows wider by this part on each side, to serve several frames

# Lamp directions from the sphere (lab) and shares: two bright lamps, and a weak one so that no side is black.
LAMPS = ((-0.6, -0.5, 0.6, 0.55), (0.7, -0.3, 0.65, 0.35), (0.0, 0.9, -0.4, 0.1))
LIT = 0.75  # share of the lamps' light on the brightest side

TOWARDS, LAMP_SHARES = np.array(LAMPS, np.float32)[:, :3], np.array(LAMPS, np.float32)[:, 3] / np.float32(LIT)
TOWARDS /= np.linalg.norm(TOWARDS, axis=1, keepdims=True)
_ACROSS = fine_pixels(1, SUPERSAMPLING).numpy()
# Weights of a pixel's middle and of steps to the right and down, for its fine samples, row by row.
FINE = np.array([(1, right, down) for down in _ACROSS for right in _ACROSS], np.float32)

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Window = tuple[slice, slice]  # rows and columns of a picture


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedScene:
    """Static part of the scene: texture map, light, grey levels."""

    texture: Tensor  # (H, 2 H) float32, reduced to the picture's resolution
    closed: Tensor  # the same, continued over its edges, see `closed_texture`
    settings: SynthSettings


def make_scene(texture: Tensor, settings: SynthSettings) -> RenderedScene:
    """Prepare a scene from a texture map (H, 2 H)."""
    reduced = reduced_texture(texture, SUPERSAMPLING * settings.diameter_px)
    return RenderedScene(texture=reduced, closed=closed_texture(reduced), settings=settings)


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """The part of a picture that balls change, before noise and the blur of the optics."""

    size: tuple[int, int]  # height and width of the whole picture, px
    window: Window
    light: Singles  # (h, w), grey level of the balls times their coverage
    cover: Singles  # (h, w), their coverage
    blur_px: float = 0.0  # of the optics, not yet applied to light and cover

    @classmethod
    def none(cls, size: tuple[int, int]) -> Self:
        """Return the exposure of a picture (H, W) without a ball."""
        nothing = np.zeros((0, 0), np.float32)
        return cls(size=size, window=(slice(0, 0), slice(0, 0)), light=nothing, cover=nothing)

    def before(self, behind: Singles | float) -> Singles:
        """Return the picture (H, W) of the balls in front of grey levels (H, W), or of one level."""
        picture = np.broadcast_to(np.asarray(behind, np.float32), self.size).copy()
        self.put(picture)
        return picture

    def put(self, picture: Singles) -> None:
        """Put the balls in front of the grey levels of a picture (H, W), in place."""
        seen = self.through_optics()
        picture[self.window] *= 1 - seen.cover
        picture[self.window] += seen.light

    def through_optics(self) -> Self:
        """Return the exposure blurred by the optics."""
        if not self.blur_px:
            return self
        light, cover = (cv2.GaussianBlur(one, (0, 0), self.blur_px) for one in (self.light, self.cover))
        return replace(self, light=np.asarray(light, np.float32), cover=np.asarray(cover, np.float32), blur_px=0.0)

    def within(self, margin_px: int) -> Self:
        """Return the exposure with a window wider on all sides, within the picture."""
        window = _wider(self.window, margin_px, self.size)
        light, cover = wider = np.zeros((2, *(side.stop - side.start for side in window)), np.float32)
        wider[(..., *_inside(self.window, window))] = self.light, self.cover
        return replace(self, window=window, light=light, cover=cover)

    @property
    def covered(self) -> Singles:
        """The coverage of every pixel in the picture, (H, W)."""
        whole = np.zeros(self.size, np.float32)
        whole[self.window] = self.through_optics().cover
        return whole


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelRays:
    """Rays through the pixels of a window (h, w): origins, mm, and directions, lab; linear within a pixel."""

    window: Window
    exact: Floats  # (2, 3, h, w)
    linear: Singles  # (2, 3, 3, h, w), the same with their changes per pixel to the right and down

    @classmethod
    def of(cls, camera: Camera, window: Window) -> Self:
        """Compute the rays of a window; the rays of a pixel do not depend on the window."""
        wider = _wider(window, 1, camera.image_size[::-1])
        v, u = torch.meshgrid(*(torch.arange(side.start, side.stop).double() for side in wider), indexing="ij")
        rays = camera.rays(torch.stack([u, v], -1))
        exact = torch.stack([rays.origin_lab_mm, rays.direction_lab]).movedim(-1, 1).nan_to_num().contiguous().numpy()
        linear = np.stack([exact, *np.gradient(exact, axis=(3, 2))], 1).astype(np.float32)
        return cls(window=wider, exact=exact, linear=linear).within(window)

    def within(self, window: Window) -> Self:
        """Return the rays of a part of the window."""
        part = (..., *_inside(window, self.window))
        return replace(self, window=window, exact=self.exact[part], linear=self.linear[part])

    def feet(self, centre: Floats) -> Singles:
        """Return where the fine samples pass a centre (3,) nearest, relative to it, (3, S, h, w)."""
        start, direction = self.exact[0] - centre[:, None, None], self.exact[1]
        ahead = (start * direction).sum(0)
        foot = (start - ahead * direction).astype(np.float32)
        (_, *moves), (along, *turns) = self.linear
        ahead = ahead.astype(np.float32)
        changes = [
            move - (move * along + foot * turn).sum(0) * along - ahead * turn
            for move, turn in zip(moves, turns, strict=True)
        ]
        return _fine(np.stack([foot, *changes]))


def _fine(linear: Singles) -> Singles:
    """Return fine samples (3, S, h, w) from values and their changes to the right and down (3, 3, h, w)."""
    found: Singles = (FINE @ linear.swapaxes(0, 1).reshape(3, 3, -1)).reshape(3, len(FINE), *linear.shape[2:])
    return found


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
    """Yield N exposures of K balls without noise. `position_lab_mm` (K, N, E, 3) and `R_lab_body` (K, N, E, 3, 3) are
    the poses at the E instants of each exposure. Nearer balls cover those behind them; balls cast no shadows. Raises
    CameraError: sphere not wholly in front of the camera, or not wholly in the liquid.
    """
    size, blur_px = camera.image_size[::-1], scenes[0].settings.blur_px
    radii_mm = position_lab_mm.new_tensor([scene.settings.diameter_mm / 2 for scene in scenes])[:, None, None]
    rays = dict[int, PixelRays]()
    parts = (torch.split(poses, AT_ONCE, 1) for poses in (position_lab_mm, R_lab_body))
    for X, R in zip(*parts, strict=True):
        disks = torch.cat([camera.project(X), reach_px(camera, X, radii_mm)[..., None]], -1).numpy()
        away = (X - centre_lab_mm(camera)).norm(dim=-1).sum(-1)
        order = away.argsort(0, descending=True).T.tolist()  # far balls first
        centres, turns = X.double().numpy(), R.mT.float().numpy()
        for n in range(X.shape[1]):
            balls = []
            for k in order[n]:
                window = _window(disks[k, n], size)
                if any(side.start == side.stop for side in window):
                    continue
                if k not in rays or _around([rays[k].window, window]) != rays[k].window:
                    rays[k] = PixelRays.of(camera, _wider(window, (window[0].stop - window[0].start) // ROOM, size))
                own, poses = rays[k].within(window), zip(centres[k, n], turns[k, n], strict=True)
                balls.append((window, np.stack([_seen(scenes[k], own, *pose) for pose in poses])))
            yield _exposure(balls, blur_px, size)


def _exposure(balls: Sequence[tuple[Window, Singles]], blur_px: float, size: tuple[int, int]) -> Exposure:
    """Combine balls, far ones first: windows and their light and coverage, (E, 2, h, w)."""
    if not balls:
        return Exposure.none(size)
    window = _wider(_around([place for place, _ in balls]), 2 + round(4 * blur_px), size)
    both = np.zeros((*balls[0][1].shape[:2], *(side.stop - side.start for side in window)), np.float32)
    for place, seen in balls:
        there = both[(..., *_inside(place, window))]
        there *= 1 - seen[:, 1:]
        there += seen
    light, cover = both.mean(0)
    return Exposure(size=size, window=window, light=light, cover=cover, blur_px=blur_px)


def _around(windows: Sequence[Window]) -> Window:
    down, right = (
        slice(min(s.start for s in sides), max(s.stop for s in sides)) for sides in zip(*windows, strict=True)
    )
    return down, right


def _inside(part: Window, window: Window) -> Window:
    down, right = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(part, window, strict=True))
    return down, right


def _window(disks: NDArray[np.float64], size: tuple[int, int]) -> Window:
    """Return the part of a picture (H, W) that contains disks (E, 3): u, v, radius, px."""
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


def _seen(scene: RenderedScene, rays: PixelRays, centre: Floats, R_body_lab: Singles) -> Singles:
    """Return shaded paint times coverage, and coverage, (2, h, w), of a ball, as `see_sphere` where a ray hits."""
    settings, radius_mm = scene.settings, scene.settings.diameter_mm / 2
    normal = rays.feet(centre)
    depth2 = np.float32(radius_mm**2) - np.einsum("kshw,kshw->shw", normal, normal)
    hit, depth = depth2 > 0, torch.from_numpy(depth2).clamp_min_(0).numpy()
    normal -= np.sqrt(depth, out=depth) * _fine(rays.linear[1])
    towards = np.concatenate([R_body_lab, TOWARDS], dtype=np.float32) / np.float32(radius_mm)
    turned: Singles = np.matmul(towards, normal.reshape(3, -1), dtype=np.float32)
    grey = _paint(scene.closed, turned[:3])
    grey *= settings.white - settings.black
    grey += settings.black
    lit = torch.from_numpy(turned[3:]).clamp_min_(0).numpy()
    grey *= LAMP_SHARES * (1 - settings.ambient) @ lit + settings.ambient
    return np.stack([part.mean(0, dtype=np.float32) for part in (grey.reshape(hit.shape) * hit, hit)])


def _paint(closed: Tensor, body: Singles) -> Singles:
    """Return the paint by `sample_closed` (P,) at directions (3, P), in a third of the time."""
    height, (x, y, z) = len(closed) - 2, body
    place = torch.empty(2, len(x))
    torch.atan2(*map(torch.from_numpy, (y, x)), out=place[0])
    torch.atan2(*map(torch.from_numpy, (z, np.sqrt(x * x + y * y))), out=place[1])
    place *= torch.tensor([[2 * height / (2 * height + 1)], [-2 * height / (height + 1)]]) / math.pi
    # -1 and 1 are the centres of the outermost texels.
    grey = torch.nn.functional.grid_sample(closed[None, None], place.mT[None, None], align_corners=True)
    return np.asarray(grey.numpy().ravel())


def digitise(picture: Singles, settings: SynthSettings, rng: torch.Generator) -> NDArray[np.uint8]:
    """Add camera noise to grey levels (H, W) and round to 8 bits."""
    noise = torch.empty(picture.shape).normal_(generator=rng).numpy()
    sigma = torch.from_numpy(picture).clamp_min(0).numpy()  # numpy takes three times as long for this and the root
    sigma *= settings.shot_noise**2
    sigma += settings.read_noise**2
    return np.asarray(cv2.add(picture, cv2.multiply(cv2.sqrt(sigma, sigma), noise, noise), dtype=cv2.CV_8U))


def seeded(*what: str | int) -> torch.Generator:
    """Return a generator of random numbers determined by these words and numbers."""
    words = [zlib.crc32(word.encode()) if isinstance(word, str) else word for word in what]
    state = np.random.SeedSequence(words).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0]) >> 1)


def hidden_shares(
    places: Mapping[str, Floats], cameras: Mapping[str, Camera], radii_mm: Mapping[str, float]
) -> dict[str, Floats]:
    """Return for each ball at positions (N, 3), lab, mm, the share of its disk (C, N) covered by nearer disks."""
    across = torch.linspace(-1, 1, POINTS, dtype=torch.float64)
    grid = torch.cartesian_prod(across, across)
    grid = grid[grid.square().sum(1) < 1]
    shares: dict[str, list[Floats]] = {name: [] for name in places}
    for camera in cameras.values():
        X = {name: torch.from_numpy(place) for name, place in places.items()}
        disks = {name: sphere_disk_px(camera, place, radii_mm[name]) for name, place in X.items()}
        far_mm = {name: (place - centre_lab_mm(camera)).norm(dim=-1) for name, place in X.items()}
        for name, (middle, radius) in disks.items():
            at = middle[:, None] + radius[:, None, None] * grid
            covered = torch.zeros(at.shape[:2], dtype=torch.bool)
            for other, (there, size) in disks.items():
                inside = (at - there[:, None]).norm(dim=-1) < size[:, None]
                covered |= inside & (far_mm[other] < far_mm[name])[:, None]
            shares[name].append(covered.double().mean(1).numpy())
    return {name: np.stack(each) for name, each in shares.items()}
