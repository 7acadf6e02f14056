"""Disagreement of the cameras about the sphere, each measured alone, and its likely causes of few parameters."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.targets import Floats
from sphereorient.cameras import Camera, R_lab_view, Rays, centre_lab_mm, sphere_radius_px, triangulate

RUNS, RUN = 3, 20  # number and length of the runs of consecutive frames in which causes are tried
STRETCH = 0.01  # allowed relative excess of an outline's width over its height
GAP_PX, TURN_DEG, SIZE = 1.0, 0.2, 0.01  # allowed differences of agreeing cameras, in any light
TURN_SIGMAS, EDGE_PX = 3.0, 0.2  # the same for uncertain rotations, and for small spheres: px of the radius
NAN = torch.tensor(torch.nan, dtype=torch.float64)
Sight = tuple[Rays, Tensor]  # of one camera in N frames: lines of sight, and R_lab_body (N, 3, 3)
LATEST = 8  # largest tested delay of a movie, frames
PLAUSIBLE = 0.2  # largest deviation: relative, rad, 100 mm
FIT: dict[str, Any] = {"loss": "soft_l1", "x_scale": 0.01, "max_nfev": 30}
FLIPS = {"horizontal": (0,), "vertical": (1,), "both": (0, 1)}  # axes of the picture


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Allowed differences of agreeing cameras, in any light: typical values of a movie."""

    gap_px: float
    turn_deg: float
    size: float  # relative


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """Measurements by each of C cameras alone in N frames; NaN if there are none."""

    cameras: Mapping[str, Camera]
    centre_px: Tensor  # (N, C, 2)
    radius_px: Tensor  # (N, C), of the sphere's picture, along the camera's x
    R_lab_body: Tensor  # (N, C, 3, 3)
    diameter_mm: float = 1.0  # without it only ratios of sizes between cameras matter
    outline_stretch: Tensor = NAN  # (N, C) or (): relative excess of an outline's width over the cameras' prediction
    frame: Tensor | None = None  # (N,) int64, increasing, at even times; None: delays are not tested

    @classmethod
    def of_outlines(cls, cameras: Mapping[str, Camera], centre_px: Tensor, radius_px: Tensor) -> "Seen":
        """Return the measurements by outlines (N, C, 2), (N, C), px, alone."""
        R = torch.full((*radius_px.shape, 3, 3), torch.nan, dtype=torch.float64)
        return cls(cameras=cameras, centre_px=centre_px, radius_px=radius_px, R_lab_body=R)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """All pairs of cameras."""
        return list(combinations(range(len(self.cameras)), 2))

    def gaps(self, pair: tuple[int, int], centre_px: Tensor | None = None) -> "Gaps":
        """Return the gaps of two cameras, with other centres (N, C, 2), px, if given."""
        pixels, cameras = self.centre_px if centre_px is None else centre_px, list(self.cameras.values())
        return gaps_between([cameras[k] for k in pair], [pixels[:, k] for k in pair])


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaps:
    """Distances between the lines of sight to n points; made by `gaps_between`."""

    signed_mm: Tensor  # (n,), along the common perpendicular; NaN where a point is missing
    per_mm_px: Tensor  # (n,), px in the first camera per millimetre along it
    position_lab_mm: Tensor  # (n, 3), the middle of the shortest segment
    across_lab: Tensor  # (n, 3), unit, the common perpendicular

    @property
    def signed_px(self) -> Tensor:
        """The gaps in px of the first camera, (n,): the epipolar residual."""
        return self.signed_mm * self.per_mm_px

    @property
    def typical_px(self) -> float:
        """Median size of the gaps, px."""
        return float(self.signed_px.abs().nanmedian())


def gaps_between(cameras: Sequence[Camera], centre_px: Sequence[Tensor]) -> Gaps:
    """Return the gaps (common perpendiculars) of two cameras' lines of sight to centres (n, 2), px; NaN: no ball."""
    a, b = (camera.rays(uv) for camera, uv in zip(cameras, centre_px, strict=True))
    position, signed, across = _meet(a, b)
    half = 0.5 * across
    seen = cameras[0].project(torch.cat([position - half, position + half])).chunk(2)
    per_mm_px = (seen[1] - seen[0]).norm(dim=-1)
    return Gaps(signed_mm=signed, per_mm_px=per_mm_px, position_lab_mm=position, across_lab=across)


