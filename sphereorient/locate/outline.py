"""The circle of the sphere in a picture: a blob of its size, then the outline near the blob."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.locate.settings import LocateSettings

Floats = NDArray[np.float64]
Levels = NDArray[np.float32]  # a picture (H, W), grey levels
Mask = NDArray[np.bool_]

DIRECTIONS = 72  # bins of 5 degrees for a circle's support
BEYOND = 1.0  # weight of a rim point outside a circle relative to one on it
NOISE_FLOOR = 2.0  # sigmas below which the root is linear, not to amplify noise
NOISE_STEEPNESS = 0.28  # times root noise: steepness of stabilised noise at one pixel in 10^4
LEAST_RIM = 0.25  # least denominator of the coverage, share of all directions
NEAR_HIDDEN_PX = 3  # edges this near the mask do not belong to the rim
PAINTED = 0.15  # least variance of the sphere, share of the window's largest
BESIDE, NEAR_RIM = 0.1, 1.1  # most foreground beside the sphere, share of the disk; radii: halo
SET_ASIDE = 2  # other round objects whose rims are removed
THIN = 0.6  # of the least coverage: least support of a rim. Balls have 1.2 or more, blades 0.4
# Largest rms of a circle: in tolerances times squared coverage; least coverage in this product.
ROUGH, SHORT = 1.5, 4 / 9
PROFILES = 180  # radial profiles; more would sample the same pixels
ALL_AROUND = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class Blob:
    """Approximate position of the sphere."""

    u_px: float
    v_px: float
    merit: float  # variance inside times similarity to a disk


def coarser(picture: Levels, factor: int) -> Levels:
    """Average by an integer factor, cropping right and lower borders (other ratios are 40 times slower)."""
    height, width = (side // factor for side in picture.shape)
    whole = picture[: height * factor, : width * factor]
    return picture if factor == 1 else np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def find_blobs(difference: Levels, noise: Levels, diameter_px: float, settings: LocateSettings) -> list[Blob]:
    """Return at most `settings.blob_candidates` round blobs of about `diameter_px`, best first.
    `difference` is |frame - background|, `noise` the background's sigma, (H, W), grey levels. The blob filter is a
    difference of two box filters.
    Source: paper section III A.
    """
    factor = settings.reduction
    small = np.maximum(coarser(difference - settings.noise_factor * noise, factor), 0)
    # Clip near the sphere's brightness, against bright reflections.
    lit = small[small > 0]
    if lit.size == 0:
        return []
    small = np.minimum(small, np.float32(np.percentile(lit, 95)))
    size = diameter_px / factor
    inner, outer = (max(3, round(size * share) | 1) for share in (0.85, 1.5))
    outer = max(outer, inner + 2)
    area_ratio = (inner / outer) ** 2
    mean_in = cv2.boxFilter(small, -1, (inner, inner), borderType=cv2.BORDER_CONSTANT)
    mean_out = cv2.boxFilter(small, -1, (outer, outer), borderType=cv2.BORDER_CONSTANT)
    ring = (mean_out - area_ratio * mean_in) / (1 - area_ratio)
    response = mean_in - ring
    blobs = []
    reach = max(1, round(0.6 * size))
    for _ in range(settings.blob_candidates):
        row, column = np.unravel_index(int(response.argmax()), response.shape)
        if response[row, column] <= 0:
            break
        u, v, merit = _judge(small, float(column), float(row), size / 2)
        blobs.append(Blob(u_px=(u + 0.5) * factor - 0.5, v_px=(v + 0.5) * factor - 0.5, merit=merit))
        response[window_about(float(column), float(row), reach)] = 0
    return sorted(blobs, key=lambda blob: -blob.merit)


def _judge(small: Levels, u: float, v: float, radius: float) -> tuple[float, float, float]:
    """Centre a blob on its foreground; return (u, v, merit)."""
    merit = 0.0
    for _ in range(2):
        around = window_about(u, v, int(np.ceil(1.5 * radius)))
        window = small[around]
        rows, columns = (
            grid + at.start for grid, at in zip(np.indices(window.shape, dtype=np.float32), around, strict=True)
        )
        inside = (rows - v) ** 2 + (columns - u) ** 2 <= (1.1 * radius) ** 2
        weight = (window > 0) & inside
        total, count = int(np.count_nonzero(window)), int(np.count_nonzero(weight))
        if count == 0:
            return u, v, 0.0
        merit = float(window[inside].var()) * (count / total) ** 2
        u, v = float(columns[weight].mean()), float(rows[weight].mean())
    return u, v, merit


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Circle fitted to the limb."""

    u_px: float
    v_px: float
    radius_px: float
    rms_px: float  # distance of supporting edges from the circle
    coverage: float  # share of the visible directions with a supporting edge
    spread: tuple[tuple[float, ...], ...] = ALL_AROUND  # covariance of (u, v, radius), (3, 3), over rms_px^2
    stretch: float = math.nan  # relative excess of width over height
    painted: bool = True  # more than one grey inside

    @property
    def circle(self) -> tuple[float, float, float]:
        """Column and row of the middle, and radius, px."""
        return self.u_px, self.v_px, self.radius_px


