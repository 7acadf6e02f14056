"""All disks of a picture that may be spheres, also partly hidden ones and those cut by the border."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.locate.background import Background
from sphereorient.locate.outline import (
    DIRECTIONS,
    Edges,
    Outline,
    away_from_hidden,
    direction_bins,
    edge_points,
    in_the_clear,
    least_steepness,
    stabilised,
    support,
    window_about,
)
from sphereorient.locate.settings import LocateSettings

STEP_PX = 2.5  # step of the radii of votes, about the scatter of votes of one rim
SCATTER_PX = 2.0  # Gaussian that joins votes
SHRINK = 2  # votes are counted on a picture reduced by this factor
DEPTH = 0.5  # of the setting `diameter_tolerance`: largest deviation of a voted radius
LEAST_VOTES = 0.08  # share of a rim that must vote for its middle
PEAK, MOST = 5, 80  # reduced px: distance of separate middles of one radius; most examined circles
VOTED_PX = 2.5  # error of a voted circle
USUAL = 0.75  # of this deviation: circles of paint are usually farther from the expected radius than rims
LEAST_RIM = 0.2  # share of all directions with an edge on the rim, less half of those with one just outside
LEAST_BESIDE = 0.15  # share of the pixels about an edge that differ from the background
HALO, LEAST_NEW = 1.05, 0.06  # of the radius; least share of a disk outside all disks with more rim
LEAST_FULL = 0.35  # share of a disk that differs from the background
ALONE = 0.5  # of the radius: of two nearer middles, the one with more votes is kept
FURTHER = 4  # more disks than spheres: other round objects, and circles in the texture
RADIAL = 0.85  # cosine of the angle between an edge's gradient and the radius
NEAR = (0.15, 0.15, 0.1, 0.1)  # of the radius, by round: largest distance of used edges from the circle
PAINT_SHARE = 0.04  # of the radius: error of a middle if black paint hides the rim
RADIUS_SIGMA = 0.06  # relative error of the voted radius: stabilises circles with a short arc
TUKEY, LEAST_SCALE_PX, FEWEST = 3.0, 0.3, 8

Points = NDArray[np.float64]
Circle = NDArray[np.float64]  # (3,): u, v, radius, px


def find_disks(
    picture: NDArray[np.generic], background: Background, diameters_px: Sequence[float], settings: LocateSettings
) -> list[Outline]:
    """Return the disks in a picture (H, W) of about the expected diameters, px, one per sphere; most rim first.
    Every edge votes for the middles of disks with this edge on the rim: along the inward gradient, one radius away.
    `rms_px` is the standard error of the middle, larger for a short arc; `coverage` the share of all directions with an
    edge on the rim. There may be more disks than spheres.
    """
    difference = background.difference(picture)
    noise = background.typical_noise
    root = stabilised(difference, noise, settings)
    full = (difference > settings.noise_factor * background.noise).view(np.uint8)
    lit = root[::2, ::2][full[::2, ::2] > 0]
    if not lit.size:
        return []
    edges = edge_points(root, least_steepness(float(np.percentile(lit, 90)), noise, settings)[0])
    edges = edges.where(in_the_clear(edges.point, away_from_hidden(background.shown, picture.shape)))
    side = max(3, round(min(diameters_px) / 2) | 1)
    column, row = edges.point.astype(np.int64).T
    edges = edges.where(cv2.boxFilter(full, cv2.CV_32F, (side, side))[row, column] > LEAST_BESIDE)
    tolerance = DEPTH * settings.diameter_tolerance
    circles = _voted(edges, picture.shape, diameters_px, tolerance)
    circles = circles[_square_share(full, background.shown, circles) > LEAST_FULL]
    found: list[Outline] = []
    rest = full.copy()  # without the found disks
    while len(circles) and len(found) < len(diameters_px) + FURTHER:
        merit = _usual(circles[:, 2], diameters_px, tolerance) * support(circles, edges, VOTED_PX) / DIRECTIONS
        best = int(merit.argmax())
        if merit[best] < LEAST_RIM:
            break
        fit = _fitted(edges, circles[best], settings.edge_tolerance_px)
        circle = circles[best] if fit is None else np.array(fit.circle)
        filled = [_full_share(part, background.shown, circle) for part in (full, rest)]
        if fit is not None and filled[0] > LEAST_FULL and filled[1] > LEAST_NEW:
            found.append(fit)
            cover(rest, fit, HALO, 0)
            # Each rim belongs to one disk.
            edges = edges.where(np.abs(np.linalg.norm(edges.point - circle[:2], axis=1) - circle[2]) > VOTED_PX)
        away = np.linalg.norm(circles[:, :2] - circle[:2], axis=1) > ALONE * circle[2]
        away[best] = False
        circles = circles[away & (merit > LEAST_RIM / 2)]
    return found


def _voted(edges: Edges, shape: tuple[int, ...], diameters_px: Sequence[float], tolerance: float) -> Points:
    """Return the circles (n, 3: u, v, r) with most votes, most first; middles may lie outside the picture."""
    radii = _radii(diameters_px, tolerance)
    margin = int(max(radii) / SHRINK) + 1
    height, width = (side // SHRINK + 1 + 2 * margin for side in shape)
    start = (edges.point / SHRINK + (margin + 0.5)).astype(np.float32)
    inward = (edges.inward / SHRINK).astype(np.float32)
    beside = np.ones((PEAK, PEAK), np.uint8)
    found = []
    for radius in radii:
        column, row = (start + np.float32(radius) * inward).astype(np.int32).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        count = np.bincount((row * width + column)[inside], minlength=height * width).reshape(height, width)
        share = count.astype(np.float32) * np.float32(4 * (SCATTER_PX / SHRINK) ** 2 / radius)  # of a rim
        votes = cv2.GaussianBlur(share, (0, 0), SCATTER_PX / SHRINK)
        row, column = np.nonzero((votes > LEAST_VOTES) & (votes >= cv2.dilate(votes, beside)))
        found.append(np.column_stack([column, row, np.full(len(row), radius), votes[row, column]]))
    circles = np.concatenate(found)
    circles[:, :2] = (circles[:, :2] - margin) * SHRINK
    return circles[np.argsort(-circles[:, 3], kind="stable")[:MOST], :3]


def _usual(radius: Points, diameters_px: Sequence[float], tolerance: float) -> Points:
    """Return a weight (n,) of radii, px: 1 for the expected ones, less for those likely to be circles of paint."""
    off = np.abs(2 * radius[:, None] / np.asarray(diameters_px) - 1).min(1)
    return np.asarray(np.exp(-0.5 * (off / (USUAL * tolerance)) ** 2))


def _radii(diameters_px: Sequence[float], tolerance: float) -> list[float]:
    """Return the radii, px, of votes: the expected ones, and others within the tolerance, in even steps."""
    radii: list[float] = []
    for diameter in sorted(set(diameters_px)):
        low, high = diameter / 2 * (1 - tolerance), diameter / 2 * (1 + tolerance)
        low = max(low, radii[-1] + STEP_PX) if radii else low
        radii += np.arange(low, high + STEP_PX / 2, STEP_PX).tolist()
    return radii


def _fitted(edges: Edges, voted: Circle, least_px: float) -> Outline | None:
    """Return the circle through the edges near a voted one, by least squares with Tukey's weights."""
    circle = voted.copy()
    edges = edges.where(np.abs(edges.point - circle[:2]).max(1) < (1 + 2 * NEAR[0]) * circle[2])
    for near in NEAR:
        across = edges.point - circle[:2]
        distance = np.maximum(np.hypot(across[:, 0], across[:, 1]), 1e-9)
        outward = across / distance[:, None]
        offset = distance - circle[2]
        rim = np.flatnonzero(
            (-(outward * edges.inward).sum(1) > RADIAL) & (np.abs(offset) < max(near * circle[2], least_px))
        )
        if len(rim) < FEWEST:
            return None
        rim = rim[_outermost(outward[rim], offset[rim])]
        outward, offset = outward[rim], offset[rim]
        scale = max(1.4826 * float(np.median(np.abs(offset))), LEAST_SCALE_PX)
        weight = np.clip(1 - (offset / (TUKEY * scale)) ** 2, 0, None) ** 2
        design = np.column_stack([outward, np.ones(len(offset))])
        normal = (design * weight[:, None]).T @ design
        normal[2, 2] += (scale / (RADIUS_SIGMA * voted[2])) ** 2
        toward = design.T @ (weight * offset)
        toward[2] += (scale / (RADIUS_SIGMA * voted[2])) ** 2 * (voted[2] - circle[2])
        circle = circle + np.linalg.solve(normal, toward)
        if not np.abs(circle[:2] - voted[:2]).max() < ALONE * voted[2]:
            return None
    spread = scale**2 * np.linalg.inv(normal)[:2, :2]
    return Outline(
        u_px=float(circle[0]),
        v_px=float(circle[1]),
        radius_px=float(circle[2]),
        rms_px=float(np.hypot(np.sqrt(np.linalg.eigvalsh(spread)[-1]), PAINT_SHARE * circle[2])),
        coverage=float((weight > 0).mean() * len(offset)) / DIRECTIONS,
    )


