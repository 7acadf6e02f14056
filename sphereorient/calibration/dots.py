"""Dots in a picture: found as blobs, then measured by a fit of each rim."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from sphereorient.calibration.targets import Floats, Ints
from sphereorient.cameras.checks import camera_error

RING = 1.8  # radii up to which the background is fitted: less than half way to the next dot on usual plates
LEAST_RING_PX = 2.5  # least width beyond the rim, for small dots
OTHERS = 1.5  # radii within which pixels belong to another dot
STEPS = 12  # of Levenberg and Marquardt, before and again after robust weights
SETTLED = 1e-7  # part of the cost; a smaller gain moves a centre by less than 0.001 of its sigma
PARAMETERS = 10  # centre 2, shape 3, blur 1, light 3, contrast 1
LEAST_BLUR_PX = 0.2  # the pixels alone blur a rim by 0.29
_Chain = list[tuple[Floats, Floats, float]]  # centre, shape and area of a blob, one for each grey level


@dataclass(frozen=True, kw_only=True, eq=False)
class Dots:
    """Dots in a picture; NaN where the fit did not converge to an ellipse."""

    uv_px: Floats  # (n, 2), centres of the ellipses
    shape: Floats  # (n, 2, 2), 1/px^2: x^T shape x = 1 on the rim, x from the centre
    sigma_px: Floats  # (n,), standard deviation of each of u and v, from the fit
    contrast: Floats  # (n,), share of light missing in the dark part, 0 .. 1
    misfit: Floats  # (n,), rms of the picture around the fitted dot, relative to its contrast

    def __len__(self) -> int:
        return len(self.uv_px)

    @property
    def area_px(self) -> Floats:
        """(n,), px^2, within the fitted rims."""
        return np.asarray(np.pi / np.sqrt(np.maximum(np.linalg.det(self.shape), 1e-12)))

    def __getitem__(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> "Dots":
        return Dots(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})


@dataclass(frozen=True, kw_only=True)
class DotSettings:
    """Settings of the dot detection."""

    levels: int = 32  # thresholds at which blobs are searched; a dot must be seen at three or more
    smooth_px: float = 0.8  # sigma of the smoothing before the search (noise)
    smallest_area_px: float = 8.0  # a smaller dot has too few pixels for its ellipse
    largest_part: float = 0.2  # longest side of a dot, as part of the picture's shorter side
    faintest: float = 0.4  # least contrast of a dot, as part of that of the strongest ones in the picture
    worst_misfit: float = 0.12  # rms of the picture around the fitted dot, noise included, as part of its contrast


def find_dots(picture: NDArray[np.generic], *, dark: bool = True, settings: DotSettings = DotSettings()) -> Dots:
    """Find dots wholly inside a grey picture (H, W) of any number type and measure their centres, from top to bottom.
    `dark`: dark dots on a bright background. CameraError for another shape, or NaN.
    """
    grey = as_grey(picture)
    centre, shape = _blobs(grey if dark else -grey, settings)
    fit = fit_ellipses(grey, centre, shape, dark=dark)
    height, width = grey.shape
    moved = np.einsum("na,nab,nb->n", fit.uv_px - centre, shape, fit.uv_px - centre)
    reach = half_box(fit.shape)
    with np.errstate(invalid="ignore"):
        inside = ((fit.uv_px - reach >= -0.5) & (fit.uv_px + reach <= [width - 0.5, height - 0.5])).all(axis=1)
        good = inside & (fit.misfit < settings.worst_misfit) & (fit.contrast > 0.1) & (moved < 0.5)
        good &= np.isfinite(fit.sigma_px) & (fit.area_px >= settings.smallest_area_px)
    if good.any():
        # Noise may form faint dots; dots of one plate have equal contrast in any light.
        good &= fit.contrast > settings.faintest * np.percentile(fit.contrast[good], 95)
    good &= _first_of_equals(fit.uv_px, fit.shape, good)
    kept = np.flatnonzero(good)
    return fit[kept[np.lexsort((fit.uv_px[kept, 0], fit.uv_px[kept, 1]))]]


def as_grey(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return a grey picture (H, W), 16 x 16 px or more, as float32; CameraError for anything else or NaN."""
    if picture.ndim != 2 or min(picture.shape) < 16:
        do = "convert it to one grey picture"
        raise camera_error("plate picture", "(H, W) of 16 px or more", f"{picture.shape}", do)
    grey = picture.astype(np.float32)
    if not np.isfinite(grey).all():
        raise camera_error("plate picture", "grey values", "NaN", "export it again")
    return grey


