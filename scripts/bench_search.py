"""Measure the grey search: speed, and how often its best proposal is the right orientation.

    scripts/bench_search.py [EXPERIMENT_FOLDER ...] [--attitudes N]

Synthetic frames (one ball each, random attitude, noise 5 % of the step from black to white, outline half a pixel of 80
and up to 1 % of the radius off) of three paints under three lights; then every frame of the experiments given, which
hold experiment.yaml and truth.h5, with the outlines that `locate` finds. Times are CPU seconds of one thread, best
quarter of the repetitions, since other programs only make them longer.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sphereorient import locate, so3
from sphereorient.cameras import Camera, R_cam_view
from sphereorient.experiment.recording import open_recording
from sphereorient.locate import find_scenes, screened_frames
from sphereorient.methods.settings import Settings
from sphereorient.search import GreySearch, GreySearchSettings, crop_disk
from sphereorient.sphere import orthographic_view
from sphereorient.synth import SynthSettings, make_scene, random_texture, render_frame
from sphereorient.synth.scene import seeded
from sphereorient.synth.write import default_cameras

LIGHTS = {"even": 1.0, "lamps": 0.5, "one side dark": 0.05}  # share of even light
PATTERNS = {"blobs": 1, "patches": 2, "dots": 3}
NOISE = 0.05
RIGHT_DEG = 3.0
CENTRE_PX, RADIUS_SHARE = 0.5, 0.01  # planted errors

Sample = tuple[np.ndarray, float, float, float, Tensor]  # picture, outline's u, v and radius (px), R_view_body


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--attitudes", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(1)
    speed()
    accuracy(options.attitudes)
    for folder in options.folders:
        on_experiment(folder)


def speed() -> None:
    print("| disk | templates | bank built | template comparisons per CPU-second, selection included | one frame |")
    print("|---|---|---|---|---|")
    rendered = frames("blobs", 1.0, 32)
    for size_px in (40, 24):
        speed_at(size_px, rendered)


def speed_at(size_px: int, rendered: list[Sample]) -> None:
    texture = random_texture("blobs", PATTERNS["blobs"])
    start = time.process_time()
    search = GreySearch(texture, GreySearchSettings(size_px=size_px))
    built = time.process_time() - start
    templates = len(search.templates)
    disks = torch.cat([cropped(size_px, *one) for one in rendered]).repeat(8, 1, 1)

    def rate(count: int) -> str:
        return f"{count * templates / cpu_s(lambda: search.search(disks[:count])) / 1e6:.0f} M ({count} disks)"

    def first_s(one: Sample) -> float:
        return cpu_s(lambda: search.propose(cropped(size_px, *one)), 8)

    pixels = int(orthographic_view(size_px).inside.sum())
    first_ms = np.mean([first_s(one) for one in rendered[:8]]) * 1e3
    print(
        f"| {size_px} px, {pixels} pixels | {templates} | {built:.2f} s | {rate(64)}, {rate(128)}, {rate(256)} "
        f"| {first_ms:.1f} ms: crop, search, climb |"
    )


def accuracy(attitudes: int) -> None:
    settings = GreySearchSettings()
    print(f"\n| paint, light | disks | best proposal within {RIGHT_DEG:g}° | none | p50 / p95 / max (°) | score |")
    print("|---|---|---|---|---|---|")
    for paint in PATTERNS:
        search = GreySearch(random_texture(paint, PATTERNS[paint]), settings)
        for light, ambient in LIGHTS.items():
            rendered = frames(paint, ambient, attitudes)
            disks = torch.cat([cropped(settings.size_px, *one) for one in rendered])
            report(f"{paint}, {light}", search, disks, torch.stack([R for *_, R in rendered]))


def on_experiment(folder: Path) -> None:
    settings, whole = GreySearchSettings(), Settings()
    with open_recording(folder / "experiment.yaml") as recording:
        search = GreySearch(recording.texture, settings)
        with h5py.File(folder / "truth.h5") as truth:
            R_lab_body = torch.from_numpy(truth["orientation"][:])
        for stream in recording.streams:
            (scene,) = find_scenes(recording, stream, whole.locate.background_frames, whole.locate).values()
            background, diameter_px = scene.background, scene.diameter_px
            disks, R_view_body = [], []
            for k, frame in zip(recording.frames, screened_frames(stream, background), strict=True):
                outline, _ = locate.find_ball(frame.picture, background, diameter_px, whole.locate)
                if outline is not None:
                    place = (outline.u_px, outline.v_px, outline.radius_px)
                    disks.append(torch.from_numpy(crop_disk(frame.picture, *place, settings.size_px)))
                    R_view_body.append(R_lab_view(stream.camera, *place[:2]).mT @ R_lab_body[k])
            report(f"{folder.name}, {stream.name}", search, torch.stack(disks), torch.stack(R_view_body))


def report(name: str, search: GreySearch, disks: Tensor, R_view_body: Tensor) -> None:
    found = search.propose(disks)
    any_ = found.offset.diff() > 0
    best = found.offset[:-1][any_]
    error = torch.rad2deg(so3.geodesic_distance(found.R_view_body[best], R_view_body[any_]))
    right = (error <= RIGHT_DEG).sum() / len(disks)
    p50, p95 = error.quantile(0.5), error.quantile(0.95)
    print(
        f"| {name} | {len(disks)} | {right:.2%} | {int((~any_).sum())} | {p50:.2f} / {p95:.2f} / {error.max():.2f} "
        f"| {found.score[best].median():.3f}, least {found.score[best].min():.3f} |",
        flush=True,
    )


def frames(paint: str, ambient: float, count: int) -> list[Sample]:
    """Return picture, outline (u, v, radius; with planted errors) and R_view_body at random attitudes."""
    settings = SynthSettings(
        diameter_px=80, image_size=(128, 128), ambient=ambient, shot_noise=0.0, read_noise=NOISE * (170 - 20)
    )
    return list(_frames(paint, settings, count))


def _frames(paint: str, settings: SynthSettings, count: int) -> Iterator[Sample]:
    scene = make_scene(random_texture(paint, PATTERNS[paint]), settings)
    camera = default_cameras(settings)["cam1"]
    rng, noise, generator = np.random.default_rng(7), seeded(7), torch.Generator().manual_seed(7)
    position = torch.zeros(1, 3, dtype=torch.float64)
    u, v = camera.project(position[0]).tolist()
    limb_px = 0.5 * settings.diameter_px / math.sqrt(1 - (0.5 * settings.diameter_mm / settings.distance_mm) ** 2)
    for R_lab_body in so3.random_rotations(count, generator=generator):
        picture = render_frame(scene, camera, position, R_lab_body[None], noise)
        angle = rng.uniform(0, 2 * math.pi)
        radius = limb_px * (1 + RADIUS_SHARE * rng.uniform(-1, 1))
        place = (u + CENTRE_PX * math.cos(angle), v + CENTRE_PX * math.sin(angle))
        yield picture, *place, radius, R_lab_view(camera, *place).mT @ R_lab_body


def cropped(size_px: int, picture: np.ndarray, u_px: float, v_px: float, radius_px: float, _: Tensor) -> Tensor:
    return torch.from_numpy(crop_disk(picture, u_px, v_px, radius_px, size_px))[None]


def R_lab_view(camera: Camera, u_px: float, v_px: float) -> Tensor:
    ray = camera.rays(torch.tensor([u_px, v_px], dtype=torch.float64)).direction_lab
    return camera.R_cam_lab.mT @ R_cam_view(camera.R_cam_lab @ ray)


def cpu_s(work: Callable[[], object], repetitions: int = 24) -> float:
    times = []
    for _ in range(repetitions):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.quantile(times, 0.25))


if __name__ == "__main__":
    main()
