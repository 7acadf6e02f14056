"""The ball's outline with sub-pixel accuracy: edges, the circle with the most support, a robust fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.locate.blob import Blob
from sphereorient.locate.settings import LocateSettings

DIRECTIONS = 72  # bins of 5 degrees in which the support of a circle is counted
BEYOND = 1.0  # weight of a rim point beyond a circle against one on it
NOISE_FLOOR = 2.0  # below so many sigmas the root is linear, so that noise is not amplified
NOISE_STEEPNESS = 0.28  # times the root of the noise: steepness of stabilised noise at one pixel of ten thousand
LEAST_RIM = 0.25  # of all directions: least denominator of the coverage, however much of the rim is hidden
NEAR_HIDDEN_PX = 3  # from the border of the mask: edges there do not belong to the rim
PAINTED = 0.15  # least variance of the ball, as a share of the largest variance in the window
BESIDE, NEAR_RIM = (
    0.1,
    1.1,
)  # share of the disk: more foreground beside it is another object; radii: halo
SET_ASIDE = 2  # other round objects whose rims are removed
PROFILES = 180  # radial profiles of the sub-pixel fit; more sample the same pixels again


@dataclass(frozen=True, kw_only=True)
class Outline:
    """The circle fitted to the rim of a ball; made by `fit_outline`."""

    u_px: float
    v_px: float
    radius_px: float
    rms_px: float  # distance of the supporting edges from the circle
    coverage: float  # share of the visible directions that have a supporting edge
    painted: bool = True  # whether it holds more than one grey


@dataclass(frozen=True, kw_only=True, eq=False)
class _Edges:
    """Edge pixels with the unit vector from dark to bright."""

    point: NDArray[np.float64]  # (E, 2), px
    inward: NDArray[np.float64]  # (E, 2)


def _edge_points(window: NDArray[np.float32], steepness: float) -> _Edges:
    """Return the Canny edges of a blurred window, in window pixels."""
    du = cv2.Scharr(window, cv2.CV_32F, 1, 0) / 32
    dv = cv2.Scharr(window, cv2.CV_32F, 0, 1) / 32
    scale = 8192 / max(float(np.abs(du).max()), float(np.abs(dv).max()), 1e-6)
    low, high = 0.5 * steepness * scale, steepness * scale
    edges = cv2.Canny((du * scale).astype(np.int16), (dv * scale).astype(np.int16), low, high, L2gradient=True)
    rows, columns = np.nonzero(edges)
    gradient = np.stack([du[rows, columns], dv[rows, columns]], axis=1).astype(np.float64)
    norm = np.linalg.norm(gradient, axis=1, keepdims=True)
    keep = norm[:, 0] > 0
    point = np.stack([columns, rows], axis=1).astype(np.float64)[keep]
    return _Edges(point=point, inward=gradient[keep] / norm[keep])


def _in_the_clear(place: NDArray[np.float64], clear: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return which points (n, 2), window px, are not near the mask, (n,)."""
    if clear is None:
        return np.ones(len(place), bool)
    limit = np.array(clear.shape[::-1]) - 1
    u, v = np.rint(place).astype(np.int64).clip(0, limit).T
    return np.asarray(clear[v, u])


def _rim_in_the_clear(circle: NDArray[np.float64], clear: NDArray[np.bool_] | None) -> float:
    """Return the number of directions in which the rim of a circle is not near the mask."""
    if clear is None:
        return DIRECTIONS
    angle = (np.arange(DIRECTIONS) + 0.5) * (2 * np.pi / DIRECTIONS)
    rim = circle[:2] + circle[2] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return max(float(_in_the_clear(rim, clear).sum()), LEAST_RIM * DIRECTIONS)


