import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import torch
from conftest import REPO

from sphereorient import so3
from sphereorient.trajectory import Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt" / "experiment.yaml"
# Windows of eight frames, five in the excerpt; every fourth frame is searched for, in a small bank, the blur given.
SHORT = (
    *("refine.chunk_frames=4", "refine.chunks=2", "refine.appearance_frames=6", "refine.blur_px=0.63"),
    "search.step_deg=16",
)
SHORT_BLOCKS = [word for changed in SHORT for word in ("--set", changed)]
COMMAND = [sys.executable, "-m", "sphereorient.cli", "track"]


def datasets(path: Path) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    """Every dataset of a track, to the last bit."""
    found = {}

    def keep(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            values = np.asarray(item[()])
            found[name] = (str(values.dtype), values.shape, values.tobytes())

    with h5py.File(path, "r") as file:
        file.visititems(keep)
    return found


def run(*arguments: object, **more: object) -> subprocess.CompletedProcess[str]:
    """Run the command line."""
    words = [*COMMAND, *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=False, **more)


def off_deg(track: Trajectory, experiment: Path) -> np.ndarray:
    """Errors of a track's orientations, (N,), degrees."""
    with h5py.File(experiment.parent / "truth.h5") as truth:
        R = torch.from_numpy(truth["orientation"][()])
    return np.degrees(so3.geodesic_distance(torch.from_numpy(track.orientation), R).numpy())


def rms_sigmas(track: Trajectory, off: np.ndarray) -> float:
    """The same in stated standard deviations, rms."""
    sigma = np.degrees(np.sqrt(np.trace(track.orientation_cov, axis1=1, axis2=2)))
    return float(np.sqrt(np.mean((off / sigma) ** 2)))
