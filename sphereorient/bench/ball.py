"""A ball under an animal, filmed by one camera, without prior knowledge: scenes with the parameters of spintrack's
benchmark (NeLy-EPFL/spintrack, Apache-2.0, page of results and families.py), but own pictures and motions.
"""

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from sphereorient import so3
from sphereorient.bench.score import against
from sphereorient.cameras import PinholeCamera, save_cameras
from sphereorient.cameras.model import focal_of_field, middle_of_picture
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.files.picture import write_picture
from sphereorient.files.threads import Progress, silent
from sphereorient.files.whole_file import make_folder, write_text, writing
from sphereorient.mapping.chain import chained
from sphereorient.mapping.disks import held_place
from sphereorient.mapping.first_pass import first_adjustment, followed_by
from sphereorient.methods.method import one_thread
from sphereorient.methods.settings import Settings
from sphereorient.movies import write_ffv1
from sphereorient.pose.poses import supported
from sphereorient.report.texture_map import write_map
from sphereorient.run import MemoryStore, Request
from sphereorient.run.stages import run_tracks
from sphereorient.sphere.texture import map_directions
from sphereorient.statistics.behaviour import Behaviour, Reference
from sphereorient.synth.motion import Motion6D
from sphereorient.synth.write import write_truth
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.rotations import rotation_vectors

Singles = NDArray[np.float32]
Floats = NDArray[np.float64]

RATE_HZ = 100.0
RADIUS_MM = 5.0
ROWS = 512  # of the paint
SAMPLES = 2  # per pixel and axis
EXPOSURES = 4  # instants per exposure
SWAY_FRAMES = 8  # correlation time of the sway
BEHIND, BEHIND_NOISE = 55.0, 3.0  # grey levels of the static background
AWAY_DEG = 30.0  # downward tilt of the camera
GREY_BODY, GREY_LEG = 28.0, 22.0


@dataclass(frozen=True, kw_only=True)
class Caps:
    """Dark caps on a bright ball."""

    caps: int = 150
    radius_deg: tuple[float, float] = (4.0, 10.0)
    dark: tuple[float, float] = (0.8, 1.0)
    soft_deg: float = 0.8
    base: float = 0.9


@dataclass(frozen=True, kw_only=True)
class BallScene:
    """One scene; `fictrac`, `spintrack`: published median and 95 % of the steps, degrees, and drift, degrees/min."""

    motion: str = "walk"  # or saccades: a third of the forward motion, same rotations
    paint: Caps = field(default_factory=Caps)
    size: tuple[int, int] = (640, 480)  # px
    field_deg: float = 30.0  # vertical field of view
    azimuth_deg: float = 3.0  # of the ball, to the right
    elevation_deg: float = -2.0
    half_deg: float = 11.0  # angular radius of the ball
    specular: float = 0.15
    vignette: float = 0.25
    flicker: float = 0.0  # at 47 Hz
    drift: float = 0.0  # of the light, over the movie
    blur_px: float = 0.7
    read_noise: float = 2.0
    shot_noise: float = 5.0  # grey levels at 255
    exposure: float = 0.0  # share of the time between frames
    legs: int = 0
    dust: int = 0
    sway_px: float = 0.0  # sway of the ball in its holder, rms
    sway_share: float = 0.0  # of the distance, rms, along the line of sight
    sink_px: float = 0.0  # over the movie
    fictrac: tuple[float, float, float] = (math.nan,) * 3  # as published
    spintrack: tuple[float, float, float] = (math.nan,) * 3