def _circles_through(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return circles (n, 3: u, v, r) through triples of points (n, 3, 2); NaN for collinear ones."""
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    cross = 2 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        a2, b2 = (a**2).sum(1) / cross, (b**2).sum(1) / cross
        offset = np.stack([b[:, 1] * a2 - a[:, 1] * b2, a[:, 0] * b2 - b[:, 0] * a2], axis=1)
    return np.column_stack([p[:, 0] + offset, np.linalg.norm(offset, axis=1)])


def _support(circles: NDArray[np.float64], edges: _Edges, tolerance: float) -> NDArray[np.float64]:
    """Return the support of circles: directions with an edge on the circle, less half of those with one just outside.

    An edge supports a circle if it lies on it and falls outwards along the radius. The edges of the rim are the
    outermost: a circle through texture edges has more edges of the ball outside.
    """
    away = edges.point[None] - circles[:, None, :2]
    distance = np.linalg.norm(away, axis=2)
    radial = -(away * edges.inward[None]).sum(2) / np.maximum(distance, 1e-9) > 0.8
    offset = distance - circles[:, 2:3]
    direction = ((np.arctan2(away[..., 1], away[..., 0]) + np.pi) * (DIRECTIONS / (2 * np.pi))).astype(int) % DIRECTIONS
    on = radial & (np.abs(offset) < tolerance)
    beyond = radial & (offset >= tolerance) & (offset < 0.25 * circles[:, 2:3])
    row = np.arange(len(circles))[:, None] * DIRECTIONS + direction
    counted = [
        np.bincount(row[which], minlength=len(circles) * DIRECTIONS).reshape(-1, DIRECTIONS) > 0
        for which in (on, beyond)
    ]
    return np.asarray(counted[0].sum(1) - 0.5 * counted[1].sum(1), np.float64)


def _painted(window: NDArray[np.float32], circle: NDArray[np.float64]) -> bool:
    """Return whether the variance inside a circle is not much less than in squares of its size elsewhere.

    An object before or beside the ball may be as round and as large, with a more complete rim; but it has one colour.
    """
    side = max(3, round(2**0.5 * circle[2]) | 1)  # of the square within the circle
    mean, square = (
        cv2.boxFilter(part, -1, (side, side), borderType=cv2.BORDER_REPLICATE) for part in (window, window**2)
    )
    variance = square - mean**2
    limit = np.array(window.shape[::-1]) - 1
    u, v = np.rint(circle[:2]).astype(np.int64).clip(0, limit)
    return bool(variance[v, u] >= PAINTED * variance.max())


def _alone(window: NDArray[np.float32], circle: NDArray[np.float64]) -> bool:
    """Return whether there is no foreground outside a circle: then it may be a ball of one colour."""
    row, column = np.ogrid[: window.shape[0], : window.shape[1]]
    away = np.hypot(row - circle[1], column - circle[0]) / circle[2]
    inside = away < 1
    beside = (window > 0.5 * np.median(window[inside])) & (away > NEAR_RIM) if inside.any() else inside
    return bool(float(beside.sum()) < BESIDE * np.pi * circle[2] ** 2)


def _best_circle(
    edges: _Edges, radius_range: tuple[float, float], tolerance: float, tries: int = 400
) -> NDArray[np.float64] | None:
    """Return the circle of an allowed size with the most support, from seeded random triples (RANSAC)."""
    if len(edges.point) < 8:
        return None
    # A fixed seed: the same picture gives the same circle.
    choice = np.random.default_rng(0).integers(0, len(edges.point), (4 * tries, 3))
    circles = _circles_through(edges.point[choice])
    good = np.isfinite(circles).all(1) & (circles[:, 2] > radius_range[0]) & (circles[:, 2] < radius_range[1])
    circles = circles[good]
    if not len(circles):
        return None
    # All three edges must fall outwards: most triples of texture edges fail this cheap test.
    away = edges.point[choice[good]] - circles[:, None, :2]
    outwards = -(away * edges.inward[choice[good]]).sum(2) / circles[:, 2:3] > 0.8
    circles = circles[outwards.all(1)][:tries]
    if not len(circles):
        return None
    best: NDArray[np.float64] = circles[int(_support(circles, edges, tolerance).argmax())]
    return best


def _ball_circle(
    edges: _Edges, window: NDArray[np.float32], radius_range: tuple[float, float], tolerance: float
) -> tuple[NDArray[np.float64] | None, bool]:
    """Return the best circle that may be the ball, and whether it is painted; rims of other objects are removed."""
    for _ in range(SET_ASIDE + 1):
        circle = _best_circle(edges, radius_range, tolerance)
        painted = circle is not None and _painted(window, circle)
        if circle is None or painted or _alone(window, circle):
            return circle, painted
        away = np.abs(np.linalg.norm(edges.point - circle[:2], axis=1) - circle[2]) > tolerance
        edges = _Edges(point=edges.point[away], inward=edges.inward[away])
    return None, False


def _radial_edges(
    window: NDArray[np.float32],
    circle: NDArray[np.float64],
    reach: tuple[float, float],
    steepness: float,
    clear: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Find the outermost steep fall along radial profiles about a circle, with sub-pixel accuracy.

    The outermost, not the steepest: texture edges inside are often steeper than the rim.

    Returns:
        Of profiles with such a fall: unit direction (n, 2), signed distance from the circle (n,), px, steepness (n,).
    """
    step = 0.5
    # Two samples to each side of a fall are needed, however small the circle.
    offset = np.arange(-max(reach[0], 2 * step), max(reach[1], 2 * step) + step / 2, step)
    angle = np.arange(PROFILES) * (2 * np.pi / PROFILES)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at = circle[:2] + outward[:, None] * (circle[2] + offset)[None, :, None]
    profile = cv2.remap(
        window,
        at[..., 0].astype(np.float32),
        at[..., 1].astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    fall = np.asarray(cv2.blur(profile[:, :-2] - profile[:, 2:], (3, 1)) / (2 * step), np.float32)
    # A maximum within 1 px to both sides: interpolation makes the tail of the blurred rim ripple.
    peak = (fall >= cv2.dilate(fall, np.ones((1, 5), np.uint8))) & (fall > steepness)
    peak[:, [0, -1]] = False
    last = peak.shape[1] - 1 - peak[:, ::-1].argmax(1)
    rows = np.arange(PROFILES)
    last = np.where(peak.any(1), last, 1)
    left, middle, right = fall[rows, last - 1], fall[rows, last], fall[rows, last + 1]
    bend = left - 2 * middle + right
    limit = np.array(window.shape[::-1]) - 1
    keep = peak.any(1) & (bend < 0) & ((at[:, -1] >= 0) & (at[:, -1] <= limit)).all(1)
    keep &= _in_the_clear(at[rows, last + 1], clear)
    shift = 0.5 * (left - right)[keep] / bend[keep]
    return outward[keep], offset[last[keep] + 1] + shift * step, middle[keep]


def _consensus(
    outward: NDArray[np.float64], offset: NDArray[np.float64], trust: NDArray[np.float64], tolerance: float
) -> NDArray[np.float64]:
    """Return the shift (du, dv, dr) of a circle on which most rim points agree, from seeded random triples.

    Where black paint hides the rim, the outermost fall is a texture edge further inside. Such outliers are one-sided: a
    mean or a median would shrink the circle; the largest consensus set does not.
    """
    design = np.column_stack([outward, np.ones(len(outward))])
    choice = np.random.default_rng(0).integers(0, len(offset), (300, 3))
    triple = design[choice]
    solvable = np.abs(np.linalg.det(triple)) > 0.2  # triples within about 60 degrees are ill-conditioned
    if not solvable.any():
        return np.zeros(3)
    moves = np.linalg.solve(triple[solvable], offset[choice[solvable]][..., None])[..., 0]
    residual = offset - moves @ design.T
    # Nothing of the ball lies beyond its rim: points beyond a circle weigh more than points on it.
    merit = (np.abs(residual) < tolerance) @ trust - BEYOND * ((residual > 2 * tolerance) @ trust)
    best: NDArray[np.float64] = moves[int(merit.argmax())]
    return best


def _fit_circle(
    window: NDArray[np.float32],
    circle: NDArray[np.float64],
    tolerance: float,
    steepness: float,
    clear: NDArray[np.bool_] | None,
) -> Outline | None:
    """Fit a circle to the sub-pixel rim points: consensus, then least squares with Tukey weights."""
    for reach in ((0.35 * circle[2], 0.25 * circle[2]), (0.1 * circle[2], 0.1 * circle[2])):
        outward, offset, fall = _radial_edges(window, circle, reach, steepness, clear)
        if len(offset) < 12:
            return None
        # Weak falls are often the halo of a texture patch.
        trust = np.minimum(fall / np.percentile(fall, 75), 1.0)
        design = np.column_stack([outward, np.ones(len(outward))])
        move = _consensus(outward, offset, trust, 0.4 * tolerance)
        residual = offset - design @ move
        for _ in range(6):
            near = np.abs(residual) < tolerance
            scale = max(1.4826 * float(np.median(np.abs(residual[near]))) if near.any() else 0.0, 0.05)
            weight = np.clip(1 - (residual / (4 * scale)) ** 2, 0, None) ** 2 * near * trust
            if np.count_nonzero(weight) < 8:
                return None
            root = np.sqrt(weight)
            move = np.linalg.lstsq(design * root[:, None], offset * root, rcond=None)[0]
            residual = offset - design @ move
        circle = circle + move
    used = weight > 0
    rms = float(np.sqrt((residual[used] ** 2).mean()))
    angle = np.arctan2(outward[used, 1], outward[used, 0])
    direction = ((angle + np.pi) * (DIRECTIONS / (2 * np.pi))).astype(int) % DIRECTIONS
    coverage = min(len(np.unique(direction)) / _rim_in_the_clear(circle, clear), 1.0)
    return Outline(
        u_px=float(circle[0]), v_px=float(circle[1]), radius_px=float(circle[2]), rms_px=rms, coverage=coverage
    )


def _stabilised(window: NDArray[np.float32], noise: float, blur_px: float) -> NDArray[np.float32]:
    """Blur and take the root (variance stabilisation for shot noise), so that dim and bright rims count alike."""
    blurred = cv2.GaussianBlur(window, (0, 0), blur_px)
    out: NDArray[np.float32] = np.sqrt(blurred + noise) - np.float32(np.sqrt(noise))
    return out


def fit_outline(
    difference: NDArray[np.float32],
    noise: float,
    blob: Blob,
    diameter_px: float,
    settings: LocateSettings,
    shown: NDArray[np.bool_] | None = None,
) -> Outline | None:
    """Fit the circle of a ball near a blob.

    Robust against texture edges (not on one circle), bubbles (few directions), and black paint before a dark background
    (missing directions).

    Args:
        difference: (H, W), |frame - background|, grey levels.
        noise: typical standard deviation of a background pixel, grey levels.
        blob: approximate position.
        diameter_px: expected diameter.
        settings: of this room.
        shown: (H, W), False where something hides the ball; None: nowhere.

    Returns:
        The outline in picture pixels, or None if no circle of an allowed size is supported.

    Source: paper section III A (Canny edges and a circle fit); the robust part is ours.
    """
    reach = int(np.ceil(0.5 * diameter_px * (1 + settings.diameter_tolerance) + 8))
    left, top = max(0, int(blob.u_px) - reach), max(0, int(blob.v_px) - reach)
    around = np.s_[top : int(blob.v_px) + reach + 1, left : int(blob.u_px) + reach + 1]
    window, clear = difference[around], None
    if shown is not None:
        square = np.ones((2 * NEAR_HIDDEN_PX + 1,) * 2, np.uint8)
        clear = cv2.erode(shown[around].astype(np.uint8), square) > 0
    if min(window.shape) < 8:
        return None
    window = _stabilised(window, NOISE_FLOOR * noise, settings.edge_blur_px)
    contrast = float(np.percentile(window, 90))
    # A step blurred by sigma is contrast / (sigma sqrt(2 pi)) steep.
    # The floor keeps circles from being fitted to noise alone.
    floor = NOISE_STEEPNESS * noise**0.5
    steepness = max(settings.edge_fraction * contrast / (settings.edge_blur_px * 2.5), floor)
    edges = _edge_points(window, steepness)
    kept = _in_the_clear(edges.point, clear)
    edges = _Edges(point=edges.point[kept], inward=edges.inward[kept])
    sizes = tuple(0.5 * diameter_px * (1 + sign * settings.diameter_tolerance) for sign in (-1, 1))
    circle, painted = _ball_circle(edges, window, (sizes[0], sizes[1]), settings.edge_tolerance_px)
    if circle is None:
        return None
    fit = _fit_circle(window, circle, settings.edge_tolerance_px, max(0.5 * steepness, floor), clear)
    if fit is None or not sizes[0] < fit.radius_px < sizes[1]:
        return None
    return replace(fit, u_px=fit.u_px + left, v_px=fit.v_px + top, painted=painted)
