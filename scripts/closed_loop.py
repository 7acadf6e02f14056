"""Measure the delay of a closed loop: scripts/closed_loop.py [PICTURES_A_SECOND [SECONDS]]

An animal on a rendered ball turns at a constant rate. Pictures are written into shared memory as by a camera,
`sphereorient live` measures them and sends FicTrac's lines over a socket, and each line sets the next picture: the ball
is rotated back by a share of the heading. The heading settles at TURN_DEG / GAIN if the measurements are right.
"""

from __future__ import annotations

import math
import socket
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import yaml

from sphereorient import so3
from sphereorient.experiment import load_experiment
from sphereorient.live.shared import SharedFrames
from sphereorient.sphere import load_texture
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.synth.scene import digitise, expose, make_scene, seeded

STILL = {"velocity_rms": 0.0, "volume_mm": 1e-3, "omega_rms": 4.0, "omega_time": 0.2, "exposure": 0.001}
SETTINGS = SynthSettings(frames=60, frame_rate=100.0, image_size=(240, 200), diameter_px=90.0, **STILL)
TURN_DEG, GAIN = 1.0, 0.1  # turn of the animal per picture; share of the heading that is rotated back
HEADING = 17  # index in the line, "FT" is 0


def main(rate_hz: float = 50.0, seconds: float = 10.0) -> None:
    with TemporaryDirectory() as place, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lines:
        experiment, pictures = set_up(Path(place))
        rng, turned_deg, delay_s, heading_deg = seeded(1), 0.0, [], []
        lines.bind(("127.0.0.1", 0))
        lines.settimeout(120)  # the appearance is learnt first
        command = [sys.executable, "-m", "sphereorient.cli", "live", experiment, "--cameras", "cam1"]
        command += ["--source", f"shared:{place}/ring", "--to", f"udp:{lines.getsockname()[1]}"]
        with SharedFrames(Path(place) / "ring", pictures[0].size) as ring:  # 8 bit: a byte a pixel
            tracker = subprocess.Popen(command)
            for _ in range(round(seconds * rate_hz)):
                picture = digitise(pictures[round(turned_deg) % 360], SETTINGS, rng)  # noise: no two are alike
                begun_s = time.perf_counter()
                ring.write(begun_s, [picture])
                heading = math.degrees(float(lines.recv(4096).decode().split(",")[HEADING]))
                heading_deg.append((heading + 180) % 360 - 180)
                turned_deg += TURN_DEG - GAIN * np.nan_to_num(heading_deg[-1])  # the answer
                delay_s.append(time.perf_counter() - begun_s)
                time.sleep(max(0.0, begun_s + 1 / rate_hz - time.perf_counter()))
        tracker.wait()  # it ends with the ring
    half = len(delay_s) // 2  # the first line waited for the set-up; then the loop settles
    p50, p99 = 1e3 * np.quantile(delay_s[half:], (0.5, 0.99))
    print(f"picture to answer: {p50:.1f} ms (median), {p99:.1f} ms (99 %) at {rate_hz:g} pictures a second")
    print(f"heading held at {np.nanmean(heading_deg[half:]):.2f} degrees; expected {TURN_DEG / GAIN:.2f}")


def set_up(folder: Path) -> tuple[str, list[np.ndarray]]:
    """Write an experiment with a fixed ball; return it and a picture of the ball per degree."""
    write_synthetic_experiment(folder, SETTINGS)
    path = folder / "experiment.yaml"
    known = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump(known | {"sphere": known["sphere"] | {"fixed": True}}))
    loaded = load_experiment(path)
    scene, camera = make_scene(load_texture(loaded.texture_path), SETTINGS), loaded.cameras["cam1"]
    turn = torch.outer(torch.deg2rad(torch.arange(360.0).double()), torch.tensor([0.0, 0.0, -1.0]).double())
    centre = torch.zeros(1, 3, dtype=torch.float64)
    return str(path), [
        expose([scene], camera, centre[None], R[None, None]).before(SETTINGS.background) for R in so3.exp(turn)
    ]


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
