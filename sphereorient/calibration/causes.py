"""What may be wrong where cameras contradict each other; each cause has few parameters, which are fitted robustly."""

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
from sphereorient.calibration.comparison import Comparison, Sight, misfit
from sphereorient.calibration.targets import Floats
from sphereorient.cameras import Camera, Rays

LATEST = 8  # frames by which a movie may be late
PLAUSIBLE = 0.2  # largest deviation: relative, rad, 100 mm
FIT: dict[str, Any] = {"loss": "soft_l1", "x_scale": 0.01, "max_nfev": 30}
FLIPS = {"horizontal": (0,), "vertical": (1,), "both": (0, 1)}  # axes of the picture


@dataclass(frozen=True, kw_only=True)
class Cause:
    """What would explain a contradiction."""

    words: str  # with its size, and what to do
    left: float = math.inf  # share of the misfit that it leaves
    parameters: int = 0
    deadly: bool = False  # nothing can be measured before it is corrected
    cameras: tuple[int, ...] = ()  # that it blames


def other_readings(
    cameras: Mapping[str, Camera], centre_px: Tensor, R_view_body: Tensor, flips: Sequence[str] = tuple(FLIPS)
) -> Iterator[tuple[Cause, Tensor, Tensor]]:
    """Yield causes, centres (N, C, 2), px, and attitudes (N, C, 3, 3) with two movies swapped, or one flipped."""
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
    """Yield what may be wrong, with the share that it leaves of the misfit of what was `found`, (P, N, 8)."""
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

    words = f"sphere.diameter {mm:.4g} explains the pictures if it is {{:.4g}}, or the calibration's lengths are off"
    yield fitted(lambda p: compare(sights, larger=float(p[0])), 1, words, lambda p: [mm * math.exp(p[0])])
    for some in [each, *([k] for k in each)]:
        words = f"pixels of {' and '.join(names[k] for k in some)} {{:+.1f}} % wider than calibrated: check sx, "
        words += "pixel_pitch, and whether the movie was resized"
        wide = fitted(partial(_wide, compare, some), 1, words, lambda p: [100 * p[0]])
        yield replace(wide, cameras=tuple(some))
    for k, name in enumerate(names):
        for count, moved in ((3, ""), (6, " and moved by {:.2g} mm")):
            words = f"{name} turned by {{:.2g}} degrees{moved} since its calibration: calibrate again"
            yield replace(fitted(partial(_moved, compare, k), count, words, _turn_and_move), cameras=(k,))
    if compare.frame is not None:
        yield from _late(compare, compare.frame, whole)


def _turn_and_move(p: Floats) -> list[float]:
    """Return the turn, degrees, and the move, mm, of the parameters of `_moved`."""
    return [math.degrees(float(np.linalg.norm(p[:3]))), 100 * float(np.linalg.norm(p[3:]))]


def _wide(compare: Comparison, some: Sequence[int], p: Floats) -> Tensor:
    """Pixels wider than high; the circle about the picture is half as much too large."""
    pixels, larger = compare.centre_px.clone(), torch.zeros(len(compare.names), dtype=torch.float64)
    for k in some:
        middle = 0.5 * (compare.cameras[k].image_size[0] - 1)
        pixels[:, k, 0] = middle + (pixels[:, k, 0] - middle) / (1 + float(p[0]))
        larger[k] = math.log1p(0.5 * float(p[0]))
    return compare(compare.sights(pixels), larger, wider=2 * larger)


def _moved(compare: Comparison, camera: int, p: Floats) -> Tensor:
    """The camera turned about its centre by p[:3], rad, lab, and moved by p[3:], in 100 mm."""
    turn, sights = so3.exp(torch.from_numpy(p[:3])), compare.sights()
    rays, R = sights[camera]
    origin = rays.origin_lab_mm + 100 * torch.from_numpy(p[3:] if len(p) > 3 else np.zeros(3))
    sights[camera] = Rays(origin_lab_mm=origin, direction_lab=rays.direction_lab @ turn.mT), turn @ R
    return compare(sights)


def _late(compare: Comparison, frame: Tensor, whole: float) -> Iterator[Cause]:
    """Each movie some frames late; between frames all is interpolated."""
    shifts = np.arange(-LATEST, LATEST + 0.5, 0.5)
    # Of two the first one sets the time; of more the others do.
    for k, name in list(enumerate(compare.names))[len(compare.names) == 2 :]:
        left = [misfit(compare(_shifted(compare, k, frame, float(shift)))) / whole for shift in shifts]
        if np.isnan(left).all():
            continue
        best = int(np.nanargmin(left))
        words = f"the movie of {name} {abs(shifts[best]):g} frames {'late' if shifts[best] > 0 else 'early'}"
        yield Cause(words=f"{words}: check start:", left=left[best], parameters=1, cameras=(k,))


def _shifted(compare: Comparison, camera: int, frame: Tensor, late: float) -> list[Sight]:
    """Return what the cameras say if one shows each frame `late` frames later."""
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