SCENES: Mapping[str, BallScene] = {
    "clean_fly": BallScene(fictrac=(0.243, 0.671, -0.227), spintrack=(0.041, 0.091, -0.041)),
    "noisy": BallScene(
        read_noise=8.0, shot_noise=14.0, blur_px=1.0, fictrac=(0.258, 0.632, -0.151), spintrack=(0.043, 0.096, -0.031)
    ),
    "occluded": BallScene(legs=6, dust=3, fictrac=(0.275, 0.735, 0.138), spintrack=(0.046, 0.107, 0.132)),
    "offaxis": BallScene(
        azimuth_deg=16.0,
        elevation_deg=9.0,
        half_deg=8.0,
        fictrac=(0.385, 1.090, 2.050),
        spintrack=(0.047, 0.126, -0.338),
    ),
    "motion_blur": BallScene(
        exposure=0.8, blur_px=1.5, fictrac=(0.304, 0.845, -1.351), spintrack=(0.098, 0.459, -0.705)
    ),
    "sparse": BallScene(
        paint=Caps(caps=40, radius_deg=(8.0, 16.0)), fictrac=(0.341, 0.835, -0.837), spintrack=(0.062, 0.159, -0.491)
    ),
    "speckle": BallScene(
        paint=Caps(caps=1500, radius_deg=(1.0, 2.5), soft_deg=0.4),
        fictrac=(90.266, 175.677, 160.536),
        spintrack=(0.037, 0.091, -0.068),
    ),
    "saccades": BallScene(motion="saccades", fictrac=(0.242, 0.611, -0.071), spintrack=(0.034, 0.081, -0.395)),
    "lab_small_ball": BallScene(
        size=(864, 512),
        field_deg=2.0,
        half_deg=0.31,
        azimuth_deg=-0.4,
        elevation_deg=0.03,
        blur_px=0.8,
        legs=6,
        fictrac=(0.165, 0.432, -1.327),
        spintrack=(0.049, 0.099, 0.104),
    ),
    "low_contrast": BallScene(
        paint=Caps(dark=(0.25, 0.35), base=0.7), fictrac=(0.346, 0.902, -1.030), spintrack=(0.046, 0.110, -0.008)
    ),
    "lighting": BallScene(
        flicker=0.15,
        drift=0.2,
        vignette=0.4,
        specular=0.35,
        fictrac=(0.253, 0.686, -0.969),
        spintrack=(0.040, 0.092, 0.025),
    ),
    "at_rest": BallScene(half_deg=5.73),
    "sways": BallScene(half_deg=5.73, sway_px=4.0, sway_share=0.03),
    "sinks": BallScene(half_deg=5.73, elevation_deg=1.0, sink_px=100.0),
}


def painted(paint: Caps, rng: np.random.Generator) -> Singles:
    """Return a map (H, 2 H) of separate caps over twelve large faint ones."""
    directions = map_directions(ROWS).float().numpy()
    grey = np.full(directions.shape[:2], paint.base, np.float32)

    def put(centre: NDArray[np.float64], radius: float, dark: float, soft: float) -> None:
        away = np.arccos(np.clip(directions @ centre.astype(np.float32), -1, 1))
        x = np.clip((radius + soft - away) / (2 * soft), 0, 1)
        grey[...] *= 1 - dark * x * x * (3 - 2 * x)

    for centre in _directions(rng, 12):
        put(centre, math.radians(rng.uniform(15, 40)), 0.12, 0.3)
    low, high = np.radians(paint.radius_deg)
    kept = np.zeros((0, 3))
    for centre in _directions(rng, 20_000):
        if len(kept) < paint.caps and not (kept @ centre > math.cos(0.9 * (low + high))).any():
            kept = np.vstack([kept, centre])
            put(centre, rng.uniform(low, high), rng.uniform(*paint.dark), math.radians(paint.soft_deg))
    return grey