def _meet(a: Rays, b: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """Return points nearest to two lines of sight (n, 3), signed gap (n,), mm, and its direction (n, 3), unit, lab."""
    position, _ = triangulate(a, b)
    across = torch.linalg.cross(a.direction_lab, b.direction_lab)
    across = across / across.norm(dim=-1, keepdim=True)
    signed = ((b.origin_lab_mm - a.origin_lab_mm) * across).sum(-1)
    return position, torch.where(torch.isfinite(position).all(-1), signed, torch.nan), across


def limits_of(seen: Seen, covariance_rad2: Tensor) -> Limits:
    """Return the allowed differences of agreeing cameras; covariance (N, C, 3, 3) of each camera's rotation."""
    sigma_deg = math.degrees(float(so3.trace(covariance_rad2).sqrt().nanmedian().nan_to_num(posinf=0.0)))
    turn_deg = max(TURN_DEG, math.sqrt(2) * TURN_SIGMAS * sigma_deg)
    return Limits(gap_px=GAP_PX, turn_deg=turn_deg, size=max(SIZE, EDGE_PX / float(seen.radius_px.nanmedian())))


class Comparison:
    """Computes the differences between the cameras for measured or changed observations."""

    def __init__(self, seen: Seen, limits: Limits) -> None:
        rows = torch.nonzero(torch.isfinite(seen.centre_px).all(-1).sum(-1) > 1)[:, 0]
        if len(rows) > RUNS * RUN:
            starts = torch.linspace(0, len(rows) - RUN, RUNS).round().long()
            rows = rows[(starts[:, None] + torch.arange(RUN)).flatten()]
        self.cameras, self.names, self.pairs = list(seen.cameras.values()), list(seen.cameras), seen.pairs
        self.centre_px, self.stretch = seen.centre_px[rows], seen.outline_stretch.expand_as(seen.radius_px)[rows]
        self.frame = None if seen.frame is None else seen.frame[rows]
        self.diameter_mm = seen.diameter_mm
        scale = [limits.gap_px, *[math.radians(limits.turn_deg)] * 3, *[limits.size] * 2, *[STRETCH] * 2]
        self._scale = torch.tensor(scale, dtype=torch.float64)
        views = [R_lab_view(camera, self.centre_px[:, k]) for k, camera in enumerate(self.cameras)]
        self.R_view_body = torch.stack(views, 1).mT @ seen.R_lab_body[rows]
        self._centres = [centre_lab_mm(camera) for camera in self.cameras]
        self._px_mm, self._by_size = [], []  # by size: distances (N,) of the cameras of a pair
        for two in self.pairs:
            gap = gaps_between([self.cameras[c] for c in two], [self.centre_px[:, c] for c in two])
            self._px_mm.append(gap.per_mm_px.nanmedian())
            self._by_size.append([self._far(c, gap.position_lab_mm, seen.radius_px[rows, c]) for c in two])

    def _far(self, c: int, position_lab_mm: Tensor, radius_px: Tensor) -> Tensor:
        expected_px = sphere_radius_px(self.cameras[c], position_lab_mm, self.diameter_mm / 2)
        far: Tensor = (position_lab_mm - self._centres[c]).norm(dim=-1) * expected_px / radius_px
        return far

    def sights(self, centre_px: Tensor | None = None, R_view_body: Tensor | None = None) -> list[Sight]:
        """Return lines of sight and rotations of centres (N, C, 2), px, and attitudes (N, C, 3, 3); None: measured."""
        pixels = (self.centre_px if centre_px is None else centre_px).unbind(1)
        attitudes = (self.R_view_body if R_view_body is None else R_view_body).unbind(1)
        each = zip(self.cameras, pixels, attitudes, strict=True)
        return [(camera.rays(pixel), R_lab_view(camera, pixel) @ R) for camera, pixel, R in each]

    def __call__(
        self, sights: Sequence[Sight], larger: Tensor | float = 0.0, sized: bool = True, wider: Tensor | float = 0.0
    ) -> Tensor:
        """Return gap, rotation (3), log sizes (2) and stretches (2) of pairs and frames, (P, N, 8), in units of limits.
        `larger`: logarithm of the ratio of measured to predicted size of the sphere's picture, () or (C,); `wider`:
        relative excess of width over height, () or (C,).
        """
        stretch = self.stretch - wider
        growth = torch.as_tensor(larger, dtype=torch.float64).expand(len(self.names))
        parts = []
        for (k, m), px_mm, by_size in zip(self.pairs, self._px_mm, self._by_size, strict=True):
            (ray, R), (other_ray, other_R) = sights[k], sights[m]
            position, gap_mm, _ = _meet(ray, other_ray)
            turn = so3.log(R @ other_R.mT)
            far = [(position - self._centres[c]).norm(dim=-1) for c in (k, m)]
            size = torch.stack([(a / b).log() for a, b in zip(far, by_size, strict=True)], -1) - growth[[k, m]]
            size = size if sized else size * torch.nan
            parts.append(torch.cat([(gap_mm * px_mm)[:, None], turn, size, stretch[:, [k, m]]], -1))
        return torch.stack(parts) / self._scale


def typical(found: Tensor) -> Tensor:
    """Return the typical gap, rotation, and size farthest from the expected one, of each pair, (P, 3)."""
    gap, turn, size = found[..., 0].abs(), found[..., 1:4].norm(dim=-1), found[..., 4:6]
    middle = size.nanmedian(1).values.nan_to_num()
    farthest = middle.gather(1, middle.abs().argmax(1, keepdim=True))
    return torch.cat([gap.nanmedian(1, keepdim=True).values, turn.nanmedian(1, keepdim=True).values, farthest], 1)


def misfit(found: Tensor) -> float:
    """Return the median over frames of the mean square of differences (P, N, K), mean of pairs; NaN without."""
    return float(found.square().nanmean(-1).nanmedian(1).values.nanmean())


@dataclass(frozen=True, kw_only=True)
class Cause:
    """A possible cause of a contradiction."""

    words: str  # cause, its size, and what to do
    left: float = math.inf  # share of the misfit that it leaves
    parameters: int = 0
    deadly: bool = False  # no measurement is possible before it is corrected
    cameras: tuple[int, ...] = ()  # affected


def other_readings(
    cameras: Mapping[str, Camera], centre_px: Tensor, R_view_body: Tensor, flips: Sequence[str] = tuple(FLIPS)
) -> Iterator[tuple[Cause, Tensor, Tensor]]:
    """Yield causes, centres (N, C, 2), px, and attitudes (N, C, 3, 3) for two swapped movies, or one flipped."""
    names, sizes = list(cameras), [camera.image_size for camera in cameras.values()]
    for k, m in combinations(range(len(names)), 2):
        if sizes[k] == sizes[m]:
            movies = [*range(len(names))]
            movies[k], movies[m] = m, k
            cause = Cause(words=f"swap {names[k]} and {names[m]} under movies:", deadly=True, cameras=(k, m))
            yield cause, centre_px[:, movies], R_view_body[:, movies]
    for k, name in enumerate(names):
        for how in flips:
            flipped, R = centre_px.clone(), R_view_body.clone()
            for axis in FLIPS[how]:
                flipped[:, k, axis] = sizes[k][axis] - 1 - flipped[:, k, axis]
                R[:, k, axis] = -R[:, k, axis]
            yield Cause(words=f"write flip: {{{name}: {how}}}", deadly=True, cameras=(k,)), flipped, R


def likely_causes(compare: Comparison, found: Tensor) -> Iterator[Cause]:
    """Yield likely causes, each with the remaining share of the misfit of the differences `found`, (P, N, 8)."""
    names, whole = compare.names, misfit(found)
    cameras = dict(zip(names, compare.cameras, strict=True))
    for cause, centre_px, R in other_readings(cameras, compare.centre_px, compare.R_view_body, ["both"]):
        left = misfit(compare(compare.sights(centre_px, R), sized=False)) / misfit(found[..., :4])
        yield replace(cause, left=left)
    sights, mm, each = compare.sights(), compare.diameter_mm, list(range(len(names)))

    def fitted(
        measured: Callable[[Floats], Tensor], count: int, words: str, numbers: Callable[[Floats], list[float]]
    ) -> Cause:
        def residuals(p: Floats) -> Floats:
            return np.asarray(measured(p).flatten().nan_to_num(nan=0.0))

        bounds = np.full(count, -PLAUSIBLE), np.full(count, PLAUSIBLE)
        best: Any = least_squares(residuals, np.zeros(count), bounds=bounds, **FIT)
        return Cause(words=words.format(*numbers(best.x)), left=misfit(measured(best.x)) / whole, parameters=count)

    words = f"the pictures fit sphere.diameter {{:.4g}}, not {mm:.4g}: measure it, or check the calibration's lengths"
    yield fitted(lambda p: compare(sights, larger=float(p[0])), 1, words, lambda p: [mm * math.exp(p[0])])
    for some in [each, *([k] for k in each)]:
        words = f"pictures of {' and '.join(names[k] for k in some)} {{:+.1f}} % wider than calibrated: check sx "
        words += "({:+.1f} %), pixel_pitch along u ({:+.1f} %), and whether the movie was resized"
        wide = fitted(partial(_wide, compare, some), 1, words, _widths)
        yield replace(wide, cameras=tuple(some))
    for k, name in enumerate(names):
        for count, moved in ((3, ""), (6, " and moved by {:.2g} mm")):
            words = f"{name} rotated by {{:.2g}} degrees{moved} since its calibration: calibrate again"
            yield replace(fitted(partial(_moved, compare, k), count, words, _turn_and_move), cameras=(k,))
    if compare.frame is not None:
        yield from _late(compare, compare.frame, whole)


def _turn_and_move(p: Floats) -> list[float]:
    """Return rotation, degrees, and displacement, mm, of the parameters of `_moved`."""
    return [math.degrees(float(np.linalg.norm(p[:3]))), 100 * float(np.linalg.norm(p[3:]))]


def _widths(p: Floats) -> list[float]:
    """Return the relative changes of width, sx and pixel_pitch along u, per cent, of the parameter of `_wide`."""
    wider = float(p[0])
    return [100 * wider, 100 * wider, 100 * (1 / (1 + wider) - 1)]


def _wide(compare: Comparison, some: Sequence[int], p: Floats) -> Tensor:
    """Return differences with pictures wider by p[0]; the outline's circle is larger by half of that."""
    pixels, larger = compare.centre_px.clone(), torch.zeros(len(compare.names), dtype=torch.float64)
    for k in some:
        middle = 0.5 * (compare.cameras[k].image_size[0] - 1)
        pixels[:, k, 0] = middle + (pixels[:, k, 0] - middle) / (1 + float(p[0]))
        larger[k] = math.log1p(0.5 * float(p[0]))
    return compare(compare.sights(pixels), larger, wider=2 * larger)


def _moved(compare: Comparison, camera: int, p: Floats) -> Tensor:
    """Return differences with a camera rotated about its centre by p[:3], rad, lab, and moved by p[3:], in 100 mm."""
    turn, sights = so3.exp(torch.from_numpy(p[:3])), compare.sights()
    rays, R = sights[camera]
    origin = rays.origin_lab_mm + 100 * torch.from_numpy(p[3:] if len(p) > 3 else np.zeros(3))
    sights[camera] = Rays(origin_lab_mm=origin, direction_lab=rays.direction_lab @ turn.mT), turn @ R
    return compare(sights)


def _late(compare: Comparison, frame: Tensor, whole: float) -> Iterator[Cause]:
    """Yield the delay of each movie; between frames, measurements are interpolated."""
    shifts = np.arange(-LATEST, LATEST + 0.5, 0.5)
    # With two movies the first one sets the time; with more, the others do.
    for k, name in list(enumerate(compare.names))[len(compare.names) == 2 :]:
        left = [misfit(compare(_shifted(compare, k, frame, float(shift)))) / whole for shift in shifts]
        if np.isnan(left).all():
            continue
        best = int(np.nanargmin(left))
        words = f"the movie of {name} {abs(shifts[best]):g} frames {'late' if shifts[best] > 0 else 'early'}"
        yield Cause(words=f"{words}: check start:", left=left[best], parameters=1, cameras=(k,))


def _shifted(compare: Comparison, camera: int, frame: Tensor, late: float) -> list[Sight]:
    """Return the observations if a movie shows each frame `late` frames later."""
    sights = compare.sights()
    rays, R = sights[camera]
    first = math.floor(late)
    share = torch.full((len(frame), 1), late - first, dtype=torch.float64)
    low, high = (torch.searchsorted(frame, frame + k).clamp(max=len(frame) - 1) for k in (first, first + 1))
    inside = ((frame[low] == frame + first) & (frame[high] == frame + first + 1))[:, None]
    origin, direction = (torch.lerp(of[low], of[high], share) for of in (rays.origin_lab_mm, rays.direction_lab))
    R = so3.exp(share * so3.log(R[high] @ R[low].mT)) @ R[low]
    rays = Rays(origin_lab_mm=origin, direction_lab=torch.where(inside, direction, torch.nan))
    sights[camera] = rays, torch.where(inside[..., None], R, torch.nan)
    return sights
