"""The poses of some frames in a file, to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import torch

from sphereorient.files.hdf5 import whole_hdf5
from sphereorient.follow import POSE_PARTS, Poses
from sphereorient.trajectory import Reason

SCHEMA = "sphereorient-poses/1"


def write_poses(path: Path, poses: Sequence[Poses]) -> None:
    """Write the poses of consecutive frames, aside, onto the disk, and then under their name.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_hdf5(path, "check the space left, then run again with --resume") as file:
        file.attrs["schema"] = SCHEMA
        file["count"] = np.array([len(one) for one in poses])
        file["use"] = np.stack([one.use.numpy() for one in poses])
        file["reason"] = np.array([[str(why) for why in one.reason] for one in poses], "S16")
        for name in POSE_PARTS:
            file[name] = torch.cat([getattr(one, name) for one in poses]).numpy()


def read_poses(path: Path) -> list[Poses] | None:
    """Return what `write_poses` wrote, or None where the file is not whole."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                return None
            count, use = file["count"][()].tolist(), torch.from_numpy(file["use"][()])
            reason = [[Reason(why.decode()) for why in row] for row in file["reason"][()].tolist()]
            parts = {name: torch.split(torch.from_numpy(file[name][()]), count) for name in POSE_PARTS}
    except (OSError, KeyError, ValueError, RuntimeError):
        return None
    return [
        # Copies: rows of one array would keep the whole of it.
        Poses(**{name: parts[name][k].clone() for name in POSE_PARTS}, use=use[k].clone(), reason=tuple(reason[k]))
        for k in range(len(count))
    ]