def _first_of_equals(uv_px: Floats, shape: Floats, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    # Two blobs can converge to the same dot; candidates are sorted by confidence.
    kept = np.zeros_like(good)
    for k in np.flatnonzero(good):
        away = uv_px[kept] - uv_px[k]
        kept[k] = not (np.einsum("na,nab,nb->n", away, shape[kept], away) < 1).any()
    return kept


def _blobs(grey: NDArray[np.float32], settings: DotSettings) -> tuple[Floats, Floats]:
    """Return centres (n, 2), px, and shapes (n, 2, 2) of dark blobs that are ellipses at three grey levels or more."""
    smooth = cv2.GaussianBlur(grey, (0, 0), settings.smooth_px)
    low, high = np.percentile(smooth, [0.1, 99.9])
    done: list[_Chain] = []
    going: list[_Chain] = []
    for level in np.linspace(low, high, settings.levels + 2)[1:-1]:
        labels, number, area, centre, shape = _ellipses_at(smooth < level, settings)
        followed: dict[int, _Chain] = {}
        for chain in sorted(going, key=len, reverse=True):  # a blob continues the longest chain that leads to it
            u, v = np.rint(chain[-1][0]).astype(int)
            k = number.get(int(labels[v, u]), -1)
            if k < 0 or k in followed or area[k] > 1.6 * chain[-1][2] + 4:
                done.append(chain)
            else:
                followed[k] = chain
        going = [[*followed.get(k, []), (centre[k], shape[k], float(area[k]))] for k in range(len(area))]
    chains = sorted((chain for chain in done + going if len(chain) >= 3), key=len, reverse=True)
    centres = np.array([chain[len(chain) // 2][0] for chain in chains]).reshape(-1, 2)
    shapes = np.array([chain[len(chain) // 2][1] for chain in chains]).reshape(-1, 2, 2)
    kept = _first_of_equals(centres, shapes, np.ones(len(chains), dtype=bool))
    return centres[kept], shapes[kept]


def _ellipses_at(
    mask: NDArray[np.bool_], settings: DotSettings
) -> tuple[NDArray[np.int32], dict[int, int], Floats, Floats, Floats]:
    """Return the labels of the mask's components, and label, area, centre and shape of those that are ellipses."""
    height, width = mask.shape
    pieces: Any = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    labels, stats = pieces[1], pieces[2]
    longest = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    wanted = (longest <= settings.largest_part * min(height, width)) & (stats[:, cv2.CC_STAT_AREA] >= 4)
    wanted[0] = False
    place = np.cumsum(wanted) - 1
    n = int(wanted.sum())
    v, u = np.nonzero(wanted[labels])
    of = place[labels[v, u]]
    area = np.bincount(of, minlength=n).astype(np.float64)
    centre = np.stack([np.bincount(of, w, minlength=n) for w in (u, v)], axis=1) / area[:, None]
    x, y = u - centre[of, 0], v - centre[of, 1]
    xx, xy, yy = (np.bincount(of, w, minlength=n) / area for w in (x * x, x * y, y * y))
    xx, yy = xx + 1 / 12, yy + 1 / 12  # a pixel has a width
    det = xx * yy - xy * xy
    full = area / (4 * np.pi * np.sqrt(det))  # 1 for an ellipse, 0.955 for a rectangle
    good = np.flatnonzero((full > 0.88) & (area >= 0.5 * settings.smallest_area_px))
    inverse = np.stack([np.stack([yy, -xy], -1), np.stack([-xy, xx], -1)], -2) / (4 * det)[:, None, None]
    number = {int(label): k for k, label in enumerate(np.flatnonzero(wanted)[good])}
    return labels, number, area[good], centre[good], inverse[good]


def fit_ellipses(grey: NDArray[np.float32], centre_px: Floats, shape: Floats, *, dark: bool) -> Dots:
    """Fit rim, blur, light and contrast of n dots to the grey values (H, W) around centres (n, 2), px.
    `shape` (n, 2, 2), 1/px^2: first guess of the rim x^T shape x = 1. The model is light times 1 - contrast cover.
    Light is a plane and cover symmetric: blur, a wrong rim profile and the picture's edge do not move the centre.
    """
    n = len(centre_px)
    values = np.full((n, PARAMETERS), np.nan)
    sigma, misfit = np.full(n, np.nan), np.full(n, np.nan)
    owner = _owners(grey.shape, centre_px, shape)
    half = _window(shape)
    # Group windows of similar size, so that one large blob does not pad all others.
    bucket = np.ceil(np.log(np.maximum(half, 1)) / np.log(1.35)).astype(int)
    for size in np.unique(bucket):
        some = np.flatnonzero(bucket == size)
        windows = _Windows.cut(grey, owner, some, centre_px[some], shape[some])
        values[some], sigma[some], misfit[some] = windows.fit(shape[some], dark)
    return Dots(
        uv_px=centre_px + values[:, :2],
        shape=values[:, [[2, 3], [3, 4]]],
        sigma_px=sigma,
        contrast=values[:, 9],
        misfit=misfit,
    )


def _window(shape: Floats) -> Ints:
    return np.asarray(np.ceil(RING * half_box(shape) + LEAST_RING_PX).astype(int).max(axis=1, initial=0))


def half_box(shape: Floats) -> Floats:
    """Return half width and half height (n, 2) of the bounding boxes of ellipses, px."""
    det = np.maximum(np.linalg.det(shape), 1e-12)
    return np.asarray(np.sqrt(shape[:, [1, 0], [1, 0]] / det[:, None]))


def _owners(size: tuple[int, ...], centre_px: Floats, shape: Floats) -> NDArray[np.int32]:
    """Return the dot of each pixel (H, W), -1 for the background; if dots overlap, the first one."""
    owner = np.full(size, -1, dtype=np.int32)
    box = OTHERS * half_box(shape)
    for k in range(len(centre_px) - 1, -1, -1):
        u0, v0 = np.maximum(np.floor(centre_px[k] - box[k]), 0).astype(int)
        u1, v1 = np.ceil(centre_px[k] + box[k]).astype(int) + 1
        part = owner[v0:v1, u0:u1]
        x = np.arange(u0, u0 + part.shape[1])[None, :] - centre_px[k, 0]
        y = np.arange(v0, v0 + part.shape[0])[:, None] - centre_px[k, 1]
        a, b, c = shape[k, 0, 0], shape[k, 0, 1], shape[k, 1, 1]
        part[a * x * x + 2 * b * x * y + c * y * y < OTHERS**2] = k
    return owner


@dataclass(frozen=True, eq=False)
class _Windows:
    """Pixels around some dots, (n, K): position relative to the first centre, grey value, weight."""

    x: Floats
    y: Floats
    grey: Floats
    weight: Floats

    @classmethod
    def cut(
        cls, grey: NDArray[np.float32], owner: NDArray[np.int32], which: Ints, centre_px: Floats, shape: Floats
    ) -> "_Windows":
        height, width = grey.shape
        half = int(_window(shape).max())
        steps = np.arange(-half, half + 1)
        middle = np.rint(centre_px).astype(int)
        down, across = (step.ravel() for step in np.meshgrid(steps, steps, indexing="ij"))
        u, v = middle[:, :1] + across, middle[:, 1:] + down
        seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u_in, v_in = u.clip(0, width - 1), v.clip(0, height - 1)
        x, y = u - centre_px[:, :1], v - centre_px[:, 1:]
        rim = _Rim(x, y, shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1])
        owned = owner[v_in, u_in]
        used = seen & ((rim.q < RING) | (rim.distance < LEAST_RING_PX)) & ((owned < 0) | (owned == which[:, None]))
        # Put used pixels first and cut to the longest row: half of a window's box is unused.
        first = np.argsort(~used, axis=1, kind="stable")[:, : max(int(used.sum(1).max()), 1)]
        parts = (x, y, grey[v_in, u_in].astype(np.float64), used.astype(np.float64))
        return cls(*(np.take_along_axis(part, first, axis=1) for part in parts))

    def fit(self, shape: Floats, dark: bool) -> tuple[Floats, Floats, Floats]:
        """Return the parameters (n, 10), the sigma of the centre (n,), px, and the misfit (n,)."""
        values = self._descend(self._first_guess(shape, dark), dark)
        # Dirt and glare: pixels with residuals far beyond the window's scatter get little weight.
        residual = self.grey - self._model(values, dark)[0]
        scatter = np.sqrt((self.weight * residual**2).sum(1) / np.maximum(self.weight.sum(1), 1))
        robust = self.weight / (1 + (residual / (3 * scatter[:, None] + 1e-9)) ** 2) ** 2
        values = replace(self, weight=robust)._descend(values, dark)
        model, slope = self._model(values, dark)
        freedom = np.maximum(self.weight.sum(1) - PARAMETERS, 1)
        scatter = np.sqrt((self.weight * (self.grey - model) ** 2).sum(1) / freedom)
        normal, scale = _normal(slope(), robust)
        covariance = np.linalg.pinv(normal, hermitian=True)[:, [0, 1], [0, 1]] / scale[:, :2] ** 2
        sigma = scatter * np.sqrt(np.maximum(covariance.mean(axis=1), 0))
        amplitude = np.abs(values[:, 6] * values[:, 9])
        return values, sigma, scatter / np.maximum(amplitude, 1e-9)

    def _first_guess(self, shape: Floats, dark: bool) -> Floats:
        n = len(shape)
        a, b, c = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
        inner = _Rim(self.x, self.y, a, b, c).q < 1
        inside, outside = self.weight * inner, self.weight * ~inner
        within = (inside * self.grey).sum(1) / np.maximum(inside.sum(1), 1)
        about = (outside * self.grey).sum(1) / np.maximum(outside.sum(1), 1)
        bright, shade = (about, within) if dark else (within, about)
        bright = np.where(np.abs(bright) > 1e-6, bright, 1e-6)
        start = [0 * a, 0 * a, a, b, c, np.full(n, 0.8), bright, 0 * a, 0 * a, 1 - shade / bright]
        return np.stack(start, axis=1)

    def _model(self, values: Floats, dark: bool) -> tuple[Floats, Callable[[], Floats]]:
        """Return the modelled grey values (n, K), and a function that returns their slopes (n, 10, K)."""
        x, y = self.x - values[:, :1], self.y - values[:, 1:2]
        geometry = _Rim(x, y, values[:, 2], values[:, 3], values[:, 4])
        distance, blur, contrast = geometry.distance, values[:, 5, None], values[:, 9, None]
        sign = -1.0 if dark else 1.0
        reach = distance / (np.sqrt(2) * blur)
        cover = 0.5 * (1 + sign * erf(reach))
        light = values[:, 6, None] + values[:, 7, None] * self.x + values[:, 8, None] * self.y
        dim = 1 - contrast * cover

        def slope() -> Floats:
            density = sign * np.exp(-np.minimum(reach**2, 50)) / (np.sqrt(2 * np.pi) * blur)
            pull = -light * contrast * density  # per px of distance
            out = np.empty((len(x), PARAMETERS, x.shape[1]))
            geometry.slopes(pull, out[:, :5])
            out[:, 5] = -pull * distance / blur
            out[:, 6], out[:, 7], out[:, 8] = dim, dim * self.x, dim * self.y
            out[:, 9] = -light * cover
            return out

        return light * dim, slope

    def _cost(self, values: Floats, model: Floats) -> Floats:
        cost = (self.weight * (self.grey - model) ** 2).sum(1)
        ellipse = (values[:, 2] > 0) & (values[:, 2] * values[:, 4] > values[:, 3] ** 2)
        return np.where(ellipse & (values[:, 5] > LEAST_BLUR_PX) & np.isfinite(cost), cost, np.inf)

    def _descend(self, start: Floats, dark: bool) -> Floats:
        """Return the parameters (n, 10) after Levenberg-Marquardt; converged windows are dropped."""
        values = start.copy()
        moving, windows, damping = np.arange(len(start)), self, np.full(len(start), 1e-3)
        model, slope = windows._model(start, dark)
        cost = windows._cost(start, model)
        for _ in range(STEPS):
            jacobian, residual = slope(), windows.grey - model
            normal, scale = _normal(jacobian, windows.weight)
            downhill = (jacobian @ (windows.weight * residual)[..., None])[..., 0] / scale
            normal = normal + damping[:, None, None] * np.eye(PARAMETERS)
            trial = values[moving] + np.linalg.solve(normal, downhill[..., None])[..., 0] / scale
            with np.errstate(all="ignore"):
                new = windows._cost(trial, windows._model(trial, dark)[0])
            better = new < cost
            settled = better & (cost - new < SETTLED * cost) | (damping > 1e2)
            values[moving[better]] = trial[better]
            damping = np.where(better, damping * 0.2, damping * 10)
            moving, damping = moving[~settled], damping[~settled]
            windows = _Windows(*(part[~settled] for part in (windows.x, windows.y, windows.grey, windows.weight)))
            if len(moving) == 0:
                break
            model, slope = windows._model(values[moving], dark)
            cost = windows._cost(values[moving], model)
        return values


def _normal(jacobian: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return J^T W J (n, P, P) scaled to unit diagonal, and the scale of each parameter (n, P)."""
    normal = (jacobian * weight[:, None]) @ jacobian.transpose(0, 2, 1)
    scale = np.sqrt(np.maximum(np.einsum("npp->np", normal), 1e-12))
    return normal / scale[:, :, None] / scale[:, None, :], scale


class _Rim:
    """Distances of pixels x, y (n, K), px, from the rim x^T A x = 1, A = [[a, b], [b, c]] (n,), negative inside.
    To first order in q - 1, with q = sqrt(x^T A x); exact for circles.
    """

    def __init__(self, x: Floats, y: Floats, a: Floats, b: Floats, c: Floats) -> None:
        self.x, self.y = x, y
        self.metric = a, b, c = a[:, None], b[:, None], c[:, None]
        self.along_u, self.along_v = a * x + b * y, b * x + c * y  # A x, half the gradient of q^2
        self.h = np.maximum(np.sqrt(self.along_u**2 + self.along_v**2), 1e-9)  # |A x|
        q2 = np.maximum(x * self.along_u + y * self.along_v, 1e-12)
        self.q = np.sqrt(q2)
        self.distance = (q2 - self.q) / self.h

    def slopes(self, pull: Floats, out: Floats) -> None:
        """Write pull times d distance / d (centre u, centre v, a, b, c) into out (n, 5, K)."""
        a, b, c = self.metric
        by_q2, by_h = pull * (1 - 0.5 / self.q) / self.h, -pull * self.distance / self.h**2
        by_u, by_v = by_h * self.along_u, by_h * self.along_v
        out[:, 0] = -2 * by_q2 * self.along_u - a * by_u - b * by_v
        out[:, 1] = -2 * by_q2 * self.along_v - b * by_u - c * by_v
        out[:, 2] = by_q2 * self.x * self.x + by_u * self.x
        out[:, 3] = 2 * by_q2 * self.x * self.y + by_u * self.y + by_v * self.x
        out[:, 4] = by_q2 * self.y * self.y + by_v * self.y