@dataclass(frozen=True, kw_only=True, eq=False)
class Edges:
    """Edge pixels (E, 2), px, and unit vectors from dark to bright (E, 2)."""

    point: Floats
    inward: Floats

    def where(self, kept: Mask) -> "Edges":
        """Return some of the edges, by a mask (E,)."""
        return Edges(point=self.point[kept], inward=self.inward[kept])


def edge_points(window: Levels, steepness: float) -> Edges:
    """Return the edges of a picture (H, W) that rise by at least `steepness` per px."""
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
    return Edges(point=point, inward=gradient[keep] / norm[keep])


def window_about(u: float, v: float, reach: int) -> tuple[slice, slice]:
    """Return the rows and columns of a picture within `reach` of a point, px."""
    rows, columns = (slice(max(0, int(at) - reach), max(0, int(at) + reach + 1)) for at in (v, u))
    return rows, columns


def direction_bins(across: Floats, down: Floats) -> NDArray[np.int64]:
    """Return the bins, of `DIRECTIONS`, of the directions of vectors, (n,)."""
    return ((np.arctan2(down, across) + np.pi) * (DIRECTIONS / (2 * np.pi))).astype(int) % DIRECTIONS


def stabilised(difference: Levels, noise: float, settings: LocateSettings) -> Levels:
    """Return the root of a blurred difference: shot noise becomes uniform, and dim and bright rims count equally."""
    lift = NOISE_FLOOR * noise
    blurred = cv2.GaussianBlur(difference, (0, 0), settings.edge_blur_px)
    return np.asarray(np.sqrt(blurred + lift) - np.float32(np.sqrt(lift)), np.float32)


def least_steepness(contrast: float, noise: float, settings: LocateSettings) -> tuple[float, float]:
    """Return the least steepness of an edge in a stabilised picture, and the floor that excludes noise."""
    floor = NOISE_STEEPNESS * noise**0.5
    # A step blurred by sigma has steepness contrast / (sigma sqrt(2 pi)).
    return max(settings.edge_fraction * contrast / (settings.edge_blur_px * 2.5), floor), floor


