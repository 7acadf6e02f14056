"""Do the cameras agree? What each camera alone says of the sphere is compared, and a conflict gets a likely cause."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, R_lab_view, Rays, centre_lab_mm, sphere_radius_px, triangulate

Floats = NDArray[np.float64]
RUNS, RUN = 3, 20  # causes are tried in some runs of frames that follow each other
FEWEST = 3  # frames from which cameras are judged
STRETCH = 0.01  # by how much outlines may be wider than high, where nothing is wrong
LATEST = 8  # frames by which a movie may be late
PLAUSIBLE = 0.2  # largest deviation: relative, rad, 100 mm
EXPLAINS = 0.3  # a cause leaves at most this share of the misfit
EQUALLY = 2.0  # causes that leave at most this many times the least are named as well
SIMPLER = 0.5  # a cause of fewer parameters is preferred if its misfit, in units of the limits, is below this


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How far apart cameras that agree may be, in any light: typical values of a movie."""

    gap_px: float
    turn_deg: float
    size: float  # relative


GAP_PX, TURN_DEG, SIZE = 1.0, 0.2, 0.01  # by which cameras that agree may differ, in any light
TURN_SIGMAS, EDGE_PX = 3.0, 0.2  # and where the rotation is less well known, or the sphere is small: px of the radius
OUTLINES = Limits(gap_px=1.5, turn_deg=1.0, size=0.01)  # of outlines alone: they jump where paint is dark


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What each of C cameras alone says of N frames; NaN where it says nothing."""

    cameras: Mapping[str, Camera]
    centre_px: Tensor  # (N, C, 2)
    radius_px: Tensor  # (N, C), of the sphere's picture, along the camera's x
    R_lab_body: Tensor  # (N, C, 3, 3)
    diameter_mm: float
    outline_stretch: Tensor | None = None  # (N, C), by how much outlines are wider than the cameras say, relative
    frame: Tensor | None = None  # (N,) int64, increasing, at even times; None: no camera is tested for being late

    def at(self, rows: Tensor) -> "Seen":
        """Return some frames."""
        parts = {name: getattr(self, name)[rows] for name in ("centre_px", "radius_px", "R_lab_body")}
        parts["outline_stretch"] = self.stretch[rows]
        return replace(self, **parts, frame=None if self.frame is None else self.frame[rows])

    @property
    def stretch(self) -> Tensor:
        """(N, C): `outline_stretch`, NaN if unknown."""
        return torch.full_like(self.radius_px, torch.nan) if self.outline_stretch is None else self.outline_stretch


def limits_of(seen: Seen, covariance_rad2: Tensor) -> Limits:
    """Return how far apart cameras that agree may be; covariance (N, C, 3, 3) of each camera's rotation."""
    sigma_deg = math.degrees(float(so3.trace(covariance_rad2).sqrt().nanmedian()))
    return Limits(
        gap_px=GAP_PX,
        turn_deg=max(TURN_DEG, math.sqrt(2) * TURN_SIGMAS * sigma_deg if math.isfinite(sigma_deg) else 0.0),
        size=max(SIZE, EDGE_PX / float(seen.radius_px.nanmedian())),
    )


@dataclass(frozen=True, kw_only=True)
class Cause:
    """What would explain a contradiction."""

    words: str  # with its size, and what to do
    left: float  # share of the misfit that it leaves
    parameters: int
    deadly: bool = False  # nothing can be measured before it is corrected
    cameras: tuple[int, ...] = ()  # that it blames


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """Typical disagreement of cameras, and its causes, likeliest first; made by `compare_cameras`."""

    frames: int  # with two cameras; nothing is judged below `FEWEST`
    gap_px: float = math.nan  # between the lines of sight
    turn_deg: float = math.nan  # between the attitudes
    size: float = math.nan  # measured over expected, less 1, of the camera where it is farthest from 0
    contradicts: bool = False
    causes: tuple[Cause, ...] = ()

    @property
    def deadly(self) -> bool:
        """Whether the likeliest cause must be corrected first."""
        return any(cause.deadly for cause in self.causes[:1])

    @property
    def advice(self) -> str:
        """The causes as text."""
        unknown = "no single cause explains it: check the cameras, the movies and sphere.diameter"
        return "; or ".join(cause.words for cause in self.causes) or unknown

    def __str__(self) -> str:
        parts = {f"lines of sight {self.gap_px:.2f} px apart": self.gap_px}
        parts |= {f"attitudes {self.turn_deg:.2g} degrees apart": self.turn_deg}
        parts |= {f"size {100 * self.size:+.1f} %": self.size}
        return ", ".join(words for words, value in parts.items() if math.isfinite(value))


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaps:
    """Distances between the lines of sight to n points; made by `gaps_between`."""

    signed_mm: Tensor  # (n,), along the common perpendicular; NaN where a point is missing
    per_mm_px: Tensor  # (n,), px of the first camera for a millimetre along it
    position_lab_mm: Tensor  # (n, 3), the middle of the shortest segment
    across_lab: Tensor  # (n, 3), unit, the common perpendicular

    @property
    def signed_px(self) -> Tensor:
        """The gaps in px of the first camera, (n,): the epipolar residual."""
        return self.signed_mm * self.per_mm_px


