"""Test of this machine: correctness and time of a fit, and frame rates that `live` can hold."""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import psutil
import torch

from sphereorient import so3
from sphereorient.bench.score import orientations_at
from sphereorient.errors import SphereOrientError, error_words, refusal
from sphereorient.experiment.recording import open_recording
from sphereorient.files.cache import cache_folder
from sphereorient.files.compiled import WITHOUT, compiled_parts
from sphereorient.files.hdf5 import UNNAMED
from sphereorient.files.threads import cores, limited_cores
from sphereorient.follow.appearance import Appearance
from sphereorient.follow.appearance.record import Studied
from sphereorient.live.live import measured
from sphereorient.live.loop import open_live
from sphereorient.live.seen import cameras_here
from sphereorient.live.sources import movie_frames
from sphereorient.locate import Background, CameraScene
from sphereorient.methods.method import Learnt, save_learnt
from sphereorient.methods.proposers import finest_table
from sphereorient.methods.settings import Settings
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.lasting import Lasting
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory.rotations import distance_deg

LIMITS_DEG = {40.0: 0.3, 90.0: 0.1, 160.0: 0.1}  # by the ball's diameter, px: limit of the error of a right pose
FRAMES, FIRST = 40, 10  # of a ball; first ones left out, while caches fill
STILL: dict[str, Any] = {"volume_mm": 1.0, "velocity_rms": 0.0, "exposure": 0.0, "exposure_samples": 1}
TURNS = STILL | {"omega_rms": 3.0, "frame_rate": 200.0, "periodic": True}
BUSY = 0.7  # share of the time available to fits; the rest is for output and interruptions


def machine() -> tuple[dict[str, Any], list[str]]:
    """Return properties and performance of the machine, by name, for JSON; and faults, a line each."""
    free_cores = cores() * (1 - psutil.cpu_percent(0.5) / 100)
    parts, faults = compiled_parts()
    fits = []
    for px, limit_deg in LIMITS_DEG.items():
        name, expected = f"fit of a ball of {px:g} px", f"poses right to {limit_deg:g} degrees"
        do = f"run it with {WITHOUT}=1; if that is right, compile again"
        try:
            fits.append(fit_speed(px))
        except (SphereOrientError, RuntimeError, OSError) as error:
            faults.append(refusal(name, expected=expected, got=error_words(error), do=do))
            continue
        if not fits[-1]["error_deg"] < limit_deg:
            faults.append(refusal(name, expected=expected, got=f"{fits[-1]['error_deg']:.2f}", do=do))
    if not _torch_is_right():
        do = "run `pip install --force-reinstall torch`"
        faults.append(refusal("torch", expected="numpy's solution and a right gradient", got="others", do=do))
    memory = psutil.virtual_memory()
    found = {
        "compiled": parts,
        "processor": torch.backends.cpu.get_cpu_capability().lower(),
        "cores": cores(),
        "free_cores": round(free_cores, 1),
        "memory_gb": round(memory.total / 1e9, 1),
        "free_memory_gb": round(memory.available / 1e9, 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cache": str(cache_folder() or "") or None,
        "cameras": cameras_here(),
        "live_one_camera": fits,
    }
    return found, faults


def _torch_is_right() -> bool:
    A, turn = torch.linspace(-1, 2, 9).reshape(3, 3).double(), torch.tensor([0.3, -0.2, 0.5]).double()
    A, turn = A @ A.mT + torch.eye(3), turn.requires_grad_()  # with a gradient, without compiled code
    (slope,) = torch.autograd.grad((back := so3.log(so3.exp(turn))).sum(), turn)
    pairs = (torch.linalg.inv(A), np.linalg.inv(A.numpy())), (back.detach(), turn.detach()), (slope, torch.ones(3))
    return all(np.allclose(one, other) for one, other in pairs)


def fit_speed(diameter_px: float) -> dict[str, float]:
    """Render a moving ball at known poses for one camera, and measure it as `live` does. Return the largest orientation
    error (NaN: a frame without a pose), CPU and wall time per frame, and the rates that can be held on a free core, on
    a shared one, and now.
    """
    side = 2 * round(0.8 * diameter_px)
    scene = SynthSettings(frames=FRAMES, cameras=1, diameter_px=diameter_px, image_size=(side, side), **TURNS)
    with TemporaryDirectory() as folder, limited_cores(1):  # as `live`
        path, learnt = write_synthetic_experiment(Path(folder), scene), Path(folder) / "learnt.h5"
        save_learnt({UNNAMED: Learnt.of(_appearance(path, scene))}, learnt)
        R_true = orientations_at(path.parent / "truth.h5", np.arange(FRAMES))
        with open_live(path, Settings(), None, learnt) as opened:
            frames = list(movie_frames(opened.recording, paced=False))
            views, measured_s, found = opened.tracker.appearances[""].fitter.views, [], []
            for now in measured(opened.tracker, views, frames):
                measured_s.append((time.process_time(), time.perf_counter()))
                found.append(now.R_lab_body)
    cpu_ms, now_ms = (1e3 * (np.array(measured_s[-1]) - measured_s[FIRST - 1]) / (FRAMES - FIRST)).tolist()
    return {
        "diameter_px": diameter_px,
        "error_deg": float(distance_deg(np.array(found), R_true).max()),
        "cpu_ms": cpu_ms,
        "now_ms": now_ms,
        "hz_free_core": 1e3 * BUSY / cpu_ms,
        "hz_shared_core": 0.5e3 * BUSY / cpu_ms,
        "hz_now": 1e3 * BUSY / now_ms,
    }


def _appearance(path: Path, scene: SynthSettings) -> Appearance:
    """Return the appearance that `track` would learn, from known poses."""
    with open_recording(path) as recording, h5py.File(path.parent / "truth.h5") as truth:
        (stream,) = recording.streams
        pictures = [[picture] for picture, _ in stream.pictures() if picture is not None][::FIRST]
        X, R = (torch.from_numpy(truth[name][::FIRST]) for name in ("position", "orientation"))
        level = np.full(stream.movie.frame_shape, 1.0, np.float32)
        behind = Background(mean=scene.background * level, noise=scene.read_noise * level, full_scale=255.0)
        view = CameraView.of(stream.name, stream.camera, CameraScene(background=behind, diameter_px=scene.diameter_px))
        paint = finest_table(recording.texture, scene.diameter_px, None)
        fitter = first_fitter([view], recording.experiment.radius_mm, paint, scene.blur_px)
        studied = Studied.begun(fitter, paint, pictures, (X, R, torch.ones(len(X), 1, dtype=torch.bool)), None)
        lit = replace(studied.lit().fitter, widest_px=0.6 * scene.diameter_px)
    return Appearance(fitter=lit, still=lit, lasting=Lasting.none(1), score_min=0.8, right_score=0.98)