def _outermost(outward: Points, offset: Points) -> NDArray[np.int64]:
    """Return the index of the outermost edge of each direction that has one, as edges of the paint lie inside."""
    direction = direction_bins(*outward.T)
    order = np.lexsort((offset, direction))
    last = np.append(direction[order][1:] != direction[order][:-1], True)
    return np.asarray(order[last])


def _square_share(full: NDArray[np.uint8], shown: NDArray[np.bool_] | None, circles: Points) -> Points:
    """Return the share (n,) of shown pixels that differ from the background in the squares inscribed in circles."""
    limit = np.array(full.shape[::-1])
    low, high = (
        np.rint(circles[:, :2] + sign * 0.7 * circles[:, 2:] + 0.5).astype(np.int64).clip(0, limit) for sign in (-1, 1)
    )
    seen = np.ones_like(full) if shown is None else shown.view(np.uint8)
    count = []
    for part in (full, seen):
        whole = cv2.integral(part)
        rows, columns = (whole[side[:, 1]] for side in (low, high)), (low[:, 0], high[:, 0])
        above, below = ((row[range(len(low)), columns[0]], row[range(len(low)), columns[1]]) for row in rows)
        count.append(below[1] - below[0] - above[1] + above[0])
    return np.asarray(count[0] / np.maximum(count[1], 1))


def _full_share(full: NDArray[np.uint8], shown: NDArray[np.bool_] | None, circle: Circle) -> float:
    """Return the share of a circle's pixels in the picture that differ from the background."""
    u, v, radius = circle.tolist()
    window = window_about(u, v, int(radius) + 1)
    row, column = np.ogrid[: full[window].shape[0], : full[window].shape[1]]
    inside = (row + window[0].start - v) ** 2 + (column + window[1].start - u) ** 2 < (0.95 * radius) ** 2
    if shown is not None:
        inside = inside & shown[window]
    return float(full[window][inside].mean()) if inside.any() else 0.0


def cover(mask: NDArray[Any], disk: Outline, share: float, value: int) -> None:
    """Set a mask (H, W) to a value inside a disk of `share` times the radius plus a pixel."""
    reach = share * disk.radius_px + 1
    left, top = max(0, int(disk.u_px - reach)), max(0, int(disk.v_px - reach))
    window = mask[top : max(0, int(disk.v_px + reach) + 2), left : max(0, int(disk.u_px + reach) + 2)]
    row, column = np.ogrid[: window.shape[0], : window.shape[1]]
    window[(row + top - disk.v_px) ** 2 + (column + left - disk.u_px) ** 2 <= reach**2] = value