def away_from_hidden(shown: Mask | None, shape: tuple[int, ...]) -> Mask:
    """Return where in a picture, or a window, edges are not due to a mask, (H, W)."""
    if shown is None:
        return np.ones(shape, bool)
    square = np.ones((2 * NEAR_HIDDEN_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(shown.astype(np.uint8), square) > 0)


def in_the_clear(place: Floats, clear: Mask) -> Mask:
    """Return which points (n, 2), window px, are away from the mask, (n,)."""
    limit = np.array(clear.shape[::-1]) - 1
    u, v = np.rint(place).astype(np.int64).clip(0, limit).T
    return np.asarray(clear[v, u])


def _rim_in_the_clear(circle: Floats, clear: Mask) -> float:
    """Return the number of directions in which the rim is away from the mask."""
    angle = (np.arange(DIRECTIONS) + 0.5) * (2 * np.pi / DIRECTIONS)
    rim = circle[:2] + circle[2] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return max(float(in_the_clear(rim, clear).sum()), LEAST_RIM * DIRECTIONS)


def _circles_through(p: Floats) -> Floats:
    """Return circles (n, 3: u, v, r) through point triples (n, 3, 2); NaN if collinear."""
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    cross = 2 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        a2, b2 = (a**2).sum(1) / cross, (b**2).sum(1) / cross
        offset = np.stack([b[:, 1] * a2 - a[:, 1] * b2, a[:, 0] * b2 - b[:, 0] * a2], axis=1)
    return np.column_stack([p[:, 0] + offset, np.linalg.norm(offset, axis=1)])


def support(circles: Floats, edges: Edges, tolerance: float) -> Floats:
    """Count directions with an edge on the circle, less half of those with one just outside: the rim is outermost."""
    across, down = (edges.point[:, k] - circles[:, k : k + 1] for k in (0, 1))
    distance = np.sqrt(across**2 + down**2)
    offset = distance - circles[:, 2:3]
    # Most edges are far from most circles.
    near = (offset > -tolerance) & (offset < np.maximum(0.25 * circles[:, 2:3], tolerance))
    circle, edge = np.nonzero(near)
    across, down, distance, offset = (part[near] for part in (across, down, distance, offset))
    inward = edges.inward[edge]
    radial = -(across * inward[:, 0] + down * inward[:, 1]) / np.maximum(distance, 1e-9) > 0.8
    row = circle * DIRECTIONS + direction_bins(across, down)
    counted = [
        np.bincount(row[radial & which], minlength=len(circles) * DIRECTIONS).reshape(-1, DIRECTIONS) > 0
        for which in (offset < tolerance, (offset >= tolerance) & (offset < 0.25 * circles[circle, 2]))
    ]
    return np.asarray(counted[0].sum(1) - 0.5 * counted[1].sum(1), np.float64)


def _painted(window: Levels, circle: Floats) -> bool:
    """Return whether the variance inside a circle is near the window's largest; objects of one colour have less."""
    side = max(3, round(2**0.5 * circle[2]) | 1)
    mean, square = (
        cv2.boxFilter(part, -1, (side, side), borderType=cv2.BORDER_REPLICATE) for part in (window, window**2)
    )
    variance = square - mean**2
    limit = np.array(window.shape[::-1]) - 1
    u, v = np.rint(circle[:2]).astype(np.int64).clip(0, limit)
    return bool(variance[v, u] >= PAINTED * variance.max())


def _alone(window: Levels, circle: Floats) -> bool:
    """Return whether there is no foreground outside a circle, so that it may be a sphere of one colour."""
    row, column = np.ogrid[: window.shape[0], : window.shape[1]]
    away = np.hypot(row - circle[1], column - circle[0]) / circle[2]
    inside = away < 1
    beside = (window > 0.5 * np.median(window[inside])) & (away > NEAR_RIM) if inside.any() else inside
    return bool(float(beside.sum()) < BESIDE * np.pi * circle[2] ** 2)


def _best_circle(edges: Edges, radius_range: tuple[float, float], tolerance: float, tries: int = 400) -> Floats | None:
    """Return the best supported circle of an allowed size (RANSAC, fixed seed)."""
    if len(edges.point) < 8:
        return None
    choice = np.random.default_rng(0).integers(0, len(edges.point), (4 * tries, 3))
    circles = _circles_through(edges.point[choice])
    good = np.isfinite(circles).all(1) & (circles[:, 2] > radius_range[0]) & (circles[:, 2] < radius_range[1])
    circles = circles[good]
    if not len(circles):
        return None
    # Quick test first: all three edges must fall outwards.
    away = edges.point[choice[good]] - circles[:, None, :2]
    outwards = -(away * edges.inward[choice[good]]).sum(2) / circles[:, 2:3] > 0.8
    circles = circles[outwards.all(1)][:tries]
    if not len(circles):
        return None
    best: Floats = circles[int(support(circles, edges, tolerance).argmax())]
    return best


def _ball_circle(
    edges: Edges, window: Levels, radius_range: tuple[float, float], tolerance: float
) -> tuple[Floats | None, bool]:
    """Return the best circle that may be the sphere, and whether it is painted; rims of other objects are removed."""
    for _ in range(SET_ASIDE + 1):
        circle = _best_circle(edges, radius_range, tolerance)
        painted = circle is not None and _painted(window, circle)
        if circle is None or painted or _alone(window, circle):
            return circle, painted
        away = np.abs(np.linalg.norm(edges.point - circle[:2], axis=1) - circle[2]) > tolerance
        edges = edges.where(away)
    return None, False


def _radial_edges(
    window: Levels, circle: Floats, reach: tuple[float, float], steepness: float, clear: Mask
) -> tuple[Floats, Floats, Floats]:
    """Return direction (n, 2), offset (n,), px, and steepness (n,) of outermost falls; inner edges may be steeper."""
    step = 0.5
    # A fall needs two samples on each side.
    offset = np.arange(-max(reach[0], 2 * step), max(reach[1], 2 * step) + step / 2, step)
    angle = np.arange(PROFILES) * (2 * np.pi / PROFILES)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at = circle[:2] + outward[:, None] * (circle[2] + offset)[None, :, None]
    right, down = at.astype(np.float32).transpose(2, 0, 1)
    profile = cv2.remap(window, right, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    fall = np.asarray(cv2.blur(profile[:, :-2] - profile[:, 2:], (3, 1)) / (2 * step), np.float32)
    # Maximum within 1 px, against ripples by interpolation in the tail of the blurred rim.
    peak = (fall >= cv2.dilate(fall, np.ones((1, 5), np.uint8))) & (fall > steepness)
    peak[:, [0, -1]] = False
    last = peak.shape[1] - 1 - peak[:, ::-1].argmax(1)
    rows = np.arange(PROFILES)
    last = np.where(peak.any(1), last, 1)
    left, middle, right = fall[rows, last - 1], fall[rows, last], fall[rows, last + 1]
    bend = left - 2 * middle + right
    limit = np.array(window.shape[::-1]) - 1
    keep = peak.any(1) & (bend < 0) & ((at[:, -1] >= 0) & (at[:, -1] <= limit)).all(1)
    keep &= in_the_clear(at[rows, last + 1], clear)
    shift = 0.5 * (left - right)[keep] / bend[keep]
    return outward[keep], offset[last[keep] + 1] + shift * step, middle[keep]


def _consensus(outward: Floats, offset: Floats, trust: Floats, tolerance: float) -> Floats:
    """Return the shift (du, dv, dr) with most support; as outliers lie inside, means and medians are biased."""
    design = np.column_stack([outward, np.ones(len(outward))])
    choice = np.random.default_rng(0).integers(0, len(offset), (300, 3))
    triple = design[choice]
    solvable = np.abs(np.linalg.det(triple)) > 0.2  # triples within 60 degrees are ill-conditioned
    if not solvable.any():
        return np.zeros(3)
    moves = np.linalg.solve(triple[solvable], offset[choice[solvable]][..., None])[..., 0]
    residual = offset - moves @ design.T
    # The sphere ends at its rim: points outside have more weight than points on it.
    merit = (np.abs(residual) < tolerance) @ trust - BEYOND * ((residual > 2 * tolerance) @ trust)
    best: Floats = moves[int(merit.argmax())]
    return best


def _fit_circle(window: Levels, circle: Floats, tolerance: float, steepness: float, clear: Mask) -> Outline | None:
    for reach in ((0.35 * circle[2], 0.25 * circle[2]), (0.1 * circle[2], 0.1 * circle[2])):
        outward, offset, fall = _radial_edges(window, circle, reach, steepness, clear)
        if len(offset) < 12:
            return None
        # Weak falls are often halos of texture patches.
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
    # Light, paint and blur shift neighbouring edges together: more edges do not help, but a longer arc does.
    information = 2 / PROFILES * design[used].T @ design[used]
    ellipse = np.column_stack([design, outward[:, 0] ** 2 - outward[:, 1] ** 2, 2 * outward[:, 0] * outward[:, 1]])
    wider = np.linalg.lstsq(ellipse * root[:, None], offset * root, rcond=None)[0][3]
    rms = float(np.sqrt((residual[used] ** 2).mean()))
    coverage = min(len(np.unique(direction_bins(*outward[used].T))) / _rim_in_the_clear(circle, clear), 1.0)
    return Outline(
        u_px=float(circle[0]),
        v_px=float(circle[1]),
        radius_px=float(circle[2]),
        rms_px=rms,
        coverage=coverage,
        spread=tuple(map(tuple, np.linalg.inv(information).tolist())),
        stretch=float(2 * wider / circle[2]),
    )


def fit_outline(
    difference: Levels,
    noise: float,
    blob: Blob,
    diameter_px: float,
    settings: LocateSettings,
    shown: Mask | None = None,
) -> Outline | None:
    """Return the outline near a blob, picture px; None if no circle of an allowed size is supported. Fewer supporting
    edges must fit better, as edges of paint and of glints at the border scatter.
    `difference` (H, W) is |frame - background| and `noise` its sigma, grey levels; `shown` (H, W) is False where
    something hides the sphere. Robust to texture edges, bubbles and black paint on a dark background.
    Source: paper section III A (Canny edges, circle fit); the robust part is ours.
    """
    reach = int(np.ceil(0.5 * diameter_px * (1 + settings.diameter_tolerance) + 8))
    around = window_about(blob.u_px, blob.v_px, reach)
    window = difference[around]
    if min(window.shape) < 8:
        return None
    clear = away_from_hidden(None if shown is None else shown[around], window.shape)
    window = stabilised(window, noise, settings)
    steepness, floor = least_steepness(float(np.percentile(window, 90)), noise, settings)
    edges = edge_points(window, steepness)
    edges = edges.where(in_the_clear(edges.point, clear))
    sizes = tuple(0.5 * diameter_px * (1 + sign * settings.diameter_tolerance) for sign in (-1, 1))
    circle, painted = _ball_circle(edges, window, (sizes[0], sizes[1]), settings.edge_tolerance_px)
    if circle is None:
        return None
    least = THIN * settings.coverage_min * _rim_in_the_clear(circle, clear)
    if float(support(circle[None], edges, settings.edge_tolerance_px)[0]) < least:
        return None
    fit = _fit_circle(window, circle, settings.edge_tolerance_px, max(0.5 * steepness, floor), clear)
    if fit is None or not sizes[0] < fit.radius_px < sizes[1]:
        return None
    if fit.rms_px > ROUGH * settings.edge_tolerance_px * fit.coverage * max(fit.coverage, SHORT):
        return None
    top, left = (at.start for at in around)
    return replace(fit, u_px=fit.u_px + left, v_px=fit.v_px + top, painted=painted)
