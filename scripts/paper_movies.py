"""Synthetic movies as in the paper's experiment: a tumbling sphere between impellers, two cameras, exact truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import torch
import yaml
from ensembles import Draw, EnsembleSpec, Law
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, save_cameras
from sphereorient.files.picture import write_picture
from sphereorient.movies import write_ffv1
from sphereorient.synth import RandomMotion, SynthSettings, degrade, make_scene, random_texture
from sphereorient.synth.degrade import Disk
from sphereorient.synth.degrade_scene import picture_of_ball, through_optics
from sphereorient.synth.scene import Exposure, digitise, exposures, seeded
from sphereorient.synth.write import default_cameras, experiment_document, frame_times_s, instants_s, write_truth

Floats = NDArray[np.float64]
TEXTURE_SEED = 2011  # one painted sphere in all movies
LAWS = EnsembleSpec()  # of the paper's Table I, with docs/errata.md E6
NEAR_MM = 40.0  # each coordinate of the centre is within this at one instant of every movie
LAMPS = {"uneven_light": 2.5, "highlights": 80.0}  # severities as in docs/degradations.md
MOST_BUBBLES = 4  # in front of the disk
IMPELLER_HZ, BLADES, BAND_PX = 3.0, 8, 30.0


def waves(draws: list[Draw], scale: float, origin: Floats) -> Callable[..., Tensor]:
    """Return a function of times (...), s, and the derivative: rates (..., 3) times `scale`; -1 is their integral."""

    def at(time_s: Tensor, derivative: int = 0) -> Tensor:
        flat = time_s.reshape(-1).numpy()
        segment = np.zeros(len(flat), np.int64)
        if derivative < 0:
            found = origin + scale * np.stack([draw.integral(flat, segment) for draw in draws], 1)
        else:
            found = scale * np.stack([draw.at(flat, segment)[derivative] for draw in draws], 1)
        return torch.from_numpy(found).reshape(*time_s.shape, 3)

    return at


def tumbling(number: int, duration_s: float) -> RandomMotion:
    """Draw the motion of one movie: velocity Gaussian, omega intermittent; the sphere passes near the middle once."""
    rng = np.random.default_rng([TEXTURE_SEED, number])
    pairs = zip(LAWS.velocity_rms, LAWS.acceleration_rms, strict=True)
    moves = [Law.of(rms, slope).draw(1, rng) for rms, slope in pairs]
    turns = [law.draw(1, rng) for law in LAWS.omega_laws()]
    once = torch.tensor([rng.uniform(0, duration_s)], dtype=torch.float64)
    there = rng.uniform(-NEAR_MM, NEAR_MM, 3) - waves(moves, 1e3, np.zeros(3))(once, -1)[0].numpy()
    start = torch.Generator().manual_seed(int(rng.integers(2**31)))
    R_start = so3.random_rotations(1, generator=start, dtype=torch.float64)[0]
    return RandomMotion(path=waves(moves, 1e3, there), omega=waves(turns, 1.0, np.zeros(3)), R_start=R_start)


@cache
def reflections(width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the grey levels along a row: of the disks, (2, W), and of each blade's reflection, (2, BLADES, W)."""
    edge = np.stack([np.arange(width), width - 1 - np.arange(width)])
    from_px = 50 + 0.085 * width * (np.arange(BLADES)[:, None] + 1)
    mirrored = np.exp(-0.5 * ((edge[:, None] - from_px) / 13) ** 2)
    return expit((BAND_PX - edge) / 2).astype(np.float32), mirrored.astype(np.float32)


def impellers(size: tuple[int, int], camera: int, time_s: float) -> NDArray[np.float32]:
    """Return the grey levels (H, W) of the turning disks on either side, seen from the edge, and of their reflections.

    A blade is as wide as its height above the axis' plane and moves as the cosine of its angle.
    """
    width, height = size
    band, mirrored = reflections(width)
    turned = IMPELLER_HZ * time_s * np.array([[1.0], [-1.0]]) + (np.arange(BLADES) + 0.3 * camera) / BLADES
    before = np.nonzero(np.sin(2 * np.pi * turned) > 0)  # side and blade
    angle = 2 * np.pi * turned[before][:, None]
    up = np.sin(angle)
    profile = np.exp(-0.5 * ((np.arange(height) - height / 2 * (1 + 1.1 * np.cos(angle))) / (4 + 14 * up)) ** 2)
    across = (35 + 65 * up) * band[before[0]] + 26 * up * mirrored[before]
    light = np.asarray(profile.astype(np.float32).T @ across.astype(np.float32))
    light += 20 * band.sum(0)
    return light


def put(light: NDArray[np.float32], exposure: Exposure, disk: Disk, seeds: tuple[int, int, int]) -> None:
    """Draw the sphere over grey levels (H, W), with reflections of the tank's lamps, and bubbles.

    `seeds` are camera, movie and frame: lamps are constant, bubbles change with the frame.
    """
    static, moving = (seeded(TEXTURE_SEED, *seeds[:count]) for count in (1, 3))
    bubbles = {"bubbles": float(torch.randint(MOST_BUBBLES + 1, (), generator=moving))}
    through_optics(exposure, disk, LAMPS, lambda _: static).put(light)
    window = exposure.within(round(0.5 * float(disk.radius_px))).window  # bubbles reach beyond the sphere
    light[window] = degrade(torch.from_numpy(light[window]), disk.within(window), bubbles, moving)


def film(folder: Path, number: int, frames: int) -> None:
    """Render one movie of two cameras with its truth into a new folder."""
    settings = SynthSettings(name=f"movie {number:03d}", frames=frames, diameter_px=78, seed=number)
    folder.mkdir(parents=True)
    grey = np.rint(random_texture(settings.texture, TEXTURE_SEED).numpy() * 255).astype(np.uint8)
    write_picture(folder / "texture.png", grey)
    scene = make_scene(torch.from_numpy(grey / np.float32(255)), settings)
    cameras, motion = default_cameras(settings), tumbling(number, frames / settings.frame_rate)
    times_s, poses = frame_times_s(settings), motion.at(instants_s(settings).reshape(-1))
    X, R = (part.unflatten(0, (frames, -1)) for part in (poses.position_lab_mm, poses.R_lab_body))

    def pictures(index: int, camera: Camera) -> Iterator[NDArray[np.uint8]]:
        rng = seeded(number, index)
        at, width = camera.project(X.mean(1)), torch.tensor(camera.image_size)
        near = ((at > -width) & (at < 2 * width)).all(1)  # the lens's distortion is valid only nearby
        disks = picture_of_ball(camera, X[near].mean(1), settings.diameter_mm / 2)
        seen, place = exposures([scene], camera, X[None, near], R[None, near]), near.cumsum(0) - 1
        for k in range(frames):
            light = impellers(camera.image_size, index, float(times_s[k]))
            light += settings.background
            if near[k]:
                disk = Disk(centre_px=disks.centre_px[place[k]], radius_px=disks.radius_px[place[k]])
                put(light, next(seen), disk, (index, number, k))
            yield digitise(light, settings, rng)

    for index, (name, camera) in enumerate(cameras.items()):
        write_ffv1(folder / f"{name}.mkv", pictures(index, camera), settings.frame_rate)
    save_cameras(folder / "cameras.yaml", cameras, comment="exact cameras; X_cam = R X_lab + T, mm")
    write_truth(folder / "truth.h5", {"": motion.at(times_s)}, cameras)
    # Without backgrounds: the mean of the movie is used, as in the paper.
    document = experiment_document(settings, cameras)
    del document["backgrounds"]
    (folder / "experiment.yaml").write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