def gaps_between(cameras: Sequence[Camera], centre_px: Sequence[Tensor]) -> Gaps:
    """Return the gaps (common perpendiculars) of two cameras' lines of sight to centres (n, 2), px; NaN: no ball."""
    a, b = (camera.rays(uv) for camera, uv in zip(cameras, centre_px, strict=True))
    position, signed, across = _meet(a, b)
    half = 0.5 * across
    seen = cameras[0].project(torch.cat([position - half, position + half])).chunk(2)
    per_mm_px = (seen[1] - seen[0]).norm(dim=-1)
    return Gaps(signed_mm=signed, per_mm_px=per_mm_px, position_lab_mm=position, across_lab=across)


def _meet(a: Rays, b: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """Return where lines of sight meet (n, 3), their signed gap (n,), mm, and its unit direction (n, 3), lab."""
    position, _ = triangulate(a, b)
    across = torch.linalg.cross(a.direction_lab, b.direction_lab)
    across = across / across.norm(dim=-1, keepdim=True)
    signed = ((b.origin_lab_mm - a.origin_lab_mm) * across).sum(-1)
    return position, torch.where(torch.isfinite(position).all(-1), signed, torch.nan), across


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sight:
    """What one camera says, in the lab."""

    rays: Rays  # (N, 3)
    R_lab_body: Tensor  # (N, 3, 3)


def compare_cameras(seen: Seen, limits: Limits) -> Consistency:
    """Compare the cameras in pairs; where they contradict each other, find the likeliest causes.
    Each cause has few parameters, which are fitted robustly; the one that leaves least is the likeliest.
    """
    compare = _Comparison(seen, limits)
    found = compare(compare.sights())
    count = int(torch.isfinite(found[..., 0]).sum(1).amax()) if len(found) else 0
    if count < FEWEST:
        return Consistency(frames=count)
    usual = _usual(found)
    usual = usual.gather(0, usual.nan_to_num().abs().argmax(0, keepdim=True))[0]  # of the pair that is farthest apart
    known = Consistency(
        frames=count,
        gap_px=limits.gap_px * float(usual[0]),
        turn_deg=limits.turn_deg * float(usual[1]),
        size=math.expm1(limits.size * float(usual[2])),
        contradicts=bool((usual.nan_to_num().abs() > 1).any()),
    )
    if not known.contradicts:
        return known
    causes = sorted((c for c in compare.causes(found) if c.left < EXPLAINS), key=lambda cause: cause.left)
    agree = {*compare.majority(found)} if len(compare.cameras) > 2 else set()
    causes = [cause for cause in causes if not agree & {*cause.cameras}] or causes
    if causes:
        enough = EQUALLY * causes[0].left + SIMPLER / max(_misfit(found), 1e-9)
        causes = [cause for cause in causes if cause.left < enough]
        fewest = min(cause.parameters for cause in causes)
        causes = [cause for cause in causes if cause.parameters == fewest]
    return replace(known, causes=tuple(causes))


def _usual(found: Tensor) -> Tensor:
    """Return the typical gap, turn, and size that is farthest from the expected one, of each pair, (P, 3)."""
    gap, turn, size = found[..., 0].abs(), found[..., 1:4].norm(dim=-1), found[..., 4:6]
    middle = size.nanmedian(1).values.nan_to_num()
    farthest = middle.gather(1, middle.abs().argmax(1, keepdim=True))
    return torch.cat([gap.nanmedian(1, keepdim=True).values, turn.nanmedian(1, keepdim=True).values, farthest], 1)


def majority(seen: Seen, limits: Limits) -> tuple[int, ...]:
    """Return the largest set of cameras of which each two agree; none where these are not more than half of all.
    Of sets of one size that whose lines of sight and sizes agree best: where two cameras alone measure a direction, the
    size of the picture in another, which looks along it, decides.
    """
    compare = _Comparison(seen, limits)
    return compare.majority(compare(compare.sights()))


def majority_by_outlines(cameras: Mapping[str, Camera], centre_px: Tensor, radius_px: Tensor) -> tuple[int, ...]:
    """Return the cameras that agree, see `majority`, of outlines (N, C, 2), (N, C), px, alone; none of one or two."""
    if len(cameras) < 3:
        return ()
    R = torch.full((*radius_px.shape, 3, 3), torch.nan, dtype=torch.float64)
    # Only ratios of sizes differ between cameras: the diameter is of no importance.
    seen = Seen(cameras=cameras, centre_px=centre_px, radius_px=radius_px, R_lab_body=R, diameter_mm=1.0)
    return majority(seen, OUTLINES)


class _Comparison:
    """Measures by how much the cameras would differ if something was wrong."""

    def __init__(self, seen: Seen, limits: Limits) -> None:
        rows = torch.nonzero(torch.isfinite(seen.centre_px).all(-1).sum(-1) > 1)[:, 0]
        if len(rows) > RUNS * RUN:
            starts = torch.linspace(0, len(rows) - RUN, RUNS).round().long()
            rows = rows[(starts[:, None] + torch.arange(RUN)).flatten()]
        seen = seen.at(rows)
        self.seen, self.limits = seen, limits
        self.cameras, self.names = list(seen.cameras.values()), list(seen.cameras)
        self.pairs = list(combinations(range(len(self.cameras)), 2))
        self.centres = [centre_lab_mm(camera) for camera in self.cameras]
        views = [R_lab_view(camera, seen.centre_px[:, k]) for k, camera in enumerate(self.cameras)]
        self.R_view_body = torch.stack(views, 1).mT @ seen.R_lab_body
        gaps = [
            gaps_between((self.cameras[k], self.cameras[m]), (seen.centre_px[:, k], seen.centre_px[:, m]))
            for k, m in self.pairs
        ]
        self.px_mm = [gap.per_mm_px.nanmedian() for gap in gaps]
        # Distance by the size of the picture, (N,) of each camera of a pair.
        self.by_size = [
            [
                (gap.position_lab_mm - self.centres[c]).norm(dim=-1)
                * sphere_radius_px(self.cameras[c], gap.position_lab_mm, seen.diameter_mm / 2)
                / seen.radius_px[:, c]
                for c in pair
            ]
            for gap, pair in zip(gaps, self.pairs, strict=True)
        ]

    def sights(
        self,
        centre_px: Tensor | None = None,
        R_view_body: Tensor | None = None,
        places: Sequence[int] | None = None,
    ) -> list[_Sight]:
        """Return lines of sight and attitudes; `places` are the cameras that took the movies."""
        pixels = self.seen.centre_px if centre_px is None else centre_px
        R_view_body = self.R_view_body if R_view_body is None else R_view_body
        found = []
        for k, place in enumerate(places or range(len(self.cameras))):
            camera, pixel = self.cameras[place], pixels[:, k]
            R_lab_body = R_lab_view(camera, pixel) @ R_view_body[:, k]
            found.append(_Sight(rays=camera.rays(pixel), R_lab_body=R_lab_body))
        return found

    def __call__(
        self,
        sights: Sequence[_Sight],
        larger: Tensor | float = 0.0,
        sized: bool = True,
        wider: Tensor | None = None,
    ) -> Tensor:
        """Return gap, turn (3), log sizes (2) and stretches (2) of pairs and frames, (P, N, 8), in units of limits.
        `larger`: logarithm of the factor by which pictures of the sphere are larger than the cameras say, () or (C,);
        `wider`: by how much wider than high, relative, (C,).
        """
        stretch = self.seen.stretch if wider is None else self.seen.stretch - wider
        growth = torch.as_tensor(larger, dtype=torch.float64).expand(len(self.names))
        parts = []
        for (k, m), px_mm, by_size in zip(self.pairs, self.px_mm, self.by_size, strict=True):
            position, gap_mm, _ = _meet(sights[k].rays, sights[m].rays)
            turn = so3.log(sights[k].R_lab_body @ sights[m].R_lab_body.mT)
            far = [(position - self.centres[c]).norm(dim=-1) for c in (k, m)]
            size = torch.stack([(a / b).log() for a, b in zip(far, by_size, strict=True)], -1) - growth[[k, m]]
            size = size if sized else size * torch.nan
            parts.append(torch.cat([(gap_mm * px_mm)[:, None], turn, size, stretch[:, [k, m]]], -1))
        limits = self.limits
        scale = [limits.gap_px, *[math.radians(limits.turn_deg)] * 3, *[limits.size] * 2, *[STRETCH] * 2]
        return torch.stack(parts) / torch.tensor(scale, dtype=torch.float64)

    def majority(self, found: Tensor) -> tuple[int, ...]:
        """Return the cameras that agree, see `majority`, of what was measured."""
        count = len(self.cameras)
        if not found.shape[1]:
            return ()
        gap, turn, size = _usual(found).unbind(1)
        agree = (gap <= 1) & (turn.nan_to_num(0.0) <= 1)  # without paint in view no turn is known
        worse = torch.where(agree, gap.square() + size.square(), torch.inf)
        apart = dict(zip(self.pairs, worse.tolist(), strict=True))
        for several in range(count, count // 2, -1):
            sets = combinations(range(count), several)
            worst = {some: max(apart[pair] for pair in combinations(some, 2)) for some in sets}
            best = min(worst, key=lambda some: worst[some])
            if math.isfinite(worst[best]):
                return best
        return ()

    def causes(self, found: Tensor) -> Iterator[Cause]:
        """Yield what may be wrong, with the share of the misfit that it leaves."""
        names, count = self.names, len(self.names)
        whole, unsized = _misfit(found), _misfit(found[..., :4])
        for k, m in self.pairs:
            if self.cameras[k].image_size == self.cameras[m].image_size:
                places = [*range(count)]
                places[k], places[m] = m, k
                left = _misfit(self(self.sights(places=places), sized=False)) / unsized
                words = f"swap {names[k]} and {names[m]} under movies:"
                yield Cause(words=words, left=left, parameters=0, deadly=True, cameras=(k, m))
        for k, name in enumerate(names):
            left = _misfit(self(self._upside_down(k), sized=False)) / unsized
            yield Cause(words=f"write flip: {{{name}: both}}", left=left, parameters=0, deadly=True, cameras=(k,))
        mm = self.seen.diameter_mm
        words = (
            f"sphere.diameter {mm:.4g} explains the pictures if it is {{:.4g}}, or the calibration's lengths are off"
        )
        yield self._best(
            lambda p: self(self.sights(), larger=float(p[0])), 1, words, lambda p: [mm * math.exp(p[0])], whole
        )
        for some in [list(range(count)), *([k] for k in range(count))]:
            words = f"pixels of {' and '.join(names[k] for k in some)} {{:+.1f}} % wider than calibrated: check sx, "
            words += "pixel_pitch, and whether the movie was resized"
            wide = self._best(partial(self._wide, some), 1, words, lambda p: [100 * p[0]], whole)
            yield replace(wide, cameras=tuple(some))
        for k, name in enumerate(names):
            words = f"{name} turned by {{:.2g}} degrees since its calibration: calibrate again"
            moved = self._best(partial(self._moved, k), 3, words, lambda p: [_degrees(p)], whole)
            yield replace(moved, cameras=(k,))
            words = f"{name} turned by {{:.2g}} degrees and moved by {{:.2g}} mm since its calibration: calibrate again"
            moved = self._best(
                partial(self._moved, k),
                6,
                words,
                lambda p: [_degrees(p[:3]), 100 * float(np.linalg.norm(p[3:]))],
                whole,
            )
            yield replace(moved, cameras=(k,))
        if self.seen.frame is not None:
            yield from self._late(self.seen.frame, whole)

    def _best(
        self,
        misfits: Callable[[Floats], Tensor],
        count: int,
        words: str,
        numbers: Callable[[Floats], list[float]],
        whole: float,
    ) -> Cause:
        """Fit the parameters of a cause."""

        def residuals(p: Floats) -> Floats:
            flat: Floats = misfits(p).flatten().nan_to_num(nan=0.0).numpy()
            return flat

        start = np.zeros(count)
        best: Any = least_squares(
            residuals, start, bounds=(start - PLAUSIBLE, start + PLAUSIBLE), loss="soft_l1", x_scale=0.01, max_nfev=30
        )
        left = _misfit(misfits(best.x)) / whole
        return Cause(words=words.format(*numbers(best.x)), left=left, parameters=count)

    def _upside_down(self, camera: int) -> list[_Sight]:
        """A movie turned by half a turn."""
        width, height = self.cameras[camera].image_size
        pixels, R = self.seen.centre_px.clone(), self.R_view_body.clone()
        pixels[:, camera] = pixels.new_tensor([width - 1, height - 1]) - pixels[:, camera]
        R[:, camera] = R.new_tensor([-1.0, -1.0, 1.0])[:, None] * R[:, camera]
        return self.sights(pixels, R_view_body=R)

    def _wide(self, some: Sequence[int], p: Floats) -> Tensor:
        """Pixels wider than high; the circle about the picture is half as much too large."""
        pixels, larger = self.seen.centre_px.clone(), torch.zeros(len(self.names), dtype=torch.float64)
        for k in some:
            middle = 0.5 * (self.cameras[k].image_size[0] - 1)
            pixels[:, k, 0] = middle + (pixels[:, k, 0] - middle) / (1 + float(p[0]))
            larger[k] = math.log1p(0.5 * float(p[0]))
        return self(self.sights(pixels), larger, wider=2 * larger)

    def _moved(self, camera: int, p: Floats) -> Tensor:
        """The camera turned about its centre by p[:3], rad, lab, and moved by p[3:], in 100 mm."""
        turn, sights = so3.exp(torch.from_numpy(p[:3])), self.sights()
        one = sights[camera]
        moved = 100 * torch.from_numpy(p[3:] if len(p) > 3 else np.zeros(3))
        rays = Rays(
            origin_lab_mm=one.rays.origin_lab_mm + moved,
            direction_lab=one.rays.direction_lab @ turn.mT,
        )
        sights[camera] = _Sight(rays=rays, R_lab_body=turn @ one.R_lab_body)
        return self(sights)

    def _late(self, frame: Tensor, whole: float) -> Iterator[Cause]:
        """Each movie some frames late; between frames all is interpolated."""
        shifts = np.arange(-LATEST, LATEST + 0.5, 0.5)
        # Of two the first one sets the time; of more the others do.
        for k, name in list(enumerate(self.names))[len(self.names) == 2 :]:
            left = [_misfit(self(self._shifted(k, frame, float(shift)))) / whole for shift in shifts]
            if np.isnan(left).all():
                continue
            best = int(np.nanargmin(left))
            words = f"the movie of {name} {abs(shifts[best]):g} frames {'late' if shifts[best] > 0 else 'early'}"
            yield Cause(words=f"{words}: check start:", left=left[best], parameters=1, cameras=(k,))

    def _shifted(self, camera: int, frame: Tensor, late: float) -> list[_Sight]:
        """Return what the cameras say if one shows each frame `late` frames later."""
        sights = self.sights()
        one = sights[camera]
        first = math.floor(late)
        share = torch.full((len(frame), 1), late - first, dtype=torch.float64)
        low, high = (torch.searchsorted(frame, frame + k).clamp(max=len(frame) - 1) for k in (first, first + 1))
        inside = (frame[low] == frame + first) & (frame[high] == frame + first + 1)
        direction = torch.lerp(one.rays.direction_lab[low], one.rays.direction_lab[high], share)
        origin = torch.lerp(one.rays.origin_lab_mm[low], one.rays.origin_lab_mm[high], share)
        before, after = one.R_lab_body[low], one.R_lab_body[high]
        R = so3.exp(share * so3.log(after @ before.mT)) @ before
        rays = Rays(origin_lab_mm=origin, direction_lab=torch.where(inside[:, None], direction, torch.nan))
        sights[camera] = _Sight(rays=rays, R_lab_body=torch.where(inside[:, None, None], R, torch.nan))
        return sights


def _degrees(turn: Floats) -> float:
    return math.degrees(float(np.linalg.norm(turn)))


def _misfit(found: Tensor) -> float:
    """Return the median over frames of the mean square of what was measured (P, N, K), mean of pairs; NaN without."""
    return float(found.square().nanmean(-1).nanmedian(1).values.nanmean())