def _directions(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    found = rng.normal(size=(count, 3))
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _wandering(rng: np.random.Generator, count: int, sigma: float, frames: float) -> NDArray[np.float64]:
    """Return an Ornstein-Uhlenbeck series, (count,)."""
    stays = math.exp(-1 / frames)
    steps, found = rng.normal(0, sigma * math.sqrt(1 - stays**2), count), np.empty(count)
    x = rng.normal(0, sigma)
    for k, step in enumerate(steps):
        x = stays * x + step
        found[k] = x
    return found


def walked(count: int, rng: np.random.Generator, forward_share: float = 1.0) -> NDArray[np.float64]:
    """Return the rotations (N, 3), rad, lab, of a ball under a fly that walks and stops, after spintrack."""
    walks, k, on = np.zeros(count, bool), 0, True
    speed = np.zeros(count)
    while k < count:
        length = min(count - k, round(rng.uniform(*((1, 5) if on else (0.5, 3))) * RATE_HZ))
        part = np.s_[k : k + length]
        walks[part] = on
        if on:
            speed[part] = rng.uniform(4, 18) * (1 + 0.25 * _wandering(rng, length, 1.0, 15))
        k, on = k + length, not on
    forward = speed.clip(0) / RADIUS_MM / RATE_HZ
    side, turn = _wandering(rng, count, 0.15, 10) * forward, _wandering(rng, count, math.radians(120), 12) * walks
    turn /= RATE_HZ
    for start in rng.choice(np.flatnonzero(walks), rng.poisson(0.7 * walks.sum() / RATE_HZ), replace=False):
        length = round(rng.uniform(0.05, 0.1) * RATE_HZ)
        burst = 0.5 - 0.5 * np.cos(2 * math.pi * (np.arange(length) + 0.5) / length)
        peak = math.radians(rng.uniform(400, 1200)) / RATE_HZ * rng.choice((-1, 1))
        turn[start : start + length] += peak * burst[: count - start]
    turns = np.stack([-side, forward_share * forward, -turn], axis=1)
    turns += rng.normal(0, 0.0005, turns.shape) * ~walks[:, None]
    turns[0] = 0.0
    return turns


def _camera(scene: BallScene) -> PinholeCamera:
    """Return the camera, behind the animal and tilted down; lab: forward, right, down, origin at the camera."""
    c, s = math.cos(math.radians(AWAY_DEG)), math.sin(math.radians(AWAY_DEG))
    return PinholeCamera(
        image_size=scene.size,
        f_px=torch.tensor(focal_of_field(scene.size[1], scene.field_deg), dtype=torch.float64),
        centre_px=middle_of_picture(scene.size),
        R_cam_lab=torch.tensor([[0.0, 1.0, 0.0], [-s, 0.0, c], [c, 0.0, s]], dtype=torch.float64),
        T_cam_lab_mm=torch.zeros(3, dtype=torch.float64),
    )


def _places(scene: BallScene, camera: PinholeCamera, count: int, rng: np.random.Generator) -> Tensor:
    """Return the ball's centres in N frames, (N, 3), mm, lab."""
    a, e = math.radians(scene.azimuth_deg), math.radians(scene.elevation_deg)
    ahead = torch.tensor([math.sin(a) * math.cos(e), -math.sin(e), math.cos(a) * math.cos(e)], dtype=torch.float64)
    X = (ahead * RADIUS_MM / math.sin(math.radians(scene.half_deg))) @ camera.R_cam_lab
    if not (scene.sway_px or scene.sink_px):
        return X.expand(count, 3)
    aside = rng.normal(size=(3, count + 8 * SWAY_FRAMES))
    aside = gaussian_filter1d(aside, SWAY_FRAMES, axis=1)[:, 4 * SWAY_FRAMES : -4 * SWAY_FRAMES]
    u, v, size = torch.from_numpy(aside / aside.std(axis=1, keepdims=True))
    sunk = torch.linspace(0, scene.sink_px, count, dtype=torch.float64)
    right = camera.across_lab(X)
    mm_px = X.norm() / camera.f_px
    ahead = torch.nn.functional.normalize(X, dim=0)
    right = torch.nn.functional.normalize(right - (right @ ahead) * ahead, dim=0)
    down = torch.linalg.cross(ahead, right)
    share = scene.sway_px / math.sqrt(2) * mm_px
    moved = (share * u)[:, None] * right + (share * v + sunk * mm_px)[:, None] * down
    places: Tensor = X + moved + (scene.sway_share * size)[:, None] * X
    return places


class _Film:
    def __init__(self, scene: BallScene, camera: PinholeCamera, X: Tensor, paint: Singles, rng: np.random.Generator):
        self.scene, self._camera, self._paint, self._rng = scene, camera, paint, rng
        (u, v), (width, height) = camera.project(X).tolist(), scene.size
        self.radius_px, self.middle = float(camera.f_px) * math.tan(math.radians(scene.half_deg)), (u, v)
        self._X = torch.full_like(X, torch.nan)  # not set yet
        self._put(X)
        rows, columns = np.mgrid[:height, :width]
        away = (columns - width / 2) ** 2 + (rows - height / 2) ** 2
        self._gain = (1 - scene.vignette * away / (width**2 + height**2) * 4).astype(np.float32)
        self._behind = (BEHIND + rng.normal(0, BEHIND_NOISE, (height, width))).astype(np.float32)
        top, left = (one.start for one in self._there)
        bottom, right = (one.stop for one in self._there)
        for _ in range(scene.dust):
            dx, dy, size = rng.uniform(left, right), rng.uniform(top, bottom), rng.uniform(4, 12)
            spot = np.exp(-((columns - dx) ** 2 + (rows - dy) ** 2) / (2 * size**2))
            self._gain *= (1 - 0.5 * spot).astype(np.float32)

    def _put(self, X: Tensor) -> None:
        """Move the ball to a position (3,), mm, lab."""
        if torch.equal(self._X, X):
            return
        scene, camera, self._X = self.scene, self._camera, X
        (u, v), (width, height) = camera.project(X).tolist(), scene.size
        radius_px = 1.15 * float(camera.f_px) * math.tan(math.asin(RADIUS_MM / float(X.norm())))
        left, top = max(0, int(u - radius_px)), max(0, int(v - radius_px))
        right, bottom = min(width, int(u + radius_px) + 2), min(height, int(v + radius_px) + 2)
        self._there = np.s_[top:bottom, left:right]
        across = [
            torch.arange((stop - start) * SAMPLES, dtype=torch.float64) / SAMPLES + start + (0.5 / SAMPLES - 0.5)
            for start, stop in ((top, bottom), (left, right))
        ]
        y, x = torch.meshgrid(*across, indexing="ij")
        rays = camera.rays(torch.stack([x, y], -1))
        towards = (rays.direction_lab * X).sum(-1)
        inside = RADIUS_MM**2 - X.square().sum() + towards.square()
        self._hit = (inside > 0).float().numpy()
        point = (towards - inside.clamp_min(0).sqrt())[..., None] * rays.direction_lab
        self._normal = torch.nn.functional.normalize(point - X, dim=-1)
        lamp = torch.nn.functional.normalize(torch.tensor([-0.3, -0.7, -0.65]).double(), dim=0) @ camera.R_cam_lab
        lit = (self._normal @ lamp).clamp_min(0)
        mirrored = 2 * lit[..., None] * self._normal - lamp
        glint = -(mirrored * rays.direction_lab).sum(-1)
        self._shade = ((0.35 + 0.65 * lit).numpy() * self._hit).astype(np.float32)
        self._glint = (scene.specular * glint.clamp_min(0).numpy() ** 25 * self._hit).astype(np.float32)

    def _seen(self, R_lab_body: Tensor) -> Singles:
        x, y, z = (self._normal.float() @ R_lab_body.float()).unbind(-1)
        rows, columns = self._paint.shape
        u = (torch.atan2(y, x) / (2 * math.pi) + 0.5) * columns - 0.5
        v = torch.acos(z.clamp(-1, 1)) / math.pi * rows - 0.5
        return np.asarray(
            cv2.remap(self._paint, u.numpy(), v.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32
        )

    def frame(self, k: int, count: int, X: Tensor, R: Tensor, turns: tuple[Tensor, Tensor]) -> NDArray[np.uint8]:
        """Return the picture of frame k, with X and R at mid-exposure; `turns` (3,): rotation to it, to the next."""
        self._put(X)
        scene, share = self.scene, np.zeros(1)
        if scene.exposure:
            share = scene.exposure * ((np.arange(EXPOSURES) + 0.5) / EXPOSURES - 0.5)
        paint = np.mean([self._seen(so3.exp(one * turns[one > 0]) @ R) for one in share.tolist()], axis=0)
        fine = np.stack([paint * self._shade + self._glint, self._hit], -1)
        height, width = (side // SAMPLES for side in fine.shape[:2])
        light, cover = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
        picture = self._behind.copy()
        picture[self._there] = picture[self._there] * (1 - cover) + 255 * light
        self._put_animal(picture, k)
        time_s = k / RATE_HZ
        gain = 1 + scene.flicker * math.sin(2 * math.pi * 47 * time_s) + scene.drift * math.sin(2 * math.pi * k / count)
        picture = cv2.GaussianBlur(picture * self._gain * np.float32(gain), (0, 0), scene.blur_px)
        noise = np.sqrt(scene.read_noise**2 + scene.shot_noise**2 * picture.clip(0, 255) / 255)
        noisy = picture + self._rng.standard_normal(picture.shape, np.float32) * noise
        return np.asarray(noisy.round().clip(0, 255), np.uint8)

    def body(self) -> NDArray[np.uint8]:
        """Return the mask of the animal's body, black where it hides the ball."""
        mask = np.full(self._behind.shape, 255, np.uint8)
        if self.scene.legs:
            self._ellipse(mask, 0.0, 1.1)
        return mask

    def _ellipse(self, picture: NDArray[Any], grey: float, larger: float = 1.0) -> None:
        (u, v), r = self.middle, self.radius_px
        axes = (int(0.38 * r * larger), int(0.22 * r * larger))
        cv2.ellipse(picture, (int(u), int(v - 0.78 * r)), axes, 0, 0, 360, grey, -1, cv2.LINE_AA)

    def _put_animal(self, picture: Singles, k: int) -> None:
        (u, v), r = self.middle, self.radius_px
        for leg in range(self.scene.legs):
            side, rank = (-1) ** (leg + 1), leg // 2
            swing = math.sin(2 * math.pi * 12 * k / RATE_HZ + math.pi * (leg % 2) + 2 * math.pi * rank / 3)
            angle = math.radians(-90 + side * (35 + 25 * rank) + 8 * swing)
            reach = r * (0.55 + 0.12 * rank + 0.06 * swing)
            hip = np.array([u, v - 0.78 * r])
            foot = np.array([u + reach * math.cos(angle), v + reach * math.sin(angle)])
            knee = (hip + foot) / 2 + np.array([side * 0.18 * r, -0.12 * r])
            line = np.array([hip, knee, foot], np.int32).reshape(-1, 1, 2)
            cv2.polylines(picture, [line], False, GREY_LEG, max(1, round(0.035 * r)), cv2.LINE_AA)
        if self.scene.legs:
            self._ellipse(picture, GREY_BODY)


def write_ball_scene(folder: Path, scene: BallScene, frames: int, seed: int, progress: Progress = silent) -> Path:
    """Render a scene with exact truth; return its experiment.yaml, without map and diameter."""
    rng, camera = np.random.default_rng(seed), _camera(scene)
    X = _places(scene, camera, frames, rng)
    film = _Film(scene, camera, X[0], painted(scene.paint, rng), rng)
    turns = torch.from_numpy(walked(frames, rng, 0.3 if scene.motion == "saccades" else 1.0))
    R = chained(so3.exp(turns[1:]))

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for k in range(frames):
            progress("render", k, frames)
            yield film.frame(k, frames, X[k], R[k], (turns[k], turns[min(k + 1, frames - 1)]))

    make_folder(folder, f"folder {folder}")
    write_ffv1(folder / "cam1.mkv", pictures(), RATE_HZ)
    save_cameras(folder / "cameras.yaml", {"cam1": camera}, comment="exact camera; X_cam = R X_lab + T, mm")
    sphere = {"diameter": None, "fixed": "sways" if scene.sway_px or scene.sink_px else True}
    content = {"schema": "sphereorient-experiment/1", "name": folder.name, "frame_rate": RATE_HZ, "sphere": sphere}
    content |= {"cameras": "cameras.yaml", "movies": {"cam1": "cam1.mkv"}}
    if scene.legs:
        write_picture(folder / "mask.png", film.body())
        content["masks"] = {"cam1": "mask.png"}
    write_text(folder / "experiment.yaml", yaml.safe_dump(content, sort_keys=False))
    still = torch.zeros(frames, 3, dtype=torch.float64)
    truth = Motion6D(
        time_s=torch.arange(frames, dtype=torch.float64) / RATE_HZ,
        position_lab_mm=X / RADIUS_MM,
        velocity_m_s=still,
        acceleration_m_s2=still,
        R_lab_body=R,
        omega_lab_rad_s=turns * RATE_HZ,
        alpha_lab_rad_s2=still,
    )
    write_truth(folder / "truth.h5", {"": truth}, {"cam1": camera})
    return folder / "experiment.yaml"


@dataclass(frozen=True, kw_only=True, eq=False)
class BallErrors:
    """Errors of N frames of a scene, degrees, without constant rotations of body and lab."""

    found: int  # frames with an orientation
    step_deg: NDArray[np.float64]  # of the rotation between neighbouring frames, if both have one
    orientation_deg: NDArray[np.float64]
    over_sigma: float  # error of the step over its stated sigma, rms per axis
    behaviour: Behaviour

    @classmethod
    def of(cls, time_s: Floats, ours: Floats, covariance: Floats, true: Floats) -> "BallErrors":
        """Compare orientations (N, 3, 3), NaN: none, with true ones; covariances (N, 3, 3), lab: independent part."""
        known: NDArray[np.bool_] = np.asarray(np.isfinite(ours).all((1, 2)))
        linked = known[1:] & known[:-1]
        turns = [rotation_vectors(one[1:] @ one[:-1].mT) for one in (ours, true)]
        steps = (turns[0] - turns[1])[linked]
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        stated = np.sqrt((variance[1:] + variance[:-1])[linked])
        track = replace(Trajectory.empty(time_s), orientation=ours)
        errors_deg, behaviour = against(Reference(R_lab_body=true), track, "both")
        return cls(
            found=int(known.sum()),
            step_deg=np.rad2deg(np.linalg.norm(steps, axis=1)),
            orientation_deg=errors_deg[known],
            over_sigma=float(np.sqrt(np.mean((steps / stated) ** 2))),
            behaviour=behaviour,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class BallRow:
    """The results of a scene."""

    first: BallErrors  # of the first pass
    refined: BallErrors | None  # of the precise method by its map; None: not run
    cpu_ms: float  # per frame of the first pass, with decoding
    radius_px: float

    def numbers(self) -> dict[str, Any]:
        """Return all for JSON."""
        ways = {"first": self.first} if self.refined is None else {"first": self.first, "refined": self.refined}
        rows = {
            way: {
                "found": one.found,
                "step_p50_deg": float(np.median(one.step_deg)),
                "step_p95_deg": float(np.percentile(one.step_deg, 95)),
                "orientation_p50_deg": float(np.median(one.orientation_deg)),
                "orientation_p95_deg": float(np.percentile(one.orientation_deg, 95)),
                "over_sigma": one.over_sigma,
                "behaviour": one.behaviour.numbers(),
            }
            for way, one in ways.items()
        }
        return {"radius_px": self.radius_px, "cpu_ms": self.cpu_ms, **rows}


def measure_scene(path: Path, settings: Settings, refine: bool, progress: Progress = silent) -> BallRow:
    """Track a scene without a map; `refine`: then by the precise method, with the map of the first pass."""
    with h5py.File(path.with_name("truth.h5")) as file:
        R_true = file["orientation"][()]
    with open_recording(path, None, textured=False) as recording, one_thread():
        count = len(recording.timeline)  # track all frames
        place = held_place(recording, settings.paint, settings.locate, progress, count)
        adjustment = first_adjustment(recording, place, progress)
        begun = time.process_time()
        for _ in recording.streams[0].pictures():
            pass
        decoded = time.process_time()
        poses = followed_by(adjustment, recording, place, progress)
        cpu_s = (time.process_time() - decoded) - (decoded - begun)
        time_s = recording.timeline.time_s
        radius_px = float(place.views[0].radius_px(place.usual, place.radius_mm))
    none = torch.full((3, 3), torch.nan, dtype=torch.float64)
    R = torch.stack([one.R_lab_body[0] if supported(one) else none for one in poses]).numpy()
    covariance = torch.stack([one.covariance[0, :3, :3] if supported(one) else none for one in poses]).numpy()
    refined = None
    if refine:
        texture = path.with_name("learnt.png")
        with writing(force=True):
            write_map(adjustment.texture(), texture)
        mapped = load_experiment(path).with_sphere(texture_path=texture)
        store = MemoryStore()
        (track,) = run_tracks(Request(experiment=mapped), store, progress=progress).values()
        (known,) = (store.known or {}).values()
        varying = track.orientation_cov - known.lasting.alone[0, :3, :3].numpy()
        refined = BallErrors.of(time_s, track.orientation, varying, R_true)
    return BallRow(
        first=BallErrors.of(time_s, R, covariance, R_true),
        refined=refined,
        cpu_ms=1e3 * cpu_s / len(poses),
        radius_px=radius_px,
    )
